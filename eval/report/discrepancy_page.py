"""The result of closing the loop as one page that needs no network: sentences first, then pictures."""

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from plotly.subplots import make_subplots

from jiggle_mj.estimate import Sheet
from jiggle_mj.recording.output_files import write_text

from ..metrics.flat_map import plane_of
from .explanation import explanation_figure, explanation_sentence

SHOWN_HYPOTHESES, LISTED = 10, 3
"""Most hypotheses in the picture of probabilities, whose height holds no more names, and in the sentence."""
BEFORE, AFTER, RING = "#d55e00", "#0072b2", "#e8000b"
"""Colours of the figures before and after, and of the ring around an attached particle."""
TIMES, LOCALISED = ("before", "after"), ("localisation", "localisation_after")
"""Keys of discrepancy.json for the two times."""
WITHOUT_MODEL = "#999999"
"""Colour of predictions without a model."""
TRIVIAL = {
    "unmoved": "nothing moves",
    "last_frame": "the last frame stays",
    "in_proportion": "each particle moves in proportion",
}
"""Predictions without a model, in words."""
PREDICTED = {"before": BEFORE, "after": AFTER, "last_frame": WITHOUT_MODEL, "with_remainder": "black"}
"""Colours of the predictions of each frame of the part that chose no effect, by their keys."""
PAGE_HEIGHT = 1250
"""Height of all pictures [px]."""
PERSISTENT = 0.5
"""Autocorrelation from which the page says that errors persist."""
VERDICTS = {
    "no-effect": "These frames show no missing effect.",
    "effect": "An effect is named, and it explains the residual.",
    "ambiguous": "An effect is found, but these frames do not distinguish it from others.",
    "effect-with-remainder": "An effect is named, and a part of the residual stays unexplained.",
    "unexplained": "There is a residual that no effect of the library explains.",
}
"""Sentence for each verdict."""


def story(found: Mapping[str, Any]) -> list[str]:
    """Return what was found, in sentences, from the content of discrepancy.json."""
    first = VERDICTS[found["verdict"]]
    if found["verdict"] == "ambiguous" and not found["ambiguous_with"]:
        first = "An effect is found, but these frames do not exclude that nothing is missing."
    sentences = [first, _posterior_sentence(found["posterior"])]
    for effect in found["effects"]:
        sizes = ", ".join(_size(*each) for each in zip(effect["theta"], effect["sd"], effect["units"], strict=True))
        sentences.append(f"Added: {effect['name']} ({sizes}), log Bayes factor {effect['log_bayes_factor']:.0f}.")
        if effect["this_session_alone"]:
            sentences.append(
                f"{effect['name']} belongs to the tool, camera or tracker, and holds for this session alone."
            )
        if rivals := effect["indistinguishable_from"]:
            sentences.append(f"These frames do not distinguish {effect['name']} from: {', '.join(rivals)}.")
    sentences += [f"Refused: {effect['name']}, because {effect['why']}." for effect in found["refused"]]
    if found["effects"]:
        uses = "" if found["attachments"]["why"] else "; estimate --declare corrected.toml uses it"
        sentences.append(f"The model with it is in corrected.toml{uses}.")
        sentences.append(_attachments_sentence(found))
    if found["explanation"]:
        sentences.append(explanation_sentence(found["explanation"][0], found["localisation"]["particles"]))
    sentences += _held_out_sentences(found)
    sentences.append(_stiffness_sentence(found["force"]))
    if found["suggestion"] is not None:
        sentences.append(_suggestion_sentence(found["suggestion"]))
    if not found["noise"]["still_frames"]:
        sentences.append(
            f"There are no still frames: noise of {1e3 * found['noise']['sd_m']:.2g} mm was assumed, and of "
            f"{1e3 * found['noise']['smooth_sd_m']:.2g} mm that neighbours share."
        )
    sentences += _persistence_sentences(found["noise"])
    if left_out := found["frames"]["left_out"]:
        sentences.append(
            f"{len(left_out)} frames of {len(left_out) + found['frames']['used']} are left out: the held tissue has "
            "another shape there than when the jaws closed on it, so its tracking is wrong there."
        )
    return sentences


def _persistence_sentences(noise: Mapping[str, Any]) -> list[str]:
    """Return how much the errors of a frame persist in the next one, if most of them do."""
    if not noise["autocorrelation"] > PERSISTENT:
        return []
    return [
        f"Errors persist, as where a tracker drifts: what points err by has a correlation of "
        f"{noise['autocorrelation']:.2g} from one frame to the next, some {1e3 * noise['step_sd_m']:.2g} mm of it are "
        f"new in each, and it is some {1e3 * noise['whole_sd_m']:.2g} mm by the last one."
    ]


def _posterior_sentence(posterior: list[Mapping[str, Any]]) -> str:
    """Return the probabilities of the likeliest hypotheses, and whether their errors are larger than usual."""
    shares = [f"{title_of(one)} {one['probability']:.2g}" for one in posterior[:LISTED]]
    larger = posterior[0]["larger_errors"]
    why = f" Its errors are larger than usual with a probability of {larger:.2g}: something without a name is missing."
    return f"Probability of what is missing: {', '.join(shares)}.{why if larger > 0.5 else ''}"


def title_of(hypothesis: Mapping[str, Any]) -> str:
    """Return the names of a hypothesis's effects as text."""
    return " and ".join(hypothesis["effects"]) or "nothing"


def _held_out_sentences(found: Mapping[str, Any]) -> list[str]:
    """Return the errors of held-out parts, and of the part that chose no effect."""
    held_out, sentences = found["held_out"], []
    if held_out["folds"] and found["effects"]:
        before, after = (np.sqrt(np.mean([fold[f"{when}_rms_m"] ** 2 for fold in held_out["folds"]])) for when in TIMES)
        sentences.append(f"Error of held-out parts: {1e3 * before:.2f} mm before, {1e3 * after:.2f} mm after.")
    if held_out["before_rms_m"] is None:
        return [
            *sentences,
            "There is only one grasp: nothing was held out, and effects that one grasp does not distinguish stay so.",
        ]
    numbers = f"{1e3 * held_out['before_rms_m']:.2f} mm"
    if found["effects"]:
        numbers += f" before, {1e3 * held_out['after_rms_m']:.2f} mm after"
    remainder, held = held_out["with_remainder_rms_m"], held_out["with_remainder_coverage_90"]
    trivial = {words: held_out[f"{name}_rms_m"] for name, words in TRIVIAL.items()}
    errors = [f"{1e3 * error:.2f} mm if {words}" for words, error in trivial.items()]
    sentences += [
        f"The last part chose no effect; predicted from the tool's reports alone, its error is {numbers}.",
        f"With a remainder without a name, learned from the parts before, it is {1e3 * remainder:.2f} mm, and 90 % "
        f"intervals hold {100 * held:.0f} %.",
        f"Without a model it is {', '.join(errors[:-1])}, and {errors[-1]}.",
    ]
    words, least = min(trivial.items(), key=lambda pair: pair[1])
    if least < remainder:
        sentences.append(f"That {words} predicts this part better than the model does: do not rely on its attachments.")
    return sentences


def _stiffness_sentence(force: Mapping[str, Any] | None) -> str:
    """Return whether stiffnesses are in N/m or relative, by the measured force of the tool."""
    relative = "Stiffnesses and weights are relative to the declared membrane stiffness"
    if force is None:
        return f"{relative}: no force on the tool was measured."
    if force["why_not"] is not None:
        return f"{relative}, and the measured force of the tool does not change that: {force['why_not']}"
    sd, errors = force["stiffness_factor_log_sd"], force["held_out_rms_n"]
    held_out = ""
    if errors["measured"] is not None:
        after, measured = 1e3 * errors["after"], 1e3 * errors["measured"]
        held_out = f" In the last part the force, of {measured:.3g} mN (RMS), is predicted to {after:.2g} mN."
    return (
        f"Stiffnesses are absolute, by the measured force of the tool: they are {force['stiffness_factor']:.3g} times "
        f"what is declared, within {100 * sd:.2g} %, and the membrane's is {force['membrane_stiffness_n_per_m']:.3g} "
        f"N/m.{held_out}"
    )


def _attachments_sentence(found: Mapping[str, Any]) -> str:
    """Return what the attachments after are from."""
    if found["attachments"]["from"] == "estimate":
        return "The attachments after are those of an estimate with it."
    why = found["attachments"]["why"] or "where a residual stays unexplained, it counts less than in an estimate"
    return f"The attachments after are those of the fit: {why.removesuffix('.')}."


def _suggestion_sentence(suggestion: Mapping[str, Any]) -> str:
    grasp, pull = (" ".join(f"{1e3 * part:.0f}" for part in suggestion[key]) for key in ("grasp_m", "pull_m"))
    between = " and ".join(suggestion["between"])
    expected = f"{suggestion['expected_log_bayes_factor']:.0f} nat"
    if not suggestion["enough"]:
        return f"No pull that was tried distinguishes {between}: the largest expected log Bayes factor is {expected}."
    return (
        f"To distinguish {between}: grasp at {grasp} mm, pull by {pull} mm, and hold for {suggestion['hold_s']:.0f} s; "
        f"the expected log Bayes factor is {expected}."
    )


def sizes_with_sd(values: Sequence[float], sds: Sequence[float], units: Sequence[str]) -> str:
    """Return parameters and their standard deviations as text."""
    return ", ".join(_size(*each) for each in zip(values, sds, units, strict=True))


def _size(value: float, sd: float, unit: str) -> str:
    """Return a parameter and its standard deviation as text; lengths and angles in thousandths of their unit."""
    if unit.partition("/")[0] in ("m", "rad"):
        value, sd, unit = 1e3 * value, 1e3 * sd, f"m{unit}"
    digits = max(0, 1 - int(np.floor(np.log10(sd)))) if sd > 0 else 3
    return f"{value:.{digits}f} ± {sd:.{digits}f} {unit}".strip()


def write_page(path: Path, *, name: str, sheet: Sheet, found: Mapping[str, Any]) -> None:
    """Write the page; the same input gives the same bytes.

    Raises:
        OutputError: the file cannot be written.
    """
    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    templates = files("jiggle_mj.eval.report") / "templates"
    pictures = _pictures(sheet, found).to_html(full_html=False, include_plotlyjs=True, div_id="discrepancy")
    text = page.from_string((templates / "discrepancy.html").read_text()).render(
        name=name,
        style=Markup((templates / "report.css").read_text()),
        verdict=found["verdict"],
        sentences=story(found),
        pictures=Markup(pictures),
        explained=[explanation_sentence(one, found["localisation"]["particles"]) for one in found["explanation"]],
        explanation=Markup(_explanation(sheet, found)),
        detections=[(when, found[f"detection_{when}"]) for when in TIMES if found[f"detection_{when}"] is not None],
        share=lambda value: "-" if value is None else f"{value:.2f}",
    )
    write_text(path, text)


def _explanation(sheet: Sheet, found: Mapping[str, Any]) -> str:
    """Return the pictures of the explanation as HTML; nothing where no hypothesis is explained."""
    if not found["explanation"]:
        return ""
    flat = plane_of(sheet.rest).flatten(sheet.rest)
    figure = explanation_figure(found["explanation"], flat, found["localisation"]["particles"])
    return figure.to_html(full_html=False, include_plotlyjs=False, div_id="explanation")


def _pictures(sheet: Sheet, found: Mapping[str, Any]) -> go.Figure:
    figure = make_subplots(
        rows=3,
        cols=2,
        subplot_titles=(
            "mean residual on the sheet, before [mm]; ringed: detected attached",
            "after [mm]",
            "probability of what is missing",
            "rank correlation of the residual, before and after",
            "residual of each frame [mm]; dotted: predicted from the tool's reports alone",
            "held-out parts, then the part that chose no effect [mm]",
        ),
        vertical_spacing=0.1,
    )
    flat = plane_of(sheet.rest).flatten(sheet.rest)
    residuals = [1e3 * _lengths(found[key]["particles"]["mean_residual_m"]) for key in LOCALISED]
    most = float(np.nanmax([np.nanmax(residual) for residual in residuals]))
    for column, (residual, key) in enumerate(zip(residuals, LOCALISED, strict=True), 1):
        marker = {
            "color": residual,
            "cmin": 0,
            "cmax": most,
            "colorscale": "Viridis",
            "showscale": column == 2,
            "size": 9,
        }
        marker["colorbar"] = {"len": 0.28, "y": 0.87}
        marker["line"] = {
            "color": RING,
            "width": [2.5 if attached else 0 for attached in found[key]["particles"]["attached"]],
        }
        dots = go.Scatter(x=1e3 * flat[:, 0], y=1e3 * flat[:, 1], mode="markers", marker=marker, showlegend=False)
        figure.add_trace(dots, row=1, col=column)
        figure.update_yaxes(scaleanchor=f"x{'' if column == 1 else column}", row=1, col=column)
    likely = found["posterior"][:SHOWN_HYPOTHESES][::-1]
    bars = go.Bar(x=[one["probability"] for one in likely], y=[title_of(one) for one in likely],
                  orientation="h", marker={"color": AFTER}, showlegend=False)  # fmt: skip
    figure.add_trace(bars, row=2, col=1)
    for when, key, colour in zip(TIMES, LOCALISED, (BEFORE, AFTER), strict=True):
        known = {name: value for name, value in found[key]["correlates_with"].items() if value is not None}
        bars = go.Bar(x=[*known.values()], y=[*known], orientation="h", marker={"color": colour}, name=when)
        figure.add_trace(bars, row=2, col=2)
        frames = found[key]["frames"]
        line = go.Scatter(x=[frame["index"] for frame in frames], y=[_in_mm(frame["rms_m"]) for frame in frames],
                          mode="lines+markers", name=when,
                          marker={"color": colour}, showlegend=False)  # fmt: skip
        figure.add_trace(line, row=3, col=1)
        errors = [fold[f"{when}_rms_m"] for fold in found["held_out"]["folds"]] + [found["held_out"][f"{when}_rms_m"]]
        labels = [f"held out {k + 1}" for k in range(len(errors) - 1)] + ["chose no effect"]
        bars = go.Bar(x=labels, y=[_in_mm(error) for error in errors], marker={"color": colour}, name=when,
                      showlegend=False)  # fmt: skip
        figure.add_trace(bars, row=3, col=2)
    for name, colour in PREDICTED.items():
        errors = [(frame["index"], _in_mm(frame[f"{name}_rms_m"])) for frame in found["held_out"]["frames"]]
        line = go.Scatter(x=[index for index, _ in errors], y=[error for _, error in errors], mode="lines",
                          name=TRIVIAL.get(name, name.replace("_", " ")), line={"color": colour, "dash": "dot"},
                          showlegend=name not in TIMES)  # fmt: skip
        figure.add_trace(line, row=3, col=1)
    if found["held_out"]["before_rms_m"] is not None:
        others = {"with the remainder": "with_remainder"} | {words: name for name, words in TRIVIAL.items()}
        bars = go.Bar(x=[*others], y=[_in_mm(found["held_out"][f"{name}_rms_m"]) for name in others.values()],
                      marker={"color": [AFTER] + [WITHOUT_MODEL] * len(TRIVIAL)}, showlegend=False)  # fmt: skip
        figure.add_trace(bars, row=3, col=2)
    figure.update_layout(
        legend={"orientation": "h", "x": 0.62, "y": 0.685, "traceorder": "normal"},
        height=PAGE_HEIGHT,
        template="plotly_white",
        barmode="group",
        margin={"l": 40, "r": 20},
    )
    return figure


def _in_mm(error: float | None) -> float | None:
    return None if error is None else 1e3 * error


def _lengths(vectors: list[list[float] | None]) -> Float[np.ndarray, " n"]:
    """Return the length of each vector; NaN where there is none."""
    return np.array([np.nan if vector is None else np.linalg.norm(vector) for vector in vectors])
