"""How much of what a policy that looks survives is the look: who looks and has learned nothing, beside who learned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rl2grid.analysis.ledger_learned import SEVERAL, trainings_text
from rl2grid.analysis.ledger_overview import by_task
from rl2grid.analysis.ledger_table import LedgerRow
from rl2grid.analysis.table import difference_cell, markdown_row, p_cell, with_interval
from rl2grid.envs.tasks import short_id
from rl2grid.errors import UsageError
from rl2grid.records.comparisons import paired_differences
from rl2grid.records.ledger import HashedTest, looking_of
from rl2grid.records.month_values import common_months
from rl2grid.records.statistics import estimate

_HEADINGS = ("task", "heuristic", "looking", "months", "learned nothing", "who learned", "survival", "gain", "p")


def looks_table(results: Mapping[str, HashedTest], beginnings: Mapping[str, HashedTest]) -> str:
    """What learning adds to a look, as Markdown: a row per configuration of several trainings that looks.

    It is compared with policies that have learned nothing, under the same heuristic, which look in the same way, on the
    months that both played; p-values are corrected after Holm over the rows of a task.

    Args:
        results: of a ledger.
        beginnings: of another one, whose policies look before their first update.

    Raises:
        UsageError: nobody who learned nothing has looked.
    """
    if not beginnings:
        raise UsageError(
            "Nobody who learned nothing has looked: play some with 'python benchmarks/look_alone.py play'."
        )
    rows = by_task(results)
    lines = [markdown_row(_HEADINGS), "|:--|:--|:--|--:|--:|:--|" + "--:|" * 3]
    for task, without in by_task(beginnings).items():
        pairs = [(base, row) for base in without for row in rows.get(task, ()) if _are_alike(base, row)]
        lines += [markdown_row(cells) for cells in _cells(pairs)]
    return "\n".join(lines)


def _are_alike(base: LedgerRow, row: LedgerRow) -> bool:
    """Whether a row of several trainings looks as the other does, on months that both played."""
    first, other = base.first, row.first
    return (
        len(row.results) >= SEVERAL
        and looking_of(first.configuration) == looking_of(other.configuration)
        and first.heuristic == other.heuristic
        and common_months(first.months, other.months) > 0
    )


def _cells(pairs: Sequence[tuple[LedgerRow, LedgerRow]]) -> list[list[str]]:
    if not pairs:
        return []
    months = min(common_months(base.first.months, row.first.months) for base, row in pairs)
    scores = [one.scores("survival", months) for pair in pairs for one in pair]
    differences = paired_differences(scores, [(2 * place + 1, 2 * place) for place in range(len(pairs))])
    return [
        [
            *_task_and_look(base.first),
            str(months),
            with_interval(estimate(base.scores("survival", months)), 3),
            _who(row),
            with_interval(estimate(row.scores("survival", months)), 3),
            difference_cell(difference).text,
            p_cell(difference).text,
        ]
        for (base, row), difference in zip(pairs, differences, strict=True)
    ]


def _task_and_look(result: HashedTest) -> tuple[str, str, str]:
    heuristic = f"`{result.heuristic}`" if result.heuristic else ""
    return short_id(result.task), heuristic, looking_of(result.configuration).removeprefix(", ")


def _who(row: LedgerRow) -> str:
    """Who learned, and by how many trainings."""
    return f"{row.first.policy}{row.told_by} ({trainings_text(row)})"
