"""The folder of field cases, inputs that users had trouble with: not part of the project."""

import os
from pathlib import Path

import pytest

CASES = os.environ.get("JIGGLE_MJ_CASES")


def case(name: str) -> Path:
    """The folder of one case; skips the test where there are none."""
    if CASES is None:
        pytest.skip("field cases are not part of the project; JIGGLE_MJ_CASES names the folder that holds them")
    return Path(CASES) / name
