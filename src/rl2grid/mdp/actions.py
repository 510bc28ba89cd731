"""Actions: what an engine plays in a step, the catalogue of topology actions, its levels, and continuous actions.

An action is any number of *changes* of lines and substations and at most one *injection*
(:class:`StepAction`); which of them the rules allow is told by :mod:`rl2grid.mdp.legality`. Tasks offer
actions of one change, injections, or one change and an injection together.

The full catalogue of a grid holds do nothing, then every move of a set of one substation's elements
to the other busbar, then the switch of every line: sum over substations of ``2^(n - 1) - 1`` plus
``n_line + 1`` actions (paper, Section 3.1). Its order is that of Grid2Op's ``DiscreteActSpace`` with
``change_bus`` and ``change_line_status``. Moving a set and moving all other elements of the
substation are electrically the same; of the two, the catalogue keeps the one that leaves the first
element where it is, as Grid2Op does. Grids with larger substations have a :func:`limited_catalogue`.

The elements that a move concerns are a mask. In a value it is a Python integer of any size; in arrays it is
a row of 64-bit words, the lowest bits first, of which the grids of the project need one.
"""

from __future__ import annotations

import enum
import functools
import hashlib
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rl2grid.arrays import F32, I64, Flags
from rl2grid.compile import jit
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.grids.rankings import ranking
from rl2grid.mdp.state import GridState

Kinds = NDArray[np.int8]
Ids = NDArray[np.int32]
Masks = NDArray[np.uint64]


TOPOLOGY, INJECTION = "topology", "injection"
"""Names of the parts of a joint task's action, in this order."""
LARGEST_CATALOGUE = 1 << 22
"""Actions that :func:`full_catalogue` enumerates at most: a substation of 22 elements has half of them."""
WORD_BITS = 64
_WORD = (1 << WORD_BITS) - 1
_SHORT_HASH_ELEMENTS = 32


class ActionKind(enum.IntEnum):
    """What a change does; ``target`` is a line or a substation."""

    NOTHING = 0
    """In catalogues and batches only: an action that does nothing has no changes."""
    MOVE = 1
    """Move the masked elements of a substation to the other busbar (``change_bus``)."""
    SWITCH = 2
    """Open a closed line, close an open one (``change_line_status``)."""
    RECONNECT = 3
    """Close a line, both ends to the busbars they were on last (``set_line_status`` +1)."""
    RESTORE = 4
    """Move every connected element of a substation that is on busbar 2 back to busbar 1."""


_NOTHING, _MOVE, _SWITCH, _RECONNECT, _RESTORE = (int(kind) for kind in ActionKind)


class Change(NamedTuple):
    """What an action does to one line or one substation."""

    kind: int
    """An :class:`ActionKind` other than NOTHING."""
    target: int
    """Line (SWITCH, RECONNECT) or substation (MOVE, RESTORE)."""
    mask: int = 0
    """MOVE: bit k is the k-th element of the substation, entry ``sub_first_element + k`` of ``topo_vect``."""

    @property
    def is_of_line(self) -> bool:
        """Whether ``target`` is a line."""
        return self.kind in (_SWITCH, _RECONNECT)


class _Parts(NamedTuple):
    changes: tuple[Change, ...]
    values: F32 | None


class StepAction(_Parts):
    """What an engine plays in one step: changes of lines and substations, and an injection.

    All of it is played, or, where it is illegal or ambiguous, nothing; see :mod:`rl2grid.mdp.legality`. The
    order of the changes has no meaning: lines are switched first, then elements moved, then substations
    restored, as Grid2Op merges an action.

    ``changes`` are at most one of each line and each substation. ``values`` are redispatch, curtailment and storage,
    float32 [continuous], see :func:`decode_continuous`; None: no injection.

    Raises:
        UsageError: two changes of one line or substation, or a change that changes nothing.
    """

    __slots__ = ()

    def __new__(cls, changes: tuple[Change, ...] = (), values: F32 | None = None) -> StepAction:
        """Check that the changes do not speak of the same thing twice."""
        for change in changes:
            if not _MOVE <= change.kind <= _RESTORE:
                raise UsageError(f"{change.kind!r} is no kind of change: give MOVE, SWITCH, RECONNECT or RESTORE.")
        if len(changes) > 1:
            _refuse_repeated_targets(changes)
        return super().__new__(cls, changes, values)


DO_NOTHING = StepAction()


def move(sub: int, mask: int) -> StepAction:
    """Move the masked elements of a substation to the other busbar."""
    return StepAction((Change(_MOVE, sub, mask),))


def switch(line: int) -> StepAction:
    """Open a closed line, close an open one."""
    return StepAction((Change(_SWITCH, line),))


def reconnect(line: int) -> StepAction:
    """Close a line, both ends to the busbars they were on last."""
    return StepAction((Change(_RECONNECT, line),))


def restore(sub: int) -> StepAction:
    """Move every connected element of a substation that is on busbar 2 back to busbar 1."""
    return StepAction((Change(_RESTORE, sub),))


def inject(values: F32) -> StepAction:
    """Redispatch, curtail and use storage: ``values`` is the action of the continuous tasks, float32 [continuous]."""
    return StepAction((), values)


def one_change(kind: int, target: int, mask: int = 0) -> StepAction:
    """The action of one change, of which the kind may be NOTHING: what heuristics and catalogues name."""
    return DO_NOTHING if kind == _NOTHING else StepAction((Change(kind, target, mask),))


def joint(*actions: StepAction) -> StepAction:
    """Several actions as one.

    Raises:
        UsageError: two of them change one line or substation, or two inject.
    """
    injections = [action.values for action in actions if action.values is not None]
    if len(injections) > 1:
        raise UsageError(f"{len(injections)} of the actions inject: an action has one injection at most.")
    changes = tuple(change for action in actions for change in action.changes)
    return StepAction(changes, injections[0] if injections else None)


def check_changes(grid: Grid, changes: Sequence[Change]) -> None:
    """Refuse changes of what the grid does not have; engines do before they play an action.

    Raises:
        UsageError: a line, substation or element that does not exist.
    """
    for change in changes:
        kind, target, mask = change
        if kind in (_SWITCH, _RECONNECT):
            if not 0 <= target < grid.n_line:
                raise UsageError(f"Line {target} of {grid.id} does not exist: choose from 0 to {grid.n_line - 1}.")
            continue
        sizes = _substation_sizes(grid)
        if not 0 <= target < len(sizes):
            raise UsageError(f"Substation {target} of {grid.id} does not exist: choose from 0 to {len(sizes) - 1}.")
        if mask and not 0 < mask < 1 << sizes[target]:
            raise UsageError(
                f"Mask {mask:#x} names elements that substation {target} of {grid.id} does not have: "
                f"of its {sizes[target]} elements, bit k is the k-th."
            )


def _refuse_repeated_targets(changes: tuple[Change, ...]) -> None:
    targets = [(change.kind in (_SWITCH, _RECONNECT), change.target) for change in changes]
    if len(set(targets)) == len(targets):
        return
    is_line, target = next(each for k, each in enumerate(targets) if each in targets[:k])
    what = "line" if is_line else "substation"
    raise UsageError(f"Two changes of one action are of {what} {target}: give one change of each line and substation.")


@functools.cache
def _substation_sizes(grid: Grid) -> tuple[int, ...]:
    return tuple(grid.sub_info.tolist())


def mask_words(grid: Grid) -> int:
    """64-bit words of a mask of the largest substation of ``grid``."""
    return -(-int(grid.sub_info.max()) // WORD_BITS)


def write_mask(mask: int, out: Masks) -> None:
    """Write a mask as 64-bit words, the lowest bits first, to ``out`` [word]."""
    for word in range(len(out)):
        out[word] = mask >> WORD_BITS * word & _WORD


def mask_integer(words: Masks) -> int:
    """The mask of which the words are given, uint64 [word]."""
    return sum(int(word) << WORD_BITS * k for k, word in enumerate(words))


@dataclass(frozen=True, eq=False)
class ActionCatalogue:
    """A list of topology actions of one change as arrays; the position in it is the action's id. Read-only."""

    kind: Kinds
    """[action] an :class:`ActionKind`."""
    target: Ids
    """[action] line or substation."""
    mask: Masks
    """[action, word] moved elements; 0 unless the kind is MOVE."""

    @functools.cached_property
    def runs(self) -> I64:
        """int64 [run + 1], where actions of one kind and target that follow each other begin, and where the last end.

        They are legal together; in a full catalogue all moves of a substation are a run.
        """
        changes = (np.diff(self.kind) != 0) | (np.diff(self.target) != 0)
        return np.concatenate(([0], 1 + np.flatnonzero(changes), [len(self)]))

    def __len__(self) -> int:
        return len(self.kind)

    def __getitem__(self, action: int) -> StepAction:
        return one_change(int(self.kind[action]), int(self.target[action]), mask_integer(self.mask[action]))

    def take(self, ids: Ids) -> ActionCatalogue:
        """The actions ``ids`` of this catalogue, in that order."""
        return _read_only(self.kind[ids], self.target[ids], self.mask[ids])

    def masks(self) -> list[int]:
        """The mask of every action as an integer."""
        if self.mask.shape[1] == 1:
            return [int(words) for words in self.mask[:, 0].tolist()]
        return [mask_integer(words) for words in self.mask]

    def find(self, kind: int, target: int, mask: int = 0) -> int:
        """Id of an action, -1 if the catalogue lacks it."""
        words = np.zeros(self.mask.shape[1], np.uint64)
        write_mask(mask, words)
        found = (self.kind == kind) & (self.target == target) & (self.mask == words).all(axis=1)
        return int(found.argmax()) if found.any() else -1


@functools.cache
def full_catalogue(grid: Grid) -> ActionCatalogue:
    """Every topology action of ``grid``: do nothing, moves by substation, switches by line.

    Raises:
        UsageError: they are more than :data:`LARGEST_CATALOGUE`.
    """
    size = full_size(grid.sub_info.tolist(), grid.n_line)
    if size > LARGEST_CATALOGUE:
        largest = int(grid.sub_info.argmax())
        raise UsageError(
            f"{grid.id} has more topology actions than the {LARGEST_CATALOGUE:,} that are enumerated (substation "
            f"{largest} has {int(grid.sub_info[largest])} elements): take a limited_catalogue of it."
        )
    subs = [_moves(n_elements) for n_elements in grid.sub_info.tolist()]
    return _catalogue(grid, np.repeat(np.arange(grid.n_sub), [len(masks) for masks in subs]), np.concatenate(subs))


def full_size(sub_info: Iterable[int], n_line: int) -> int:
    """Number of topology actions of a grid whose substations have ``sub_info`` elements."""
    return 1 + sum((1 << n_elements - 1) - 1 for n_elements in sub_info) + n_line


def limited_catalogue(grid: Grid, max_elements: int = 2, most: int = 10_000) -> ActionCatalogue:
    """Topology actions of any ``grid``: do nothing, then the smallest moves, then the switch of every line.

    Moving a set of elements and moving all others of the substation are the same; the size of a move is the number
    of elements of the smaller of the two. Moves of one element come first, then those of two, and so on, within a
    size by substation and then in lexicographic order of the smaller set; each is written as the set
    without the substation's first element. With ``max_elements`` and ``most`` large enough these are the actions of
    :func:`full_catalogue`, in another order.

    Args:
        grid: the grid.
        max_elements: size of the largest moves.
        most: actions at most; the moves that come last are left out.

    Raises:
        UsageError: ``max_elements`` below 1, or ``most`` has no room for do nothing and the switches.
    """
    if max_elements < 1:
        raise UsageError(f"max_elements={max_elements} is not allowed: give at least 1.")
    room = most - 1 - grid.n_line
    if room < 0:
        raise UsageError(f"most={most} is not allowed: {grid.id} has {1 + grid.n_line} actions without moves.")
    moves = list(itertools.islice(_small_moves(grid, max_elements), room))
    masks = np.zeros((len(moves), mask_words(grid)), np.uint64)
    for row, (_, mask) in enumerate(moves):
        write_mask(mask, masks[row])
    return _catalogue(grid, np.array([sub for sub, _ in moves], np.int64), masks)


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
    """Short hash of the actions of a level and of their order.

    Masks count with 32 bits where no substation of the grid has more elements, else with all their words.
    """
    actions = level_catalogue(grid, level)
    digest = hashlib.sha256(grid.id.encode())
    digest.update(actions.kind.astype("<i1").tobytes())
    digest.update(actions.target.astype("<i4").tobytes())
    short = grid.sub_info.max() <= _SHORT_HASH_ELEMENTS
    digest.update((actions.mask[:, 0].astype("<u4") if short else actions.mask.astype("<u8")).tobytes())
    return digest.hexdigest()[:16]


@jit
def is_legal(state: GridState, i: int, kind: int, target: int) -> bool:
    """Whether the rules let environment ``i`` play an action of one change now.

    A line or substation may be acted on when its cooldown, as last observed, is over (Grid2Op's
    ``DefaultRules``). One change never exceeds the limits on simultaneous changes; for several see
    :func:`rl2grid.mdp.legality.judge`. Elements behind an open line may be moved: nothing happens to them, and the
    substation is what counts.
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
    parts = [_change_in_words(grid, change) for change in action.changes]
    if action.values is not None:
        parts += _injection_in_words(grid, action.values)
    return "; ".join(parts) if parts else "do nothing"


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
    """Masks of every move of a substation, uint64 [move, 1], in Grid2Op's order.

    That is the lexicographic order of the vectors of moved elements with the first element fixed:
    the number of an action, read in binary, is the vector with the last element as lowest bit.
    """
    number = np.arange(1, 1 << (n_elements - 1), dtype=np.uint64)
    mask = np.zeros_like(number)
    for k in range(1, n_elements):
        mask |= (number >> np.uint64(n_elements - 1 - k) & np.uint64(1)) << np.uint64(k)
    return mask[:, np.newaxis]


def _small_moves(grid: Grid, max_elements: int) -> Iterator[tuple[int, int]]:
    """Substation and mask of every move of at most that many elements, in the order of a limited catalogue."""
    sizes = grid.sub_info.tolist()
    for size in range(1, min(max_elements, max(sizes) // 2) + 1):
        for sub, n_elements in enumerate(sizes):
            if 2 * size > n_elements:
                continue
            everything = (1 << n_elements) - 1
            for elements in itertools.combinations(range(n_elements), size):
                mask = sum(1 << k for k in elements)
                if not mask & 1:
                    yield sub, mask
                elif 2 * size < n_elements:  # else the other half comes as a set of its own
                    yield sub, everything ^ mask


def _catalogue(grid: Grid, subs: NDArray[np.int64], masks: Masks) -> ActionCatalogue:
    """Do nothing, the moves ``masks`` [move, word] of ``subs`` [move], and the switch of every line."""
    kind = np.repeat([_NOTHING, _MOVE, _SWITCH], [1, len(subs), grid.n_line]).astype(np.int8)
    target = np.concatenate(([0], subs, np.arange(grid.n_line))).astype(np.int32)
    mask = np.zeros((len(kind), masks.shape[1]), np.uint64)
    mask[1 : 1 + len(subs)] = masks
    return _read_only(kind, target, mask)


def _read_only(kind: Kinds, target: Ids, mask: Masks) -> ActionCatalogue:
    for array in (kind, target, mask):
        array.setflags(write=False)
    return ActionCatalogue(kind, target, mask)


def _change_in_words(grid: Grid, change: Change) -> str:
    kind, target, mask = change
    if kind == _SWITCH:
        return f"switch line {target} ({grid.name_line[target]})"
    if kind == _RECONNECT:
        return f"reconnect line {target} ({grid.name_line[target]})"
    if kind == _RESTORE:
        return f"substation {target}: move everything back to busbar 1"
    elements = _in_words(grid, moved_elements(grid, target, mask))
    return f"substation {target}: move {elements} to the other busbar"


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
    first, *others = [group for group in groups if group] or ["nothing"]
    return f"{first} with {_listed(others)}" if others else first


def _numbered(noun: str, ids: list[int]) -> str:
    if not ids:
        return ""
    return f"{noun}{'s' if len(ids) > 1 else ''} {_listed([str(k) for k in ids])}"


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _injection_in_words(grid: Grid, values: F32) -> list[str]:
    injection = decode_continuous(grid, values)
    return [
        *(f"redispatch {grid.name_gen[gen]} by {injection.redispatch[gen]:+.1f} MW"
          for gen in np.flatnonzero(injection.redispatch)),
        *(f"limit {grid.name_gen[gen]} to {100 * injection.curtailment_limit[gen]:.0f}% of its maximum"
          for gen in np.flatnonzero((injection.curtailment_limit >= 0) & (injection.curtailment_limit < 1))),
        *(f"{'charge' if power > 0 else 'discharge'} {name} with {abs(power):.1f} MW"
          for name, power in zip(grid.name_storage, injection.storage, strict=True) if power),
    ]  # fmt: skip
