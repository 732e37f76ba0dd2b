"""The page of curves of the study of policies: entropy and true energy against steps."""

from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from .active_table import STEPS, Courses, with_best
from .figures import value

PAGE = "active.html"
COLOURS = ("#d55e00", "#cc79a7", "#0072b2", "#56b4e9", "#009e73", "#e69f00")
"""Colours of the policies: the palette of Okabe and Ito, for every common colour vision."""
ROW_HEIGHT = 330
"""Height of a scene's row [px]."""


def write_curves(runs: Courses, path: Path) -> None:
    """Write the page: a row for each scene, a colour for each policy; thin lines are single runs.

    The same input gives the same bytes.
    """
    runs = with_best(runs)
    scenes = list(dict.fromkeys(cell.scene for cell in runs))
    titles = [f"{scene}: {what}" for scene in scenes for what in ("entropy fallen [nat]", "mean boundary energy [J]")]
    figure = make_subplots(rows=len(scenes), cols=2, subplot_titles=titles, vertical_spacing=0.3 / len(scenes) / 2)
    colours = dict(zip(dict.fromkeys(cell.policy for cell in runs), COLOURS, strict=False))
    step = np.arange(STEPS + 1)
    for scene, policy in dict.fromkeys((cell.scene, cell.policy) for cell in runs):
        colour, row = colours[policy], 1 + scenes.index(scene)
        chosen = [run for cell, run in runs.items() if (cell.scene, cell.policy) == (scene, policy)]
        curves = [run.entropy_reduction for run in chosen], [run.loads.energy for run in chosen]
        for column, lines in enumerate(curves, start=1):
            for values in lines:
                line = go.Scatter(x=step, y=values, line={"color": colour, "width": 0.7}, opacity=0.5, showlegend=False)
                figure.add_trace(line, row=row, col=column)
            first = row == column == 1
            mean = go.Scatter(x=step, y=np.mean(lines, axis=0), line={"color": colour, "width": 2.5}, name=policy,
                              legendgroup=policy, showlegend=first)  # fmt: skip
            figure.add_trace(mean, row=row, col=column)
        figure.update_yaxes(type="log", row=row, col=2)
    for row, scene in enumerate(scenes, start=1):
        allowed = value(next(run for cell, run in runs.items() if cell.scene == scene).result, ("safety", "limit_j"))
        limit = go.Scatter(x=step[[0, -1]], y=[allowed] * 2, line={"dash": "dot", "color": "black"},
                           name="limit", showlegend=row == 1)  # fmt: skip
        figure.add_trace(limit, row=row, col=2)
    figure.update_layout(height=ROW_HEIGHT * len(scenes), template="plotly_white", title="Policies, step by step")
    figure.write_html(path, include_plotlyjs=True, div_id="active")
