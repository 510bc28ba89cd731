"""Requests for trainings: what is refused before anything is made, and that a stored request is the request."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from toy_runs import SMALL, request, toy_envs

from rl2grid.algorithms.registry import algorithms_for
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.training.request import RunArgs, find_limits, hyperparameters, read_config
from rl2grid.training.runs import train

MISSPELT = hyperparameters("lagrangian-ppo", "bus14-T0", constraints=("LIS",), thresholds=(1.0,))


def test_the_stored_request_is_the_request(tmp_path: Path):
    folder = train(request(tmp_path / "run"), make_envs=toy_envs)
    args, _ = read_config(folder)
    assert args.hyperparameters == SMALL
    assert args.env_keywords["reward"] == (1.0, 0.5, 0.25)
    assert args.env_keywords["split"] == "train"
    assert args.env_keywords["episode_length"] is None
    assert args.task == find_task("rl2grid/bus14-T0-v0")
    assert args.folder == folder
    assert asdict(args)["checkpoint_seconds"] == 0.0


def test_limits_are_those_of_the_constraint_or_of_lagrangian_ppo(tmp_path: Path):
    def limits(algorithm: str, task: str, keyword: str | None = None, **changes: Any) -> dict[str, float]:
        args = hyperparameters(algorithm, task, **changes)
        return find_limits(RunArgs(task, args, algorithm, env_keywords={"constraint": keyword}))

    assert limits("ppo", "bus14-R") == {}
    assert limits("ppo", "bus14-R", "TLO") == {"TLO": 50.0}
    assert limits("dqn", "bus14-T0-LSI") == {"LSI": 0.0}
    assert limits("lagrangian-ppo", "bus14-R", "TLO", thresholds=(20.0,)) == {"TLO": 20.0}
    assert limits("lagrangian-ppo", "bus14-T0", constraints=("LSI", "TLO")) == {"LSI": 0.0, "TLO": 50.0}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"task": "bus15-T0"}, "does not exist"),
        ({"algorithm": "td4"}, "choose one of ppo"),
        ({"env_keywords": {"heuristics": "idle"}}, "Environment keyword 'heuristics' does not exist"),
        ({"env_keywords": {"heuristic": "lazy"}}, "lazy"),
        ({"env_keywords": {"episode_length": 0}}, "episode_length=0 is not allowed: give a number of grid steps"),
        ({"env_keywords": {"gamma": 0.9}}, "gamma belongs to"),
        ({"env_keywords": {"split": "test"}}, "Training on the test scenarios"),
        ({"env_keywords": {"reward": lambda state, i: 0.0}}, "stores its reward by name"),
        ({"env_keywords": {"scenario": "nowhere"}}, "Scenario 'nowhere' is not in the split train"),
        ({"evaluate_every": 0}, "evaluate_every"),
        ({"task": "bus14-R"}, "Only discrete actions can be masked"),
        ({"task": "bus14-T0-LSI", "env_keywords": {"constraint": "TLO"}}, "contradicts task 'rl2grid/bus14-T0-LSI-v0'"),
        ({"algorithm": "lagrangian-ppo", "hyperparameters": hyperparameters("lagrangian-ppo", "bus14-T0")}, "needs a"),
        ({"algorithm": "lagrangian-ppo", "hyperparameters": MISSPELT}, "'LIS' does not exist: choose one of LSI, TLO"),
    ],
)
def test_requests_that_cannot_be_met_leave_nothing_behind(tmp_path: Path, changes: dict[str, Any], sentence: str):
    with pytest.raises(UsageError, match=sentence):
        train(request(tmp_path / "run", **changes), make_envs=toy_envs)
    assert list(tmp_path.iterdir()) == []


def test_an_algorithm_that_cannot_learn_the_task_is_refused():
    with pytest.raises(UsageError, match=r"'td3' cannot learn .*, which has discrete actions: choose one of ppo"):
        hyperparameters("td3", "bus14-T0")


def test_all_algorithms_learn_joint_tasks_with_the_actions_that_they_know():
    masked = {name: getattr(hyperparameters(name, "bus14-H0"), "mask_actions", None) for name in algorithms_for("H")}
    topology = {name: hyperparameters(name, "bus14-T0").mask_actions for name in algorithms_for("T")}
    assert masked.keys() >= {"ppo", "lagrangian-ppo", "dqn", "sac", "td3", "imitation"}
    assert {name: masked[name] for name in topology} == {**topology, "imitation": False}  # of both parts at once
    assert hyperparameters("td3", "bus14-H0") == hyperparameters("td3", "bus14-R")


def test_joint_tasks_are_learned_as_is_asked_for():
    for name in ("ppo", "sac"):
        assert hyperparameters(name, "bus14-H0", joint_actions="discrete").mask_actions
        box = hyperparameters(name, "bus14-H0", joint_actions="box")
        assert replace(box, joint_actions=None) == hyperparameters(name, "bus14-R")
    for name, only in (("dqn", "discrete"), ("td3", "box"), ("imitation", "box")):
        with pytest.raises(UsageError, match=f"joint_actions of {name} .* does not exist: choose one of {only}."):
            hyperparameters(name, "bus14-H0", joint_actions="box" if only == "discrete" else "discrete")


def test_unknown_presets_and_hyperparameters_are_refused():
    with pytest.raises(UsageError, match="choose one of default, paper"):
        hyperparameters("ppo", "bus14-T0", "papers")
    with pytest.raises(UsageError, match="'learning_rate' does not exist: choose one of seed, "):
        hyperparameters("ppo", "bus14-T0", learning_rate=1.0)
    assert hyperparameters("ppo", "bus14-R", "paper").actor_learning_rate == 3e-5
    assert hyperparameters("ppo", "bus14-T0", "paper", seed=8).seed == 8
