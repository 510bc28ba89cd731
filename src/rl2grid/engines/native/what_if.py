"""What every action, or every outage, would do to the line loadings of a moment: one call (``docs/what_if.md``).

The power flow of the topology after the action is solved, as a step would solve it; protections do not trip lines.
"""

from __future__ import annotations

import enum
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from rl2grid.arrays import F32, I8, I32, U64, Flags
from rl2grid.compile import jit
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.environments import Environments, open_environments
from rl2grid.engines.native.threads import Threads
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.handles import Handle, opener
from rl2grid.mdp.actions import ActionCatalogue, ActionKind, Ids
from rl2grid.mdp.termination import GameOver
from rl2grid.powerflow.batch import (
    MOVE,
    NOTHING,
    SWITCH,
    BatchSolver,
    ChangeOutcomes,
    Changes,
    Snapshot,
    new_outcomes,
    new_snapshot,
    new_wiring,
)
from rl2grid.powerflow.model import Network, load_network
from rl2grid.structures import allocate

_KINDS = np.full(len(ActionKind), -1, np.int8)
_KINDS[[ActionKind.NOTHING, ActionKind.MOVE, ActionKind.SWITCH]] = NOTHING, MOVE, SWITCH
_SMALLEST_PART = 64
"""Changes that are worth a thread."""
_FEW = 128
"""Changes of a question whose arrays are kept for the next one of its size."""
_DISPATCH = int(GameOver.DISPATCH)
_open_snapshot, _open_changes = opener(Snapshot), opener(Changes)


class Moment(enum.Enum):
    """Of which injections, planned outages and cooldowns a question is."""

    PRESENT = "present"
    """Those of the last observation."""
    NEXT_STEP = "next step"
    """Those of the forecast for the next step, as ``simulate`` plays it."""


class ActionOutcomes(NamedTuple):
    """What each action would do; entry k belongs to the k-th action asked."""

    worst_loading: F32  # [action] largest current over thermal limit, inf where no flow is found
    verdict: I8  # [action] rl2grid.mdp.termination.GameOver: NONE, or why no flow is found
    overloads: I32  # [action] lines above their thermal limit, 0 where no flow is found
    legal: Flags  # [action] the cooldowns allow it; the other fields do not look at that


class FirstSafe(NamedTuple):
    """Which of some actions, in an order of preference, is to be played."""

    place: int  # of the first that is safe; where none is, of the first with the least worst loading
    worst_loading: float  # after it: largest current over thermal limit, inf where no flow is found
    is_safe: bool


class OutageOutcomes(NamedTuple):
    """What the loss of each line would do; entry k belongs to the k-th line asked."""

    worst_loading: F32  # [outage] largest current over thermal limit, inf where no flow is found
    verdict: I8  # [outage] rl2grid.mdp.termination.GameOver: NONE, or why no flow is found
    overloads: I32  # [outage] lines above their thermal limit, 0 where no flow is found
    was_open: Flags  # [outage] the line is open already: the other fields are the present ones


class Security(NamedTuple):
    """The outages of a moment in two numbers."""

    worst_loading: float  # largest over all outages, inf if one of them leaves no flow
    n_unsafe: int  # outages that leave an overload or no flow
    n_outages: int  # lines in service


class _Room(NamedTuple):
    """Where the changes and the outcomes of a question lie."""

    changes: Handle[Changes]
    outcomes: Handle[ChangeOutcomes]
    company: I32  # [change] workspace of a search for one


def _new_room(shape: tuple[int, ...], n_line: int) -> _Room:
    """Room for changes whose masks have a shape, [change, word], without loadings of single lines."""
    n, n_words = shape
    changes = allocate(Changes, {"change": n, "word": n_words})
    outcomes = new_outcomes(n, np.zeros((0, n_line), np.float32))
    return _Room(Handle(changes), Handle(outcomes), np.zeros(n, np.int32))


class WhatIf:
    """Answers what-if questions about one grid; keeps the workspace, so make it once.

    Not for several threads at a time.

    Args:
        grid: the grid.
        network: electrical model; of a grid that no system is registered for; None: that of its system.
        num_threads: threads that share a call; every number gives the same bits.

    Raises:
        UsageError: not a positive number of threads.
    """

    def __init__(self, grid: Grid, network: Network | None = None, num_threads: int = 1) -> None:
        if num_threads < 1:
            raise UsageError(f"num_threads={num_threads} is not allowed: give at least 1.")
        self.grid = grid
        self._network = load_network(grid) if network is None else network
        wiring = new_wiring(grid, self._network)
        self._snapshot = new_snapshot(grid)
        self._point = Handle(self._snapshot)
        self._solvers = [BatchSolver(grid, self._network, wiring, self._snapshot) for _ in range(num_threads)]
        self._threads = Threads(num_threads, "what-if")
        self._rooms: dict[tuple[int, ...], _Room] = {}

    def actions(
        self, snapshot: Snapshot, catalogue: ActionCatalogue, ids: Ids | None = None, rho: F32 | None = None
    ) -> ActionOutcomes:
        """The flow after each action, from one operating point.

        Args:
            snapshot: the operating point.
            catalogue: the actions; of kinds NOTHING, MOVE and SWITCH.
            ids: those to ask for, int32 [action]; all of them if left out.
            rho: where the loadings of all lines are to be written, float32 [action, line].

        Raises:
            UsageError: an action of another kind, or ``rho`` of another shape.
        """
        changes = _changes_of(catalogue, ids)
        outcomes = self.solve(snapshot, changes, rho)
        return ActionOutcomes(*outcomes[:3], legal_changes(snapshot, changes))

    def first_safe(self, snapshot: Snapshot, catalogue: ActionCatalogue, ids: Ids, limit: float) -> FirstSafe:
        """The first of some actions after which every line is loaded below a limit, else the least bad of them.

        What :meth:`actions` says of each, to the bit, but nothing is solved behind the one that is found. One thread.

        Args:
            snapshot: the operating point.
            catalogue: the actions; of kinds NOTHING, MOVE and SWITCH.
            ids: those to choose from, int32 [action], the one to play if it is safe first.
            limit: share of the thermal limits.

        Raises:
            UsageError: no action, or one of another kind or that the catalogue lacks.
        """
        self._write_snapshot(snapshot)
        return self._first_safe(catalogue, ids, limit)

    def first_safe_in(
        self, environments: Handle[Environments], i: int, catalogue: ActionCatalogue, ids: Ids, limit: float
    ) -> FirstSafe:
        """What :meth:`first_safe` says of the operating point of environment ``i`` as it is."""
        _write_point(environments.address, i, self._point.address)
        return self._first_safe(catalogue, ids, limit)

    def _first_safe(self, catalogue: ActionCatalogue, ids: Ids, limit: float) -> FirstSafe:
        """:meth:`first_safe`, of the operating point that was taken over."""
        if not len(ids):
            raise UsageError("A safe action is found among some: give at least one.")
        room = self._room((len(ids), catalogue.mask.shape[1]))
        _fill(room.changes, catalogue, ids)
        place = self._solvers[0].find_safe(room.changes, room.outcomes, limit, room.company)
        worst = float(room.outcomes.structure.worst_loading[place])
        return FirstSafe(place, worst, worst < limit)

    def outages(self, snapshot: Snapshot, lines: Ids | None = None, rho: F32 | None = None) -> OutageOutcomes:
        """The flow after the loss of each line (N-1), all others as they are.

        Args:
            snapshot: the operating point.
            lines: those to lose, one at a time, int32 [outage]; all of them if left out.
            rho: where the loadings of all lines are to be written, float32 [outage, line].

        Raises:
            UsageError: ``rho`` of another shape.
        """
        chosen = np.arange(self.grid.n_line, dtype=np.int32) if lines is None else np.asarray(lines, np.int32)
        ends = self.grid.line_or_pos_topo_vect[chosen], self.grid.line_ex_pos_topo_vect[chosen]
        was_open = (snapshot.topo_vect[ends[0]] < 1) & (snapshot.topo_vect[ends[1]] < 1)
        kind = np.where(was_open, NOTHING, SWITCH).astype(np.int8)
        outcomes = self.solve(snapshot, Changes(kind, chosen, np.zeros((len(chosen), 1), np.uint64)), rho)
        return OutageOutcomes(*outcomes[:3], was_open)

    def security(self, snapshot: Snapshot) -> Security:
        """The N-1 analysis of all lines in service in two numbers."""
        outcomes = self.outages(snapshot)
        lost = ~outcomes.was_open
        if not lost.any():
            return Security(0.0, 0, 0)
        unsafe = (outcomes.verdict != 0) | (outcomes.overloads > 0)
        return Security(float(outcomes.worst_loading[lost].max()), int(unsafe[lost].sum()), int(lost.sum()))

    def solve(self, snapshot: Snapshot, changes: Changes, rho: F32 | None = None) -> ChangeOutcomes:
        """The flow after each change; see :func:`rl2grid.powerflow.batch.solve_changes`."""
        n, n_line = len(changes.kind), self.grid.n_line
        if rho is not None and (rho.shape != (n, n_line) or rho.dtype != np.float32 or not rho.flags.c_contiguous):
            raise UsageError(f"rho must be a contiguous float32 array of shape ({n}, {n_line}), got {rho.shape}.")
        self._write_snapshot(snapshot)
        if rho is not None:
            outcomes = new_outcomes(n, rho)
            self._solve(Handle(changes), Handle(outcomes))
            return outcomes
        room = self._room_of(changes)
        self._solve(room.changes, room.outcomes)
        return ChangeOutcomes._make(array.copy() for array in room.outcomes.structure)

    def _write_snapshot(self, snapshot: Snapshot) -> None:
        """Take over the operating point."""
        for kept, array in zip(self._snapshot, snapshot, strict=True):
            np.copyto(kept, array)

    def _room_of(self, changes: Changes) -> _Room:
        """Room that holds the changes."""
        room = self._room(changes.mask.shape)
        asked = room.changes.structure
        asked.kind[:], asked.target[:], asked.mask[:] = changes
        return room

    def _room(self, shape: tuple[int, ...]) -> _Room:
        """Room for changes whose masks have a shape: kept for few of them, of which there will be more."""
        room = self._rooms.get(shape) or _new_room(shape, self.grid.n_line)
        if shape[0] <= _FEW:
            self._rooms[shape] = room
        return room

    def _solve(self, asked: Handle[Changes], outcomes: Handle[ChangeOutcomes]) -> None:
        """Write the outcomes of the changes."""
        changes = asked.structure
        order = np.lexsort((changes.target, -changes.kind)).astype(np.int32)
        parts = self._parts(order)

        def solve_part(k: int) -> None:
            self._solvers[k].solve(asked, outcomes, parts[k])

        if len(parts) == 1:
            solve_part(0)
        else:
            self._threads.map(solve_part, range(len(parts)))

    def _parts(self, order: I32) -> list[I32]:
        n_parts = min(len(self._solvers), len(order) // _SMALLEST_PART)
        return np.array_split(order, n_parts) if n_parts > 1 else [order]


def snapshot_of(engine: NativeEngine, i: int) -> Snapshot:
    """The operating point of environment ``i`` as last observed; copies, a few kB.

    Raises:
        UsageError: the environment is not in an episode.
    """
    return _copied(_present(engine, i))


def forecast_of(engine: NativeEngine, i: int, horizon: int = 1) -> Snapshot | None:
    """The operating point of environment ``i`` on the forecast ``horizon`` steps ahead, before anybody acts.

    Returns:
        The operating point, or None if the generators cannot follow the forecast: the game is then lost, whatever
        the topology.

    Raises:
        UsageError: after a game over, or without such a forecast.
    """
    point = _foreseen(engine, i, horizon)
    return None if point is None else _copied(point)


def what_if(
    engine: NativeEngine,
    i: int,
    catalogue: ActionCatalogue,
    ids: Ids | None = None,
    moment: Moment = Moment.PRESENT,
    num_threads: int = 1,
) -> ActionOutcomes:
    """The flow after each action in environment ``i``; see :meth:`WhatIf.actions`.

    Where the generators cannot follow the forecast, every verdict is DISPATCH.
    """
    point = _present(engine, i) if moment is Moment.PRESENT else _foreseen(engine, i)
    if point is None:
        n = len(catalogue) if ids is None else len(ids)
        nothing = np.zeros(n, np.int32)
        return ActionOutcomes(np.full(n, np.inf, np.float32), np.full(n, _DISPATCH, np.int8), nothing, nothing == 0)
    return _solver_of(engine, num_threads).actions(point, catalogue, ids)


def first_safe(engine: NativeEngine, i: int, catalogue: ActionCatalogue, ids: Ids, limit: float) -> FirstSafe:
    """Which action to play in environment ``i``, by the forecast of the next step; see :meth:`WhatIf.first_safe`.

    Where the generators cannot follow the forecast, it is the first.
    """
    foreseen = engine.foresee(i, 1)
    if foreseen is None:
        return FirstSafe(0, np.inf, False)
    return _solver_of(engine, 1).first_safe_in(foreseen, 0, catalogue, ids, limit)


def outages(engine: NativeEngine, i: int) -> OutageOutcomes:
    """The flow after the loss of each line in environment ``i``, as last observed; see :meth:`WhatIf.outages`."""
    return _solver_of(engine, 1).outages(_present(engine, i))


def n_minus_1_score(engine: NativeEngine, i: int) -> float:
    """Share of the lines in service whose loss would leave neither an overload nor a collapse."""
    security = _solver_of(engine, 1).security(_present(engine, i))
    return 1.0 - security.n_unsafe / max(security.n_outages, 1)


def _solver_of(engine: NativeEngine, num_threads: int) -> WhatIf:
    """The solver that an engine has used before, or a new one."""
    solvers = _SOLVERS.setdefault(engine, {})
    if num_threads not in solvers:
        solvers[num_threads] = WhatIf(engine.grid, engine.environments.network, num_threads)
    return solvers[num_threads]


_SOLVERS: WeakKeyDictionary[NativeEngine, dict[int, WhatIf]] = WeakKeyDictionary()


def _present(engine: NativeEngine, i: int) -> Snapshot:
    """What :func:`snapshot_of` copies."""
    if engine.state.terminated[i] or not engine.state.line_status[i].any():
        raise UsageError("Nothing can be asked after a game over or before a reset: reset the environment first.")
    return _point_of(engine.environments, i)


def _foreseen(engine: NativeEngine, i: int, horizon: int = 1) -> Snapshot | None:
    """What :func:`forecast_of` copies: it is there until the next simulation."""
    foreseen = engine.foresee(i, horizon)
    return None if foreseen is None else _point_of(foreseen.structure, 0)


def _point_of(environments: Environments, i: int) -> Snapshot:
    """The operating point of row ``i``, where it lies: it changes with the row."""
    state, hidden = environments.state, environments.hidden
    return Snapshot(
        state.topo_vect[i],
        hidden.last_bus[i],
        state.time_before_cooldown_line[i],
        state.time_before_cooldown_sub[i],
        hidden.gen_p[i],
        hidden.gen_v[i].astype(np.float32),
        hidden.load_p[i],
        hidden.load_q[i],
        state.storage_power[i],
    )


def _copied(point: Snapshot) -> Snapshot:
    return Snapshot._make(array.copy() for array in point)


def _changes_of(catalogue: ActionCatalogue, ids: Ids | None) -> Changes:
    """What actions change; of all of a catalogue, or of some.

    Raises:
        UsageError: as :func:`_fill`.
    """
    asked = np.arange(len(catalogue), dtype=np.int32) if ids is None else np.asarray(ids, np.int32)
    changes = allocate(Changes, {"change": len(asked), "word": catalogue.mask.shape[1]})
    _fill(Handle(changes), catalogue, asked)
    return changes


def _fill(changes: Handle[Changes], catalogue: ActionCatalogue, ids: Ids) -> None:
    """Write what actions change.

    Raises:
        UsageError: the catalogue lacks one of them, or one changes no topology.
    """
    written = _write_changes(catalogue.kind, catalogue.target, catalogue.mask, ids, changes.address)
    if written == len(ids):
        return
    if 0 <= ids[written] < len(catalogue):
        raise UsageError("A what-if is for actions of kind NOTHING, MOVE and SWITCH; others have no topology.")
    raise UsageError(f"Action {ids[written]} is none of the catalogue: give numbers from 0 to {len(catalogue) - 1}.")


@jit
def _write_point(environments: int, i: int, snapshot: int) -> None:
    """Take over what :func:`_point_of` tells of an environment; addresses of handles."""
    opened, point = open_environments(environments), _open_snapshot(snapshot)
    state, hidden = opened.state, opened.hidden
    for k in range(point.topo_vect.shape[0]):
        point.topo_vect[k] = state.topo_vect[i, k]
        point.last_bus[k] = hidden.last_bus[i, k]
    for k in range(point.cooldown_line.shape[0]):
        point.cooldown_line[k] = state.time_before_cooldown_line[i, k]
    for k in range(point.cooldown_sub.shape[0]):
        point.cooldown_sub[k] = state.time_before_cooldown_sub[i, k]
    for k in range(point.gen_p.shape[0]):
        point.gen_p[k] = hidden.gen_p[i, k]
        point.gen_v[k] = np.float32(hidden.gen_v[i, k])
    for k in range(point.load_p.shape[0]):
        point.load_p[k] = hidden.load_p[i, k]
        point.load_q[k] = hidden.load_q[i, k]
    for k in range(point.storage_p.shape[0]):
        point.storage_p[k] = state.storage_power[i, k]


@jit
def _write_changes(kind: I8, target: I32, mask: U64, ids: I32, changes: int) -> int:
    """Write what actions change.

    Args:
        kind: of the catalogue, as the others.
        target: likewise.
        mask: likewise.
        ids: of the actions.
        changes: address of the handle to as many changes.

    Returns:
        How many are written: all, or those before the first that the catalogue lacks or that changes no topology.
    """
    asked = _open_changes(changes)
    for k in range(ids.shape[0]):
        action = ids[k]
        if action < 0 or action >= kind.shape[0] or _KINDS[kind[action]] < 0:
            return k
        asked.kind[k] = _KINDS[kind[action]]
        asked.target[k] = target[action]
        for word in range(mask.shape[1]):
            asked.mask[k, word] = mask[action, word]
    return len(ids)


def legal_changes(snapshot: Snapshot, changes: Changes) -> Flags:
    """Which changes the cooldowns allow, bool [change]; the rule of :func:`rl2grid.mdp.actions.is_legal`."""
    legal = np.ones(len(changes.kind), np.bool_)
    moves, switches = changes.kind == MOVE, changes.kind == SWITCH
    legal[moves] = snapshot.cooldown_sub[changes.target[moves]] == 0
    legal[switches] = snapshot.cooldown_line[changes.target[switches]] == 0
    return legal
