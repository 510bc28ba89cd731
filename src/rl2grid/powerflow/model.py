"""The electrical model behind a power flow: read from LightSim2Grid, looked up for a grid."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from rl2grid.errors import one_of
from rl2grid.grids import Grid
from rl2grid.grids.network import FILED, Network
from rl2grid.grids.systems import find_system, system_ids

__all__ = ["Network", "load_network", "network_hash", "read_network_record"]


def read_network_record(grid_model: Any, tolerance: float, max_iterations: int) -> dict[str, Any]:
    """What the file of a network holds, from a LightSim2Grid grid model in its initial state.

    Args:
        grid_model: ``LightSimBackend._grid`` after ``LightSimBackend.reset``: set-points in force are read.
        tolerance: ``LightSimBackend.tol``, MVA.
        max_iterations: ``LightSimBackend.max_it``.
    """
    base_power = float(grid_model.get_sn_mva())
    lines = [*grid_model.get_lines(), *grid_model.get_trafos()]
    generators = list(grid_model.get_generators())
    shunts = [shunt for shunt in grid_model.get_shunts() if shunt.connected]
    nominal = np.asarray(grid_model.get_bus_vn_kv())[: grid_model.get_n_sub()]
    admittances = [[line.yac_11, line.yac_12, line.yac_21, line.yac_22] for line in lines]
    return {
        "base_power": [base_power],
        "tolerance": [tolerance / base_power],
        "max_iterations": [max_iterations],
        "nominal_voltage": nominal.tolist(),
        "line_admittance": np.array(admittances, np.complex128).view(np.float64).tolist(),
        "line_susceptance": [line.ydc_11.real for line in lines],
        "gen_kilovolt": [float(nominal[generator.sub_id]) for generator in generators],
        "gen_setpoint": [generator.target_vm_pu for generator in generators],
        "shunt_sub": [shunt.bus_id for shunt in shunts],
        "shunt_admittance": [[s.target_p_mw / base_power, -s.target_q_mvar / base_power] for s in shunts],
    }


def load_network(grid: Grid) -> Network:
    """The network of a grid; asking again returns the same object.

    Raises:
        UsageError: no system of that grid is registered.
    """
    if grid.id not in system_ids():
        raise one_of("The network of grid", grid.id, system_ids())
    return find_system(grid.id).network


def network_hash(grid: Grid) -> str:
    """Short hash of the electrical model of a grid.

    Raises:
        UsageError: no system of that grid is registered.
    """
    network, digest = load_network(grid), hashlib.sha256()
    for name in FILED:
        value = getattr(network, name)
        digest.update(f"{name} {value.dtype.str} {value.shape}".encode())
        digest.update(value.tobytes())
    return digest.hexdigest()[:16]
