"""Worlds: everything of one environment at one moment, as a value.

``save(i)`` of an engine or an environment makes a :class:`World`, ``restore(i, world)`` goes on from it, bit for bit as
the original would. A *true* world knows the future, for its time series goes on as it did. An *imagined* world
(``imagine(i, seed)``) knows only what an operator may know: see ``docs/worlds.md``.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import weakref
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.mdp.actions import Change, StepAction
from rl2grid.scenarios.episodes import EpisodePlan

_OUTLOOK_ARRAYS = ("load_p", "load_q", "prod_p", "prod_v")
_COMPRESSION = 1
MAX_BYTES = 2**28
"""Of one array of a saved world: a text that expands to more holds none."""
"""Level of zlib: checkpoints are to be quick."""

Bytes = NDArray[np.uint8]
F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Home:
    """Where a world can be restored: engines that are made alike."""

    engine: str
    """``"native"`` or ``"reference"``."""
    grid_id: str
    grid_hash: str
    dispatch: str
    attacked: bool
    """Whether the grid's opponent attacks."""
    layout: str
    """Hash of what is saved and in which order: another version of the package may save something else."""

    def __str__(self) -> str:
        opponent = "with opponent" if self.attacked else "without opponent"
        return f"the {self.engine} engine on {self.grid_id}, dispatch={self.dispatch!r}, {opponent}"


@dataclass(frozen=True)
class SeriesName:
    """Which recorded or generated series goes on after a true world."""

    scenario_id: str
    content_hash: str
    start: int
    """Row of the scenario at which the episode began."""

    @property
    def nbytes(self) -> int:
        """Nothing: the series is where it was, and is loaded by its name."""
        return 0


@dataclass(frozen=True, eq=False)
class Outlook:
    """The time series of an imagined future: the forecasts made now; later steps repeat the last row."""

    scenario_id: str
    """The scenario whose forecasts these are."""
    first_step: int
    """Step of the episode to which row 0 belongs."""
    load_p: F32 = field(repr=False)
    """MW, float32 [rows, load]."""
    load_q: F32 = field(repr=False)
    """MVAr, float32 [rows, load]."""
    prod_p: F32 = field(repr=False)
    """MW, float32 [rows, gen]."""
    prod_v: F32 = field(repr=False)
    """kV, float32 [rows, gen]."""

    def __post_init__(self) -> None:
        for name in _OUTLOOK_ARRAYS:
            object.__setattr__(self, name, _fixed(getattr(self, name), np.float32))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Outlook) and _same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.scenario_id, self.first_step))

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.__post_init__()

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return self.load_p.nbytes + self.load_q.nbytes + self.prod_p.nbytes + self.prod_v.nbytes


@dataclass(frozen=True, eq=False)
class History:
    """How the reference engine comes back to a moment: it plays the episode again."""

    plan: EpisodePlan
    actions: tuple[StepAction, ...] = field(repr=False)
    """Those of all grid steps since the reset."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, History) and _plain_history(self) == _plain_history(other)

    def __hash__(self) -> int:
        return hash((self.plan, len(self.actions)))


class Trail:
    """How far the truth of an episode has been seen: one object for an environment, its worlds and its copies.

    Only within a process: a world that was pickled carries how far it was seen until then.
    """

    def __init__(self, furthest: int) -> None:
        self.furthest = furthest
        """Last step of the episode that anybody has played."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Trail:
        return self


@dataclass(frozen=True)
class Standing:
    """What an environment adds to its engine's world: its task, and where it is in its stream of episodes."""

    task: str
    """Id of the task."""
    options: tuple[tuple[str, str], ...]
    """The keywords of the environment, in words."""
    seed: int
    """Seed of the stream."""
    number: int
    """Episodes of the stream before this one."""
    reset_options: tuple[tuple[str, Any], ...]
    """``options`` of the reset."""
    earlier_steps: int
    """Grid steps of the stream's earlier episodes."""
    pending: bool
    """The episode ended inside ``reset``; the next ``step`` returns the ending."""
    plan: EpisodePlan
    effect: str
    """What was refused or clipped of the last action."""
    foresight: int
    """Decisions of the episode taken where its truth had been seen before; see :class:`Trail`."""
    trail: Trail | None = field(default=None, compare=False, repr=False)
    """None: of an imagined world."""


@dataclass(frozen=True, eq=False)
class World:
    """Everything of one environment at one moment; picklable, never changed.

    It holds the grid's state and hidden memory, the power flow's voltages and factors, the opponent and its draws, the
    planned outages, all sums, and where the series and the stream of episodes are; not the series themselves, which are
    loaded by their names and shared.
    """

    home: Home
    """Where it can be restored."""
    rows: Bytes
    """What the engine holds of the environment, uint8 [byte]."""
    series: SeriesName | Outlook
    """What the outside world does from here on."""
    history: History | None = None
    """None: of the native engine, which needs none."""
    standing: Standing | None = None
    """None: of an engine, which knows no episodes beyond the running one."""
    nearby: weakref.ref[Any] | None = field(default=None, repr=False)
    """The series where this process has it open; not pickled."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "rows", _fixed(self.rows, np.uint8))

    @property
    def imagined(self) -> bool:
        """Whether the future is imagined; the true one is knowledge that no operator has (*foresight*)."""
        return isinstance(self.series, Outlook)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays; the other values take a few hundred more."""
        return self.rows.nbytes + self.series.nbytes

    def __eq__(self, other: object) -> bool:
        return isinstance(other, World) and _same_fields(self, other)

    def __hash__(self) -> int:
        return hash((self.home, self.rows.tobytes()))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "nearby": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.__post_init__()

    def __deepcopy__(self, memo: dict[int, Any]) -> World:
        return self  # nothing of it ever changes

    def at(self, standing: Standing) -> World:
        """The same world, of an environment."""
        return replace(self, standing=standing)

    def check_home(self, home: Home) -> None:
        """Refuse a world that is of another engine.

        Raises:
            UsageError: it is.
        """
        if self.home == home:
            return
        if replace(self.home, layout=home.layout) == home:
            raise UsageError(f"This world was saved by another version of the engine: save it again on {home}.")
        raise UsageError(f"This world is of {self.home}: it cannot be restored on {home}.")

    def to_plain(self) -> dict[str, Any]:
        """The world as numbers, texts, lists and dictionaries of them, for files that execute nothing.

        Arrays are texts: compressed (zlib) and written in base64.
        """
        standing = None if self.standing is None else _plain_standing(self.standing)
        series = {each.name: _plain_value(getattr(self.series, each.name)) for each in fields(self.series)}
        history = None if self.history is None else _plain_history(self.history)
        return {
            "home": asdict(self.home),
            "rows": _text_of(self.rows),
            "series": series,
            "history": history,
            "standing": standing,
        }


def other_values(grid_id: str, series: SeriesName) -> UsageError:
    """The series of a world has changed since."""
    return UsageError(
        f"Scenario {series.scenario_id!r} of {grid_id} has other values than when this world was saved, which cannot "
        "be gone on with."
    )


@functools.lru_cache(maxsize=32)
def grid_fingerprint(grid: Grid) -> str:
    """Hash of every value of a grid."""
    digest = hashlib.sha256()
    for each in fields(grid):
        value = getattr(grid, each.name)
        digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return digest.hexdigest()[:16]


def world_of_plain(plain: Mapping[str, Any]) -> World:
    """The world that :meth:`World.to_plain` wrote down.

    Raises:
        UsageError: it is not one.
    """
    try:
        series = dict(plain["series"])
        if "load_p" in series:
            series |= {name: _array_of(series[name]) for name in _OUTLOOK_ARRAYS}
        history, standing = plain["history"], plain["standing"]
        return World(
            Home(**plain["home"]),
            _bytes_of(plain["rows"]),
            Outlook(**series) if "load_p" in series else SeriesName(**series),
            None if history is None else _history_of_plain(history),
            None if standing is None else _standing_of_plain(standing),
        )
    except (KeyError, TypeError, ValueError, zlib.error) as error:
        raise UsageError("The saved state is not of this version: it does not hold the worlds of its rows.") from error


def _text_of(array: NDArray[Any]) -> str:
    return base64.b64encode(zlib.compress(array.tobytes(), _COMPRESSION)).decode()


def _bytes_of(text: str) -> Bytes:
    unpacking = zlib.decompressobj()
    content = unpacking.decompress(base64.b64decode(text, validate=True), MAX_BYTES)
    if not unpacking.eof:
        raise ValueError(f"more than {MAX_BYTES} bytes")
    return np.frombuffer(content, np.uint8)


def _plain_value(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"shape": list(value.shape), "values": _text_of(value)}
    return value


def _array_of(plain: Mapping[str, Any]) -> F32:
    return _bytes_of(plain["values"]).view(np.float32).reshape(plain["shape"])


def _plain_history(history: History) -> dict[str, Any]:
    actions = [
        [[list(change) for change in action.changes], None if action.values is None else action.values.tolist()]
        for action in history.actions
    ]
    return {"plan": _plain_plan(history.plan), "actions": actions}


def _history_of_plain(plain: Mapping[str, Any]) -> History:
    actions = tuple(
        StepAction(
            tuple(Change(*change) for change in changes), None if values is None else np.array(values, np.float32)
        )
        for changes, values in plain["actions"]
    )
    return History(EpisodePlan(**plain["plan"]), actions)


def _plain_plan(plan: EpisodePlan) -> dict[str, Any]:
    return {name: _number(value) for name, value in plan._asdict().items()}


def _plain_standing(standing: Standing) -> dict[str, Any]:
    plain = {each.name: getattr(standing, each.name) for each in fields(standing) if each.name != "trail"}
    plain["plan"] = _plain_plan(standing.plan)
    plain["options"] = dict(standing.options)
    plain["reset_options"] = {name: _number(value) for name, value in standing.reset_options}
    return {**plain, "furthest": None if standing.trail is None else standing.trail.furthest}


def _standing_of_plain(plain: Mapping[str, Any]) -> Standing:
    rest = {name: value for name, value in plain.items() if name != "furthest"}
    rest["plan"] = EpisodePlan(**plain["plan"])
    for name in ("options", "reset_options"):
        rest[name] = tuple(plain[name].items())
    furthest = plain["furthest"]
    return Standing(**rest, trail=None if furthest is None else Trail(furthest))


def _number(value: Any) -> Any:
    """A NumPy number as Python's."""
    return value.item() if isinstance(value, np.generic) else value


def _fixed(array: NDArray[Any], dtype: Any) -> NDArray[Any]:
    """An array that cannot be written to; the given one if it is of that kind already."""
    if array.dtype != dtype or not array.flags.c_contiguous:
        array = np.ascontiguousarray(array, dtype)
    array.flags.writeable = False
    return array


def _same_fields(one: Any, other: Any) -> bool:
    for each in fields(one):
        mine, theirs = getattr(one, each.name), getattr(other, each.name)
        if each.name == "nearby":
            continue
        if isinstance(mine, np.ndarray):
            if not np.array_equal(mine, theirs):
                return False
        elif mine != theirs:
            return False
    return True
