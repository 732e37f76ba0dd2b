"""Where a tissue is attached: shapes in tissue coordinates, and the vertices that lie in them.

A vertex is attached when it is within half the shape's width of it; attachments are the union of the shapes. Where two
shapes meet they must agree on the stiffness, because a vertex has one.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from jiggle_mj.scenes.section import Section, number, points, stiffness, vector

from jiggle_mj.errors import SceneError


def _distance_to_segment(
    p: Float[np.ndarray, "n 2"], start: Float[np.ndarray, " 2"], end: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, " n"]:
    along = end - start
    share = np.clip((p - start) @ along / max(float(along @ along), 1e-300), 0.0, 1.0)
    return np.linalg.norm(p - start - share[:, None] * along, axis=1)


@dataclass(frozen=True, kw_only=True)
class Attachment(Section, ABC):
    """A shape with a width and a stiffness; the subclasses say which shape."""

    section: ClassVar[str] = "attachments"
    stiffness: float = stiffness()
    """Spring constant of each attached vertex [N/m]; infinity is a weld."""

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
    width: float = number(unit="m", above=0)

    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """From points to the segment [m]."""
        return _distance_to_segment(p, np.array(self.start), np.array(self.end))


@dataclass(frozen=True, kw_only=True)
class Arc(Attachment):
    """A band along a circle, counter-clockwise from one angle to the other."""

    centre: tuple[float, float] = vector(length=2, unit="m")
    radius: float = number(unit="m", above=0)
    start_deg: float = number(unit="degrees", at_least=-360, at_most=360)
    end_deg: float = number(unit="degrees", at_least=-360, at_most=720)
    width: float = number(unit="m", above=0)

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
    radius: float = number(unit="m", above=0)
    width: float = number(0.0, unit="m", at_least=0)

    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """From points to the disc [m]; 0 inside."""
        return np.maximum(np.linalg.norm(p - np.array(self.centre), axis=1) - self.radius, 0.0)


@dataclass(frozen=True, kw_only=True)
class Polygon(Attachment):
    """A filled simple polygon; a width reaches beyond its outline."""

    points: tuple[tuple[float, float], ...] = points(at_least=3)
    width: float = number(0.0, unit="m", at_least=0)

    def distance(self, p: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """From points to the polygon [m]; 0 inside, by the even-odd rule."""
        corners = np.array(self.points)
        outline = np.full(len(p), np.inf)
        inside = np.zeros(len(p), dtype=bool)
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            outline = np.minimum(outline, _distance_to_segment(p, start, end))
            crosses = (start[1] > p[:, 1]) != (end[1] > p[:, 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                x = start[0] + (p[:, 1] - start[1]) * (end[0] - start[0]) / (end[1] - start[1])
            inside ^= crosses & (p[:, 0] < x)
        return np.where(inside, 0.0, outline)


SHAPES: dict[str, type[Attachment]] = {"segment": Segment, "arc": Arc, "disc": Disc, "polygon": Polygon}


def vertex_stiffness(
    attachments: tuple[Attachment, ...], vertices: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """Stiffness of the attachment at each vertex [N/m]: 0 where free, infinity where welded.

    Raises:
        SceneError: a shape holds no vertex, or two shapes disagree about one.
    """
    total = np.zeros(len(vertices))
    owner = np.full(len(vertices), -1)
    for number_, shape in enumerate(attachments):
        inside = shape.distance(vertices) <= shape.half_width
        if not inside.any():
            raise SceneError(
                f"attachments[{number_}] ({type(shape).__name__.lower()}) holds no vertex of the tissue: "
                "move it onto the sheet or widen it."
            )
        clash = np.flatnonzero(inside & (owner >= 0) & (total != shape.stiffness))
        if clash.size:
            x, y = vertices[clash[0]]
            raise SceneError(
                f"attachments[{owner[clash[0]]}] and attachments[{number_}] give the vertex at ({x:.4f}, {y:.4f}) m "
                f"two stiffnesses, {total[clash[0]]:g} and {shape.stiffness:g} N/m: make them equal or part them."
            )
        total[inside], owner[inside] = shape.stiffness, number_
    return total
