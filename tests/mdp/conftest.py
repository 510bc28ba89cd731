"""States to test the functions of :mod:`rl2grid.mdp` with."""

import numpy as np
import pytest
from random_states import random_state

from rl2grid.grids import load_grid
from rl2grid.mdp.state import new_state

ROWS = 40


@pytest.fixture(params=["bus14", "bus36-MO-v0", "bus118-MOB-v1"])
def grid(request):
    """A small, a medium and a large grid; the last has storage."""
    return load_grid(request.param)


@pytest.fixture
def random_rows(grid):
    """A state of many random rows of ``grid``; some have just collapsed."""
    return random_state(grid, ROWS, seed=5)


@pytest.fixture
def calm():
    """Builds one row in operation: reference topology, every line at half its limit, nothing dispatched."""

    def build(grid):
        state = new_state(grid, 1)
        state.episode_length[:] = 100
        state.step[:] = 1
        state.line_status[:] = True
        state.rho[:] = 0.5
        state.topo_vect[:] = 1
        state.final_topo_vect[:] = 1
        state.time_next_maintenance[:] = -1
        state.curtailment_limit[:] = 1
        state.gen_p[:] = np.where(grid.gen_renewable, 0, grid.gen_pmax / 2)
        state.load_p[:] = state.gen_p.sum() / grid.n_load
        return state

    return build
