"""The check of a recording before it is used: what is doubtful is reported, what cannot be right is refused."""

from collections.abc import Callable
from pathlib import Path

from ..errors import RecordingError
from .problems import problems
from .survey import Survey


def refuse_implausible(
    surveyed: Survey, path: Path, *, log: Callable[[str], None], allow: bool = False, cure: str = ""
) -> None:
    """Report what is doubtful about a recording, and refuse one that is implausible.

    Args:
        surveyed: its survey.
        path: its file, for messages.
        log: gets a line for each doubt.
        allow: report what refuses it as well, and return.
        cure: ends the message of a refusal.

    Raises:
        RecordingError: the recording is implausible; names every reason.
    """
    found = problems(surveyed)
    for problem in found:
        if not problem.refuses or allow:
            log(f"{problem.name}: {problem.text}")
    reasons = [f"{problem.name}: {problem.text}" for problem in found if problem.refuses]
    if reasons and not allow:
        raise RecordingError(f"{path} is implausible. {' '.join(reasons)}{cure}")
