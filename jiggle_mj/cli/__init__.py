"""The command line: `jiggle-mj VERB`. Results go to files; --json prints them to stdout, all else goes to stderr.

Exit codes: 0 success, 1 the run failed, 2 wrong usage (a scene, an option or an output folder that cannot be used), 130
Ctrl-C. The verbs import heavy packages inside, so that help is quick.
"""

import tyro

from ..allocator import keep_freed_memory
from ..errors import JiggleError, OptionError, OutputError, SceneError
from .checks import bench, doctor, scene_check
from .estimating import close_loop, estimate, identify, run, score
from .importing import import_, inspect
from .init import init
from .recording import record
from .tables import table
from .terminal import FAILED, INTERRUPTED, WRONG_USAGE, stop

VERBS = {
    "run": run,
    "record": record,
    "init": init,
    "import": import_,
    "inspect": inspect,
    "estimate": estimate,
    "identify": identify,
    "close-loop": close_loop,
    "score": score,
    "table": table,
    "bench": bench,
    "scene-check": scene_check,
    "doctor": doctor,
}
"""Verb to the function that it calls."""


def main() -> None:
    """Run the verb that the command line names, and exit with its code."""
    keep_freed_memory()
    try:
        tyro.extras.subcommand_cli_from_dict(
            VERBS,
            prog="jiggle-mj",
            description=(
                "Estimate where a tissue sheet is attached, how stiff each attachment is and how certain that is, from "
                "pulls of a tweezer that a stereo camera sees."
            ),
        )
    except (SceneError, OptionError, OutputError) as failure:
        stop(failure, WRONG_USAGE)
    except JiggleError as failure:
        stop(failure, FAILED)
    except KeyboardInterrupt:
        stop(
            "interrupted; the recording so far is complete, and 'jiggle-mj estimate' reads it into another folder",
            INTERRUPTED,
        )
