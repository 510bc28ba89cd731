"""What is left to gain: the survival of methods beside that of those who know the future."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from rl2grid.analysis.table import MISSING, Cell, Column, ResultTable, interval_cell
from rl2grid.envs.tasks import short_id
from rl2grid.records.methods import Method, interval_words
from rl2grid.records.statistics import estimate

_COLUMNS = (
    Column("Task", words=True),
    Column("Method", words=True),
    Column("Survival"),
    Column("Bound", words=True),
    Column("Its survival"),
    Column("Reached"),
)


def bounds_table(methods: Mapping[str, Sequence[Method]], bounds: Mapping[str, Sequence[Method]]) -> ResultTable:
    """Every method of a task beside every bound of it; who knows the future is in no other table.

    Args:
        methods: by task, each in the order of its ranking.
        bounds: methods with foresight, by task, at least one.
    """
    rows = [
        (Cell(short_id(task)), *row)
        for task, group in bounds.items()
        for bound in group
        for row in _rows(methods.get(task, ()), bound)
    ]
    everyone = [method for grouped in (methods, bounds) for group in grouped.values() for method in group]
    caption = (
        "What is left to gain: survival of each method, and in the same months of who steps saved true worlds, and so "
        "knows all attacks, outages and demand to come. It is ranked nowhere, and a lower bound of the best possible. "
        f"Reached: the share of it. {interval_words(everyone)}."
    )
    return ResultTable("foresight", caption, _COLUMNS, tuple(rows))


def _rows(methods: Sequence[Method], bound: Method) -> Iterator[tuple[Cell, ...]]:
    limit = (Cell(bound.label), interval_cell(estimate(bound.scores("survival"))))
    if not methods:
        yield MISSING, MISSING, *limit, MISSING
    for method in methods:
        reached = Cell(f"{method.survival / bound.survival:.0%}") if bound.survival else MISSING
        yield Cell(method.label), interval_cell(estimate(method.scores("survival"))), *limit, reached
