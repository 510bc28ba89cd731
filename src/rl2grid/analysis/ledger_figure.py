"""The ledger of test results as a figure: a task's configurations by what they survive."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter

from rl2grid.analysis.figures import wrapped_label
from rl2grid.analysis.ledger_table import LedgerRow, present_rows
from rl2grid.drawing.theme import LIGHT, Theme, style
from rl2grid.envs.tasks import short_id
from rl2grid.records.ledger import HashedTest
from rl2grid.records.statistics import estimate


def draw_ledger(results: Mapping[str, HashedTest], task: str, *, theme: Theme = LIGHT) -> Figure:
    """Survival on the test months with 95% intervals, a line per configuration, the longest-lived on top.

    Args:
        results: of a ledger.
        task: id of the task.
        theme: of the figure.

    Raises:
        ValueError: the ledger has no result of the task.
    """
    rows = present_rows(results, task)
    if not rows:
        raise ValueError(f"The ledger has no result of {task}.")
    found = sorted(((estimate(row.scores("survival")), row) for row in rows), key=lambda one: one[0].value)
    names = [wrapped_label(_name(row)) for _, row in found]
    height = 0.44 if any("\n" in name for name in names) else 0.32
    # Letters that can be read on a phone, where the figure is three inches wide.
    letters = dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "axes.labelsize", "legend.fontsize"), 10.5)
    with matplotlib.rc_context({**style(theme), **letters}):
        figure = Figure(figsize=(6.2, 1.3 + height * len(rows)), layout="constrained")
        axes = figure.subplots()
        for place, (survival, row) in enumerate(found):
            colour = theme.series[int(row.first.has_learned)]
            axes.plot([survival.low, survival.high], [place, place], color=colour, linewidth=2, alpha=0.55)
            axes.plot(survival.value, place, marker="o", color=colour, markersize=6)
            if row.first.training and len(row.results) > 1:
                each = [one.test["survival"] for one in row.results]
                axes.plot(each, [place] * len(each), linestyle="", marker="|", color=colour, markersize=9)
        axes.set_yticks(range(len(found)), names)
        axes.set(xlim=(0, 1.01), ylim=(-0.6, len(found) - 0.4), xlabel="Share of the month survived")
        axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        axes.grid(axis="x")
        axes.set_title(f"{short_id(task)}, test months", loc="left")
        if any(row.first.has_learned for row in rows):
            # Below the axes, where it covers no result.
            figure.legend(handles=_legend(theme), loc="outside lower center", ncols=2, frameon=False)
    return figure


def _name(row: LedgerRow) -> str:
    if not row.first.training:
        return row.first.label
    seeds = f", {len(row.results)} seeds" if len(row.results) > 1 else ""
    return f"{row.label} ({row.first.training['decisions']:,} decisions{seeds})"


def _legend(theme: Theme) -> list[Line2D]:
    untrained, trained, *_ = theme.series
    return [
        Line2D([], [], color=untrained, marker="o", label="without training"),
        Line2D([], [], color=trained, marker="o", label="trained (ticks: each seed)"),
    ]
