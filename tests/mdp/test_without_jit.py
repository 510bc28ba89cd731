"""Every compiled function gives the same bits without its compiler.

Run as a script, this file writes what all functions return to the file named by its argument.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from random_states import random_state

from rl2grid.grids import load_grid
from rl2grid.handles import AsOpened
from rl2grid.mdp.accumulate import accrue, begin_episode, begin_transition
from rl2grid.mdp.constraints import lsi_cost, tlo_cost, update_excused
from rl2grid.mdp.features import observation_size
from rl2grid.mdp.heuristics import (
    careful_candidate,
    is_careful_enough,
    is_safe,
    reconnect_action,
    recovery_action,
    remember_move,
    remember_topology,
)
from rl2grid.mdp.observations import observation_writer
from rl2grid.mdp.rewards import PRESETS
from rl2grid.mdp.scores import margin_score, overload_score, topology_score
from rl2grid.mdp.security import loading_after_loss, new_security
from rl2grid.mdp.termination import game_over_reason
from rl2grid.powerflow.model import load_network

ROWS = 12
SCALARS = (
    is_careful_enough,
    is_safe,
    recovery_action,
    reconnect_action,
    game_over_reason,
    lsi_cost,
    tlo_cost,
    margin_score,
    overload_score,
    topology_score,
    *(preset.components for preset in PRESETS.values()),
)


def evaluate():
    """What every function returns or writes on random states, by name."""
    results = {}
    for grid_id in ("bus14", "bus118-MOB-v0"):
        grid = load_grid(grid_id)
        state = random_state(grid, ROWS, seed=11)
        for function in SCALARS:
            values = [np.atleast_1d(function(state, i)) for i in range(ROWS)]
            results[f"{grid_id} {function.__name__}"] = np.array(values, np.float64)
        for kind in ("T", "R", "H"):
            observations = np.zeros((ROWS, observation_size(grid, kind)), np.float32)
            for i in range(ROWS):
                observation_writer(kind)(state, i, observations[i])
            results[f"{grid_id} observation {kind}"] = observations
        results[f"{grid_id} careful"] = np.array([_remember(state, i) for i in range(ROWS)])
        results[f"{grid_id} losses"] = np.array([_lose(grid, state, i) for i in range(0, ROWS, 6)])
        _accumulate(state)
        for name, array in zip(state._fields, state, strict=True):
            results[f"{grid_id} state {name}"] = array
    return results


def _remember(state, i):
    """What the careful heuristic may try, from everything remembered on."""
    remember_topology(state, i)
    for sub in range(0, len(state.sub_info), 3):
        remember_move(state, i, sub)
    return [careful_candidate(state, i, begin) for begin in (0, state.rho.shape[1])]


def _lose(grid, state, i):
    """Worst loadings after the loss of lines."""
    security = new_security(grid, load_network(grid), attacks=True)
    opened, state_opened = AsOpened()(security), AsOpened()(state)
    lines = enumerate(security.line[:3])
    return [loading_after_loss(opened, state_opened, i, k) if state.line_status[i, line] else 0.0 for k, line in lines]


def _accumulate(state):
    preset = PRESETS["default"]
    for i in range(ROWS):
        update_excused(state, i)
        begin_episode(state, i)
        for step in range(5):
            if step == 3:
                begin_transition(state, i)
            survive, overload, cost = preset.components(state, i)
            accrue(state, i, survive, overload, cost, preset.weights, 0.99)


def test_results_do_not_depend_on_compilation(tmp_path):
    path = tmp_path / "results.npz"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    subprocess.run([sys.executable, __file__, str(path)], env=environment, check=True)
    compiled = evaluate()
    with np.load(path) as interpreted:
        assert set(interpreted.files) == set(compiled)
        for name in interpreted.files:
            assert interpreted[name].dtype == compiled[name].dtype, name
            np.testing.assert_array_equal(interpreted[name], compiled[name], err_msg=name)


if __name__ == "__main__":
    np.savez(Path(sys.argv[1]), **evaluate())
