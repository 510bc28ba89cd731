"""Systems: a grid with everything that it is played with, as one value, and the registry of those that exist.

Grids, networks, rankings, scenarios and tasks are looked up by the id of a grid, and all of it here. The seven of the
benchmark (:mod:`rl2grid.benchmark`) are registered when one is first looked up, in the way in which a user's own are
(:func:`rl2grid.register_system`).
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from numpy.typing import NDArray

from rl2grid.errors import UsageError, one_of
from rl2grid.grids.grid import Grid, MaintenanceConfig
from rl2grid.grids.network import Network
from rl2grid.grids.ranking import Ranking

T = TypeVar("T")

_ID = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


class Lazy(Generic[T]):
    """A field that is given as a value or as a function without arguments that makes it when it is first asked for.

    Args:
        default: one value, of a field that may be left out.
    """

    def __init__(self, *default: T) -> None:
        self._default = default

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, system: object | None, owner: type) -> T:
        if system is None:  # a dataclass asks for the default of its field
            if not self._default:
                raise AttributeError(self._name)
            return self._default[0]
        value = vars(system)[self._name]
        if callable(value):
            value = vars(system)[self._name] = value()
        return value  # type: ignore[no-any-return]

    def __set__(self, system: object, value: T | Callable[[], T]) -> None:
        vars(system)[self._name] = value


class Series(Protocol):
    """A time series as it is loaded, columns in the order of the grid."""

    @property
    def start_datetime(self) -> datetime:
        """Time stamp of the first row."""

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Named as the attributes of :class:`rl2grid.scenarios.scenario.Scenario`."""

    @property
    def content_hash(self) -> str:
        """Hash of every value; the same on every machine."""


class Scenarios(Protocol):
    """What a grid is played on: lists, draws and loads its time series.

    An id is ``source/name``. :class:`rl2grid.scenarios.recorded.RecordedScenarios` plays series that somebody has,
    :class:`rl2grid.scenarios.months.GeneratedScenarios` generated months beside them.
    """

    def sources(self, grid: Grid) -> Mapping[str, str]:
        """Every source, and what an id of it looks like."""

    def listed(self, grid: Grid, split: str) -> tuple[str, ...]:
        """Ids of a split, in the order in which an evaluation plays them.

        Raises:
            UsageError: the split has none, or no end.
        """

    def check(self, grid: Grid, split: str, scenario_id: str) -> None:
        """Refuse a whole series that is not in a split.

        Raises:
            UsageError: it is not.
        """

    def draw(self, grid: Grid, split: str, seed: int, number: int) -> str:
        """Id of what episode ``number`` of the stream of ``seed`` plays: a function of these and nothing else."""

    def load(self, grid: Grid, source: str, name: str) -> Series:
        """A series.

        Raises:
            UsageError: there is none of that name.
        """

    def sample(self, grid: Grid, split: str) -> tuple[str, tuple[str, ...]]:
        """What stands for a split in its hash: the rule of a split without end (else ""), and ids."""

    def maintenance(self, grid: Grid, source: str) -> MaintenanceConfig:
        """How planned outages are sampled where a series of ``source`` records none."""

    def generator_version(self, split: str) -> str | None:
        """Version of what generates the series of a split; None: they are recorded ones."""


@dataclass(frozen=True, eq=False)
class System:
    """A grid with all that the benchmark asks for: what it plays, how it flows, which actions are worth trying.

    Rules, maintenance and opponent are the grid's. Every part but the grid may be given as a function without
    arguments, which is called when the part is first needed; for worker processes it must be one that can be pickled.
    """

    grid: Grid
    network: Lazy[Network] = Lazy()
    """Constants of the power flow."""
    scenarios: Lazy[Scenarios] = Lazy()
    """The time series."""
    ranking: Lazy[Ranking | None] = Lazy(None)
    """The ranked actions, which the levels below the highest hold; None: there is one level, of all actions."""
    environment: Lazy[Path | None] = Lazy(None)
    """Folder of the Grid2Op environment that the reference engine plays; None: only the native engine plays."""
    constants: Lazy[Mapping[str, Any] | None] = Lazy(None)
    """What the generator of scenarios knows of the grid (:mod:`rl2grid.scenarios.generator.constants`), if anything."""

    @property
    def id(self) -> str:
        """What the grid is called, in ids of tasks too."""
        return self.grid.id

    @property
    def hash(self) -> str:
        """Short hash of the grid."""
        return self.grid.hash

    def required_constants(self) -> Mapping[str, Any]:
        """What the generator of scenarios knows of the grid.

        Raises:
            UsageError: nothing was fitted for it.
        """
        if self.constants is None:
            raise UsageError(f"No months of {self.id} can be generated: its system has no constants of the generator.")
        return self.constants

    def ranked(self, ranking: Ranking, *sizes: int) -> System:
        """The same system with levels below that of all actions, which hold the best of a ranking.

        Args:
            ranking: the actions, best first (:func:`rl2grid.grids.rankings.read_ranking`).
            sizes: number of actions of each level, do nothing included; the smallest first.

        Raises:
            UsageError: the sizes do not increase, or the ranking has not so many actions.
        """
        everything = self.grid.level_sizes[-1]
        if sizes != tuple(sorted(set(sizes))) or any(not 2 <= size < everything for size in sizes):
            raise UsageError(
                f"The levels {sizes} of {self.id} are not allowed: give increasing sizes from 2 to {everything - 1:,}."
            )
        if sizes and sizes[-1] > len(ranking.ids) + 1:
            raise UsageError(
                f"A level of {sizes[-1]:,} actions of {self.id} is not allowed: its ranking has {len(ranking.ids):,}."
            )
        return replace(self, grid=replace(self.grid, level_sizes=(*sizes, everything)), ranking=ranking)


_SYSTEMS: dict[str, System] = {}
_BENCHMARK = "rl2grid.benchmark"
"""The module that registers the seven; it knows of layers above this one, which therefore has its name alone."""


def _systems() -> dict[str, System]:
    """All registered systems by the id of their grid; the seven of the benchmark are the first."""
    importlib.import_module(_BENCHMARK)
    return _SYSTEMS


def system_ids() -> tuple[str, ...]:
    """Ids of all registered systems: the seven of the benchmark, then a user's own as they were registered."""
    return tuple(_systems())


def find_system(grid_id: str) -> System:
    """The system of the grid called ``grid_id``.

    Raises:
        UsageError: none of that name is registered.
    """
    systems = _systems()
    if grid_id not in systems:
        raise one_of("Grid", grid_id, system_ids())
    return systems[grid_id]


def load_grid(grid_id: str) -> Grid:
    """The grid called ``grid_id``.

    Raises:
        UsageError: no system of that name is registered.
    """
    return find_system(grid_id).grid


def add_system(system: System) -> None:
    """Make a system known to everything that looks grids up, in the place of an earlier one of the same grid.

    Its tasks are registered with Gymnasium by :func:`rl2grid.envs.registration.register_system`.

    Raises:
        UsageError: its id cannot be part of a task's, or is that of another grid.
    """
    if _ID.fullmatch(system.id) is None:
        raise UsageError(f"Grid {system.id!r} cannot name tasks: use letters, digits, '_', '-' and '.' only.")
    systems = _systems()
    if system.id in systems and systems[system.id].hash != system.hash:
        raise UsageError(f"Another grid is registered as {system.id!r}: give this one an id of its own.")
    systems[system.id] = system


def remove_system(grid_id: str) -> None:
    """Forget a system, so that another one may take its id.

    Raises:
        UsageError: none of that name is registered.
    """
    find_system(grid_id)
    del _SYSTEMS[grid_id]
