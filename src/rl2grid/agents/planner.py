"""A planner: sequences of topology actions and secure dispatch, on forecasts alone (``docs/algorithms/planner.md``)."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from numbers import Real
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.agent import Action, Considered, Info, Observation, injecting_action, injection_part, topology_part
from rl2grid.agents.contingencies import NONE, Contingencies, danger, expected, with_certain
from rl2grid.agents.dispatch import controls, encode, encode_all, worst_loading
from rl2grid.agents.greedy_topology import effects
from rl2grid.agents.secure_dispatch import SecureDispatch, Series, with_change
from rl2grid.agents.topology_search import NOTHING, SAFE, TopologySearch
from rl2grid.agents.trend import Later, Trend, later_of, undispatched, without_closing
from rl2grid.arrays import F32, F64, I32
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.what_if import WhatIf, forecast_of, snapshot_of
from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid
from rl2grid.handles import AsOpened
from rl2grid.mdp.actions import ActionKind, continuous_layout, full_catalogue
from rl2grid.mdp.heuristics import is_safe
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.batch import Snapshot
from rl2grid.powerflow.model import load_network

INGREDIENTS = (
    "sequences",
    "danger",
    "restoring",
    "prevention",
    "dispatch first",
    "trend",
    "preparing",
)
"""What can be left out of the planner, to see what it is worth."""
_RESTORE_BELOW = 0.93
"""Worst loading up to which a substation is brought back to its reference."""
_DANGER_ADDED = 1e-3
"""What a restored substation may add to the danger of outages."""
_ENOUGH = 0.99
"""Worst loading that dispatch alone must leave for the topology to stay as it is."""
_PERIOD = 6
"""Steps between plans while the grid is safe."""
_AIM = 48
"""Steps within which generators are to be where a pupil is told that they are wanted, while the grid is safe: so many
that ramps hardly matter."""
_LEAST_AGE = 2
"""Steps that a plan is followed at least, however the dispatch drifts."""
_SHARES = (1.0, 0.5, 0.2)
"""Of a plan that the generators could not follow: what is tried of it."""
_SETTLED = 5e-3
"""MW between target and actual dispatch below which it counts as met."""
_FIRST_REQUEST = 1e-5
"""MW that count as a request and change nothing."""
_NEGLIGIBLE_PLAN, _NEGLIGIBLE_REQUEST = 0.05, 0.01
"""MW, and entries of an action, below which a plan changes nothing."""

_PRESSED = "while the grid is safe, power is shifted at once: a line will be loaded too much, or generators take over"
_PREVENTIVE = "while the grid is safe, power is shifted so that it stays so after a loss, or back to rest"


class Foretold(NamedTuple):
    """What somebody who knows the future tells the planner of a moment to come."""

    step: int
    lines: I32  # lost until then
    injection: F64  # [topo] MW then, if nothing were dispatched


class _Moment(NamedTuple):
    """What is known when an action is chosen."""

    state: GridState
    safe: bool
    ahead: Snapshot | None  # forecast of the next step before anybody acts; None: the generators cannot follow
    series: Series | None  # of the generators; None where nothing is injected
    later: Later | None  # what is to come; None where topology does not prepare for it


class Planner:
    """Keeps the grid secure by topology, by redispatch, curtailment and storage, or by both in one step.

    While the grid is safe, it closes lines, brings substations back where that is safe and makes no outage worse, and
    makes ready for half an hour later by the trend and for announced maintenance: by topology where there is nothing
    else, or it shifts power so that no line is overloaded then, nor after an attack or an announced outage, now
    or an hour later (:class:`~rl2grid.agents.secure_dispatch.SecureDispatch`). When it is not safe, it looks
    for the sequence of topology actions that makes it so before protections trip a line
    (:class:`~rl2grid.agents.topology_search.TopologySearch`), and dispatches against what is left; where both can be
    done, dispatch comes first. It knows forecasts, announced maintenance and which lines the opponent may attack, not
    when. It is meant to be played without a heuristic, because it acts while the grid is safe.

    Args:
        without: ingredients of :data:`INGREDIENTS` to leave out.
        seconds: that a search may take; None: as long as it takes, so that results depend on nothing but the seed.

    Raises:
        UsageError: there is no such ingredient, or the seconds are no positive number.
    """

    kinds: ClassVar[tuple[str, ...]] = ("T", "R", "H")
    rules: ClassVar[Mapping[str, int]] = {"T": 2, "R": 3, "H": 3}
    called: ClassVar[str] = "planner"
    """Its name, without what is left out of it."""

    def __init__(self, without: Collection[str] = (), seconds: float | None = None) -> None:
        if isinstance(without, str) or not isinstance(without, Collection):
            raise UsageError(f'without={without!r} is not allowed: give a list of ingredients, such as ["danger"].')
        for each in without:
            if each not in INGREDIENTS:
                raise one_of("Ingredient", each, INGREDIENTS)
        if seconds is not None and not _is_positive(seconds):
            raise UsageError(f"seconds={seconds!r} is not allowed: give a positive number.")
        self._foretold: Foretold | None = None
        self._without, self._seconds = frozenset(without), seconds
        self.name = self.called + "".join(f" without {each}" for each in sorted(self._without))
        if seconds is not None:
            self.name += f" ({seconds:g} s)"

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Look up the grid, its actions and its electrical model.

        Raises:
            UsageError: the reference engine plays, which answers no what-if, or a search is limited that the task has
                no use for.
        """
        base: Any = env.unwrapped
        if not isinstance(base.engine, NativeEngine):
            raise UsageError("Agent 'planner' asks what-ifs of the native engine: choose engine=\"native\".")
        if self._seconds is not None and not base.task.changes_topology:
            raise UsageError(
                f"The seconds of the planner end its search for topology actions, which {base.task.id} has not: leave "
                "them out."
            )
        self._env, self._space = base, env.action_space
        self._opened: AsOpened[GridState] = AsOpened()
        self._grid: Grid = base.grid
        self._what_if, self._trend = WhatIf(self._grid), Trend(self._grid)
        self._search: TopologySearch | None = None
        if base.task.changes_topology:
            self._catalogue = full_catalogue(self._grid).take(base.action_catalogue_ids)
            longest = {"longest": 0} if "sequences" in self._without else {}
            self._search = TopologySearch(self._grid, self._catalogue, self._what_if, seconds=self._seconds, **longest)
        self._dispatch: SecureDispatch | None = None
        if base.task.injects:
            self._dispatch = SecureDispatch(self._grid, load_network(self._grid), self._what_if)

    def reset(self, i: int) -> None:
        """Forget the series of the last episode."""
        self._why = ""
        self._planned: F64 | None = None
        self._age, self._step = 0, 0
        self._compared: list[tuple[int, float]] = []
        self._topology, self._is_plan_void = NOTHING, False
        self._trend.reset()
        if self._dispatch is not None:
            self._dispatch.reset()

    def act(self, observation: Observation, info: Info) -> Action:
        """What it plans for the next step."""
        state: GridState = self._env.state
        self._why, self._compared = "", []
        self._trend.watch(state)
        step = int(state.step[0])
        # A heuristic played between, or the environment was brought back to an earlier moment.
        self._is_plan_void |= not self._step <= step <= self._step + 1
        self._step = step
        moment = self._moment(state)
        action = self._choose(moment)
        if self._search is not None:
            self._topology = topology_part(action)
        self._last = moment, action
        return action

    def aim(self) -> F32:
        """Where it wants the injections: of a safe grid wherever ramps let them be in hours, else in the next step.

        For the former a plan is made, besides the one that is followed for half an hour or for a step.
        """
        moment, action = self._last
        if not moment.safe:
            return injection_part(action)
        assert moment.series is not None
        planned = self._plan(moment, self._point(moment), self._topology, moment.series, _AIM)
        return self._held() if planned is None else encode_all(moment.state, self._grid, planned)

    def forewarn(self, foretold: Foretold | None) -> None:
        """Dispatch against what is foretold, until it is there; None: against what is forecast and published alone."""
        self._foretold, self._is_plan_void = foretold, True

    def _choose(self, moment: _Moment) -> Action:
        if moment.safe and self._is_calm(moment):
            topology = self._preparing(moment) or self._restoring(moment)
            injection = self._preventive(moment, topology) if self._dispatch is not None else None
            return self._action(topology, injection)
        return self._relieve(moment)

    def explain(self) -> Considered | None:
        """By what rule the last action was chosen."""
        return Considered("", (), (), self._why) if self._why else None

    def ranking(self, most: int) -> Considered | None:
        """The single topology actions that the search found best, with the worst loading by the forecast, and more
        where several lines are overloaded or one would trip; None: there was no search.
        """
        if not self._compared:
            return None
        actions, penalties = zip(*self._compared[:most], strict=True)
        return Considered("worst loading and overloads", actions, penalties)

    def overruled(self, played: Action) -> None:
        """Another topology than the one it was made for voids a plan: the next one is made at once."""
        if self._search is not None:
            self._is_plan_void |= topology_part(played) != self._topology

    def _moment(self, state: GridState) -> _Moment:
        ahead, safe = forecast_of(self._env.engine, 0), is_safe(self._opened(state), 0)
        if self._dispatch is not None:
            return _Moment(state, safe, ahead, self._series(state), None)
        if ahead is None or "preparing" in self._without:
            return _Moment(state, safe, ahead, None, None)
        ahead = without_closing(state, ahead)
        return _Moment(state, safe, ahead, None, later_of(state, ahead, self._grid, self._change_per_step()))

    def _point(self, moment: _Moment) -> Snapshot:
        """What is expected in the next step; as it is now where the generators cannot follow."""
        return moment.ahead if moment.ahead is not None else snapshot_of(self._env.engine, 0)

    def _is_calm(self, moment: _Moment) -> bool:
        """Whether nothing has to be done by the forecast."""
        if moment.ahead is None:
            return True
        if self._search is None:
            assert self._dispatch is not None
            assert moment.series is not None
            return self._dispatch.worst_loading(moment.state, moment.ahead, moment.series) < SAFE
        outcomes, _ = self._search.outcomes(moment.ahead, np.zeros(1, np.int32))
        return bool(outcomes.worst_loading[NOTHING] < SAFE)

    def _preparing(self, moment: _Moment) -> int:
        """The entry that begins to make what is to come safe; nothing where it is, or nothing makes it so."""
        if moment.later is None or moment.ahead is None:
            return NOTHING
        assert self._search is not None
        found = self._search.prepared(moment.ahead, moment.later)
        if found.action != NOTHING:
            self._why = (
                f"while the grid is safe, it is made ready for what is to come: {found.n_actions} actions lead to a "
                f"worst loading of {found.worst_loading:.0%} then"
            )
        return found.action

    def _restoring(self, moment: _Moment) -> int:
        """The entry that closes a line or brings a substation back, if that keeps the grid safe; else nothing."""
        if self._search is None or moment.ahead is None or is_at_reference(moment.state):
            return NOTHING
        effect = effects(self._grid, moment.state, self._catalogue)
        closes = effect.restores & (self._catalogue.kind == ActionKind.SWITCH)
        line = self._best_of(moment, self._worth_closing(moment.state, np.flatnonzero(closes)), SAFE)
        if line:
            self._why = "while the grid is safe, a line is closed if that keeps it so"
            return line[0]
        if "restoring" in self._without:
            return NOTHING
        homeward = np.flatnonzero(effect.restores & (self._catalogue.kind == ActionKind.MOVE))
        candidates = self._best_of(moment, homeward, _RESTORE_BELOW)
        if not candidates:
            return NOTHING
        contingencies = self._expected(moment.state)
        before = danger(self._what_if, moment.ahead, contingencies)
        for entry in candidates:
            after = self._search.after(moment.ahead, entry)
            if danger(self._what_if, after, contingencies) <= before + _DANGER_ADDED:
                self._why = "while the grid is safe, a substation is brought back if that makes no outage worse"
                return entry
        return NOTHING

    def _best_of(self, moment: _Moment, entries: NDArray[np.int64], below: float) -> list[int]:
        """Legal entries after which the worst loading is below a margin, the least loaded first.

        Later it is to be below as well, or no larger than if nothing were done.
        """
        if len(entries) == 0:
            return []
        assert self._search is not None
        assert moment.ahead is not None
        chosen = entries.astype(np.int32)
        outcomes, _ = self._search.outcomes(moment.ahead, chosen)
        loading = np.where(outcomes.legal, outcomes.worst_loading, np.inf)
        if moment.later is not None:
            point = moment.later.of(moment.ahead, self._grid)
            later, _ = self._search.outcomes(point, np.concatenate(([np.int32(NOTHING)], chosen)))
            of_nothing, of_chosen = later.worst_loading[0], later.worst_loading[1:]
            loading = np.where(of_chosen > of_nothing, np.maximum(loading, of_chosen), loading)
        return [int(entries[k]) for k in np.argsort(loading, kind="stable").tolist() if loading[k] < below]

    def _preventive(self, moment: _Moment, topology: int) -> F32 | None:
        """The injection that a safe grid is to have, every half hour and whenever the dispatch drifts."""
        assert self._dispatch is not None
        assert moment.series is not None
        state, series = moment.state, moment.series
        point = self._point(moment)
        pressed = self._dispatch.is_pressed(state, point, series)
        due = int(state.step[0]) % _PERIOD == 0 or topology != NOTHING or pressed or self._is_plan_void
        self._age += 1
        if due or (self._age >= _LEAST_AGE and self._drifts(state, series)):
            self._age, self._is_plan_void = 0, False
            self._planned = self._plan(moment, point, topology, series, 1 if pressed else _PERIOD)
        injection = None if self._planned is None else self._towards(topology, self._planned)
        if injection is not None and not self._why:
            self._why = _PRESSED if pressed else _PREVENTIVE
        return injection

    def _drifts(self, state: GridState, series: Series) -> bool:
        assert self._dispatch is not None
        return self._dispatch.is_in_use(state) and self._dispatch.is_drifting(state, series)

    def _relieve(self, moment: _Moment) -> Action:
        """What makes the grid safe again."""
        point = self._point(moment)
        series = moment.series
        if self._search is None:
            assert series is not None
            injection = self._injection(moment, point, NOTHING, series)
            if injection is not None and not self._worst(NOTHING, injection) < self._worst(NOTHING, None):
                injection = None
            self._why = "dispatch against the overload" if injection is not None else "no dispatch helps"
            return self._action(NOTHING, injection)
        if series is not None and "dispatch first" not in self._without and not self._can_close(moment):
            injection = self._injection(moment, point, NOTHING, series)
            if injection is not None and self._worst(NOTHING, injection) < _ENOUGH:
                self._why = "dispatch alone makes the grid safe"
                return self._action(NOTHING, injection)
        topology = NOTHING
        if moment.ahead is not None:
            overflow, feared = moment.state.timestep_overflow[0], self._feared(moment)
            found = self._search.best(moment.ahead, overflow, feared, moment.later)
            topology, self._compared = found.action, self._search.singles
            self._why = (
                f"{found.n_actions} actions lead to a worst loading of {found.worst_loading:.0%}"
                f"{f', with {found.n_trips} lines tripped' if found.n_trips else ''}"
            )
        return self._action(topology, None if series is None else self._injection(moment, point, topology, series))

    def _feared(self, moment: _Moment) -> Contingencies:
        """The outages by which sequences are chosen: none while one attack is on."""
        if "danger" in self._without or moment.state.attacked[0].any():
            return NONE
        return self._expected(moment.state)

    def _expected(self, state: GridState) -> Contingencies:
        """The outages that may come."""
        return expected(self._grid, state)

    def _worth_closing(self, state: GridState, entries: NDArray[np.int64]) -> NDArray[np.int64]:
        """Of the entries that close a line, those that may be played while the grid is safe."""
        return entries

    def _can_close(self, moment: _Moment) -> bool:
        state = moment.state
        switches = self._catalogue.target[self._catalogue.kind == ActionKind.SWITCH]
        ready = ~state.line_status[0] & (state.time_before_cooldown_line[0] == 0)
        return bool(ready[switches].any())

    def _series(self, state: GridState) -> Series:
        assert self._dispatch is not None
        outlook = self._env.engine.outlook(0)
        # An imagined world goes on from forecasts of an earlier step, the last of which repeats.
        past = min(int(state.step[0]) + 1 - outlook.first_step, len(outlook.prod_p) - 1)
        series = self._dispatch.foreseen(state, outlook.prod_p[past:], self._trend.per_step())
        foretold = self._foretold_at(state)
        if foretold is not None:
            return with_change(series, foretold.injection - undispatched(state, self._grid))
        return with_change(series, np.zeros(self._grid.dim_topo)) if "trend" in self._without else series

    def _change_per_step(self) -> F64:
        """MW more that every element injects in a step, by the trend, float64 [topo]."""
        change = self._trend.per_step()
        return np.zeros_like(change) if "trend" in self._without else change

    def _injection(self, moment: _Moment, point: Snapshot, topology: int, series: Series) -> F32 | None:
        """The continuous action with a topology action, float32 [continuous]; None: none, or it cannot be followed."""
        self._planned = None
        planned = self._plan(moment, point, topology, series, 1)
        return None if planned is None else self._towards(topology, planned)

    def _plan(self, moment: _Moment, point: Snapshot, topology: int, series: Series, steps: int) -> F64 | None:
        """MW that each control should inject after a topology action, float64 [control]."""
        assert self._dispatch is not None
        if topology != NOTHING:
            assert self._search is not None
            point = self._search.after(point, topology)
        contingencies = NONE if "prevention" in self._without else self._expected(moment.state)
        foretold, everything = self._foretold_at(moment.state), not moment.safe
        if foretold is not None:
            contingencies, everything = with_certain(contingencies, foretold.lines), True
        return self._dispatch.plan(moment.state, point, series, contingencies, everything, steps)

    def _foretold_at(self, state: GridState) -> Foretold | None:
        is_to_come = self._foretold is not None and int(state.step[0]) < self._foretold.step
        return self._foretold if is_to_come else None

    def _towards(self, topology: int, planned: F64) -> F32 | None:
        """The continuous action that comes nearer to a plan; None: nothing of it is left, or it cannot be followed."""
        assert self._dispatch is not None
        state = self._env.state
        injected = self._dispatch.next_step(state, planned)
        action = encode(state, self._grid, injected)
        n_gen = len(continuous_layout(self._grid).redispatch)
        moved = float(np.abs(injected - controls(state, self._grid).now).max(initial=0.0)) >= _NEGLIGIBLE_PLAN
        if not moved and float(np.abs(action[:n_gen]).max(initial=0.0)) < _NEGLIGIBLE_REQUEST:
            return None
        return self._followed(topology, action)

    def _followed(self, topology: int, action: F32) -> F32 | None:
        """As much of an action as generators can follow by the forecast."""
        held = self._held()
        for share in _SHARES:
            part = (held + np.float32(share) * (action - held)).astype(np.float32)
            result = self._env.simulate(self._action(topology, part))
            if not result.terminated and not result.info["illegal"]:
                return part
        return None

    def _worst(self, topology: int, injection: F32 | None) -> float:
        """The worst loading by the forecast; infinite where the game would be lost."""
        return worst_loading(self._env, self._action(topology, injection))

    def _held(self) -> F32:
        """The injection that leaves dispatch and curtailment as they are.

        What was asked for and not reached is given up: while targets are met nothing is solved again, so that a series
        that rises faster than its generators can, as some do, ends nothing.
        """
        layout, state = continuous_layout(self._grid), self._env.state
        gens, n_gen = layout.redispatch, len(layout.redispatch)
        values = np.zeros(layout.size, np.float32)
        ramp, target = state.gen_max_ramp_up[gens], state.target_dispatch[0][gens]
        missed = state.actual_dispatch[0][gens] - target
        # Who was never asked has no target, and the first request is added to what it was given.
        request = np.where(target == 0.0, _FIRST_REQUEST, missed)
        request[np.abs(missed) < _SETTLED] = 0.0
        values[:n_gen] = np.clip(np.divide(request, ramp, out=np.zeros_like(missed), where=ramp > 0), -1.0, 1.0)
        limits = state.curtailment_limit[0][layout.curtail]
        values[n_gen : n_gen + len(layout.curtail)] = np.minimum(limits - 1.0, 0.0)
        return values

    def _action(self, topology: int, injection: F32 | None) -> Action:
        if self._dispatch is None:
            return topology
        return injecting_action(self._space, self._held() if injection is None else injection, topology)


def _is_positive(seconds: float) -> bool:
    return isinstance(seconds, Real) and not isinstance(seconds, bool) and math.isfinite(seconds) and seconds > 0


def is_at_reference(state: GridState) -> bool:
    """Whether every line of row 0 is closed and every element on busbar 1."""
    return bool((state.topo_vect[0] == 1).all())
