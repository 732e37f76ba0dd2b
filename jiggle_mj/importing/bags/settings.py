"""What the user says about a bag: map.toml, and the options of the command line, which go before it.

Checks keys and kinds of values only; `roles` compares the topics with those of the bag. docs/BAGS.md has an example.
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

from ... import toml_kinds as kinds
from ...errors import OptionError, RecordingError
from ...likely_name import did_you_mean
from ...observation import Declaration
from ...recording.reader import PAIRING_TOLERANCE_NS
from ...toml_kinds import StrictTable
from ..recording_toml import parse_declaration_table
from ..units import LENGTH_UNITS, unit_of
from .gripper import ClosedRule

Role = Literal["left", "right", "left_info", "right_info", "tool", "gripper", "points", "depth", "depth_info", "force"]
"""What a topic is for."""
ROLES: tuple[Role, ...] = get_args(Role)
"""Every role."""
Side = Literal["left", "right"]
"""Which camera of the pair."""
Clock = Literal["header", "receive"]
"""Whose time a message has: its own header's, or that of the recorder that received it."""
PAIRING_TOLERANCE_MS = PAIRING_TOLERANCE_NS / 1e6
"""Default largest difference between the stamps of a left and a right image [ms]."""
MIN_SPACING = 1e-5
"""Smallest edge of the cubes that thin a depth image [m]: far below what a depth camera resolves."""
MS = 1_000_000
"""Nanoseconds in a millisecond."""


@dataclass(frozen=True, kw_only=True)
class DepthSettings:
    """How a depth image becomes a cloud."""

    near: float = 0.0
    """Smallest depth that is used [m]."""
    far: float = 1.0
    """Largest depth that is used [m]."""
    mask: Path | None = None
    """An image of the depth image's size: pixels above 0 show the tissue; None for all pixels."""
    spacing: float = 2e-3
    """Edge of the cubes of which each gives one point, the mean of its points [m]."""


@dataclass(frozen=True, kw_only=True)
class BagSettings:
    """What the user says about a bag; the defaults say nothing."""

    topics: dict[Role, str] = field(default_factory=dict)
    """Topic of each role that the user names; `tf:FRAME` for a tool that is a frame of /tf; empty for no topic."""
    closed: ClosedRule | None = None
    """When the jaws are closed; None where the messages say so themselves."""
    tool_unit: float = 1.0
    """Metres in one unit of the poses on the tool's topic."""
    grasp_radius: float | None = None
    """Radius of the grip [m]; None for the importer's default, which is said."""
    camera_info: dict[Side, Path] = field(default_factory=dict)
    """Calibration files of `camera_calibration`, which replace the bag's."""
    rectified: bool | None = None
    """Whether the images are rectified; None to go by `rect` in the topic's name."""
    pairing_tolerance_ms: float = PAIRING_TOLERANCE_MS
    """Largest difference between the stamps of a left and a right image [ms]."""
    clock: Clock = "header"
    """Whose time a message has; a topic without stamps has the time of receipt."""
    world: str | None = None
    """Frame that counts as the world; None for the root of /tf."""
    id_field: str | None = None
    """Field of the clouds that numbers the material points; empty for none, None to look for a usual name."""
    noise_sd: float | None = None
    """Standard deviation of each coordinate of the clouds [m]; None for the default of `MeasuredPoints`."""
    force_sd: float | None = None
    """Standard deviation of each component of the force on the tool [N]; None to measure it while the jaws are open."""
    allow_truncated: bool = False
    """Whether the complete records of an MCAP file that was cut off are read."""
    depth: DepthSettings = DepthSettings()
    """How depth images become clouds."""
    declaration: Declaration | None = None
    """The user's prior knowledge of the tissue; None where none is given."""


def read_map(path: Path) -> BagSettings:
    """Read a map.toml and return what it says.

    Raises:
        RecordingError: the file is missing or no TOML, a key is unknown, or a value is of the wrong kind.
    """
    try:
        top = StrictTable(tomllib.loads(path.read_text(encoding="utf-8-sig")), str(path))
    except (OSError, UnicodeDecodeError) as failure:
        raise RecordingError(f"{path} cannot be read: {failure}.") from failure
    except (tomllib.TOMLDecodeError, RecursionError) as failure:
        raise RecordingError(f"{path} is not TOML: {str(failure)[:200]}.") from failure
    tables = {
        name: top.table(name, optional=True)
        for name in ("topics", "tool", "gripper", "camera", "time", "frames", "points", "force", "depth", "declaration")
    }
    topics, gripper, camera, depth = tables["topics"], tables["gripper"], tables["camera"], tables["depth"]
    rule, limits = gripper.take("closed", kinds.text, None), depth.take("range", _range, [0.0, DepthSettings.far])
    mask = depth.take("mask", kinds.text, None)
    settings = BagSettings(
        topics={role: topics.take(role, kinds.text) for role in ROLES if role in topics.values},
        closed=None if rule is None else ClosedRule.parse(rule),
        tool_unit=unit_of(tables["tool"], "unit", LENGTH_UNITS, "m"),
        grasp_radius=gripper.take("radius", kinds.positive, None),
        camera_info={
            side: path.parent / camera.take(side, kinds.text) for side in ("left", "right") if side in camera.values
        },
        rectified=camera.take("rectified", kinds.flag, None),
        pairing_tolerance_ms=tables["time"].take("pairing_tolerance_ms", kinds.positive, PAIRING_TOLERANCE_MS),
        clock=_clock(tables["time"]),
        world=tables["frames"].take("world", kinds.text, None),
        id_field=tables["points"].take("id", kinds.text, None),
        noise_sd=tables["points"].take("noise_sd", kinds.positive, None),
        force_sd=tables["force"].take("sd", kinds.positive, None),
        depth=DepthSettings(
            near=limits[0],
            far=limits[1],
            mask=None if mask is None else path.parent / mask,
            spacing=depth.take("spacing", _spacing, DepthSettings.spacing),
        ),
        declaration=parse_declaration_table(tables["declaration"]) if tables["declaration"].given else None,
    )
    topics.known |= set(ROLES)
    camera.known |= {"left", "right"}
    for name, table in tables.items():
        if name != "declaration" or table.given:
            table.refuse_unknown()
    top.refuse_unknown()
    return settings


def with_options(
    settings: BagSettings,
    *,
    topic: Sequence[str] = (),
    camera_info: Sequence[str] = (),
    closed: str | None = None,
    pairing_tolerance: float | None = None,
    grasp_radius: float | None = None,
    world: str | None = None,
    clock: Clock | None = None,
    allow_truncated: bool = False,
) -> BagSettings:
    """Return settings in which the options of the command line replace those of map.toml.

    Args:
        settings: those of map.toml, or the defaults.
        topic: each `ROLE=TOPIC`.
        camera_info: each `left=FILE` or `right=FILE`.
        closed: the rule of the gripper, such as `jaw<0.1`.
        pairing_tolerance: of left and right images [ms].
        grasp_radius: of the grip [m].
        world: frame that counts as the world.
        clock: whose time a message has.
        allow_truncated: whether the complete records of an MCAP file that was cut off are read.

    Raises:
        OptionError: an option is not of that form, or out of range.
    """
    given: dict[str, Any] = {"world": world, "clock": clock}
    topics = dict(settings.topics)
    for text in topic:
        role, name = _pair(text, "--topic", ROLES)
        topics[cast(Role, role)] = name
    files = dict(settings.camera_info)
    for text in camera_info:
        side, name = _pair(text, "--camera-info", ("left", "right"))
        files[cast(Side, side)] = Path(name)
    for name, value in (("pairing_tolerance", pairing_tolerance), ("grasp_radius", grasp_radius)):
        if value is not None and not 0 < value < float("inf"):
            raise OptionError(f"--{name.replace('_', '-')} must be a number above 0; got {value}.")
    given |= {"pairing_tolerance_ms": pairing_tolerance, "grasp_radius": grasp_radius}
    given |= {"closed": None if closed is None else ClosedRule.parse(closed)}
    chosen = {name: value for name, value in given.items() if value is not None}
    return replace(settings, topics=topics, camera_info=files, allow_truncated=allow_truncated, **chosen)


def _pair(text: str, option: str, allowed: Sequence[str]) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or name not in allowed:
        meant = did_you_mean(name, allowed)
        raise OptionError(
            f"{option} must be NAME=VALUE with NAME one of {', '.join(allowed)}; got '{text[:200]}'{meant}"
        )
    return name, value


def _range(value: Any) -> list[float]:
    if not isinstance(value, list) or len(value) != 2 or not 0 <= kinds.number(value[0]) < kinds.number(value[1]):
        raise TypeError("two numbers from 0, the smaller first")
    return [float(each) for each in value]


def _spacing(value: Any) -> float:
    if kinds.number(value) < MIN_SPACING:
        raise TypeError(f"a number from {MIN_SPACING:g} [m]")
    return float(value)


def _clock(table: StrictTable) -> Clock:
    clock = table.take("clock", kinds.text, "header")
    if clock not in get_args(Clock):
        raise RecordingError(f"{table.where} clock must be one of {', '.join(get_args(Clock))}; got '{clock[:200]}'.")
    return cast(Clock, clock)
