"""Runs of DQN, SAC and TD3: folders, and that a kill at any moment changes nothing, the replay memory included."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from killed_runs import KILLED, run_until_killed
from toy_runs import LAYERS, SIZES, assert_same_run, falling, request, table, toy_envs, toy_run

from rl2grid.algorithms.checkpoint import load_checkpoint
from rl2grid.algorithms.policy_agent import load_agent
from rl2grid.errors import UsageError
from rl2grid.training.request import hyperparameters, read_config
from rl2grid.training.runs import resume, train

CASES = [("dqn", "bus14-T0"), ("sac", "bus14-T0"), ("sac", "bus14-R"), ("td3", "bus14-R")]
ALL = pytest.mark.parametrize(("algorithm", "task"), CASES)


@ALL
def test_a_run_folder_holds_everything_about_the_run(tmp_path: Path, algorithm: str, task: str):
    asked = toy_run(tmp_path / "run", algorithm, task)
    folder = train(asked, evaluate=falling, make_envs=toy_envs)
    present = {path.name for path in folder.iterdir()} - {".lock"}
    assert present == {
        "config.json",
        "metrics.csv",
        "checkpoint.pt",
        "best.pt",
        "energy.json",
        "log.txt",
    }  # no replay: it is finished
    args, _ = read_config(folder)
    assert args.hyperparameters == asked.hyperparameters
    agent = load_agent(folder, task)
    assert agent.name == algorithm
    assert agent.identity["decisions"] == 96
    names = set(table(folder)["name"])
    assert {"charts/survival", "charts/episodic_return", "losses/qf_loss", "losses/qf_values"} <= names


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.25], ids=["mapped", "memory"])
@ALL
def test_a_run_killed_at_the_worst_moments_ends_like_one_that_was_not(
    tmp_path: Path, algorithm: str, task: str, share: float
):
    asked = toy_run(tmp_path / "straight", algorithm, task, buffer_memory_share=share)
    straight = train(asked, evaluate=falling, make_envs=toy_envs)
    kills = ["before-step:37", "before-write:2", "after-replace:3", "before-replace:4", "mid-write:1"]
    if share:
        kills.insert(1, "mid-replay:2")
    for kill in kills:
        assert run_until_killed(tmp_path / "run", kill, algorithm, task, buffer_memory_share=share) == KILLED, kill
    resume(tmp_path / "run", evaluate=falling, make_envs=toy_envs)
    assert_same_run(tmp_path / "run", straight)


@ALL
def test_a_run_broken_off_and_resumed_ends_like_one_that_was_not(tmp_path: Path, algorithm: str, task: str):
    class BrokenOffError(Exception):
        pass

    def break_off(agent: Any) -> Any:
        if agent.identity["decisions"] == 192:
            raise BrokenOffError
        return falling(agent)

    straight = train(toy_run(tmp_path / "straight", algorithm, task), evaluate=falling, make_envs=toy_envs)
    with pytest.raises(BrokenOffError):
        train(toy_run(tmp_path / "run", algorithm, task), evaluate=break_off, make_envs=toy_envs)
    assert any((tmp_path / "run" / "replay").glob("*.rows"))
    checkpoint = load_checkpoint(tmp_path / "run" / "checkpoint.pt")
    assert checkpoint["decisions"] == 160
    assert "segments" not in checkpoint["training"]["memory"]  # in files of their own
    resume(tmp_path / "run", evaluate=falling, make_envs=toy_envs)
    assert_same_run(tmp_path / "run", straight)


def test_the_replay_memory_is_needed_to_resume(tmp_path: Path):
    def stop(agent: Any) -> Any:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(toy_run(tmp_path / "run", "dqn", "bus14-T0"), evaluate=stop, make_envs=toy_envs)
    for path in (tmp_path / "run" / "replay").glob("*.rows"):
        path.unlink()
    with pytest.raises(UsageError, match="is missing or too short: the run cannot be resumed"):
        resume(tmp_path / "run", make_envs=toy_envs)


def test_impossible_pairs_are_refused_before_anything_is_made(tmp_path: Path):
    for algorithm, task in (("td3", "bus14-T0"), ("dqn", "bus14-R")):
        with pytest.raises(UsageError, match=f"'{algorithm}' cannot learn .*: choose one of ppo, "):
            hyperparameters(algorithm, task)
        other = toy_run(tmp_path / "run", *CASES[0 if algorithm == "dqn" else 3])
        with pytest.raises(UsageError, match="cannot learn"):
            train(replace(other, task=task), make_envs=toy_envs)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("algorithm", "task"), CASES)
def test_a_run_on_the_grid_broken_off_and_resumed_ends_like_one_that_was_not(tmp_path: Path, algorithm: str, task: str):
    class BrokenOffError(Exception):
        pass

    def break_off(agent: Any) -> Any:
        if agent.identity["decisions"] == 96:
            raise BrokenOffError
        return {"survival": 0.0}

    sizes = {**SIZES, "total_timesteps": 128, "learning_starts": 16}
    changes = {
        "task": task,
        "algorithm": algorithm,
        "hyperparameters": hyperparameters(algorithm, task, **sizes, **LAYERS[algorithm]),
        "env_keywords": {"heuristic": "idle"},
        "evaluate_every": 32,
    }
    straight = train(request(tmp_path / "straight", **changes), evaluate=lambda agent: {"survival": 0.0})
    with pytest.raises(BrokenOffError):
        train(request(tmp_path / "run", **changes), evaluate=break_off)
    resume(tmp_path / "run", evaluate=lambda agent: {"survival": 0.0})
    assert_same_run(tmp_path / "run", straight)
    assert load_checkpoint(straight / "checkpoint.pt")["training"]["grid_steps"] > 128
