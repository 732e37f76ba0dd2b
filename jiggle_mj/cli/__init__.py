"""The command line: `jiggle-mj VERB`. Results go to files; --json prints them to stdout, all else goes to stderr.

Exit codes: 0 success, 1 the run failed, 2 wrong usage (a scene, an option or an output folder that cannot be used), 130
Ctrl-C. This file imports nothing heavy, so that Ctrl-C is quiet from the beginning and help is quick.
"""

from importlib import import_module

from .interrupts import leaving_at_once


def main() -> None:
    """Run the verb that the command line names, and exit with its code."""
    with leaving_at_once():
        running = import_module(f"{__name__}.running")
    running.run_command_line()
