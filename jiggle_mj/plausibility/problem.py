"""A problem of a recording, and numbers in the unit in which they are easiest to read."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RecordingProblem:
    """One thing about a recording that is wrong or doubtful."""

    name: str
    """Its name, in a few words with hyphens."""
    refuses: bool
    """Whether an estimate would be meaningless."""
    text: str
    """What was found, what is usual, and what to do; one sentence or two."""


def warning(name: str, text: str) -> RecordingProblem:
    """Return a problem with which an estimate goes on."""
    return RecordingProblem(name=name, refuses=False, text=text)


def metres(length: float) -> str:
    """Return a length in the unit in which it is easiest to read."""
    for factor, unit in ((1.0, "m"), (1e3, "mm")):
        if length * factor >= 1:
            return f"{length * factor:.3g} {unit}"
    return f"{length * 1e6:.3g} um" if length else "0 m"


def seconds(time: float) -> str:
    """Return a time in the unit in which it is easiest to read."""
    for size, unit in ((3.156e7, "years"), (86400.0, "days"), (1.0, "s"), (1e-3, "ms"), (1e-6, "us")):
        if time >= size:
            return f"{time / size:.3g} {unit}"
    return f"{time:.3g} s"
