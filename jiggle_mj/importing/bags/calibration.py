"""The stereo camera of a bag: CameraInfo or calibration files, and /tf where they have no baseline.

The right camera's P[0,3] is minus fx times the baseline. Where P is missing, or is that of two single cameras, the pair
is rectified from K, D and the transform between the two optical frames, by OpenCV's stereoRectify. Conventions:
sensor_msgs/CameraInfo, and the YAML of the ROS package camera_calibration.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from ...camera import MAX_BASELINE_M, CameraCalibration, StereoCamera
from ...errors import ObservationError, RecordingError
from ...recording.frames import transform_of_rotation

MODELS = ("plumb_bob", "rational_polynomial")
"""Distortion models that are read; with coefficients of zero every model is none."""
BASELINE_AGREEMENT = 0.05
"""Largest relative difference of the baselines of CameraInfo and /tf that passes without a word."""


@dataclass(frozen=True, kw_only=True)
class CameraSource:
    """What a bag or a file says of one camera."""

    calibration: CameraCalibration
    """The calibration; its P is K where none is given."""
    has_P: bool
    """Whether P is given, and not zero."""
    frame: str
    """Name of the optical frame; empty for a file."""
    where: str
    """Topic or file."""


def parse_camera_info(message: Any, where: str, frame: str) -> CameraSource:
    """Return the calibration in a `sensor_msgs/CameraInfo` of ROS 1 or 2.

    Raises:
        RecordingError: uncalibrated, another distortion model, a part of the image, or numbers that are not finite.
    """
    K, D, R, P = (
        np.array(getattr(message, name, getattr(message, name.upper(), ())), float) for name in ("k", "d", "r", "p")
    )
    roi = getattr(message, "roi", None)
    binned = max(int(getattr(message, "binning_x", 0)), int(getattr(message, "binning_y", 0))) > 1
    if binned or (roi is not None and (roi.x_offset or roi.y_offset)):
        raise RecordingError(
            f"{where} describes a binned image or a part of one; record the whole image, or give its own calibration "
            "with --camera-info."
        )
    return _source(
        width=int(message.width),
        height=int(message.height),
        model=str(message.distortion_model),
        numbers=(K, D, R, P),
        frame=frame,
        where=where,
    )


def read_camera_file(path: Path, frame: str) -> CameraSource:
    """Read the YAML that the ROS package camera_calibration writes.

    Raises:
        RecordingError: missing, not that YAML, or refused as by `parse_camera_info`.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        given = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
        numbers = tuple(
            np.array(given[name]["data"], float)
            for name in ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix")
        )
        size, model = (int(given["image_width"]), int(given["image_height"])), str(given["distortion_model"])
    except (OSError, UnicodeDecodeError, YAMLError, RecursionError, KeyError, TypeError, ValueError) as failure:
        reason = " ".join(str(failure).split())[:200]
        raise RecordingError(
            f"{path} is not a calibration file of the ROS package camera_calibration ({reason}): it needs image_width, "
            "image_height, camera_matrix, distortion_model, distortion_coefficients, rectification_matrix, "
            "projection_matrix."
        ) from failure
    return _source(width=size[0], height=size[1], model=model, numbers=numbers, frame=frame, where=str(path))


def stereo_camera(
    left: CameraSource,
    right: CameraSource,
    *,
    T_world_left: Float[np.ndarray, "4 4"],
    T_left_right: Float[np.ndarray, "4 4"] | None,
    rectified: bool,
) -> tuple[StereoCamera, bool, list[str]]:
    """Return the camera pair, whether only its images can tell left from right, and what the user should know.

    Args:
        left: of the left camera.
        right: of the right camera.
        T_world_left: left optical frame to the world [m].
        T_left_right: right optical frame to the left one [m]; None where /tf does not tell.
        rectified: whether the images are rectified already.

    Raises:
        RecordingError: no baseline, one that contradicts the order of the cameras, or an implausible one.
    """
    notes: list[str] = []
    unsure = False
    pair = (left.calibration, right.calibration)
    baseline = _baseline(*pair) if left.has_P and right.has_P else None
    if baseline is None:
        if T_left_right is None:
            raise RecordingError(
                f"{left.where} and {right.where} give no baseline (P[0,3] is 0 in both, or P is missing), and /tf does "
                f"not join '{left.frame}' and '{right.frame}'; calibrate the pair, and give both files with "
                "--camera-info."
            )
        pair = _rectify(*pair, T_left_right) if not rectified else _pair_along_x(*pair, T_left_right[0, 3])
        baseline = _baseline(*pair)
        notes.append(f"baseline {1e3 * (baseline or 0):.4g} mm from /tf, as the calibration has none")
    elif T_left_right is not None:
        along = float((pair[0].R @ T_left_right[:3, 3])[0])
        if along < 0:
            raise RecordingError(
                f"by /tf the camera of {right.where} is on the left of that of {left.where}; are the topics swapped? "
                "Give --topic left=... --topic right=... --topic left_info=... --topic right_info=..."
            )
        if baseline < 0:
            baseline = -baseline
            notes.append("P[0,3] of camera_info has the other sign; by /tf the right camera is on the right")
        if abs(along - baseline) > BASELINE_AGREEMENT * abs(baseline):
            notes.append(
                f"baseline {1e3 * baseline:.4g} mm by camera_info, {1e3 * along:.4g} mm by /tf; the first is used"
            )
    elif baseline < 0:
        baseline, unsure = -baseline, True
    if baseline is None or not 0 < baseline <= MAX_BASELINE_M:
        raise RecordingError(
            f"the baseline is {baseline or 0:.4g} m (P[0,3] of {right.where} over fx); up to {MAX_BASELINE_M:g} m is "
            "read. Is P in millimetres?"
        )
    left_calibration, right_calibration = _pair_along_x(*pair, baseline)
    R = left_calibration.R
    if rectified:
        left_calibration, right_calibration = (
            replace(each, K=each.P[:, :3].copy(), D=np.zeros(5), R=np.eye(3))
            for each in (left_calibration, right_calibration)
        )
    camera = StereoCamera(
        left=left_calibration,
        right=right_calibration,
        T_world_camera=T_world_left @ transform_of_rotation(R.T),
    )
    return camera, unsure, notes


def _source(
    *, width: int, height: int, model: str, numbers: tuple[np.ndarray, ...], frame: str, where: str
) -> CameraSource:
    K, D, R, P = numbers
    R = R if R.any() else np.eye(3).ravel()
    P = P if P.size else np.zeros(12)
    has_P = bool(P[0] > 0)
    if (K.size, R.size, P.size) != (9, 9, 12):
        raise RecordingError(f"{where}: K, R, P have {K.size}, {R.size}, {P.size} numbers; they must have 9, 9, 12.")
    if not all(np.isfinite(each).all() for each in (K, D, R, P)):
        raise RecordingError(f"{where} holds numbers that are not finite.")
    if not (K[0] > 0 and K[4] > 0 and width > 0 and height > 0):
        raise RecordingError(
            f"{where} is not calibrated: fx = {K[0]:g}, size {width}x{height}; calibrate the camera, and give the file "
            "with --camera-info."
        )
    if D.any() and model not in MODELS:
        raise RecordingError(
            f"{where} has distortion model '{model[:40]}'; {' and '.join(MODELS)} are read. Rectify the images, and "
            "import the rectified topics."
        )
    if D.size > 8 and D[8:].any():
        raise RecordingError(f"{where} has {D.size} distortion coefficients that are not zero; up to 8 are read.")
    try:
        calibration = CameraCalibration(
            width=width,
            height=height,
            K=K.reshape(3, 3),
            P=P.reshape(3, 4) if has_P else np.hstack([K.reshape(3, 3), np.zeros((3, 1))]),
            D=_padded(D),
            R=R.reshape(3, 3),
        )
    except ObservationError as failure:
        raise RecordingError(f"{where}: {failure}") from failure
    return CameraSource(calibration=calibration, has_P=has_P, frame=frame, where=where)


def _padded(D: Float[np.ndarray, " d"]) -> Float[np.ndarray, " e"]:
    """Return the coefficients as five or eight numbers."""
    length = 5 if not D[5:].any() else 8
    return np.concatenate([D[:length], np.zeros(max(length - len(D), 0))])


def _baseline(left: CameraCalibration, right: CameraCalibration) -> float | None:
    """Return the baseline [m] that two P give; None where they give none. Either camera may be the reference."""
    if left.P[0, 3] == right.P[0, 3] == 0:
        return None
    return float(left.P[0, 3] / left.P[0, 0] - right.P[0, 3] / right.P[0, 0])


def _pair_along_x(
    left: CameraCalibration, right: CameraCalibration, baseline: float
) -> tuple[CameraCalibration, CameraCalibration]:
    """Return the pair with the left camera as the reference."""
    P_left, P_right = left.P.copy(), right.P.copy()
    P_left[0, 3], exact = 0.0, P_right[0, 3]
    P_right[0, 3] = -P_right[0, 0] * baseline
    if left.P[0, 3] == 0 and exact < 0 and np.isclose(exact, P_right[0, 3]):
        P_right[0, 3] = exact
    return replace(left, P=P_left), replace(right, P=P_right)


def _rectify(
    left: CameraCalibration, right: CameraCalibration, T_left_right: Float[np.ndarray, "4 4"]
) -> tuple[CameraCalibration, CameraCalibration]:
    """Return the pair with R and P of OpenCV's stereoRectify."""
    T_right_left = np.linalg.inv(T_left_right)
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        left.K,
        left.D,
        right.K,
        right.D,
        (left.width, left.height),
        np.ascontiguousarray(T_right_left[:3, :3]),
        np.ascontiguousarray(T_right_left[:3, 3:]),
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )
    return replace(left, R=R_left, P=P_left), replace(right, R=R_right, P=P_right)
