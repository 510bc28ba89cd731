"""The actions to be played: where an engine, its agents and the heuristics leave them for a step to read."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from rl2grid.arrays import F32, I32, I64, U64, Flags
from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.mdp.actions import ActionKind, StepAction, continuous_layout, mask_words, write_mask
from rl2grid.structures import allocate, scratch

_NOTHING, _MOVE = int(ActionKind.NOTHING), int(ActionKind.MOVE)


class Orders(NamedTuple):
    """Structure of arrays of ``n`` environments: one action each, with room for a change of everything."""

    n_changes: Annotated[I32, scratch("", "how many changes it has")]
    kind: Annotated[I32, scratch("change", "an `rl2grid.mdp.actions.ActionKind`")]
    target: Annotated[I32, scratch("change", "line or substation")]
    mask: Annotated[U64, scratch("change word", "elements that are moved")]
    touches: Annotated[Flags, scratch("change", "it touches its line or substation, which then cools down")]
    injects: Annotated[Flags, scratch("", "it has an injection")]
    injection: Annotated[F32, scratch("entry", "the injection, as continuous tasks have it")]
    verdict: Annotated[I32, scratch("", "what the rules say, `rl2grid.mdp.legality.LEGAL` or why it is not played")]
    verdict_target: Annotated[I32, scratch("", "the line or substation that cools down, else -1")]
    verdict_left: Annotated[I32, scratch("", "for which it still does", "steps")]


def new_orders(grid: Grid, n: int) -> Orders:
    """Orders to do nothing."""
    sizes = {"change": grid.n_line + grid.n_sub, "word": mask_words(grid), "entry": continuous_layout(grid).size}
    return allocate(Orders, sizes, n)


def write_order(orders: Orders, i: int, action: StepAction) -> None:
    """Note the action that row ``i`` is to play."""
    orders.n_changes[i] = len(action.changes)
    for k, (kind, target, mask) in enumerate(action.changes):
        orders.kind[i, k] = kind
        orders.target[i, k] = target
        if kind == _MOVE:
            write_mask(mask, orders.mask[i, k])
    orders.injects[i] = action.values is not None
    if action.values is not None:
        orders.injection[i] = action.values


@jit
def order_one_change(orders: Orders, i: int, kind: int, target: int) -> None:
    """Note an action of one change without a mask, of which the kind may be NOTHING."""
    orders.n_changes[i] = 1 if kind != _NOTHING else 0
    orders.kind[i, 0] = kind
    orders.target[i, 0] = target
    orders.injects[i] = False


@jit
def refer_to_choices(chosen: I64, n_choices: int, end: I64) -> bool:
    """Whether all of ``chosen``, int64 [k], are among ``n_choices`` changes; writes the one behind each to ``end``."""
    for k in range(chosen.shape[0]):
        if not 0 <= chosen[k] < n_choices:
            return False
        end[k] = chosen[k] + 1
    return True
