"""Trainings on joint tasks, whose actions algorithms and policies know flattened."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from toy_runs import falling

import rl2grid
from rl2grid.agents.agent import ExplainingAgent
from rl2grid.training.request import RunArgs, hyperparameters
from rl2grid.training.runs import resume, train

SMALL: dict[str, Any] = {
    "total_timesteps": 8,
    "num_envs": 2,
    "num_steps": 4,
    "learning_starts": 4,
    "batch_size": 2,
    "buffer_size": 16,
}


@pytest.mark.parametrize("algorithm", ["dqn", "td3"])
def test_a_policy_is_trained_stored_and_plays_joint_actions(algorithm: str, tmp_path: Path):
    folder = rl2grid.train(
        algorithm,
        "bus14-H0",
        folder=tmp_path / "run",
        hyperparameters=SMALL,
        validation_months=0,
        progress=False,
    )
    agent = rl2grid.load(folder)
    env = gymnasium.make("rl2grid/bus14-H0-v0", disable_env_checker=True)
    observation, info = env.reset(seed=0)
    agent.bind(env)
    action = agent.act(observation, info)
    assert env.action_space.contains({**action, "topology": np.int64(action["topology"])})
    env.step(action)
    assert isinstance(agent, ExplainingAgent)
    considered = agent.explain()
    assert (considered is None) == (algorithm == "td3")
    if considered is not None:
        assert {"topology", "injection"} == set(considered.actions[0])
        np.testing.assert_array_equal(considered.actions[0]["injection"], action["injection"])


def test_a_run_broken_off_and_resumed_ends_like_one_that_was_not(tmp_path: Path):
    chosen = hyperparameters("dqn", "bus14-H0", **{**SMALL, "total_timesteps": 32})
    asked = RunArgs(
        task="bus14-H0", hyperparameters=chosen, algorithm="dqn", folder=tmp_path / "straight", evaluate_every=16,
        validation_months=1, progress=False,
    )  # fmt: skip

    def stop(*_: Any) -> Any:
        raise KeyboardInterrupt

    straight = train(asked, evaluate=falling)
    with pytest.raises(KeyboardInterrupt):
        train(replace(asked, folder=tmp_path / "run"), evaluate=stop)
    resumed = resume(tmp_path / "run", evaluate=falling)
    assert rl2grid.load(resumed).identity["policy_hash"] == rl2grid.load(straight).identity["policy_hash"]
