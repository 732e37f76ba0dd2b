"""The topics of a recording, and the messages that each may hold."""

from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration as CalibrationMessage
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

LEFT, RIGHT = "/camera/left/image_raw", "/camera/right/image_raw"
LEFT_INFO, RIGHT_INFO = "/camera/left/camera_info", "/camera/right/camera_info"
TF, TF_STATIC = "/tf", "/tf_static"
POSE, GRASP, POINTS, EVENT = "/tool/pose", "/tool/grasp", "/tissue/points", "/event/topology"
JSON_TOPICS = (GRASP, EVENT)
"""Topics whose messages are JSON."""
SCHEMAS: dict[str, tuple[Any, ...]] = {
    LEFT: (CompressedImage, RawImage),
    RIGHT: (CompressedImage, RawImage),
    LEFT_INFO: (CalibrationMessage,),
    RIGHT_INFO: (CalibrationMessage,),
    TF: (FrameTransforms, FrameTransform),
    TF_STATIC: (FrameTransforms, FrameTransform),
    POSE: (PoseInFrame,),
    POINTS: (PointCloud,),
}
"""Topics that are read as protobuf, and the message classes allowed on each."""
FORCE = "/tool/force"
"""Topic of the force on the tool, which is JSON; in another encoding it is ignored."""
