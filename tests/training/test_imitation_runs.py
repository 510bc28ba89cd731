"""Runs of imitation: what is stored with them, and that interruptions change nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from labelled_toys import NothingToPlay, write
from toy_runs import assert_same_run, falling, request

from rl2grid.algorithms.policy_agent import load_agent
from rl2grid.errors import UsageError
from rl2grid.records.metrics import read_rows
from rl2grid.training.limits import TimeLimit
from rl2grid.training.request import RunArgs, hyperparameters
from rl2grid.training.runs import is_finished, resume, train


def a_request(folder: Path, *labels: str, **changes: Any) -> RunArgs:
    args = hyperparameters(
        "imitation",
        "bus14-T0",
        **{
            "labels": labels,
            "total_timesteps": 384,
            "num_steps": 32,
            "batch_size": 10,
            "gamma": 0.99,
            "actor_layers": (8,),
            "critic_layers": (8,),
            **changes,
        },
    )
    return request(folder, algorithm="imitation", hyperparameters=args, env_keywords={})


def nothing(args: RunArgs) -> NothingToPlay:
    return NothingToPlay(args.task)


def test_an_interrupted_run_is_the_same(tmp_path: Path):
    labels = write(tmp_path / "labels", "bus14-T0", months=3, n=10)
    straight = train(a_request(tmp_path / "straight", labels), evaluate=falling, make_envs=nothing)
    folder = train(a_request(tmp_path / "run", labels), evaluate=falling, limit=TimeLimit(1e-9), make_envs=nothing)
    assert not is_finished(folder)
    resume(folder, evaluate=falling, make_envs=nothing)
    assert is_finished(folder)
    assert_same_run(folder, straight)
    agent = load_agent(folder, "bus14-T0")
    assert (agent.name, agent.identity["decisions"]) == ("imitation", 96)
    trained_with = agent.identity["trained_with"]
    assert trained_with["labels"]["teacher"] == "greedy"
    assert json.loads((folder / "config.json").read_text())["identity"]["labels"] == trained_with["labels"]
    names = {row["name"] for row in read_rows(folder / "metrics.csv")}
    assert {"losses/imitation_loss", "losses/holdout_loss", "charts/agreement", "charts/holdout_agreement"} <= names
    assert {"charts/holdout_agreement_acting", "losses/value_loss", "validation/survival"} <= names


def test_labels_that_became_more_are_not_gone_on_with(tmp_path: Path):
    labels = write(tmp_path / "labels", "bus14-T0", months=3, n=10)
    folder = train(a_request(tmp_path / "run", labels), limit=TimeLimit(1e-9), make_envs=nothing)
    write(tmp_path / "labels", "bus14-T0", months=4, n=10)
    with pytest.raises(UsageError, match="cannot be resumed: its labels are no longer those it began with"):
        resume(folder, make_envs=nothing)


def test_a_run_that_cannot_be_begun_leaves_nothing(tmp_path: Path):
    with pytest.raises(UsageError, match="needs labels"):
        train(a_request(tmp_path / "run"), make_envs=nothing)
    assert list(tmp_path.iterdir()) == []
