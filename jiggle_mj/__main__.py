"""`python -m jiggle_mj` is `jiggle-mj`."""

from jiggle_mj.cli import main

main()
