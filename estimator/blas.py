"""Limit BLAS to one thread, because its own threads compete with XLA's.

On two cores an update with both takes 1.5 times as long; where the cores are shared, many times as long.
"""

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_thread() -> AbstractContextManager[object]:
    """Return a context in which BLAS uses one thread."""
    return _controller().limit(limits=1, user_api="blas")


@cache
def _controller() -> ThreadpoolController:
    """Find the loaded BLAS libraries, once."""
    return ThreadpoolController()
