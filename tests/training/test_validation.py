"""Validation: means of the very evaluation, and safety by the thresholds that the run itself has."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.random_agent import RandomAgent
from rl2grid.errors import UsageError
from rl2grid.evaluation.protocol import evaluate
from rl2grid.scenarios.library import list_scenarios
from rl2grid.training import request, validation
from rl2grid.training.validation import validator

MONTH = list_scenarios("bus14", "validation")[:1]


def a_run(task: str, algorithm: str = "ppo", changes: dict[str, Any] | None = None, **keywords: Any) -> request.RunArgs:
    hyperparameters = request.hyperparameters(algorithm, task, **(changes or {}))
    return request.RunArgs(task, hyperparameters, algorithm=algorithm, env_keywords=keywords)


@pytest.mark.parametrize("keywords", [{"heuristic": "idle"}, {"heuristic": None, "maintenance": False}])
def test_the_means_are_those_of_an_evaluation_under_the_conditions_of_training(keywords: dict[str, Any]):
    result = evaluate(RandomAgent(), "bus14-T0", scenarios=MONTH, **keywords)
    args = a_run("bus14-T0", split="train", gamma=0.9, reward="paper", **keywords)
    means = validator(replace(args, validation_months=1))(RandomAgent())  # type: ignore[arg-type]
    assert means["survival"] == result.summary.survival.value
    assert means["episodic_return"] == result.summary.episode_return.value
    assert means["decisions"] == result.summary.decisions.value


def test_safe_months_are_counted_by_the_thresholds_of_the_run(monkeypatch: pytest.MonkeyPatch):
    played = evaluate(DoNothing(), "bus14-T0", scenarios=MONTH)
    cases = [(True, 0.0, 50.0), (True, 0.0, 50.5), (False, 2.0, 10.0), (True, 0.0, 0.0)]
    episodes = tuple(
        replace(played.episodes[0], scenario=str(k), completed=completed, cost_lsi=lsi, cost_tlo=tlo)
        for k, (completed, lsi, tlo) in enumerate(cases)
    )
    monkeypatch.setattr(validation, "evaluate", lambda *_, **__: replace(played, episodes=episodes))

    def share(args: request.RunArgs) -> float:
        return validator(args)(DoNothing())["safe_completed"]  # type: ignore[arg-type]

    assert share(a_run("bus14-T0-TLO")) == 0.5
    assert share(a_run("bus14-R", constraint="LSI")) == 0.75
    of_its_own = {"constraints": ("LSI", "TLO"), "thresholds": (2.0, 50.5)}
    assert share(a_run("bus14-T0", "lagrangian-ppo", of_its_own)) == 0.75
    assert "safe_completed" not in validator(a_run("bus14-T0"))(DoNothing())  # type: ignore[arg-type]


def test_a_constraint_that_contradicts_the_task_is_refused():
    with pytest.raises(UsageError, match="contradicts task 'rl2grid/bus14-T0-LSI-v0': leave it out"):
        validator(a_run("bus14-T0-LSI", constraint="TLO"))
