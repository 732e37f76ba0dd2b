"""`close-loop` of several recordings: a line for each as it ends, and what they show together."""

import json
import sys
from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from .terminal import FAILED, INTERRUPTED, console, log, stop


def close_several(
    recordings: Sequence[Path],
    out: Path,
    workers: AbstractContextManager[Executor],
    *,
    as_json: bool,
    **options: Any,
) -> None:
    """Close the loop over several recordings and print what they show; exit with 1 where one failed, 130 after Ctrl-C.

    Args:
        recordings: MCAP files.
        out: folder of all results.
        workers: what works on several recordings at a time.
        as_json: print results.json to stdout.
        options: further arguments of `close_loops`.

    Raises:
        JiggleError: what `close_loops` raises.
    """
    from jiggle_mj.eval.report.comparison_page import summary_sentences
    from jiggle_mj.eval.report.joint_section import joint_sentences
    from jiggle_mj.eval.runs.closing_many import PAGE, close_loops

    try:
        with workers as executor:
            results = close_loops(recordings, out, executor=executor, log=log, **options)
    except KeyboardInterrupt:
        stop(
            f"interrupted; complete results in {out} stay, and the same command, without --overwrite, continues",
            INTERRUPTED,
        )
    joint = results.get("joint")
    for sentence in (*summary_sentences(results), *([] if joint is None else joint_sentences(joint))):
        console.print(sentence, highlight=False)
    console.print(f"report: {out / PAGE}")
    if as_json:
        print(json.dumps(results))
    if any(row["failed"] is not None for row in results["recordings"]):
        sys.exit(FAILED)
