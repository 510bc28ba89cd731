"""Joint tasks flattened to one kind of action."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.envs.joint import (
    JointAsBox,
    JointAsDiscrete,
    VectorJointAsBox,
    VectorJointAsDiscrete,
    control_moves,
)
from rl2grid.envs.spec import JointActions, spec_from_state, spec_of, task_spec
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import continuous_layout

N, M = 50, 6
MOVES = 3 * 2 + 3
"""Of bus14: three generators go up and down, three renewables down."""


def make(task: str = "bus14-H0", **keywords: Any) -> Any:
    return gymnasium.make(f"rl2grid/{task}-v0", disable_env_checker=True, **keywords)


def make_vector(n: int = 3, name: str = "bus14-H0") -> Any:
    return gymnasium.make_vec(f"rl2grid/{name}-v0", num_envs=n)


@pytest.mark.parametrize("wrapper", [JointAsBox, JointAsDiscrete, lambda env: env])
def test_passes_the_environment_checker(wrapper):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(wrapper(make()), skip_render_check=True)


def test_the_largest_entry_is_the_topology_action_and_ties_go_to_the_lowest():
    env = JointAsBox(make())
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (N + M,), np.float32)
    flat = np.full(N + M, -0.5, np.float32)
    flat[[7, 9]], flat[N:] = 0.25, np.linspace(-1, 1, M)
    action = env.action(flat)
    assert action["topology"] == 7
    np.testing.assert_array_equal(action["injection"], np.linspace(-1, 1, M).astype(np.float32))
    assert env.action(np.zeros(N + M))["topology"] == 0
    assert env.describe_action(flat) == env.unwrapped.describe_action(action)


def test_ids_behind_the_topology_actions_move_one_control():
    env = JointAsDiscrete(make())
    assert env.action_space == gymnasium.spaces.Discrete(N + MOVES)
    layout = continuous_layout(load_grid("bus14"))
    assert not env.action(7)["injection"].any()
    assert env.action(7)["topology"] == 7
    moves = [env.action(N + k) for k in range(MOVES)]
    assert all(move["topology"] == 0 for move in moves)
    found = [(int(np.flatnonzero(move["injection"])[0]), float(move["injection"].sum())) for move in moves]
    renewables = range(len(layout.redispatch), M)
    assert found == [*((k, way) for k in range(3) for way in (1.0, -1.0)), *((k, -1.0) for k in renewables)]
    assert env.describe_action(N).startswith("redispatch")
    assert env.describe_action(N + MOVES - 1).startswith("limit")


def test_storage_charges_and_discharges():
    grid = load_grid("bus118-MOB-v0")
    moves = control_moves(grid)
    assert moves.shape == (20 * 2 + 42 + 7 * 2, 69)
    assert moves[-2:, -1].tolist() == [1.0, -1.0]


def test_masks_are_those_of_the_topology_and_of_controls_none():
    name = "bus36-M-H0"  # bus14 has no cooldowns
    env, vector = JointAsDiscrete(make(name)), VectorJointAsDiscrete(make_vector(name=name))
    env.reset(seed=0)
    vector.reset(seed=0)
    switched = next(a for a in range(1, N) if env.describe_action(a).startswith("switch"))
    env.step(switched)
    vector.step(np.array([switched, 0, N + 1]))
    expected = np.ones(env.action_space.n, np.bool_)
    expected[:N] = env.unwrapped.action_masks()
    assert not expected[switched]
    np.testing.assert_array_equal(env.action_masks(), expected)
    np.testing.assert_array_equal(vector.action_masks()[0], expected)
    assert vector.action_masks()[:, N:].all()


@pytest.mark.parametrize(
    ("single", "several"), [(JointAsBox, VectorJointAsBox), (JointAsDiscrete, VectorJointAsDiscrete)]
)
def test_a_vector_plays_what_single_environments_play(single, several):
    vector, singles = several(make_vector()), [single(make()) for _ in range(3)]
    assert vector.single_action_space == singles[0].action_space
    observations, _ = vector.reset(seed=2)
    np.testing.assert_array_equal(observations, [env.reset(seed=2 + i)[0] for i, env in enumerate(singles)])
    vector.action_space.seed(1)
    vector.step(vector.action_space.sample())
    began = vector.state_dict()
    vector.reset(seed=7)
    vector.load_state_dict(began)
    vector.reset(seed=2)
    for _ in range(4):
        actions = vector.action_space.sample()
        _, rewards, *_ = vector.step(actions)
        for i, env in enumerate(singles):
            _, reward, over, complete, _ = env.step(actions[i])
            assert rewards[i] == reward
            if over or complete:
                env.reset()


def test_what_is_no_action_is_refused_in_a_sentence():
    box, discrete = JointAsBox(make()), JointAsDiscrete(make())
    vectors = VectorJointAsBox(make_vector(2)), VectorJointAsDiscrete(make_vector(2))
    for wrong, sentence in ((np.zeros(N), r"shape \(50,\): give numbers of shape \(56,\)"), ("up", "is none: give")):
        with pytest.raises(UsageError, match=sentence):
            box.action(wrong)
    for value in (np.nan, 1.5):
        with pytest.raises(UsageError, match=r"every entry must lie in \[-1, 1\]"):
            box.action(np.full(N + M, value))
    with pytest.raises(UsageError, match=f"from 0 to {N + MOVES - 1}"):
        discrete.action(N + MOVES)
    with pytest.raises(UsageError, match=r"shape \(1, 56\): give numbers of shape \(2, 56\)"):
        vectors[0].actions(np.zeros((1, N + M)))
    with pytest.raises(UsageError, match=f"from 0 to {N + MOVES - 1}"):
        vectors[1].actions(np.array([0, N + MOVES]))
    with pytest.raises(UsageError, match=f"from 0 to {N + MOVES - 1}"):
        vectors[1].actions(np.array([0.0, 1.0]))
    with pytest.raises(UsageError, match="for 2 environments: give one each"):
        vectors[1].actions([0])


def test_only_joint_tasks_are_flattened_and_only_once():
    with pytest.raises(UsageError, match="rl2grid/bus14-T0-v0 is no joint task"):
        JointAsBox(make("bus14-T0"))
    with pytest.raises(UsageError, match="CartPoleEnv is no joint task"):
        JointAsDiscrete(gymnasium.make("CartPole-v1"))
    with pytest.raises(UsageError, match="flatten them before other wrappers"):
        JointAsDiscrete(JointAsBox(make()))
    with pytest.raises(UsageError, match="SyncVectorEnv is no vector of rl2grid: flatten each of its environments"):
        VectorJointAsBox(gymnasium.make_vec("rl2grid/bus14-H0-v0", num_envs=2, vectorization_mode="sync"))


def test_a_vector_asks_for_one_dict_of_all_its_actions():
    action = {"topology": 0, "injection": np.zeros(6, np.float32)}
    env = gymnasium.make_vec("rl2grid/bus14-H0-v0", num_envs=2, split="bundled")
    env.reset(seed=0)
    for actions in ([action, action], [0, 1], None):
        with pytest.raises(UsageError, match=r"one dict with 'topology', 2 integers .* of shape \(2, 6\)"):
            env.step(actions)
    env.close()


def test_policies_are_told_of_the_flattened_actions():
    task = find_task("bus14-H0")
    box, discrete = spec_of(JointAsBox(make())), spec_of(VectorJointAsDiscrete(make_vector()))
    assert box.state_dict() == task_spec(task).state_dict()
    assert (box.action_size, box.continuous) == (N + M, True)
    assert (discrete.action_size, discrete.continuous) == (N + MOVES, False)
    for spec in (box, discrete):
        assert isinstance(spec.actions, JointActions)
        assert (len(spec.actions.topology), spec.actions.injection.size) == (N, M)
        assert spec.features[-1].end == spec.observation_size == 268
        again = spec_from_state(spec.state_dict())
        assert again.state_dict() == spec.state_dict()
        assert again.features == spec.features
    with pytest.raises(UsageError, match="wrap it in JointAsBox or JointAsDiscrete"):
        spec_of(make())


def test_stable_baselines3_learns_a_few_steps():
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    env = JointAsDiscrete(make(heuristic="idle"))
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, n_epochs=1, device="cpu", seed=0)
    model.learn(16)
    action, _ = model.predict(env.reset(seed=0)[0])
    env.step(action)


@pytest.mark.parametrize("wrapper", [VectorJointAsBox, VectorJointAsDiscrete])
def test_our_algorithms_learn_a_few_steps(wrapper):
    pytest.importorskip("torch")
    from rl2grid.algorithms.ppo import PPO, Args

    masks = wrapper is VectorJointAsDiscrete
    args = Args(total_timesteps=8, num_envs=2, num_steps=4, num_minibatches=1, update_epochs=1, mask_actions=masks)
    ppo = PPO(args, wrapper(make_vector(2)))
    assert ppo.iterate()
    with pytest.raises(UsageError, match="wrap the environments in VectorJointAsBox or VectorJointAsDiscrete"):
        PPO(args, make_vector(2))
