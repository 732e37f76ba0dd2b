"""Drop compiled functions before a process has too many of them, as one that works on many sheets compiles for each."""

from pathlib import Path

import jax

MAX_MAPS = 30_000
"""Memory maps of this process from which on its compiled functions are dropped. Linux grants 65530, and XLA dies of the
lack of one; closing the loop over a sheet of new size takes 15000."""
MAPS = Path("/proc/self/maps")
"""Where Linux lists them."""


def drop_many_compiled(*, most: int = MAX_MAPS) -> bool:
    """Drop what was compiled in this process if it has more than `most` memory maps, and return whether it was.

    Elsewhere than on Linux nothing is known of them, and nothing is dropped.
    """
    many = MAPS.exists() and MAPS.read_bytes().count(b"\n") > most
    if many:
        jax.clear_caches()
    return many
