"""Secure dispatch: outage factors, the way to a plan, drift, and what a plan does to a grid."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.contingencies import NONE, Contingencies, danger
from rl2grid.agents.dc_flow import buses, dc_flow, dc_point, outage_factors, sensitivities
from rl2grid.agents.dispatch import controls
from rl2grid.agents.secure_dispatch import SecureDispatch, _Case, _overload_rows
from rl2grid.agents.trend import LATER, TREND_SHARE
from rl2grid.engines.native.what_if import WhatIf, forecast_of, snapshot_of
from rl2grid.mdp.actions import continuous_layout
from rl2grid.powerflow.model import load_network


def standing(task: str, **keywords: Any) -> Any:
    env = gymnasium.make(f"rl2grid/{task}-v0", split="validation", disable_env_checker=True, **keywords).unwrapped
    env.reset(seed=0)
    return env


def dispatch_of(env: Any) -> SecureDispatch:
    return SecureDispatch(env.grid, load_network(env.grid), WhatIf(env.grid))


def series_of(env: Any, dispatch: SecureDispatch) -> Any:
    return dispatch.foreseen(env.state, env.imagine(0).series.prod_p, np.zeros(env.grid.dim_topo))


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-M"])
def test_outage_factors_are_the_dc_flow_without_the_line(grid_id):
    env = standing(f"{grid_id}-R")
    grid = env.grid
    point = dc_point(env.state, 0, grid, load_network(grid))
    flow, table, bus = dc_flow(grid, point), sensitivities(grid, point), buses(grid, point.busbar)
    compared = 0
    for line in range(grid.n_line):
        factors = outage_factors(grid, table, bus, line)
        if factors is None:
            continue
        busbar = point.busbar.copy()
        busbar[[grid.line_or_pos_topo_vect[line], grid.line_ex_pos_topo_vect[line]]] = -1
        without = dc_flow(grid, point._replace(busbar=busbar))
        np.testing.assert_allclose(flow + factors * flow[line], without, atol=1e-6)
        compared += 1
    assert compared > grid.n_line // 2


def test_a_calm_grid_at_rest_needs_no_plan():
    env = standing("bus14-R")
    dispatch = dispatch_of(env)
    point = snapshot_of(env.engine, 0)
    assert dispatch.plan(env.state, point, series_of(env, dispatch), NONE, everything=False) is None


def test_what_an_outage_would_overload_is_relieved_before_it_happens():
    """By the AC flow, what all attackable lines threaten together is less after two hours of preparation."""
    env = standing("bus36-MO-v0-R", opponent=False)
    dispatch, what_if = dispatch_of(env), WhatIf(env.grid)
    lines = np.array(sorted(env.grid.opponent.areas[0]), np.int32)
    contingencies = Contingencies(lines, np.ones(len(lines)))
    env.reset(seed=0, options={"start": 220})
    start = danger(what_if, snapshot_of(env.engine, 0), contingencies)
    idle = standing("bus36-MO-v0-R", opponent=False)
    idle.reset(seed=0, options={"start": 220})
    from rl2grid.agents.dispatch import encode

    for _ in range(24):
        point = snapshot_of(env.engine, 0)
        planned = dispatch.plan(env.state, point, series_of(env, dispatch), contingencies, everything=False, steps=6)
        assert planned is not None
        env.step(encode(env.state, env.grid, dispatch.next_step(env.state, planned)))
        idle.step(np.zeros(idle.action_space.shape, np.float32))
    prepared = danger(what_if, snapshot_of(env.engine, 0), contingencies)
    unprepared = danger(what_if, snapshot_of(idle.engine, 0), contingencies)
    assert start > 0.1
    assert prepared < 0.8 * unprepared


def test_changes_on_the_way_to_a_plan_sum_to_zero_and_keep_to_ramps():
    env = standing("bus118-MOB-v0-R", opponent=False)
    dispatch, rng = dispatch_of(env), np.random.default_rng(0)
    for _ in range(5):
        control, gens = controls(env.state, env.grid), continuous_layout(env.grid).redispatch
        planned = control.now.copy()
        planned[: len(gens)] += rng.normal(0.0, 60.0, len(gens))
        planned[: len(gens)] -= planned.mean()
        after = dispatch.next_step(env.state, planned)
        assert abs((after - control.now).sum()) < 1e-6
        assert (after >= control.least - 1e-9).all()
        assert (after <= control.most + 1e-9).all()


def test_curtailed_renewables_come_back_slowly():
    env = standing("bus36-MO-v0-R", opponent=False)
    layout = continuous_layout(env.grid)
    n_gen = len(layout.redispatch)
    env.state.gen_p_before_curtail[0][layout.curtail] = env.state.gen_p[0][layout.curtail] + 5.0
    dispatch, control = dispatch_of(env), controls(env.state, env.grid)
    curtailed = -control.now[n_gen:].sum()
    ramp = float(env.state.gen_max_ramp_down[layout.redispatch].sum())
    back = (dispatch.next_step(env.state, control.at_rest) - control.now)[n_gen:].sum()
    assert curtailed > 0.25 * ramp
    np.testing.assert_allclose(back, 0.25 * ramp, rtol=1e-6)


def test_a_dispatch_outside_of_what_generators_can_do_has_drifted():
    env = standing("bus14-R")
    dispatch = dispatch_of(env)
    series = series_of(env, dispatch)
    assert not dispatch.is_drifting(env.state, series)
    gen = int(continuous_layout(env.grid).redispatch[0])
    env.state.actual_dispatch[0][gen] = env.state.gen_pmax[gen] + 5.0
    assert dispatch.is_in_use(env.state)
    assert dispatch.is_drifting(env.state, series)


def test_beyond_the_forecasts_the_trend_goes_on():
    env = standing("bus14-R")
    gens, change = continuous_layout(env.grid).redispatch, np.zeros(env.grid.dim_topo)
    env.state.gen_p[0][gens] = 44.0
    change[env.grid.gen_pos_topo_vect[gens]] = 2.0
    forecast = np.zeros((1, env.grid.n_gen), np.float32)
    forecast[0, gens] = 50.0
    series = dispatch_of(env).foreseen(env.state, forecast, change)
    np.testing.assert_allclose(series.now, 44.0)
    np.testing.assert_allclose(series.ahead[:, 0], [50.0, 54.0, 60.0, 72.0])


def test_a_plan_counts_only_what_the_forecast_says_of_the_next_step():
    """Nothing of the true future is read: another future with the same forecasts gives the same plan."""
    plans = []
    for seed in (0, 1):
        env = standing("bus36-MO-v0-R")
        env.reset(seed=5, options={"start": 220})
        env.restore(env.imagine(seed))
        dispatch = dispatch_of(env)
        point = forecast_of(env.engine, 0)
        assert point is not None
        lines = np.array(sorted(env.grid.opponent.areas[0]), np.int32)
        contingencies = Contingencies(lines, np.ones(len(lines)))
        plans.append(dispatch.plan(env.state, point, series_of(env, dispatch), contingencies, everything=True))
    assert plans[0] is not None
    np.testing.assert_array_equal(plans[0], plans[1])


def rising(env, series, megawatts):
    """The series, where by the trend one generator far from the balancing one produces so much more in a step."""
    layout = continuous_layout(env.grid)
    change = np.zeros(env.grid.dim_topo)
    change[env.grid.gen_pos_topo_vect[layout.curtail[0]]] = LATER * TREND_SHARE * megawatts
    return series._replace(half_hour=change, hour=2 * change)


def test_a_line_that_will_be_overloaded_by_the_trend_is_relieved_before():
    env = standing("bus36-MO-v0-R", opponent=False)
    dispatch = dispatch_of(env)
    point, series = snapshot_of(env.engine, 0), series_of(env, dispatch)
    assert dispatch.worst_loading(env.state, point, series) < 0.9
    assert not dispatch.is_pressed(env.state, point, series)
    assert dispatch.plan(env.state, point, series, NONE, everything=False) is None
    later = rising(env, series, 40.0)
    assert dispatch.is_pressed(env.state, point, later)
    planned = dispatch.plan(env.state, point, later, NONE, everything=False)
    assert planned is not None
    before, _ = dispatch._cases(env.state, point, later, NONE)
    worst = int(np.argmax(np.abs(before[1].share)))
    change = before[1].effect[worst] @ (planned - controls(env.state, env.grid).now)
    assert np.sign(before[1].share[worst]) * change < 0  # what will flow too much is made less


def test_what_an_outage_would_overload_an_hour_later_is_relieved_before():
    """The loss of no line leaves an overload now, nor does the trend without one within half an hour."""
    env = standing("bus36-MO-v0-R", opponent=False)
    dispatch, what_if = dispatch_of(env), WhatIf(env.grid)
    point, series = snapshot_of(env.engine, 0), series_of(env, dispatch)
    lines = np.array([20], np.int32)
    contingencies = Contingencies(lines, np.ones(1))
    assert what_if.outages(point, lines).worst_loading[0] < 0.9
    assert dispatch.plan(env.state, point, series, contingencies, everything=False) is None
    later = rising(env, series, 12.0)
    assert dispatch.plan(env.state, point, later, NONE, everything=False) is None
    planned = dispatch.plan(env.state, point, later, contingencies, everything=False)
    assert planned is not None
    cases, needed = dispatch._cases(env.state, point, later, contingencies)
    assert needed
    worst = int(np.argmax(np.abs(cases[-1].share)))
    change = cases[-1].effect[worst] @ (planned - controls(env.state, env.grid).now)
    assert np.sign(cases[-1].share[worst]) * change < 0


def test_beyond_its_limit_a_line_costs_more():
    """What the rows of a case add up to is the price of its loadings, whatever is injected."""
    rng = np.random.default_rng(0)
    prices = (0.9, 20.0), (0.98, 200.0)
    share, effect, now = np.array([0.95, -1.1, 0.3]), rng.normal(0.0, 0.01, (3, 4)), rng.normal(0.0, 10.0, 4)
    rows, bound, weight = _overload_rows(_Case(prices, share, effect), now)
    for _ in range(20):
        injected = now + rng.normal(0.0, 3.0, 4)
        loading = (np.sign(share) * (share + effect @ (injected - now)))[:2]  # the third line is not watched
        expected = sum(price * np.maximum(loading - above, 0.0).sum() for above, price in prices)
        np.testing.assert_allclose(weight @ np.maximum(rows @ injected - bound, 0.0), expected, atol=1e-9)


def test_what_curtailment_holds_makes_the_next_step_count():
    env = standing("bus36-MO-v0-R", opponent=False)
    dispatch, layout = dispatch_of(env), continuous_layout(env.grid)
    point, series = snapshot_of(env.engine, 0), series_of(env, dispatch)
    env.state.gen_p_before_curtail[0][layout.curtail] = env.state.gen_p[0][layout.curtail] + 5.0
    assert dispatch.is_pressed(env.state, point, series)
