"""Small trainings on :mod:`toy_grid`, and whether two of them are the same run: what test modules of runs share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from toy_grid import ToyGrid

from rl2grid.algorithms.checkpoint import load_checkpoint
from rl2grid.algorithms.policy_agent import PolicyAgent
from rl2grid.algorithms.ppo import Args
from rl2grid.training.request import RunArgs, hyperparameters

SMALL = Args(
    seed=5,
    total_timesteps=4 * 8 * 12,
    num_envs=4,
    num_steps=8,
    gamma=0.9,
    update_epochs=2,
    actor_layers=(8,),
    critic_layers=(8,),
)
TIMES = ["charts/SPS", "charts/grid_SPS", "charts/environment_share"]
SIZES: dict[str, Any] = {
    "seed": 5,
    "total_timesteps": 4 * 8 * 12,
    "num_envs": 4,
    "num_steps": 8,
    "learning_starts": 40,
    "batch_size": 8,
    "buffer_size": 160,
    "gamma": 0.9,
}
LAYERS: dict[str, dict[str, Any]] = {
    "dqn": {"layers": (8,)},
    "sac": {"actor_layers": (8,), "critic_layers": (8,)},
    "td3": {"actor_layers": (8,), "critic_layers": (8,)},
}


def request(folder: Path, **changes: Any) -> RunArgs:
    """A request for a small training with PPO, some of it changed."""
    request = RunArgs(
        task="bus14-T0",
        hyperparameters=SMALL,
        folder=folder,
        env_keywords={"heuristic": "idle", "reward": (1.0, 0.5, 0.25)},
        checkpoint_seconds=0.0,
        evaluate_every=96,
        tensorboard=False,
        progress=False,
    )
    return replace(request, **changes)


def toy_run(folder: Path, algorithm: str, task: str, **changes: Any) -> RunArgs:
    """A request for a small training with any algorithm, some hyperparameters changed."""
    if algorithm == "ppo":
        return request(folder, task=task, hyperparameters=replace(SMALL, **changes))
    args = hyperparameters(algorithm, task, **{**SIZES, **LAYERS[algorithm], **changes})
    return request(folder, algorithm=algorithm, task=task, hyperparameters=args)


def toy_envs(args: RunArgs) -> ToyGrid:
    continuous = args.task.kind == "R"
    return ToyGrid(args.hyperparameters.num_envs, gamma=args.hyperparameters.gamma, continuous=continuous)


def falling(agent: PolicyAgent) -> Mapping[str, float]:
    """A validation that likes the policy after 96 decisions best."""
    return {"survival": 1.0 - abs(agent.identity["decisions"] - 96) / 1000, "return": 2.0}


def table(folder: Path) -> pd.DataFrame:
    """The metrics of a run that do not depend on the speed of the machine."""
    metrics = pd.read_csv(folder / "metrics.csv").drop(columns=["wall_time", "checksum"])
    return metrics[~metrics["name"].isin(TIMES)].reset_index(drop=True)


def assert_same_run(mine: Path, theirs: Path) -> None:
    """The same weights, optimiser, random states, environments, counters, metrics and best policy."""
    assert_same(*(load_checkpoint(folder / "checkpoint.pt")["training"] for folder in (mine, theirs)))
    assert_same(*(load_checkpoint(folder / "checkpoint.pt")["policy"] for folder in (mine, theirs)))
    pd.testing.assert_frame_equal(table(mine), table(theirs), check_exact=True)
    if (theirs / "best.pt").exists():
        assert_same(*(load_checkpoint(folder / "best.pt")["policy"] for folder in (mine, theirs)))


def assert_same(mine: Any, theirs: Any, where: str = "") -> None:
    if isinstance(mine, dict):
        assert mine.keys() == theirs.keys(), where
        for key in mine:
            assert_same(mine[key], theirs[key], f"{where}/{key}")
    elif isinstance(mine, list | tuple):
        assert len(mine) == len(theirs), where
        for k, (one, other) in enumerate(zip(mine, theirs, strict=True)):
            assert_same(one, other, f"{where}/{k}")
    elif isinstance(mine, torch.Tensor | np.ndarray):
        assert type(mine) is type(theirs), where
        assert mine.dtype == theirs.dtype, where
        equal = torch.equal if isinstance(mine, torch.Tensor) else np.array_equal
        assert equal(mine, theirs), where
    else:
        assert str(mine) == str(theirs), where
