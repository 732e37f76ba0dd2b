"""Run the command line: `python -m jiggle_mj` is `jiggle-mj`."""

from .cli import main

main()
