"""The frames that a filter keeps, as arrays of an estimate's file.

Of a precision, which is symmetric, six numbers are stored. Positions stay in float64, so that identifying from the file
gives what identifying from the recording gives.
"""

import numpy as np

from ..errors import RecordingError
from ..estimate import KeptFrames
from .stored_arrays import StoredArrays

KEPT_FRAMES = "frames.npz"
"""Attachment."""
MAX_KEPT_BYTES = 1 << 28
"""Largest size of the frames in memory that is stored [byte]: half of the largest attachment that is read."""
FORCES = ("force_index", "pull", "pull_covariance", "offset_sd", "offset_number")
NAMES = ("grasp", "x", "y", "held", "force_unknown", *FORCES)
"""Arrays that are stored as they are; the former are those of the measured forces."""
ROW, COLUMN = np.triu_indices(3)
"""Places of the six stored numbers of a precision."""


def frames_to_arrays(frames: KeptFrames) -> dict[str, np.ndarray]:
    """Return the arrays by name."""
    arrays = {name: getattr(frames, name) for name in NAMES}
    arrays["precision"] = frames.precision[:, :, ROW, COLUMN]
    return arrays if frames.fields is None else arrays | {"fields": frames.fields}


def frames_from_arrays(arrays: StoredArrays, n: int, where: str) -> KeptFrames:
    """Return the frames of an estimate of n particles.

    Args:
        arrays: as they were stored.
        n: number of particles.
        where: what holds them, for messages.

    Raises:
        RecordingError: an array is missing or damaged.
    """
    grasp = arrays.indices("grasp", (None,), below=np.iinfo(np.int32).max)
    f = len(grasp)
    stored = arrays.numbers("precision", (f, n, 6), finite=True)  # its size is checked before memory is taken
    precision = np.empty((f, n, 3, 3))
    precision[:, :, ROW, COLUMN] = precision[:, :, COLUMN, ROW] = stored
    if f == 0 or (np.diff(grasp) < 0).any() or (stored[:, :, ROW == COLUMN] < 0).any():
        raise RecordingError(f"{where} is damaged: it holds no frames in order, with precisions; estimate again.")
    force_index = arrays.indices("force_index", (None,), below=f)
    p = len(force_index)
    if (np.diff(force_index) <= 0).any():
        raise RecordingError(f"{where} is damaged: its forces are not in order; estimate again.")
    return KeptFrames(
        grasp=grasp,
        x=arrays.positions("x", (f, n, 3), finite=True),
        y=arrays.positions("y", (f, n, 3), finite=True),
        precision=precision,
        held=arrays.flags("held", (f, n)),
        force_unknown=arrays.flags("force_unknown", (f, n)),
        fields=arrays.positions("fields", (n, None), finite=True) if "fields" in arrays else None,
        force_index=force_index,
        pull=arrays.numbers("pull", (p, 3), finite=True),
        pull_covariance=arrays.numbers("pull_covariance", (p, 3, 3)),
        offset_sd=arrays.numbers("offset_sd", (p,)),
        offset_number=arrays.indices("offset_number", (p,), below=np.iinfo(np.int32).max),
    )
