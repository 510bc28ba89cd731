"""Random states that could be a grid's: for tests that compare a function with its definition."""

import numpy as np

from rl2grid.mdp.state import new_state
from rl2grid.mdp.termination import GameOver

EPISODE_LENGTH = 8064


def random_state(grid, n, seed):
    """``n`` rows of ``grid`` in operation; about one in eight has just collapsed and is blank, as in Grid2Op."""
    rng = np.random.default_rng(seed)
    state = new_state(grid, n)
    state.episode_length[:] = EPISODE_LENGTH
    state.step[:] = rng.integers(1, EPISODE_LENGTH + 1, n)
    _draw_topology(grid, state, rng)
    _draw_powers(grid, state, rng)
    _draw_counters(grid, state, rng)
    state.illegal[:] = rng.random(n) < 0.2
    state.ambiguous[:] = rng.random(n) < 0.1
    for i in np.flatnonzero(rng.random(n) < 0.125):
        _collapse(grid, state, i, rng)
    return state


def random_topology(grid, rng, share_open=0.05, share_moved=0.1):
    """A ``topo_vect``: some lines open (both ends), some elements on busbar 2."""
    topology = np.where(rng.random(grid.dim_topo) < share_moved, 2, 1).astype(np.int32)
    is_open = rng.random(grid.n_line) < share_open
    topology[grid.line_or_pos_topo_vect[is_open]] = -1
    topology[grid.line_ex_pos_topo_vect[is_open]] = -1
    return topology


def _draw_topology(grid, state, rng):
    for i in range(len(state.step)):
        state.topo_vect[i] = state.final_topo_vect[i] = random_topology(grid, rng, share_moved=rng.choice([0.0, 0.1]))
    state.line_status[:] = state.topo_vect[:, grid.line_or_pos_topo_vect] > 0
    loading = rng.gamma(4.0, 0.15, state.rho.shape) * rng.choice([0.5, 1.0], (len(state.rho), 1))
    state.rho[:] = np.where(state.line_status, loading, 0.0)
    state.a_or[:] = state.rho * grid.thermal_limit
    state.p_or[:] = rng.normal(0.0, 50.0, state.p_or.shape) * state.line_status


def _draw_powers(grid, state, rng):
    n = len(state.step)
    state.gen_p[:] = grid.gen_pmax * rng.random((n, grid.n_gen)) * (rng.random((n, grid.n_gen)) < 0.8)
    state.load_p[:] = rng.random((n, grid.n_load))
    share = rng.uniform(0.9, 1.0, (n, 1))
    state.load_p[:] *= share * state.gen_p.sum(1, keepdims=True) / state.load_p.sum(1, keepdims=True)
    for angle in (state.gen_theta, state.load_theta, state.storage_theta):
        angle[:] = rng.normal(0.0, 15.0, angle.shape)
    dispatched = grid.gen_redispatchable * (rng.random((n, grid.n_gen)) < 0.3)
    state.actual_dispatch[:] = dispatched * rng.normal(0.0, 3.0, (n, grid.n_gen))
    state.target_dispatch[:] = state.actual_dispatch + dispatched * rng.normal(0.0, 0.5, (n, grid.n_gen))
    state.gen_margin_up[:] = np.clip(grid.gen_pmax - state.gen_p, 0, grid.gen_max_ramp_up)
    state.gen_margin_down[:] = np.clip(state.gen_p - grid.gen_pmin, 0, grid.gen_max_ramp_down)
    state.curtailment_limit[:] = 1.0
    limited = grid.gen_renewable & (rng.random((n, grid.n_gen)) < 0.3)
    state.curtailment_limit[limited] = rng.random(limited.sum())
    potential = np.where(limited, grid.gen_pmax * rng.random((n, grid.n_gen)), state.gen_p)
    state.gen_p_before_curtail[:] = np.where(grid.gen_renewable, potential, 0.0)
    curtailed = state.gen_p_before_curtail - state.gen_p
    state.curtailment[:] = np.where(grid.gen_renewable, curtailed / grid.gen_pmax, 0.0)
    state.storage_charge[:] = grid.storage_emax * rng.random((n, grid.n_storage))
    used = rng.random((n, grid.n_storage)) < 0.5
    state.storage_power[:] = used * rng.uniform(-grid.storage_max_p_prod, grid.storage_max_p_absorb, used.shape)
    state.storage_power_target[:] = state.storage_power


def _draw_counters(grid, state, rng):
    shape = state.rho.shape
    state.timestep_overflow[:] = (state.rho > 1) * rng.integers(1, 4, shape)
    state.time_before_cooldown_line[:] = (rng.random(shape) < 0.3) * rng.integers(1, 13, shape)
    state.time_before_cooldown_sub[:] = rng.integers(0, 4, state.time_before_cooldown_sub.shape)
    planned = rng.random(shape) < 0.3
    state.time_next_maintenance[:] = np.where(planned, rng.integers(0, 40, shape), -1)
    state.duration_next_maintenance[:] = np.where(planned, rng.integers(1, 97, shape), 0)
    state.attacked[:] = (rng.random(shape) < 0.1) & ~state.line_status
    state.excused[:] = (rng.random(shape) < 0.2) & ~state.line_status


def _collapse(grid, state, i, rng):
    state.terminated[i] = True
    state.game_over[i] = rng.integers(1, len(GameOver))
    observed = state._fields[state._fields.index("gen_p") : state._fields.index("step")]
    for name in observed:
        getattr(state, name)[i] = 0
    state.topo_vect[i] = -1
    state.time_next_maintenance[i] = -1
    state.curtailment_limit[i] = 1
