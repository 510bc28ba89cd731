"""What operation cost, and the scores of the L2RPN competitions, as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rl2grid.analysis.table import MISSING, Cell, Column, ResultTable, interval_cell, mean_cell
from rl2grid.envs.tasks import short_id
from rl2grid.records.l2rpn import COLUMNS, HEADINGS, L2RPNScores, read_scores, score_columns
from rl2grid.records.methods import Method, interval_words
from rl2grid.records.statistics import estimate

COSTS: Mapping[str, str] = {
    "losses": "cost_losses",
    "redispatch": "cost_redispatch",
    "curtailment": "cost_curtailment",
    "storage": "cost_storage",
    "blackout": "cost_blackout",
    "all": "cost_operation",
}
"""Headings of the costs, and the columns of episodes that hold them."""
_METHOD = (Column("Task", words=True), Column("Method", words=True))

Methods = Mapping[str, Sequence[Method]]
"""By task."""
Stored = Mapping[int, Sequence[Sequence[L2RPNScores]]]
"""Scores of the episodes of each evaluation of a method, by the ``id`` of the method."""


def operation_table(methods: Methods) -> ResultTable | None:
    """What operation cost; None where no episode says."""
    known = [method for group in methods.values() for method in group if _knows_operation(method)]
    if not known:
        return None
    rows = [
        (*_names(method), *(mean_cell(estimate(method.scores(column)), digits=0) for column in COSTS.values()))
        for method in known
    ]
    caption = (
        "Cost of an episode by the rules of L2RPN 2020, in the price of a MWh: losses, redispatch, curtailment that is "
        "added and storage at the price of the dearest generator that produces; after a game over, the demand of all "
        f"later steps at the highest price. Plus or minus half of the interval. {interval_words(known)}."
    )
    return ResultTable("operation", caption, (*_METHOD, *(Column(name) for name in COSTS)), tuple(rows))


def stored_scores(methods: Methods) -> Stored:
    """The scores that lie beside the episodes of the evaluations, for methods that have all of theirs."""
    found = {}
    for method in (one for group in methods.values() for one in group):
        scores = [
            None if result.folder is None else read_scores(result.folder, result.episodes)
            for result in method.evaluations
        ]
        complete = [one for one in scores if one is not None]
        if len(complete) == len(scores):
            found[id(method)] = complete
    return found


def l2rpn_table(methods: Methods, scores: Stored) -> ResultTable | None:
    """The scores of the competitions; None where no method has any."""
    known = [method for group in methods.values() for method in group if id(method) in scores]
    if not known:
        return None
    rows = []
    for method in known:
        columns = score_columns([result.episodes for result in method.evaluations], scores[id(method)])
        cost = mean_cell(estimate(method.scores("cost_operation")), digits=0) if _knows_operation(method) else MISSING
        rows.append((*_names(method), cost, *(interval_cell(estimate(columns[name]), digits=1) for name in COLUMNS)))
    caption = (
        "Scores of L2RPN competitions by Grid2Op's formulas, -100 to 100: 80 for reconnecting lines on a grid where "
        "none is ever tripped by an overload, 0 for doing nothing, -100 for a blackout from the beginning. 2020 is the "
        "operational part of 2021 and 2023, too; what is paid for alarms and alerts is left out. Cost: operation and "
        f"blackout at the prices of 2020. {interval_words(known)}."
    )
    headings = (Column("Cost"), *(Column(HEADINGS[name]) for name in COLUMNS))
    return ResultTable("l2rpn", caption, (*_METHOD, *headings), tuple(rows))


def _knows_operation(method: Method) -> bool:
    return all(episode.knows_operation for episode in method.episodes)


def _names(method: Method) -> tuple[Cell, Cell]:
    return Cell(short_id(method.task.id)), Cell(method.label)
