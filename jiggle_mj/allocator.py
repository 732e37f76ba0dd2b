"""Keep freed memory for the next frame: requesting it again from Linux, page by page, takes an eighth of an update."""

import ctypes

TRIM_THRESHOLD, TOP_PAD, MMAP_MAX = -1, -2, -4
"""Parameters of mallopt(3), as <malloc.h> numbers them."""
TRIM_BYTES = 2**31 - 1
"""Free bytes at the end of the heap above which they return to the system: the largest int, so that they never do."""
GROWTH_BYTES = 2**28
"""Smallest growth of the heap [byte]: 256 MiB, so that it rarely grows."""


def keep_freed_memory() -> None:
    """Keep freed memory in this process from now on, where the C library has mallopt(3); elsewhere do nothing."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for parameter, value in ((MMAP_MAX, 0), (TRIM_THRESHOLD, TRIM_BYTES), (TOP_PAD, GROWTH_BYTES)):
            mallopt(parameter, value)
