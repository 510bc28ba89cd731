"""What is left to gain on the test months: who knows what comes, beside the best of those who do not."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from rl2grid.analysis.ledger_overview import DO_NOTHING, KINDS, PLANNER, best_row, by_task, kind_of
from rl2grid.analysis.ledger_table import LedgerRow
from rl2grid.analysis.table import markdown_row
from rl2grid.arrays import F64
from rl2grid.envs.tasks import short_id
from rl2grid.errors import UsageError
from rl2grid.records.ledger import HashedTest
from rl2grid.records.month_values import common_months
from rl2grid.records.statistics import aggregated

_HEADINGS = ("task", "heuristic", "months", *KINDS, "with foresight", "anybody", "the planner reaches")


def headroom_table(results: Mapping[str, HashedTest], bounds: Mapping[str, HashedTest]) -> str:
    """Survival of the months that somebody with foresight played, as Markdown, a row per bound.

    Of each kind of agent that knows what an operator knows, the row that survives longest of all its months. *Anybody*
    takes each month from whoever survived it longest, trained or not, by whatever rules and heuristic: what was
    survived once can be.

    Args:
        results: of a ledger.
        bounds: of another one, whose agents know the future.

    Raises:
        UsageError: there are no bounds.
    """
    if not bounds:
        raise UsageError("There are no bounds: play some with 'python benchmarks/bounds.py play'.")
    rows = by_task(results)
    order = {task: place for place, task in enumerate(rows)}
    ordered = sorted(bounds.values(), key=lambda bound: order.get(bound.task, len(order)))
    lines = [markdown_row(_HEADINGS), "|:--|:--|" + "--:|" * (len(_HEADINGS) - 2)]
    return "\n".join([*lines, *(markdown_row(_cells(bound, rows.get(bound.task, ()), results)) for bound in ordered)])


def _cells(bound: HashedTest, rows: Sequence[LedgerRow], results: Mapping[str, HashedTest]) -> list[str]:
    months = int(bound.months["number"])
    comparable = [row for row in rows if common_months(bound.months, row.first.months) == months]
    best = {kind: best_row([row for row in comparable if kind_of(row.first) == kind]) for kind in KINDS}
    known = _survived(bound, months).mean()
    anybody = _longest([bound, *_others(bound, results)], months)
    planner = best["planner"]
    return [
        short_id(bound.task),
        f"`{bound.heuristic}`" if bound.heuristic else "",
        str(months),
        *("" if row is None else _named(row, months) for row in best.values()),
        f"{known:.3f}",
        f"**{anybody:.3f}**",
        "" if planner is None else f"{_survival(planner, months) / anybody:.0%}",
    ]


def _named(row: LedgerRow, months: int) -> str:
    """What it survives, and who it is where its column does not say that."""
    survival = f"{_survival(row, months):.3f}"
    is_told = row.first.label == DO_NOTHING or row.first.agent == PLANNER
    return survival if is_told else f"{survival} {row.label}"


def _others(bound: HashedTest, results: Mapping[str, HashedTest]) -> list[HashedTest]:
    """All that played the same months of the task, and maybe more."""
    months = int(bound.months["number"])
    same = [one for one in results.values() if one.task == bound.task]
    return [one for one in same if common_months(bound.months, one.months) == months]


def _survived(result: HashedTest, months: int) -> F64:
    return result.by_month["survival"][:months]


def _survival(row: LedgerRow, months: int) -> float:
    return aggregated(row.scores("survival", months))


def _longest(results: Iterable[HashedTest], months: int) -> float:
    """The mean over months of the longest that anybody survived each."""
    return float(np.max([_survived(one, months) for one in results], axis=0).mean())
