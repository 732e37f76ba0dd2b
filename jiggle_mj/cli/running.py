"""Running of one command line: verbs, exit codes, and one line for each way in which the environment fails."""

import errno
import inspect
import io
import os
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import wraps
from importlib import import_module
from importlib.metadata import version
from typing import Any

import tyro

from ..allocator import keep_freed_memory
from ..errors import JiggleError, OptionError, OutputError, SceneError
from ..likely_name import did_you_mean
from .checks import bench, doctor, scene_check
from .environment import open_standard_streams, require_jax, require_working_folder
from .estimating import close_loop, estimate, identify, run, score
from .importing import import_
from .importing import inspect as inspect_
from .init import init
from .interrupts import leaving_at_once, unwinding
from .listing import disturbances, effects, scenes
from .recording import record
from .tables import table
from .terminal import FAILED, INTERRUPTED, WRONG_USAGE, note, stop

VERBS: dict[str, Callable[..., None]] = {
    "run": run,
    "record": record,
    "init": init,
    "import": import_,
    "inspect": inspect_,
    "estimate": estimate,
    "identify": identify,
    "close-loop": close_loop,
    "score": score,
    "table": table,
    "bench": bench,
    "scene-check": scene_check,
    "scenes": scenes,
    "effects": effects,
    "disturbances": disturbances,
    "doctor": doctor,
}
"""Verb to the function that it calls."""
HEAVY: dict[str, tuple[str, ...]] = {
    "run": ("jax", "jiggle_mj.eval.runs.experiment", "jiggle_mj.scenes"),
    "record": ("jiggle_mj.scenes", "jiggle_mj.episode"),
    "init": ("jiggle_mj.importing.init",),
    "import": ("jiggle_mj.importing.folder",),
    "inspect": ("jiggle_mj.importing.bags.inspection",),
    "estimate": ("jax", "jiggle_mj.eval.runs.experiment"),
    "identify": ("jax", "jiggle_mj.estimator", "jiggle_mj.episode"),
    "close-loop": ("jax", "jiggle_mj.eval.runs.closing_many"),
    "score": ("jax", "jiggle_mj.eval.runs.scoring"),
    "table": ("jax", "jiggle_mj.eval.runs.experiment", "jiggle_mj.scenes"),
    "bench": ("jax", "jiggle_mj.eval.benchmark.estimator_benchmark"),
    "effects": ("jax", "jiggle_mj.estimator.effects"),
    "scene-check": ("jiggle_mj.scenes.load_tests",),
}
"""Modules that take a second to import, by verb; while they do, Ctrl-C leaves at once. Where JAX is among them, its
environment is checked first."""
UNWRITABLE = {errno.EACCES, errno.EPERM, errno.EROFS}
"""Errors of the system that another output folder mends."""
DESCRIPTION = """Estimate where a tissue sheet is attached, how stiff each attachment is and how certain that is, from
pulls of a tweezer that a stereo camera sees.

Exit codes: 0 fine; 1 the run failed, or a recording cannot be read; 2 an argument, a scene or an output folder cannot
be used; 130 interrupted. --version prints the version; 'jiggle-mj doctor' checks this machine."""


def run_command_line() -> None:
    """Run the verb that the command line names, and exit with its code; no failure prints a traceback."""
    lost_output = open_standard_streams()
    arguments = sys.argv[1:]
    try:
        with unwinding():
            try:
                require_working_folder()
                _check_verb(arguments, lost_output=lost_output)
                keep_freed_memory()
                _call_verb(arguments)
            finally:
                sys.stdout.flush()
    except (SceneError, OptionError, OutputError) as failure:
        stop(failure, WRONG_USAGE)
    except JiggleError as failure:
        stop(failure, FAILED)
    except BrokenPipeError:
        _drop_output()
        stop("the program that reads the output has ended; files that were written are complete.", FAILED)
    except OSError as failure:
        _drop_output()
        where = failure.filename or "the output"
        why = failure.strerror or str(failure)
        stop(f"{where}: {why}; mend this, or write to another folder.", _exit_code(failure))
    except MemoryError as failure:
        stop(f"out of memory ({failure or 'no more is granted'}); use a shorter or smaller input.", FAILED)
    except KeyboardInterrupt:
        stop(
            "interrupted; a recording that was begun is complete until then, and 'jiggle-mj estimate' reads it into "
            "another folder",
            INTERRUPTED,
        )


def _exit_code(failure: OSError) -> int:
    return WRONG_USAGE if failure.errno in UNWRITABLE else FAILED


def _check_verb(arguments: list[str], *, lost_output: bool) -> None:
    """Print the version where that is asked for, and refuse an unknown verb or a result that nobody would see.

    Raises:
        OptionError: no verb, an unknown one, or stdout is closed and the result goes there.
    """
    first = arguments[0] if arguments else ""
    if first == "--version":
        print(f"jiggle-mj {version('jiggle-mj')}")
        sys.exit()
    if lost_output and ("--json" in arguments or first == "table"):
        raise OptionError("stdout is closed, and the result would go there; redirect it to a file.")
    if first in ("-h", "--help") or first in VERBS or first.startswith("--tyro-"):
        return
    if first.startswith("-") and set(arguments) & set(VERBS):
        raise OptionError(f"{first} stands before the verb; options come after it: jiggle-mj VERB ... {first} ...")
    known = [*VERBS, "--help", "--version"]
    what = f"no verb {first!r}{did_you_mean(first, known)}" if first else "a verb is missing."
    raise OptionError(f"{what} There are {', '.join(VERBS)}; 'jiggle-mj --help' explains them.")


def _call_verb(arguments: list[str]) -> None:
    """Parse the arguments and call the verb; after wrong options, say which ones were probably meant."""
    called: list[str] = []
    verbs = {name: _noted(name, function, called) for name, function in VERBS.items()}
    try:
        tyro.extras.subcommand_cli_from_dict(verbs, prog="jiggle-mj", description=DESCRIPTION)
    except SystemExit as ended:
        if ended.code == WRONG_USAGE and not called:
            _propose_options(verbs, arguments)
        raise


def _noted(name: str, function: Callable[..., None], called: list[str]) -> Callable[..., None]:
    """Return the verb's function, which notes that parsing is over and checks what the verb needs."""

    @wraps(function)
    def call(*positional: Any, **options: Any) -> None:
        called.append(name)
        with leaving_at_once():
            if "jax" in HEAVY.get(name, ()):
                require_jax()
            for module in HEAVY.get(name, ()):
                import_module(module)
        function(*positional, **options)

    call.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]
    return call


def _propose_options(verbs: dict[str, Callable[..., None]], arguments: list[str]) -> None:
    """Print the likely option for each unknown one; the known ones are those of the verb's help."""
    given = [argument.partition("=")[0] for argument in arguments if re.match("--[a-z]", argument)]
    verb = [argument for argument in arguments[:2] if not argument.startswith("-")]
    known: set[str] = set()
    for words in (verb[:1], verb):
        shown = io.StringIO()
        with suppress(SystemExit), redirect_stdout(shown), redirect_stderr(io.StringIO()):
            tyro.extras.subcommand_cli_from_dict(verbs, prog="jiggle-mj", args=[*words, "--help"])
        known.update(re.findall(r"--[a-z][a-z-]*", shown.getvalue()))
    for option in given:
        if option not in known:
            note(f"no option {option!r}{did_you_mean(option, sorted(known))}")


def _drop_output() -> None:
    """Send what is still buffered for stdout to the null device, so that exiting does not fail again."""
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
