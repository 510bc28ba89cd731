"""Read live Grid2Op environments into the records that :mod:`rl2grid.grids` and its networks are made of.

``python -m rl2grid.engines.reference.extract`` rewrites ``src/rl2grid/grids/data/*.json``, two files per grid:
``<grid>.json`` (:func:`describe_environment`) and ``<grid>.network.json`` (:func:`describe_network`).
``tests/grids/test_grid.py`` and ``tests/powerflow/test_model.py`` compare them with live environments.
"""

from __future__ import annotations

import argparse
import json
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.powerflow.model import read_network_record


@dataclass(frozen=True)
class Source:
    """Where one base grid comes from; the first bundled name describes it.

    The two mixes of bus118-M are one grid: they differ only in the maximum power of their renewables,
    of which the grid takes the larger (mix x2.5), so that the series of both can be played on it.
    """

    grid2op_name: str
    bundled_names: tuple[str, ...]
    level_sizes: tuple[int, ...]


SOURCES: dict[str, Source] = {
    "bus14": Source(
        "l2rpn_case14_sandbox",
        ("l2rpn_case14_sandbox", "rte_case14_realistic", "rte_case14_redisp"),
        (50, 209),
    ),
    "bus36-M": Source("l2rpn_wcci_2020", ("l2rpn_wcci_2020",), (50, 302, 1829, 11071, 66978)),
    "bus36-MO-v0": Source(
        "l2rpn_neurips_2020_track1_small", ("l2rpn_neurips_2020_track1",), (50, 302, 1829, 11071, 66978)
    ),
    "bus36-MO-v1": Source("l2rpn_icaps_2021_small", ("l2rpn_icaps_2021",), (50, 302, 1829, 11071, 66978)),
    "bus118-M": Source(
        "l2rpn_neurips_2020_track2_small",
        ("l2rpn_neurips_2020_track2/x2.5", "l2rpn_neurips_2020_track2/x1"),
        (50, 308, 1903, 11744, 72461),
    ),
    "bus118-MOB-v0": Source("l2rpn_wcci_2022", ("l2rpn_wcci_2022_dev",), (50, 309, 1914, 11849, 73328)),
    "bus118-MOB-v1": Source("l2rpn_idf_2023", ("l2rpn_idf_2023",), (50, 309, 1915, 11852, 73357)),
}

_BUS14_MAINTENANCE: dict[str, Any] = {
    "lines": (0, 4, 5, 10, 14),
    "monthly_daily_probability": [0.02] * 12,
    "monthly_max_per_day": [1] * 12,
    "start_hour": 9,
    "end_hour": 17,
}
"""Table 1 of the paper gives bus14 maintenance, the wheel none.

The lines are those whose outage from 9 to 17 h leaves at least nine of ten working days of the four real
months without a further trip or a collapse, when nothing else is done.
"""

_NO_MAINTENANCE: dict[str, Any] = {
    "lines": [],
    "monthly_daily_probability": [0.0] * 12,
    "monthly_max_per_day": [0] * 12,
    "start_hour": 9,
    "end_hour": 17,
}

OPPONENT_KINDS = {
    "BaseOpponent": "none",
    "WeightedRandomOpponent": "weighted",
    "GeometricOpponent": "geometric",
    "GeometricOpponentMultiArea": "multi_area",
}
"""The kind of each class of ``grid2op.Opponent`` that :mod:`rl2grid.mdp.opponents` plays."""

_VECTORS = (
    "sub_info",
    "line_or_to_subid",
    "line_ex_to_subid",
    "gen_to_subid",
    "load_to_subid",
    "storage_to_subid",
    "line_or_pos_topo_vect",
    "line_ex_pos_topo_vect",
    "gen_pos_topo_vect",
    "load_pos_topo_vect",
    "storage_pos_topo_vect",
    "gen_type",
    "gen_pmin",
    "gen_pmax",
    "gen_max_ramp_up",
    "gen_max_ramp_down",
    "gen_redispatchable",
    "gen_renewable",
)
_STORAGE_VECTORS = {
    "storage_emax": "storage_Emax",
    "storage_emin": "storage_Emin",
    "storage_max_p_prod": "storage_max_p_prod",
    "storage_max_p_absorb": "storage_max_p_absorb",
    "storage_charging_efficiency": "storage_charging_efficiency",
    "storage_discharging_efficiency": "storage_discharging_efficiency",
    "storage_loss": "storage_loss",
}
_NAMES = ("name_sub", "name_line", "name_gen", "name_load", "name_storage")


def make_environment(bundled_name: str) -> Any:
    """The Grid2Op environment ``name`` or mix ``name/mix`` of the wheel, with LightSim2Grid."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import grid2op
    from lightsim2grid import LightSimBackend

    # The folder itself: a mix taken out of its multimix is closed together with it.
    folder = Path(grid2op.__file__).parent / "data" / bundled_name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return grid2op.make(str(folder), backend=LightSimBackend())


class Identity(NamedTuple):
    """What a grid is called; fields as in :class:`rl2grid.grids.Grid`."""

    id: str
    grid2op_name: str
    bundled_names: tuple[str, ...]
    level_sizes: tuple[int, ...]


def describe_environment(grid_id: str) -> dict[str, Any]:
    """Everything that :class:`rl2grid.grids.Grid` holds of one of the seven grids, read from live environments."""
    source = SOURCES[grid_id]
    environments = [make_environment(name) for name in source.bundled_names if not name.startswith("rte_")]
    identity = Identity(grid_id, source.grid2op_name, source.bundled_names, source.level_sizes)
    maintenance = _BUS14_MAINTENANCE if grid_id == "bus14" else read_maintenance(environments[0])
    load_p_max = np.max([_load_p_max(each) for each in environments], axis=0)
    record = read_grid_record(environments[0], identity, maintenance, load_p_max)
    for environment in environments:
        environment.close()
    return record


def describe_network(bundled_name: str) -> dict[str, Any]:
    """Everything that the file of a network holds, read from a live environment of the wheel."""
    environment = make_environment(bundled_name)
    record = read_initial_network(environment)
    environment.close()
    return record


def read_grid_record(
    environment: Any, identity: Identity, maintenance: dict[str, Any], load_p_max: NDArray[np.float32]
) -> dict[str, Any]:
    """The record of :class:`rl2grid.grids.Grid`, as plain JSON values.

    Args:
        environment: a ``grid2op.Environment`` with LightSim2Grid; only read.
        identity: what the grid is called.
        maintenance: how maintenance is sampled; see :func:`read_maintenance`.
        load_p_max: [load] largest demand of each load, MW.
    """
    layout = environment.grid_layout or {}
    record: dict[str, Any] = {
        **identity._asdict(),
        "rules": _rules(environment),
        "opponent": _opponent(environment),
        "maintenance": maintenance,
        "layout": [[float(x) for x in layout.get(name, (0.0, 0.0))] for name in environment.name_sub],
        "sub_area": _areas(environment),
        "thermal_limit": environment.get_thermal_limit(),
        "slack_gen": _slack_generator(environment),
        "load_p_max": load_p_max,
    }
    for name in (*_NAMES, *_VECTORS):
        record[name] = getattr(environment, name)
    record["gen_cost_per_mw"] = environment.gen_cost_per_MW
    for name, attribute in _STORAGE_VECTORS.items():
        record[name] = getattr(environment, attribute) if environment.n_storage else []
    if not environment.n_storage:
        record |= {"name_storage": [], "storage_to_subid": [], "storage_pos_topo_vect": []}
    plain: dict[str, Any] = json.loads(json.dumps(record, default=_plain))
    return plain


def read_initial_network(environment: Any) -> dict[str, Any]:
    """The record of the network, :func:`rl2grid.powerflow.model.read_network_record`, before any time series.

    Puts the grid of ``environment`` back to its initial state: reset the environment before it plays again.
    """
    backend = environment.backend
    backend.reset("")
    return read_network_record(backend._grid, backend.tol, backend.max_it)


def read_maintenance(environment: Any) -> dict[str, Any]:
    """The record of :class:`rl2grid.grids.MaintenanceConfig`; no line where the series record maintenance.

    Begins an episode, because the series say how maintenance is sampled only then.
    """
    environment.reset()
    data = read_series(environment)
    lines = getattr(data, "line_to_maintenance", None)
    if not lines:
        return _NO_MAINTENANCE
    return {
        "lines": sorted(environment.name_line.tolist().index(name) for name in lines),
        "monthly_daily_probability": data.daily_proba_per_month_maintenance,
        "monthly_max_per_day": data.max_daily_number_per_month_maintenance,
        "start_hour": data.maintenance_starting_hour,
        "end_hour": data.maintenance_ending_hour,
    }


def environment_name(environment: Any) -> str:
    """Name of the folder of a ``grid2op.Environment``; Grid2Op's own name for it contains the backend's."""
    return Path(environment.get_path_env()).name or str(environment.name)


def read_series(environment: Any) -> Any:
    """The ``grid2op.Chronics.GridValue`` that feeds the present episode."""
    source = environment.chronics_handler.real_data
    return getattr(source, "data", source)


def _rules(environment: Any) -> dict[str, Any]:
    parameters = environment.parameters
    return {
        "cooldown_line": parameters.NB_TIMESTEP_COOLDOWN_LINE,
        "cooldown_sub": parameters.NB_TIMESTEP_COOLDOWN_SUB,
        "reconnection": parameters.NB_TIMESTEP_RECONNECTION,
        "overflow_allowed": parameters.NB_TIMESTEP_OVERFLOW_ALLOWED,
        "hard_overflow": float(parameters.HARD_OVERFLOW_THRESHOLD),
        "max_line_changes": parameters.MAX_LINE_STATUS_CHANGED,
        "max_sub_changes": parameters.MAX_SUB_CHANGED,
    }


def _opponent(environment: Any) -> dict[str, Any]:
    space = environment._oppSpace
    opponent = space.opponent
    kind = OPPONENT_KINDS[type(opponent).__name__]
    if kind == "none":
        return {"kind": "none"}
    areas = opponent.list_opponents if kind == "multi_area" else [opponent]
    record: dict[str, Any] = {
        "kind": kind,
        "areas": [area._lines_ids for area in areas],
        "max_duration": int(space.attack_max_duration),
        "cooldown": int(space.attack_cooldown),
        "initial_budget": float(space.init_budget),
        "budget_per_step": float(space.budget_per_timestep),
    }
    if kind == "weighted":
        return record | {
            "rho_normalization": opponent._rho_normalization,
            "attack_period": int(opponent._attack_period),
        }
    return record | {
        "hazard_rate": float(areas[0]._attack_hazard_rate),
        "recovery_rate": float(areas[0]._recovery_rate),
        "minimum_duration": int(areas[0]._recovery_minimum_duration),
        "pmax_pmin_ratio": float(areas[0]._pmax_pmin_ratio),
    }


def _areas(environment: Any) -> list[int]:
    rules = environment._game_rules.legal_action
    by_area = getattr(rules, "substations_id_by_area", None)
    areas = [0] * environment.n_sub
    for area, substations in enumerate((by_area or {}).values()):
        for substation in substations:
            areas[substation] = area
    return areas


def _slack_generator(environment: Any) -> int:
    generators = environment.backend._grid.get_generators()
    return next(i for i, generator in enumerate(generators) if generator.is_slack)


def _load_p_max(environment: Any) -> Any:
    largest = np.zeros(environment.n_load, np.float32)
    for index in range(len(environment.chronics_handler.subpaths)):
        environment.set_id(index)
        environment.reset()
        largest = np.maximum(largest, read_series(environment).load_p.max(axis=0))
    return largest


def _plain(value: Any) -> Any:
    """NumPy values as JSON; float32 by its shortest decimal, which reads back to the same float32."""
    if isinstance(value, np.ndarray):
        if value.dtype == np.float32:
            return [float(str(item)) for item in value]
        return value.tolist()
    if isinstance(value, np.floating):
        return float(str(value))
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be written to the grid data.")


def main() -> None:
    """Rewrite the grid data."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument(
        "--output", type=Path, default=Path(__file__).parents[2] / "grids" / "data", help="folder of the JSON files"
    )
    output: Path = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    for grid_id, source in SOURCES.items():
        record = describe_environment(grid_id)
        _write_record(output / f"{grid_id}.json", record)
        _write_record(output / f"{grid_id}.network.json", describe_network(source.bundled_names[0]))
        print(f"{grid_id}: {len(record['name_line'])} lines, opponent {record['opponent']['kind']}")


def _write_record(path: Path, record: dict[str, Any]) -> None:
    lines = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in record.items())
    path.write_text("{\n" + lines + "\n}\n")


if __name__ == "__main__":
    main()
