"""What every verb needs of its environment: open streams, a working folder, and a JAX that starts.

Each lack becomes one line before anything is written. `jiggle-mj doctor` checks more, and in other processes.
"""

import io
import os
import sys

from ..errors import EnvironmentFault, OptionError


def open_standard_streams() -> bool:
    """Open the null device in place of each closed standard stream; return whether stdout was closed.

    Otherwise the next file that is opened takes the stream's number, and messages of libraries end up in it. A
    character that the terminal cannot show is escaped, instead of ending the run.
    """
    lost_output = sys.stdout is None
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    return lost_output


def require_working_folder() -> None:
    """Refuse a working folder that was deleted.

    Raises:
        OptionError: it was.
    """
    try:
        os.getcwd()
    except OSError as failure:
        raise OptionError("the working folder does not exist any more; change to another one (cd ~).") from failure


def require_jax() -> None:
    """Refuse an environment in which JAX does not start.

    Raises:
        EnvironmentFault: it does not.
    """
    from ..doctor import jax_failure

    failure = jax_failure()
    if failure is not None:
        raise EnvironmentFault(f"{failure} 'jiggle-mj doctor' says more.")
