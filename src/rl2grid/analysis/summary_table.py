"""The summaries of several agents on one task, side by side: for the terminal, and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rl2grid.analysis.table import Cell, Column, ResultTable, markdown_row, share_text, with_interval
from rl2grid.records.statistics import Estimate
from rl2grid.records.summary import Summary

HEADINGS: tuple[str, ...] = (
    "agent",
    "heuristic",
    "episodes",
    "survival",
    "IQM survival",
    "completed",
    "return",
    "LSI cost",
    "safe LSI",
    "TLO cost",
    "safe TLO",
    "margin",
    "overload",
    "topology",
    "operating cost",
)
N_LABELS = 2
"""Leading columns that hold words."""

LEGEND = (
    "Means per episode with 95% intervals over months alone: one policy says nothing of other trainings. Survival: "
    "share of the episode survived; "
    "IQM: interquartile mean. Safe: cost within the threshold and episode completed. "
    "Margin, overload, topology: the operational scores, means per step. Operating cost: losses, redispatch, "
    "curtailment, storage and blackout at the prices of L2RPN 2020."
)


def table_cells(summary: Summary) -> list[str]:
    """The cells of one agent, under :data:`HEADINGS`."""
    return [
        _with_mark(summary.agent, summary),
        summary.heuristic,
        str(summary.episodes),
        with_interval(summary.survival, 3),
        with_interval(summary.survival_iqm, 3),
        share_text(summary.completed),
        _number(summary.episode_return),
        _number(summary.cost_lsi),
        share_text(summary.safe_lsi),
        _number(summary.cost_tlo),
        share_text(summary.safe_tlo),
        _number(summary.score_margin),
        _number(summary.score_overload),
        _number(summary.score_topology),
        _number(summary.cost_operation),
    ]


def summary_table(summaries: Sequence[Summary]) -> ResultTable:
    """The columns that fit 80 characters, intervals below their values; the best survival is bold.

    "Done" is the share of episodes completed.
    """
    columns = {
        "survival": "survival",
        "completed": "done",
        "return": "return",
        "LSI cost": "LSI cost",
        "safe LSI": "safe LSI",
        "TLO cost": "TLO cost",
        "safe TLO": "safe TLO",
    }
    rows = []
    for summary in summaries:
        cells = dict(zip(HEADINGS, table_cells(summary), strict=True))
        best = is_best(summary, summaries)
        rows.append(
            (
                Cell(agent_words(summary), best=best),
                *(Cell(cells[name], best=best) for name in columns),
            )
        )
    return ResultTable("summaries", "", (Column("agent", words=True), *map(Column, columns.values())), tuple(rows))


def agent_words(summary: Summary) -> str:
    """The agent with the heuristic that it played with, as "PPO + idle", and whether it knew the future."""
    words = summary.agent if summary.heuristic == "none" else f"{summary.agent} + {summary.heuristic}"
    return _with_mark(words, summary)


def markdown_table(summaries: Sequence[Summary]) -> str:
    """A Markdown table with every column; the best survival is bold."""
    lines = [markdown_row(HEADINGS), markdown_row([":--" if k < N_LABELS else "--:" for k in range(len(HEADINGS))])]
    for summary in summaries:
        cells = table_cells(summary)
        survival = HEADINGS.index("survival")
        if is_best(summary, summaries):
            cells[survival] = f"**{cells[survival]}**"
        lines.append(markdown_row(cells))
    return "\n".join(lines) + "\n"


def is_best(summary: Summary, summaries: Sequence[Summary]) -> bool:
    """Whether no other agent survives longer on average; of one agent alone, nobody is best.

    Who knows the future is not ranked: what it survives is a bound.
    """
    ranked = [other.survival.value for other in summaries if not other.foresight]
    return not summary.foresight and len(ranked) > 1 and summary.survival.value == max(ranked)


def _with_mark(words: str, summary: Summary) -> str:
    return f"{words} (with foresight)" if summary.foresight else words


def _number(estimate: Estimate) -> str:
    """Three significant digits, thousands separated."""
    value = estimate.value
    if math.isnan(value):
        return "-"
    if value == 0:
        return "0"
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}"
