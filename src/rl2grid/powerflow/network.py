"""What a power flow needs to know: the branches of a grid, and one snapshot of it in operation."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.grids import Grid

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


class Branches(NamedTuple):
    """The linear (DC) model of the lines of a grid, transformers included."""

    susceptance: F64
    """[line] MW per radian: base power over reactance and transformer ratio."""
    nominal_voltage: F64
    """[line] kV at the origin."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A grid in operation at one moment: topology, injections and the flows measured with them.

    Attribute names are Grid2Op's. Powers are in MW and Mvar, voltages in kV.
    """

    topo_vect: I32
    """[topo] busbar of each element, -1 when disconnected."""
    last_bus: I32
    """[topo] busbar each element is on or was on last: where a line end returns to when closed."""
    gen_p: F64
    gen_v: F64
    """[gen] voltage set-point, kV."""
    load_p: F64
    load_q: F64
    storage_p: F64
    """[storage] positive charges."""
    p_or: F64
    q_or: F64
    v_or: F64
    """[line] kV at the origin, 0 on open lines."""
    thermal_limit: F64
    """[line] A at the origin."""
    cooldown_line: I32
    """[line] steps before the line may be switched."""
    cooldown_sub: I32
    """[sub] steps before the substation may be changed."""

    def loading(self) -> F64:
        """[line] current over thermal limit at the origin, 0 on open lines (Grid2Op's ``rho``)."""
        voltage = np.where(self.v_or > 0, self.v_or, np.inf)
        return np.asarray(np.hypot(self.p_or, self.q_or) * 1000 / (np.sqrt(3) * voltage * self.thermal_limit))


def stack(snapshots: list[Snapshot]) -> dict[str, NDArray[np.generic]]:
    """Arrays [snapshot, ...] by attribute, for storage; :func:`unstack` is the inverse."""
    return {field.name: np.stack([getattr(item, field.name) for item in snapshots]) for field in fields(Snapshot)}


def unstack(arrays: Any) -> list[Snapshot]:
    """The snapshots that :func:`stack` packed."""
    columns = {field.name: arrays[field.name] for field in fields(Snapshot)}
    return [Snapshot(**{name: column[k] for name, column in columns.items()}) for k in range(len(columns["topo_vect"]))]


def read_branches(grid: Grid, grid_model: Any) -> Branches:
    """The branches of a LightSim2Grid grid model (lines first, then transformers, as in Grid2Op)."""
    elements = [*grid_model.get_lines(), *grid_model.get_trafos()]
    base_power = float(grid_model.get_sn_mva())
    susceptance = np.array([element.ydc_11.real for element in elements]) * base_power
    nominal = np.asarray(grid_model.get_bus_vn_kv())[grid.line_or_to_subid]
    return Branches(susceptance, nominal.astype(np.float64))
