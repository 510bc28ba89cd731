"""Actions: the catalogue of topology actions, its difficulty levels, legality, and continuous actions.

The full catalogue of a grid holds do nothing, then every move of a set of one substation's elements
to the other busbar, then the switch of every line: sum over substations of ``2^(n - 1) - 1`` plus
``n_line + 1`` actions (paper, Section 3.1). Its order is that of Grid2Op's ``DiscreteActSpace`` with
``change_bus`` and ``change_line_status``. Moving a set and moving all other elements of the
substation are electrically the same; of the two, the catalogue keeps the one that leaves the first
element where it is, as Grid2Op does.
"""

from __future__ import annotations

import enum
import functools
import hashlib
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rl2grid.arrays import F32, Flags
from rl2grid.compile import jit
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.grids.rankings import ranking
from rl2grid.mdp.state import GridState

Kinds = NDArray[np.int8]
Ids = NDArray[np.int32]
Masks = NDArray[np.uint32]


class ActionKind(enum.IntEnum):
    """What an action does; ``target`` is a line or a substation."""

    NOTHING = 0
    MOVE = 1
    """Move the masked elements of a substation to the other busbar (``change_bus``)."""
    SWITCH = 2
    """Open a closed line, close an open one (``change_line_status``)."""
    RECONNECT = 3
    """Close a line, both ends to the busbars they were on last (``set_line_status`` +1)."""
    RESTORE = 4
    """Move every connected element of a substation that is on busbar 2 back to busbar 1."""
    INJECTION = 5
    """Redispatch, curtail and use storage: ``values`` is the action of the continuous tasks."""


_NOTHING, _MOVE, _SWITCH, _RECONNECT, _RESTORE = (int(kind) for kind in list(ActionKind)[:5])


class StepAction(NamedTuple):
    """What an engine plays in one step."""

    kind: int = int(ActionKind.NOTHING)
    target: int = 0
    """Line (SWITCH, RECONNECT) or substation (MOVE, RESTORE)."""
    mask: int = 0
    """MOVE: bit k is the k-th element of the substation, entry ``sub_first_element + k`` of ``topo_vect``."""
    values: F32 | None = None
    """INJECTION: the Box action, float32 [continuous]; see :func:`decode_continuous`."""


DO_NOTHING = StepAction()


@dataclass(frozen=True, eq=False)
class ActionCatalogue:
    """A list of topology actions as arrays; the position in it is the action's id. Read-only."""

    kind: Kinds
    """[action] an :class:`ActionKind`."""
    target: Ids
    """[action] line or substation."""
    mask: Masks
    """[action] moved elements; 0 unless the kind is MOVE."""

    def __len__(self) -> int:
        return len(self.kind)

    def __getitem__(self, action: int) -> StepAction:
        return StepAction(int(self.kind[action]), int(self.target[action]), int(self.mask[action]))

    def take(self, ids: Ids) -> ActionCatalogue:
        """The actions ``ids`` of this catalogue, in that order."""
        return _read_only(self.kind[ids], self.target[ids], self.mask[ids])


@functools.cache
def full_catalogue(grid: Grid) -> ActionCatalogue:
    """Every topology action of ``grid``: do nothing, moves by substation, switches by line."""
    subs = [_moves(n_elements) for n_elements in grid.sub_info.tolist()]
    sizes = [len(masks) for masks in subs]
    kind = np.repeat([_NOTHING, _MOVE, _SWITCH], [1, sum(sizes), grid.n_line]).astype(np.int8)
    lines = np.arange(grid.n_line, dtype=np.int32)
    target = np.concatenate(([0], np.repeat(np.arange(grid.n_sub), sizes), lines)).astype(np.int32)
    mask = np.concatenate((np.zeros(1, np.uint32), *subs, np.zeros(grid.n_line, np.uint32)))
    return _read_only(kind, target, mask)


def level_ids(grid: Grid, level: int) -> Ids:
    """Catalogue ids of the actions of a difficulty level, int32 [action].

    Do nothing comes first, then the best-ranked actions in rank order. The highest level is the
    whole catalogue in its own order.

    Raises:
        UsageError: the grid has no such level.
    """
    if isinstance(level, bool) or not isinstance(level, int | np.integer) or not 0 <= level < len(grid.level_sizes):
        levels = ", ".join(f"{k} ({size:,} actions)" for k, size in enumerate(grid.level_sizes))
        raise UsageError(f"Level {level!r} of {grid.id} does not exist: choose one of {levels}.")
    if level == len(grid.level_sizes) - 1:
        return np.arange(len(full_catalogue(grid)), dtype=np.int32)
    return np.concatenate((np.zeros(1, np.int32), ranking(grid.id).ids[: grid.level_sizes[level] - 1]))


def level_catalogue(grid: Grid, level: int) -> ActionCatalogue:
    """The actions of a difficulty level; see :func:`level_ids`."""
    return full_catalogue(grid).take(level_ids(grid, level))


@functools.cache
def action_set_hash(grid: Grid, level: int) -> str:
    """Short hash of the actions of a level and of their order."""
    actions = level_catalogue(grid, level)
    digest = hashlib.sha256(grid.id.encode())
    digest.update(actions.kind.astype("<i1").tobytes())
    digest.update(actions.target.astype("<i4").tobytes())
    digest.update(actions.mask.astype("<u4").tobytes())
    return digest.hexdigest()[:16]


@jit
def is_legal(state: GridState, i: int, kind: int, target: int) -> bool:
    """Whether the rules let environment ``i`` play a topology action now.

    A line or substation may be acted on when its cooldown, as last observed, is over (Grid2Op's
    ``DefaultRules``; one action of a catalogue never exceeds the limits on simultaneous changes).
    Elements behind an open line may be moved: nothing happens to them, and the substation is what
    counts.
    """
    if kind in (_MOVE, _RESTORE):
        return bool(state.time_before_cooldown_sub[i, target] == 0)
    if kind in (_SWITCH, _RECONNECT):
        return bool(state.time_before_cooldown_line[i, target] == 0)
    return True


@jit
def legal_actions(state: GridState, i: int, kind: Kinds, target: Ids, out: Flags) -> None:
    """Write to ``out`` [action] which of the actions (``kind``, ``target``) are legal; see :func:`is_legal`."""
    for action in range(kind.shape[0]):
        out[action] = is_legal(state, i, kind[action], target[action])


def moved_elements(grid: Grid, sub: int, mask: int) -> Ids:
    """Entries of ``topo_vect`` that a MOVE changes, ascending int32."""
    first = int(grid.sub_first_element[sub])
    return np.array([first + k for k in range(int(grid.sub_info[sub])) if mask >> k & 1], np.int32)


def describe(grid: Grid, action: StepAction) -> str:
    """The action in words, for people."""
    kind, target = ActionKind(action.kind), action.target
    if kind == ActionKind.NOTHING:
        return "do nothing"
    if kind == ActionKind.SWITCH:
        return f"switch line {target} ({grid.name_line[target]})"
    if kind == ActionKind.RECONNECT:
        return f"reconnect line {target} ({grid.name_line[target]})"
    if kind == ActionKind.RESTORE:
        return f"substation {target}: move everything back to busbar 1"
    if kind == ActionKind.MOVE:
        elements = _in_words(grid, moved_elements(grid, target, action.mask))
        return f"substation {target}: move {elements} to the other busbar"
    assert action.values is not None
    return _injection_in_words(grid, action.values)


@dataclass(frozen=True, eq=False)
class ContinuousLayout:
    """Which entry of a continuous action does what: redispatch, then curtailment, then storage."""

    redispatch: Ids
    """Generators that may be redispatched, ascending."""
    curtail: Ids
    """Renewable generators, ascending."""
    storage: Ids
    """Storage units, ascending."""
    names: tuple[str, ...]
    """What each entry controls, in words."""

    @property
    def size(self) -> int:
        """Number of entries."""
        return len(self.redispatch) + len(self.curtail) + len(self.storage)


@functools.cache
def continuous_layout(grid: Grid) -> ContinuousLayout:
    """The entries of the continuous actions of ``grid``."""
    redispatch = np.flatnonzero(grid.gen_redispatchable).astype(np.int32)
    curtail = np.flatnonzero(grid.gen_renewable).astype(np.int32)
    storage = np.arange(grid.n_storage, dtype=np.int32)
    names = (
        *(f"redispatch {grid.name_gen[gen]}" for gen in redispatch),
        *(f"curtail {grid.name_gen[gen]}" for gen in curtail),
        *(f"storage {grid.name_storage[unit]}" for unit in storage),
    )
    return ContinuousLayout(redispatch, curtail, storage, names)


class Injection(NamedTuple):
    """A continuous action in physical units, float32."""

    redispatch: F32
    """[gen] MW added to the target dispatch."""
    curtailment_limit: F32
    """[gen] share of pmax that a renewable may produce from now on; -1 on other generators."""
    storage: F32
    """[storage] MW, positive charges."""


def decode_continuous(grid: Grid, action: ArrayLike) -> Injection:
    """What a continuous action asks for.

    An entry ``a`` in [-1, 1] means: redispatch by ``a`` times the ramp of a step; limit a renewable
    to ``1 + min(a, 0)`` of its maximum; charge (``a > 0``) or discharge a storage unit with ``|a|``
    times its maximum power. Zero is no intervention.

    Args:
        grid: the grid.
        action: [continuous], in the order of :func:`continuous_layout`.

    Raises:
        UsageError: wrong shape, NaN, or a value outside [-1, 1].
    """
    layout = continuous_layout(grid)
    values = validate_continuous(grid, action)
    moves, limits, powers = np.split(values, [len(layout.redispatch), len(layout.redispatch) + len(layout.curtail)])
    redispatch = np.zeros(grid.n_gen, np.float32)
    ramp = np.where(moves > 0, grid.gen_max_ramp_up[layout.redispatch], grid.gen_max_ramp_down[layout.redispatch])
    redispatch[layout.redispatch] = moves * ramp
    limit = np.full(grid.n_gen, -1.0, np.float32)
    limit[layout.curtail] = np.float32(1.0) + np.minimum(limits, np.float32(0.0))
    storage = powers * np.where(powers > 0, grid.storage_max_p_absorb, grid.storage_max_p_prod)
    return Injection(redispatch, limit, storage.astype(np.float32))


def validate_continuous(grid: Grid, action: ArrayLike) -> F32:
    """``action`` as float32 [continuous].

    Raises:
        UsageError: wrong shape, NaN, or a value outside [-1, 1].
    """
    size = continuous_layout(grid).size
    try:
        values = np.asarray(action, dtype=np.float32)
    except (TypeError, ValueError):
        raise UsageError(f"An action of {grid.id} must be {size} numbers in [-1, 1], got {action!r}.") from None
    if values.shape != (size,):
        raise UsageError(f"An action of {grid.id} must have shape ({size},), got {values.shape}.")
    if np.isnan(values).any():
        entry = int(np.flatnonzero(np.isnan(values))[0])
        raise UsageError(f"Entry {entry} of the action is NaN: every entry must lie in [-1, 1].")
    if (np.abs(values) > 1).any():
        entry = int(np.flatnonzero(np.abs(values) > 1)[0])
        raise UsageError(f"Entry {entry} of the action is {values[entry]}: every entry must lie in [-1, 1].")
    return values


def _moves(n_elements: int) -> Masks:
    """Masks of every move of a substation, in Grid2Op's order.

    That is the lexicographic order of the vectors of moved elements with the first element fixed:
    the number of an action, read in binary, is the vector with the last element as lowest bit.
    """
    number = np.arange(1, 1 << (n_elements - 1), dtype=np.uint32)
    mask = np.zeros_like(number)
    for k in range(1, n_elements):
        mask |= (number >> np.uint32(n_elements - 1 - k) & np.uint32(1)) << np.uint32(k)
    return mask


def _read_only(kind: Kinds, target: Ids, mask: Masks) -> ActionCatalogue:
    for array in (kind, target, mask):
        array.setflags(write=False)
    return ActionCatalogue(kind, target, mask)


def _in_words(grid: Grid, elements: Ids) -> str:
    """For example "lines 3 and 7 with load 2"."""
    lines = {
        line
        for positions in (grid.line_or_pos_topo_vect, grid.line_ex_pos_topo_vect)
        for line in np.flatnonzero(np.isin(positions, elements)).tolist()
    }
    groups = [
        _numbered("line", sorted(lines)),
        _numbered("generator", np.flatnonzero(np.isin(grid.gen_pos_topo_vect, elements)).tolist()),
        _numbered("load", np.flatnonzero(np.isin(grid.load_pos_topo_vect, elements)).tolist()),
        _numbered("storage", np.flatnonzero(np.isin(grid.storage_pos_topo_vect, elements)).tolist()),
    ]
    first, *others = [group for group in groups if group]
    return f"{first} with {_listed(others)}" if others else first


def _numbered(noun: str, ids: list[int]) -> str:
    if not ids:
        return ""
    return f"{noun}{'s' if len(ids) > 1 else ''} {_listed([str(k) for k in ids])}"


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _injection_in_words(grid: Grid, values: F32) -> str:
    injection = decode_continuous(grid, values)
    parts = [
        *(f"redispatch {grid.name_gen[gen]} by {injection.redispatch[gen]:+.1f} MW"
          for gen in np.flatnonzero(injection.redispatch)),
        *(f"limit {grid.name_gen[gen]} to {100 * injection.curtailment_limit[gen]:.0f}% of its maximum"
          for gen in np.flatnonzero((injection.curtailment_limit >= 0) & (injection.curtailment_limit < 1))),
        *(f"{'charge' if power > 0 else 'discharge'} {name} with {abs(power):.1f} MW"
          for name, power in zip(grid.name_storage, injection.storage, strict=True) if power),
    ]  # fmt: skip
    return "; ".join(parts) if parts else "do nothing"
