"""Names and words: standard terms, full first sentences, one name for one class, files of a readable size."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.sources import FOLDERS, ROOT, modules, tracked_text

LONGEST_SOURCE, LONGEST_TEST = 400, 500
"""Lines of a file that a reader still takes in."""

REPLACED = {
    r"foretell\w*|foretold": "predict, held out",
    r"reckon\w*": "compute, assume",
    r"\bglances?\b": "normal equations",
    r"\bgathered\b|\bgather\(": "dataset, collect_dataset",
    r"leftovers?\b|left[ _-]over": "unexplained residual",
    r"outlooks?\b": "pull predictor",
    r"\btugs?\b": "candidate pull",
    r"CarriedTruth|\bcarried truth\b": "transferred truth",
    r"\bborne\b": "attachment loads",
    r"side_by_side": "parallel_map",
    r"\bjudg(e|ed|ing) again\b|\b_judged?\b": "refine, smooth",
    r"\bwidened\b": "inflated, dilated",
    r"\bway of the tool\b|\btool's way\b": "displacement",
    r"\blingers?\b": "history dependent",
    r"\brungs?\b": "stiffness components",
    r"\bparts? left out\b": "held-out parts",
    r"\btold (apart|from)\b": "distinguished from",
    r"\bthrice\b": "three times",
    r"\bloop goes round\b": "the loop repeats",
    r"\bundisturbed\b": "nominal",
}
"""Words that an engineer does not search for, and what stands for them. Case is ignored."""

RENAMED = set(
    "Foretold Glance glances Gathered Leftover Outlook Tug Sight Stated stating CarriedTruth carrying widened Followed "
    "lingers natural rungs parting Rub Film Load OWN Added Trial Stage undisturbed worked told say".split()
)
"""Names of code that have standard ones now; the words themselves are English."""


@pytest.mark.parametrize("pattern", REPLACED)
def test_no_text_holds_a_word_that_has_a_standard_name(pattern: str):
    """Every tracked text file: sources, tests, pages, messages. The changelog may say what was renamed to what."""
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]} ({REPLACED[pattern]})"
        for path, text in tracked_text()
        if path.name != Path(__file__).name
        for number, line in enumerate(text.splitlines(), start=1)
        if re.search(pattern, line, re.IGNORECASE) and not (path.name == "CHANGELOG.md" and "→" in line)
    ]
    assert found == []


def definitions(path: Path) -> Iterator[tuple[int, str]]:
    """Line and name of everything that a file defines: classes, functions, arguments, variables, attributes."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id if isinstance(node, ast.Name) else node.attr


def test_nothing_is_defined_by_a_name_that_was_replaced():
    found = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in modules(ROOT).values()
        for line, name in definitions(path)
        if name in RENAMED
    ]
    assert found == []


def test_one_class_name_is_defined_once():
    places = defaultdict(list)
    for module, path in modules(ROOT).items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(module)
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


def sentences(path: Path) -> Iterator[tuple[int, str]]:
    """Line and first line of every docstring, those under fields and constants too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        for child in getattr(node, "body", []) if isinstance(getattr(node, "body", []), list) else []:
            value = getattr(child, "value", None)
            if isinstance(child, ast.Expr) and isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield child.lineno, value.value.strip().splitlines()[0]


def test_every_docstring_begins_with_a_sentence():
    """None begins with "Of", and none is a symbol and a unit alone."""
    found = [
        f"{path.relative_to(ROOT)}:{line}: {first}"
        for path in [*modules(ROOT).values(), *(ROOT / "tests").rglob("*.py"), *(ROOT / "tools").glob("*.py")]
        for line, first in sentences(path)
        if first.startswith("Of ") or not re.search(r"[A-Za-z]{3}", re.sub(r"\[.*?\]|`.*?`", "", first))
    ]
    assert found == []


@pytest.mark.parametrize(
    ("folder", "longest"), [*((name, LONGEST_SOURCE) for name in FOLDERS), ("tests", LONGEST_TEST)]
)
def test_no_file_is_too_long_to_read(folder: str, longest: int):
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in (ROOT / folder).rglob("*.py")}
    assert {str(path.relative_to(ROOT)): n for path, n in lengths.items() if n > longest} == {}
