"""The ledger of test results as a table: a row per configuration, its seeds together."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

from rl2grid.envs.tasks import short_id
from rl2grid.records.evaluations import identity_hash
from rl2grid.records.ledger import HashedTest

_HEADINGS = (
    "task",
    "agent",
    "heuristic",
    "decisions (grid steps)",
    "minutes",
    "validation",
    "test survival",
    "completed",
    "cost TLO",
    "P(TLO safe)",
    "P(LSI safe)",
)
_TESTED = {"completed": ".0%", "cost_tlo": ".0f", "safe_tlo": ".0%", "safe_lsi": ".0%"}


def ledger_table(results: Iterable[HashedTest]) -> str:
    """Results as Markdown: tasks in order, trained agents last, the seeds of one configuration in one row."""
    lines = ["| " + " | ".join(_HEADINGS) + " |", "|" + "---|" * len(_HEADINGS)]
    for _, group in itertools.groupby(sorted(results, key=_place), key=lambda result: _place(result)[:-1]):
        lines.append("| " + " | ".join(_cells(list(group))) + " |")
    return "\n".join(lines)


def _place(result: HashedTest) -> tuple[Any, ...]:
    """Where a result stands; those that differ in the last element alone are seeds of one configuration."""
    configuration = result.configuration
    others = dict(configuration.get("hyperparameters", {}))
    seed = others.pop("seed", 0)
    what = identity_hash({**configuration, "hyperparameters": others})
    trained = "algorithm" in configuration
    return configuration["task"], trained, result.agent, str(result.heuristic), what, seed


def _cells(group: Sequence[HashedTest]) -> list[str]:
    first, training = group[0], [result.training for result in group]
    cells = [short_id(first.configuration["task"]), first.agent, first.heuristic or "none"]
    if first.training:
        steps = sum(run["grid_steps"] for run in training) / len(group) / 1e6
        minutes, validation = ([run[name] for run in training] for name in ("minutes", "validation_survival"))
        cells += [f"{training[0]['decisions']:,} ({steps:.1f} M)", _seeds(minutes, ".0f"), _seeds(validation, ".3f")]
    else:
        cells += ["", "", ""]
    _, low, high = first.test["survival"]
    survival = _seeds(_tested(group, "survival"), ".3f")
    cells.append(f"{survival} [{low:.3f}, {high:.3f}]" if len(group) == 1 else f"**{_mean(group):.3f}** of {survival}")
    cells += [_seeds(_tested(group, name), form) for name, form in _TESTED.items()]
    return cells


def _tested(group: Sequence[HashedTest], name: str) -> list[float]:
    return [result.test[name][0] for result in group]


def _mean(group: Sequence[HashedTest]) -> float:
    return sum(_tested(group, "survival")) / len(group)


def _seeds(values: Sequence[float], form: str) -> str:
    return ", ".join(format(value, form) for value in values)
