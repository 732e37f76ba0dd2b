"""A calibrated stereo camera: pinhole projection, disparity, and the conventions of its frames.

Cameras follow the OpenCV optical convention (x right, y down, z forward); pixel coordinates put integers at pixel
centres. `T_world_camera` maps points in the left camera's optical frame to the world.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .argument_checks import as_array, as_instance, as_integer, as_number, store
from .errors import ObservationError

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Transform from an OpenGL camera frame (y up, looking along -z; MuJoCo's) to an optical one; it is its own inverse."""
QUATERNION_DECIMALS = 12
"""Decimals of a recorded quaternion: few enough that a rotation that is read is recorded as the same digits again."""
MAX_BASELINE_M = 1.0
"""Largest baseline [m]: a stereo endoscope has 4 mm, a stereo head over a table 0.3 m."""
EQUAL_INTRINSICS = 1e-6
"""Largest relative and absolute [px] difference of equal rectified intrinsics: a calibration file rounds its digits."""
ORTHONORMAL = 1e-3
"""Largest difference of R^T R from the identity: calibration files print a rotation with few digits."""


def rounded_quaternion(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 4"]:
    """Return a rotation as a recording holds it: a quaternion wxyz of `QUATERNION_DECIMALS`."""
    return Rotation.from_matrix(R).as_quat(scalar_first=True).round(QUATERNION_DECIMALS)


def matrix_from_quaternion(quat_wxyz: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a quaternion, which need not be of unit length."""
    return Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix()


def as_recorded(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return a pose bit by bit as a recording gives it back.

    The rotation is rounded and read twice, as a rounded quaternion is of unit length only to its last decimal.
    """
    recorded = T.copy()
    for _ in range(2):
        recorded[:3, :3] = matrix_from_quaternion(rounded_quaternion(recorded[:3, :3]))
    return recorded


def optical_from_opengl(T_world_opengl: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a camera's optical frame from that of its OpenGL frame, both camera to world [m]."""
    return T_world_opengl @ OPENCV_FROM_OPENGL


def _check_rotation(R: Float[np.ndarray, "3 3"], where: str) -> None:
    """Refuse a matrix that is no rotation.

    Raises:
        ObservationError: its columns are not of unit length and at right angles, or it mirrors.
    """
    bounded = np.abs(R).max() <= 1 + ORTHONORMAL  # products of larger numbers may overflow
    if not bounded or np.abs(R.T @ R - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(R) < 0:
        shown = ", ".join(f"[{', '.join(f'{x:.4g}' for x in row)}]" for row in R)
        raise ObservationError(f"{where} must be a rotation matrix; got [{shown}].")


@dataclass(frozen=True, kw_only=True)
class CameraCalibration:
    """Calibration of one camera of the pair, with the fields of `sensor_msgs/CameraInfo`.

    Raises:
        ObservationError: a size is not a whole number above 0, a matrix has another shape or numbers that are not
            finite, a focal length is not above 0, or R is no rotation.
    """

    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    K: Float[np.ndarray, "3 3"]
    """Intrinsic matrix of the raw image [px]."""
    P: Float[np.ndarray, "3 4"]
    """Projection matrix of the rectified image [px]; the right camera has P[0, 3] = -fx * baseline [px m]."""
    D: Float[np.ndarray, " d"] = field(default_factory=lambda: np.zeros(5))
    """Distortion coefficients in OpenCV's `plumb_bob` order; zeros for a rectified image."""
    R: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """Rotation from the raw to the rectified optical frame."""

    def __post_init__(self) -> None:
        """Check sizes and matrices."""
        name, error = "CameraCalibration", ObservationError
        for size in ("width", "height"):
            store(self, **{size: as_integer(getattr(self, size), f"{name}.{size} [px]", at_least=1, error=error)})
        for matrix, shape in (("K", (3, 3)), ("P", (3, 4)), ("R", (3, 3)), ("D", (None,))):
            store(self, **{matrix: as_array(getattr(self, matrix), f"{name}.{matrix}", shape, error=error)})
        for matrix in ("K", "P"):
            diagonal = getattr(self, matrix)[[0, 1], [0, 1]]
            if not (diagonal > 0).all():
                raise error(f"{name}.{matrix} must have focal lengths fx, fy above 0 px; got {diagonal.tolist()}.")
        _check_rotation(self.R, f"{name}.R")

    @property
    def rectified(self) -> bool:
        """Return whether the raw image already is the rectified one."""
        return not self.D.any() and np.allclose(self.R, np.eye(3)) and np.allclose(self.K, self.P[:, :3])


@dataclass(frozen=True, kw_only=True)
class StereoCamera:
    """Two calibrated cameras and the pose of the left one.

    Raises:
        ObservationError: sizes or rectified intrinsics differ, the right camera's P[0, 3] is not negative (swapped?),
            the baseline is beyond `MAX_BASELINE_M`, or the pose is not a rigid transform of shape (4, 4).
    """

    left: CameraCalibration
    """Calibration of the left camera."""
    right: CameraCalibration
    """Calibration of the right camera."""
    T_world_camera: Float[np.ndarray, "4 4"]
    """Transform from the left rectified optical frame to the world [m]."""

    def __post_init__(self) -> None:
        """Check that the two calibrations belong together, and the pose."""
        for side in ("left", "right"):
            as_instance(getattr(self, side), f"StereoCamera.{side}", CameraCalibration, error=ObservationError)
        T = as_array(self.T_world_camera, "StereoCamera.T_world_camera", (4, 4), error=ObservationError)
        _check_rotation(T[:3, :3], "StereoCamera.T_world_camera[:3, :3]")
        if not np.array_equal(T[3], [0, 0, 0, 1]):
            raise ObservationError(f"StereoCamera.T_world_camera must end in the row 0 0 0 1; got {T[3].tolist()}.")
        store(self, T_world_camera=T)
        sizes = [(c.width, c.height) for c in (self.left, self.right)]
        if sizes[0] != sizes[1]:
            raise ObservationError(
                f"camera_info sizes differ: left {sizes[0]}, right {sizes[1]}; both must be one rectified size."
            )
        if not self.baseline > 0:
            raise ObservationError(
                f"right camera_info has P[0,3] = {self.right.P[0, 3]:.6g}; it must be -fx*baseline, below zero "
                "(are the cameras swapped, or is the calibration monocular?)."
            )
        if self.baseline > MAX_BASELINE_M:
            raise ObservationError(
                f"the baseline is {self.baseline:.4g} m (right camera_info P[0,3] = {self.right.P[0, 3]:.6g}); at most "
                f"{MAX_BASELINE_M:g} m are read (is it in millimetres? then it is {self.baseline / 1e3:.4g} m)."
            )
        if self.left.P[0, 3] != 0 or not np.allclose(
            self.left.P[:, :3], self.right.P[:, :3], rtol=EQUAL_INTRINSICS, atol=EQUAL_INTRINSICS
        ):
            raise ObservationError(
                f"the rectified cameras differ: left P = {self.left.P.tolist()}, right P = {self.right.P.tolist()}; "
                "all but the right P[0,3] must be equal (rectify with OpenCV's CALIB_ZERO_DISPARITY)."
            )

    @classmethod
    def rectified(
        cls, *, width: int, height: int, focal: float, baseline: float, T_world_camera: Float[np.ndarray, "4 4"]
    ) -> "StereoCamera":
        """Return an ideal pair whose principal point is the image's centre.

        Args:
            width: of both images [px].
            height: of both images [px].
            focal: focal length [px].
            baseline: distance between the two centres of projection [m].
            T_world_camera: left optical frame to world [m].

        Raises:
            ObservationError: a size, the focal length or the baseline is not above 0, or the pose is not a rigid
                transform.
        """
        name, error = "StereoCamera.rectified", ObservationError
        focal = as_number(focal, f"{name}: focal", unit="px", above=0, error=error)
        baseline = as_number(baseline, f"{name}: baseline", unit="m", above=0, error=error)
        width = as_integer(width, f"{name}: width [px]", at_least=1, error=error)
        height = as_integer(height, f"{name}: height [px]", at_least=1, error=error)
        K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
        left, right = np.hstack([K, np.zeros((3, 1))]), np.hstack([K, [[-focal * baseline], [0], [0]]])
        return cls(
            left=CameraCalibration(width=width, height=height, K=K, P=left),
            right=CameraCalibration(width=width, height=height, K=K, P=right),
            T_world_camera=T_world_camera,
        )

    @property
    def focal(self) -> tuple[float, float]:
        """Return the rectified focal lengths fx, fy [px]."""
        return float(self.left.P[0, 0]), float(self.left.P[1, 1])

    @property
    def centre(self) -> tuple[float, float]:
        """Return the rectified principal point cx, cy [px]."""
        return float(self.left.P[0, 2]), float(self.left.P[1, 2])

    @property
    def baseline(self) -> float:
        """Return the distance between the two centres of projection [m]."""
        return float(-self.right.P[0, 3] / self.right.P[0, 0])

    def in_camera(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Return world points in the left rectified optical frame [m]."""
        T = np.linalg.inv(self.T_world_camera)
        return points @ T[:3, :3].T + T[:3, 3]

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Return left pixel u, v and disparity u_left - u_right [px] of world points [m]; it is positive in front."""
        camera = self.in_camera(points)
        (fx, fy), (cx, cy), depth = self.focal, self.centre, camera[..., 2]
        return np.stack(
            [fx * camera[..., 0] / depth + cx, fy * camera[..., 1] / depth + cy, fx * self.baseline / depth], axis=-1
        )

    def back_project(self, uvd: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Return the world points [m] of left pixel u, v and disparity [px]: the inverse of `project`."""
        (fx, fy), (cx, cy) = self.focal, self.centre
        depth = fx * self.baseline / uvd[..., 2]
        camera = np.stack([(uvd[..., 0] - cx) * depth / fx, (uvd[..., 1] - cy) * depth / fy, depth], axis=-1)
        return camera @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]

    def back_projection_jacobian(self, uvd: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
        """Return the derivative of `back_project` [m/px], which propagates pixel noise to the world."""
        (fx, fy), (cx, cy) = self.focal, self.centre
        u, v, d = np.moveaxis(uvd, -1, 0)
        depth, zero = fx * self.baseline / d, np.zeros_like(d)
        jacobian = np.stack(
            [
                np.stack([depth / fx, zero, -(u - cx) * depth / (fx * d)], axis=-1),
                np.stack([zero, depth / fy, -(v - cy) * depth / (fy * d)], axis=-1),
                np.stack([zero, zero, -depth / d], axis=-1),
            ],
            axis=-2,
        )
        return self.T_world_camera[:3, :3] @ jacobian
