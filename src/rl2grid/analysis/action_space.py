"""Action spaces: what the actions of a level are, what each does, and what came of trying them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rl2grid.errors import UsageError
from rl2grid.grids import STEPS_PER_HOUR, Grid, find_system
from rl2grid.grids.ranking import Trials
from rl2grid.grids.rankings import ranking, trials
from rl2grid.mdp.actions import (
    WORD_BITS,
    ActionKind,
    Change,
    Ids,
    StepAction,
    describe,
    full_catalogue,
    level_catalogue,
    level_ids,
    moved_elements,
)
from rl2grid.records.shares import wilson_interval

MINUTES_PER_STEP = 60 // STEPS_PER_HOUR


@dataclass(frozen=True)
class ActionRow:
    """One action of a level, as listed."""

    action: int
    """Id in the level: what an agent plays."""
    catalogue: int
    """Id in the grid's full catalogue."""
    rank: int | None
    """Place in the ranking, 1 is best; None: not ranked (do nothing, or beyond the ranking's end)."""
    trials: int
    survival: float
    """Share of the trials without a collapse; NaN without trials."""
    survival_low: float
    survival_high: float
    """95% interval after Wilson."""
    margin: float
    """Mean over the surviving trials of 1 - the worst loading; NaN where none survived."""
    words: str


def select_actions(grid: Grid, level: int, *, substation: int | None = None, line: int | None = None) -> Ids:
    """Ids in the level of the actions that meet every condition, ascending int32.

    Args:
        grid: the grid.
        level: difficulty level.
        substation: only moves at this substation.
        line: only the switch of this line and moves of one of its ends.

    Raises:
        UsageError: there is no such level, substation or line.
    """
    catalogue = level_catalogue(grid, level)
    moves = catalogue.kind == ActionKind.MOVE
    chosen = np.ones(len(catalogue), np.bool_)
    if substation is not None:
        _check_number("Substation", substation, grid.n_sub, grid)
        chosen &= moves & (catalogue.target == substation)
    if line is not None:
        _check_number("Line", line, grid.n_line, grid)
        concerned = (catalogue.kind == ActionKind.SWITCH) & (catalogue.target == line)
        for element in (int(grid.line_or_pos_topo_vect[line]), int(grid.line_ex_pos_topo_vect[line])):
            sub = int(grid.element_to_subid[element])
            word, bit = divmod(element - int(grid.sub_first_element[sub]), WORD_BITS)
            moved = catalogue.mask[:, word] >> np.uint64(bit) & np.uint64(1) == 1
            concerned |= moves & (catalogue.target == sub) & moved
        chosen &= concerned
    return np.flatnonzero(chosen).astype(np.int32)


def list_actions(grid: Grid, level: int, actions: Sequence[int] | Ids) -> list[ActionRow]:
    """What there is to say about some actions of a level, in the order given.

    Raises:
        UsageError: there is no such level or action, or the ranking tells nothing of trials.
    """
    ids = level_ids(grid, level)
    catalogue, tried = full_catalogue(grid), _trials(grid)
    rank = _ranks(grid)
    for action in actions:
        if not 0 <= action < len(ids):
            raise UsageError(
                f"Action {action} of level {level} of {grid.id} does not exist: choose from 0 to {len(ids) - 1}."
            )
    chosen = ids[np.asarray(actions, np.int64)]
    low, high = wilson_interval(tried.survived[chosen], tried.trials[chosen])
    survival = tried.survival
    return [
        ActionRow(
            action=int(action),
            catalogue=k,
            rank=int(rank[k]) or None,
            trials=int(tried.trials[k]),
            survival=float(survival[k]),
            survival_low=float(low[row]),
            survival_high=float(high[row]),
            margin=float(tried.margin[k]) if tried.survived[k] else float("nan"),
            words=describe(grid, catalogue[k]),
        )
        for row, (action, k) in enumerate(zip(actions, chosen.tolist(), strict=True))
    ]


@dataclass(frozen=True)
class ElementChange:
    """An element of the acted substation, or the acted line; busbar 1 or 2, None when out of service."""

    name: str
    before: int | None
    after: int | None


@dataclass(frozen=True)
class Explanation:
    """What an action does to a grid in its reference topology: all in service, everything on busbar 1."""

    changes: tuple[ElementChange, ...]
    """Every element of the substation, moved or not; both ends of the line."""
    cut_off: tuple[str, ...]
    """Elements that are then without connection to the generator that balances the grid."""
    consequence: str
    """Whether the grid stays in one piece, in words."""
    cooldown: str
    reversal: str


def explain_action(grid: Grid, action: StepAction) -> Explanation:
    """What a topology action of the catalogue does in the reference topology."""
    before = _reference(grid)
    after = topology_after(grid, action)
    names = element_names(grid)
    changes = tuple(
        ElementChange(names[k], _busbar(before[k]), _busbar(after[k])) for k in _concerned(grid, action).tolist()
    )
    cut_off = tuple(names[k] for k in cut_off_elements(grid, after).tolist())
    return Explanation(
        changes,
        cut_off,
        _consequence_in_words(cut_off),
        _cooldown_in_words(grid, action),
        _reversal_in_words(grid, action),
    )


def topology_after(grid: Grid, action: StepAction) -> NDArray[np.int32]:
    """``topo_vect`` after an action of the catalogue in the reference topology, int32 [topo]."""
    topology = _reference(grid)
    # Lines last: an end that is moved and opened is open.
    for change in sorted(action.changes, key=lambda each: each.kind == ActionKind.SWITCH):
        topology[_changed_elements(grid, change)] = -1 if change.kind == ActionKind.SWITCH else 2
    return topology


def changed_elements(grid: Grid, action: StepAction) -> Ids:
    """Entries of ``topo_vect`` that an action changes in the reference topology, by change."""
    return _joined([_changed_elements(grid, change) for change in action.changes])


def _changed_elements(grid: Grid, change: Change) -> Ids:
    if change.kind == ActionKind.MOVE:
        return moved_elements(grid, change.target, change.mask)
    if change.kind == ActionKind.SWITCH:
        ends = (grid.line_or_pos_topo_vect[change.target], grid.line_ex_pos_topo_vect[change.target])
        return np.array(ends, np.int32)
    return np.zeros(0, np.int32)


def _joined(parts: list[Ids]) -> Ids:
    """The different entries of all parts, in the order of the parts."""
    entries = dict.fromkeys(int(entry) for part in parts for entry in part)
    return np.array(list(entries), np.int32)


def cut_off_elements(grid: Grid, topo_vect: NDArray[np.int32]) -> Ids:
    """Connected elements without a path of closed lines to the generator that balances the grid, ascending."""
    busbar = np.where(topo_vect > 0, grid.element_to_subid + grid.n_sub * (topo_vect - 1), -1)
    origin, extremity = busbar[grid.line_or_pos_topo_vect], busbar[grid.line_ex_pos_topo_vect]
    closed = (origin >= 0) & (extremity >= 0)
    origin, extremity = origin[closed], extremity[closed]
    reached = np.zeros(2 * grid.n_sub, np.bool_)
    reached[busbar[grid.gen_pos_topo_vect[grid.slack_gen]]] = True
    n_reached = 0
    while n_reached < (n_reached := int(reached.sum())):
        reached[extremity[reached[origin]]] = True
        reached[origin[reached[extremity]]] = True
    return np.flatnonzero((busbar >= 0) & ~reached[busbar]).astype(np.int32)


def element_names(grid: Grid) -> list[str]:
    """Each entry of ``topo_vect`` in words, as "line 7 to substation 4" or "load 2"."""
    names = [""] * grid.dim_topo
    ends = (
        (grid.line_or_pos_topo_vect, grid.line_ex_to_subid),
        (grid.line_ex_pos_topo_vect, grid.line_or_to_subid),
    )
    for positions, others in ends:
        for line, (position, other) in enumerate(zip(positions.tolist(), others.tolist(), strict=True)):
            names[position] = f"line {line} to substation {other}"
    for noun, positions in (
        ("generator", grid.gen_pos_topo_vect),
        ("load", grid.load_pos_topo_vect),
        ("storage", grid.storage_pos_topo_vect),
    ):
        for number, position in enumerate(positions.tolist()):
            names[position] = f"{noun} {number}"
    return names


@dataclass(frozen=True)
class SubstationShare:
    """How many of a substation's moves each level holds."""

    substation: int
    elements: int
    moves: int
    """In the full catalogue."""
    held: tuple[int, ...]
    """[level]"""


def substation_shares(grid: Grid) -> list[SubstationShare]:
    """Every substation with at least one move, the one with most moves first."""
    held = np.stack([_moves_by_substation(grid, level_ids(grid, level)) for level in range(len(grid.level_sizes))])
    order = np.argsort(-held[-1], kind="stable")
    return [
        SubstationShare(int(sub), int(grid.sub_info[sub]), int(held[-1, sub]), tuple(held[:, sub].tolist()))
        for sub in order
        if held[-1, sub]
    ]


def switches_held(grid: Grid, level: int) -> int:
    """Number of line switches among the actions of a level."""
    return int(np.count_nonzero(level_catalogue(grid, level).kind == ActionKind.SWITCH))


def _check_number(what: str, number: int, size: int, grid: Grid) -> None:
    if not 0 <= number < size:
        raise UsageError(f"{what} {number} of {grid.id} does not exist: choose from 0 to {size - 1}.")


def _ranks(grid: Grid) -> Ids:
    """[catalogue] place in the ranking from 1 on, 0 without one."""
    rank = np.zeros(len(full_catalogue(grid)), np.int32)
    if find_system(grid.id).ranking is None:
        return rank
    ids = ranking(grid.id).ids
    rank[ids] = np.arange(1, len(ids) + 1)
    return rank


def _trials(grid: Grid) -> Trials:
    """What came of trying the actions; that none was tried where the grid has no ranking."""
    if find_system(grid.id).ranking is not None:
        return trials(grid.id)
    n_actions = len(full_catalogue(grid))
    none = np.zeros(n_actions, np.uint32)
    return Trials(none, none, np.zeros(n_actions, np.float32))


def _moves_by_substation(grid: Grid, ids: Ids) -> NDArray[np.int64]:
    catalogue = full_catalogue(grid)
    moves = ids[catalogue.kind[ids] == ActionKind.MOVE]
    return np.bincount(catalogue.target[moves], minlength=grid.n_sub)


def _concerned(grid: Grid, action: StepAction) -> Ids:
    """Entries of ``topo_vect`` that an explanation lists."""
    return _joined([_concerned_by(grid, change) for change in action.changes])


def _concerned_by(grid: Grid, change: Change) -> Ids:
    if change.kind != ActionKind.MOVE:
        return _changed_elements(grid, change)
    first = int(grid.sub_first_element[change.target])
    return np.arange(first, first + int(grid.sub_info[change.target]), dtype=np.int32)


def _reference(grid: Grid) -> NDArray[np.int32]:
    """``topo_vect`` with everything in service and on busbar 1."""
    return np.ones(grid.dim_topo, np.int32)


def _busbar(entry: int) -> int | None:
    return int(entry) if entry > 0 else None


def _consequence_in_words(cut_off: Sequence[str]) -> str:
    if not cut_off:
        return "The grid stays in one piece."
    # Grid2Op forgives a storage unit that is cut off while it neither charges nor discharges.
    unless = " unless the storage is idle" if all(name.startswith("storage") for name in cut_off) else ""
    return f"Cut off: {', '.join(cut_off)}. This ends the episode{unless}."


def _cooldown_in_words(grid: Grid, action: StepAction) -> str:
    if not action.changes:
        return "None: doing nothing is always allowed."
    return " ".join(_cooldown_of_change(grid, change) for change in action.changes)


def _cooldown_of_change(grid: Grid, change: Change) -> str:
    of_line = change.kind == ActionKind.SWITCH
    what = f"{'line' if of_line else 'substation'} {change.target}"
    steps = grid.rules.cooldown_line if of_line else grid.rules.cooldown_sub
    if steps == 0:
        return f"None: {what} may be changed again in the next step."
    noun = f"{steps} step{'s' if steps > 1 else ''} ({steps * MINUTES_PER_STEP} minutes)"
    return f"{what.capitalize()} may not be changed for {noun} afterwards."


def _reversal_in_words(grid: Grid, action: StepAction) -> str:
    if not action.changes:
        return "There is nothing to take back."
    return " ".join(_reversal_of_change(grid, change) for change in action.changes)


def _reversal_of_change(grid: Grid, change: Change) -> str:
    wait = grid.rules.cooldown_line if change.kind == ActionKind.SWITCH else grid.rules.cooldown_sub
    when = "once the cooldown is over" if wait else "in any later step"
    if change.kind == ActionKind.SWITCH:
        return f"The same action closes the line again, {when}."
    return f"The same action moves the elements back, {when}; elements out of service do not move."
