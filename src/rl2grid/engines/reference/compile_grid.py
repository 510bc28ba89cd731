"""Any Grid2Op environment as a system, so that it can be simulated without Grid2Op and registered beside the seven.

:func:`compile_grid` reads a live environment once and keeps what it read in the data folder;
:func:`load_compiled` reads that without importing Grid2Op. Only environments are taken whose every feature is
simulated (:mod:`rl2grid.engines.reference.supported`). Series stay where they are: a system knows their folders.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import filelock
import numpy as np

from rl2grid.engines.reference.extract import (
    Identity,
    environment_name,
    read_grid_record,
    read_initial_network,
    read_maintenance,
    read_series,
)
from rl2grid.errors import UsageError
from rl2grid.grids import System
from rl2grid.grids.grid import grid_from_record
from rl2grid.grids.network import network_from_record
from rl2grid.mdp.actions import full_size
from rl2grid.scenarios.cache import data_folder
from rl2grid.scenarios.recorded import RecordedScenarios

FORMAT_VERSION = 1
"""Raised whenever the files of compiled grids would be read differently."""

_HASH_DIGITS = 16


def compile_grid(environment: Any) -> System:
    """Read a Grid2Op environment into a system, and keep it in the data folder.

    The grid is named after the folder of the environment. It has one level, of all topology actions; ``load_p_max`` is
    that of the first time series. Every split holds every series of the environment; where these are in no folders
    there are none. The environment is left as it is: a copy plays the first row of its first time series.

    Args:
        environment: a ``grid2op.Environment`` with ``LightSimBackend``. Only its present time series is searched
            for hazards, which are not simulated.

    Raises:
        UsageError: the environment has a feature that is not simulated, or the data folder cannot be written.
    """
    # Here and not above: load_compiled does without Grid2Op.
    from rl2grid.engines.reference.supported import require_supported, require_supported_model

    require_supported(environment)
    episode = environment.copy()
    try:
        episode.set_id(0)
        maintenance = read_maintenance(episode)
        load_p_max = _load_p_max(episode)
        network = read_initial_network(episode)
        require_supported_model(environment, episode.backend._grid)
    finally:
        episode.close()
    name = environment_name(environment)
    n_actions = full_size(environment.sub_info.tolist(), int(environment.n_line))
    identity = Identity(name, name, (), (n_actions,))
    record = {"grid": read_grid_record(environment, identity, maintenance, load_p_max), "network": network}
    place = _place(environment)
    _keep(record, place)
    return _system(record, place)


def load_compiled(source: str | Path) -> System:
    """A system that :func:`compile_grid` has kept, without Grid2Op.

    Args:
        source: the hash of the grid, or the path of its file (``*.json``).

    Raises:
        UsageError: there is no such file, or it is damaged.
    """
    path = Path(source) if str(source).endswith(".json") else compiled_path(str(source))
    kept = _read(path)
    if kept is None:
        raise UsageError(f"Compiled grid {source} is missing or damaged ({path}): compile its environment again.")
    return _system(*kept)


def compiled_path(grid_hash: str) -> Path:
    """Where the grid with this hash is kept."""
    return data_folder() / "grids" / f"v{FORMAT_VERSION}" / f"{grid_hash}.json"


def _load_p_max(environment: Any) -> Any:
    """[load] largest demand in the present time series, MW; the present demand where it is not read from a file."""
    load_p = getattr(read_series(environment), "load_p", None)
    if load_p is None or not len(load_p):
        return environment.get_obs().load_p
    return np.max(load_p, axis=0)


def _hash(record: dict[str, Any]) -> str:
    content = json.dumps({"format": FORMAT_VERSION, **record}, sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:_HASH_DIGITS]


def _place(environment: Any) -> dict[str, Any]:
    """Where this machine has the environment and its series; no part of what the hash names."""
    source = environment.chronics_handler.real_data
    folders = [Path(str(path)) for path in getattr(source, "subpaths", ())]
    names = {
        theirs: ours
        for columns in (environment._names_chronics_to_backend or {}).values()
        for theirs, ours in columns.items()
        if theirs != ours
    }
    return {
        "environment": str(environment.get_path_env()),
        "series": {folder.name: str(folder) for folder in sorted(folders) if folder.is_dir()},
        "columns": names,
    }


def _keep(record: dict[str, Any], place: dict[str, Any]) -> None:
    path = compiled_path(_hash(record))
    if _read(path) == (record, place):
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with filelock.FileLock(path.with_suffix(".lock")):
            temporary = path.with_name(f".{path.name}.{os.getpid()}")
            temporary.write_text(json.dumps({"hash": _hash(record), **record, "place": place}))
            os.replace(temporary, path)
    except OSError as error:
        raise UsageError(
            f"The data folder {data_folder()} cannot be written ({error}): set RL2GRID_DATA to one that can."
        ) from error


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """The record and the place, or None where the file is missing or is not what its hash says."""
    try:
        record: dict[str, Any] = json.loads(path.read_text())
        expected, place = record.pop("hash"), record.pop("place")
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return (record, place) if _hash(record) == expected else None


def _system(record: dict[str, Any], place: dict[str, Any]) -> System:
    grid = grid_from_record(record["grid"], _hash(record))
    series = {name: Path(folder) for name, folder in place["series"].items()}
    scenarios = RecordedScenarios(series, columns=place["columns"])
    network = network_from_record(grid, record["network"])
    return System(grid, network, scenarios, environment=Path(place["environment"]))
