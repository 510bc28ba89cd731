"""Hyperparameters: values that no algorithm can work with are refused when they are given, not after hours."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import pytest

from rl2grid.algorithms.hyperparameters import SharedArgs
from rl2grid.algorithms.registry import algorithm_names, find_algorithm
from rl2grid.errors import UsageError
from rl2grid.training.request import hyperparameters

TASKS = {"T": "bus14-T0", "R": "bus14-R"}
PAIRS = [(name, kind) for name in algorithm_names() for kind in find_algorithm(name).kinds]


def numbers(args: SharedArgs) -> list[str]:
    """Names of the hyperparameters that are one number each, whole ones left out."""
    return [field.name for field in fields(args) if field.type in ("float", "float | None")]


@pytest.mark.parametrize(("algorithm", "kind"), PAIRS)
def test_what_is_no_number_is_refused_wherever_one_is_wanted(algorithm: str, kind: str):
    args = hyperparameters(algorithm, TASKS[kind])
    assert {"gamma", "reward_scale", "max_grad_norm"} < set(numbers(args))
    for name in numbers(args):
        with pytest.raises(UsageError, match=name):
            replace(args, **{name: math.nan})


@pytest.mark.parametrize(
    ("algorithm", "changes", "sentence"),
    [
        ("dqn", {"reward_scale": 0.0}, "DQN needs a positive reward_scale, not 0.0"),
        ("td3", {"reward_scale": -math.inf}, "TD3 needs a positive reward_scale, not -inf"),
        ("ppo", {"initial_log_std": math.inf}, "PPO needs initial_log_std between -20 and 2, not inf"),
        ("ppo", {"target_kl": 0.0}, "PPO needs a positive target_kl, not 0.0"),
        ("ppo", {"entropy_coefficient": -0.1}, "PPO needs entropy_coefficient of at least 0, not -0.1"),
        ("lagrangian-ppo", {"value_coefficient": math.inf}, "value_coefficient of at least 0, not inf"),
        ("sac", {"entropy_per_dimension": 0.7}, r"entropy_per_dimension of at most log 2 = 0\.69, not 0\.7"),
        ("sac", {"entropy_per_dimension": -math.inf}, "finite entropy_per_dimension"),
    ],
)
def test_values_that_cannot_work_are_refused(algorithm: str, changes: dict[str, Any], sentence: str):
    task = TASKS["R" if "R" in find_algorithm(algorithm).kinds else "T"]
    with pytest.raises(UsageError, match=sentence):
        replace(hyperparameters(algorithm, task), **changes)
