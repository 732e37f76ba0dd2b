"""Memory that was freed is taken again without a page fault."""

import subprocess
import sys

FAULTS = """
import resource, sys
import numpy as np
from jiggle_mj.allocator import keep_freed_memory
if sys.argv[1] == "kept":
    keep_freed_memory()
for turn in range(20):
    if turn == 1:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(2**19)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(how: str) -> int:
    done = subprocess.run([sys.executable, "-c", FAULTS, how], check=True, capture_output=True, text=True)
    return int(done.stdout)


def test_freed_memory_is_kept():
    assert faults("kept") < faults("as the C library has it") / 10
