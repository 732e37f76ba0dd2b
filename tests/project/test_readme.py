"""What README.md and docs/ say is true: the example runs; each verb, option, scene, key, default and link exists."""

import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jiggle_mj import cli
from jiggle_mj.cli.running import VERBS
from jiggle_mj.errors import SceneError
from jiggle_mj.estimator.summaries import RULE
from jiggle_mj.scenes import DISTURBANCES, load_scene, shipped_scenes
from jiggle_mj.scenes.scene.attachments import SHAPES, Attachment
from jiggle_mj.scenes.scene.scene import Scene
from jiggle_mj.scenes.scene.section import Section, checked
from jiggle_mj.scenes.scene_file import SECTIONS, scene_from_table

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
USAGE = (ROOT / "docs" / "USAGE.md").read_text(encoding="utf-8")
METHOD = (ROOT / "docs" / "METHOD.md").read_text(encoding="utf-8")
RESULTS = (ROOT / "docs" / "RESULTS.md").read_text(encoding="utf-8")
STUDIES = (ROOT / "docs" / "STUDIES.md").read_text(encoding="utf-8")
SCENES = (ROOT / "docs" / "SCENES.md").read_text(encoding="utf-8")
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").rglob("*.md")])

TABLES: dict[str, type[Section]] = {**SECTIONS, "attachments": Attachment, **SHAPES}
"""The tables of docs/SCENES.md."""
RIGHT_AT_LEAST = 0.6
"""Precision and recall of the example, exact and on a mesh of its own; docs/RESULTS.md has the bar for exact scores."""
RUN_AND_KEEP = """
import runpy, numpy
names = runpy.run_path("example.py")
numpy.savez("kept.npz", rest=names["estimator"].sheet.rest, reported=names["detection"].attached)
"""
"""Program that runs the example, and saves what it found for checks that the example does not make."""
OPTION = r"(?<![\w-])--[a-z][a-z-]*"
"""A long option, not a dash in a table."""
LARGEST_PICTURE = 300_000
"""Largest size of a picture [bytes]; a README that loads slowly is not read."""
LONGEST_README, LONGEST_RESULTS = 150, 300
"""Largest numbers of lines: a front page is read at once, and the results have one current figure for each claim."""
COMMIT_HASH = r"\b(?=[0-9a-f]*[0-9])(?=[0-9a-f]*[a-f])[0-9a-f]{7}\b"
"""A short commit hash; current pages have none, since history is in docs/notebook/."""


def blocks(page: str, language: str) -> list[str]:
    """Return the fenced blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page, re.DOTALL | re.MULTILINE)


def commands(page: str) -> Iterator[tuple[str, list[str]]]:
    """Yield verb and options of each `jiggle-mj VERB ...` in code; the verb `table` with the name of its table."""
    code = "\n".join(re.findall(r"```.*?```|`[^`\n]+`", page, re.DOTALL))
    for verb, rest in re.findall(r"\bjiggle-mj (table [a-z-]+|[a-z-]+)([^`#\n]*)", code):
        yield verb, re.findall(OPTION, rest)


def known_options(verb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> set[str]:
    """Return the options that the verb's own help lists."""
    monkeypatch.setattr(sys, "argv", ["jiggle-mj", *verb.split(), "--help"])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 0
    return set(re.findall(OPTION, capsys.readouterr().out))


def documented(page: str) -> dict[str, dict[str, tuple[str, str]]]:
    """Map section, or shape of an attachment, to key to (default, allowed), from the tables of docs/SCENES.md."""
    tables: dict[str, dict[str, tuple[str, str]]] = {}
    for part in re.split(r"^(?=##+ )", page, flags=re.MULTILINE)[1:]:
        heading = part.partition("\n")[0]
        named = re.search(r'`(?:\[+|shape = ")(\w+)["\]]', heading)
        rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \|", part, re.MULTILINE)
        if named:
            tables[named[1]] = {key: (default, allowed) for key, default, allowed in rows}
    return tables


def own(section: type[Section]) -> list[Field[Any]]:
    """Return the fields of a table; a shape's are those that not every shape has."""
    shared = {f.name for f in fields(Attachment)} if section in SHAPES.values() else set()
    return [f for f in fields(section) if f.name not in shared]


def refusal(section: type[Section], key: str) -> str:
    """Return what a section says is allowed, when it is given a value of a wrong type."""
    field = next(f for f in fields(section) if f.name == key)
    with pytest.raises(SceneError) as refused:
        checked(field, None, where="it")
    return str(refused.value).partition("must be ")[2].removesuffix(".")


def anchors(page: str) -> set[str]:
    """Return the anchors that GitHub gives the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE), re.MULTILINE)
    texts = [re.sub(r"\[(.*?)\]\(.*?\)", r"\1", heading) for heading in headings]
    return {re.sub(r"[^\w\- ]", "", text).strip().lower().replace(" ", "-") for text in texts}


def test_the_readme_example_finds_the_attachments(tmp_path: Path):
    """The README's Python, as it stands, on the scene of docs/USAGE.md has both scores of `RIGHT_AT_LEAST` or more.

    Runs in an interpreter of its own, with none of the tests' settings. A particle is truly attached when a shape of
    the scene file reaches it at rest.
    """
    (scene,), (example,) = blocks(USAGE, "toml"), blocks(README, "python")
    (tmp_path / "scene.toml").write_text(scene, encoding="utf-8")
    (tmp_path / "example.py").write_text(example, encoding="utf-8")
    command = [sys.executable, "-W", "error", "-c", RUN_AND_KEEP]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "kept.npz") as kept:
        rest, reported = kept["rest"], kept["reported"]
    shapes = load_scene(tmp_path / "scene.toml").attachments
    true = np.any([shape.distance(rest[:, :2]) <= shape.half_width for shape in shapes], axis=0)
    assert (reported & true).sum() >= RIGHT_AT_LEAST * max(reported.sum(), true.sum())
    assert f"{reported.sum()} of {len(rest)} particles attached" in done.stdout
    assert len(re.findall(r"mm: P = \d", done.stdout)) == reported.sum()


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_every_command_in_the_pages_exists(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Each verb is one of the command line's, and takes the options that stand behind it."""
    for verb, options in commands(path.read_text(encoding="utf-8")):
        assert verb.split()[0] in VERBS
        assert set(options) <= known_options(verb, monkeypatch, capsys), verb


def test_the_readme_is_short_and_links_every_page():
    assert len(README.splitlines()) <= LONGEST_README
    pages = {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")}
    assert pages <= set(re.findall(r"\]\(([^)#]+)", README))


def test_the_results_have_one_current_figure_for_each_claim():
    """No commit hash stands in a page outside docs/notebook/."""
    assert len(RESULTS.splitlines()) <= LONGEST_RESULTS
    current = [path for path in PAGES if path.parent.name != "notebook"]
    assert {path.name: re.findall(COMMIT_HASH, path.read_text(encoding="utf-8")) for path in current} == {
        path.name: [] for path in current
    }


def test_the_usage_page_shows_every_verb():
    assert {verb.split()[0] for verb, _ in commands(USAGE)} == set(VERBS)


def test_every_option_that_readme_usage_and_results_name_exists(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Also those that are named apart from a command."""
    pages = (README, USAGE, METHOD, RESULTS, STUDIES)
    verbs = {*VERBS, *(verb for page in pages for verb, _ in commands(page))}
    known = {"--version"}.union(*(known_options(verb, monkeypatch, capsys) for verb in sorted(verbs)))
    assert set(re.findall(OPTION, "".join(pages))) <= known


def test_every_shipped_scene_is_in_the_usage_page():
    """The list behind "Shipped:" names each scene, and no other."""
    listed = re.search(r"Shipped: (.*?)\. \[k\]", USAGE, re.DOTALL)
    assert listed and set(re.findall(r"`(\w+)`", listed[1])) == set(shipped_scenes())


def test_the_method_page_states_the_detection_rule():
    assert f"The rule is {RULE}" in METHOD


def test_scenes_md_names_exactly_the_sections_and_keys():
    known = {name: {f.name for f in own(cls)} for name, cls in TABLES.items()}
    tables = documented(SCENES)
    assert tables.pop("disturbances", {}) == {}, "in a page of their own"
    assert {name: set(keys) for name, keys in tables.items()} == known
    top = {"name", "seed", "secret", "attachments", "disturbances"}
    assert set(SECTIONS) | top == {f.name for f in fields(Scene)}


@pytest.mark.parametrize("name", TABLES)
def test_scenes_md_states_each_default_and_range(name: str):
    """The default is TOML for the field's default; what is allowed is in the words of the refusal."""
    section = TABLES[name]
    for field in own(section):
        default, allowed = documented(SCENES)[name][field.name]
        assert allowed == refusal(section, field.name), field.name
        if field.default is MISSING:
            assert default == "needed", field.name
        else:
            documented_default = tomllib.loads(f"it = {default.strip('`')}")["it"]
            assert checked(field, documented_default, where=name) == field.default, field.name


@pytest.mark.parametrize("name", DISTURBANCES)
def test_disturbances_md_states_each_default_and_range(name: str):
    """One row for the magnitude, one for each further key; `start` is the same for all."""
    page = (ROOT / "docs" / "DISTURBANCES.md").read_text(encoding="utf-8")
    rows = re.findall(rf"^\| `{name}(\.\w+)?` \| `(.*?)` \| (.*?) \|", page, re.MULTILINE)
    documented_keys = {key.removeprefix(".") or "magnitude": (default, allowed) for key, default, allowed in rows}
    known = {f.name: f for f in fields(DISTURBANCES[name]) if f.name != "start"}
    assert set(documented_keys) == set(known)
    for key, (default, allowed) in documented_keys.items():
        assert allowed == refusal(DISTURBANCES[name], key), key
        assert checked(known[key], tomllib.loads(f"it = {default}")["it"], where=name) == known[key].default, key


def test_the_worked_example_of_scenes_md_is_a_scene_and_declares_its_own_tissue():
    """k = E t and the mass per area = density times t, as the page says."""
    (text,) = blocks(SCENES, "toml")
    scene = scene_from_table(tomllib.loads(text), name="worked")
    tissue, declared = scene.tissue, scene.declared
    assert len(scene.attachments) == 2
    assert declared.membrane_stiffness == pytest.approx(tissue.young * tissue.thickness)
    assert declared.areal_density == pytest.approx(tissue.density * tissue.thickness)
    assert (declared.thickness, declared.poisson) == (tissue.thickness, tissue.poisson)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_every_link_within_the_project_leads_somewhere(path: Path):
    links = re.findall(r"\]\((?!https?://)([^)#]+)", path.read_text(encoding="utf-8"))
    assert [link for link in links if not (path.parent / link).is_file()] == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_every_anchor_within_the_project_is_a_heading(path: Path):
    links = re.findall(r"\]\((?!https?://)([^)#]*)#([^)]+)\)", path.read_text(encoding="utf-8"))
    pages = {page: (path.parent / page if page else path).read_text(encoding="utf-8") for page, _ in links}
    assert [(page, anchor) for page, anchor in links if anchor not in anchors(pages[page])] == []


def test_every_page_links_the_glossary():
    pages = [path for path in (ROOT / "docs").glob("*.md") if path.name != "glossary.md"]
    assert [path.name for path in [ROOT / "README.md", *pages] if "glossary.md" not in path.read_text("utf-8")] == []


def test_every_test_and_file_that_paper_md_names_exists():
    page = (ROOT / "docs" / "PAPER.md").read_text(encoding="utf-8")
    known = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")}
    tests = re.findall(r"`(test_\w+\.py)::(test_\w+)`", page)
    assert tests
    assert [name for file, name in tests if f"def {name}(" not in known.get(file, "")] == []
    files = set(re.findall(r"`((?:estimator|eval|jiggle_mj|scenes)/[\w/]+\.py)`", page))
    assert {file for file in files if not (ROOT / file).is_file()} == set()


def test_the_glossary_has_each_term_once():
    terms = re.findall(r"^### (.*)$", GLOSSARY, re.MULTILINE)
    assert len(terms) == len(set(terms))


def test_pictures_are_small():
    pictures = [path for path in (ROOT / "docs" / "images").iterdir() if path.is_file()]
    assert pictures and max(path.stat().st_size for path in pictures) < LARGEST_PICTURE
