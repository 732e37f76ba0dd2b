"""Writing observations to a recording: an MCAP file that holds what an estimator may see, and nothing else.

The topics are in docs/RECORDINGS.md; `reader` reads them back.
"""

import os
from dataclasses import replace
from types import TracebackType
from typing import Self

import numpy as np
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from ..argument_checks import as_instance, as_path, quoted
from ..camera import StereoCamera
from ..errors import OptionError
from ..observation import Declaration, MeasuredPoints, Observation
from .declaration import METADATA, file_metadata, write_declaration
from .events import EVENT_SCHEMA, event_json
from .force import FORCE_SCHEMA, NO_TORQUE, UNMEASURED, ToolForce, force_json
from .frames import camera_transforms
from .mcap_files import McapOutput
from .schemas import (
    GRASP_SCHEMA,
    WORLD,
    calibration_message,
    grasp_json,
    image_message,
    point_cloud,
    pose_message,
)
from .topics import EVENT, FORCE, GRASP, LEFT, LEFT_INFO, POINTS, POSE, RIGHT, RIGHT_INFO, TF


class RecordingWriter:
    """Write observations to a file as they come; what is written survives a crash.

    Args:
        path: the file to write.
        camera: the camera that takes the images; None for a recording of points.
        declaration: what the user says is known.
        metadata: entries of the caller, such as the seed.
        overwrite: replace an existing file.

    Raises:
        OptionError: an argument is of another type.
        OutputError: the path exists, or cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        camera: StereoCamera | None,
        declaration: Declaration,
        metadata: dict[str, str],
        overwrite: bool = False,
    ) -> None:
        path = as_path(path, "the recording's path")
        if camera is not None:
            as_instance(camera, "camera", StereoCamera)
        as_instance(declaration, "declaration", Declaration)
        if not all(isinstance(text, str) for text in (*as_instance(metadata, "metadata", dict), *metadata.values())):
            raise OptionError(f"metadata must be a dict of texts; got {quoted(metadata)}.")
        self._camera, self._forces_began = camera, False
        self._output = McapOutput(path, overwrite=overwrite)
        self._output.metadata(METADATA, file_metadata() | metadata)
        write_declaration(self._output, declaration)
        if camera is not None:
            self._output.message(LEFT_INFO, 0, calibration_message(camera.left, "left"))
            self._output.message(RIGHT_INFO, 0, calibration_message(camera.right, "right"))
            self._output.message(TF, 0, camera_transforms(camera))
        self._output.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def write(self, observation: Observation) -> None:
        """Write one observation, and hand it to the operating system.

        Raises:
            OptionError: this is no observation.
            ValueError: the observation has images, and the writer has no camera.
        """
        as_instance(observation, "observation", Observation)
        output, time = self._output, observation.time
        for report in observation.reports:
            at_report = replace(observation.tool, position=report.position)
            output.message(POSE, report.time, pose_message(report.time, at_report))
        output.message(POSE, time, pose_message(time, observation.tool))
        output.json(GRASP, time, grasp_json(observation.tool), schema=GRASP_SCHEMA)
        for event in observation.events:
            output.json(EVENT, time, event_json(event), schema=EVENT_SCHEMA)
        if observation.images is not None:
            if self._camera is None:
                raise ValueError("RecordingWriter.camera is None, and the observation has images; give the camera.")
            output.message(LEFT, time, image_message(time, observation.images.left, "left"))
            output.message(RIGHT, time, image_message(time, observation.images.right, "right"))
        if observation.points is not None:
            output.message(POINTS, time, _points_message(time, observation.points))
        measured = observation.force
        if measured is not None or self._forces_began:  # else the force of the frame before would be read in this one
            x, y, z = UNMEASURED if measured is None else measured.on_tool.tolist()
            sd, self._forces_began = None if measured is None else measured.sd, True
            self.write_force(ToolForce(time=time, force=(x, y, z), torque=NO_TORQUE, frame_id=WORLD, sd=sd))
        output.flush()

    def write_force(self, force: ToolForce) -> None:
        """Write a measured force at its own time."""
        self._output.json(FORCE, force.time, force_json(force), schema=FORCE_SCHEMA)

    def close(self) -> None:
        """Write the index and close the file."""
        self._output.close()


def _points_message(time: int, points: MeasuredPoints) -> PointCloud:
    columns: dict[str, np.ndarray] = dict(zip("xyz", np.asarray(points.positions, float).T, strict=True))
    if points.track_id is not None:
        columns["track_id"] = points.track_id
    stated = {"sd": points.sd} if points.sd_stated else {}
    if points.smooth_sd and points.smooth_length is not None:
        stated |= {"smooth_sd": points.smooth_sd, "smooth_length": points.smooth_length}
    columns |= {name: np.full(len(points.positions), value) for name, value in stated.items()}
    return point_cloud(time, columns)
