"""What the evidence of a hypothesis rests on: in words, and as a strip over frames and a map of the sheet."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float
from plotly.subplots import make_subplots

HOLDS = 0.05
"""Change of the tool's displacement from frame to frame up to which it holds [largest displacement of the grasp]."""
NEAR = 0.6
"""Distance of the particles from something, over that of all particles, up to which they are said to be near it."""
FOR, AGAINST = "#0072b2", "#d55e00"
"""Colours of what is for a hypothesis, and against it."""
ROW_HEIGHT = 230
"""Height of the pictures of one hypothesis [px]."""
T = TypeVar("T")


def explanation_sentence(one: Mapping[str, Any], particles: Mapping[str, Any]) -> str:
    """Return in words on which frames and particles the evidence of a hypothesis rests.

    Args:
        one: of the key `explanation` of discrepancy.json.
        particles: of its key `localisation`.
    """
    title, frames = " and ".join(one["effects"]), one["frames"]
    parts = np.array([frame["nat"] for frame in frames])
    first = f"{title} {'leads' if one['log_bayes_factor'] > 0 else 'trails'} what is declared by "
    first += f"{abs(one['log_bayes_factor']):.0f} nat. The frames give {parts.sum():.0f} nat, what grasps share "
    first += f"{one['grasps_nat']:.0f}"
    if parts.sum() <= 0:
        return f"{first}: it does not rest on frames."
    most = half_of(parts)
    where, nat = "", np.array(one["particles_nat"], dtype=float)
    if nat.sum() > 0:
        chosen = half_of(nat)
        where = f", and on {len(chosen)} of {len(nat)} particles{_place(chosen, particles)}"
    return f"{first}. Half of the frames' share rests on {len(most)} of {len(frames)}{_phase(most, frames)}{where}."


def half_of(parts: Float[np.ndarray, " n"]) -> list[int]:
    """Return the fewest parts that have at least half of a positive sum, the largest first."""
    order = np.argsort(-parts, kind="stable")
    return order[: int(np.argmax(np.cumsum(parts[order]) >= parts.sum() / 2)) + 1].tolist()


def phases(frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what the tool does in each frame: it goes out, holds, or comes back."""
    largest, words = dict[int, float](), list[str]()
    for frame in frames:
        largest[frame["grasp"]] = max(largest.get(frame["grasp"], 0.0), frame["displacement_m"])
    before: Mapping[str, Any] = {"grasp": None, "displacement_m": 0.0}
    for frame in frames:
        step = frame["displacement_m"] - (before["displacement_m"] if before["grasp"] == frame["grasp"] else 0.0)
        holds = abs(step) <= HOLDS * largest[frame["grasp"]]
        words.append("holds" if holds else "goes out" if step > 0 else "comes back")
        before = frame
    return words


def _phase(chosen: list[int], frames: Sequence[Mapping[str, Any]]) -> str:
    """Return what the tool does in most of some frames, and in which grasp; nothing of either where it differs."""
    done = _most([phases(frames)[k] for k in chosen])
    grasp = _most([frames[k]["grasp"] for k in chosen]) if len({frame["grasp"] for frame in frames}) > 1 else None
    found = ["" if done is None else f"while the tool {done}", "" if grasp is None else f"in grasp {grasp}"]
    return "".join(f" {words}" for words in found if words)


def _most(values: Sequence[T]) -> T | None:
    """Return the value that more than half of some have; None if there is none."""
    (commonest, count), *_ = Counter(values).most_common()
    return commonest if 2 * count > len(values) else None


def _place(chosen: list[int], particles: Mapping[str, Any]) -> str:
    """Return what some particles are near to, by the median distance from it; nothing if they are not."""
    rest = np.array(particles["rest_m"])
    found = dict[str, tuple[float, float]]()
    for words, key in (("what is held", "held"), ("what is attached", "attached")):
        if any(particles[key]):
            others = rest[np.array(particles[key], dtype=bool)]
            distance = np.linalg.norm(rest[:, None] - others[None], axis=2).min(axis=1)
            found[words] = float(np.median(distance[chosen])), float(np.median(distance))
    near = [words for words, (own, of_all) in found.items() if of_all > 0 and own <= NEAR * of_all]
    if not near:
        return ""
    words = min(near, key=lambda one: found[one][0] / found[one][1])
    own, of_all = (1e3 * length for length in found[words])
    return f" near {words} (half of them within {own:.0f} mm, of all particles within {of_all:.0f} mm)"


def explanation_figure(
    explained: Sequence[Mapping[str, Any]], flat: Float[np.ndarray, "n 2"], particles: Mapping[str, Any]
) -> go.Figure:
    """Return for each hypothesis a strip of what each frame gives, and a map of what each particle gives [nat].

    Args:
        explained: the key `explanation` of discrepancy.json.
        flat: particles at rest in the plane of the map [m].
        particles: the particles of its key `localisation`.
    """
    titles = [part for one in explained for part in (f"{' and '.join(one['effects'])}: nat by frame", "by particle")]
    x, y = (1e3 * flat.T).tolist()
    figure = make_subplots(rows=len(explained), cols=2, subplot_titles=titles, column_widths=[0.62, 0.38],
                           vertical_spacing=0.3 / len(explained))  # fmt: skip
    for row, one in enumerate(explained, 1):
        nat = [frame["nat"] for frame in one["frames"]]
        colours = [FOR if part > 0 else AGAINST for part in nat]
        bars = go.Bar(x=[str(frame["index"]) for frame in one["frames"]], y=nat, marker={"color": colours},
                      customdata=phases(one["frames"]), hovertemplate="frame %{x}, tool %{customdata}: %{y:.1f} nat",
                      name="", showlegend=False)  # fmt: skip
        figure.add_trace(bars, row=row, col=1)
        parts = one["particles_nat"]
        most = max(np.finfo(float).tiny, *map(abs, parts))
        marker = {"color": parts, "cmin": -most, "cmax": most, "colorscale": [[0, AGAINST], [0.5, "#eeeeee"], [1, FOR]],
                  "showscale": True, "size": 7, "colorbar": {"len": 0.8 / len(explained), "thickness": 10,
                  "y": 1 - (row - 0.5) / len(explained)},
                  "line": {"color": "#222222", "width": [1.5 * held for held in particles["held"]]}}  # fmt: skip
        dots = go.Scatter(x=x, y=y, mode="markers", marker=marker, showlegend=False,
                          hovertemplate="%{marker.color:.2f} nat", name="")  # fmt: skip
        figure.add_trace(dots, row=row, col=2)
        figure.update_xaxes(type="category", row=row, col=1)
        figure.update_yaxes(scaleanchor=f"x{2 * row}", row=row, col=2)
    figure.update_layout(height=ROW_HEIGHT * len(explained) + 60, template="plotly_white",
                         margin={"l": 40, "r": 20, "t": 40, "b": 30})  # fmt: skip
    return figure
