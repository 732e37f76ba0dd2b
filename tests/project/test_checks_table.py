"""docs/RECORDINGS.md names every problem that a check of a recording finds, and says whether it refuses or doubts."""

import ast
import re
from collections import defaultdict

from tests.support.sources import ROOT

PAGE = (ROOT / "docs" / "RECORDINGS.md").read_text(encoding="utf-8")
CALLS = {"_refuse": {True}, "warning": {False}, "_problem": {True, False}, "RecordingProblem": {True, False}}
"""Calls that make a problem, and whether it may refuse where the call does not say."""


def problems_in_code() -> dict[str, set[bool]]:
    """Return whether each problem in the code refuses (True), is doubted (False), or both."""
    found: defaultdict[str, set[bool]] = defaultdict(set)
    for path in sorted((ROOT / "jiggle_mj" / "plausibility").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in CALLS:
                given = {keyword.arg: keyword.value for keyword in node.keywords}
                name, refuses = given.get("name", *node.args[:1]), given.get("refuses")
                if ast.unparse(name) == "name":
                    continue  # of `_problem` itself
                assert isinstance(name, ast.Constant), f"{path}, line {node.lineno}: no literal name"
                stated = isinstance(refuses, ast.Constant)
                found[str(name.value)] |= {bool(refuses.value)} if stated else CALLS[ast.unparse(node.func)]
    return dict(found)


def rows_of_table() -> dict[str, tuple[str, str]]:
    """Return when each problem is refused, and when doubted, by its name."""
    (table,) = re.findall(r"^\| name \| refused \| doubted \|\n\|[-|]+\|\n((?:\|.*\|\n)+)", PAGE, re.MULTILINE)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    return {name: (refused, doubted) for names, refused, doubted in rows for name in re.findall(r"`([\w-]+)`", names)}


def test_the_table_lists_the_problems_of_the_code():
    assert set(rows_of_table()) == set(problems_in_code())


def test_the_table_says_when_each_is_refused_and_when_doubted():
    """A cell for what the code does. `tool-clock` and `tool-drift` refuse in place of `tool-apart` and `tool-still`."""
    rows = rows_of_table()
    for name, outcomes in problems_in_code().items():
        written = {refuses for refuses, when in zip((True, False), rows[name], strict=True) if when}
        expected = outcomes | ({True} if name in ("tool-clock", "tool-drift") else set())
        assert written == expected, name
