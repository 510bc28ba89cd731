"""Greedy search among topology actions, by worst loading or by security (``docs/algorithms/greedy.md``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.agent import Action, Considered, Info, Observation, has_topology_actions, topology_action
from rl2grid.agents.contingencies import overload_after
from rl2grid.agents.recovery import Recovery
from rl2grid.arrays import F64, Flags
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.handles import AsOpened
from rl2grid.mdp.actions import WORD_BITS, ActionCatalogue, ActionKind, Masks, full_catalogue, mask_words
from rl2grid.mdp.heuristics import SAFE_RHO, is_safe
from rl2grid.mdp.state import GridState

_NOTHING = 0
_WORTHWHILE = 1e-3
"""Least decrease of the worst loading for which an action is played."""
_NEAR = 0.03
"""Worst loadings above the least one by less are good enough to be chosen for their security."""
_CANDIDATES = 10
"""Actions whose security is looked at, and do nothing."""


class GreedyTopology:
    """While the grid is not safe, plays the action with the lowest worst loading in the next step, by its forecast.

    All actions are tried at once with the AC power flow (:meth:`PowerGridEnv.what_if`). Of those that
    make the grid safe, one that restores a line or a substation is preferred, then one that a single action can undo.
    While the grid is safe, it plays what :class:`Recovery` plays, if the forecast then stays safe.

    Args:
        actions: ids that it may play, do nothing always being one of them; None: all of the task.
    """

    name = "greedy"
    kinds = ("T", "H")

    def __init__(self, actions: Sequence[int] | None = None) -> None:
        self._recovery = Recovery()
        self._chosen = None if actions is None else [_NOTHING, *sorted(set(actions) - {_NOTHING})]

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Remember the environment, which is asked for forecasts.

        Raises:
            UsageError: the task has no topology actions.
        """
        if not has_topology_actions(env.action_space):
            raise UsageError(
                f"Agent {self.name!r} cannot play a redispatching task (-R-), which has no topology actions: "
                "choose a topology task (-T0-, -T1-, ...) or the agent 'greedy'."
            )
        base: Any = env.unwrapped
        self._env, self._space = base, env.action_space
        self._opened: AsOpened[GridState] = AsOpened()
        self._recovery.bind(env)
        ids = np.arange(len(base.action_catalogue_ids)) if self._chosen is None else np.array(self._chosen)
        self._ids = ids.tolist()
        self._catalogue = full_catalogue(base.grid).take(base.action_catalogue_ids[ids])

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The best action; the one that changes nothing where none is better. On joint tasks it never injects."""
        return topology_action(self._space, self.choose())

    def choose(self) -> int:
        """The id of the best action; 0 where none is better than doing nothing."""
        self._loading: F64 | None = None
        if is_safe(self._opened(self._env.state), 0):
            self._why = "while the grid is safe, it does what recovery does, if the forecast then stays safe"
            return self._recover()
        outcomes = self._env.what_if(self._ids)
        loading = np.where(outcomes.legal, outcomes.worst_loading, np.inf).astype(np.float64)
        self._loading = loading
        if not loading.min() < loading[_NOTHING] - _WORTHWHILE:
            self._why = "by the forecast, no action is better than doing nothing"
            return _NOTHING
        return int(self._ids[self._best(loading)])

    def explain(self) -> Considered | None:
        """By what rule the last action was chosen; what was compared is what every action promises."""
        return Considered("", (), (), self._why)

    def ranking(self, most: int) -> Considered | None:
        """The actions with the least worst loading by the forecast; None: the grid was safe."""
        if self._loading is None:
            return None
        best = np.argsort(self._loading, kind="stable")[:most]
        best = best[np.isfinite(self._loading[best])]
        return Considered("worst loading", [self._ids[k] for k in best.tolist()], self._loading[best].tolist())

    def _best(self, loading: F64) -> int:
        """The entry to play, given the worst loading after each: one of them is better than do nothing."""
        effect = effects(self._env.grid, self._env.state, self._catalogue)
        safe = loading < min(float(SAFE_RHO), float(loading[_NOTHING]) - _WORTHWHILE)
        rules = (
            (safe & effect.restores, "the best of those that make the grid safe and restore a line or a substation"),
            (safe & effect.can_be_undone, "the best of those that make the grid safe and that one action can undo"),
        )
        for preferred, self._why in rules:
            if preferred.any():
                return int(np.where(preferred, loading, np.inf).argmin())
        self._why = "the least worst loading: no action that can be undone makes the grid safe"
        return int(loading.argmin())

    def _recover(self) -> int:
        """The recovery heuristic's action, if it keeps the grid as safe as the heuristic asks."""
        action = self._recovery.choose()
        if action == _NOTHING or action not in self._ids:
            return _NOTHING
        worst = self._env.what_if([action]).worst_loading[0]
        return action if worst < SAFE_RHO else _NOTHING


class GreedyN1(GreedyTopology):
    """As :class:`GreedyTopology`, but of the best actions by worst loading it plays the most secure one.

    Security is that of the topology after the action to the loss of any one line (N-1, :func:`insecurity`).
    """

    name = "greedy-n1"

    def _best(self, loading: F64) -> int:
        ranked = np.argsort(loading, kind="stable")[:_CANDIDATES].astype(np.int32)
        acceptable = min(float(loading.min()) + _NEAR, float(loading[_NOTHING]) - _WORTHWHILE)
        candidates = ranked[loading[ranked] < acceptable]
        undoable = effects(self._env.grid, self._env.state, self._catalogue.take(candidates)).can_be_undone
        candidates = candidates[undoable] if undoable.any() else candidates
        self._why = "of the best, the one after which the loss of any one line does least"
        danger = np.array([insecurity(self._env.security(self._ids[entry])) for entry in candidates.tolist()])
        return int(candidates[np.lexsort((loading[candidates], danger))[0]])


def insecurity(outcomes: Any) -> float:
    """Sum over the outages of the overload that each leaves: of its worst line, at most 1; 1 for a collapse.

    Args:
        outcomes: what :meth:`PowerGridEnv.security` returns.
    """
    return float(overload_after(outcomes)[~outcomes.was_open].sum())


class Effect(NamedTuple):
    """What actions do to the way back to the reference topology; bool [action]."""

    restores: Flags
    """It closes a line, or brings a substation back to busbar 1."""
    can_be_undone: Flags
    """One action of the catalogue brings back what it changes."""


def effects(grid: Grid, state: GridState, catalogue: ActionCatalogue) -> Effect:
    """What each action would do to the topology of row 0.

    A move from the reference is undone by itself; a second one in the same substation may leave a division that no
    action of a low level takes back.
    """
    switches, moves = catalogue.kind == ActionKind.SWITCH, catalogue.kind == ActionKind.MOVE
    restores, can_be_undone = np.zeros(len(catalogue), np.bool_), np.ones(len(catalogue), np.bool_)
    restores[switches] = ~state.line_status[0][catalogue.target[switches]]
    on_second, connected = _masks(grid, state.topo_vect[0] == 2), _masks(grid, state.topo_vect[0] > 0)
    subs, masks = catalogue.target[moves], catalogue.mask[moves]
    after = (on_second[subs] ^ masks) & connected[subs]
    all_on_first = ~after.any(axis=1)
    restores[moves] = all_on_first & on_second[subs].any(axis=1)
    way_back = set(zip(subs.tolist(), _keys(masks), strict=True))
    keys = zip(subs.tolist(), _keys(after), strict=True)
    can_be_undone[moves] = all_on_first | np.fromiter((key in way_back for key in keys), np.bool_, len(subs))
    return Effect(restores, can_be_undone)


def _keys(masks: Masks) -> list[bytes]:
    """Every mask, uint64 [action, word], as something to look up."""
    packed, size = masks.tobytes(), masks.shape[1] * masks.itemsize
    return [packed[begin : begin + size] for begin in range(0, len(packed), size)]


def _masks(grid: Grid, flags: NDArray[np.bool_]) -> Masks:
    """The flagged elements of each substation as the mask of a move, uint64 [sub, word]."""
    place = np.arange(grid.dim_topo) - grid.sub_first_element[grid.element_to_subid]
    word, bit = np.divmod(place[flags], WORD_BITS)
    masks = np.zeros((grid.n_sub, mask_words(grid)), np.uint64)
    np.bitwise_or.at(masks, (grid.element_to_subid[flags], word), np.uint64(1) << bit.astype(np.uint64))
    return masks
