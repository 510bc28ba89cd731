"""What benchmarks that compare trainings share: the months that chose nothing, and gains over one of the methods.

Trainings keep the policy that survives longest on the first validation months; what is compared is played on those
behind them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import rl2grid
from rl2grid.agents.agent import Agent
from rl2grid.envs.tasks import Task, find_task
from rl2grid.evaluation.protocol import first_months
from rl2grid.records.comparisons import paired_differences
from rl2grid.records.statistics import UNIT, Estimate, Scores, estimate
from rl2grid.records.trainings import is_run
from rl2grid.scenarios.library import list_scenarios
from rl2grid.scenarios.splits import VALIDATION
from rl2grid.training.request import read_config
from rl2grid.training.runs import resume
from rl2grid.training.validation import find_validator

CHOSEN_ON = 20
"""Validation months by which the best policy of a training is kept."""


def validation_months(task: Task, skip: int, months: int) -> tuple[str, ...]:
    """The ``months`` validation months behind the first ``skip``."""
    return first_months(task, VALIDATION, skip + months)[skip:]


def begin_or_go_on(run: Path, begin: Callable[[], object]) -> None:
    """Begin a run, or train one that is there, and may have been interrupted, to its end, validated as it was begun."""
    if is_run(run):
        resume(run, evaluate=find_validator(read_config(run)[0]))
    else:
        begin()


def survival_behind(agent: Agent | Path, task_id: str, months: int | None = None, *, skip: int = 0) -> list[float]:
    """Survival of each of the first ``months`` validation months behind :data:`CHOSEN_ON` and ``skip`` more; None: of
    all.
    """
    task = find_task(task_id)
    scenarios = list_scenarios(task.grid_id, VALIDATION)[CHOSEN_ON + skip :][:months]
    played = rl2grid.evaluate(agent, task, scenarios=scenarios, workers=0)
    return [round(episode.survival, 5) for episode in played.episodes]


def compared(survival: Mapping[str, Sequence[list[float]]], base: str) -> dict[str, dict[str, Any]]:
    """Mean of every method and its gain over one of them, on the same months.

    Args:
        survival: of each method and training, of each month.
        base: the method that the others are compared with.

    Returns:
        By method ``survival`` and, of the others, ``gain``, each with its 95% interval over trainings and months, and
        ``p`` with Holm's correction.
    """
    names = list(survival)
    scores = [Scores(np.array(survival[name])[:, :, None], UNIT) for name in names]
    found: dict[str, dict[str, Any]] = {
        name: {"survival": _rounded(estimate(one))} for name, one in zip(names, scores, strict=True)
    }
    others = [place for place, name in enumerate(names) if name != base]
    differences = paired_differences(scores, [(place, names.index(base)) for place in others])
    for place, difference in zip(others, differences, strict=True):
        found[names[place]] |= {"gain": _rounded(difference.estimate), "p": round(float(difference.holm), 4)}
    return found


def _rounded(one: Estimate) -> list[float]:
    return [round(float(x), 4) for x in (one.value, one.low, one.high)]
