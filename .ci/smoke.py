"""What a user of the wheel relies on first, tried with the installed package alone, outside the checkout."""

import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

CHECKOUT = Path(sys.argv[1])
COMMAND = Path(sys.executable).with_name("jiggle-mj")


def jiggle(*arguments: str) -> str:
    """Standard output of the installed command."""
    return subprocess.run([COMMAND, *arguments], check=True, capture_output=True, text=True).stdout


def main() -> None:
    """Stop at the first thing that does not hold."""
    import jiggle_mj

    package = Path(jiggle_mj.__file__).parent
    assert not package.is_relative_to(CHECKOUT), f"{package} is the checkout's"

    import jiggle_mj.estimator

    assert "mujoco" not in sys.modules, "importing jiggle_mj.estimator imported mujoco"

    scenes = {path.name for path in (CHECKOUT / "scenes").glob("*.toml")}
    installed = {path.name for path in (package / "scenes").glob("*.toml")}
    assert scenes and installed == scenes, f"the wheel lacks the scenes {scenes - installed}"

    assert "run" in jiggle("--help")
    found = json.loads(jiggle("doctor", "--json"))
    assert found["checks"] and found["verdict"], "the doctor said nothing"
    jiggle("record", "free", "--out", "run.mcap")
    assert Path("run.mcap").read_bytes().startswith(b"\x89MCAP0\r\n"), "run.mcap is no MCAP file"
    assert Path("run.truth.mcap").exists(), "the recording came without its truth"
    print(f"jiggle-mj {version('jiggle-mj')} works from {package}")


if __name__ == "__main__":
    main()
