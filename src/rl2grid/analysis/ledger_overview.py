"""The ledger of test results at a glance: the best of each kind of agent on every task that was played."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rl2grid.analysis.ledger_table import LedgerRow, ledger_rows
from rl2grid.analysis.table import highlighted, markdown_row
from rl2grid.envs.tasks import all_tasks, short_id
from rl2grid.records.ledger import HashedTest
from rl2grid.records.looks import by_present_rules
from rl2grid.records.statistics import aggregated

KINDS = ("do nothing", "search and rules", "planner", "learned")
"""What agents are told apart by: nothing is ever done; no training, but a model of the grid or a rule; sequences of
actions on forecasts; learned."""
DO_NOTHING, PLANNER, PLANNER_OPEN = "do-nothing", "planner", "planner-open"
PLANNERS = (PLANNER, PLANNER_OPEN, "rehearsal")
"""Agents of the third kind; cells name those that are not called like it."""
USUAL_MONTHS = 500
"""Of the test list; a cell says the number where fewer were played."""


def overview_table(results: Mapping[str, HashedTest]) -> str:
    """The highest mean survival of each kind of agent, as Markdown, a row per task; the best of a row is bold.

    Args:
        results: of a ledger.
    """
    lines = [markdown_row(["task", *KINDS]), "|:--|" + ":--|" * len(KINDS)]
    for task, rows in by_task(results).items():
        best = [best_row([row for row in rows if kind_of(row.first) == kind]) for kind in KINDS]
        highest = max(survival_of(row) for row in best if row is not None)
        lines.append(markdown_row([short_id(task), *(_cell(row, highest) for row in best)]))
    return "\n".join(lines)


def by_task(results: Mapping[str, HashedTest]) -> dict[str, list[LedgerRow]]:
    """The rows by present rules of every task, tasks in the order of their registration."""
    found: dict[str, list[LedgerRow]] = {}
    for row in ledger_rows(by_present_rules(results), results):
        found.setdefault(row.first.task, []).append(row)
    order = {task: place for place, task in enumerate(all_tasks())}
    return {task: found[task] for task in sorted(found, key=lambda one: order.get(one, len(order)))}


def kind_of(result: HashedTest) -> str:
    """Which of :data:`KINDS` played."""
    if result.has_learned:
        return "learned"
    if result.agent in PLANNERS:
        return "planner"
    return "do nothing" if result.label == DO_NOTHING else "search and rules"


def best_row(rows: Sequence[LedgerRow]) -> LedgerRow | None:
    """The row of the highest mean survival; None: there is no row."""
    return max(rows, key=survival_of, default=None)


def survival_of(row: LedgerRow) -> float:
    """Mean survival, over trainings and months."""
    return aggregated(row.scores("survival"))


def _cell(row: LedgerRow | None, highest: float) -> str:
    if row is None:
        return ""
    label = "" if row.first.label in (DO_NOTHING, PLANNER) else row.first.label
    return survival_cell(row, highest, label, remarks_on(row))


def survival_cell(row: LedgerRow, highest: float, label: str, remarks: Sequence[str]) -> str:
    """Mean survival, bold if it is the highest of its line, who it is, and remarks in brackets."""
    shown = highlighted(f"{survival_of(row):.3f}", survival_of(row) == highest)
    return " ".join([shown, *([label] if label else []), *([f"({', '.join(remarks)})"] if remarks else [])])


def remarks_on(row: LedgerRow) -> list[str]:
    """How many trainings, and how many months where these are not all of the list."""
    number, months = len(row.results), int(row.first.months["number"])
    trainings = [f"{number} training{'s' if number > 1 else ''}"] if row.first.training else []
    return [*trainings, *([f"{months} months"] if months != USUAL_MONTHS else [])]
