"""Grids as immutable data, read without Grid2Op; the files of seven (paper, Table 1) are shipped.

The files under ``data/`` are written by ``python -m rl2grid.engines.reference.extract`` from live
Grid2Op environments and compared with them by ``tests/grids/test_grid.py``.
"""

from __future__ import annotations

import functools
import hashlib
import json
from dataclasses import dataclass, fields
from importlib import resources
from typing import Any, get_type_hints

import numpy as np

from rl2grid.arrays import F32, I32, Flags

GRID_IDS: tuple[str, ...] = (
    "bus14",
    "bus36-M",
    "bus36-MO-v0",
    "bus36-MO-v1",
    "bus118-M",
    "bus118-MOB-v0",
    "bus118-MOB-v1",
)
"""The seven grids whose files are shipped, in the order of the paper's Table 1."""

STEPS_PER_HOUR = 12
"""All grids play 5-minute steps."""

_DTYPES: dict[Any, type] = {I32: np.int32, F32: np.float32, Flags: np.bool_}


@dataclass(frozen=True)
class Rules:
    """Operating rules of a grid (``grid2op.Parameters`` and ``gamerules``)."""

    cooldown_line: int
    """Steps during which a line cannot be switched again (``NB_TIMESTEP_COOLDOWN_LINE``)."""
    cooldown_sub: int
    """Steps during which a substation cannot be changed again (``NB_TIMESTEP_COOLDOWN_SUB``)."""
    reconnection: int
    """Steps before a line tripped by a protection may be reconnected (``NB_TIMESTEP_RECONNECTION``)."""
    overflow_allowed: int
    """Overloaded steps a line survives (``NB_TIMESTEP_OVERFLOW_ALLOWED``)."""
    hard_overflow: float
    """Loading above which a line trips at once (``HARD_OVERFLOW_THRESHOLD``)."""
    max_line_changes: int
    """Lines one action may switch, per area (``MAX_LINE_STATUS_CHANGED``)."""
    max_sub_changes: int
    """Substations one action may change, per area (``MAX_SUB_CHANGED``)."""


@dataclass(frozen=True)
class OpponentConfig:
    """The attacker of a grid (``grid2op.Opponent``); see :mod:`rl2grid.mdp.opponents`."""

    kind: str
    """``none``, ``weighted`` (WeightedRandomOpponent), ``geometric`` (GeometricOpponent) or
    ``multi_area`` (GeometricOpponentMultiArea)."""
    areas: tuple[tuple[int, ...], ...] = ()
    """Line ids that may be attacked; one tuple per area (one area unless ``multi_area``)."""
    rho_normalization: tuple[float, ...] = ()
    """``weighted`` only: usual loading of each attackable line."""
    max_duration: int = 0
    """Longest attack accepted, steps (``opponent_attack_duration``)."""
    cooldown: int = 0
    """Steps between attacks (``opponent_attack_cooldown``)."""
    initial_budget: float = 0.0
    budget_per_step: float = 0.0
    attack_period: int = 0
    """``weighted`` only: an attack falls uniformly in the next ``attack_period`` steps."""
    hazard_rate: float = 0.0
    """``geometric`` and ``multi_area``: chance per step that an attack begins."""
    recovery_rate: float = 0.0
    """``geometric`` and ``multi_area``: chance per step that an attack ends."""
    minimum_duration: int = 0
    """``geometric`` and ``multi_area``: steps an attack lasts at least."""
    pmax_pmin_ratio: float = 0.0
    """``geometric`` and ``multi_area``: odds of the most against the least loaded line."""


@dataclass(frozen=True)
class MaintenanceConfig:
    """How planned maintenance is sampled where a series records none."""

    lines: tuple[int, ...]
    """Line ids that may be maintained; empty where every bundled series records its own."""
    monthly_daily_probability: tuple[float, ...]
    """January to December: probability of maintenance per line and working day."""
    monthly_max_per_day: tuple[int, ...]
    """January to December: most lines maintained on one day."""
    start_hour: int
    """Maintenance begins at this hour."""
    end_hour: int
    """Maintenance ends at this hour."""


@dataclass(frozen=True, eq=False)
class Grid:
    """One base grid: names, connections, limits, costs and rules.

    Attribute names are Grid2Op's. Powers are in MW, energies in MWh, currents in A. The topology
    vector (``topo_vect``) has :attr:`dim_topo` entries, substation after substation.
    """

    id: str
    grid2op_name: str
    """Name of the full dataset."""
    bundled_names: tuple[str, ...]
    """Names of the environments inside the Grid2Op wheel (``name`` or ``name/mix``)."""
    level_sizes: tuple[int, ...]
    """Number of discrete actions per difficulty level (paper, Table 4)."""
    rules: Rules
    opponent: OpponentConfig
    maintenance: MaintenanceConfig

    name_sub: tuple[str, ...]
    name_line: tuple[str, ...]
    name_gen: tuple[str, ...]
    name_load: tuple[str, ...]
    name_storage: tuple[str, ...]
    layout: tuple[tuple[float, float], ...]
    """Position of each substation on a drawing."""
    sub_area: I32
    """Area of each substation (``RulesByArea``); all zero elsewhere."""
    sub_info: I32
    """Number of elements connected to each substation."""

    line_or_to_subid: I32
    line_ex_to_subid: I32
    gen_to_subid: I32
    load_to_subid: I32
    storage_to_subid: I32
    line_or_pos_topo_vect: I32
    line_ex_pos_topo_vect: I32
    gen_pos_topo_vect: I32
    load_pos_topo_vect: I32
    storage_pos_topo_vect: I32

    thermal_limit: F32
    """Permanent current limit at the origin of each line, A."""
    gen_type: tuple[str, ...]
    gen_pmin: F32
    gen_pmax: F32
    gen_max_ramp_up: F32
    """MW per step."""
    gen_max_ramp_down: F32
    gen_redispatchable: Flags
    gen_renewable: Flags
    gen_cost_per_mw: F32
    """Cost per MWh."""
    slack_gen: int
    """The generator that balances the power flow."""
    storage_emax: F32
    storage_emin: F32
    storage_max_p_prod: F32
    storage_max_p_absorb: F32
    storage_charging_efficiency: F32
    storage_discharging_efficiency: F32
    storage_loss: F32
    load_p_max: F32
    """Largest demand of each load in the bundled series, MW (used to scale observations)."""

    @property
    def n_sub(self) -> int:
        return len(self.name_sub)

    @property
    def n_line(self) -> int:
        return len(self.name_line)

    @property
    def n_gen(self) -> int:
        return len(self.name_gen)

    @property
    def n_load(self) -> int:
        return len(self.name_load)

    @property
    def n_storage(self) -> int:
        return len(self.name_storage)

    @property
    def dim_topo(self) -> int:
        return int(self.sub_info.sum())

    @functools.cached_property
    def sub_first_element(self) -> I32:
        """Position in the topology vector of the first element of each substation."""
        return np.concatenate(([0], np.cumsum(self.sub_info)[:-1])).astype(np.int32)

    @functools.cached_property
    def element_to_subid(self) -> I32:
        """Substation of each entry of the topology vector."""
        return np.repeat(np.arange(self.n_sub, dtype=np.int32), self.sub_info)

    @functools.cached_property
    def hash(self) -> str:
        """Short hash of everything that defines the grid."""
        record = {field.name: getattr(self, field.name) for field in fields(self)}
        return hashlib.sha256(json.dumps(record, default=_plain).encode()).hexdigest()[:16]


def read_grid(grid_id: str) -> Grid:
    """The grid whose file is shipped as ``data/<grid_id>.json``."""
    content = (resources.files("rl2grid.grids") / "data" / f"{grid_id}.json").read_bytes()
    return grid_from_record(json.loads(content), hashlib.sha256(content).hexdigest()[:16])


def grid_from_record(record: dict[str, Any], digest: str | None = None) -> Grid:
    """The grid that the plain values of a JSON file describe; its arrays are read-only.

    Args:
        record: the values.
        digest: its :attr:`Grid.hash`; None: that of the values.
    """
    hints = _hints()
    values: dict[str, Any] = {}
    for field in fields(Grid):
        value, hint = record[field.name], hints[field.name]
        if hint in _DTYPES:
            value = np.array(value, dtype=_DTYPES[hint])
            value.setflags(write=False)
        elif hint in (Rules, OpponentConfig, MaintenanceConfig):
            value = hint(**{key: _tuples(item) for key, item in value.items()})
        else:
            value = _tuples(value)
        values[field.name] = value
    grid = Grid(**values)
    if digest is not None:
        vars(grid)["hash"] = digest
    return grid


@functools.cache
def _hints() -> dict[str, Any]:
    return get_type_hints(Grid)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else vars(value)
