"""Damage files in many ways, read them, and count what is not one of the project's errors.

    python tools/fuzz_readers.py --seed 0 --count 5000 --reader recording truth

For each reader: how many inputs were refused, how many were read, and how many ended in a raw Python error, took longer
than 10 s, or needed more than 2 GB. Exits with 1 where one did. The same seed gives the same inputs.
"""

import argparse
import faulthandler
import json
import random
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from jiggle_mj.errors import JiggleError

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.support.damaged_files import damaged
from tests.support.damaged_imports import IMPORTS
from tests.support.valid_files import READERS, Reader

HANG_S = 10
"""Time after which a reading counts as a hang [s]."""
MEMORY_BYTES = 2 << 30
"""Memory that a reading may need [byte]."""
MAX_MESSAGE = 1000
"""Longest message of an error [characters]: 200 of the content, twice, and the path."""


ALL = READERS | IMPORTS
"""Each reader and each import by its name."""


class Hang(BaseException):
    """Raised in a reading that takes too long."""


def main() -> None:
    """Fuzz the readers that the command line names, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=1000, help="inputs for each reader")
    parser.add_argument("--reader", nargs="*", choices=list(ALL), default=list(ALL))
    parser.add_argument("--keep", type=Path, help="folder for the first input of each kind of raw error")
    arguments = parser.parse_args()
    warnings.simplefilter("error")
    faulthandler.enable()
    signal.signal(signal.SIGALRM, _on_alarm)
    faults = 0
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.reader:
            faults += fuzz(name, ALL[name](Path(folder)), arguments.seed, arguments.count, arguments.keep)
    sys.exit(min(faults, 1))


def fuzz(name: str, reader: Reader, seed: int, count: int, keep: Path | None) -> int:
    """Read `count` damaged inputs, print what came of it, and return the number of faults."""
    outcomes: Counter[str] = Counter()
    raw: dict[tuple[str, str], tuple[int, str]] = {}
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY_BYTES, hard))
    for number in range(count):
        generator = random.Random(f"{seed} {name} {number}")
        kind, data = damaged(reader, generator)
        reader.path.write_bytes(data)
        outcome, place = _read(reader.read)
        outcomes[outcome] += 1
        if outcome in ("raw error", "hang", "memory", "long message"):
            times, first = raw.get(place, (0, ""))
            raw[place] = (times + 1, first or f"input {number}, {kind}")
            if keep is not None and times == 0:
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f"{name}-{seed}-{number}{reader.path.suffix}").write_bytes(data)
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
    print(f"{name}: {json.dumps({'seed': seed, 'inputs': count} | dict(sorted(outcomes.items())))}", flush=True)
    for (error, where), (times, first) in sorted(raw.items(), key=lambda item: -item[1][0]):
        print(f"    {times} x {error} at {where}; first: {first}", flush=True)
    return sum(times for times, _ in raw.values())


def _read(read: Callable[[], object]) -> tuple[str, tuple[str, str]]:
    """Return what came of a reading, and of an error its kind and place."""
    signal.alarm(HANG_S)
    try:
        read()
    except JiggleError as failure:
        if len(str(failure)) > MAX_MESSAGE or "\n" in str(failure):
            return "long message", (type(failure).__name__, str(failure)[:80])
        return "refused", ("", "")
    except Hang:
        return "hang", ("Hang", "")
    except MemoryError:
        return "memory", ("MemoryError", _place())
    except Exception as failure:
        return "raw error", (type(failure).__name__, f"{_place()}: {str(failure)[:100]!r}")
    finally:
        signal.alarm(0)
    return "read", ("", "")


def _place() -> str:
    """Return the innermost line of this project in the error that is being handled."""
    frames = traceback.extract_tb(sys.exc_info()[2])
    ours = [frame for frame in frames if "site-packages" not in frame.filename] or list(frames)
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"


def _on_alarm(*_: object) -> None:
    raise Hang


if __name__ == "__main__":
    main()
