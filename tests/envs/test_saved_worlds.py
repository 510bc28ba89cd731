"""Environments and vectors go on from a saved world as the original did; imagined worlds and foresight show."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.engines import worlds
from rl2grid.envs.vector import PowerGridVectorEnv
from rl2grid.errors import UsageError
from rl2grid.scenarios.library import list_scenarios

CALM = {"heuristic": "idle", "split": "bundled", "maintenance": False}
"""Keywords with which an episode of a bundled series of bus14 may end inside ``reset``."""


def make(task: str, **keywords: Any) -> Any:
    return gymnasium.make(f"rl2grid/{task}-v0", disable_env_checker=True, **keywords).unwrapped


def action_of(env: Any, k: int) -> Any:
    """A random action, nothing every other time."""
    random, space = np.random.default_rng(k), env.action_space
    if isinstance(space, gymnasium.spaces.Discrete):
        return int(random.integers(space.n)) if k % 2 else 0
    if isinstance(space, gymnasium.spaces.Dict):
        topology = int(random.integers(env.task.n_topology_actions)) if k % 2 else 0
        values = random.uniform(-0.3, 0.3, env.task.n_injections) if k % 3 else np.zeros(env.task.n_injections)
        return {"topology": topology, "injection": values.astype(np.float32)}
    values = random.uniform(-0.3, 0.3, space.shape) if k % 2 else np.zeros(space.shape)
    return values.astype(np.float32)


def played(env: Any, first: int, n: int) -> list[Any]:
    """Everything that an environment returns over some decisions, and over the resets between them."""
    returned = []
    for k in range(first, first + n):
        returned.append(env.step(action_of(env, k)))
        if returned[-1][2] or returned[-1][3]:
            returned.append(env.reset())
    return returned


def two_days() -> dict[str, Any]:
    """Options of a reset: a scenario of bus14 that the idle heuristic completes inside ``reset``."""
    return {
        "scenario": next(name for name in list_scenarios("bus14", "bundled") if "rte_case14" not in name),
        "start": 0,
    }


# --- True worlds ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "keywords"),
    [
        ("bus14-T0", {}),
        ("bus14-T0", {"heuristic": "idle", "gamma": 0.9}),
        ("bus14-R", {"heuristic": "recovery"}),
        ("bus14-H0", {"heuristic": "recovery"}),
        ("bus36-MO-v0-T0", {"heuristic": "careful", "split": "validation"}),
        ("bus36-MO-v1-R", {"dispatch": "grid2op"}),
        ("bus118-MOB-v1-T0", {"normalize": None}),
        ("bus118-MOB-v1-R", {"heuristic": "recovery", "split": "bundled"}),
    ],
)
def test_what_follows_a_restored_world_is_what_followed_the_original(task: str, keywords: dict[str, Any]):
    env, other = make(task, **keywords), make(task, **keywords)
    env.reset(seed=11)
    other.reset(seed=2)
    for moment in range(3):
        played(env, 20 * moment, 9)
        last = env.step(action_of(env, 20 * moment + 9))
        world = env.save()
        if last[2] or last[3]:
            env.reset()
            world = env.save()
        straight = played(env, 20 * moment + 10, 12)
        observation, info = other.restore(pickle.loads(pickle.dumps(world)))
        assert other.save() == world
        if not (last[2] or last[3]):
            np.testing.assert_array_equal(observation, last[0])
            np.testing.assert_equal(info, last[4])
        np.testing.assert_equal(played(other, 20 * moment + 10, 12), straight)
        env.restore(world)
        np.testing.assert_equal(played(env, 20 * moment + 10, 12), straight)


def test_an_ending_inside_reset_is_still_returned():
    env, other = make("bus14-T0", **CALM), make("bus14-T0", **CALM)
    options = two_days()
    _, info = env.reset(seed=0, options=options)
    assert info["over"]
    world = env.save()
    expected = env.step(0)
    assert expected[2] or expected[3]
    restored = other.restore(world)
    assert restored[1]["over"]
    np.testing.assert_equal(other.step(0), expected)
    np.testing.assert_equal(other.reset(), env.reset())


@pytest.mark.parametrize("task", ["bus14-T0", "bus118-MOB-v1-R"])
def test_worlds_go_from_row_to_row_and_between_vectors_and_single_environments(task: str):
    vector, other = (PowerGridVectorEnv(f"{task}", 3, heuristic="idle") for _ in range(2))
    single = make(task, heuristic="idle")
    vector.reset(seed=3)
    other.reset(seed=30)

    def actions(k: int) -> list[Any]:
        return [action_of(single, 10 * k + i) for i in range(3)]

    for k in range(6):
        observations, *_, infos = vector.step(actions(k))
    worlds = [vector.save(i) for i in range(3)]
    for i in range(3):
        observation, info = other.restore(2 - i, worlds[i])
        np.testing.assert_array_equal(observation, observations[i])
        assert info["action_effect"] == str(infos["action_effect"][i])
        assert info["grid_steps"] == infos["grid_steps"][i]
    single.restore(worlds[1])
    alone = True
    for k in range(6, 14):
        chosen = actions(k)
        straight, moved = vector.step(np.array(chosen)), other.step(np.array(chosen[::-1]))
        for one, two in zip(straight[:4], moved[:4], strict=True):
            np.testing.assert_array_equal(one, two[::-1])
        if alone:
            np.testing.assert_array_equal(single.step(chosen[1])[1], straight[1][1])
            alone = not (straight[2][1] or straight[3][1])
    vector.restore(0, worlds[2])
    assert vector.save(0) == worlds[2]


def test_a_world_of_a_version_with_other_keywords_is_refused():
    env = make("bus14-T0")
    env.reset(seed=0)
    world = env.save()
    assert world.standing is not None
    older = world.at(replace(world.standing, options=world.standing.options[:-1]))
    with pytest.raises(UsageError, match="saved by another version of rl2grid"):
        env.restore(older)


def test_worlds_of_something_else_are_refused():
    env, other = make("bus14-T0"), make("bus14-R")
    with pytest.raises(UsageError, match="was not reset yet"):
        env.save()
    env.reset(seed=0)
    other.reset(seed=0)
    before = env.save()
    with pytest.raises(UsageError, match="of rl2grid/bus14-R-v0: it cannot be restored in rl2grid/bus14-T0-v0"):
        env.restore(other.save())
    idle = make("bus14-T0", heuristic="idle")
    idle.reset(seed=0)
    world = idle.save()
    with pytest.raises(UsageError, match="of an environment with heuristic='idle', this one has heuristic=None"):
        env.restore(world)
    with pytest.raises(UsageError, match="of an engine alone"):
        env.restore(env._environments.engine.save(0))
    assert env.save() == before
    vector = PowerGridVectorEnv("bus14-T0", 2)
    for row in (-1, 2, "0"):
        with pytest.raises(UsageError, match="give a number from 0 to 1"):
            vector.save(row)  # type: ignore[arg-type]


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_of_an_environment_are_independent_and_go_on_alike(duplicate: Any):
    env = gymnasium.make("rl2grid/bus36-MO-v0-T0-v0", heuristic="recovery", render_mode="rgb_array")
    env.reset(seed=4)
    for k in range(5):
        if any(env.step(action_of(env, k))[2:4]):
            env.reset()
    twin = duplicate(env)
    before = env.unwrapped.save()
    again = played(twin, 5, 10)
    assert env.unwrapped.save() == before
    np.testing.assert_equal(played(env, 5, 10), again)


def test_an_environment_that_was_never_reset_is_copied_too():
    env = copy.deepcopy(make("bus14-T0"))
    with pytest.raises(UsageError, match="was not reset yet"):
        env.step(0)
    np.testing.assert_equal(env.reset(seed=1), make("bus14-T0").reset(seed=1))


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda envs: pickle.loads(pickle.dumps(envs))])
def test_copies_of_a_vector_are_independent_and_go_on_alike(duplicate: Any):
    vector = PowerGridVectorEnv("bus14-T0", 3, num_threads=2)
    vector.reset(seed=4)
    for _ in range(8):
        vector.step(np.random.default_rng(1).integers(50, size=3))
    twin = duplicate(vector)
    assert twin.state_dict() == vector.state_dict()
    for k in range(12):
        actions = np.random.default_rng(k).integers(50, size=3)
        for one, two in zip(vector.step(actions)[:4], twin.step(actions)[:4], strict=True):
            np.testing.assert_array_equal(one, two)


def test_saved_states_are_texts_and_numbers_and_show_what_was_shown():
    vector = PowerGridVectorEnv("bus36-MO-v1-T0", 2, heuristic="idle")
    vector.reset(seed=1)
    for _ in range(4):
        observations, *_, infos = vector.step([1, 7])
    saved = json.loads(json.dumps(vector.state_dict()))
    other = PowerGridVectorEnv("bus36-MO-v1-T0", 2, heuristic="idle")
    again, restored = other.load_state_dict(saved)
    np.testing.assert_array_equal(again, observations)
    assert restored["action_effect"].tolist() == [str(effect) for effect in infos["action_effect"]]
    assert other.state_dict() == vector.state_dict()
    with pytest.raises(UsageError, match="not of this version"):
        other.load_state_dict({"rows": [{"seed": 1, "number": 0, "actions": [3, 4]}] * 2})
    assert other.state_dict() == vector.state_dict()


def test_a_saved_state_that_expands_without_end_is_refused(monkeypatch: pytest.MonkeyPatch):
    vector = PowerGridVectorEnv("bus14-T0", 1)
    vector.reset(seed=1)
    saved = vector.state_dict()
    vector.load_state_dict(saved)
    monkeypatch.setattr(worlds, "MAX_BYTES", 1000)
    with pytest.raises(UsageError, match="not of this version"):
        vector.load_state_dict(saved)


@pytest.mark.parametrize("num_workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_vectors_of_the_reference_engine_come_back_by_playing_again(num_workers: int):
    vector = PowerGridVectorEnv("bus14-T0", 2, engine="reference", num_workers=num_workers)
    vector.reset(seed=3)
    for k in range(4):
        vector.step([0, k])
    world, state = vector.save(1), vector.state_dict()
    twin = copy.deepcopy(vector)
    expected = vector.step([0, 9])
    observation, _ = twin.restore(0, world)
    assert twin.save(0) == world
    np.testing.assert_array_equal(twin.step([9, 9])[0], np.array([expected[0][1]] * 2))
    twin.load_state_dict(json.loads(json.dumps(state)))
    np.testing.assert_array_equal(twin.step([0, 9])[0], expected[0])
    assert observation.shape == vector.single_observation_space.shape
    with pytest.raises(UsageError, match='choose engine="native"'):
        vector.imagine(0, 0)
    vector.close()
    twin.close()


# --- Imagined worlds and foresight ----------------------------------------------------------------------------------


def test_an_imagined_world_is_played_in_place_and_left_again():
    env = make("bus36-MO-v0-T0", heuristic="idle", split="validation")
    straight = copy.deepcopy(env)
    for each in (env, straight):
        each.reset(seed=5)
    for k in range(6):
        present, endings = env.save(), []
        for seed in range(3):
            observation, info = env.restore(env.imagine(seed))
            assert env.imagined
            np.testing.assert_array_equal(observation, env.restore(present)[0])
            assert info["step"] == env.state.step[0]
            env.restore(env.imagine(seed))
            for _ in range(4):
                endings.append(env.step(0))
                if endings[-1][2] or endings[-1][3]:
                    break
            env.restore(present)
            assert not env.imagined
        np.testing.assert_equal(env.step(k), straight.step(k))
        assert env.foresight == 0
        if env._environments.is_over(0):
            np.testing.assert_equal(env.reset(), straight.reset())


def test_what_is_imagined_ends_like_any_episode_and_is_followed_by_one_of_its_own_stream():
    env = make("bus14-T0", split="bundled")
    env.reset(seed=5)
    length = int(env.state.episode_length[0])
    env.reset(seed=5, options={"start": length - 4})
    truth = env.save()
    env.restore(env.imagine(99))
    truncated = False
    while not truncated:
        *_, terminated, truncated, _ = env.step(0)
        assert not terminated
    assert env.imagined
    _, info = env.reset()
    assert not env.imagined
    other = make("bus14-T0", split="bundled")
    other.reset(seed=99)
    assert other.reset()[1]["scenario"] == info["scenario"]
    env.restore(truth)
    assert env.reset()[1]["scenario"] == make_next(5)


def make_next(seed: int) -> str:
    env = make("bus14-T0", split="bundled")
    env.reset(seed=seed)
    scenario: str = env.reset()[1]["scenario"]
    return scenario


def test_an_imagined_world_holds_nothing_of_the_stream_it_came_from():
    env = make("bus36-MO-v0-T0")
    env.reset(seed=123456789)
    world = env.imagine(3)
    assert world.imagined
    assert world.standing is not None
    assert (world.standing.seed, world.standing.plan.seed) == (3, 3)
    assert "123456789" not in json.dumps(world.to_plain())
    for seed in (-1, 0.5, None):
        with pytest.raises(UsageError, match="not negative"):
            env.imagine(seed)


def test_stepping_a_saved_true_world_is_counted_as_foresight():
    env = make("bus14-T0")
    env.reset(seed=1)
    env.step(0)
    assert env.foresight == 0
    world = env.save()
    env.restore(world)  # nothing was seen of what follows
    env.step(0)
    assert env.foresight == 0
    env.step(0)
    env.restore(world)
    env.step(0)
    env.step(0)
    assert env.foresight == 2
    env.step(0)  # nobody has been here before
    assert env.foresight == 2
    env.reset()
    assert env.foresight == 0


@pytest.mark.parametrize("elsewhere", ["copy", "another environment", "a vector"])
def test_foresight_is_noticed_wherever_the_world_was_stepped(elsewhere: str):
    env = make("bus14-T0")
    env.reset(seed=1)
    if elsewhere == "copy":
        copy.deepcopy(env).step(0)
    elif elsewhere == "another environment":
        other = make("bus14-T0")
        other.restore(env.save())
        other.step(0)
    else:
        vector = PowerGridVectorEnv("bus14-T0", 2)
        vector.reset(seed=7)
        vector.restore(1, env.save())
        vector.step([0, 0])
    env.step(0)
    assert env.foresight == 1
    imagining = make("bus14-T0")
    imagining.restore(env.imagine(0))
    imagining.step(0)
    env.step(0)
    assert env.foresight == 1
