"""The reference engine plays what an unmodified Grid2Op environment plays."""

import gc
import sys
import warnings
import weakref
from pathlib import Path

import grid2op
import numpy as np
import pytest
from grid2op.Action import DontAct, PlayableAction
from grid2op.Opponent import BaseOpponent, NeverAttackBudget
from grid2op_copies import made_once
from lightsim2grid import LightSimBackend

from rl2grid.engines.reference import engine as engine_module
from rl2grid.engines.reference.engine import ReferenceEngine
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp.actions import DO_NOTHING, ActionKind, continuous_layout, full_catalogue, inject, switch
from rl2grid.mdp.state import OBSERVED, OBSERVED_STORAGE
from rl2grid.mdp.termination import GameOver
from rl2grid.scenarios.episodes import EpisodePlan
from rl2grid.scenarios.library import list_scenarios, load_scenario

ATTRIBUTES = (*OBSERVED, *OBSERVED_STORAGE)


def make_plain_environment(grid):
    """Grid2Op as it is, without opponent, with an action class that allows everything."""
    folder = Path(grid2op.__file__).parent / "data" / grid.bundled_names[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return grid2op.make(
            str(folder),
            backend=LightSimBackend(),
            action_class=PlayableAction,
            opponent_action_class=DontAct,
            opponent_class=BaseOpponent,
            opponent_budget_class=NeverAttackBudget,
            opponent_init_budget=0.0,
            opponent_budget_per_ts=0.0,
            opponent_attack_duration=0,
            kwargs_opponent={},
        )


plain_environment = made_once(make_plain_environment, lambda grid: grid.id)


def matching_scenario(grid, plain):
    """The bundled scenario whose loads are those of the plain environment's episode."""
    load_p = plain.chronics_handler.real_data.data.load_p
    for scenario_id in list_scenarios(grid.id, "bundled"):
        scenario = load_scenario(grid.id, scenario_id)
        rows = min(len(load_p), scenario.n_rows, 50)
        if np.array_equal(np.asarray(load_p[:rows], np.float32), scenario.load_p[:rows]):
            return scenario
    raise AssertionError("no bundled scenario holds the series that Grid2Op plays")


def plain_maintenance(plain, scenario, n_line):
    """The maintenance that the plain environment sampled or read for its episode."""
    recorded = plain.chronics_handler.real_data.data.maintenance
    matrix = np.zeros((scenario.n_rows, n_line), np.bool_)
    if recorded is not None:
        rows = min(len(recorded), scenario.n_rows)
        matrix[:rows] = recorded[:rows]
    return matrix


def grid2op_action(plain, grid, action):
    """The same action, built the way Grid2Op's documentation does."""
    for kind, target, mask in action.changes:
        if kind == ActionKind.MOVE:
            first = int(grid.sub_first_element[target])
            moved = [first + k for k in range(int(grid.sub_info[target])) if mask >> k & 1]
            return plain.action_space({"change_bus": moved})
        assert kind == ActionKind.SWITCH
        return plain.action_space({"change_line_status": [target]})
    if action.values is not None:
        layout = continuous_layout(grid)
        request = {"curtail": [], "redispatch": [], "set_storage": []}
        entries = iter(action.values.tolist())
        for gen in layout.redispatch.tolist():
            request["redispatch"].append((gen, np.float32(next(entries)) * grid.gen_max_ramp_up[gen]))
        for gen in layout.curtail.tolist():
            request["curtail"].append((gen, np.float32(1) + np.minimum(np.float32(next(entries)), np.float32(0))))
        for unit in layout.storage.tolist():
            value = np.float32(next(entries))
            limit = grid.storage_max_p_absorb[unit] if value > 0 else grid.storage_max_p_prod[unit]
            request["set_storage"].append((unit, value * limit))
        return plain.action_space({key: value for key, value in request.items() if value})
    return plain.action_space()


def random_action(grid, kind, random):
    """Often nothing, otherwise a topology action or a small injection."""
    if random.random() < 0.6:
        return DO_NOTHING
    if kind == "T":
        catalogue = full_catalogue(grid)
        if random.random() < 0.3:
            return switch(int(random.integers(grid.n_line)))
        return catalogue[int(random.integers(len(catalogue)))]
    values = (0.3 * random.uniform(-1, 1, continuous_layout(grid).size)).astype(np.float32)
    return inject(values)


def play_side_by_side(monkeypatch, grid_id, kind, steps, seed):
    """Play both and compare every attribute at every step; returns the number of steps compared."""
    grid = load_grid(grid_id)
    plain = plain_environment(grid)
    ours = ReferenceEngine(grid, 1, dispatch="grid2op", opponent=False)
    random = np.random.default_rng(seed)
    compared = 0
    while compared < steps:
        observation = plain.reset()
        scenario = matching_scenario(grid, plain)
        maintenance = plain_maintenance(plain, scenario, grid.n_line)
        monkeypatch.setattr(engine_module, "maintenance_matrix", lambda *_, matrix=maintenance: matrix)
        ours.reset(0, EpisodePlan(seed, 0, scenario.id, 0, min(plain.max_episode_duration(), scenario.n_steps)))
        done = False
        compare(ours.state, observation)
        shown = ours._observations[0]
        assert (shown.day, shown.hour_of_day, shown.minute_of_hour) == (
            observation.day,
            observation.hour_of_day,
            observation.minute_of_hour,
        )
        while not done and compared < steps:
            action = random_action(grid, kind, random)
            observation, _, done, info = plain.step(grid2op_action(plain, grid, action))
            ours.step(0, action)
            compare(ours.state, observation)
            # A dispatch that cannot be balanced and ends the game is a game over here, not an illegal action.
            failed = info["failed_redispatching"] and not done
            assert ours.state.illegal[0] == (info["is_illegal"] or failed)
            assert ours.state.ambiguous[0] == info["is_ambiguous"]
            assert done == bool(ours.state.terminated[0] or ours.state.truncated[0])
            compared += 1
    return compared


def compare(state, observation):
    for name in ATTRIBUTES:
        expected = getattr(observation, name)
        if len(expected):
            np.testing.assert_array_equal(getattr(state, name)[0], expected, err_msg=name)


@pytest.mark.parametrize("kind", ["T", "R"])
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_equals_plain_grid2op(monkeypatch, grid_id, kind):
    assert play_side_by_side(monkeypatch, grid_id, kind, steps=50, seed=1) == 50


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["T", "R"])
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_equals_plain_grid2op_for_long(monkeypatch, grid_id, kind):
    assert play_side_by_side(monkeypatch, grid_id, kind, steps=2000, seed=2) == 2000


def test_copies_are_independent():
    grid = load_grid("bus14")
    engine = ReferenceEngine(grid, 2)
    scenario_id = list_scenarios("bus14", "bundled")[0]
    for i in range(2):
        engine.reset(i, EpisodePlan(0, 0, scenario_id, 0, 100))
    engine.step(0, full_catalogue(grid)[5])
    assert not np.array_equal(engine.state.topo_vect[0], engine.state.topo_vect[1])
    engine.step(1, full_catalogue(grid)[5])
    np.testing.assert_array_equal(engine.state.rho[0], engine.state.rho[1])


@pytest.mark.parametrize("closed", [False, True])
def test_an_engine_that_is_forgotten_is_closed_without_a_complaint(monkeypatch, closed):
    """Grid2Op's finalizers raise where the garbage collector comes to the forecasts before their environment."""
    complaints = []
    monkeypatch.setattr(sys, "unraisablehook", lambda complaint: complaints.append(complaint.exc_value))
    engine = ReferenceEngine(load_grid("bus14"), 2)
    engine.reset(0, EpisodePlan(0, 0, list_scenarios("bus14", "bundled")[0], 0, 100))
    gc.collect()  # which changes the order in which it comes to them
    gc.collect()
    if closed:
        engine.close()
        engine.close()
    engine.itself, environment = engine, weakref.ref(engine.grid2op_environment(1))
    del engine
    gc.collect()
    assert environment() is None
    assert complaints == []


def test_game_over_is_explained_and_blanked():
    """Cutting the transformer that carries the generator of substation 7 isolates it."""
    grid = load_grid("bus14")
    engine = ReferenceEngine(grid, 1)
    engine.reset(0, EpisodePlan(0, 0, list_scenarios("bus14", "bundled")[0], 0, 100))
    (line,) = np.flatnonzero((grid.line_or_to_subid == 7) | (grid.line_ex_to_subid == 7))
    engine.step(0, switch(int(line)))
    assert engine.state.terminated[0]
    assert engine.state.game_over[0] == GameOver.GENERATOR_DISCONNECTED
    assert (engine.state.topo_vect[0] == -1).all()
    assert (engine.state.rho[0] == 0).all()
    # The environment is usable again.
    engine.reset(0, EpisodePlan(0, 1, list_scenarios("bus14", "bundled")[0], 0, 100))
    assert not engine.state.terminated[0]
    assert engine.state.rho[0].max() > 0


def test_simulate_leaves_the_state_untouched():
    grid = load_grid("bus14")
    engine = ReferenceEngine(grid, 1)
    engine.reset(0, EpisodePlan(0, 0, list_scenarios("bus14", "bundled")[0], 0, 100))
    before = [np.copy(array) for array in engine.state]
    simulated = engine.simulate(0, full_catalogue(grid)[5], 1)
    assert not np.array_equal(simulated.topo_vect[0], engine.state.topo_vect[0])
    for name, old, new in zip(engine.state._fields, before, engine.state, strict=True):
        np.testing.assert_array_equal(old, new, err_msg=name)
