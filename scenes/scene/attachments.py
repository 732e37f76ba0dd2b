"""Where a tissue is attached: shapes in tissue coordinates, and the vertices that lie in them.

A vertex is attached when it is within half the shape's width of it; attachments are the union of the shapes. Where two
shapes meet they must agree on how they hold, because a vertex is held in one way.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from itertools import combinations
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from jiggle_mj.errors import SceneError
from jiggle_mj.regions import distance_to_segment

from .section import Section, number, points, stiffness, vector


def _cross(*corners: tuple[float, float]) -> bool:
    """Whether two segments a-b and c-d cross within both."""
    a, b, c, d = map(np.array, corners)

    def side(p: Float[np.ndarray, " 2"], q: Float[np.ndarray, " 2"], r: Float[np.ndarray, " 2"]) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0


@dataclass(frozen=True, kw_only=True)
class Attachment(Section, ABC):
    """A shape with a width and a stiffness; the subclasses say which shape."""

    section: ClassVar[str] = "attachments"
    stiffness: float = stiffness()
    """Spring constant of each attached vertex [N/m]; infinity is a weld."""
    breaks_at: float = number(0.0, unit="N", at_least=0, at_most=1e6)
    """Largest force; 0 for any."""
    hardening: float = number(0.0, unit="1/m^2", at_least=0, at_most=1e12)
    """c of a force k e (1 + c e^2), e the elongation beyond the slack."""
    slack: float = number(0.0, unit="m", at_least=0, at_most=0.05)
    """Length up to which a spring is loose."""
    offset: tuple[float, float, float] = vector((0.0, 0.0, 0.0), length=3, unit="m")
    """The anchor, from where the vertex lies at rest; world."""
    yields_at: float = number(0.0, unit="m", at_least=0, at_most=1)
    """Largest e; beyond it the anchor comes after. 0 for any."""
    creep: float = number(0.0, unit="1/s", at_least=0, at_most=100)
    """Share of e by which the anchor comes after in a second."""

    def __post_init__(self) -> None:
        """Check that a weld is asked for nothing that only a spring has."""
        super().__post_init__()
        given = [name for name in ("hardening", "slack", "offset", "yields_at", "creep") if np.any(getattr(self, name))]
        if math.isinf(self.stiffness) and given:
            raise SceneError(
                f"attachments.{given[0]} of a weld: only a spring has one; give a stiffness in N/m or leave it out."
            )

    @property
    def law(self) -> tuple[float | tuple[float, float, float], ...]:
        """How it holds a vertex: all that does not say where."""
        return tuple(getattr(self, f.name) for f in fields(Attachment))

    @property
    def half_width(self) -> float:
        """Vertices up to this distance from the shape are attached [m]."""
        return 0.5 * getattr(self, "width")  # noqa: B009  # each shape has one, with a range of its own

    @abstractmethod
    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """From points in tissue coordinates to the shape [m]."""


@dataclass(frozen=True, kw_only=True)
class Segment(Attachment):
    """A straight band."""

    start: tuple[float, float] = vector(length=2, unit="m")
    end: tuple[float, float] = vector(length=2, unit="m")
    width: float = number(unit="m", above=0, at_most=1)

    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """From points to the segment [m]."""
        return distance_to_segment(p, np.array(self.start), np.array(self.end))


@dataclass(frozen=True, kw_only=True)
class Arc(Attachment):
    """A band along a circle, counter-clockwise from one angle to the other."""

    centre: tuple[float, float] = vector(length=2, unit="m")
    radius: float = number(unit="m", above=0)
    start_deg: float = number(unit="degrees", at_least=-360, at_most=360)
    end_deg: float = number(unit="degrees", at_least=-360, at_most=720)
    width: float = number(unit="m", above=0, at_most=1)

    def __post_init__(self) -> None:
        """Check the angles."""
        super().__post_init__()
        if not 0 < self.end_deg - self.start_deg <= 360:
            raise SceneError(
                f"attachments.end_deg = {self.end_deg:g}: must be above start_deg = {self.start_deg:g} by at most 360."
            )

    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """From points to the arc [m]."""
        start, end = math.radians(self.start_deg), math.radians(self.end_deg)
        offset = p - np.array(self.centre)
        angle = np.arctan2(offset[:, 1], offset[:, 0])
        beside = (angle - start) % (2 * math.pi) <= end - start
        to_circle = np.abs(np.linalg.norm(offset, axis=1) - self.radius)
        tips = self.radius * np.array([[math.cos(a), math.sin(a)] for a in (start, end)])
        to_tips = np.linalg.norm(offset[:, None] - tips, axis=2).min(axis=1)
        return np.where(beside, to_circle, to_tips)


@dataclass(frozen=True, kw_only=True)
class Disc(Attachment):
    """A filled disc; a width reaches beyond its rim."""

    centre: tuple[float, float] = vector(length=2, unit="m")
    radius: float = number(unit="m", above=0, at_most=1)
    width: float = number(0.0, unit="m", at_least=0, at_most=1)

    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """From points to the disc [m]; 0 inside."""
        return np.maximum(np.linalg.norm(p - np.array(self.centre), axis=1) - self.radius, 0.0)


@dataclass(frozen=True, kw_only=True)
class Polygon(Attachment):
    """A filled simple polygon; a width reaches beyond its outline."""

    points: tuple[tuple[float, float], ...] = points(at_least=3)
    width: float = number(0.0, unit="m", at_least=0, at_most=1)

    def __post_init__(self) -> None:
        """Check that the outline does not cross itself."""
        super().__post_init__()
        sides = list(zip(self.points, (*self.points[1:], self.points[0]), strict=True))
        for i, j in combinations(range(len(sides)), 2):
            if _cross(*sides[i], *sides[j]):
                raise SceneError(f"attachments.points: the sides after point {i} and point {j} cross; reorder them.")

    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """From points to the polygon [m]; 0 inside, by the even-odd rule."""
        corners = np.array(self.points)
        outline = np.full(len(p), np.inf)
        inside = np.zeros(len(p), dtype=bool)
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            outline = np.minimum(outline, distance_to_segment(p, start, end))
            crosses = (start[1] > p[:, 1]) != (end[1] > p[:, 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                x = start[0] + (p[:, 1] - start[1]) * (end[0] - start[0]) / (end[1] - start[1])
            inside ^= crosses & (p[:, 0] < x)
        return np.where(inside, 0.0, outline)


SHAPES: dict[str, type[Attachment]] = {"segment": Segment, "arc": Arc, "disc": Disc, "polygon": Polygon}


def owners(attachments: tuple[Attachment, ...], vertices: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Which of the attachments holds each vertex; -1 where it is free.

    Raises:
        SceneError: a shape holds no vertex, or two shapes disagree about one.
    """
    owner = np.full(len(vertices), -1)
    for number_, shape in enumerate(attachments):
        inside = shape.distance(vertices) <= shape.half_width
        if not inside.any():
            raise SceneError(
                f"attachments[{number_}] ({type(shape).__name__.lower()}) holds no vertex of the tissue: "
                "move it onto the sheet or widen it."
            )
        for vertex in np.flatnonzero(inside & (owner >= 0)):
            _agree(attachments, int(owner[vertex]), number_, vertices[vertex])
        owner[inside] = number_
    return owner


def _agree(attachments: tuple[Attachment, ...], one: int, other: int, place: Float[np.ndarray, " 2"]) -> None:
    for f, a, b in zip(fields(Attachment), attachments[one].law, attachments[other].law, strict=True):
        if a != b:
            held = ["a weld" if value == math.inf else f"{f.name} = {value}" for value in (a, b)]
            raise SceneError(
                f"attachments[{one}] and attachments[{other}] contradict each other at the vertex at "
                f"({place[0]:.4f}, {place[1]:.4f}) m: {held[0]} and {held[1]}. Make them equal or part them."
            )


def vertex_stiffness(attachments: tuple[Attachment, ...], owner: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the stiffness that holds each vertex [N/m], by `owners`: 0 where free, infinity where welded."""
    return np.array([attachments[one].stiffness if one >= 0 else 0.0 for one in owner])
