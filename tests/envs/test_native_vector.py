"""The vector environment of the native engine: what it returns, bit for bit, and what it refuses."""

from __future__ import annotations

import copy
import json
from typing import Any

import gymnasium
import numba
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from returned import assert_same, copied, put_together, with_ending

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.envs.vector import PowerGridVectorEnv
from rl2grid.errors import UsageError
from rl2grid.mdp.rewards import PRESETS, default_components
from rl2grid.scenarios.library import list_scenarios, load_scenario

TASKS = ("bus14-T0", "bus14-R", "bus118-MOB-v1-T0", "bus118-MOB-v1-R")
HEURISTICS = (None, "idle", "recovery", "careful", "secure")
TOLERANCE = 1e-4
"""Of features divided by their physical scale, and of rewards of a grid step: the engines solve the flow to 1e-6."""


def make_vector(task: str, num_envs: int, **keywords: Any) -> PowerGridVectorEnv:
    return PowerGridVectorEnv(f"rl2grid/{task}-v0", num_envs, **keywords)


def make_single(task: str, **keywords: Any) -> Any:
    return gymnasium.make(f"rl2grid/{task}-v0", disable_env_checker=True, **keywords).unwrapped


def action_of(task: Any, seed: int, decision: int) -> Any:
    """What the environment of a seed is asked to do: now and then nothing, else anything, ineffective or not."""
    random = np.random.default_rng([seed, decision])
    if task.kind == "T":
        return int(random.integers(task.n_actions)) if random.random() < 0.7 else 0
    size = 0.3 * float(random.random() < 0.7)
    return random.uniform(-size, size, task.n_actions).astype(np.float32)


def actions_of(vector: PowerGridVectorEnv, seeds: list[int], decision: int) -> Any:
    return np.array([action_of(vector.task, seed, decision) for seed in seeds])


def play(vector: PowerGridVectorEnv, seeds: list[int], decisions: int) -> list[Any]:
    """Copies of everything that a vector returns, from the reset on."""
    returned = [copied(vector.reset(seed=seeds))]
    for decision in range(decisions):
        returned.append(copied(vector.step(actions_of(vector, seeds, decision))))
    return returned


class Singles:
    """Single environments put together as Gymnasium's vector environments do."""

    def __init__(self, task: str, seeds: list[int], **keywords: Any) -> None:
        self._seeds = seeds
        self._envs = [make_single(task, **keywords) for _ in seeds]

    def play(self, decisions: int) -> list[Any]:
        """What :func:`play` returns."""
        begun = [env.reset(seed=seed) for env, seed in zip(self._envs, self._seeds, strict=True)]
        returned: list[Any] = [(np.stack([one[0] for one in begun]), put_together([one[1] for one in begun]))]
        return returned + [self._step(decision) for decision in range(decisions)]

    def _step(self, decision: int) -> Any:
        observations, rewards, terminated, truncated, infos = [], [], [], [], []
        for env, seed in zip(self._envs, self._seeds, strict=True):
            observation, reward, over, complete, info = env.step(action_of(env.task, seed, decision))
            if over or complete:
                last, (observation, begun) = observation, env.reset()
                info = with_ending(begun, last, info)
            observations.append(observation)
            rewards.append(reward)
            terminated.append(over)
            truncated.append(complete)
            infos.append(info)
        return np.stack(observations), np.array(rewards), np.array(terminated), np.array(truncated), put_together(infos)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("heuristic", HEURISTICS)
def test_equals_single_environments_put_together_by_gymnasium(task, heuristic):
    seeds = [3, 4, 7]
    keywords = {"heuristic": heuristic, "gamma": 0.99}
    vector = make_vector(task, len(seeds), **keywords)
    mine = play(vector, seeds, 40)
    theirs = Singles(task, seeds, **keywords).play(40)
    for decision, pair in enumerate(zip(mine, theirs, strict=True)):
        assert_same(*pair, f"{decision - 1}")
    if heuristic not in (None, "secure") or not task.endswith("-R"):  # which are not lost that soon
        assert any((one[2] | one[3]).any() for one in mine[1:]), "no episode ended: the test did not see an autoreset"


def test_several_endings_in_a_step_and_none_are_put_together_as_gymnasium_does():
    seeds = list(range(12))
    mine = play(make_vector("bus14-T0", len(seeds)), seeds, 12)
    theirs = Singles("bus14-T0", seeds).play(12)
    for decision, pair in enumerate(zip(mine, theirs, strict=True)):
        assert_same(*pair, f"{decision - 1}")
    ends = {int((one[2] | one[3]).sum()) for one in mine[1:]}
    assert 0 in ends, "every step ended an episode"
    assert max(ends) > 1, "no step ended several"


def assert_close(mine: Any, theirs: Any, where: str = "") -> None:
    """As :func:`assert_same`, floats within TOLERANCE."""
    if isinstance(theirs, dict):
        for key in theirs:
            if key not in ("action_effect", "_action_effect"):  # numbers in words
                assert_close(mine[key], theirs[key], f"{where}/{key}")
    elif isinstance(theirs, tuple) or (isinstance(theirs, np.ndarray) and theirs.dtype == object):
        for k, pair in enumerate(zip(mine, theirs, strict=True)):
            assert_close(*pair, f"{where}/{k}")
    elif isinstance(theirs, np.ndarray) and np.issubdtype(theirs.dtype, np.floating):
        np.testing.assert_allclose(mine, theirs, rtol=TOLERANCE, atol=TOLERANCE, err_msg=where)
    else:
        assert_same(mine, theirs, where)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("heuristic", HEURISTICS)
def test_equals_the_reference_engine(task, heuristic):
    seeds, decisions = [13, 26], 40 if heuristic is None else 8  # their heuristics have little to wait for
    keywords = {"heuristic": heuristic, "gamma": 0.99}
    reference = make_vector(task, len(seeds), engine="reference", num_workers=0, **keywords)
    native = make_vector(task, len(seeds), **keywords)
    pairs = zip(play(native, seeds, decisions), play(reference, seeds, decisions), strict=True)
    for decision, (mine, theirs) in enumerate(pairs):
        assert_close(mine, theirs, f"{decision - 1}")
    reference.close()


@pytest.mark.parametrize("task", TASKS)
def test_batch_size_order_and_threads_do_not_matter(task):
    seeds = list(range(24))
    keywords = {"heuristic": "idle"}
    together = play(make_vector(task, 24, num_threads=1, **keywords), seeds, 8)
    threads = play(make_vector(task, 24, num_threads=4, **keywords), seeds, 8)
    for mine, theirs in zip(threads, together, strict=True):
        assert_same(mine, theirs)
    chosen = [17, 2, 23]
    few = play(make_vector(task, 3, **keywords), chosen, 8)
    for mine, theirs in zip(few, together, strict=True):
        for array, whole in zip(mine[:-1], theirs[:-1], strict=True):
            np.testing.assert_array_equal(array, whole[chosen])
        np.testing.assert_array_equal(mine[-1]["episode_return"], theirs[-1]["episode_return"][chosen])


def test_an_ending_is_shown_and_the_next_episode_begins_in_the_same_step():
    vector = make_vector("bus14-T0", 4)
    assert vector.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    vector.reset(seed=0)
    for decision in range(200):
        actions = actions_of(vector, [0, 1, 2, 3], decision)
        observations, rewards, terminated, truncated, infos = vector.step(actions)
        ended = terminated | truncated
        if ended.any() and not ended.all():
            break
    else:
        pytest.fail("no episode ended alone")
    np.testing.assert_array_equal(infos["_final_obs"], ended)
    np.testing.assert_array_equal(infos["_final_info"], ended)
    for i in range(4):
        if not ended[i]:
            assert infos["final_obs"][i] is None
            assert infos["step"][i] > 0
            continue
        assert infos["step"][i] == infos["decisions"][i] == 0
        assert infos["final_info"]["step"][i] > 0
        assert infos["final_info"]["game_over_text"][i]
        assert not infos["game_over_text"][i]
        assert infos["grid_steps"][i] == infos["final_info"]["grid_steps"][i] == infos["final_info"]["step"][i]
        assert not np.array_equal(infos["final_obs"][i], observations[i])
        assert rewards[i] == 0.0, "the step of a game over pays nothing"


def two_days_without_a_decision() -> str:
    """A scenario of bus14 that the idle heuristic completes inside ``reset``."""
    return next(name for name in list_scenarios("bus14", "bundled") if "rte_case14" not in name)


def test_an_episode_that_is_over_inside_reset_is_returned_by_the_next_step():
    vector = make_vector("bus118-MOB-v1-T0", 3, heuristic="idle", split="bundled")
    vector.reset(seed=0)
    vector.step([1, 1, 1])
    refused = vector.step([1, 1, 1])[-1]["action_effect"]
    assert "cools down" in str(refused[0]), "an action must have been refused, of which nothing may show later"
    scenario = list_scenarios("bus118-MOB-v1", "bundled")[0]
    last = load_scenario("bus118-MOB-v1", scenario).n_steps - 1
    observations, infos = vector.reset(seed=0, options={"scenario": scenario, "start": last})
    assert infos["over"].all()
    observations, earned = observations.copy(), infos["reset_reward"].copy()
    assert (earned > 0).all()
    _, rewards, terminated, truncated, infos = vector.step([1, 1, 1])
    assert truncated.all()
    assert not terminated.any()
    np.testing.assert_array_equal(np.stack(infos["final_obs"]), observations)
    final = infos["final_info"]
    np.testing.assert_array_equal([final["n_steps"], rewards], 0)
    np.testing.assert_array_equal(final["reset_reward"], earned)
    np.testing.assert_array_equal(final["episode_return"], earned)
    np.testing.assert_array_equal(final["decisions"], [0, 0, 0])
    assert not final["over"].any()
    assert not final["illegal"].any()
    assert [str(effect) for effect in final["action_effect"]] == ["", "", ""]


@pytest.mark.parametrize("task", ["bus14-T0", "bus118-MOB-v1-R"])
@pytest.mark.parametrize("heuristic", [None, "recovery"])
def test_a_saved_state_is_restored_by_playing_again(task, heuristic):
    seeds = [1, 2, 3]
    straight, resumed = (make_vector(task, 3, heuristic=heuristic, gamma=0.9) for _ in range(2))
    played = play(straight, seeds, 25)
    saved = json.loads(json.dumps(straight.state_dict()))
    observations, infos = copied(resumed.load_state_dict(saved))
    np.testing.assert_array_equal(observations, played[-1][0])
    for key in ("scenario", "step", "decisions", "episode_return", "grid_steps", "over"):
        np.testing.assert_array_equal(infos[key], played[-1][-1][key])
    assert resumed.state_dict() == straight.state_dict()
    for decision in range(25, 35):
        actions = actions_of(straight, seeds, decision)
        assert_same(copied(resumed.step(actions)), copied(straight.step(actions)))


def test_a_state_saved_before_a_pending_ending_is_restored():
    keywords = {"heuristic": "idle", "split": "bundled", "maintenance": False}
    straight, resumed = (make_vector("bus14-T0", 2, **keywords) for _ in range(2))
    straight.reset(seed=0, options={"scenario": two_days_without_a_decision(), "start": 0})
    resumed.load_state_dict(straight.state_dict())
    assert_same(copied(resumed.step([0, 0])), copied(straight.step([0, 0])))


def test_a_state_of_another_size_is_refused():
    vector = make_vector("bus14-T0", 2)
    vector.reset(seed=0)
    with pytest.raises(UsageError, match="has 2 environments, this vector has 3"):
        make_vector("bus14-T0", 3).load_state_dict(vector.state_dict())


def test_observations_stay_for_one_more_step_and_all_else_for_good():
    vector = make_vector("bus14-T0", 3)
    returned = [vector.reset(seed=0)]
    kept = [copied(returned[0])]
    for decision in range(6):
        returned.append(vector.step(actions_of(vector, [0, 1, 2], decision)))
        kept.append(copied(returned[-1]))
        np.testing.assert_array_equal(returned[-2][0], kept[-2][0])
    assert np.shares_memory(returned[-1][0], returned[-3][0]), "two buffers: copy what has to last longer"
    for mine, theirs in zip(returned, kept, strict=True):
        assert_same(copied(mine)[1:], theirs[1:])


def test_a_reset_without_seeds_takes_the_next_episodes():
    vector, again = make_vector("bus14-T0", 2), make_vector("bus14-T0", 2)
    vector.reset(seed=7)
    following = copied(vector.reset())
    again.reset(seed=[7, 8])
    assert_same(copied(again.reset()), following)
    assert not np.array_equal(following[0], copied(again.reset(seed=7))[0])


def test_masks_are_those_of_the_rules():
    vector = make_vector("bus36-M-T0", 2)
    vector.reset(seed=0)
    assert vector.action_masks().all()
    vector.step([1, 0])
    masks = vector.action_masks()
    assert not masks[0].all()
    assert masks[0, 0]
    assert masks[1].all()
    np.testing.assert_array_equal(masks, vector.call("action_masks"))
    with pytest.raises(UsageError, match="has continuous actions"):
        make_vector("bus14-R", 1).action_masks()


def test_effects_are_put_into_words_and_stay_what_they_were():
    vector = make_vector("bus36-M-T0", 2)
    vector.reset(seed=0)
    vector.step([1, 0])
    effects = vector.step([1, 0])[-1]["action_effect"]
    assert "cools down for" in str(effects[0])
    assert str(effects[1]) == ""
    words = str(effects[0])
    for _ in range(3):
        vector.step([0, 0])
    assert str(effects[0]) == words
    assert effects[1] == "", "nothing is made for a row of which there is nothing to say"
    redispatching = make_vector("bus14-R", 2, split="bundled")
    redispatching.reset(seed=0)
    said = [str(redispatching.step(np.ones((2, 6), np.float32))[-1]["action_effect"][0]) for _ in range(12)]
    assert any(text.startswith(("clipped", "refused")) for text in said)


# --- The slow paths: Python at every grid step -----------------------------------------------------------------------


@numba.njit
def doubled(state, i):
    """A reward of a user."""
    survive, overload, cost = default_components(state, i)
    return 2.0 * survive, overload, 0.0 * cost


@pytest.mark.parametrize("task", ["bus14-T0", "bus118-MOB-v1-R"])
def test_a_reward_of_the_user_changes_rewards_only(task):
    seeds, keywords = [1, 2], {"heuristic": "idle", "gamma": 0.9}
    own = play(make_vector(task, 2, reward=doubled, **keywords), seeds, 15)
    built_in = play(make_vector(task, 2, reward=(2.0, 1.0, 0.0), **keywords), seeds, 15)
    for mine, theirs in zip(own, built_in, strict=True):
        for array, other in zip(mine[:-1], theirs[:-1], strict=True):
            np.testing.assert_array_equal(array, other)
        for key in ("step", "episode_return", "discounted_reward", "illegal", "grid_steps"):
            np.testing.assert_array_equal(mine[-1][key], theirs[-1][key])
        assert [str(x) for x in mine[-1]["action_effect"]] == [str(x) for x in theirs[-1]["action_effect"]]


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_pays_what_its_components_say(name):
    """In compiled code, and in Python called after every grid step."""

    def weighted(state, i):
        return tuple(np.multiply(PRESETS[name].weights, PRESETS[name].components(state, i)))

    keywords = {"heuristic": "careful", "gamma": 0.9}
    built_in = play(make_vector("bus36-MO-v0-T0", 4, reward=name, **keywords), [1, 2, 3, 4], 25)
    own = play(make_vector("bus36-MO-v0-T0", 4, reward=weighted, **keywords), [1, 2, 3, 4], 25)
    for mine, theirs in zip(own[1:], built_in[1:], strict=True):
        np.testing.assert_allclose(mine[1], theirs[1], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("task", TASKS)
def test_listeners_change_nothing(task):
    heard: list[int] = []
    keywords = {"heuristic": "recovery", "gamma": 0.9}
    listening = Singles(task, [5], **keywords)
    listening._envs[0].step_listeners.append(lambda state, i: heard.append(int(state.step[i])))
    mine = listening.play(25)
    theirs = Singles(task, [5], **keywords).play(25)
    for one, other in zip(mine, theirs, strict=True):
        assert_same(one, other)
    played = mine[-1][-1]["grid_steps"][0] + sum(int((one[2] | one[3])[0]) for one in mine[1:])
    assert len(heard) == played + 1, "every grid step and every reset is heard once"


@pytest.mark.parametrize("task", ["bus14-R", "bus118-MOB-v1-R"])
def test_grid2op_dispatch_equals_the_reference_engine(task):
    seeds, keywords = [11, 12], {"dispatch": "grid2op", "gamma": 0.9}
    reference = make_vector(task, 2, engine="reference", num_workers=0, **keywords)
    pairs = zip(play(make_vector(task, 2, **keywords), seeds, 12), play(reference, seeds, 12), strict=True)
    for decision, (mine, theirs) in enumerate(pairs):
        assert_close(mine, theirs, f"{decision - 1}")
    reference.close()


def test_grid2op_dispatch_does_not_matter_to_topology_tasks_without_storage():
    seeds = [1, 2]
    exact, grid2op = (make_vector("bus14-T0", 2, dispatch=name) for name in ("exact", "grid2op"))
    for mine, theirs in zip(play(grid2op, seeds, 20), play(exact, seeds, 20), strict=True):
        assert_same(mine, theirs)


# --- Refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "actions", "message"),
    [
        ("bus14-T0", [0, 50], "from 0 to 49"),
        ("bus14-T0", [0, -1], "from 0 to 49"),
        ("bus14-T0", [0.0, 1.0], "from 0 to 49"),
        ("bus14-T0", [0], "give one each"),
        ("bus14-T0", [[0, 1], [1, 2]], "from 0 to 49"),
        ("bus14-R", np.zeros((2, 5), np.float32), r"must have shape \(6,\)"),
        ("bus14-R", np.full((2, 6), np.nan), "NaN"),
        ("bus14-R", np.full((2, 6), 1.5), "must lie in"),
        ("bus14-R", np.zeros((3, 6), np.float32), "give one each"),
        ("bus14-R", ["up", "down"], "action"),
    ],
)
def test_a_refused_action_steps_no_environment(task, actions, message):
    vector = make_vector(task, 2)
    vector.reset(seed=0)
    before = copy.deepcopy(vector.state_dict())
    with pytest.raises(UsageError, match=message):
        vector.step(actions)
    assert vector.state_dict() == before


def test_a_step_before_the_first_reset_is_refused():
    with pytest.raises(UsageError, match="call reset first"):
        make_vector("bus14-T0", 2).step([0, 0])


def test_wrong_reset_options_are_refused():
    vector = make_vector("bus14-T0", 2)
    with pytest.raises(UsageError, match="is not in the split train of bus14: choose one such as"):
        vector.reset(options={"scenario": "no such month"})
    with pytest.raises(UsageError, match="choose from scenario, start"):
        vector.reset(options={"row": 3})
    with pytest.raises(UsageError, match="give one each"):
        vector.reset(seed=[1, 2, 3])
    assert vector.reset(seed=0)[0].shape[0] == 2


def test_a_reset_refused_in_one_environment_leaves_all_where_they_were():
    vector = make_vector("bus14-T0", 2, split="bundled")
    vector.reset(seed=0)
    vector.step([0, 0])
    before = copy.deepcopy(vector.state_dict())
    with pytest.raises(UsageError, match="leaves nothing to play"):
        vector.reset(seed=[6, 7], options={"start": 600})  # only the second plays a series that short
    assert vector.state_dict() == before


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"num_envs": 0}, "num_envs=0 is not allowed"),
        ({"num_envs": 2, "num_threads": 0}, "num_threads=0 is not allowed"),
        ({"num_envs": 2, "num_threads": 1.5}, "num_threads=1.5 is not allowed"),
        ({"num_envs": 2, "num_workers": 1}, "num_workers=1 is not for engine='native': give num_threads"),
    ],
)
def test_wrong_sizes_are_refused(keywords, message):
    with pytest.raises(UsageError, match=message):
        make_vector("bus14-T0", **keywords)
