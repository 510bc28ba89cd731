"""What survives without learning: doing nothing, the heuristics alone, greedy search and plans, a row per task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rl2grid.analysis.ledger_overview import (
    DO_NOTHING,
    PLANNER,
    PLANNER_OPEN,
    best_row,
    by_task,
    remarks_on,
    survival_cell,
    survival_of,
)
from rl2grid.analysis.ledger_table import LedgerRow
from rl2grid.analysis.table import markdown_row
from rl2grid.envs.tasks import short_id
from rl2grid.records.ledger import HashedTest

ALONE: Mapping[str, str | None] = {"do nothing": None, "`recovery`": "recovery", "`careful`": "careful"}
"""Heuristics under which nobody acts: a grid has one value of each, as none of what its tasks offer is chosen."""
ACTING = {"greedy search": ("greedy",), "planner": (PLANNER, PLANNER_OPEN), "rehearsal": ("rehearsal",)}
"""Agents, of which each cell has the one, and the heuristic, that survives longest; it names all but the first."""

Milliseconds = Mapping[tuple[str, str, str | None], tuple[float, float]]
"""Within which half of the decisions are made and 99 of 100, by task (in short), agent and heuristic."""


def untrained_table(results: Mapping[str, HashedTest], milliseconds: Milliseconds | None = None) -> str:
    """Mean survival of who learns nothing, as Markdown; the best of a row is bold.

    Args:
        results: of a ledger.
        milliseconds: what decisions take, shown where it is known.
    """
    rows = by_task(results)
    columns = ["task", *ALONE, *ACTING]
    lines = [markdown_row(columns), "|" + ":--|" * len(columns)]
    for task, of_task in rows.items():
        of_grid = [row for other, found in rows.items() if _grid(other) == _grid(task) for row in found]
        cells = [_with_most_months(of_grid, heuristic) for heuristic in ALONE.values()]
        cells += [best_row([row for row in of_task if row.first.agent in agents]) for agents in ACTING.values()]
        highest = max((survival_of(row) for row in cells if row is not None), default=0.0)
        lines.append(markdown_row([short_id(task), *(_cell(row, highest, milliseconds or {}) for row in cells)]))
    return "\n".join(lines)


def _grid(task: str) -> str:
    return short_id(task).rpartition("-")[0]


def _with_most_months(rows: Sequence[LedgerRow], heuristic: str | None) -> LedgerRow | None:
    alone = [row for row in rows if row.first.agent == DO_NOTHING and row.first.heuristic == heuristic]
    return max(alone, key=lambda row: int(row.first.months["number"]), default=None)


def _cell(row: LedgerRow | None, highest: float, milliseconds: Milliseconds) -> str:
    if row is None:
        return ""
    test = row.first
    if test.agent == DO_NOTHING:  # its column says the heuristic, and it takes no time
        return survival_cell(row, highest, "", remarks_on(row))
    took = milliseconds.get((short_id(test.task), test.agent, test.heuristic))
    times = [] if took is None else [f"{took[0]:.2g}, {took[1]:.2g} ms"]
    named = [] if any(test.agent == agents[0] for agents in ACTING.values()) else [test.agent]
    label = ", ".join([*named, *([f"`{test.heuristic}`"] if test.heuristic else [])])
    return survival_cell(row, highest, label, [*times, *remarks_on(row)])
