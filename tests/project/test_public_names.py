"""The names that `jiggle_mj` offers: one list, fetched when used, seen alike by Python and by static tools."""

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import jiggle_mj

SOURCE = Path(inspect.getfile(jiggle_mj))


def static_names() -> set[str]:
    """What a type checker sees: the names bound under `if TYPE_CHECKING`."""
    tree = ast.parse(SOURCE.read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    names = {alias.asname or "" for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    return names | {ast.unparse(node.target) for node in block.body if isinstance(node, ast.AnnAssign)}


def test_static_tools_see_the_public_names():
    assert static_names() == set(jiggle_mj.__all__)
    assert sorted(jiggle_mj.__all__) == list(jiggle_mj.__all__)


def test_every_public_name_is_what_its_static_import_says():
    """`from module import name as name` under TYPE_CHECKING and `jiggle_mj.name` are the same object."""
    tree = ast.parse(SOURCE.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jiggle_mj."):
            module = __import__(node.module or "", fromlist=["_"])
            for alias in node.names:
                assert getattr(jiggle_mj, alias.name) is getattr(module, alias.name), alias.name
    assert jiggle_mj.__version__


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Tissue'"):
        _ = jiggle_mj.Tissue  # pyright: ignore[reportAttributeAccessIssue]


def test_no_public_name_hides_a_module():
    """`jiggle_mj.estimate` and its like stay modules, whatever was fetched before."""
    modules = {path.stem for path in SOURCE.parent.glob("*.py")} | {"scenes", "estimator", "eval"}
    assert modules & set(jiggle_mj.__all__) == set()


@pytest.mark.parametrize("name", ["Observation", "Declaration", "Grasp", "Belief", "JiggleError", "StereoCamera"])
def test_the_shared_vocabulary_comes_without_either_engine(name: str):
    """A fresh interpreter that fetches the name has loaded neither mujoco nor jax."""
    code = f"import jiggle_mj, sys\njiggle_mj.{name}\nprint({{'mujoco', 'jax', 'cv2'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_dir_lists_what_has_not_been_fetched():
    """Completion in a fresh interpreter offers all of it."""
    code = "import jiggle_mj\nprint(set(jiggle_mj.__all__) <= set(dir(jiggle_mj)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
