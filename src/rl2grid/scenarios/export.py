"""Writing a scenario as a folder that Grid2Op plays: the inverse of :mod:`rl2grid.scenarios.folder`."""

from __future__ import annotations

import bz2
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.grids import Grid, MaintenanceConfig, find_system
from rl2grid.scenarios.progress import Report, ignore
from rl2grid.scenarios.scenario import Scenario

_CHUNK = 2048
"""Rows that are turned into text at once."""


def export_scenario(grid: Grid, scenario: Scenario, folder: Path, report: Report = ignore) -> Path:
    """Write ``scenario`` as ``folder``: bzip2 tables of the shortest decimals that read back as the same float32.

    Where planned outages are sampled, Grid2Op's ``maintenance_meta.json`` says how. The folder appears
    whole or not at all. ``report`` is told how many values were written.

    Returns:
        The folder.

    Raises:
        UsageError: The folder holds something already, or cannot be written.
    """
    folder = folder.resolve()
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise UsageError(f"{folder} exists already: choose a folder that does not.")
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}")
    try:
        temporary.mkdir(parents=True)
        _write_files(grid, scenario, temporary, report)
        os.replace(temporary, folder)
    except OSError as error:
        raise UsageError(f"Folder {folder} cannot be written ({error}): choose another place.") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return folder


def _write_files(grid: Grid, scenario: Scenario, folder: Path, report: Report) -> None:
    done, total = 0, sum(array.size for array in scenario.arrays().values())
    for name, array in scenario.arrays().items():
        header = _names(grid, name)
        file = folder / f"{name}ed.csv.bz2" if name.endswith("_forecast") else folder / f"{name}.csv.bz2"
        with bz2.open(file, "wt", encoding="ascii", newline="\n") as stream:
            stream.write(";".join(header) + "\n")
            table = array.reshape(-1, array.shape[-1])  # Horizons of one row follow each other.
            for first in range(0, len(table), _CHUNK):
                chunk = table[first : first + _CHUNK]
                stream.write(_lines(chunk))
                done += chunk.size
                report(done, total)
    (folder / "start_datetime.info").write_text(f"{scenario.start_datetime:%Y-%m-%d %H:%M}\n")
    (folder / "time_interval.info").write_text("00:05\n")
    config = find_system(grid.id).scenarios.maintenance(grid, scenario.source)
    if config.lines:
        (folder / "maintenance_meta.json").write_text(json.dumps(_maintenance_rules(grid, config), indent=1) + "\n")


def _lines(chunk: NDArray[Any]) -> str:
    words = chunk.astype(np.int8).astype(str) if chunk.dtype == np.bool_ else chunk.astype(str)
    return "\n".join(";".join(row) for row in words.tolist()) + "\n"


def _names(grid: Grid, array: str) -> Sequence[str]:
    if array.startswith("load"):
        return grid.name_load
    return grid.name_gen if array.startswith("prod") else grid.name_line


def _maintenance_rules(grid: Grid, config: MaintenanceConfig) -> dict[str, Any]:
    return {
        "maintenance_starting_hour": config.start_hour,
        "maintenance_ending_hour": config.end_hour,
        "line_to_maintenance": [grid.name_line[line] for line in config.lines],
        "daily_proba_per_month_maintenance": list(config.monthly_daily_probability),
        "max_daily_number_per_month_maintenance": list(config.monthly_max_per_day),
    }
