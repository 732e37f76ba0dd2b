"""Freed memory is kept for the next frame: asking Linux for it anew, page by page, takes an eighth of an update."""

import ctypes

TRIM_THRESHOLD, TOP_PAD, MMAP_MAX = -1, -2, -4
"""Parameters of mallopt(3), as <malloc.h> numbers them."""
KEPT, GROWTH = 2**31 - 1, 2**28
"""Free bytes at the heap's end from which on they go back to the system (the most that an int says), and by how many
the heap grows at least."""


def keep_freed_memory() -> None:
    """Of this whole process, from now on, where the C library has mallopt(3); elsewhere nothing changes."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for parameter, value in ((MMAP_MAX, 0), (TRIM_THRESHOLD, KEPT), (TOP_PAD, GROWTH)):
            mallopt(parameter, value)
