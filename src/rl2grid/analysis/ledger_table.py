"""The ledger of test results as a table: a row per configuration, its seeds together, compared on the same months."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rl2grid.analysis.result_tables import merits
from rl2grid.analysis.table import difference_cell, highlighted, markdown_row, p_cell, share_text, with_interval
from rl2grid.envs.tasks import find_task, short_id
from rl2grid.errors import one_of
from rl2grid.mdp.constraint_table import CONSTRAINTS, THRESHOLDS
from rl2grid.records.comparisons import Difference, holm, paired_differences
from rl2grid.records.ledger import HashedTest
from rl2grid.records.looks import budget, by_present_rules, earlier_choices, is_outdated, latest_rules, method_of
from rl2grid.records.month_values import common_months
from rl2grid.records.statistics import UNIT, Scores, estimate
from rl2grid.records.versions import TARGETS_VERSION

REFERENCE = "do-nothing"
"""What rows are compared with unless another is named, where it has had its test."""
LEGEND = (
    "Test survival: mean over seeds and months, 95% interval over both; of one training, or none, over months alone. "
    "Last: of the last policies of the runs, where they are not the best by validation. {heading}: paired difference "
    "on the same months; p: that there is none, Holm's correction over the rows of the task. Completed and safe: "
    "shares of months, with Wilson's intervals. Marks: a, entered after other configurations of the same agent and "
    "heuristic had had their test on these months (their number); b, another budget (decisions, validations, months of "
    "each) than most trained rows of the task with that heuristic; r, an agent without training, or the heuristic "
    "beside it, by earlier rules than another row of both; s, a run that had been evaluated on test months before; "
    "t, trained under a heuristic with targets of an earlier version. Decisions of a training that began from "
    "another's policy are its own; imitation's are those of its labels, each as often as it was learned from."
)
_HEADINGS = (
    "task",
    "agent",
    "heuristic",
    "months",
    "decisions (grid steps)",
    "minutes",
    "validation",
    "test survival",
    "last",
    "{heading}",
    "p",
    "completed",
    "cost TLO",
    "P(TLO safe)",
    "P(LSI safe)",
    "marks",
)


@dataclass(frozen=True)
class LedgerRow:
    """One configuration with all its seeds."""

    results: tuple[HashedTest, ...]
    marks: str
    """What the legend explains."""
    told_by: str
    """The hyperparameters that tell it from rows of the same label and budget; empty where there are none."""
    is_outdated: bool
    """Whether it is by earlier rules than another row of its agent; see :func:`is_outdated`."""

    @property
    def first(self) -> HashedTest:
        return self.results[0]

    @property
    def player(self) -> str:
        """See :attr:`HashedTest.player`, and what tells it from others."""
        return f"{self.first.player}{self.told_by}"

    @property
    def label(self) -> str:
        """See :attr:`HashedTest.label`, and what tells it from others."""
        return f"{self.first.label}{self.told_by}"

    @property
    def names(self) -> tuple[str, str]:
        """By which it is asked for: as its agent and heuristic are called, which other rows may be too, and wholly."""
        return self.first.label, self.label

    def scores(self, column: str, months: int | None = None, *, of_last: bool = False) -> Scores:
        """A column of the tests, seeds of the training as runs; the first ``months`` of them."""
        tests = [one.last_by_month if of_last else one.by_month for one in self.results]
        values = [of_months[column][:months] for of_months in tests]
        return Scores(np.stack(values), UNIT if column in ("survival", "completed") else (0.0, np.inf))

    def safe(self, constraint: str) -> Scores:
        """Whether a month was completed within the threshold of a constraint."""
        costs = self.scores(CONSTRAINTS[constraint].column).values
        return Scores(self.scores("completed").values * (costs <= THRESHOLDS[constraint]), UNIT)


def ledger_table(results: Mapping[str, HashedTest], task: str | None = None, reference: str | None = None) -> str:
    """Results as Markdown with a legend: tasks in order, trained agents last, seeds of one configuration in one row.

    Args:
        results: of a ledger.
        task: id of the task whose rows are shown; None: all.
        reference: agent and heuristic, as in ``greedy + recovery``, that the rows of each task are compared with, and
            what tells it from other rows, as in ``ppo + recovery (initial_log_std 0.0)``, if it is not to be the first
            of them; None: doing nothing.

    Raises:
        UsageError: no row of the ledger has that name.
    """
    shown = {digest: one for digest, one in results.items() if task in (None, one.task)}
    rows = ledger_rows(shown, results)
    labels = sorted({name for row in rows for name in row.names})
    if reference is not None and reference not in labels:
        raise one_of("Reference", reference, labels)
    reference = reference or REFERENCE
    heading = f"to {reference}"
    compared = _compared(rows, reference)
    names = [name.format(heading=heading) for name in _HEADINGS]
    lines = [markdown_row(names), "|" + "---|" * len(names)]
    lines += [markdown_row(_cells(row, compared.get(number))) for number, row in enumerate(rows)]
    return "\n".join([*lines, "", LEGEND.format(heading=heading.capitalize())])


def short_ledger_table(results: Mapping[str, HashedTest], task: str) -> str:
    """The results of one task in few columns, as Markdown: the best first, which is bold.

    The order is by :func:`merits`. A constrained task shows its own cost and safe months, others the safe months in the
    sense of TLO.

    Args:
        results: of a ledger.
        task: id of the task.
    """
    rows = present_rows(results, task)
    compared = _compared(rows, REFERENCE)
    heading = f"to {REFERENCE}"
    limit = find_task(task).constraint
    ranked = sorted(enumerate(rows), key=lambda one: merits(one[1], limit), reverse=True)
    counted = limit or "TLO"
    names = ("agent", "survival", heading, "completed", f"cost {limit}", f"{counted} safe")
    columns: dict[str, list[str]] = {name: [] for name in names}
    for place, (number, row) in enumerate(ranked):
        survival = with_interval(estimate(row.scores("survival")), 3)
        difference = compared.get(number)
        cells = (
            highlighted(row.label, place == 0),
            highlighted(survival, place == 0),
            difference_cell(difference).text if isinstance(difference, Difference) else difference or "",
            share_text(estimate(row.scores("completed"))),
            "" if limit is None else f"{estimate(row.scores(CONSTRAINTS[limit].column)).value:,.1f}",
            share_text(estimate(row.safe(counted))),
        )
        for column, cell in zip(columns.values(), cells, strict=True):
            column.append(cell)
    shown = {name: cells for name, cells in columns.items() if any(cells)}
    lines = [markdown_row(list(shown)), "|" + ":--|" + "--:|" * (len(shown) - 1)]
    return "\n".join([*lines, *(markdown_row(cells) for cells in zip(*shown.values(), strict=True))])


def present_rows(results: Mapping[str, HashedTest], task: str) -> list[LedgerRow]:
    """The rows of a task, without those by earlier rules of an agent."""
    current = by_present_rules(results)
    return ledger_rows({digest: one for digest, one in current.items() if one.task == task}, results)


def ledger_rows(shown: Mapping[str, HashedTest], results: Mapping[str, HashedTest]) -> list[LedgerRow]:
    """Rows in the order of the table.

    Args:
        shown: results that are shown.
        results: all of the ledger, whose order says what was seen before.
    """
    groups = [list(group) for _, group in itertools.groupby(sorted(shown.values(), key=_place), key=_choice)]
    budgets: dict[tuple[str, Any], Counter[tuple[Any, ...]]] = {}
    for first, *_ in groups:
        if first.training:
            budgets.setdefault((first.task, first.heuristic), Counter())[budget(first)] += 1
    usual = {key: max(counts, key=lambda one: (counts[one], dict(one)["decisions"])) for key, counts in budgets.items()}
    told_by, latest = _told_by([first for first, *_ in groups]), latest_rules(results)
    return [
        LedgerRow(tuple(group), _marks(group, usual, latest, results), words, is_outdated(group[0], latest))
        for group, words in zip(groups, told_by, strict=True)
    ]


def _told_by(choices: Sequence[HashedTest]) -> list[str]:
    """Of each choice, the hyperparameters in which those of one task, label and budget differ, in words."""
    hyperparameters = [one.configuration.get("hyperparameters", {}) for one in choices]
    keys = [
        (one.task, one.label, chosen.get("total_timesteps"))
        for one, chosen in zip(choices, hyperparameters, strict=True)
    ]
    alike: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for key, chosen in zip(keys, hyperparameters, strict=True):
        alike.setdefault(key, []).append(chosen)
    return [_differing(chosen, alike[key]) for key, chosen in zip(keys, hyperparameters, strict=True)]


def _differing(chosen: Mapping[str, Any], others: Sequence[Mapping[str, Any]]) -> str:
    differing = [
        f"{name} {' '.join(map(str, value)) if isinstance(value, list | tuple) else value}"
        for name, value in chosen.items()
        if name != "seed" and any(other.get(name) != value for other in others)
    ]
    return f" ({', '.join(differing)})" if differing else ""


def _marks(
    group: Sequence[HashedTest],
    usual: Mapping[tuple[str, Any], tuple[Any, ...]],
    latest: Mapping[tuple[Any, ...], int],
    results: Mapping[str, HashedTest],
) -> str:
    first = group[0]
    seen = len(earlier_choices(results, method_of(first), first.choice))
    marks = [f"a{seen}"] if seen else []
    marks += ["r"] if is_outdated(first, latest) else []
    if first.training:
        marks += ["b"] if budget(first) != usual[first.task, first.heuristic] else []
        marks += ["s"] if any(one.training.get("tested_before") for one in group) else []
        is_old = first.configuration.get("targets_version", 1) < TARGETS_VERSION
        marks += ["t"] if is_old and first.heuristic else []  # without a heuristic, the targets were the same
    return " ".join(marks)


def _compared(rows: Sequence[LedgerRow], reference: str) -> dict[int, Difference | str]:
    """Difference of each row to the reference of its task, by present rules if possible, or why there is none."""
    found: dict[int, Difference | str] = {}
    for _, group in itertools.groupby(enumerate(rows), key=lambda one: one[1].first.task):
        numbered = dict(group)
        alike = [row for row in numbered.values() if reference in row.names]
        base = min(alike, key=lambda row: row.is_outdated, default=None)
        if base is None:
            continue
        others = {number: row for number, row in numbered.items() if row is not base}
        allowed = {number: row for number, row in others.items() if _is_fair(row, base)}
        found |= dict.fromkeys(others.keys() - allowed.keys(), "other budget")
        found |= _differences(allowed, base)
    return found


def _differences(rows: Mapping[int, LedgerRow], base: LedgerRow) -> dict[int, Difference]:
    """To one row, each on all months that both played; corrected as one family."""
    found: dict[int, Difference] = {}
    for number, row in rows.items():
        months = common_months(row.first.months, base.first.months)
        (found[number],) = paired_differences([one.scores("survival", months) for one in (row, base)], [(0, 1)])
    corrected = holm([one.p for one in found.values()])
    return {number: replace(one, holm=float(p)) for (number, one), p in zip(found.items(), corrected, strict=True)}


def _is_fair(row: LedgerRow, base: LedgerRow) -> bool:
    """Whether a difference is of the agents: on the same list, and trained ones with the same budget."""
    same_list = common_months(row.first.months, base.first.months) > 0
    return same_list and (not (row.first.training and base.first.training) or budget(row.first) == budget(base.first))


def _choice(result: HashedTest) -> tuple[Any, ...]:
    return _place(result)[:-1]


def _place(result: HashedTest) -> tuple[Any, ...]:
    """Where a result stands; those that differ in the last element alone are seeds of one configuration."""
    seed = result.configuration.get("hyperparameters", {}).get("seed", 0)
    return result.task, bool(result.training), result.agent, str(result.heuristic), result.choice, seed


def _cells(row: LedgerRow, compared: Difference | str | None) -> list[str]:
    first, training = row.first, [result.training for result in row.results]
    cells = [short_id(first.task), row.player, first.heuristic or "none", _months(first)]
    if first.training:
        steps = sum(run["grid_steps"] for run in training) / len(training) / 1e6
        minutes, validation = ([run[name] for run in training] for name in ("minutes", "validation_survival"))
        cells += [f"{training[0]['decisions']:,} ({steps:.1f} M)", _seeds(minutes, ".0f"), _seeds(validation, ".3f")]
    else:
        cells += ["", "", ""]
    cells += _survival(row)
    if isinstance(compared, Difference):
        cells += [difference_cell(compared).text, p_cell(compared).text]
    else:
        cells += [compared or "", ""]
    return [*cells, *_shares(row), row.marks]


def _months(result: HashedTest) -> str:
    version = result.months["split_version"]
    return str(result.months["number"]) + (f" (list {version})" if version else "")


def _survival(row: LedgerRow) -> list[str]:
    """Of the best policies, and of the last."""
    each = [result.test["survival"] for result in row.results]
    best = with_interval(estimate(row.scores("survival")), 3)
    last = estimate(row.scores("survival", of_last=True)).value if any(one.last for one in row.results) else None
    return [best if len(each) == 1 else f"**{best}** of {_seeds(each, '.3f')}", "" if last is None else f"{last:.3f}"]


def _shares(row: LedgerRow) -> list[str]:
    """Completed, cost and safe months."""
    cost = estimate(row.scores("cost_tlo")).value
    completed, tlo, lsi = (estimate(one) for one in (row.scores("completed"), row.safe("TLO"), row.safe("LSI")))
    return [share_text(completed), f"{cost:.0f}", share_text(tlo), share_text(lsi)]


def _seeds(values: Sequence[float], form: str) -> str:
    return ", ".join(format(value, form) for value in values)
