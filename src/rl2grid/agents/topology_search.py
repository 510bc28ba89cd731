"""Search over sequences of topology actions on the forecasts (``docs/algorithms/planner.md``)."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from rl2grid.agents.contingencies import Contingencies, danger, without_lines
from rl2grid.agents.trend import Later
from rl2grid.arrays import F32, F64, I32, Flags
from rl2grid.engines.native.what_if import ActionOutcomes, WhatIf
from rl2grid.envs.outages_after_action import point_after
from rl2grid.grids import Grid
from rl2grid.mdp.actions import ActionCatalogue, ActionKind, StepAction
from rl2grid.powerflow.batch import Snapshot

NOTHING = 0
SAFE = 0.95
"""Worst loading below which a sequence has reached what it was for."""
_BEAM = (40, 30)
"""Sequences that are gone on from after one step, and after more."""
_WIDE = 320
"""Actions of which every one is tried in later steps; of a larger catalogue the most promising ones of the first."""
_LONGEST = 3
"""Steps until the first trip that are looked at, and one more after it."""
_CANDIDATES = 12
"""Sequences that make the grid safe, of which the one is chosen that outages endanger least."""
_OVERLOADS = 0.3
"""What the sum of all overloads counts beside the worst loading."""
_LARGEST_OVERLOAD = 2.0
_TRIP = 3.0
"""What it counts that protections would trip a line now."""
_TRIPPED = 2.0
"""What a line counts that they have tripped."""
_CASCADE_ROUNDS = 12
_DANGER = 2.0
"""What the danger of outages counts beside the worst loading, between sequences that make the grid safe."""
_LONGEST_PREPARATION, _PREPARATION_BEAM = 5, 20
"""Actions that may prepare for a moment to come, and sequences of them that are gone on from."""
_ACTION_PRICE = 0.01
"""What every action of a preparation counts beside the worst loading, and what the first must gain more."""
_LARGEST_LOADING = 3.0
"""Up to which the worst loading of a moment to come is told apart."""


class Found(NamedTuple):
    """Where the best sequence begins, and where it leads."""

    action: int
    """Entry of the catalogue that it begins with."""
    worst_loading: float
    """After its last step; infinite where the grid is lost on every way."""
    n_actions: int
    """Its steps."""
    n_trips: int
    """Lines that protections trip on the way."""


class _Way(NamedTuple):
    """A sequence of actions, and where it leads."""

    first: int  # entry of the catalogue, -1: no action yet
    point: Snapshot  # after the last action, with what protections have tripped
    overflow: I32  # [line] steps above the limit
    n_trips: int
    worst: float
    score: float


class _Step(NamedTuple):
    """One more action at the end of a way."""

    score: float
    worst: float
    trips: bool  # protections would trip a line in the next step
    way: _Way
    action: int
    overflow: I32
    rho: F32

    @property
    def first(self) -> int:
        """Entry of the catalogue that the sequence begins with."""
        return self.way.first if self.way.first >= 0 else self.action


class _Preparation(NamedTuple):
    """A sequence of actions in a safe grid, and where it leads."""

    actions: tuple[int, ...]
    point: Snapshot  # after the last action
    score: float  # of the moment to come
    worst: float  # loading then


_LOST = Found(NOTHING, np.inf, 0, 0)


class TopologySearch:
    """Looks for sequences that lead to a safe grid before protections trip a line, and for the least damage if none do.

    Args:
        grid: the grid.
        catalogue: what may be played; entry 0 does nothing.
        what_if: what solves the flows.
        longest: steps until the first trip that are looked at; 0: one action alone.
        seconds: after which no more sequences are tried; None: as long as it takes, which is bounded. Results depend
            on the machine with it.
    """

    def __init__(
        self,
        grid: Grid,
        catalogue: ActionCatalogue,
        what_if: WhatIf,
        longest: int = _LONGEST,
        seconds: float | None = None,
    ) -> None:
        self._grid, self._catalogue, self._what_if = grid, catalogue, what_if
        self._longest, self._seconds = longest, seconds
        self._actions: dict[int, StepAction] = {}
        self.singles: list[tuple[int, float]] = []
        """Of the last search: entries of the catalogue that are best as the only action, and their penalty, which is
        the worst loading and more where several lines are overloaded or one would trip; the best first."""

    def best(self, point: Snapshot, overflow: I32, contingencies: Contingencies, later: Later | None = None) -> Found:
        """The first action of the best sequence.

        Args:
            point: forecast for the next step before anybody acts; its injections go on.
            overflow: steps that every line has been above its limit, int32 [line].
            contingencies: outages to be ready for, once the grid is safe.
            later: a moment to come that should be safe as well; None: nothing is known of one.
        """
        until = np.inf if self._seconds is None else time.perf_counter() + self._seconds
        ways = [_Way(-1, point, overflow.astype(np.int32), 0, np.inf, 0.0)]
        entries: I32 | None = None
        best, self.singles = _LOST, []
        for depth in range(self._depth(overflow)):
            steps = self._steps(ways, entries, _BEAM[min(depth, len(_BEAM) - 1)], until)
            if depth == 0:
                self.singles = [(step.action, step.score) for step in steps]
            if not steps:
                break
            safe = [step for step in steps if not step.trips and step.way.n_trips == 0 and step.worst < SAFE]
            if safe:
                return self._safest(safe, depth + 1, contingencies, later)
            if entries is None and len(self._catalogue) > _WIDE:
                entries = np.array(sorted({NOTHING, *(step.action for step in steps[:_WIDE])}), np.int32)
            ways = self._ways(steps, _BEAM[min(depth, len(_BEAM) - 1)])
            if not ways:
                break
            best = Found(ways[0].first, ways[0].worst, depth + 1, ways[0].n_trips)
            if time.perf_counter() > until:
                break
        return best

    def prepared(self, point: Snapshot, later: Later) -> Found:
        """The first action of the best sequence that makes a moment to come safe, and keeps the grid safe until then.

        Doing nothing is found where that moment is safe, or no sequence makes it so much better that it is worth its
        actions.

        Args:
            point: forecast for the next step before anybody acts.
            later: what is expected then.
        """
        until = np.inf if self._seconds is None else time.perf_counter() + self._seconds
        worst = self.worst_later(point, later)
        best, price = Found(NOTHING, worst, 0, 0), worst - _ACTION_PRICE
        ways, entries = [_Preparation((), point, worst, worst)], None
        for depth in range(1, min(later.steps, _LONGEST_PREPARATION) + 1):
            if best.worst_loading < SAFE or time.perf_counter() > until:
                break
            steps = [step for way in ways for step in self._preparations(way, later, entries)]
            if not steps:
                break
            least = min(steps, key=lambda step: step.worst)
            if least.worst + depth * _ACTION_PRICE < price:
                price = least.worst + depth * _ACTION_PRICE
                best = Found(least.actions[0], least.worst, depth, 0)
            if entries is None and len(self._catalogue) > _WIDE:
                entries = np.array(sorted({step.actions[0] for step in steps}), np.int32)
            ways = self._distinct(steps)
        return best

    def worst_later(self, point: Snapshot, later: Later) -> float:
        """The worst loading of a moment to come with the topology of an operating point; infinite without a flow."""
        outcomes, _ = self.outcomes(later.of(point, self._grid), np.zeros(1, np.int32))
        return float(outcomes.worst_loading[0])

    def after(self, point: Snapshot, action: int) -> Snapshot:
        """The operating point after an action."""
        return point_after(self._grid, point, self._action(action))

    def outcomes(self, point: Snapshot, entries: I32 | None = None) -> tuple[ActionOutcomes, F32]:
        """What every action would do, and the loadings after it, float32 [action, line]."""
        n = len(self._catalogue) if entries is None else len(entries)
        rho = np.zeros((n, self._grid.n_line), np.float32)
        return self._what_if.actions(point, self._catalogue, entries, rho), rho

    def _depth(self, overflow: I32) -> int:
        if self._longest == 0:
            return 1
        left = self._grid.rules.overflow_allowed + 1 - int(overflow.max(initial=0))
        return max(1, min(left, self._longest)) + 1

    def _steps(self, ways: list[_Way], entries: I32 | None, beam: int, until: float) -> list[_Step]:
        """The best next actions of all ways, the best first."""
        found: list[_Step] = []
        for way in ways:
            if found and time.perf_counter() > until:
                break
            found += self._next_actions(way, entries, _WIDE if way.first < 0 else beam)
        return sorted(found, key=lambda step: step.score)

    def _next_actions(self, way: _Way, entries: I32 | None, most: int) -> list[_Step]:
        outcomes, rho = self.outcomes(way.point, entries)
        playable = outcomes.legal & np.isfinite(outcomes.worst_loading)
        worst = np.where(playable, outcomes.worst_loading, np.inf).astype(np.float64)
        rho[~playable] = 0.0
        overflow = np.where(rho > 1.0, way.overflow[None, :] + 1, 0).astype(np.int32)
        trips: Flags = np.any(self._trips(rho, overflow), axis=1)
        overloads = _overloads(rho)
        score: F64 = worst + _OVERLOADS * overloads + _TRIP * trips + _TRIPPED * way.n_trips
        order = np.argsort(score, kind="stable")[:most]
        return [
            _Step(
                float(score[k]),
                float(worst[k]),
                bool(trips[k]),
                way,
                int(k if entries is None else entries[k]),
                overflow[k],
                rho[k],
            )
            for k in order.tolist()
            if np.isfinite(score[k])
        ]

    def _trips(self, rho: F32, overflow: I32) -> Flags:
        """Lines that protections trip: too long above the limit, or too far."""
        rules = self._grid.rules
        trips: Flags = (overflow > rules.overflow_allowed) | (rho > rules.hard_overflow)
        return trips

    def _ways(self, steps: list[_Step], beam: int) -> list[_Way]:
        """Where the best steps lead, the best first; of those that trip lines, those that leave a grid."""
        unhurt = any(not step.trips for step in steps[:beam])
        ways = []
        for step in steps[: beam if unhurt else max(beam, _BEAM[0])]:
            way = self._followed(step)
            if way is not None:
                ways.append(way)
        return sorted(ways, key=lambda way: way.score)[:beam]

    def _followed(self, step: _Step) -> _Way | None:
        """The way that a step leads on, a step later; None where the cascade leaves no grid."""
        after = self._cooled(self.after(step.way.point, step.action), step.action)
        rho, overflow, n_trips = step.rho, step.overflow, 0
        for _ in range(_CASCADE_ROUNDS):
            tripped = np.flatnonzero(self._trips(rho, overflow) & (rho > 0.0))
            if len(tripped) == 0:
                break
            n_trips += len(tripped)
            after = without_lines(after, self._grid, tripped, self._grid.rules.reconnection)
            outcomes, all_rho = self.outcomes(after, np.zeros(1, np.int32))
            if outcomes.verdict[0] != 0:
                return None
            rho = all_rho[0]
            overflow = np.where(rho > 1.0, np.maximum(overflow, 1), 0).astype(np.int32)
            overflow[tripped] = 0
        worst, n_trips = float(rho.max()), step.way.n_trips + n_trips
        overloads = float(np.clip(rho - 1.0, 0.0, _LARGEST_OVERLOAD).sum())
        score = worst + _OVERLOADS * overloads + _TRIPPED * n_trips
        return _Way(step.first, after, overflow, n_trips, worst, score)

    def _cooled(self, point: Snapshot, action: int) -> Snapshot:
        """A step later: cooldowns have run on, and what was changed cools down."""
        line, sub = np.maximum(point.cooldown_line - 1, 0), np.maximum(point.cooldown_sub - 1, 0)
        for change in self._action(action).changes:
            if change.kind == ActionKind.SWITCH:
                line[change.target] = max(int(line[change.target]), self._grid.rules.cooldown_line)
            else:
                sub[change.target] = max(int(sub[change.target]), self._grid.rules.cooldown_sub)
        return point._replace(cooldown_line=line, cooldown_sub=sub)

    def _safest(self, safe: list[_Step], n_actions: int, contingencies: Contingencies, later: Later | None) -> Found:
        """Of the sequences that make the grid safe, the one that outages and what is to come endanger least."""
        if len(safe) == 1 or (later is None and len(contingencies.lines) == 0):
            return Found(safe[0].first, safe[0].worst, n_actions, 0)

        def penalty(step: _Step) -> float:
            after = self.after(step.way.point, step.action)
            to_come = 0.0 if later is None else min(self.worst_later(after, later), _LARGEST_LOADING)
            return _DANGER * danger(self._what_if, after, contingencies) + max(step.worst, to_come)

        best = min(safe[:_CANDIDATES], key=penalty)
        return Found(best.first, best.worst, n_actions, 0)

    def _preparations(self, way: _Preparation, later: Later, entries: I32 | None) -> list[_Preparation]:
        """The best next actions by what they make of a moment to come, of those that keep the grid safe until then."""
        outcomes, rho = self.outcomes(later.of(way.point, self._grid), entries)
        ids = np.arange(len(self._catalogue), dtype=np.int32) if entries is None else entries
        playable = outcomes.legal & np.isfinite(outcomes.worst_loading) & (ids != NOTHING)
        rho[~playable] = 0.0
        overloads = _overloads(rho)
        score: F64 = np.where(playable, outcomes.worst_loading + _OVERLOADS * overloads, np.inf).astype(np.float64)
        most = _WIDE if not way.actions else 2 * _PREPARATION_BEAM
        order = np.argsort(score, kind="stable")[:most]
        order = order[np.isfinite(score[order])]
        if len(order) == 0:
            return []
        until_then, _ = self.outcomes(way.point, ids[order])
        keeps_safe = until_then.legal & (until_then.worst_loading < SAFE)
        return [
            _Preparation((*way.actions, int(ids[k])), way.point, float(score[k]), float(outcomes.worst_loading[k]))
            for k in order[keeps_safe].tolist()
        ]

    def _distinct(self, steps: list[_Preparation]) -> list[_Preparation]:
        """The best preparations a step later, each topology once."""
        ways: dict[bytes, _Preparation] = {}
        for step in sorted(steps, key=lambda step: step.score):
            action = step.actions[-1]
            after = self._cooled(self.after(step.point, action), action)
            ways.setdefault(after.topo_vect.tobytes(), step._replace(point=after))
            if len(ways) == _PREPARATION_BEAM:
                break
        return list(ways.values())

    def _action(self, entry: int) -> StepAction:
        if entry not in self._actions:
            self._actions[entry] = self._catalogue[entry]
        return self._actions[entry]


def _overloads(rho: F32) -> F32:
    """The sum of all overloads, at most so much a line, float32 [action]."""
    overloads: F32 = np.clip(rho - 1.0, 0.0, _LARGEST_OVERLOAD).sum(axis=1)
    return overloads
