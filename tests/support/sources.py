"""The sources as files and modules, and what each imports."""

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = {"jiggle_mj": "jiggle_mj", "scenes": "jiggle_mj.scenes", "estimator": "jiggle_mj.estimator",
           "eval": "jiggle_mj.eval"}  # fmt: skip
"""Folder at the root to import name, as the links in jiggle_mj/ have it."""


def modules(root: Path) -> dict[str, Path]:
    """Import name to source file, over the four folders."""
    found = {}
    for folder, package in FOLDERS.items():
        for path in sorted((root / folder).rglob("*.py")):
            parts = path.relative_to(root / folder).with_suffix("").parts
            found[".".join([package, *(part for part in parts if part != "__init__")])] = path
    return found


def imports(path: Path, name: str) -> Iterator[tuple[int, str]]:
    """Line and absolute name of all that a module imports; `from a import b` gives a.b."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in {"import_module", "importlib.import_module"}:
            yield from ((node.lineno, str(a.value)) for a in node.args[:1] if isinstance(a, ast.Constant))


def home(target: str, known: Iterable[str]) -> str | None:
    """The module that an imported name is, or is in."""
    parents = (target, target.rpartition(".")[0])
    return next((name for name in parents if name in known), None)


TEXT = {".py", ".md", ".toml", ".html", ".js", ".css", ".json", ".cff", ".xml"}
"""Suffixes of the files that people read."""
UNREAD = {".git", ".venv", "build", "dist", "out", "__pycache__"}
"""Folders that a checkout collects and nobody wrote."""


def tracked_text() -> Iterator[tuple[Path, str]]:
    """Yield every text file that people wrote, and what it holds."""
    for path in sorted(ROOT.rglob("*")):
        parts = set(path.relative_to(ROOT).parts[:-1])
        named = path.suffix in TEXT or path.name in ("Makefile", "run")
        if named and path.is_file() and not parts & UNREAD and not any(part.startswith(".venv") for part in parts):
            yield path, path.read_text(encoding="utf-8")
