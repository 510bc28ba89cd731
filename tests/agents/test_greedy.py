"""Greedy search beside an exhaustive search with ``simulate``, and on operating points made by hand."""

from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.agent import Agent
from rl2grid.agents.greedy import Greedy
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import level_ids
from rl2grid.mdp.state import new_state

OBSERVATION = np.zeros(2, np.float32)
INF = np.inf


class Stage(gymnasium.Env[Any, Any]):
    """A stressed bus14 whose what-if is made up."""

    def __init__(self, loading: list[float], legal: list[bool]) -> None:
        self.grid = load_grid("bus14")
        self.action_space = gymnasium.spaces.Discrete(len(loading))
        self.action_catalogue_ids = level_ids(self.grid, 1)[: len(loading)]
        self.state = new_state(self.grid, 1)
        self.state.rho[0], self.state.line_status[0], self.state.topo_vect[0] = 1.1, True, 1
        self.loading, self.legal = np.array(loading), np.array(legal)

    def what_if(self, actions: list[int] | None = None) -> SimpleNamespace:
        chosen = slice(None) if actions is None else actions
        return SimpleNamespace(worst_loading=self.loading[chosen], legal=self.legal[chosen])


def choose(loading: list[float], legal: list[bool] | None = None, actions: list[int] | None = None) -> int:
    agent = Greedy(actions)
    agent.bind(Stage(loading, legal or [True] * len(loading)))
    agent.reset(0)
    assert isinstance(agent, Agent)
    return agent.act(OBSERVATION, {})


def test_it_plays_the_lowest_worst_loading():
    assert choose([1.1, 1.0, 0.8, 0.9]) == 2


def test_it_plays_nothing_where_nothing_helps():
    assert choose([1.1, 1.2, INF]) == 0
    assert choose([1.1, 1.0999]) == 0
    assert choose([INF, INF]) == 0


def test_it_plays_no_illegal_action():
    assert choose([1.1, 0.5, 0.9], [True, False, True]) == 2


def test_it_keeps_to_its_actions():
    assert choose([1.1, 0.5, 0.9, 0.8], actions=[3, 2]) == 3


def test_it_tells_the_legal_actions_with_the_lowest_worst_loading():
    agent = Greedy([1, 2, 3, 4])
    stage = Stage([1.1, 0.5, 0.9, INF, 0.8], [True, False, True, True, True])
    agent.bind(stage)
    agent.act(OBSERVATION, {})
    assert agent.ranking(2) == ("worst loading", [4, 2], [0.8, 0.9], "")
    assert agent.ranking(9) == ("worst loading", [4, 2, 0], [0.8, 0.9, 1.1], "")
    stage.state.rho[0] = 0.5
    agent.act(OBSERVATION, {})
    assert agent.ranking(2) is None


def test_a_safe_grid_is_left_alone_and_recovery_is_tried_first():
    stage = Stage([0.9] * 209, [True] * 209)
    stage.state.rho[0] = 0.5
    agent = Greedy()
    agent.bind(stage)
    assert agent.act(OBSERVATION, {}) == 0
    stage.state.line_status[0, 7] = False
    reconnect = agent.act(OBSERVATION, {})
    assert reconnect != 0
    stage.loading[reconnect] = 1.0
    assert agent.act(OBSERVATION, {}) == 0
    stage.loading[reconnect] = 0.9
    few = Greedy([5])
    few.bind(stage)
    assert few.act(OBSERVATION, {}) == 0


def test_the_environment_is_asked_and_agrees_with_simulate():
    env = gymnasium.make("rl2grid/bus14-T0-v0", heuristic="idle", normalize=None, disable_env_checker=True)
    env.reset(seed=3)
    base = env.unwrapped
    outcomes = base.what_if()
    rho = base.observation_slices["rho"]
    compared = 0
    for action in range(50):
        result = base.simulate(action)
        if not outcomes.legal[action] or result.terminated or result.info["illegal"]:
            continue
        if outcomes.worst_loading[action] >= 2:
            continue  # a protection trips the line at once
        np.testing.assert_allclose(outcomes.worst_loading[action], result.observation[rho].max(), atol=1e-4)
        compared += 1
    assert compared > 30
    tried = [20, 7, 31]
    assert base.first_safe(tried).worst_loading == outcomes.worst_loading[tried][base.first_safe(tried).place]
    assert base.security().worst_loading.shape == (20,)
    with pytest.raises(UsageError, match="give an integer from 0 to 49"):
        base.what_if([50])
    with pytest.raises(UsageError, match="give an integer from 0 to 49"):
        base.first_safe([3, 50])


def test_only_the_native_engine_answers():
    env = gymnasium.make("rl2grid/bus14-T0-v0", engine="reference", disable_env_checker=True)
    with pytest.raises(UsageError, match="call reset first"):
        env.unwrapped.what_if()
    env.reset(seed=0)
    with pytest.raises(UsageError, match='choose engine="native"'):
        env.unwrapped.what_if()
    redispatch = gymnasium.make("rl2grid/bus14-R-v0", disable_env_checker=True)
    redispatch.reset(seed=0)
    with pytest.raises(UsageError, match="a what-if is of topology actions"):
        redispatch.unwrapped.what_if()
    with pytest.raises(UsageError, match="a what-if is of topology actions"):
        redispatch.unwrapped.first_safe([0])
