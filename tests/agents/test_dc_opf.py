"""The linear programme on cases solved by hand, and the agent on a stressed bus14."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents import dc_flow as dc_flow_module
from rl2grid.agents.agent import Agent
from rl2grid.agents.dc_flow import buses, dc_flow, dc_point, sensitivities
from rl2grid.agents.dc_opf import DcOpf, optimal_injections
from rl2grid.agents.dispatch import Control, controls, encode
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.mdp.actions import decode_continuous
from rl2grid.powerflow.model import load_network

TRIANGLE = np.array([[2 / 3, 1 / 3, 0], [1 / 3, 2 / 3, 0], [1 / 3, -1 / 3, 0]])
"""Change of the flows 1-3, 2-3, 1-2 per MW injected at buses 1, 2, 3 and taken out at 3; three equal lines."""


def control(now: list[float], least: list[float], most: list[float], price: list[float]) -> Control:
    return Control(*(np.array(x, np.float64) for x in (now, least, most, [0.0] * len(now), price)))


def test_three_buses_redispatch_just_enough():
    # 90 MW from bus 1 to bus 3: 60 on 1-3, 30 on 1-2 and 2-3. Moving x MW from bus 1 to bus 2 leaves 60 - x/3 on 1-3.
    planned = optimal_injections(
        np.array([60.0, 30.0, 30.0]),
        np.array([50.0, 100.0, 100.0]),
        TRIANGLE[:, :2],
        control([0, 0], [-50, 0], [0, 50], [1, 2]),
    )
    np.testing.assert_allclose(planned, [-30, 30], atol=1e-5)


def test_three_buses_take_the_control_that_is_cheaper_per_relief():
    # Bus 1 gives way at price 1. A MW to bus 2 (price 1) relieves 1-3 by 1/3, one to bus 3 (price 2) by 2/3: a MW
    # of relief costs 6 or 4.5. So 15 MW go to bus 3; where it has room for 9 only, bus 2 gives the other 4 of relief.
    flow, bound = np.array([60.0, 30.0, 30.0]), np.array([50.0, 100.0, 100.0])
    wide = optimal_injections(flow, bound, TRIANGLE, control([0] * 3, [-50, 0, 0], [0, 50, 50], [1, 1, 2]))
    np.testing.assert_allclose(wide, [-15, 0, 15], atol=1e-5)
    narrow = optimal_injections(flow, bound, TRIANGLE, control([0] * 3, [-50, 0, 0], [0, 50, 9], [1, 1, 2]))
    np.testing.assert_allclose(narrow, [-21, 12, 9], atol=1e-5)


def test_three_buses_go_to_the_end_of_the_ramp_where_that_is_not_enough():
    flow, bound = np.array([60.0, 30.0, 30.0]), np.array([50.0, 100.0, 100.0])
    ramp = optimal_injections(flow, bound, TRIANGLE[:, :2], control([0, 0], [-9, 0], [0, 50], [1, 1]))
    np.testing.assert_allclose(ramp, [-9, 9], atol=1e-5)


def test_without_overload_the_dispatch_returns_to_zero_as_far_as_the_lines_allow():
    # At dispatch (-30, 30) line 1-3 carries 50; each MW brought back adds 1/3.
    now = control([-30, 30], [-50, 0], [0, 50], [1, 1])
    free = optimal_injections(np.array([50.0, 40, 20]), np.full(3, 100.0), TRIANGLE[:, :2], now)
    np.testing.assert_allclose(free, [0, 0], atol=1e-5)
    bound = optimal_injections(np.array([50.0, 40, 20]), np.array([55.0, 100, 100]), TRIANGLE[:, :2], now)
    np.testing.assert_allclose(bound, [-15, 15], atol=1e-5)


def stressed(seeds: range) -> Any:
    """Environments at their first decision, with a line above 95%: the heuristic plays until then."""
    env = gymnasium.make("rl2grid/bus14-R-v0", heuristic="idle", disable_env_checker=True)
    for seed in seeds:
        _, info = env.reset(seed=seed)
        if not info["over"]:
            yield env, info


def test_it_lowers_the_worst_loading_of_a_stressed_grid():
    agent = DcOpf()
    lowered = 0
    for env, info in stressed(range(6)):
        base = env.unwrapped
        agent.bind(env)
        assert isinstance(agent, Agent)
        agent.reset(0)
        action = agent.act(np.zeros(1, np.float32), info)
        assert env.action_space.contains(action)
        rho = base.observation_slices["rho"]
        after, nothing = (base.simulate(a).observation[rho].max() for a in (action, np.zeros_like(action)))
        assert after <= nothing
        lowered += int(after < nothing - 1e-3)
    assert lowered >= 3


def test_sensitivities_give_the_flow_of_shifted_injections():
    env, _ = next(stressed(range(6)))
    base = env.unwrapped
    grid, point = base.grid, dc_point(base.state, 0, base.grid, load_network(base.grid))
    first, second = grid.load_pos_topo_vect[[0, 5]]
    shifted = point.injection.copy()
    shifted[first] += 3.0
    shifted[second] -= 3.0
    effect = sensitivities(grid, point) @ np.bincount(buses(grid, point.busbar)[[first, second]], [3.0, -3.0], 28)
    np.testing.assert_allclose(
        dc_flow(grid, point._replace(injection=shifted)) - dc_flow(grid, point), effect, atol=1e-9
    )


def test_the_action_asks_for_what_was_planned():
    env, _ = next(stressed(range(6)))
    base = env.unwrapped
    grid, state = base.grid, base.state
    now = controls(state, grid)
    rng = np.random.default_rng(0)
    planned = now.least + rng.random(len(now.now)) * (now.most - now.least)
    injection = decode_continuous(grid, encode(state, grid, planned))
    redispatchable, renewable = np.flatnonzero(grid.gen_redispatchable), np.flatnonzero(grid.gen_renewable)
    n = len(redispatchable)
    np.testing.assert_allclose(injection.redispatch[redispatchable], planned[:n], atol=0.011)
    produced = np.minimum(injection.curtailment_limit * grid.gen_pmax, state.gen_p[0])[renewable]
    np.testing.assert_allclose(produced - state.gen_p[0][renewable], planned[n:], atol=0.011)


def test_topology_tasks_are_refused():
    with pytest.raises(UsageError, match="choose a redispatching task"):
        DcOpf().bind(gymnasium.make("rl2grid/bus14-T0-v0", disable_env_checker=True))


def test_it_is_made_by_its_name():
    assert isinstance(make_agent("dc-opf"), DcOpf)


def test_a_table_of_sensitivities_that_is_too_large_is_refused(monkeypatch):
    environment = gymnasium.make("rl2grid/bus14-R-v0", split="bundled").unwrapped
    environment.reset(seed=0)
    point = dc_point(environment.state, 0, environment.grid, load_network(environment.grid))
    assert sensitivities(environment.grid, point).shape == (20, 28)
    monkeypatch.setattr(dc_flow_module, "LARGEST_TABLE", 20 * 28 - 1)
    with pytest.raises(UsageError, match=r"need a table of 20 x 28 numbers on bus14, and at most 559 are allowed"):
        sensitivities(environment.grid, point)
