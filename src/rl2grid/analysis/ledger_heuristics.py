"""The ledger of test results in the shape of the paper's Tables 2 and 3: agents, and the heuristics beside them."""

from __future__ import annotations

from collections.abc import Mapping

from rl2grid.analysis.ledger_overview import by_task, survival_of
from rl2grid.analysis.ledger_table import LedgerRow
from rl2grid.analysis.result_tables import HEURISTIC_LETTERS
from rl2grid.analysis.table import highlighted, markdown_row, with_interval
from rl2grid.envs.tasks import short_id
from rl2grid.records.ledger import HashedTest
from rl2grid.records.statistics import estimate

_NO_HEURISTIC = "none"


def heuristic_table(results: Mapping[str, HashedTest]) -> str:
    """Survival of every agent by the heuristic beside it, as Markdown, a row per task and agent.

    Cells have the interval and, of what was trained, the number of trainings. Where an agent has several rows of one
    heuristic, such as of other budgets, the one with most trainings is shown. The highest of what a task shows is bold.

    Args:
        results: of a ledger.
    """
    rows = by_task(results)
    played = {_heuristic(row) for of_task in rows.values() for row in of_task}
    heuristics = [name for name in HEURISTIC_LETTERS if name in played]
    headings = ["vanilla" if name == _NO_HEURISTIC else name for name in heuristics]
    lines = [markdown_row(["task", "agent", *headings]), "|:--|:--|" + "--:|" * len(headings)]
    for task, of_task in rows.items():
        shown: dict[tuple[str, str], LedgerRow] = {}
        for row in sorted(of_task, key=lambda one: -len(one.results)):
            shown.setdefault((row.first.player, _heuristic(row)), row)
        highest = max(survival_of(row) for row in shown.values())
        for agent in dict.fromkeys(row.first.player for row in of_task):
            cells = [_cell(shown.get((agent, name)), highest) for name in heuristics]
            lines.append(markdown_row([short_id(task), agent, *cells]))
    return "\n".join(lines)


def _heuristic(row: LedgerRow) -> str:
    return row.first.heuristic or _NO_HEURISTIC


def _cell(row: LedgerRow | None, highest: float) -> str:
    if row is None:
        return ""
    shown = highlighted(with_interval(estimate(row.scores("survival")), 3), survival_of(row) == highest)
    return f"{shown} ({len(row.results)})" if row.first.training else shown
