"""The search among dispatches on cases worked out by hand, and on a stressed bus14."""

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.agent import Agent
from rl2grid.agents.dispatch import Control
from rl2grid.agents.greedy import Greedy
from rl2grid.agents.greedy_dispatch import loadings_after, possible_shifts, shifted
from rl2grid.errors import UsageError

CONTROL = Control(*(np.array(x, np.float64) for x in ([0, 0], [-8, 0], [2, 5], [0, 0], [1, 1])))


def test_shifts_use_the_room_of_both_sides():
    shifts = possible_shifts(CONTROL, CONTROL.now)
    # Control 1 can only rise, by 5 MW; control 0 can give 8: half and all of 5 MW from 0 to 1.
    assert shifts.up.tolist() == [1, 1]
    assert shifts.down.tolist() == [0, 0]
    np.testing.assert_allclose(shifts.power, [2.5, 5.0])
    np.testing.assert_allclose(shifted(CONTROL.now, shifts, 1), [-5, 5])


def test_the_worst_loading_after_a_shift_is_that_of_the_sensitivities():
    # Line 0 is loaded 1.2 and loses 0.04 per MW from 0 to 1; line 1 goes the other way, at -0.9 to begin with.
    effect = np.array([[0.03, -0.01], [0.01, -0.01]])
    after = loadings_after(possible_shifts(CONTROL, CONTROL.now), effect, np.array([1.2, -0.9]))
    np.testing.assert_allclose(after, [1.1, 1.0])


def test_it_lowers_the_worst_loading_and_rests_in_a_safe_grid():
    env = gymnasium.make("rl2grid/bus14-R-v0", heuristic="idle", disable_env_checker=True)
    base, agent, lowered = env.unwrapped, Greedy(), 0
    for seed in range(6):
        observation, info = env.reset(seed=seed)
        if info["over"]:
            continue
        agent.bind(env)
        assert isinstance(agent, Agent)
        action = agent.act(observation, info)
        assert env.action_space.contains(action)
        rho = base.observation_slices["rho"]
        after, nothing = (base.simulate(a).observation[rho].max() for a in (action, np.zeros_like(action)))
        assert after <= nothing
        lowered += int(after < nothing - 1e-3)
    assert lowered >= 3
    calm = gymnasium.make("rl2grid/bus14-R-v0", disable_env_checker=True)
    observation, info = calm.reset(seed=0, options={"start": 0})
    assert calm.unwrapped.state.rho[0].max() < 0.95
    agent.bind(calm)
    np.testing.assert_array_equal(agent.act(observation, info), 0.0)


def test_what_was_dispatched_is_given_back():
    env = gymnasium.make("rl2grid/bus14-R-v0", disable_env_checker=True)
    observation, info = env.reset(seed=0, options={"start": 0})
    push = np.zeros(env.action_space.shape, np.float32)
    push[:2] = 1.0, -0.5
    observation, _, _, _, info = env.step(push)
    assert np.abs(env.unwrapped.state.actual_dispatch[0]).max() > 1.0
    agent = Greedy()
    agent.bind(env)
    for _ in range(10):
        observation, _, terminated, _, info = env.step(agent.act(observation, info))
        assert not terminated
    assert np.abs(env.unwrapped.state.actual_dispatch[0]).max() < 0.1  # MW


def test_actions_can_be_named_on_topology_tasks_only():
    with pytest.raises(UsageError, match="on topology tasks"):
        Greedy([1, 2]).bind(gymnasium.make("rl2grid/bus14-R-v0", disable_env_checker=True))
