"""The tables of a results section, in the shapes of the paper (Tables 2 and 3) and beyond."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Protocol

from rl2grid.analysis.comparison_table import comparison_table, pair_cells, pairwise
from rl2grid.analysis.l2rpn_table import l2rpn_table, operation_table, stored_scores
from rl2grid.analysis.table import (
    MISSING,
    Cell,
    Column,
    ResultTable,
    interval_cell,
    mean_cell,
    share_cell,
)
from rl2grid.envs.tasks import short_id
from rl2grid.mdp.constraint_table import CONSTRAINTS, THRESHOLDS
from rl2grid.mdp.features import KINDS
from rl2grid.mdp.termination import GAME_OVER_TEXT, GameOver
from rl2grid.records.methods import COSTS, Method, interval_words
from rl2grid.records.statistics import (
    Aggregate,
    Estimate,
    Scores,
    estimate,
    iqm_score,
    mean_score,
    median_score,
    optimality_gap,
)

HEURISTIC_LETTERS: dict[str, str] = {"none": "V", "idle": "I", "recovery": "R", "careful": "C", "secure": "S"}
"""The paper's, vanilla, idle and recovery; and careful and secure."""
AGGREGATES: dict[str, Aggregate] = {
    "mean": mean_score,
    "median": median_score,
    "IQM": iqm_score,
    "optimality gap": optimality_gap,
}
"""Of survival."""
SCORES: dict[str, str] = {"margin": "score_margin", "overload": "score_overload", "topology": "score_topology"}
"""Columns of the operational scores (paper, Section 5)."""
_BASELINES = "Baselines"
_METHOD = (Column("Task", words=True), Column("Method", words=True))

Methods = Mapping[str, Sequence[Method]]
"""By task."""


class Played(Protocol):
    """What was played of a task, by one method or one configuration of a ledger."""

    def scores(self, column: str) -> Scores:
        """A column of the episodes."""

    def safe(self, constraint: str) -> Scores:
        """Whether an episode was completed within the threshold of a constraint."""


def result_tables(methods: Methods) -> tuple[ResultTable, ...]:
    """Every table that the results allow; methods of a task are in the order of its ranking."""
    tables = [survival_table(methods, kind) for kind in KINDS if _tasks(methods, kind)]
    methods = {task: ranking(group) for task, group in methods.items()}
    if len(methods) > 1 and any(len(group) > 1 for group in methods.values()):
        tables.insert(0, overview_table(methods))
    tables += [aggregate_table(methods), constraint_table(methods), score_table(methods), ending_table(methods)]
    found = operation_table(methods), l2rpn_table(methods, stored_scores(methods))
    tables += [table for table in found if table is not None]
    if any(len(group) > 1 for group in methods.values()):
        tables.append(comparison_table(methods))
    return tuple(tables)


def ranking_table(methods: Sequence[Method]) -> ResultTable:
    """The methods of one task, best first: how long they survive, and how often they complete an episode, also safely.

    Args:
        methods: all of one task, at least one.
    """
    ranked = ranking(methods)
    return _ranking_table([(Cell(method.label),) for method in ranked], (Column("Method", words=True),), ranked)


def entry_table(methods: Mapping[str, Method]) -> ResultTable:
    """:func:`ranking_table` of the entries of a leaderboard, with their files.

    Args:
        methods: by file, all of one task, at least one.
    """
    ranked = ranking(tuple(methods.values()))
    files = {id(method): file for file, method in methods.items()}
    names = [(Cell(method.label), Cell(files[id(method)])) for method in ranked]
    return _ranking_table(names, (Column("Method", words=True), Column("Entry", words=True)), ranked)


def ranking(methods: Sequence[Method]) -> list[Method]:
    """Methods of one task, best first; see :func:`merits`."""
    limit = methods[0].task.constraint
    return sorted(methods, key=lambda method: merits(method, limit), reverse=True)


def merits(played: Played, limit: str | None) -> tuple[float, ...]:
    """What the better one has more of: survival, and under a constraint, before it, the share of safe episodes."""
    scores = (*((played.safe(limit),) if limit else ()), played.scores("survival"))
    return tuple(float(one.values.mean()) for one in scores)


def _ranking_table(
    names: Sequence[tuple[Cell, ...]], name_columns: tuple[Column, ...], ranked: Sequence[Method]
) -> ResultTable:
    limit = ranked[0].task.constraint
    limits = (limit,) if limit else tuple(THRESHOLDS)
    shares = ("Completed", *(f"Safe {name}" for name in limits))
    headings = ("Survival", "To the first", "p", *shares, "Played")
    differences = pairwise(ranked)
    survivals = [estimate(method.scores("survival")) for method in ranked]
    best = _printed_best([survival.value for survival in survivals], 3)
    rows = []
    for place, (name, method, survival) in enumerate(zip(names, ranked, survivals, strict=True)):
        to_first = pair_cells(differences.get((place, 0))) if place else (MISSING, MISSING)
        estimates = (method.scores("completed"), *(method.safe(name) for name in limits))
        cells = (
            interval_cell(survival, best=round(survival.value, 3) == best),
            *to_first,
            *(share_cell(estimate(scores)) for scores in estimates),
        )
        runs, *others = map(str, method.scores("survival").values.shape)
        played = " x ".join((runs if method.is_trained else MISSING.text, *others))
        rows.append((*name, *cells, Cell(played)))
    kept = " or ".join(f"{name} at most {THRESHOLDS[name]:g}" for name in limits)
    order = "share of safe episodes, then survival" if limit else "survival"
    caption = (
        f"By {order}. Survival: mean share of the episode. To the first: difference in survival to the first row "
        "on the same months; p: that there is none, Holm's correction over all pairs of methods. Others: shares of "
        f"episodes. Safe: completed, and cost {kept}. Played: training runs x months x seeds. {interval_words(ranked)}."
    )
    length = ranked[0].evaluations[0].identity.get("episode_length")
    caption += f" Episodes of {length:,} steps." if length is not None else ""
    columns = (*name_columns, *(Column(heading) for heading in headings))
    return ResultTable(f"ranking-{_task_name(ranked[0])}", caption, columns, tuple(rows))


def overview_table(methods: Methods) -> ResultTable:
    """Methods in rows and tasks in columns: mean survival, the best of a task in bold, by the mean place.

    Args:
        methods: by task, each in the order of its ranking.
    """
    places: dict[str, list[int]] = {}
    found: dict[tuple[str, str], Estimate] = {}
    for task, group in methods.items():
        for place, method in enumerate(group, start=1):
            places.setdefault(method.label, []).append(place)
            found[method.label, task] = estimate(method.scores("survival"))
    best = {
        task: _printed_best([value.value for (_, other), value in found.items() if other == task], 2)
        for task in methods
    }
    # Who was played on all tasks stands before who was not: a mean of other tasks is no order.
    mean = {label: sum(own) / len(own) for label, own in places.items()}
    ordered = sorted(places, key=lambda label: (-len(places[label]), mean[label]))
    rows = []
    for label in ordered:
        cells = [
            MISSING
            if (label, task) not in found
            else mean_cell(found[label, task], best=round(found[label, task].value, 2) == best[task])
            for task in methods
        ]
        rows.append((Cell(label), Cell(f"{mean[label]:.1f}"), *cells))
    columns = (Column("Method", words=True), Column("Mean place"), *(Column(short_id(task)) for task in methods))
    caption = (
        "Mean survival on every task, plus or minus half of its interval; the best of a task in bold. Mean place: in "
        f"the rankings of the tasks that a method was played on. {_intervals(methods, methods)}."
    )
    return ResultTable("overview", caption, columns, tuple(rows))


def survival_table(methods: Methods, kind: str) -> ResultTable:
    """Mean survival by task, agent and heuristic (paper, Table 2 for topology tasks, Table 3 for continuous ones).

    Args:
        methods: by task.
        kind: one of :data:`rl2grid.mdp.features.KINDS`.
    """
    tasks = _tasks(methods, kind)
    places = _places(itertools.chain.from_iterable(methods[task] for task in tasks))
    columns = (
        Column("Env.", words=True),
        Column("Diff.", words=True),
        *(Column(heading, group) for group, heading in places),
    )
    rows = []
    for task in tasks:
        means = {_place(method): estimate(method.scores("survival")) for method in methods[task]}
        best = _printed_best([value.value for value in means.values()], 2)
        first = methods[task][0].task
        cells = [
            mean_cell(means[place], best=round(means[place].value, 2) == best) if place in means else MISSING
            for place in places
        ]
        name = first.grid_id + (f" {first.constraint}" if first.constraint else "")
        rows.append((Cell(name), Cell(str(first.level)), *cells))
    actions = {"T": "topology", "R": "redispatch", "H": "joint"}[kind]
    caption = (
        f"Mean survival on tasks with {actions} actions (higher is better; best of a task in bold), plus or minus half "
        f"of its interval. {_intervals(methods, tasks)}. "
        "V: vanilla, I: idle, R: recovery, C: careful and S: secure heuristic."
    )
    return ResultTable(f"survival-{actions}", caption, columns, tuple(rows))


def aggregate_table(methods: Methods) -> ResultTable:
    """Mean, median, interquartile mean and optimality gap of survival."""
    columns = (*_METHOD, *(Column(name) for name in AGGREGATES))
    rows = []
    for group in methods.values():
        values = [[estimate(method.scores("survival"), rule) for rule in AGGREGATES.values()] for method in group]
        # The gap is what is missing: the least is best.
        gap = list(AGGREGATES).index("optimality gap")
        best = [
            _printed_best([-e.value if k == gap else e.value for e in column], 3)
            for k, column in enumerate(zip(*values, strict=True))
        ]
        for method, row in zip(group, values, strict=True):
            cells = [
                interval_cell(e, best=top is not None and round(e.value, 3) == abs(top))
                for e, top in zip(row, best, strict=True)
            ]
            rows.append((*_names(method), *cells))
    caption = (
        "Survival. Median: over months, of a month's mean; IQM: mean of the middle half of all episodes; optimality "
        f"gap: what is missing to full survival. {_intervals(methods, methods)}."
    )
    return ResultTable("aggregates", caption, columns, tuple(rows))


def constraint_table(methods: Methods) -> ResultTable:
    """Survival, cost and its threshold, and how often an episode keeps the threshold and is completed."""
    columns: tuple[Column, ...] = (*_METHOD, Column("Survival"))
    for name, threshold in THRESHOLDS.items():
        group = f"{name} (threshold {threshold:g})"
        columns += (Column("cost", group), Column("P(kept)", group), Column("P(kept and completed)", group))
    rows = []
    for group_ in methods.values():
        safe = {name: [estimate(method.safe(name)) for method in group_] for name in COSTS}
        for k, method in enumerate(group_):
            cells = [mean_cell(estimate(method.scores("survival")))]
            for name, column in COSTS.items():
                is_best = round(safe[name][k].value, 2) == _printed_best([e.value for e in safe[name]], 2)
                cells += [
                    mean_cell(estimate(method.scores(column)), digits=1),
                    mean_cell(estimate(method.within(name))),
                    mean_cell(safe[name][k], best=is_best),
                ]
            rows.append((*_names(method), *cells))
    meanings = "; ".join(f"{name}: {constraint.text}" for name, constraint in CONSTRAINTS.items())
    caption = (
        "Costs of an episode and the share of episodes that keep the threshold, alone and together with being "
        f"completed: a grid that is lost early costs little, too. {meanings}. Plus or minus half of the interval. "
        f"{_intervals(methods, methods)}."
    )
    return ResultTable("constraints", caption, columns, tuple(rows))


def score_table(methods: Methods) -> ResultTable:
    """The operational scores (paper, Section 5)."""
    columns = (*_METHOD, *(Column(name) for name in SCORES))
    rows = [
        (*_names(method), *(mean_cell(estimate(method.scores(column)), digits=3) for column in SCORES.values()))
        for group in methods.values()
        for method in group
    ]
    caption = (
        "Operational scores, means per grid step. Margin: free capacity, summed over lines, -1 for one that is out; "
        "overload: 0 without overloads and disconnections, down to -1; topology: minus the elements that are not on "
        f"busbar 1. Plus or minus half of the interval. {_intervals(methods, methods)}."
    )
    return ResultTable("scores", caption, columns, tuple(rows))


def ending_table(methods: Methods) -> ResultTable:
    """How many episodes ended for each reason."""
    everyone = [method for group in methods.values() for method in group]
    reasons = [r for r in GameOver if r and any(e.game_over == r.name for m in everyone for e in m.episodes)]
    columns = (*_METHOD, Column("episodes"), Column("completed"), *(Column(_short(reason)) for reason in reasons))
    rows = []
    for method in everyone:
        endings = [episode.game_over for episode in method.episodes]
        counts = [endings.count(reason.name) for reason in (GameOver.NONE, *reasons)]
        rows.append((*_names(method), Cell(str(len(endings))), *(Cell(str(count)) for count in counts)))
    caption = "How episodes ended. " + " ".join(f"{_short(r).capitalize()}: {GAME_OVER_TEXT[r]}." for r in reasons)
    return ResultTable("endings", caption.strip(), columns, tuple(rows))


def _printed_best(values: Sequence[float], digits: int) -> float | None:
    """The highest value as printed: what looks equal is equally bold. None where all look equal."""
    printed = {round(value, digits) for value in values}
    return max(printed) if len(printed) > 1 else None


def _tasks(methods: Methods, kind: str) -> list[str]:
    return [task for task, group in methods.items() if group[0].task.kind == kind]


def _places(methods: Iterable[Method]) -> list[tuple[str, str]]:
    """Group and heading of the columns: baselines first, agents in order of appearance, heuristics in the paper's."""
    letters = list(HEURISTIC_LETTERS.values())
    seen: list[tuple[str, str]] = list(dict.fromkeys(_place(method) for method in methods))
    groups = list(dict.fromkeys(group for group, _ in seen))
    groups.sort(key=lambda group: group != _BASELINES)
    ordered = []
    for group in groups:
        headings = [heading for other, heading in seen if other == group]
        if group != _BASELINES:
            headings.sort(key=letters.index)
        ordered += [(group, heading) for heading in headings]
    return ordered


def _place(method: Method) -> tuple[str, str]:
    if method.is_trained:
        return method.agent, HEURISTIC_LETTERS[method.heuristic]
    letter = "" if method.heuristic == "none" else f" ({HEURISTIC_LETTERS[method.heuristic]})"
    return _BASELINES, f"{method.agent}{letter}"


def _names(method: Method) -> tuple[Cell, Cell]:
    return Cell(_task_name(method)), Cell(method.label)


def _task_name(method: Method) -> str:
    return short_id(method.task.id)


def _intervals(methods: Methods, tasks: Iterable[str]) -> str:
    return interval_words(method for task in tasks for method in methods[task])


def _short(reason: GameOver) -> str:
    return reason.name.replace("_", " ").lower()
