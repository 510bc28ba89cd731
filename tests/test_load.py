"""``rl2grid.load``: a run becomes an agent in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import torch

import rl2grid
from rl2grid.algorithms.checkpoint import load_checkpoint
from rl2grid.errors import UsageError
from rl2grid.training.request import RunArgs, hyperparameters
from rl2grid.training.runs import train


def run_folder(folder: Path) -> Path:
    sizes: dict[str, Any] = {"num_envs": 2, "num_steps": 8, "total_timesteps": 16, "update_epochs": 1}
    args = RunArgs(
        task="bus14-T0",
        hyperparameters=hyperparameters("ppo", "bus14-T0", **sizes),
        folder=folder,
        env_keywords={"heuristic": "idle"},
        num_threads=1,
        tensorboard=False,
        progress=False,
    )
    return train(args, evaluate=lambda agent: {"survival": 0.0})


def test_a_run_becomes_an_agent_that_plays(tmp_path: Path):
    folder = run_folder(tmp_path / "run")
    agent = rl2grid.load(str(folder))
    env = gymnasium.make(agent.task, **{**agent.env_keywords, "split": "validation"})
    agent.bind(env)
    observation, info = env.reset(seed=0)
    for _ in range(3):
        observation, _, terminated, truncated, info = env.step(agent.act(observation, info))
        if terminated or truncated:
            break
    env.close()
    for name in ("best.pt", "checkpoint.pt"):
        assert rl2grid.load(folder / name).identity["policy_hash"] == agent.identity["policy_hash"]
    assert load_checkpoint(folder / "best.pt")["decisions"] == agent.identity["decisions"]


def test_what_is_no_run_is_refused_and_never_executed(tmp_path: Path):
    class Payload:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "executed"),)

    torch.save({"format": 1, "policy": Payload()}, tmp_path / "best.pt")
    for path in (tmp_path, tmp_path / "best.pt"):
        with pytest.raises(UsageError, match="is not a checkpoint that can be read"):
            rl2grid.load(path)
    assert not (tmp_path / "executed").exists()
    with pytest.raises(UsageError, match="does not exist: give a run folder, a checkpoint, or pretrained/NAME"):
        rl2grid.load(tmp_path / "elsewhere")
    (tmp_path / "labels").mkdir()
    with pytest.raises(UsageError, match="holds no policy: give one that 'rl2grid train' wrote"):
        rl2grid.load(tmp_path / "labels")


def test_the_package_is_imported_without_pytorch():
    command = "import sys, rl2grid; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", command]).returncode == 0
