"""The name that was probably meant, for messages about an unknown one."""

from collections.abc import Iterable
from difflib import get_close_matches

MAX_COMPARED = 200
"""Characters of a name that are compared: the comparison takes time with their square."""


def likeliest(name: object, known: Iterable[str], *, likeness: float = 0.6) -> str | None:
    """Return the known name that is most like a name, whatever its case; None where none has the likeness (0 to 1)."""
    by_lower = {each.lower(): each for each in known}
    near = get_close_matches(str(name)[:MAX_COMPARED].lower(), by_lower, n=1, cutoff=likeness)
    return by_lower[near[0]] if near else None


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return the end of a sentence about an unknown name: "; did you mean 'NAME'?", or "." where none is near."""
    near = likeliest(name, known)
    return "." if near is None else f"; did you mean {near!r}?"
