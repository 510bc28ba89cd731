"""The electrical model of a grid: everything a power flow needs that never changes.

The files ``grids/data/*.network.json`` are written by ``python -m rl2grid.engines.reference.extract`` from the
LightSim2Grid model behind each Grid2Op environment. Per-unit quantities refer to :attr:`Network.base_power`
and to the nominal voltage of each substation.
"""

from __future__ import annotations

import functools
import hashlib
import json
from importlib import resources
from typing import Annotated, Any, NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I32
from rl2grid.errors import one_of
from rl2grid.grids import GRID_IDS, Grid
from rl2grid.structures import constant, fields_of


class Network(NamedTuple):
    """Constants of the power flow, read-only.

    A substation has two busbars. Bus ``sub`` is its busbar 1, bus ``sub + n_sub`` its busbar 2 (LightSim2Grid's
    numbering). Lines include transformers, in Grid2Op's order.
    """

    base_power: Annotated[F64, constant("1", "LightSim2Grid's sn_mva", "MVA")]
    tolerance: Annotated[F64, constant("1", "largest mismatch of a converged flow", "per unit of base_power")]
    max_iterations: Annotated[I32, constant("1", "Newton iterations before a flow counts as divergent")]
    slack_gen: Annotated[I32, constant("1", "generator that balances the flow; its bus has angle 0")]

    nominal_voltage: Annotated[F64, constant("sub", "nominal voltage", "kV")]
    line_or_sub: Annotated[I32, constant("line", "substation of the origin")]
    line_ex_sub: Annotated[I32, constant("line", "substation of the extremity")]
    line_or_position: Annotated[I32, constant("line", "entry of the origin in topo_vect")]
    line_ex_position: Annotated[I32, constant("line", "entry of the extremity in topo_vect")]
    line_admittance: Annotated[
        F64, constant("line 8", "y11, y12, y21, y22, each as real, imaginary; 1 is the origin", "per unit")
    ]
    line_susceptance: Annotated[F64, constant("line", "of the DC flow (LightSim2Grid's ydc_11)", "per unit")]
    gen_sub: Annotated[I32, constant("gen", "substation")]
    gen_position: Annotated[I32, constant("gen", "entry in topo_vect")]
    gen_kilovolt: Annotated[
        F32, constant("gen", "nominal voltage by which set-points in kV are divided (prod_pu_to_kv)", "kV")
    ]
    gen_setpoint: Annotated[F64, constant("gen", "voltage where the series has no set-points", "per unit")]
    load_sub: Annotated[I32, constant("load", "substation")]
    load_position: Annotated[I32, constant("load", "entry in topo_vect")]
    storage_sub: Annotated[I32, constant("storage", "substation")]
    storage_position: Annotated[I32, constant("storage", "entry in topo_vect")]
    shunt_sub: Annotated[I32, constant("shunt", "substation of a shunt in service; fixed on busbar 1")]
    shunt_admittance: Annotated[
        F64, constant("shunt 2", "conductance and susceptance: conj(p + jq) / base_power", "per unit")
    ]


_FILED = (
    "base_power",
    "tolerance",
    "max_iterations",
    "nominal_voltage",
    "line_admittance",
    "line_susceptance",
    "gen_kilovolt",
    "gen_setpoint",
    "shunt_sub",
    "shunt_admittance",
)
"""Fields read from the file; the others are the grid's."""


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


def network_from_record(grid: Grid, record: dict[str, Any]) -> Network:
    """The network of ``grid`` from the record of :func:`read_network_record`."""
    fields = fields_of(Network)
    values: dict[str, Any] = {name: np.array(record[name], fields[name].dtype) for name in _FILED}
    values["shunt_admittance"] = values["shunt_admittance"].reshape(-1, 2)
    values |= {
        "slack_gen": np.array([grid.slack_gen], np.int32),
        "line_or_sub": grid.line_or_to_subid,
        "line_ex_sub": grid.line_ex_to_subid,
        "line_or_position": grid.line_or_pos_topo_vect,
        "line_ex_position": grid.line_ex_pos_topo_vect,
        "gen_sub": grid.gen_to_subid,
        "gen_position": grid.gen_pos_topo_vect,
        "load_sub": grid.load_to_subid,
        "load_position": grid.load_pos_topo_vect,
        "storage_sub": grid.storage_to_subid,
        "storage_position": grid.storage_pos_topo_vect,
    }
    for value in values.values():
        value.setflags(write=False)
    return Network(**values)


@functools.cache
def load_network(grid: Grid) -> Network:
    """The network of one of the seven grids.

    Raises:
        UsageError: the grid is not one of them.
    """
    return network_from_record(grid, json.loads(_file_bytes(grid)))


@functools.cache
def network_hash(grid: Grid) -> str:
    """Short hash of the file of the network of one of the seven grids.

    Raises:
        UsageError: the grid is not one of them.
    """
    return hashlib.sha256(_file_bytes(grid)).hexdigest()[:16]


def _file_bytes(grid: Grid) -> bytes:
    if grid.id not in GRID_IDS:
        raise one_of("The network of grid", grid.id, GRID_IDS)
    return (resources.files("rl2grid.grids") / "data" / f"{grid.id}.network.json").read_bytes()
