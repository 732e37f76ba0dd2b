"""The command line: `jiggle-mj VERB`. Results go to files; --json prints them, all else goes to stderr.

Exit codes: 0 fine, 1 the run failed, 2 bad usage (a scene, an option or an output folder that cannot be used). Heavy
imports happen inside the verbs, so that help is quick.
"""

import tyro

from ..allocator import keep_freed_memory
from ..errors import JiggleError, OptionError, OutputError, SceneError
from .checks import bench, doctor, scene_check
from .estimating import close_loop, estimate, identify, run, score
from .recording import import_, record
from .tables import table
from .terminal import stop

VERBS = {
    "run": run,
    "record": record,
    "import": import_,
    "estimate": estimate,
    "identify": identify,
    "close-loop": close_loop,
    "score": score,
    "table": table,
    "bench": bench,
    "scene-check": scene_check,
    "doctor": doctor,
}


def main() -> None:
    """Entry point of `jiggle-mj`."""
    keep_freed_memory()
    try:
        tyro.extras.subcommand_cli_from_dict(
            VERBS,
            prog="jiggle-mj",
            description="Find where a tissue is attached, how strongly and how surely, from pulls seen by a camera.",
        )
    except (SceneError, OptionError, OutputError) as failure:
        stop(failure, 2)
    except JiggleError as failure:
        stop(failure, 1)
    except KeyboardInterrupt:
        stop("interrupted; the recording so far is whole, and 'jiggle-mj estimate' reads it into another folder", 130)
