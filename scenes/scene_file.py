"""Reading and writing of scene files: one TOML table for each section of `scene/scene.py`, read strictly.

Unknown keys, wrong types and missing files are refused with the key, the value and what is allowed. What the keys mean
to MuJoCo is in `tissue/model.py`.
"""

import math
import tomllib
from collections.abc import Iterator
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from jiggle_mj.argument_checks import as_path, quoted
from jiggle_mj.errors import MAX_SHOWN, SceneError
from jiggle_mj.likely_name import did_you_mean

from .disturbances.registry import disturbance_class
from .scene.attachments import SHAPES, Attachment
from .scene.disturbance import Disturbance
from .scene.scene import (
    BedConfig,
    CameraConfig,
    DeclaredConfig,
    LightsConfig,
    LimitsConfig,
    ProcedureConfig,
    ProgrammeConfig,
    Scene,
    SensingConfig,
    TextureConfig,
    TissueConfig,
    TweezerConfig,
)
from .scene.section import Section, checked

SECTIONS: dict[str, type[Section]] = {
    cls.section: cls
    for cls in (
        TissueConfig,
        BedConfig,
        TweezerConfig,
        ProgrammeConfig,
        ProcedureConfig,
        LimitsConfig,
        CameraConfig,
        LightsConfig,
        TextureConfig,
        SensingConfig,
        DeclaredConfig,
    )
}
"""Class of each table of a scene file, except those of the arrays `attachments` and `disturbances`."""
SHIPPED_FOLDER = Path(__file__).parent
"""Folder of the shipped scenes."""
MAX_SEED = 2**32 - 1
"""Largest seed of a scene."""


def shipped_scenes() -> tuple[str, ...]:
    """Return the names of the scenes that come with the package."""
    return tuple(sorted(path.stem for path in SHIPPED_FOLDER.glob("*.toml")))


def scene_summary(name: str) -> str:
    """Return what a shipped scene shows: the comment in the first line of its file."""
    with (SHIPPED_FOLDER / f"{name}.toml").open(encoding="utf-8") as file:
        return file.readline().lstrip("# ").strip()


def load_scene(name_or_path: str | Path) -> Scene:
    """Read a shipped scene by its name, or a scene file by its path.

    Raises:
        SceneError: no such scene, not TOML, or a key or value that is not allowed.
    """
    path = as_path(name_or_path, "a scene's name or path", error=SceneError)
    if str(name_or_path) in shipped_scenes():
        path = SHIPPED_FOLDER / f"{name_or_path}.toml"
    elif path.suffix != ".toml":
        name = str(name_or_path)
        raise SceneError(
            f"no scene named {name!r}{did_you_mean(name, shipped_scenes())} Shipped scenes are "
            f"{', '.join(shipped_scenes())}, and the path of a scene file ends in .toml."
        )
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise SceneError(f"cannot read the scene file {path}: {error}.") from None
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # tomllib.TOMLDecodeError, or a number of thousands of digits
        raise SceneError(f"{path} is not valid TOML: {str(error)[:MAX_SHOWN]}.") from None
    return scene_from_table(table, name=path.stem)


def scene_from_table(table: dict[str, Any], *, name: str) -> Scene:
    """Return a scene from parsed TOML.

    Raises:
        SceneError: a key or value that is not allowed.
    """
    known = ["seed", "secret", "attachments", "disturbances", *SECTIONS]
    _refuse_unknown(table, known, where="the scene")
    seed = table.get("seed", 0)
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
        raise SceneError(f"seed = {quoted(seed)}: must be a whole number in [0, 2^32).")
    secret = table.get("secret", False)
    if not isinstance(secret, bool):
        raise SceneError(f"secret = {quoted(secret)}: must be true or false.")
    sections = {key: _section(cls, table[key], where=key) for key, cls in SECTIONS.items() if key in table}
    shapes = tuple(_attachment(entry, where=where) for where, entry in _tables(table, "attachments"))
    disturbances = tuple(_disturbance(entry, where=where) for where, entry in _tables(table, "disturbances"))
    return Scene(name=name, seed=seed, secret=secret, attachments=shapes, disturbances=disturbances, **sections)  # type: ignore[arg-type]


def _tables(table: dict[str, Any], key: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the tables of an array, each with its place for messages."""
    entries = table.get(key, [])
    if not isinstance(entries, list):
        raise SceneError(f"{key} = {quoted(entries)}: must be an array of tables, each headed [[{key}]].")
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise SceneError(f"{key}[{i}] = {quoted(entry)}: must be a table headed [[{key}]].")
        yield f"{key}[{i}]", entry


def _attachment(table: dict[str, Any], *, where: str) -> Attachment:
    shape = table.get("shape")
    if not isinstance(shape, str) or shape not in SHAPES:
        hint = did_you_mean(shape, SHAPES)
        raise SceneError(f"{where}.shape = {quoted(shape)}: must be one of {', '.join(map(repr, SHAPES))}{hint}")
    return _section(SHAPES[shape], {k: v for k, v in table.items() if k != "shape"}, where=where)


def _disturbance(table: dict[str, Any], *, where: str) -> Disturbance:
    return _section(disturbance_class(table.get("name")), {k: v for k, v in table.items() if k != "name"}, where=where)


def _section(cls: type[Section], table: object, *, where: str) -> Any:
    if not isinstance(table, dict):
        raise SceneError(f"{where} = {quoted(table)}: must be a table.")
    _refuse_unknown(table, [f.name for f in fields(cls)], where=where)
    missing = [f.name for f in fields(cls) if f.default is MISSING and f.name not in table]
    if missing:
        raise SceneError(f"{where} lacks {', '.join(missing)}.")
    try:
        return cls(**{f.name: checked(f, table[f.name], where=where) for f in fields(cls) if f.name in table})
    except SceneError as error:
        raise SceneError(str(error).replace(f"{cls.section}.", f"{where}.", 1)) from None


def _refuse_unknown(table: dict[str, Any], known: list[str], *, where: str) -> None:
    unknown = [key for key in table if key not in known]
    if unknown:
        hint = did_you_mean(unknown[0], known)
        raise SceneError(f"unknown key {quoted(unknown[0])} in {where}{hint} Known keys are {', '.join(known)}.")


def scene_table(scene: Scene) -> dict[str, Any]:
    """Return the scene as the table of a scene file, with every key; `scene_from_table` reads it back."""
    table: dict[str, Any] = {"seed": scene.seed, "secret": scene.secret}
    shape_names = {cls: shape for shape, cls in SHAPES.items()}
    table["attachments"] = [{"shape": shape_names[type(shape)], **_plain(shape)} for shape in scene.attachments]
    table["disturbances"] = [{"name": item.kind(), **_plain(item)} for item in scene.disturbances]
    return table | {key: _plain(getattr(scene, key)) for key in SECTIONS}


def _plain(section: Section) -> dict[str, Any]:
    return {
        f.name: "weld" if getattr(section, f.name) == math.inf else getattr(section, f.name) for f in fields(section)
    }
