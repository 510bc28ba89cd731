"""AC power flow of single snapshots with changed topologies, through LightSim2Grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.grids import Grid
from rl2grid.powerflow.network import Snapshot

I32 = NDArray[np.int32]
F32 = NDArray[np.float32]


class AcCheck:
    """Worst loadings of topologies of one snapshot, by the reference engine's own power flow.

    The recipe is that of Grid2Op with LightSim2Grid: every flow starts from a DC solution, and a
    flow that does not converge, or a load or generator that is cut off, is a collapse. Cascades are
    not played.

    Args:
        grid: the grid.
        backend: a ``LightSimBackend`` that holds the grid; its model is copied, the backend untouched.
    """

    def __init__(self, grid: Grid, backend: Any) -> None:
        self._grid = grid
        self._model = backend._grid.copy()
        self._max_iterations = backend.max_it
        self._tolerance = backend.tol
        self._kv_per_unit = np.asarray(backend.prod_pu_to_kv, np.float32)
        self._start = np.ones(len(self._model.get_bus_vn_kv()), np.complex128)

    def load(self, snapshot: Snapshot) -> None:
        """Take over the injections and limits of ``snapshot``; its topology is given per flow."""
        self._limit = snapshot.thermal_limit
        self._write_topology(snapshot.topo_vect)
        every = np.ones
        grid, model = self._grid, self._model
        model.update_gens_p(every(grid.n_gen, bool), snapshot.gen_p.astype(np.float32))
        model.update_gens_v(every(grid.n_gen, bool), snapshot.gen_v.astype(np.float32) / self._kv_per_unit)
        model.update_loads_p(every(grid.n_load, bool), snapshot.load_p.astype(np.float32))
        model.update_loads_q(every(grid.n_load, bool), snapshot.load_q.astype(np.float32))
        if grid.n_storage:
            model.update_storages_p(every(grid.n_storage, bool), snapshot.storage_p.astype(np.float32))

    def worst_loading(self, topo_vect: I32) -> float:
        """Largest loading of any line with this topology; infinity on a collapse."""
        self._write_topology(topo_vect)
        model = self._model
        model.deactivate_result_computation()
        start = model.dc_pf(self._start.copy(), self._max_iterations, self._tolerance)
        model.reactivate_result_computation()
        voltage = model.ac_pf(start, self._max_iterations, self._tolerance) if len(start) else start
        if not len(voltage):
            model.tell_solver_need_reset()
            return float("inf")
        current = np.concatenate((model.get_line_res1()[3], model.get_trafo_res1()[3]))
        return float(np.max(current * 1000 / self._limit))

    def _write_topology(self, topo_vect: I32) -> None:
        self._model.update_topo(np.ones(self._grid.dim_topo, bool), topo_vect)


def read_snapshot(environment: Any) -> Snapshot:
    """The present moment of a live Grid2Op environment that runs on LightSim2Grid."""
    observation = environment.get_obs(_do_copy=False)
    values = {
        "topo_vect": observation.topo_vect,
        "last_bus": environment._backend_action.last_topo_registered.values,
        "gen_p": observation.gen_p,
        "gen_v": observation.gen_v,
        "load_p": observation.load_p,
        "load_q": observation.load_q,
        "storage_p": observation.storage_power,
        "p_or": observation.p_or,
        "q_or": observation.q_or,
        "v_or": observation.v_or,
        "thermal_limit": environment.get_thermal_limit(),
        "cooldown_line": observation.time_before_cooldown_line,
        "cooldown_sub": observation.time_before_cooldown_sub,
    }
    whole = ("topo_vect", "last_bus", "cooldown_line", "cooldown_sub")
    arrays: dict[str, Any] = {
        name: np.array(value, np.int32 if name in whole else np.float64) for name, value in values.items()
    }
    return Snapshot(**arrays)
