"""Where the grid is going: the trend of what is injected, and what announced maintenance takes."""

from typing import Any

import gymnasium
import numpy as np

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.dispatch import worst_loading
from rl2grid.agents.trend import Trend, later_of, without_closing
from rl2grid.engines.native.what_if import WhatIf, forecast_of
from rl2grid.mdp.actions import ActionKind, continuous_layout, full_catalogue


def standing(task: str, **keywords: Any) -> Any:
    env = gymnasium.make(f"rl2grid/{task}-v0", split="bundled", disable_env_checker=True, **keywords).unwrapped
    env.reset(seed=0)
    return env


def before_maintenance(steps: int) -> Any:
    """A grid of which a line will be taken out so many steps later."""
    env = standing("bus36-M-T1")
    for seed in range(20):
        env.reset(seed=seed)
        until = env.state.time_next_maintenance[0]
        if (until > steps).any():
            start = int(env.state.step[0]) + int(until[until > steps].min()) - steps
            env.reset(seed=seed, options={"start": start})
            if (env.state.time_next_maintenance[0] == steps).any():
                return env
    raise AssertionError("no bundled month has maintenance")


def trend_after(env: Any, *moments: tuple[int, float]) -> Any:
    """The trend of the first generator, once what it produced at these steps has been watched."""
    gen, trend = int(continuous_layout(env.grid).redispatch[0]), Trend(env.grid)
    for step, value in moments:
        env.state.step[0] = step
        env.state.gen_p[0][gen] = value
        trend.watch(env.state)
    return trend, int(env.grid.gen_pos_topo_vect[gen])


def test_the_trend_is_of_the_last_half_hour():
    trend, gen = trend_after(standing("bus14-R"), (1, 90.0), (8, 40.0), (10, 44.0))  # the first is too long ago
    np.testing.assert_allclose(trend.per_step()[gen], 2.0)
    trend.reset()
    np.testing.assert_array_equal(trend.per_step(), 0.0)


def test_who_is_brought_back_forgets_what_came_later():
    trend, _ = trend_after(standing("bus14-R"), (10, 44.0), (11, 90.0), (12, 10.0), (10, 44.0))
    np.testing.assert_array_equal(trend.per_step(), 0.0)


def test_the_trend_is_of_what_nobody_dispatched_or_curtailed():
    env = standing("bus14-R")
    trend, layout, state = Trend(env.grid), continuous_layout(env.grid), env.state
    gen, renewable = int(layout.redispatch[0]), int(layout.curtail[0])
    for step, made, available, load in ((4, 40.0, 20.0, 10.0), (8, 48.0, 28.0, 14.0)):
        state.step[0] = step
        state.gen_p[0][gen], state.actual_dispatch[0][gen] = made + 7.0 * step, 7.0 * step
        state.gen_p[0][renewable], state.gen_p_before_curtail[0][renewable] = 1.0, available
        state.load_p[0][0] = load
        trend.watch(state)
    positions = [env.grid.gen_pos_topo_vect[[gen, renewable]], env.grid.load_pos_topo_vect[[0]]]
    np.testing.assert_allclose(trend.per_step()[np.concatenate(positions)], [2.0, 2.0, -1.0])


def test_later_three_quarters_of_the_trend_have_gone_on():
    env = standing("bus14-T0")
    grid, point, change = env.grid, forecast_of(env.engine, 0), np.zeros(env.grid.dim_topo)
    assert point is not None
    change[grid.load_pos_topo_vect[0]], change[grid.gen_pos_topo_vect[[1, 2]]] = -1.0, [0.5, -1e6]
    later = later_of(env.state, point, grid, change).of(point, grid)
    np.testing.assert_allclose(later.load_p[0], point.load_p[0] + 4.5, rtol=1e-6)
    np.testing.assert_allclose(later.load_q[0] / later.load_p[0], point.load_q[0] / point.load_p[0], rtol=1e-5)
    np.testing.assert_allclose(later.gen_p[[1, 2]], [point.gen_p[1] + 2.25, 0.0], rtol=1e-6)
    np.testing.assert_array_equal(later.load_p[1:], point.load_p[1:])
    np.testing.assert_array_equal(later.topo_vect, point.topo_vect)


def test_later_announced_maintenance_has_taken_its_line_and_nobody_can_close_it():
    env = before_maintenance(4)
    grid, point = env.grid, forecast_of(env.engine, 0)
    assert point is not None
    (lost,) = np.flatnonzero(env.state.time_next_maintenance[0] == 4)
    expected = later_of(env.state, point, grid, np.zeros(grid.dim_topo))
    later = expected.of(point, grid)
    assert lost in expected.lost
    assert expected.steps <= 4
    assert later.topo_vect[grid.line_or_pos_topo_vect[lost]] == -1
    assert later.cooldown_line[lost] == env.state.duration_next_maintenance[0][lost]
    catalogue = full_catalogue(grid)
    closing = catalogue.take(np.flatnonzero((catalogue.kind == ActionKind.SWITCH) & (catalogue.target == lost)))
    assert not WhatIf(grid).actions(later, closing).legal.any()


def test_a_line_whose_maintenance_begins_cannot_be_closed_though_simulate_closes_it():
    env = before_maintenance(1)
    point, grid = forecast_of(env.engine, 0), env.grid
    assert point is not None
    (lost,) = np.flatnonzero(env.state.time_next_maintenance[0] == 1)
    catalogue = full_catalogue(grid).take(env.action_catalogue_ids)
    (closing,) = np.flatnonzero((catalogue.kind == ActionKind.SWITCH) & (catalogue.target == lost))
    entry = np.array([closing], np.int32)
    what_if = WhatIf(grid)
    assert what_if.actions(point, catalogue, entry).legal[0]
    assert not what_if.actions(without_closing(env.state, point), catalogue, entry).legal[0]
    assert worst_loading(env, int(closing)) != worst_loading(env, 0)
    env.step(int(closing))
    assert not env.state.line_status[0][lost]
