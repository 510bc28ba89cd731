"""Scenarios of a grid of one's own: series in memory, or in Grid2Op scenario folders, source ``recorded``."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid, MaintenanceConfig
from rl2grid.scenarios.cache import CachedSeries, cached_series
from rl2grid.scenarios.folder import FolderContent, read_folder, source_key
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.splits import BUNDLED, SPLITS, draw_listed, require_listed, shortened

RECORDED = "recorded"
OWN_TOLERANCE = 0.1
"""Share of pmax by which dispatchable generators may exceed it in a grid's own series."""

_NAME = re.compile(r"[^\[\]/\\]+")
_OF_LOADS = ("load_p", "load_q", "load_p_forecast", "load_q_forecast")
_OF_GENERATORS = ("prod_p", "prod_v", "prod_p_forecast", "prod_v_forecast")
_REQUIRED = ("load_p", "load_q", "prod_p")


@dataclass(frozen=True)
class RecordedScenarios:
    """Series that somebody has; see :class:`rl2grid.grids.systems.Scenarios`.

    Raises:
        UsageError: a name cannot be part of a scenario's id, or a split is unknown or names a series that is not there.
    """

    series: Mapping[str, Path | FolderContent]
    """Name of each series, and its Grid2Op scenario folder or its arrays, columns in the order of the grid."""
    splits: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of the series of a split; a split that is left out holds all of them."""
    columns: Mapping[str, str] = field(default_factory=dict)
    """What columns of the folders are called in the grid, where the names differ (``names_chronics_to_grid``)."""

    def __post_init__(self) -> None:
        for name in self.series:
            if _NAME.fullmatch(name) is None:
                raise UsageError(f"Series {name!r} cannot name a scenario: leave out slashes and brackets.")
        for split, names in self.splits.items():
            if split not in SPLITS:
                raise one_of("Split", split, SPLITS)
            for name in names:
                if name not in self.series:
                    raise one_of(f"Series of the split {split},", name, shortened(list(self.series)))

    def sources(self, grid: Grid) -> Mapping[str, str]:
        return {RECORDED: f"{RECORDED}/{next(iter(self.series), '<name>')}"}

    def listed(self, grid: Grid, split: str) -> tuple[str, ...]:
        names = self.splits.get(split) or tuple(self.series)
        if split == BUNDLED:
            names = tuple(self.series)
        return tuple(f"{RECORDED}/{name}" for name in names)

    def check(self, grid: Grid, split: str, scenario_id: str) -> None:
        require_listed(grid, split, self.listed(grid, split), scenario_id)

    def draw(self, grid: Grid, split: str, seed: int, number: int) -> str:
        return draw_listed(self.listed(grid, split), split, seed, number)

    def load(self, grid: Grid, source: str, name: str) -> CachedSeries:
        if name not in self.series:
            listed = shortened([f"{RECORDED}/{each}" for each in self.series])
            raise one_of(f"Scenario of {grid.id}", f"{source}/{name}", listed)
        series = self.series[name]
        if isinstance(series, FolderContent):
            content = _checked(grid, name, series)
            return cached_series(grid.id, f"{RECORDED}.{name}", _key(content), lambda: content)
        names = repr(sorted(self.columns.items())).encode()
        key = hashlib.sha256(source_key(grid, series).encode() + names).hexdigest()
        return cached_series(grid.id, f"{RECORDED}.{name}", key, lambda: self._read(grid, series))

    def _read(self, grid: Grid, folder: Path) -> FolderContent:
        # Series that belong to a grid are played as they are: some that come with Grid2Op exceed pmax a little.
        return read_folder(grid, folder, columns=self.columns, dispatchable_tolerance=OWN_TOLERANCE)

    def sample(self, grid: Grid, split: str) -> tuple[str, tuple[str, ...]]:
        return "", self.listed(grid, split)

    def maintenance(self, grid: Grid, source: str) -> MaintenanceConfig:
        return grid.maintenance

    def generator_version(self, split: str) -> str | None:
        return None


def _checked(grid: Grid, name: str, content: FolderContent) -> FolderContent:
    """The arrays of a series in the types that are played.

    Raises:
        UsageError: one is missing, unknown, of another shape, or has a value that is no number.
    """
    what = f"Series {name!r} of {grid.id}"
    missing = [each for each in _REQUIRED if each not in content.arrays]
    if missing:
        raise UsageError(f"{what} lacks {missing[0]}: {', '.join(_REQUIRED)} are needed.")
    rows = len(content.arrays["load_p"])
    if rows < 2:
        raise UsageError(f"{what} has {rows} rows: at least 2 are needed.")
    arrays: dict[str, NDArray[Any]] = {}
    for field_ in fields(Scenario):  # in this order, as imported series have them
        array = content.arrays.get(field_.name)
        if array is None:
            continue
        dtype = np.bool_ if field_.name == "maintenance" else np.float32
        arrays[field_.name] = np.ascontiguousarray(array, dtype)
        _check_shape(what, field_.name, arrays[field_.name].shape, rows, _width(grid, field_.name))
        if not np.isfinite(arrays[field_.name]).all():
            raise UsageError(f"{what} has a value in {field_.name} that is no finite number.")
    unknown = sorted(set(content.arrays) - set(arrays))
    if unknown:
        raise one_of(f"Array of {what},", unknown[0], (*_OF_LOADS, *_OF_GENERATORS, "maintenance"))
    return FolderContent(content.start_datetime, arrays)


def _check_shape(what: str, name: str, shape: tuple[int, ...], rows: int, width: int) -> None:
    horizons = shape[1:2] if name.endswith("_forecast") else ()
    wanted = (rows, *horizons, width)
    if shape != wanted:
        raise UsageError(f"{what} has {name} of shape {shape}: {wanted} is needed.")


def _width(grid: Grid, name: str) -> int:
    if name in _OF_LOADS:
        return grid.n_load
    return grid.n_gen if name in _OF_GENERATORS else grid.n_line


def _key(content: FolderContent) -> str:
    digest = hashlib.sha256(content.start_datetime.isoformat().encode())
    for name, array in content.arrays.items():
        digest.update(f"{name} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
