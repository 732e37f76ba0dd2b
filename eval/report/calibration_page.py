"""The result of simulation-based calibration as one page that needs no network: sentences first, then plots."""

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from plotly.subplots import make_subplots

from jiggle_mj.recording.output_files import write_text

from ..metrics.calibration_summary import METHODS, REFERENCES, ReferenceSummary, headline
from ..metrics.rank_statistics import DRAWS, RankStatistics

PAGE = "calibration.html"
COLOURS = {"draws": "#0072b2", "belief": "#d55e00"}
"""Colours of the two posteriors."""
BAND = "rgba(120, 130, 140, 0.25)"
"""Colour of what a right posterior gives."""
ROW_HEIGHT = 190
"""Height of a row of plots [px]."""


def write_calibration_page(path: Path, summaries: Sequence[ReferenceSummary]) -> None:
    """Write the page; the same input gives the same bytes.

    Raises:
        OutputError: the file cannot be written.
    """
    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    templates = files("jiggle_mj.eval.report") / "templates"
    sections = [
        {
            "name": REFERENCES.get(summary.name, summary.name),
            "count": summary.count,
            "sentences": summary.sentences(),
            "plots": Markup(
                _plots(summary).to_html(full_html=False, include_plotlyjs=index == 0, div_id=f"plots-{summary.name}")
            ),
        }
        for index, summary in enumerate(summaries)
    ]
    text = page.from_string((templates / "calibration.html").read_text()).render(
        style=Markup((templates / "report.css").read_text()), headline=headline(summaries), sections=sections
    )
    write_text(path, text)


def _plots(summary: ReferenceSummary) -> go.Figure:
    """Return a row for each quantity, its histogram and its distribution function, and a last one for P(attached)."""
    names = list(dict.fromkeys(name for by_name in summary.ranks.values() for name in by_name))
    titles = [f"{name}: {what}" for name in names for what in ("ranks", "share up to a rank, less uniform")]
    titles += ["P(attached) less share attached, with one sd", "particles with that P(attached)"]
    rows = len(names) + 1
    figure = make_subplots(rows=rows, cols=2, subplot_titles=titles, vertical_spacing=0.35 / rows)
    for row, name in enumerate(names, start=1):
        for index, (method, by_name) in enumerate(summary.ranks.items()):
            if name in by_name:
                _add_ranks(figure, by_name[name], row, method, with_band=index == 0)
    _add_reliability(figure, summary, rows)
    figure.update_layout(
        height=ROW_HEIGHT * rows,
        template="plotly_white",
        barmode="group",
        legend={"orientation": "h", "y": 1.03},
        margin={"l": 50, "r": 20, "t": 60},
    )
    return figure


def _add_ranks(figure: go.Figure, stats: RankStatistics, row: int, method: str, *, with_band: bool) -> None:
    """Add the ranks of a quantity in one posterior; with the bands, which depend on the number of draws alone."""
    bins, points = len(stats.histogram), (np.arange(DRAWS + 1) + 0.5).tolist()
    if with_band:
        low, high = stats.band
        figure.add_trace(_region([-0.5, DRAWS + 0.5], [low, low], [high, high]), row=row, col=1)
        figure.add_trace(_region(points, *stats.curve_band), row=row, col=2)
    centres = ((np.arange(bins) + 0.5) * (DRAWS + 1) / bins - 0.5).tolist()
    colour, shown = COLOURS[method], row == 1
    bars = go.Bar(x=centres, y=list(stats.histogram), marker={"color": colour}, name=METHODS[method],
                  legendgroup=method, showlegend=shown)  # fmt: skip
    figure.add_trace(bars, row=row, col=1)
    curve = go.Scatter(x=points, y=list(stats.deviation), line={"color": colour, "shape": "hv"}, legendgroup=method,
                       name=METHODS[method], showlegend=False)  # fmt: skip
    figure.add_trace(curve, row=row, col=2)


def _region(x: Sequence[float], low: Sequence[float], high: Sequence[float]) -> go.Scatter:
    """Return the filled region between two curves."""
    return go.Scatter(x=[*x, *x[::-1]], y=[*low, *high[::-1]], fill="toself", fillcolor=BAND, mode="lines",
                      line={"width": 0}, hoverinfo="skip", showlegend=False)  # fmt: skip


def _add_reliability(figure: go.Figure, summary: ReferenceSummary, row: int) -> None:
    bins = [each.bin for each in summary.reliability]
    middle = [each.predicted for each in bins]
    excess = [each.predicted - each.attached for each in bins]
    error = {"type": "data", "array": [each.sd for each in summary.reliability]}
    dots = go.Scatter(x=middle, y=excess, error_y=error, mode="markers", marker={"color": COLOURS["belief"]},
                      showlegend=False)  # fmt: skip
    figure.add_trace(dots, row=row, col=1)
    bars = go.Bar(x=middle, y=[each.count for each in bins], marker={"color": COLOURS["belief"]}, showlegend=False)
    figure.add_trace(bars, row=row, col=2)
    figure.update_yaxes(type="log", row=row, col=2)
