"""Checks of arrays that a file holds, at the one place where they enter: type, shape, finiteness, range of indices."""

from collections.abc import Mapping

import numpy as np

from ..errors import RecordingError

MAX_LENGTH_M = 1e6
"""Largest coordinate [m]: 1000 km; beyond it, float64 resolves no micrometre and products overflow."""


class StoredArrays:
    """The arrays of one attachment or message by name, each taken with its check.

    Args:
        arrays: the arrays.
        where: what holds them, for messages.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray], where: str) -> None:
        self._arrays, self._where = arrays, where

    def __contains__(self, name: str) -> bool:
        return name in self._arrays

    def names(self) -> str:
        """Return the names of the arrays, for messages."""
        return ", ".join(sorted(self._arrays))[:200] or "none"

    def only(self, known: set[str]) -> bool:
        """Return whether there are no other arrays than these."""
        return set(self._arrays) <= known

    def numbers(self, name: str, shape: tuple[int | None, ...], *, finite: bool = False) -> np.ndarray:
        """Return real numbers as float64; None in the shape stands for any length.

        Raises:
            RecordingError: the array is missing, holds no real numbers or numbers that must be finite and are not, or
                has another shape.
        """
        values = self._taken(name, shape)
        if values.dtype.kind not in "fiub":
            self._refuse(name, "real numbers", f"{values.dtype}")
        with np.errstate(invalid="ignore"):  # raised by a signalling NaN
            values = values.astype(float)
        if finite and not np.isfinite(values).all():
            self._refuse(name, "finite numbers", "NaN or infinity")
        return values

    def positions(self, name: str, shape: tuple[int | None, ...], *, finite: bool = False) -> np.ndarray:
        """Return coordinates [m] within `MAX_LENGTH_M`; NaN where they need not be finite.

        Raises:
            RecordingError: as in `numbers`, or a coordinate is larger.
        """
        values = self.numbers(name, shape, finite=finite)
        size = np.abs(values)
        if (too_large := size > MAX_LENGTH_M).any():
            self._refuse(name, f"coordinates within {MAX_LENGTH_M:g} m", f"{size[too_large].max():.3g}")
        return values

    def indices(self, name: str, shape: tuple[int | None, ...], *, below: int, from_: int = 0) -> np.ndarray:
        """Return whole numbers from `from_` to `below` - 1.

        Raises:
            RecordingError: the array is missing, holds no whole numbers or numbers out of range, or has another shape.
        """
        values = self._taken(name, shape)
        if values.dtype.kind not in "iu":
            self._refuse(name, "whole numbers", f"{values.dtype}")
        if values.size and (values.min() < from_ or values.max() >= below):
            self._refuse(name, f"numbers from {from_} to {below - 1}", f"{values.min()} to {values.max()}")
        return values.astype(np.int64)

    def flags(self, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """Return true or false; 0 and 1 count.

        Raises:
            RecordingError: the array is missing, holds anything else, or has another shape.
        """
        values = self._taken(name, shape)
        if values.dtype.kind not in "biu" or not np.isin(values, (0, 1)).all():
            self._refuse(name, "true or false", f"{values.dtype}")
        return values.astype(bool)

    def scalar(self, name: str) -> float:
        """Return one real number.

        Raises:
            RecordingError: the array is missing, or is not one real number.
        """
        return float(self.numbers(name, ()))

    def _taken(self, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
        if name not in self._arrays:
            raise RecordingError(f"{self._where} lacks {name}; it has {self.names()}.")
        values = self._arrays[name]
        same = all(wanted is None or length == wanted for length, wanted in zip(values.shape, shape, strict=False))
        if values.ndim != len(shape) or not same:
            wanted = ", ".join("any" if length is None else str(length) for length in shape)
            self._refuse(name, f"of shape ({wanted})", f"{values.shape}")
        return values

    def _refuse(self, name: str, allowed: str, given: str) -> None:
        raise RecordingError(f"{self._where} has an array {name} of {given[:80]}; it must be {allowed}.")
