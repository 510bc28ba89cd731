"""Joint tasks: topology and injections in one decision, and what they share with the tasks of one kind."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.envs.vector import PowerGridVectorEnv
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import Change, StepAction

STORAGE_GRID = "bus118-MOB-v1"
HEURISTICS = (None, "recovery", "careful")


def make(task: str, **keywords: Any) -> Any:
    return gymnasium.make(f"rl2grid/{task}-v0", disable_env_checker=True, **keywords).unwrapped


def together(topology: Any, injection: Any) -> dict[str, Any]:
    return {"topology": topology, "injection": np.asarray(injection, np.float32)}


def joint_action(env: Any, random: np.random.Generator) -> dict[str, Any]:
    """A topology action, legal or not, and a small injection; now and then one of them only."""
    topology = int(random.integers(env.task.n_topology_actions)) if random.random() < 0.6 else 0
    size = 0.2 * float(random.random() < 0.7)
    return together(topology, random.uniform(-size, size, env.task.n_injections))


def play_alike(joint: Any, other: Any, actions: list[tuple[Any, Any]]) -> int:
    """Play pairs of actions in both; what both observe and are told must be the same. Returns the decisions played."""
    shared = [name for name in joint.observation_slices if name in other.observation_slices]
    began, _ = joint.reset(seed=3), other.reset(seed=3)
    assert began[0].shape == joint.observation_space.shape
    for decision, (of_joint, of_other) in enumerate(actions):
        mine, theirs = joint.step(of_joint), other.step(of_other)
        assert mine[1:4] == theirs[1:4]
        for name in shared:
            np.testing.assert_array_equal(
                mine[0][joint.observation_slices[name]], theirs[0][other.observation_slices[name]], err_msg=name
            )
        for key in ("action_effect", "costs", "episode_return", "illegal", "n_steps", "step"):
            assert mine[4][key] == theirs[4][key], key
        if mine[2] or mine[3]:
            return decision + 1
    return len(actions)


@pytest.mark.parametrize("grid", ["bus14", STORAGE_GRID])
@pytest.mark.parametrize("heuristic", HEURISTICS)
def test_without_injection_it_is_the_topology_task_step_by_step(grid, heuristic):
    joint, topology = (make(f"{grid}-{kind}0", heuristic=heuristic) for kind in ("H", "T"))
    random = np.random.default_rng(1)
    chosen = [int(random.integers(joint.task.n_topology_actions)) * (k % 3 == 0) for k in range(12)]
    nothing = np.zeros(joint.task.n_injections)
    assert play_alike(joint, topology, [(together(k, nothing), k) for k in chosen]) > 2


@pytest.mark.parametrize("grid", ["bus14", STORAGE_GRID])
@pytest.mark.parametrize("heuristic", [None, "idle"])
def test_without_topology_action_it_is_the_redispatching_task_step_by_step(grid, heuristic):
    joint, redispatch = make(f"{grid}-H0", heuristic=heuristic), make(f"{grid}-R", heuristic=heuristic)
    random = np.random.default_rng(2)
    values = [random.uniform(-0.1, 0.1, joint.task.n_injections).astype(np.float32) for _ in range(12)]
    assert play_alike(joint, redispatch, [(together(0, each), each) for each in values]) > 2


def test_on_grid2op_dispatch_too():
    joint, redispatch = make("bus14-H0", dispatch="grid2op"), make("bus14-R", dispatch="grid2op")
    values = [np.full(6, 0.1 * (-1) ** k, np.float32) for k in range(3)]
    assert play_alike(joint, redispatch, [(together(0, each), each) for each in values]) == 3


@pytest.mark.parametrize(
    ("task", "heuristic"),
    [
        ("bus14-H1", None),
        pytest.param("bus14-H1", "recovery", marks=pytest.mark.slow),
        pytest.param("bus14-H1", "careful", marks=pytest.mark.slow),
        pytest.param(f"{STORAGE_GRID}-H0", None, marks=pytest.mark.slow),
    ],
)
def test_engines_agree_on_random_joint_actions(task, heuristic):
    engines = [make(task, engine=engine, heuristic=heuristic) for engine in ("reference", "native")]
    random = np.random.default_rng(5)
    for env in engines:
        env.reset(seed=1)
    for _ in range(12):
        action = joint_action(engines[0], random)
        theirs, mine = (env.step(action) for env in engines)
        np.testing.assert_allclose(mine[0], theirs[0], rtol=1e-4, atol=1e-4)
        assert mine[2:4] == theirs[2:4]
        assert (mine[4]["illegal"], mine[4]["ambiguous"]) == (theirs[4]["illegal"], theirs[4]["ambiguous"])
        assert mine[1] == pytest.approx(theirs[1], abs=1e-4 * max(1, mine[4]["n_steps"]))
        if mine[2] or mine[3]:
            for env in engines:
                env.reset()


@pytest.mark.parametrize("engine", ["native", "reference"])
def test_of_an_action_with_an_illegal_part_nothing_is_kept(engine):
    env = make("bus36-M-H0", engine=engine)  # bus14 has no cooldowns
    env.reset(seed=0)
    nothing = np.zeros(22)
    switched = next(a for a in range(1, 50) if env.describe_action(together(a, nothing)).startswith("switch"))
    env.step(together(switched, nothing))
    assert not env.action_masks()[switched]
    before = env.state.target_dispatch[0].copy()
    info = env.step(together(switched, np.full(22, 0.3)))[4]
    assert info["illegal"]
    assert info["action_effect"]
    np.testing.assert_array_equal(env.state.target_dispatch[0], before)
    assert not env.step(together(0, np.full(22, 0.3)))[4]["illegal"]
    assert (env.state.target_dispatch[0] != before).any()


def test_questions_are_answered_for_their_part():
    env = make("bus14-H0")
    env.reset(seed=0)
    env.step(together(0, np.zeros(6)))
    assert env.action_masks().shape == (50,) == env.action_catalogue_ids.shape
    assert env.what_if([0, 3]).worst_loading.shape == (2,)
    assert env.security(3).worst_loading.shape == (20,)
    action = together(3, np.full(6, 0.1))
    assert env.describe_action(action).startswith(make("bus14-T0").describe_action(3) + "; redispatch")
    assert env.describe_action(together(0, np.zeros(6))) == "do nothing"
    promised = env.simulate(action)
    assert promised.observation.shape == env.observation_space.shape
    np.testing.assert_array_equal(
        promised.observation[env.observation_slices["topo_vect"]],
        env.step(action)[0][env.observation_slices["topo_vect"]],
    )


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        (3, "actions are joint: give a dict with 'topology', an integer from 0 to 49, and 'injection', 6 numbers"),
        ({"topology": 0}, "actions are joint"),
        ({"topology": 0, "injection": np.zeros(6), "storage": 0}, "actions are joint"),
        (together(50, np.zeros(6)), "give an integer from 0 to 49"),
        (together(0.0, np.zeros(6)), "give an integer from 0 to 49"),
        (together(0, np.zeros(5)), r"must have shape \(6,\)"),
        (together(0, np.full(6, 1.1)), r"every entry must lie in \[-1, 1\]"),
        (together(0, np.full(6, np.nan)), "is NaN"),
    ],
)
def test_what_is_no_action_is_refused_in_a_sentence(action, sentence):
    env = make("bus14-H0")
    env.reset(seed=0)
    for ask in (env.step, env.simulate, env.describe_action):
        with pytest.raises(UsageError, match=sentence):
            ask(action)


VECTORS: list[Any] = [
    {"engine": "native"},
    {"engine": "reference", "num_workers": 0},
    pytest.param({"engine": "reference", "num_workers": 2}, marks=pytest.mark.slow),
]


@pytest.mark.parametrize("keywords", VECTORS)
def test_a_vector_plays_what_single_environments_play(keywords):
    vector = PowerGridVectorEnv("rl2grid/bus14-H0-v0", 3, **keywords)
    singles = [make("bus14-H0", engine=keywords["engine"]) for _ in range(3)]
    observations, _ = vector.reset(seed=4)
    np.testing.assert_array_equal(observations, [env.reset(seed=4 + i)[0] for i, env in enumerate(singles)])
    random = np.random.default_rng(0)
    for _ in range(6):
        actions = [joint_action(env, random) for env in singles]
        batch = {name: np.stack([action[name] for action in actions]) for name in ("topology", "injection")}
        assert vector.action_space.contains(batch)
        np.testing.assert_array_equal(vector.action_masks(), [env.action_masks() for env in singles])
        observations, rewards, terminated, _, infos = vector.step(batch)
        for i, env in enumerate(singles):
            observation, reward, over, complete, info = env.step(actions[i])
            ended = over or complete
            assert (float(rewards[i]), bool(terminated[i])) == (reward, over)
            assert str((infos["final_info"] if ended else infos)["action_effect"][i]) == info["action_effect"]
            np.testing.assert_array_equal(observations[i], env.reset()[0] if ended else observation)
    with pytest.raises(UsageError, match="integer from 0 to 49"):
        vector.step({**batch, "topology": np.array([0, 0, 50])})
    vector.close()


@pytest.mark.parametrize("keywords", VECTORS[:2])
def test_a_vector_refuses_what_is_not_one_action_each_and_has_not_stepped(keywords):
    vector = PowerGridVectorEnv("rl2grid/bus14-H0-v0", 2, **keywords)
    vector.reset(seed=0)
    good = vector.action_space.sample()
    wrong = (
        ([0, 0], "actions are joint"),
        ({"topology": [0, 0]}, "actions are joint"),
        ({**good, "topology": [0, 0, 0]}, "3 actions were given for 2 environments"),
        ({**good, "injection": np.zeros((1, 6))}, "1 actions were given for 2 environments"),
        ({**good, "topology": [0, 50]}, "integer from 0 to 49"),
        ({**good, "topology": [0.0, 1.0]}, "integer from 0 to 49"),
        ({**good, "injection": np.full((2, 6), -2.0)}, r"must lie in \[-1, 1\]"),
        ({**good, "injection": np.zeros((2, 5))}, r"must have shape \(6,\)"),
    )
    for actions, sentence in wrong:
        with pytest.raises(UsageError, match=sentence):
            vector.step(actions)
    assert vector.get_attr("state")[0].step[0] == 0
    vector.step(good)
    vector.close()


def test_it_is_copied_pickled_and_goes_on_where_it_was_saved():
    env = make("bus14-H0", heuristic="idle")
    env.reset(seed=0)
    random = np.random.default_rng(3)
    env.step(joint_action(env, random))
    world, action = env.save(), together(4, np.full(6, 0.1))
    expected = env.step(action)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    other = make("bus14-H0", heuristic="idle")
    for one in (*copies, env, other):
        one.restore(world)
        played = one.step(action)
        np.testing.assert_array_equal(played[0], expected[0])
        assert played[1:4] == expected[1:4]
    with pytest.raises(UsageError, match="cannot be restored in rl2grid/bus14-T0-v0"):
        make("bus14-T0", heuristic="idle").restore(world)


def test_the_engine_is_given_one_action():
    env = make("bus14-H0")
    env.reset(seed=0)
    played = env._environments._step_action(together(1, np.full(6, 0.5)))
    assert isinstance(played, StepAction)
    assert [type(change) for change in played.changes] == [Change]
    np.testing.assert_array_equal(played.values, np.full(6, 0.5, np.float32))
