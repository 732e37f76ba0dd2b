"""Contents of discrepancy.json by hand, and a closed loop that takes no time, for tests of what compares many."""

import json
from pathlib import Path
from typing import Any

from jiggle_mj.errors import RecordingError
from jiggle_mj.eval.report.discrepancy_page import TRIVIAL
from jiggle_mj.recording.declaration import version_entry


def effect(name: str, theta: list[float], sd: list[float], *, site: int | None = None, session: bool = False) -> dict:
    """Return an added effect."""
    units = [""] * len(theta)
    return {"name": name, "site": site, "theta": theta, "sd": sd, "units": units, "this_session_alone": session}


def discrepancy(*effects: dict, ambiguous_with: list[str] | None = None, error: float | None = 1e-3) -> dict[str, Any]:
    """Return a result with effects, and an error of 1 mm with the remainder and of 2 mm by each trivial prediction."""
    held_out: dict[str, Any] = {f"{when}_rms_m": error for when in ("before", "after", "with_remainder")}
    held_out |= {"with_remainder_coverage_90": None if error is None else 0.9, "folds": [], "frames": []}
    held_out |= {f"{name}_rms_m": None if error is None else 2e-3 for name in TRIVIAL}
    return {
        **version_entry(),
        "verdict": "effect" if effects else "no-effect",
        "effects": list(effects),
        "ambiguous_with": ambiguous_with or [],
        "posterior": [
            {"effects": [one["name"] for one in effects], "probability": 0.96, "log_evidence": 7.0},
            {"effects": ["poisson"], "probability": 0.04, "log_evidence": 0.0},
        ],
        "held_out": held_out
        | {"with_remainder_coverage_90": None if error is None else 0.9, "folds": [], "frames": []},
        "frames": {"used": 9, "left_out": []},
    }


class QuickLoop:
    """Stands in for `close_loop`: writes a result by hand, notes which recordings it saw, and fails at some.

    Args:
        results: content of discrepancy.json by the recording's stem; `no-effect` where there is none.
        fails: what is raised by the recording's stem.
    """

    def __init__(self, results: dict[str, dict] | None = None, fails: dict[str, BaseException] | None = None) -> None:
        self.results, self.fails, self.seen = results or {}, fails or {}, list[str]()

    def __call__(self, recording: Path, folder: Path, *, log: Any, **options: Any) -> dict[str, Any]:
        """Write the result of a recording."""
        self.seen.append(recording.stem)
        if not recording.exists():
            raise RecordingError(f"{recording} does not exist.")
        found = self.results.get(recording.stem, discrepancy())
        (folder / "discrepancy.json").write_text(json.dumps(found))
        log(f"closed over {recording.name}")
        if recording.stem in self.fails:
            raise self.fails[recording.stem]
        return found
