"""What operation costs, step by step: against the classes with which Grid2Op scored the competitions."""

import numpy as np
import pytest
from grid2op.Reward._newRenewableSourcesUsageScore import _NewRenewableSourcesUsageScore
from grid2op.Reward.l2rpn_wcci2022_scorefun import L2RPNWCCI2022ScoreFun
from grid2op.Reward.l2RPNSandBoxScore import L2RPNSandBoxScore

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.reference.engine import ReferenceEngine
from rl2grid.grids import load_grid
from rl2grid.mdp.accumulate import begin_episode
from rl2grid.mdp.actions import DO_NOTHING, continuous_layout, inject
from rl2grid.mdp.operation import accrue_operation
from rl2grid.mdp.state import (
    CURTAILMENT_COST,
    LOSSES_COST,
    REDISPATCH_COST,
    RENEWABLE_AVAILABLE,
    RENEWABLE_USED,
    STORAGE_COST,
    STORAGE_ENERGY,
)
from rl2grid.scenarios.episodes import EpisodePlan
from rl2grid.scenarios.library import list_scenarios

STEPS = 12
RELATIVE = 2e-5
"""Grid2Op adds up hundreds of MW in float32, whose difference the losses are."""
COSTS = [LOSSES_COST, REDISPATCH_COST, CURTAILMENT_COST, STORAGE_COST]


def actions_of(grid, rng):
    """Redispatch, curtailment and storage: more, less, and nothing at all."""
    layout = continuous_layout(grid)
    curtail = slice(len(layout.redispatch), len(layout.redispatch) + len(layout.curtail))
    for step in range(STEPS):
        values = rng.uniform(-0.5, 0.5, layout.size).astype(np.float32)
        values[curtail][::4] = rng.uniform(-1, -0.8, len(values[curtail][::4]))
        yield DO_NOTHING if step % 4 == 3 else inject(values)


def plan_of(grid):
    return EpisodePlan(0, 0, list_scenarios(grid.id, "bundled")[0], 100, STEPS + 1, maintenance=False)


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-MOB-v0"])
def test_steps_cost_what_grid2op_says(grid_id):
    grid = load_grid(grid_id)
    engine = ReferenceEngine(grid, 1, opponent=False)
    environment = engine.grid2op_environment(0)
    sandbox, wcci, renewable = L2RPNSandBoxScore(), L2RPNWCCI2022ScoreFun(), _NewRenewableSourcesUsageScore()
    for score in (sandbox, wcci):
        score.initialize(environment)
    engine.reset(0, plan_of(grid))
    begin_episode(engine.state, 0)
    renewable.reset(environment)
    expected = np.zeros(4)
    for action in actions_of(grid, np.random.default_rng(5)):
        engine.step(0, action)
        accrue_operation(engine.state, 0)
        assert not engine.state.terminated[0]
        costs = [score(None, environment, False, False, False, False) for score in (sandbox, wcci)]
        expected += [*costs, *(np.array(renewable._get_total_nres_usage(environment)) / 12)]
    sums = engine.state.episode_operation[0]
    own_price = sums[COSTS].sum() - sums[STORAGE_COST] + 10 * sums[STORAGE_ENERGY]
    found = [sums[COSTS].sum(), own_price, sums[RENEWABLE_USED], sums[RENEWABLE_AVAILABLE]]
    np.testing.assert_allclose(found, expected, rtol=RELATIVE)
    assert all(sums[column] != 0 for column in [*COSTS[:3], *([STORAGE_ENERGY] if grid.n_storage else [])])
    assert sums[RENEWABLE_USED] < sums[RENEWABLE_AVAILABLE]
    engine.close()


def test_both_engines_cost_the_same():
    grid = load_grid("bus118-MOB-v0")
    sums = []
    for engine in (ReferenceEngine(grid, 1, opponent=False), NativeEngine(grid, 1, opponent=False)):
        engine.reset(0, plan_of(grid))
        begin_episode(engine.state, 0)
        for action in actions_of(grid, np.random.default_rng(5)):
            engine.step(0, action)
            accrue_operation(engine.state, 0)
        sums.append(engine.state.episode_operation[0].copy())
    np.testing.assert_allclose(*sums, rtol=RELATIVE)


def test_the_last_step_does_not_count(calm):
    state = calm(load_grid("bus14"))
    begin_episode(state, 0)
    for flag in (state.terminated, state.truncated):
        flag[0] = True
        accrue_operation(state, 0)
        assert not state.episode_operation[0].any()
        flag[0] = False


def test_by_hand(calm):
    state = calm(load_grid("bus14"))
    begin_episode(state, 0)
    state.gen_p[0], state.load_p[0] = 10, 1
    state.gen_p[0, state.gen_cost_per_mw == state.gen_cost_per_mw.max()] = 0
    running = state.gen_p[0] > 0
    price = state.gen_cost_per_mw[running].max() / 12
    wind = int(np.flatnonzero(state.gen_renewable)[0])
    state.gen_p_before_curtail[0, wind] = 30
    state.curtailment_limit[0, wind] = 20 / state.gen_pmax[wind]
    state.actual_dispatch[0, :2] = 3, -4
    accrue_operation(state, 0)
    sums, losses = state.episode_operation[0], state.gen_p[0].sum() - state.load_p[0].sum()
    np.testing.assert_allclose(sums[COSTS], [price * losses, price * 7, price * 10, 0], rtol=1e-6)
    accrue_operation(state, 0)  # as much as before is curtailed: that costs nothing more
    np.testing.assert_allclose(sums[COSTS], [2 * price * losses, 2 * price * 7, price * 10, 0], rtol=1e-6)
    state.curtailment_limit[0, wind] = 1
    accrue_operation(state, 0)
    assert sums[CURTAILMENT_COST] == pytest.approx(0, abs=1e-5)
