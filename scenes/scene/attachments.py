"""Where and how a tissue is attached: shapes in tissue coordinates, and the vertices that lie in them.

A vertex is attached when it is within half the shape's width of the shape; attachments are the union of the shapes.
Where two shapes meet they must agree on all values but the geometry, because a vertex has one spring or one weld.

From a scene's stiffness to a spring: `owners` and `vertex_values` here, called by `tissue/model.py`, which compiles the
joints and welds; then `tissue/anchors.py`, which makes a spring for each vertex; then its law in `tissue/springs.py`.
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
    """Return whether two segments a-b and c-d cross within both."""
    a, b, c, d = map(np.array, corners)

    def side(p: Float[np.ndarray, " 2"], q: Float[np.ndarray, " 2"], r: Float[np.ndarray, " 2"]) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0


@dataclass(frozen=True, kw_only=True)
class Attachment(Section, ABC):
    """Common values of all attachments; the subclasses add a shape with a width."""

    section: ClassVar[str] = "attachments"
    stiffness: float = stiffness()
    """Spring constant of each attached vertex [N/m]; infinity is a weld."""
    breaks_at: float = number(0.0, unit="N", at_least=0, at_most=1e6)
    """Force above which it breaks [N]; 0 for never."""
    hardening: float = number(0.0, unit="1/m^2", at_least=0, at_most=1e12)
    """c of the force k e (1 + c e^2), with e the elongation beyond the slack [1/m^2]."""
    slack: float = number(0.0, unit="m", at_least=0, at_most=0.05)
    """Length up to which a spring is loose [m]."""
    offset: tuple[float, float, float] = vector((0.0, 0.0, 0.0), length=3, unit="m")
    """Anchor minus the vertex's rest position, world [m]."""
    yields_at: float = number(0.0, unit="m", at_least=0, at_most=1)
    """Largest e [m]; beyond it the anchor follows the vertex. 0 for never."""
    creep: float = number(0.0, unit="1/s", at_least=0, at_most=100)
    """Rate at which the anchor follows the vertex, as a share of e per second [1/s]."""

    def __post_init__(self) -> None:
        """Check that a weld has none of the values that only a spring can have."""
        super().__post_init__()
        given = [name for name in ("hardening", "slack", "offset", "yields_at", "creep") if np.any(getattr(self, name))]
        if math.isinf(self.stiffness) and given:
            raise SceneError(
                f"attachments.{given[0]} of a weld: only a spring has one; give a stiffness in N/m or remove the key."
            )

    @property
    def law(self) -> tuple[float | tuple[float, float, float], ...]:
        """Return all values but the geometry."""
        return tuple(getattr(self, f.name) for f in fields(Attachment))

    @property
    def half_width(self) -> float:
        """Return the distance from the shape up to which vertices are attached [m]."""
        return 0.5 * getattr(self, "width")  # noqa: B009  # each shape has one, with a range of its own

    @abstractmethod
    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return the distance of points in tissue coordinates from the shape [m]."""


@dataclass(frozen=True, kw_only=True)
class Segment(Attachment):
    """A straight band."""

    start: tuple[float, float] = vector(length=2, unit="m")
    end: tuple[float, float] = vector(length=2, unit="m")
    width: float = number(unit="m", above=0, at_most=1)

    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return the distance of points from the segment [m]."""
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
        """Check that the arc runs counter-clockwise by at most a full turn."""
        super().__post_init__()
        if not 0 < self.end_deg - self.start_deg <= 360:
            raise SceneError(
                f"attachments.end_deg = {self.end_deg:g}: must be above start_deg = {self.start_deg:g} by at most 360."
            )

    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return the distance of points from the arc [m]."""
        start, end = math.radians(self.start_deg), math.radians(self.end_deg)
        offset = p - np.array(self.centre)
        angle = np.arctan2(offset[:, 1], offset[:, 0])
        within_angle = (angle - start) % (2 * math.pi) <= end - start
        to_circle = np.abs(np.linalg.norm(offset, axis=1) - self.radius)
        tips = self.radius * np.array([[math.cos(a), math.sin(a)] for a in (start, end)])
        to_tips = np.linalg.norm(offset[:, None] - tips, axis=2).min(axis=1)
        return np.where(within_angle, to_circle, to_tips)


@dataclass(frozen=True, kw_only=True)
class Disc(Attachment):
    """A filled disc; a width reaches beyond its rim."""

    centre: tuple[float, float] = vector(length=2, unit="m")
    radius: float = number(unit="m", above=0, at_most=1)
    width: float = number(0.0, unit="m", at_least=0, at_most=1)

    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Return the distance of points from the disc [m]; 0 inside."""
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
        """Return the distance of points from the polygon [m]; 0 inside, by the even-odd rule."""
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
"""Class of each value of the key `shape`."""


def owners(attachments: tuple[Attachment, ...], vertices: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Return the index of the attachment that holds each vertex [m]; -1 where it is free.

    Raises:
        SceneError: a shape holds no vertex, or two shapes contradict each other at one.
    """
    owner = np.full(len(vertices), -1)
    for index, shape in enumerate(attachments):
        inside = shape.distance(vertices) <= shape.half_width
        if not inside.any():
            raise SceneError(
                f"attachments[{index}] ({type(shape).__name__.lower()}) holds no vertex of the tissue: "
                "move it onto the sheet or widen it."
            )
        for vertex in np.flatnonzero(inside & (owner >= 0)):
            _refuse_contradiction(attachments, int(owner[vertex]), index, vertices[vertex])
        owner[inside] = index
    return owner


def _refuse_contradiction(
    attachments: tuple[Attachment, ...], first: int, second: int, vertex: Float[np.ndarray, " 2"]
) -> None:
    for f, a, b in zip(fields(Attachment), attachments[first].law, attachments[second].law, strict=True):
        if a != b:
            held = ["a weld" if value == math.inf else f"{f.name} = {value}" for value in (a, b)]
            raise SceneError(
                f"attachments[{first}] and attachments[{second}] contradict each other at the vertex at "
                f"({vertex[0]:.4f}, {vertex[1]:.4f}) m: {held[0]} and {held[1]}. Make them equal or move them apart."
            )


def attach(
    attachments: tuple[Attachment, ...], vertices: Float[np.ndarray, "n 2"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the owner of each vertex (see `owners`), and the stiffness of its attachment [N/m].

    The stiffness is 0 where the vertex is free and infinite where it is welded.

    Raises:
        SceneError: a shape holds no vertex, or two shapes disagree about one.
    """
    owner = owners(attachments, vertices)
    return owner, vertex_values(attachments, owner, "stiffness")


def vertex_values(
    attachments: tuple[Attachment, ...], owner: Int[np.ndarray, " n"], key: str, *, free: object = 0.0
) -> Float[np.ndarray, "n ..."]:
    """Return the value of one key of `Attachment` at each vertex, by `owners`; `free` where nothing holds it."""
    return np.array([getattr(attachments[index], key) if index >= 0 else free for index in owner], dtype=float)
