"""Ctrl-C: leave at once while nothing has been written, afterwards unwind so that files are completed."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

TYPE_CHECKING = False  # as in typing, which is not imported before Ctrl-C is quiet

if TYPE_CHECKING:
    from sys import UnraisableHookArgs
    from typing import NoReturn

INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 + SIGINT, as a shell has it."""

_interrupts: list[int] = []


@contextmanager
def leaving_at_once() -> Iterator[None]:
    """Let Ctrl-C end the process, without a word: raised among imports it would become any other exception."""
    previous = signal.signal(signal.SIGINT, _leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


@contextmanager
def unwinding() -> Iterator[None]:
    """Let Ctrl-C raise `KeyboardInterrupt`, and remember it, as a callback of a library may swallow it.

    What is raised where it cannot be (a callback, a generator that is collected) is dropped silently if it is of a kind
    that the command line reports anyway.
    """
    previous_hook, previous = sys.unraisablehook, signal.signal(signal.SIGINT, _raise)
    _interrupts.clear()

    def hook(unraisable: "UnraisableHookArgs") -> None:
        from ..errors import JiggleError

        if not isinstance(unraisable.exc_value, KeyboardInterrupt | JiggleError | OSError):
            previous_hook(unraisable)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = previous_hook
        signal.signal(signal.SIGINT, previous)


def raise_swallowed() -> None:
    """Raise the interrupt that something has swallowed.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed, and yet the work goes on.
    """
    if _interrupts:
        raise KeyboardInterrupt


def _leave(*_: object) -> "NoReturn":
    os._exit(INTERRUPTED)


def _raise(number: int, _: object) -> "NoReturn":
    _interrupts.append(number)
    raise KeyboardInterrupt
