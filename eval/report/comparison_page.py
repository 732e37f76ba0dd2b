"""What close-loop found in several recordings as one page that needs no network: sentences, tables, then pictures."""

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from plotly.subplots import make_subplots

from jiggle_mj.recording.output_files import write_text

from .discrepancy_page import AFTER, BEFORE, TRIVIAL, WITHOUT_MODEL, sizes_with_sd, title_of
from .joint_section import joint_rows, joint_sentences

ERRORS = {
    "before_rms_m": ("before", BEFORE),
    "after_rms_m": ("after", AFTER),
    "with_remainder_rms_m": ("with the remainder", "black"),
    "unmoved_rms_m": (TRIVIAL["unmoved"], "#666666"),
    "last_frame_rms_m": (TRIVIAL["last_frame"], WITHOUT_MODEL),
    "in_proportion_rms_m": (TRIVIAL["in_proportion"], "#cccccc"),
}
"""Keys of `held_out`, each with its words and its colour."""
PANEL_HEIGHT, ROW_HEIGHT = 160, 18
"""Height of a picture without its rows, and of each recording in it [px]."""
SHOWN_HYPOTHESES, MIN_PROBABILITY = 4, 0.01
"""Most hypotheses of a recording that are listed, and the probability from which they are."""
MISSING = "\N{EN DASH}"
"""Cell without a figure."""


def summary_sentences(results: Mapping[str, Any]) -> list[str]:
    """Return what several recordings show together, in sentences, from the content of results.json."""
    rows, effects = results["recordings"], results["effects"]
    done = [row for row in rows if row["failed"] is None]
    naming = sum(bool(row["effects"]) for row in done)
    sentences = [f"{naming} of {len(done)} recordings name an effect."]
    if failed := [row["name"] for row in rows if row["failed"] is not None]:
        sentences.append(f"{len(failed)} of {len(rows)} failed: {', '.join(failed)}.")
    for effect in effects:
        sentences.append(f"{effect['name']} is added in {len(effect['found'])} of {len(done)}{_agreement(effect)}.")
        if len(effect["found"]) > 1 and effect["this_session_alone"]:
            sentences.append(
                f"{effect['name']} belongs to the tool, camera or tracker: it may differ between sessions."
            )
    for row in done:
        if trivial := _better_trivial(row["held_out"]):
            sentences.append(f"{row['name']}: that {trivial} predicts the held-out part better than the model does.")
    return sentences


def write_comparison(path: Path, results: Mapping[str, Any], joint: Mapping[str, Any] | None = None) -> None:
    """Write the page; the same input gives the same bytes.

    Args:
        path: the page.
        results: content of results.json.
        joint: content of joint.json, where the recordings were fitted together.

    Raises:
        OutputError: the file cannot be written.
    """
    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    templates = files("jiggle_mj.eval.report") / "templates"
    done = [row for row in results["recordings"] if row["failed"] is None]
    pictures = _pictures(done, results["effects"]).to_html(full_html=False, include_plotlyjs=True, div_id="comparison")
    text = page.from_string((templates / "comparison.html").read_text()).render(
        style=Markup((templates / "report.css").read_text()),
        sentences=summary_sentences(results),
        errors=[words for words, _ in ERRORS.values()],
        hypotheses={row["name"]: _likeliest(row["posterior"]) for row in done},
        rows=[(row, _error_cells(row)) for row in results["recordings"]],
        effects=results["effects"],
        sizes=[(row["name"], [_size_cell(row["name"], effect) for effect in results["effects"]]) for row in done],
        together=[_common_cell(effect) for effect in results["effects"]],
        joint=joint,
        joint_sentences=[] if joint is None else joint_sentences(joint),
        joint_rows=[] if joint is None else joint_rows(joint),
        pictures=Markup(pictures) if done else "",
    )
    write_text(path, text)


def _agreement(effect: Mapping[str, Any]) -> str:
    """Return whether an effect's sizes agree, as the end of a sentence."""
    if len(effect["found"]) < 2:
        return ""
    if not effect["same_site"]:
        return ", at different sites, so that its sizes are not compared"
    if effect["agree"] is None:
        return "; its sizes have no standard deviation to compare them by"
    return (
        f"; its sizes {'agree' if effect['agree'] else 'differ'} (p = {effect['p_value']:.2g}): {_common_cell(effect)}"
    )


def _better_trivial(held_out: Mapping[str, Any]) -> str | None:
    """Return, in words, the trivial prediction that is best, if it is better than the model; else None."""
    ours, errors = (
        held_out["with_remainder_rms_m"],
        {words: held_out[f"{name}_rms_m"] for name, words in TRIVIAL.items()},
    )
    if ours is None or None in errors.values():
        return None
    best = min(errors, key=lambda words: errors[words])
    return best if errors[best] < ours else None


def _likeliest(posterior: Sequence[Mapping[str, Any]]) -> str:
    """Return the likeliest hypotheses with their probabilities, in words."""
    shown = [one for one in posterior[:SHOWN_HYPOTHESES] if one["probability"] >= MIN_PROBABILITY]
    return ", ".join(f"{title_of(one)} {one['probability']:.2f}" for one in shown)


def _error_cells(row: Mapping[str, Any]) -> list[str]:
    if row["failed"] is not None:
        return []
    errors = [row["held_out"][key] for key in ERRORS]
    return [MISSING if error is None else f"{1e3 * error:.2f}" for error in errors]


def _size_cell(recording: str, effect: Mapping[str, Any]) -> str:
    """Return an effect's size in a recording; that it is among those that are not distinguished; or nothing."""
    for found in effect["found"]:
        if found["recording"] == recording:
            site = "" if effect["same_site"] else f" at site {found['site']}"
            return sizes_with_sd(found["theta"], found["sd"], effect["units"]) + site
    return "not distinguished" if recording in effect["ambiguous_in"] else MISSING


def _common_cell(effect: Mapping[str, Any]) -> str:
    return MISSING if effect["mean"] is None else sizes_with_sd(effect["mean"], effect["mean_sd"], effect["units"])


def _pictures(rows: Sequence[Mapping[str, Any]], effects: Sequence[Mapping[str, Any]]) -> go.Figure:
    """Return a picture of the errors, then one for each parameter of an effect that several recordings have."""
    names = [row["name"] for row in rows]
    panels = [
        (effect, parameter)
        for effect in effects
        if len(effect["found"]) > 1 and effect["same_site"]
        for parameter in range(len(effect["units"]))
    ]
    titles = ["error of the part that chose no effect [mm]"]
    for effect, k in panels:
        units = effect["units"]
        titles.append(f"{effect['name']}, parameter {k + 1} of {len(units)} [{units[k] or '1'}], with one sd")
    figure = make_subplots(rows=len(titles), cols=1, subplot_titles=titles, vertical_spacing=0.35 / len(titles))
    for key, (words, colour) in ERRORS.items():
        errors = [row["held_out"][key] for row in rows]
        bars = go.Bar(x=[None if error is None else 1e3 * error for error in errors], y=names, orientation="h",
                      marker={"color": colour}, name=words)  # fmt: skip
        figure.add_trace(bars, row=1, col=1)
    for place, (effect, k) in enumerate(panels, start=2):
        found = effect["found"]
        dots = go.Scatter(
            x=[one["theta"][k] for one in found],
            y=[one["recording"] for one in found],
            error_x={"type": "data", "array": [one["sd"][k] for one in found]},
            mode="markers",
            marker={"color": AFTER},
            showlegend=False,
        )
        figure.add_trace(dots, row=place, col=1)
        if effect["mean"] is not None:
            figure.add_vline(effect["mean"][k], line={"color": WITHOUT_MODEL, "dash": "dot"}, row=place, col=1)  # pyright: ignore[reportArgumentType]
    figure.update_yaxes(autorange="reversed")
    figure.update_layout(
        height=len(titles) * (PANEL_HEIGHT + ROW_HEIGHT * len(names) * (len(ERRORS) if len(titles) == 1 else 2)),
        template="plotly_white",
        barmode="group",
        legend={"orientation": "h", "y": 1.04},
        margin={"l": 40, "r": 20},
    )
    return figure
