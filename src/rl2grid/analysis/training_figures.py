"""Figures over training: operational scores (paper, Section 5), and costs against their thresholds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, PercentFormatter

from rl2grid.analysis import figures
from rl2grid.analysis.curves import leading_curves, training_lines
from rl2grid.drawing.theme import LIGHT, VERMILLION, Theme, style
from rl2grid.mdp.constraint_table import CONSTRAINTS
from rl2grid.records.metrics import SURVIVAL
from rl2grid.records.trainings import TrainingCurve


class Panel(NamedTuple):
    """One metric over training."""

    metric: str
    title: str
    threshold: float | None = None
    """Of a cost."""


SURVIVAL_PANELS = (Panel(SURVIVAL, "Share of the episode survived"),)
SCORE_PANELS = (
    Panel("charts/score_margin", "Margin (higher: more room)"),
    Panel("charts/score_overload", "Overload (0: none)"),
    Panel("charts/score_topology", "Topology (0: reference)"),
)
COST_PANELS = (
    Panel(SURVIVAL, "Survival"),
    *(
        Panel(f"charts/{each.column}", f"{each.name} cost of an episode", each.threshold)
        for each in CONSTRAINTS.values()
    ),
)

Curves = Mapping[str, Sequence[TrainingCurve]]
"""By label."""


def logs(curves: Curves, panels: Sequence[Panel]) -> bool:
    """Whether some run logged every metric of the panels."""
    runs = [run for group in curves.values() for run in group]
    return all(any(panel.metric in run.metrics for run in runs) for panel in panels)


def draw_panels(
    curves: Curves, panels: Sequence[Panel], *, title: str, x: str = "decisions", theme: Theme = LIGHT
) -> Figure:
    """Metrics of training episodes side by side; red: the threshold of a cost.

    Args:
        curves: by label.
        panels: such as :data:`SCORE_PANELS`.
        title: of the figure.
        x: ``"decisions"`` or ``"grid_steps"``.
        theme: colours.
    """
    shown, of_all = leading_curves([run for group in curves.values() for run in group])
    with matplotlib.rc_context(style(theme)):
        figure = Figure(figsize=(3.0 * len(panels), 3.5), layout="constrained")
        grid = list(figure.subplots(1, len(panels), squeeze=False)[0])
        for axes, panel in zip(grid, panels, strict=True):
            figures.draw_metric(axes, training_lines(shown, panel.metric, x=x), x=x, theme=theme)
            axes.yaxis.set_major_formatter(FuncFormatter(_signed_thousands))
            if panel.metric == SURVIVAL:
                axes.set_ylim(0, 1.03)
                axes.yaxis.set_major_formatter(PercentFormatter(1.0))
            if panel.threshold is not None:
                axes.axhline(panel.threshold, color=VERMILLION, linewidth=1.4, linestyle=(0, (4, 2)))
                axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
            axes.annotate(
                panel.title, (0, 1), xycoords="axes fraction", xytext=(0, 4), textcoords="offset points", fontsize=8
            )
        figures.headline_of_panels(figure, title, of_all + figures.training_sentence(shown, "training episodes"))
        handles, labels = grid[0].get_legend_handles_labels()
        columns = figures.legend_columns(labels, figure.get_figwidth())
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    return figure


def _signed_thousands(value: float, place: int | None) -> str:
    return f"-{figures._thousands(-value, place)}" if value < 0 else figures._thousands(value, place)
