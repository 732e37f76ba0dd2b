"""Imports run one way: cli, eval, episode, then scenes or estimator, then the vocabulary that both sides share.

Read from the sources, imports inside functions included. A module may import the modules of its own layer and those
that `ALLOWED` lists for it; no file imports itself through others.
"""

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import jiggle_mj
from tests.support.sources import FOLDERS, ROOT, home, imports, modules

LAYER = {
    "jiggle_mj.cli": "cli",
    "jiggle_mj.__main__": "cli",
    "jiggle_mj.eval": "eval",
    "jiggle_mj.episode": "episode",
    "jiggle_mj.importing": "episode",
    "jiggle_mj.series": "episode",
    "jiggle_mj.scenes": "scenes",
    "jiggle_mj.estimator": "estimator",
    "jiggle_mj.truth": "truth",
    "jiggle_mj.recording": "files",
    "jiggle_mj.plausibility": "files",
    "jiggle_mj.recording.truth": "truth",
    "jiggle_mj.doctor": "doctor",
}
"""The layer of a module is that of its longest beginning here.

`jiggle_mj/__init__.py` is the layer `names`; every other module of `jiggle_mj` is the shared vocabulary.
"""

ALLOWED = {
    "cli": {"names", "eval", "episode", "scenes", "estimator", "files", "doctor", "vocabulary"},
    "eval": {"names", "episode", "scenes", "estimator", "truth", "files", "vocabulary"},
    "episode": {"scenes", "estimator", "truth", "files", "vocabulary"},
    "scenes": {"truth", "vocabulary"},
    "estimator": {"vocabulary"},
    "files": {"vocabulary"},
    "truth": {"files", "vocabulary"},
    "doctor": {"vocabulary"},
    "vocabulary": set(),
    "names": {"cli", "eval", "episode", "scenes", "estimator", "files", "doctor", "vocabulary"},
}
"""What each layer may import beside itself."""

READERS_OF_TRUTH = {"eval", "truth"}
"""Other layers may write truth, and hold it while they do, but not read it back."""

FORBIDDEN = {
    "estimator": {"mujoco", "mcap", "mcap_protobuf", "foxglove_schemas_protobuf", "tomllib"},
    "scenes": {"jax", "equinox"},
    "vocabulary": {"mujoco", "jax", "equinox", "cv2", "mcap"},
}
"""Packages that a layer must not touch: the estimator sees neither MuJoCo's state nor a file."""

EXEMPT = {"jiggle_mj.estimator.planning.tool_kinematics": {"mujoco"}}
"""The tool's own model is no state of the tissue's; MJX is imported once a tool is read."""

FILE_READERS = {"open", "read_text", "read_bytes", "load", "loadtxt", "genfromtxt", "fromfile", "imread", "memmap"}
"""Calls that read a file; the estimator makes none."""


def layer(name: str) -> str:
    """The layer of a module, or of a name imported from one."""
    beginnings = [known for known in LAYER if name == known or name.startswith(known + ".")]
    if beginnings:
        return LAYER[max(beginnings, key=len)]
    return "names" if name == "jiggle_mj" or name.removeprefix("jiggle_mj.") in jiggle_mj.__all__ else "vocabulary"


def broken_rules(root: Path) -> list[str]:
    """Every import, and every reading of a file, that breaks the directions."""
    found = []
    for name, path in modules(root).items():
        own = layer(name)
        for line, target in imports(path, name):
            place = f"{path.relative_to(root)}:{line}: {name}"
            if target.split(".")[0] == "jiggle_mj":
                if layer(target) not in ALLOWED[own] | {own}:
                    found.append(f"{place} ({own}) imports {target} ({layer(target)})")
                elif reads_truth(target) and own not in READERS_OF_TRUTH:
                    found.append(f"{place} ({own}) imports {target}, which reads truth")
            elif target.split(".")[0] in set(FORBIDDEN.get(own, ())) - EXEMPT.get(name, set()):
                found.append(f"{place} ({own}) imports {target}")
        if own == "estimator":
            found += [f"{path.relative_to(root)}:{line}: {call}() reads a file" for line, call in file_reads(path)]
    return found


def reads_truth(name: str) -> bool:
    """Whether an imported name is a reader of truth, going by what it is called."""
    return layer(name) == "truth" and "read" in name.rpartition(".")[2].lower()


def file_reads(path: Path) -> Iterator[tuple[int, str]]:
    """Calls by which a module would read a file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called.rpartition(".")[2] in FILE_READERS:
                yield node.lineno, called


def import_graph() -> dict[str, set[str]]:
    """Every module to the modules that it imports."""
    found = modules(ROOT)
    return {
        name: {nearest for _, target in imports(path, name) if (nearest := home(target, found)) not in (None, name)}
        for name, path in found.items()
    }


def test_no_file_imports_itself_through_others():
    """`graphlib` raises CycleError, which names the files, where the imports of any go in a circle."""
    TopologicalSorter(import_graph()).prepare()


def room(module: str) -> str:
    """The folder that a module is in, below its package; a module of the package itself is a room of its own."""
    package = next((found for found in FOLDERS.values() if module.startswith(f"{found}.") and found != "jiggle_mj"), "")
    inside = module.removeprefix(f"{package or 'jiggle_mj'}.").split(".")
    return f"{package or 'jiggle_mj'}.{inside[0]}"


def test_no_folder_imports_itself_through_others():
    """The same of folders: of two that know each other neither can be read, or moved, without the other."""
    graph: dict[str, set[str]] = {}
    for name, targets in import_graph().items():
        graph.setdefault(room(name), set()).update(room(target) for target in targets)
    TopologicalSorter({own: targets - {own} for own, targets in graph.items()}).prepare()


def test_a_circle_of_imports_is_found():
    with pytest.raises(CycleError):
        TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()


def test_imports_run_one_way():
    assert broken_rules(ROOT) == []


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("estimator/belief.py", "import mujoco"),
        ("estimator/belief.py", "from jiggle_mj.scenes import tissue"),
        ("estimator/belief.py", "from jiggle_mj import truth"),
        ("estimator/belief.py", "from jiggle_mj.recording.observation_reader import ObservationReader"),
        ("estimator/belief.py", "def f():\n    from jiggle_mj.recording.truth import read_truth"),
        ("estimator/belief.py", "import numpy as np\nx = np.load('a.npy')"),
        ("jiggle_mj/camera.py", "from .scenes import tissue"),
        ("estimator/perception/flow.py", "from .. import eval, belief\nfrom jiggle_mj import eval"),
        ("scenes/tissue.py", "from jiggle_mj.estimator.physics.mesh import lattice"),
        ("scenes/tissue.py", "import jax.numpy as jnp"),
        ("scenes/tissue.py", "import jiggle_mj.eval.metrics.detection_metrics"),
        ("jiggle_mj/camera.py", "from jiggle_mj.estimator import mesh"),
        ("jiggle_mj/observation.py", "from jiggle_mj.truth import Truth"),
        ("jiggle_mj/recording.py", "from jiggle_mj.truth import Truth"),
        ("jiggle_mj/episode.py", "from jiggle_mj.eval import metrics"),
        ("jiggle_mj/episode.py", "from jiggle_mj.recording.truth import TruthWriter, read_truth"),
        ("jiggle_mj/cli.py", "from jiggle_mj.recording.truth import read_truth"),
        ("eval/metrics.py", "from jiggle_mj.cli import main"),
    ],
)
def test_a_wrong_import_is_found(tmp_path: Path, module: str, line: str):
    """The same check over a tree that holds nothing but one wrong line names that line's file, once."""
    wrong = tmp_path / module
    wrong.parent.mkdir(parents=True)
    wrong.write_text(line + "\n", encoding="utf-8")
    assert [message.split(":")[0] for message in broken_rules(tmp_path)] == [module]


def loaded_by(statement: str) -> set[str]:
    """Top-level packages in a fresh interpreter after a statement."""
    code = f"{statement}\nimport sys\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_the_package_is_light():
    """Neither numerics, simulator nor images until a name is used."""
    assert not loaded_by("import jiggle_mj") & {"jax", "mujoco", "cv2", "scipy", "plotly", "mcap", "equinox"}


def test_importing_the_estimator_leaves_mujoco_out():
    """Every module of it, not only its front."""
    names = [name for name in modules(ROOT) if name.startswith("jiggle_mj.estimator")]
    assert "mujoco" not in loaded_by("import " + ", ".join(names))


def test_estimating_from_a_recording_leaves_mujoco_out():
    assert "mujoco" not in loaded_by("import jiggle_mj.eval.runs.experiment, jiggle_mj.eval.runs.scoring")


def test_importing_the_scenes_leaves_jax_out():
    names = [name for name in modules(ROOT) if name.startswith("jiggle_mj.scenes")]
    assert "jax" not in loaded_by("import " + ", ".join(names))
