"""Made-up grids with one large substation: what masks of more than 32 and 64 elements are tested on."""

from __future__ import annotations

from datetime import datetime
from typing import Any

import numpy as np

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.entry import reset_one
from rl2grid.grids import Grid
from rl2grid.grids.grid import grid_from_record
from rl2grid.grids.network import Network, network_from_record
from rl2grid.mdp.actions import full_size
from rl2grid.scenarios.scenario import Scenario

N_ROWS = 50
LOAD = 5.0
"""MW of every load; each outer substation has one, the one in the middle too."""
_ADMITTANCE = 1.0 / complex(0.01, 0.1)


def star_grid(n_elements: int) -> Grid:
    """A grid whose substation 0 has ``n_elements``: the ends of pairs of lines to the others, a generator, a load.

    Element k of substation 0 is an end of line k; lines 2m and 2m + 1 lead to substation m + 1.
    """
    assert n_elements % 2 == 0
    n_line = n_elements - 2
    outer = np.arange(n_line // 2)
    ends = n_elements + 3 * outer[:, np.newaxis] + [0, 1]
    sub_info = [n_elements, *[3] * len(outer)]
    n_load, none = len(outer) + 1, []
    record: dict[str, Any] = {
        "id": f"star-{n_elements}", "grid2op_name": "", "bundled_names": [],
        "level_sizes": [full_size(sub_info, n_line)],
        "rules": {"cooldown_line": 3, "cooldown_sub": 3, "reconnection": 10, "overflow_allowed": 2,
                  "hard_overflow": 10.0, "max_line_changes": 2, "max_sub_changes": 2},
        "opponent": {"kind": "none"},
        "maintenance": {"lines": [], "monthly_daily_probability": [0.0] * 12, "monthly_max_per_day": [0] * 12,
                        "start_hour": 9, "end_hour": 17},
        "name_sub": [f"sub {k}" for k in range(len(sub_info))],
        "name_line": [f"line {k}" for k in range(n_line)],
        "name_gen": ["gen 0"], "name_load": [f"load {k}" for k in range(n_load)], "name_storage": none,
        "layout": [[float(k), float(k % 2)] for k in range(len(sub_info))],
        "sub_area": [0] * len(sub_info), "sub_info": sub_info,
        "line_or_to_subid": [0] * n_line, "line_ex_to_subid": np.repeat(outer + 1, 2).tolist(),
        "gen_to_subid": [0], "load_to_subid": [*range(1, n_load), 0], "storage_to_subid": none,
        "line_or_pos_topo_vect": list(range(n_line)), "line_ex_pos_topo_vect": ends.ravel().tolist(),
        "gen_pos_topo_vect": [n_line], "load_pos_topo_vect": [*(n_elements + 3 * outer + 2).tolist(), n_line + 1],
        "storage_pos_topo_vect": none,
        "thermal_limit": [100.0] * n_line, "gen_type": ["hydro"], "gen_pmin": [0.0], "gen_pmax": [1000.0],
        "gen_max_ramp_up": [100.0], "gen_max_ramp_down": [100.0], "gen_redispatchable": [True],
        "gen_renewable": [False], "gen_cost_per_mw": [40.0], "slack_gen": 0, "storage_emax": none,
        "storage_emin": none, "storage_max_p_prod": none, "storage_max_p_absorb": none,
        "storage_charging_efficiency": none, "storage_discharging_efficiency": none, "storage_loss": none,
        "load_p_max": [LOAD] * n_load,
    }  # fmt: skip
    return grid_from_record(record)


def star_network(grid: Grid) -> Network:
    """Equal lines without charging."""
    y = _ADMITTANCE
    entries = [part for each in (y, -y, -y, y) for part in (each.real, each.imag)]
    record = {
        "base_power": [100.0], "tolerance": [1e-10], "max_iterations": [10],
        "nominal_voltage": [138.0] * grid.n_sub, "line_admittance": [entries] * grid.n_line,
        "line_susceptance": [10.0] * grid.n_line, "gen_kilovolt": [138.0], "gen_setpoint": [1.0],
        "shunt_sub": [], "shunt_admittance": [],
    }  # fmt: skip
    return network_from_record(grid, record)


def star_scenario(grid: Grid) -> Scenario:
    """Constant loads."""
    load = np.full((N_ROWS, grid.n_load), LOAD, np.float32)
    prod = np.full((N_ROWS, 1), LOAD * grid.n_load, np.float32)
    return Scenario(
        id="constant", grid_id=grid.id, source="folder", start_datetime=datetime(2050, 1, 1), content_hash="",
        first_row=0, series_rows=N_ROWS, load_p=load, load_q=np.zeros_like(load), prod_p=prod, prod_v=None,
    )  # fmt: skip


def star_engine(n_elements: int) -> NativeEngine:
    """One environment of a star grid, in its first row."""
    grid = star_grid(n_elements)
    engine = NativeEngine(grid, 1, network=star_network(grid))
    scenario = star_scenario(grid)
    engine.begin(0, scenario, 0, scenario.n_steps, np.zeros((0, 3), np.int32), None)
    reset_one(engine.address, 0)
    return engine
