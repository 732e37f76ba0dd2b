"""What closing the loop found, as one page that needs no network: the story in sentences, then its pictures."""

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from plotly.subplots import make_subplots

from jiggle_mj.errors import OutputError
from jiggle_mj.estimate import Sheet

from ..metrics.flat_map import plane_of

SHOWN = 12
"""Effects in the picture of scores."""
BEFORE, AFTER, RING = "#d55e00", "#0072b2", "#e8000b"
VERDICTS = {
    "no-effect": "Nothing is missing that these frames could show.",
    "effect": "One cause is named, and it explains what was left.",
    "ambiguous": "A cause is found, but these frames cannot tell it from others.",
    "effect-with-remainder": "A cause is named, and something else is left over.",
    "unexplained": "Something is missing, and no effect of the library explains it.",
}


def story(found: Mapping[str, Any]) -> list[str]:
    """What was found, in sentences."""
    told = [VERDICTS[found["verdict"]]]
    for one in found["effects"]:
        sizes = ", ".join(_size(*each) for each in zip(one["theta"], one["sd"], one["units"], strict=True))
        told.append(f"Added: {one['name']} ({sizes}), log Bayes factor {one['log_bayes_factor']:.0f}.")
        if one["this_session_alone"]:
            told.append(f"{one['name']} is of the tool, camera or tracker, and holds for this session alone.")
        if one["indistinguishable_from"]:
            told.append(f"Instead of {one['name']} it may as well be: {', '.join(one['indistinguishable_from'])}.")
    told += [f"Refused: {one['name']}, since {one['why']}." for one in found["refused"]]
    held = found["held_out"]
    if held["folds"] and found["effects"]:
        before, after = (np.sqrt(np.mean([one[f"{when}_rms_m"] ** 2 for one in held["folds"]])) for when in TIMES)
        told.append(f"Parts left out of the fit are foretold to {1e3 * before:.2f} mm before, {1e3 * after:.2f} after.")
    if held["before_rms_m"] is None:
        told.append(
            "There is one grasp alone: nothing was held out, and effects that one grasp cannot tell apart stay so."
        )
    else:
        numbers = f"{1e3 * held['before_rms_m']:.2f} mm"
        if found["effects"]:
            numbers += f" before, {1e3 * held['after_rms_m']:.2f} mm after"
        told.append(f"The last part chose no effect; from what the tool says it is foretold to {numbers}.")
        still, shared = (f"{1e3 * held[f'{name}_rms_m']:.2f} mm" for name in ("unmoved", "in_proportion"))
        told.append(f"Without a model: {still} if nothing moved, {shared} if each particle went its share of the way.")
    if found["suggestion"] is not None:
        told.append(_next(found["suggestion"]))
    if not found["noise"]["still_frames"]:
        told.append(
            f"There are no still frames: noise of {1e3 * found['noise']['sd_m']:.2g} mm, and as much that neighbours "
            "share, was assumed."
        )
    if left_out := found["frames"]["left_out"]:
        told.append(
            f"{len(left_out)} frames of {len(left_out) + found['frames']['used']} are left out: what is held is seen "
            "there in another shape than when the jaws closed on it, so that they are not followed right."
        )
    return told


def _next(suggestion: Mapping[str, Any]) -> str:
    grasp, pull = (" ".join(f"{1e3 * one:.0f}" for one in suggestion[key]) for key in ("grasp_m", "pull_m"))
    between = " and ".join(suggestion["between"])
    expected = f"{suggestion['expected_log_bayes_factor']:.0f} nat"
    if not suggestion["enough"]:
        return f"No pull that was tried tells {between} apart: the best is expected to say {expected}."
    return (
        f"To tell {between} apart: grasp at {grasp} mm, pull by {pull} mm, and hold for {suggestion['hold_s']:.0f} s; "
        f"that is expected to favour the right one by {expected}."
    )


def _size(value: float, sd: float, unit: str) -> str:
    """A parameter with its standard deviation, to the digits that it has; lengths and angles in thousandths."""
    if unit.partition("/")[0] in ("m", "rad"):
        value, sd, unit = 1e3 * value, 1e3 * sd, f"m{unit}"
    digits = max(0, 1 - int(np.floor(np.log10(sd)))) if sd > 0 else 3
    return f"{value:.{digits}f} ± {sd:.{digits}f} {unit}".strip()


TIMES, LOCALISED = ("before", "after"), ("localisation", "localisation_after")


def write_page(path: Path, *, name: str, sheet: Sheet, found: Mapping[str, Any]) -> None:
    """Write it; the same input gives the same bytes.

    Raises:
        OutputError: the file cannot be written.
    """
    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    templates = files(__package__) / "templates"
    pictures = _pictures(sheet, found).to_html(full_html=False, include_plotlyjs=True, div_id="discrepancy")
    text = page.from_string((templates / "discrepancy.html").read_text()).render(
        name=name,
        style=Markup((templates / "report.css").read_text()),
        verdict=found["verdict"],
        sentences=story(found),
        pictures=Markup(pictures),
        detections=[(when, found[f"detection_{when}"]) for when in TIMES if found[f"detection_{when}"] is not None],
        share=lambda value: "-" if value is None else f"{value:.2f}",
    )
    try:
        path.write_text(text)
    except OSError as failure:
        raise OutputError(f"{path} cannot be written ({failure.strerror}); give another folder.") from failure


def _pictures(sheet: Sheet, found: Mapping[str, Any]) -> go.Figure:
    figure = make_subplots(
        rows=3,
        cols=2,
        subplot_titles=(
            "mean miss on the sheet, before [mm]; ringed: found attached",
            "after [mm]",
            "log Bayes factor, one step from the fit [nat]",
            "what the miss goes with (rank correlation), before and after",
            "miss of each fitted frame [mm]",
            "parts left out of the fit, then one that chose no effect [mm]",
        ),
        vertical_spacing=0.1,
    )
    flat = plane_of(sheet.rest).flatten(sheet.rest)
    misses = {
        when: 1e3
        * np.array(
            [np.nan if one is None else np.linalg.norm(one) for one in found[key]["particles"]["mean_residual_m"]]
        )
        for when, key in zip(TIMES, LOCALISED, strict=True)
    }
    most = float(np.nanmax([np.nanmax(miss) for miss in misses.values()]))
    for column, (miss, key) in enumerate(zip(misses.values(), LOCALISED, strict=True), 1):
        marker = {"color": miss, "cmin": 0, "cmax": most, "colorscale": "Viridis", "showscale": column == 2, "size": 9}
        marker["colorbar"] = {"len": 0.28, "y": 0.87}
        marker["line"] = {"color": RING, "width": [2.5 if one else 0 for one in found[key]["particles"]["attached"]]}
        dots = go.Scatter(x=1e3 * flat[:, 0], y=1e3 * flat[:, 1], mode="markers", marker=marker, showlegend=False)
        figure.add_trace(dots, row=1, col=column)
        figure.update_yaxes(scaleanchor=f"x{'' if column == 1 else column}", row=1, col=column)
    likely = found["scores"][:SHOWN][::-1]
    bars = go.Bar(x=[one["log_bayes_factor"] for one in likely], y=[one["name"] for one in likely], orientation="h",
                  marker={"color": BEFORE}, showlegend=False)  # fmt: skip
    figure.add_trace(bars, row=2, col=1)
    for when, key, colour in zip(TIMES, LOCALISED, (BEFORE, AFTER), strict=True):
        goes = {name: value for name, value in found[key]["correlates_with"].items() if value is not None}
        figure.add_trace(
            go.Bar(x=[*goes.values()], y=[*goes], orientation="h", marker={"color": colour}, name=when), row=2, col=2
        )
        frames = found[key]["frames"]
        misses_mm = [None if one["rms_m"] is None else 1e3 * one["rms_m"] for one in frames]
        line = go.Scatter(x=[one["index"] for one in frames], y=misses_mm, mode="lines+markers", name=when,
                          marker={"color": colour}, showlegend=False)  # fmt: skip
        figure.add_trace(line, row=3, col=1)
        held = [one[f"{when}_rms_m"] for one in found["held_out"]["folds"]] + [found["held_out"][f"{when}_rms_m"]]
        labels = [f"left out {k + 1}" for k in range(len(held) - 1)] + ["chose no effect"]
        bars = go.Bar(x=labels, y=[None if one is None else 1e3 * one for one in held], marker={"color": colour},
                      name=when, showlegend=False)  # fmt: skip
        figure.add_trace(bars, row=3, col=2)
    figure.update_layout(
        legend={"orientation": "h", "x": 0.62, "y": 0.685, "traceorder": "normal"},
        height=1250,
        template="plotly_white",
        barmode="group",
        margin={"l": 40, "r": 20},
    )
    return figure
