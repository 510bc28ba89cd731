"""The electrical model of a grid as data: everything a power flow needs that never changes.

The files ``data/*.network.json`` are written by ``python -m rl2grid.engines.reference.extract`` from the
LightSim2Grid model behind each Grid2Op environment. Per-unit quantities refer to :attr:`Network.base_power`
and to the nominal voltage of each substation.
"""

from __future__ import annotations

import json
from importlib import resources
from typing import Annotated, Any, NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I32
from rl2grid.grids.grid import Grid
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


FILED = (
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


def network_from_record(grid: Grid, record: dict[str, Any]) -> Network:
    """The network of ``grid`` from the record of :func:`rl2grid.powerflow.model.read_network_record`."""
    fields = fields_of(Network)
    values: dict[str, Any] = {name: np.array(record[name], fields[name].dtype) for name in FILED}
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


def read_network(grid: Grid) -> Network:
    """The network of a grid whose file is shipped."""
    file = resources.files("rl2grid.grids") / "data" / f"{grid.id}.network.json"
    return network_from_record(grid, json.loads(file.read_bytes()))
