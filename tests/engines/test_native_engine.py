"""The native engine in conditions that no grid is in: always a defined ending, never a crash, a hang or a NaN."""

from __future__ import annotations

import functools
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.entry import reset_one
from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp.actions import DO_NOTHING, StepAction, full_catalogue, inject, move, switch
from rl2grid.mdp.features import observation_size
from rl2grid.mdp.observations import observation_writer
from rl2grid.mdp.state import OBSERVED, OBSERVED_STORAGE
from rl2grid.mdp.termination import GameOver
from rl2grid.powerflow.model import load_network
from rl2grid.scenarios.library import list_scenarios, load_scenario
from rl2grid.scenarios.scenario import Scenario

STEPS = 60
"""Rows kept of the real series."""
NO_OUTAGES = np.zeros((0, 3), np.int32)
SERIES = ("load_p", "load_q", "prod_p", "prod_v")
ANY_GRID = st.sampled_from(["bus14", "bus36-MO-v0", "bus118-MOB-v1"])


@functools.cache
def engine_of(grid_id: str, dispatch: str = "exact") -> NativeEngine:
    return NativeEngine(load_grid(grid_id), 1, dispatch, opponent=False)


@functools.cache
def calm_scenario(grid_id: str) -> Scenario:
    """The first rows of a real series."""
    scenario = load_scenario(grid_id, list_scenarios(grid_id, "bundled")[0])
    return replace(scenario, **{name: np.array(array[:STEPS]) for name, array in scenario.arrays().items()})


class Trial:
    """One episode of one environment, looked at after every step."""

    def __init__(self, grid_id: str, dispatch: str = "exact", **series: Any) -> None:
        self.engine = engine_of(grid_id, dispatch)
        self.state, self.grid = self.engine.state, self.engine.grid
        self.engine.begin(0, replace(calm_scenario(grid_id), **series), 0, STEPS - 1, NO_OUTAGES, None)
        reset_one(self.engine.address, 0)
        self.check()

    @property
    def over(self) -> bool:
        return bool(self.state.terminated[0] or self.state.truncated[0])

    @property
    def reason(self) -> GameOver:
        return GameOver(int(self.state.game_over[0]))

    def step(self, action: StepAction = DO_NOTHING) -> None:
        self.engine.step(0, action)
        self.check()

    def idle(self, steps: int = 5) -> None:
        for _ in range(steps):
            if self.over:
                return
            self.step()

    def check(self) -> None:
        """Everything observed is finite, and a game over has a reason and a blank observation."""
        for name in (*OBSERVED, *OBSERVED_STORAGE):
            assert np.isfinite(getattr(self.state, name)[0]).all(), f"{name} at step {self.state.step[0]}"
        for kind in ("T", "R"):
            observation = np.zeros(observation_size(self.grid, kind), np.float32)
            observation_writer(kind)(self.state, 0, observation)
            assert np.isfinite(observation).all(), kind
        assert self.state.terminated[0] == (self.reason != GameOver.NONE)
        assert not (self.state.terminated[0] and self.state.truncated[0])
        if self.state.terminated[0]:
            assert (self.state.topo_vect[0] == -1).all()
            assert not self.state.rho[0].any()


def injection(values: Any) -> StepAction:
    return inject(np.asarray(values, np.float32))


def n_continuous(trial: Trial) -> int:
    grid = trial.grid
    return int(grid.gen_redispatchable.sum() + grid.gen_renewable.sum()) + grid.n_storage


# --- Series ---------------------------------------------------------------------------------------------------------


def spoilt(grid_id: str, name: str, value: float, column: int | None, row: int) -> dict[str, Any]:
    array = getattr(calm_scenario(grid_id), name).copy()
    array[row, slice(None) if column is None else column] = value
    return {name: array}


def columns(grid_id: str, name: str) -> int:
    return int(getattr(calm_scenario(grid_id), name).shape[1])


@pytest.mark.parametrize("grid_id", GRID_IDS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_no_nonsense_in_a_series_reaches_an_observation(grid_id, value):
    for name in SERIES:
        if getattr(calm_scenario(grid_id), name) is None:
            continue
        for column in (None, *range(columns(grid_id, name))):
            trial = Trial(grid_id, **spoilt(grid_id, name, value, column, 2))
            trial.idle()
            # Single numbers of the others may not be read: reactive loads where a generator holds the voltage.
            if name == "load_p" or column is None:
                assert trial.reason != GameOver.NONE, f"{name}[2, {column}]"
                assert trial.state.step[0] == 2
    assert Trial(grid_id, **spoilt(grid_id, "load_p", value, None, 0)).reason == GameOver.DIVERGENCE


@settings(max_examples=60, deadline=None)
@given(
    ANY_GRID,
    st.sampled_from(SERIES),
    st.floats(width=32),
    st.integers(0, 10**6),
    st.integers(0, 4),
    st.sampled_from(["exact", "grid2op"]),
    st.integers(0, 2**32),
)
def test_any_number_in_a_series_under_any_continuous_actions(grid_id, name, value, place, row, dispatch, seed):
    if getattr(calm_scenario(grid_id), name) is None:
        name = "prod_p"
    column = place % (columns(grid_id, name) + 1)
    chosen = None if column == columns(grid_id, name) else column
    trial = Trial(grid_id, dispatch, **spoilt(grid_id, name, value, chosen, row))
    random = np.random.default_rng(seed)
    for _ in range(6):
        if trial.over:
            break
        size = random.choice([0.02, 1.0])
        action = injection(random.uniform(-size, size, n_continuous(trial)))
        forecast = trial.engine.simulate(0, action, 1)
        for attribute in (*OBSERVED, *OBSERVED_STORAGE):
            assert np.isfinite(getattr(forecast, attribute)).all(), attribute
        trial.step(action)


@pytest.mark.parametrize("grid_id", GRID_IDS)
@pytest.mark.parametrize("factor", [1e3, 1e8, -1e3])
def test_absurd_loads_are_a_voltage_collapse(grid_id, factor):
    load_p = calm_scenario(grid_id).load_p.copy()
    load_p[3:] *= factor
    trial = Trial(grid_id, load_p=load_p)
    trial.idle()
    assert (trial.reason, int(trial.state.step[0])) == (GameOver.DIVERGENCE, 3)


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_a_grid_that_produces_and_consumes_nothing(grid_id):
    calm = calm_scenario(grid_id)
    nothing = {name: np.zeros_like(getattr(calm, name)) for name in ("load_p", "load_q", "prod_p")}
    trial = Trial(grid_id, **nothing)
    trial.idle()
    if not trial.over:
        assert np.abs(trial.state.load_p[0]).max() == 0.0
        assert np.abs(trial.state.gen_p[0]).max() < 0.2 * trial.grid.gen_pmax.max(), "only losses are produced"


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_zero_generation_is_made_up_by_one_generator_or_lost(grid_id):
    trial = Trial(grid_id, prod_p=np.zeros_like(calm_scenario(grid_id).prod_p))
    trial.idle()
    if not trial.over:
        others = np.delete(trial.state.gen_p[0], trial.grid.slack_gen)
        assert not others.any()
        assert trial.state.gen_p[0, trial.grid.slack_gen] > trial.state.load_p[0].sum()


# --- Topology -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grid_id", GRID_IDS)
@pytest.mark.parametrize("order", ["first to last", "last to first", "random"])
def test_lines_opened_one_after_the_other_end_in_a_game_over(grid_id, order):
    trial = Trial(grid_id)
    lines = np.arange(trial.grid.n_line)
    if order == "last to first":
        lines = lines[::-1]
    if order == "random":
        np.random.default_rng(0).shuffle(lines)
    for line in lines:
        if trial.over:
            break
        already = not trial.state.line_status[0, line]
        if not already:
            trial.step(switch(int(line)))
    assert trial.over
    assert trial.reason in set(GameOver) - {GameOver.NONE, GameOver.DISPATCH} or trial.state.truncated[0]


@settings(max_examples=40, deadline=None)
@given(ANY_GRID, st.integers(0, 2**32))
def test_actions_at_random_until_the_end(grid_id, seed):
    trial = Trial(grid_id)
    catalogue = full_catalogue(trial.grid)
    random = np.random.default_rng(seed)
    while not trial.over:
        trial.step(catalogue[int(random.integers(len(catalogue)))])


@settings(max_examples=40, deadline=None)
@given(ANY_GRID, st.integers(0, 2**32))
def test_any_split_of_substations_whatever_the_mask(grid_id, seed):
    """Masks beyond those of the catalogue: complements, single elements, loads and generators alone."""
    trial = Trial(grid_id)
    random = np.random.default_rng(seed)
    while not trial.over:
        sub = int(random.integers(trial.grid.n_sub))
        trial.step(move(sub, int(random.integers(1, 2 ** int(trial.grid.sub_info[sub])))))


def elements_of(trial: Trial, sub: int) -> np.ndarray[Any, Any]:
    """Positions of the elements of a substation."""
    first = int(trial.grid.sub_first_element[sub])
    return np.arange(first, first + int(trial.grid.sub_info[sub]))


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_a_load_alone_on_a_busbar_is_lost(grid_id):
    grid = load_grid(grid_id)
    for load in range(grid.n_load):
        trial = Trial(grid_id)
        place = int(grid.load_pos_topo_vect[load])
        sub = int(grid.element_to_subid[place])
        trial.step(move(sub, 1 << (place - int(grid.sub_first_element[sub]))))
        assert trial.reason == GameOver.LOAD_DISCONNECTED, load


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_an_empty_busbar_changes_nothing(grid_id):
    """A substation that moves as a whole is the same substation, unless it leaves a shunt behind."""
    calm = Trial(grid_id)
    calm.step()
    flows = calm.state.rho[0].copy()
    shunts = load_network(calm.grid).shunt_sub.tolist()
    for sub in range(calm.grid.n_sub):
        trial = Trial(grid_id)
        trial.step(move(sub, 2 ** int(trial.grid.sub_info[sub]) - 1))
        if sub in shunts:
            assert trial.reason == GameOver.DIVERGENCE, sub  # as in Grid2Op
            continue
        assert not trial.over, sub
        assert (trial.state.topo_vect[0, elements_of(trial, sub)] == 2).all()
        np.testing.assert_allclose(trial.state.rho[0], flows, rtol=1e-5, atol=1e-6)


# --- Sizes and imports ----------------------------------------------------------------------------------------------


def nbytes(engine: NativeEngine) -> int:
    environments = engine.environments
    parts = (environments.state, environments.hidden, environments.flow, environments.opponent)
    return sum(array.nbytes for part in parts for array in part)


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_an_environment_takes_less_than_200_kilobytes(grid_id):
    grid = load_grid(grid_id)
    assert (nbytes(NativeEngine(grid, 9)) - nbytes(NativeEngine(grid, 1))) / 8 < 200_000


def test_an_unknown_dispatch_is_refused():
    with pytest.raises(UsageError, match="choose one of exact, grid2op"):
        NativeEngine(load_grid("bus14"), 1, "fast")


def test_a_native_environment_needs_no_grid2op():
    code = (
        "import sys, gymnasium, rl2grid\n"
        "for keywords in ({}, {'heuristic': 'idle', 'split': 'test'}, {'dispatch': 'grid2op'}):\n"
        "    env = gymnasium.make('rl2grid/bus14-R-v0', **keywords)\n"
        "    env.reset(seed=0)\n"
        "    env.step(env.action_space.sample() * 0.1)\n"
        "    env.unwrapped.simulate(env.action_space.sample() * 0.1)\n"
        "    gymnasium.make_vec('rl2grid/bus14-R-v0', num_envs=2, **keywords).reset(seed=0)\n"
        "heavy = [name for name in ('grid2op', 'lightsim2grid', 'torch', 'pandas') if name in sys.modules]\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
