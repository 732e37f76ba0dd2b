"""The checkout keeps what it promises: the wheel is whole, tests check shapes, versions agree, locks are portable."""

import importlib
import re
import sys
import tomllib

import numpy as np
import pytest
from jaxtyping import TypeCheckError
from setuptools import find_packages

from tests.support.sources import FOLDERS, ROOT, modules

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
LOCKS = ("requirements.lock", "requirements-dev.lock")


def test_the_links_lead_to_the_folders_at_the_root():
    """`jiggle_mj/estimator` is `estimator/`, so wheel, editable install and every tool that reads files agree."""
    for folder, package in FOLDERS.items():
        assert ROOT.joinpath(*package.split(".")).resolve() == ROOT / folder


def test_every_folder_with_sources_is_a_package_that_setuptools_finds():
    """setuptools follows the links and installs the folders that hold an `__init__.py`, and no others."""
    found = find_packages(str(ROOT), include=PROJECT["tool"]["setuptools"]["packages"]["find"]["include"])
    folders = {ROOT.joinpath(*package.split(".")).resolve() for package in found}
    assert folders == {path.parent for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")}


def test_every_data_file_is_in_the_wheel():
    """Whatever lies beside the sources is matched by a package-data pattern."""
    shipped = {
        path.resolve()
        for package, patterns in PROJECT["tool"]["setuptools"]["package-data"].items()
        for pattern in patterns
        for path in ROOT.joinpath(*package.split(".")).glob(pattern)
    }
    beside = {
        path
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and path.suffix != ".py" and "__pycache__" not in path.parts
    }
    assert beside - shipped == set()


def test_shapes_are_checked_while_testing():
    """A 3x4 matrix where 4x4 is due is refused by the signature, before any arithmetic."""
    from jiggle_mj.camera import optical_from_opengl

    with pytest.raises(TypeCheckError, match="T_world_opengl"):
        optical_from_opengl(np.zeros((3, 4)))


def test_the_checks_reach_the_linked_folders():
    """Every module is loaded through the checking loader."""
    fronts = {"jiggle_mj", *FOLDERS.values()}
    names = set(modules(ROOT)) - fronts - {"jiggle_mj.__main__"}
    for name in names:
        importlib.import_module(name)
    loaders = {name: type(sys.modules[name].__loader__).__name__ for name in names}
    assert {name for name, loader in loaders.items() if "Jaxtyping" not in loader} == set()


def test_the_version_is_one_everywhere():
    version = PROJECT["project"]["version"]
    assert f'version: "{version}"' in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(rf"^## {re.escape(version)}\b", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_names_no_source_of_packages(lock: str):
    """Only names, versions, hashes, markers and comments: each machine's own pip settings say where they come from."""
    line = r"[a-z0-9-]+==[\w.]+( ; .+)? \\|    --hash=sha256:[0-9a-f]{64}( \\)?|\s*# .*"
    odd = [text for text in (ROOT / lock).read_text(encoding="utf-8").splitlines() if not re.fullmatch(line, text)]
    assert odd == []


def test_the_locks_agree_and_cover_every_dependency():
    runtime, dev = (locked(lock) for lock in LOCKS)
    assert runtime.items() <= dev.items()
    assert {name_of(text) for text in PROJECT["project"]["dependencies"]} <= set(runtime)
    assert {name_of(text) for text in PROJECT["dependency-groups"]["dev"]} <= set(dev)


def locked(lock: str) -> dict[str, str]:
    """Package to version."""
    return dict(re.findall(r"^([a-z0-9-]+)==([\w.]+)", (ROOT / lock).read_text(encoding="utf-8"), re.MULTILINE))


def name_of(requirement: str) -> str:
    return re.split(r"[\[><=]", requirement)[0]
