"""Redispatch, curtailment and storage that keep the grid secure: a linear programme (``docs/algorithms/planner.md``).

Powers in MW. A *case* is the grid as it is, or after the loss of one line.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.contingencies import Contingencies
from rl2grid.agents.dc_flow import (
    DcPoint,
    buses,
    dc_point,
    flow_by,
    injections,
    is_connected,
    outage_factors,
    sensitivities,
)
from rl2grid.agents.dispatch import Control, control_positions, controls
from rl2grid.agents.dispatch_programme import DispatchProgramme
from rl2grid.agents.trend import LATER, TREND_SHARE
from rl2grid.arrays import F32, F64, I32
from rl2grid.engines.native.what_if import WhatIf
from rl2grid.grids import Grid
from rl2grid.mdp.actions import ActionCatalogue, ActionKind, continuous_layout
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.batch import Snapshot
from rl2grid.powerflow.model import Network

NORMAL_BOUND = 0.90
"""Loading that is wanted at most of every line as the grid is, and half an hour later."""
OUTAGE_BOUND = 0.95
"""The same after the loss of a line, now or an hour later."""
_SCREEN = 0.90
"""Worst loading after an outage from which on it is a case of the programme."""
_CASES = 8
"""Outages in a programme at most."""
_WATCHED = 0.85
"""Loading from which on a line of a case has a row."""
_NORMAL_PRICES = (NORMAL_BOUND, 20.0), (0.98, 200.0)
_LATER_PRICES = (NORMAL_BOUND, 5.0), (0.98, 20.0)
_OUTAGE_PRICES = (OUTAGE_BOUND, 1.0), (1.0, 5.0)
"""Loadings, and what a line costs beyond each, as a share of its limit: as the grid is, half an hour later by the
trend, and after an outage, times the weight of that. Beyond its limit a line costs much more than what is wanted
besides, or two lines of which one would trip are loaded alike."""
_OUTAGE_LATER = 0.5
"""What an outage counts an hour later, beside one now."""
_PRICE = 2e-4
"""Of a MW of the cheapest control away from rest."""
_LIMIT_PRICE = 1.0
"""Of a MW that leaves the room that a generator has on the forecasts of the next hour."""
_RESERVE = 0.85
"""Share of a generator's ramp that an action may use up."""
_RETURN_SHARE = 0.25
"""Of the ramp of all generators: what returning renewables may ask of it in a step."""
_HORIZONS = (1, 3, 6, 12)
"""Steps ahead at which generators must be able to follow the series."""
_RAMP_KEPT = 0.3
"""Share of all ramps that is kept for the next step."""
_KEPT, _KEPT_PER_STEP = 20.0, 2.0
"""MW that are kept for later steps, and more for each step ahead."""
_DRIFT = 0.1
"""MW outside its room from which on a dispatch has drifted."""
_LEAST_DRIFT_KEPT = 15.0
"""MW that must be left for later steps; the plan asks for more, so that it is not made anew at once."""
_TABLES = 8
"""Topologies of which sensitivities are kept."""
_TRIFLE = 0.5
"""MW of dispatch that cannot drift into trouble."""
_AWAY = 0.1
"""MW of dispatch, curtailment or storage that is as good as none."""
_LEAST_LOADING, _LEAST_SHARE, _MOST_SHARE = 0.3, 0.6, 1.4
"""Where the limit in MW is taken from the AC flow: from which loading, and how far from the limit as it is now."""
_NO_ACTION = ActionCatalogue(
    np.array([ActionKind.NOTHING], np.int8), np.zeros(1, np.int32), np.zeros((1, 1), np.uint64)
)


class _Case(NamedTuple):
    prices: tuple[tuple[float, float], ...]  # loadings, and what a line costs beyond each
    share: F64  # [line] DC flow over limit, with its sign
    effect: F64  # [line, control] change of that per MW


class _Look(NamedTuple):
    """An operating point, as the grid is then and as the trend leaves it."""

    dc: DcPoint
    bus: I32  # [topo]
    table: F64  # [line, bus] sensitivities
    flow: F64  # [line] MW by the DC flow
    change: F64  # [line] MW more an hour later, by the trend
    effect: F64  # [line, control] MW more on a line per MW injected
    worst: float  # loading by the AC flow
    present: _Case
    later: _Case

    @property
    def worst_later(self) -> float:
        """The largest loading of the grid as it is, and by the trend."""
        return max(self.worst, float(np.abs(self.later.share).max()))


class _Outage(NamedTuple):
    """The loss of a line."""

    line: int
    weight: float
    factor: F64  # [line] MW more on each line per MW that the lost one carried
    limit: F64  # [line] MW
    flow: F64  # [line] MW after it
    flow_later: F64  # [line] the same an hour later
    worst: float  # loading after it by the AC flow
    worst_later: float  # loading after it an hour later by the DC flow

    @property
    def urgency(self) -> float:
        """By which outages are chosen."""
        return self.weight * max(self.worst, self.worst_later)


class Series(NamedTuple):
    """Production of the redispatchable generators before any dispatch, and how all injections change."""

    now: F64  # [gen] MW
    ahead: F64  # [horizon, gen] MW
    half_hour: F64  # [topo] MW that each element will inject more in half an hour, by the trend of the last
    hour: F64  # [topo] the same in an hour


class SecureDispatch:
    """Plans what the controls inject in the next step.

    Args:
        grid: the grid.
        network: its electrical model.
        what_if: what solves the flows after outages.
    """

    def __init__(self, grid: Grid, network: Network, what_if: WhatIf) -> None:
        self._grid, self._network, self._what_if = grid, network, what_if
        self._layout = continuous_layout(grid)
        self._positions = control_positions(grid)
        self._tables: dict[bytes, F64 | None] = {}
        self._looked: tuple[Snapshot, Series, _Look | None] | None = None

    def reset(self) -> None:
        """Forget the last episode."""
        self._looked = None

    def foreseen(self, state: GridState, forecast: F32, change_per_step: F64) -> Series:
        """The series of the redispatchable generators, now and at the horizons of the programme.

        Args:
            state: row 0 is the present.
            forecast: production by the forecasts of the next steps, float32 [step, gen].
            change_per_step: of all injections by the trend, MW, float64 [topo], which goes on from the last forecast.
        """
        now, gens = self._series_now(state), self._layout.redispatch
        trend = change_per_step[self._grid.gen_pos_topo_vect[gens]]
        known = forecast[:, gens].astype(np.float64)
        least, most = np.minimum(state.gen_pmin[gens], now), np.maximum(state.gen_pmax[gens], now)
        ahead = [
            known[steps - 1] if steps <= len(known) else np.clip(known[-1] + (steps - len(known)) * trend, least, most)
            for steps in _HORIZONS
        ]
        half_hour = LATER * TREND_SHARE * change_per_step
        return Series(now, np.array(ahead), half_hour, 2 * half_hour)

    def is_in_use(self, state: GridState) -> bool:
        """Whether generators are dispatched by more than a trifle."""
        return bool(np.abs(state.actual_dispatch[0]).max(initial=0.0) >= _TRIFLE)

    def worst_loading(self, state: GridState, point: Snapshot, series: Series) -> float:
        """The largest loading of an operating point; infinite where the flow has no solution."""
        look = self._look(state, point, series)
        return np.inf if look is None else look.worst

    def is_pressed(self, state: GridState, point: Snapshot, series: Series) -> bool:
        """Whether the next step counts more than where generators get in many.

        Curtailment or storage holds what generators are to take over, or by the trend a line will be loaded too much.
        """
        control = controls(state, self._grid)
        held = np.abs(control.now[len(self._layout.redispatch) :]).max(initial=0.0)
        look = self._look(state, point, series)
        return bool(held > _AWAY or (look is not None and look.worst_later > NORMAL_BOUND))

    def is_drifting(self, state: GridState, series: Series) -> bool:
        """Whether the dispatch would leave what generators can do in the next hour, if it stayed as it is.

        While targets are met nothing is solved again, so that series plus dispatch may leave the limits of a unit; or
        all fall, or rise, faster than those that are left can.
        """
        gens = self._layout.redispatch
        dispatch = state.actual_dispatch[0][gens].astype(np.float64)
        least, most = self._room(state, series)
        if bool(((dispatch < least - _DRIFT) | (dispatch > most + _DRIFT)).any()):
            return True
        pmin, pmax, ramp = state.gen_pmin[gens], state.gen_pmax[gens], state.gen_max_ramp_up[gens]
        made = series.now + dispatch
        steps = np.array((1, *_HORIZONS))
        wanted = np.concatenate(([made.sum()], series.ahead.sum(axis=1) + dispatch.sum()))
        kept = np.array([_RAMP_KEPT * float(ramp.sum()), *(_LEAST_DRIFT_KEPT for _ in _HORIZONS)])
        lowest = np.maximum(pmin, made - steps[:, None] * ramp).sum(axis=1)
        highest = np.minimum(pmax, made + steps[:, None] * ramp).sum(axis=1)
        return bool(((lowest > wanted - kept) | (highest < wanted + kept)).any())

    def plan(
        self,
        state: GridState,
        point: Snapshot,
        series: Series,
        contingencies: Contingencies,
        everything: bool,
        steps: int = 1,
    ) -> F64 | None:
        """MW that each control should inject, float64 [control]; None: there is nothing to do.

        Args:
            state: row 0 is the present.
            point: what is expected in the next step, after the topology action that is played with it.
            series: of the redispatchable generators.
            contingencies: outages after which no line should be overloaded.
            everything: curtailment and storage may be used more than now; else only less.
            steps: that the generators have to get there; see :meth:`next_step`.
        """
        control = self._allowed(state, controls(state, self._grid), everything, steps)
        cases, needed = self._cases(state, point, series, contingencies)
        away = np.abs(control.now - control.at_rest).max(initial=0.0) > _AWAY
        away = away or np.abs(state.target_dispatch[0]).max(initial=0.0) > _AWAY
        if not needed and not away:
            return None
        return self._solve(state, control, cases, series)

    def next_step(self, state: GridState, planned: F64) -> F64:
        """What every control injects in the next step on its way to what is planned, MW, float64 [control].

        Generators go as far as their ramps let them; those that go up, or those that go down, wait for the others, so
        that all changes sum to zero.
        """
        control, n_gen = self._returning(controls(state, self._grid), state, 1), len(self._layout.redispatch)
        change = np.clip(planned, control.least, control.most) - control.now
        excess = float(change.sum())
        waiting = change[:n_gen] > 0 if excess > 0 else change[:n_gen] < 0
        total = float(change[:n_gen][waiting].sum())
        if abs(total) > abs(excess):
            change[:n_gen][waiting] *= 1.0 - excess / total
        return control.now + change

    def _series_now(self, state: GridState) -> F64:
        gens = self._layout.redispatch
        series: F64 = state.gen_p[0][gens].astype(np.float64) - state.actual_dispatch[0][gens]
        return series

    def _allowed(self, state: GridState, control: Control, everything: bool, steps: int) -> Control:
        """The controls as far as they may go in so many steps, with ramp kept in reserve."""
        gens = self._layout.redispatch
        n = len(gens)
        control = self._returning(control, state, steps)
        least, most = control.least.copy(), control.most.copy()
        if steps > 1:
            series = self._series_now(state)
            least[:n] = np.maximum(
                control.now[:n] - steps * state.gen_max_ramp_down[gens], state.gen_pmin[gens] - series
            )
            most[:n] = np.minimum(control.now[:n] + steps * state.gen_max_ramp_up[gens], state.gen_pmax[gens] - series)
        least[:n] = control.now[:n] + _RESERVE * (least[:n] - control.now[:n])
        most[:n] = control.now[:n] + _RESERVE * (most[:n] - control.now[:n])
        if not everything:
            least[n:], most[n:] = np.minimum(control.now[n:], 0.0), np.maximum(control.now[n:], 0.0)
        return control._replace(least=np.minimum(least, control.now), most=np.maximum(most, control.now))

    def _returning(self, control: Control, state: GridState, steps: int) -> Control:
        """Curtailed renewables come back slowly: generators must follow, and more may be there than was forecast."""
        first = len(self._layout.redispatch)
        renewable = slice(first, first + len(self._layout.curtail))
        curtailed = -float(control.now[renewable].sum())
        budget = _RETURN_SHARE * steps * float(state.gen_max_ramp_down[self._layout.redispatch].sum())
        most = control.most.copy()
        most[renewable] = control.now[renewable] * (1.0 - min(budget / max(curtailed, 1e-9), 1.0))
        return control._replace(most=most)

    def _room(self, state: GridState, series: Series) -> tuple[F64, F64]:
        """Least and largest dispatch that keeps every generator within its limits in the next hour."""
        gens = self._layout.redispatch
        all_series = np.concatenate((series.now[None], series.ahead))
        least = np.minimum(state.gen_pmin[gens] - all_series.min(axis=0), 0.0)
        most = np.maximum(state.gen_pmax[gens] - all_series.max(axis=0), 0.0)
        return least, most

    def _cases(
        self, state: GridState, point: Snapshot, series: Series, contingencies: Contingencies
    ) -> tuple[list[_Case], bool]:
        """What the programme watches, and whether anything of it is loaded too much."""
        look = self._look(state, point, series)
        if look is None:
            return [], False
        after = self._outages(look, point, contingencies)
        needed = look.worst_later > NORMAL_BOUND or any(worst > OUTAGE_BOUND for worst, _ in after)
        return [look.present, look.later, *(case for _, case in after)], needed

    def _look(self, state: GridState, point: Snapshot, series: Series) -> _Look | None:
        """What is seen of an operating point; None where it has no flow. The last one is remembered."""
        if self._looked is None or self._looked[0] is not point or self._looked[1] is not series:
            self._looked = point, series, self._look_at(state, point, series)
        return self._looked[2]

    def _look_at(self, state: GridState, point: Snapshot, series: Series) -> _Look | None:
        rho = np.zeros((1, self._grid.n_line), np.float32)
        outcome = self._what_if.actions(point, _NO_ACTION, None, rho)
        if outcome.verdict[0] != 0:
            return None
        injection = injections(self._grid, point.gen_p, point.load_p, point.storage_p)
        dc = dc_point(state, 0, self._grid, self._network)._replace(busbar=point.topo_vect, injection=injection)
        table = self._sensitivities(dc)
        if table is None:
            return None
        bus, flow = buses(self._grid, dc.busbar), flow_by(table, self._grid, dc)
        effect, limit = table[:, bus[self._positions]], _limits(flow, rho[0], dc)
        half_hour, hour = (
            flow_by(table, self._grid, dc._replace(injection=self._without_curtailed(state, change)))
            for change in (series.half_hour, series.hour)
        )
        present = _case(_NORMAL_PRICES, flow, effect, limit)
        later = _case(_LATER_PRICES, flow + half_hour, effect, limit)
        return _Look(dc, bus, table, flow, hour, effect, float(rho.max()), present, later)

    def _without_curtailed(self, state: GridState, change: F64) -> F64:
        """Of a change of what all elements inject, MW: what is curtailed does not follow its series."""
        change = change.copy()
        curtailed = state.gen_renewable & (state.gen_p_before_curtail[0] - state.gen_p[0] > _AWAY)
        change[self._grid.gen_pos_topo_vect[curtailed]] = 0.0
        change[self._grid.gen_pos_topo_vect[self._grid.slack_gen]] -= change.sum()
        return change

    def _sensitivities(self, dc: DcPoint) -> F64 | None:
        """Those of the topology, which seldom changes; None where the grid falls apart."""
        key = dc.busbar.tobytes()
        if key not in self._tables:
            while len(self._tables) >= _TABLES:
                del self._tables[next(iter(self._tables))]
            connected = is_connected(self._grid, dc.busbar)
            self._tables[key] = sensitivities(self._grid, dc) if connected else None
        return self._tables[key]

    def _outages(self, look: _Look, point: Snapshot, contingencies: Contingencies) -> list[tuple[float, _Case]]:
        """The worst loading after each outage that matters, and its case: flows change by outage factors."""
        lines, grid = contingencies.lines, self._grid
        if len(lines) == 0:
            return []
        rho = np.zeros((len(lines), grid.n_line), np.float32)
        outcomes = self._what_if.outages(point, lines, rho)
        found = []
        for k in np.flatnonzero(~outcomes.was_open & (outcomes.verdict == 0)).tolist():
            line = int(lines[k])
            factor = outage_factors(grid, look.table, look.bus, line)
            if factor is None:
                continue
            after = look.flow + factor * look.flow[line]
            limit = _limits(after, rho[k], look.dc)
            then = after + look.change + factor * look.change[line]
            worst, worst_then = float(outcomes.worst_loading[k]), float(np.abs(then / limit).max())
            weight = float(contingencies.weight[k])
            if max(worst, worst_then) >= _SCREEN:
                found.append(_Outage(line, weight, factor, limit, after, then, worst, worst_then))
        found.sort(key=lambda outage: -outage.urgency)
        return [case for outage in found[:_CASES] for case in _cases_after(outage, look)]

    def _solve(self, state: GridState, control: Control, cases: list[_Case], series: Series) -> F64 | None:
        n_gen = len(self._layout.redispatch)
        programme = DispatchProgramme(control, self._prices(state, control))
        rows = [_overload_rows(case, control.now) for case in cases]
        if rows:
            effect, bound, weight = (np.concatenate(column) for column in zip(*rows, strict=True))
            overload = programme.add(np.zeros(len(bound)), weight)
            programme.at_most(effect, bound, (overload, -np.ones(len(bound))))
        least, most = self._room(state, series)
        outside = programme.add(np.zeros(n_gen), np.full(n_gen, _LIMIT_PRICE))
        gens = np.eye(n_gen, len(control.now))
        programme.at_most(gens, most, (outside, -np.ones(n_gen)))
        programme.at_most(-gens, -least, (outside, -np.ones(n_gen)))
        self._keep_ramps(programme, state, series)
        return programme.solve()

    def _prices(self, state: GridState, control: Control) -> F64:
        """Per MW away from rest: cheaper where a ramp is wide, since many small steps would leave none."""
        gens = self._layout.redispatch
        price = _PRICE * control.price / max(float(control.price.min(initial=np.inf)), 1e-9)
        ramp = state.gen_max_ramp_up[gens].astype(np.float64)
        price[: len(gens)] *= ramp.mean() / np.maximum(ramp, 0.5)
        return price

    def _keep_ramps(self, programme: DispatchProgramme, state: GridState, series: Series) -> None:
        """Ask that at every horizon all generators together can still fall, and rise, with some MW to spare.

        What a generator can fall to at most, ``max(pmin, p + x - steps * ramp)``, is a column that is bounded from
        below by both; their sum may exceed what the series asks for by nothing.
        """
        gens = self._layout.redispatch
        pmin, pmax, ramp = (
            each[gens].astype(np.float64) for each in (state.gen_pmin, state.gen_pmax, state.gen_max_ramp_up)
        )
        n, start = len(gens), series.ahead[0]
        one = np.eye(n, programme.n_control)
        total = np.ones((1, n)) @ one
        for steps, wanted in zip(_HORIZONS, series.ahead.sum(axis=1).tolist(), strict=True):
            later = max(steps, 2) - 1
            kept = _RAMP_KEPT * float(ramp.sum()) if steps == 1 else _KEPT + _KEPT_PER_STEP * steps
            for sign, limit in ((1.0, pmin), (-1.0, pmax)):  # falling, then rising: the same with signs changed
                reach = start - sign * later * ramp
                extreme = np.maximum(limit, reach) if sign > 0 else np.minimum(limit, reach)
                spare = min(kept, max(sign * (wanted - float(extreme.sum())), 0.0))
                column = programme.add(sign * limit, np.zeros(n))  # sign * the extreme production
                missing = programme.add(np.zeros(1), np.ones(1))
                programme.at_most(sign * one, -sign * reach, (column, -np.ones(n)))
                programme.at_most(
                    -sign * total,
                    np.array([sign * wanted - spare]),
                    (column, np.ones((1, n))),
                    (missing, -np.ones(1)),
                )


def with_change(series: Series, change: F64) -> Series:
    """The series where not the trend but somebody who knows says how all injections will have changed, MW [topo]."""
    return series._replace(half_hour=change, hour=change)


def _case(prices: tuple[tuple[float, float], ...], flow: F64, effect: F64, limit: F64) -> _Case:
    """A case in shares of the limits."""
    return _Case(prices, flow / limit, effect / limit[:, None])


def _cases_after(outage: _Outage, look: _Look) -> list[tuple[float, _Case]]:
    """The worst loading after an outage and its case, now and an hour later, each where it matters."""
    effect = look.effect + np.outer(outage.factor, look.effect[outage.line])
    found = []
    for worst, flow, weight in (
        (outage.worst, outage.flow, outage.weight),
        (outage.worst_later, outage.flow_later, _OUTAGE_LATER * outage.weight),
    ):
        if worst >= _SCREEN:
            prices = tuple((bound, weight * price) for bound, price in _OUTAGE_PRICES)
            found.append((worst, _case(prices, flow, effect, outage.limit)))
    return found


def _limits(flow: F64, rho: NDArray[np.float32], dc: DcPoint) -> F64:
    """The limits, MW, with which the DC flow meets the loadings of the AC flow, float64 [line]."""
    known = (rho > _LEAST_LOADING) & (np.abs(flow) > 1e-3)
    limit = np.where(known, np.abs(flow) / np.maximum(rho, 0.05), dc.limit)
    met: F64 = np.clip(limit, _LEAST_SHARE * dc.limit, _MOST_SHARE * dc.limit)
    return met


def _overload_rows(case: _Case, now: F64) -> tuple[F64, F64, F64]:
    """``effect @ x <= bound + overload`` of the lines that matter: effect [row, control], bound and weight [row]."""
    lowest = min(bound for bound, _ in case.prices)
    (watched,) = np.nonzero(np.abs(case.share) > min(_WATCHED, lowest - 0.03))
    sign = np.sign(case.share[watched])
    effect = case.effect[watched] * sign[:, None]
    unchanged = (case.share[watched] - case.effect[watched] @ now) * sign
    bounds = np.concatenate([bound - unchanged for bound, _ in case.prices])
    weights = np.repeat([price for _, price in case.prices], len(watched))
    return np.tile(effect, (len(case.prices), 1)), bounds, weights
