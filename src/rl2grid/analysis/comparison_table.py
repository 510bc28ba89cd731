"""Methods of one task compared in pairs: differences on the same months, corrected for the number of pairs."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from rl2grid.analysis.lifetimes import kaplan_meier, lifetimes
from rl2grid.analysis.table import MISSING, Cell, Column, ResultTable, difference_cell, interval_cell, p_cell
from rl2grid.envs.tasks import short_id
from rl2grid.records.comparisons import Difference, paired_differences, probability_of_improvement
from rl2grid.records.methods import Method, interval_words, is_fair

COMPARED = "survival"
"""The column that methods are compared by."""
MOST_COMPARED = 12
"""Methods of which every pair is a row: 66 rows."""


def pairwise(methods: Sequence[Method]) -> dict[tuple[int, int], Difference]:
    """Differences in survival of every pair of methods of one task, by their places; p-values are of all pairs.

    Trained methods with different budgets are no pair: what differs would not be the methods alone.
    """
    places = itertools.permutations(range(len(methods)), 2)
    pairs = [(x, y) for x, y in places if is_fair(methods[x], methods[y])]
    forward = [(x, y) for x, y in pairs if x < y]
    scores = [method.scores(COMPARED) for method in methods]
    found = dict(zip(forward, paired_differences(scores, forward), strict=True))
    return {(x, y): found[x, y] if x < y else found[y, x].reversed for x, y in pairs}


def pair_cells(difference: Difference | None) -> tuple[Cell, Cell]:
    """A difference and its p-value; None: of methods whose trainings had different budgets."""
    return (Cell("other budget"), MISSING) if difference is None else (difference_cell(difference), p_cell(difference))


def comparison_table(methods: Mapping[str, Sequence[Method]]) -> ResultTable:
    """Every pair of methods of a task: who survives how much longer in the same month, and how surely.

    Of more than :data:`MOST_COMPARED` methods the pairs with the first one alone: there are too many others to be read.

    Args:
        methods: by task, each in the order of its ranking.
    """
    columns = (
        Column("Task", words=True),
        Column("X", words=True),
        Column("Y", words=True),
        Column("X - Y"),
        Column("p"),
        Column("P(X > Y)"),
        Column("median life of X, steps"),
        Column("median life of Y, steps"),
    )
    rows = []
    for group in methods.values():
        found = pairwise(group)
        for (x, one), (y, other) in itertools.combinations(enumerate(group), 2):
            if x and len(group) > MOST_COMPARED:
                break
            improvement = probability_of_improvement(one.scores(COMPARED), other.scores(COMPARED))
            medians = [Cell(_steps(_median_life(method))) for method in (one, other)]
            names = (Cell(short_id(one.task.id)), Cell(one.label), Cell(other.label))
            rows.append((*names, *pair_cells(found.get((x, y))), interval_cell(improvement), *medians))
    everyone = [method for group in methods.values() for method in group]
    first = any(len(group) > MOST_COMPARED for group in methods.values())
    which = f"Where there are more than {MOST_COMPARED} methods, pairs with the first of the ranking. " if first else ""
    caption = (
        f"{which}X - Y: how much more of a month X survives than Y in the same months. p: that there is no difference, "
        "two-sided, Holm's correction over all pairs of the task; trainings with different budgets are no pair. "
        "P(X > Y): how probably X survives longer in the same month, ties counted half. Median life: grid steps after "
        "which half of the episodes are lost (Kaplan-Meier; a dash where more than half are completed). "
        f"{interval_words(everyone)}."
    )
    return ResultTable("comparisons", caption, columns, tuple(rows))


def reference_table(methods: Sequence[Method], reference: int = 0) -> ResultTable:
    """Methods of one task against one of them.

    Args:
        methods: all of one task, at least two.
        reference: place of the one that the others are compared with.
    """
    others = [place for place in range(len(methods)) if place != reference]
    scores = [method.scores(COMPARED) for method in methods]
    fair = [place for place in others if is_fair(methods[place], methods[reference])]
    found = dict(zip(fair, paired_differences(scores, [(place, reference) for place in fair]), strict=True))
    name = methods[reference].label
    columns = (Column("Method", words=True), Column(f"survival, to {name}"), Column("p"), Column("P(longer)"))
    rows = []
    for place in others:
        longer = probability_of_improvement(scores[place], scores[reference])
        rows.append((Cell(methods[place].label), *pair_cells(found.get(place)), interval_cell(longer)))
    caption = (
        f"How much more of a month each survives than {name} in the same {scores[0].months} months. p: that there is "
        f"no difference, two-sided, Holm's correction over these {len(fair)} comparisons. P(longer): how probably it "
        f"survives longer in the same month, ties counted half. {interval_words(methods)}."
    )
    return ResultTable("differences", caption, columns, tuple(rows))


def _median_life(method: Method) -> float:
    return kaplan_meier(lifetimes([result.episodes for result in method.evaluations])).median


def _steps(value: float) -> str:
    return MISSING.text if np.isnan(value) else f"{value:,.0f}"
