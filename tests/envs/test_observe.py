"""Observations by name, and questions to every environment of a vector."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.errors import UsageError
from rl2grid.mdp.features import feature_slices, physical_scale

TASKS = ["rl2grid/bus14-T0-v0", "rl2grid/bus118-MOB-v0-R-v0"]
SINGLE = {"split": "bundled"}


@pytest.mark.parametrize("task", TASKS)
def test_an_observation_by_name_is_the_flat_one_in_units(task: str):
    env: Any = gymnasium.make(task, **SINGLE).unwrapped
    with pytest.raises(UsageError, match="call reset first"):
        env.observe()
    flat, _ = env.reset(seed=0)
    for _ in range(3):
        flat = env.step(env.action_space.sample() * 0)[0]
    named, scaled = env.observe(), env.observe(scaled=True)
    slices = feature_slices(env.grid, env.task.kind)
    assert list(named) == list(scaled) == list(slices)
    np.testing.assert_array_equal(np.concatenate(list(scaled.values())), flat)
    shift, scale = physical_scale(env.grid, env.task.kind)
    for name, part in slices.items():
        assert named[name].dtype == np.float32
        np.testing.assert_allclose(named[name], flat[part] * scale[part] + shift[part], rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(named["rho"], env.state.rho[0])
    np.testing.assert_array_equal(named["gen_p"], env.state.gen_p[0])
    raw, _ = gymnasium.make(task, normalize=None, **SINGLE).reset(seed=0)
    again, _ = env.reset(seed=0)
    np.testing.assert_array_equal(np.concatenate(list(env.observe().values())), raw)
    assert again.shape == raw.shape


@pytest.mark.parametrize("keywords", [{"num_threads": 1}, {"engine": "reference", "num_workers": 0}])
def test_every_environment_of_a_vector_is_asked(keywords: dict[str, Any]):
    envs: Any = gymnasium.make_vec(TASKS[0], num_envs=3, **keywords)
    observations, _ = envs.reset(seed=0)
    by_name = envs.call("observe", scaled=True)
    assert len(by_name) == 3
    for row, named in zip(observations, by_name, strict=True):
        np.testing.assert_array_equal(np.concatenate(list(named.values())), row)
    assert envs.unwrapped.observe()["rho"].shape == (3, 20)
    np.testing.assert_array_equal(envs.unwrapped.observe(True)["rho"][1], by_name[1]["rho"])
    np.testing.assert_array_equal(np.stack(envs.call("action_masks")), envs.action_masks())
    assert envs.call("describe_action", 0) == ("do nothing",) * 3
    assert [task.id for task in envs.get_attr("task")] == [TASKS[0]] * 3
    assert envs.get_attr("foresight") == (0, 0, 0)
    states = envs.get_attr("state")
    np.testing.assert_array_equal(states[2].rho[0], by_name[2]["rho"])
    assert envs.get_attr("observation_space")[0] == envs.single_observation_space
    results = envs.call("simulate", 0)
    assert [result.observation.shape for result in results] == [observations[0].shape] * 3
    envs.close()


def test_attributes_of_ones_own_are_kept_and_others_refused():
    envs: Any = gymnasium.make_vec(TASKS[0], num_envs=2, num_threads=1)
    envs.set_attr("colour", ["red", "blue"])
    envs.set_attr("weight", 3)
    assert envs.get_attr("colour") == ("red", "blue")
    assert envs.call("weight") == (3, 3)
    with pytest.raises(UsageError, match="3 values were given for 2 environments"):
        envs.set_attr("colour", [1, 2, 3])
    for name in ("options", "task", "step", "state"):
        with pytest.raises(UsageError, match="cannot be set: make the vector with the keywords"):
            envs.set_attr(name, None)
    for name in ("step", "reset", "close", "_environments", "frobnicate"):
        with pytest.raises(UsageError, match="does not exist: choose one of task, options"):
            envs.call(name)
    envs.close()


SCRIPT = """
import gymnasium
import rl2grid


def loading(state, i):
    return float(state.rho[i].max())


keywords = {"num_envs": 2, "split": "bundled", "reward": loading}
for more in ({}, {"engine": "reference", "num_workers": 1}):
    envs = gymnasium.make_vec("rl2grid/bus14-T0-v0", **keywords, **more)
    envs.reset(seed=0)
    rewards = envs.step([0, 0])[1]
    for reward, named in zip(rewards, envs.call("observe"), strict=True):
        print(f"{reward:.4f} {named['rho'].max():.4f}")
    envs.close()
"""


@pytest.mark.slow
def test_worker_processes_are_asked_and_know_a_reward_of_the_script(tmp_path: Path):
    """In a script of its own, whose functions no other process can import."""
    (tmp_path / "script.py").write_text(SCRIPT)
    shown = subprocess.run([sys.executable, tmp_path / "script.py"], capture_output=True, text=True, check=True).stdout
    lines = shown.splitlines()
    assert len(lines) == 4
    assert lines[:2] == lines[2:]
    assert all(len(set(line.split())) == 1 for line in lines), lines
