"""Greedy search among redispatches, curtailments and storage powers (``docs/algorithms/greedy.md``)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.agent import Action, Considered, Info, Observation
from rl2grid.agents.dc_flow import buses, dc_point, sensitivities
from rl2grid.agents.dispatch import (
    Control,
    DispatchAgent,
    anything_dispatched,
    control_positions,
    controls,
    encode,
)
from rl2grid.arrays import F64, I64
from rl2grid.mdp.actions import continuous_layout
from rl2grid.mdp.heuristics import is_safe
from rl2grid.mdp.state import GridState

_SHARES = (0.5, 1.0)
"""Of the room that both sides of a shift have: how far a candidate goes."""
_SHORTLIST = 6
"""Shifts that the DC flow finds best, each of which is simulated."""
_ROUNDS = 6
"""Shifts that one action may combine, each the best after those before."""
_WORTHWHILE = 1e-3
"""Least decrease of the worst loading for which an action is played."""
_ENOUGH = 0.9
"""Worst loading below which the cheapest action is played instead of the one with the lowest."""
_CALM = 0.925
"""Worst loading below which dispatch is given back."""
_RETURNS = (1.0, 0.5, 0.2, 0.05, 0.0)
"""Shares of what is dispatched that may be given back in a step."""
_RAMP_SHARE = 0.25
"""Of the ramp of all generators: how much of it a return of renewables and storage may use up."""
_LEAST_ROOM = 0.1
"""MW that a control must be able to move to be part of a shift."""


class Shifts(NamedTuple):
    """Candidates that move power from one control to another; shapes in brackets."""

    up: I64  # [shift] control that injects more
    down: I64  # [shift] control that injects less
    power: F64  # [shift] MW


class GreedyDispatch(DispatchAgent):
    """Shifts power between generators, renewables and storage so that the worst loading of the forecast is least.

    While the grid is not safe, all shifts between two controls by half and all of their room are ranked by a DC flow;
    the best, and the sum of those that are best one after the other, are tried with :meth:`PowerGridEnv.simulate`.
    While it is safe and something is dispatched, it goes back to zero as fast as the forecast allows.
    """

    name = "greedy"

    refusal = "A dispatch cannot be searched for on a topology task: choose a redispatching task (-R-) or a joint one."

    def act(self, observation: Observation, info: Info) -> Action:
        """The action with the least worst loading on the forecast; zeros where none is better."""
        return self._as_action(self.choose(0))

    def choose(self, topology: int) -> NDArray[np.float32]:
        """The injection to play; on joint tasks together with the topology action ``topology``.

        The shifts are ranked in the present topology, and tried on the forecast with the topology action.
        """
        state: GridState = self._env.state
        self._topology = topology
        self._remember([], np.zeros(0), "")
        if not is_safe(self._opened(state), 0):
            return self._relieve(state)
        return self._give_back(state) if anything_dispatched(state) else self._nothing.copy()

    def explain(self) -> Considered | None:
        """The actions that the last decision tried on the forecast, the least loaded first; None: it tried none."""
        if not self._tried:
            return None
        order = np.argsort(self._promised, kind="stable")
        tried = [self._as_action(self._tried[k]) for k in order]
        return Considered("worst loading", tried, self._promised[order].tolist(), self._why)

    def _remember(self, tried: list[NDArray[np.float32]], promised: F64, why: str) -> None:
        self._tried, self._promised, self._why = tried, promised, why

    def _relieve(self, state: GridState) -> NDArray[np.float32]:
        control = controls(state, self._grid)
        plans = [control.now, *self._plans(state, control)]
        actions = [self._nothing.copy(), *(encode(state, self._grid, plan) for plan in plans)]
        loadings = np.array([self._worst_loading(action) for action in actions])
        prices = np.array([0.0, *(float(control.price @ np.abs(plan - control.at_rest)) for plan in plans)])
        enough = (loadings < _ENOUGH) & (loadings < loadings[0] - _WORTHWHILE)
        best = int(np.where(enough, prices, np.inf).argmin() if enough.any() else loadings.argmin())
        rule = (
            f"the cheapest of those that keep every line below {_ENOUGH:.0%}" if enough.any() else "the least loading"
        )
        self._remember(actions, loadings, rule)
        return actions[best] if loadings[best] < loadings[0] - _WORTHWHILE else actions[0]

    def _give_back(self, state: GridState) -> NDArray[np.float32]:
        """The largest share of what is dispatched whose return stays calm; else what loads the lines least."""
        control = controls(state, self._grid)
        rest = np.clip(control.at_rest, control.least, control.most)
        actions, loadings = [], []
        for share in _RETURNS:
            plan = control.now + share * (rest - control.now)
            if share > 0.0 and not self._can_be_followed(state, plan - control.now):
                continue
            actions.append(encode(state, self._grid, plan))
            loadings.append(self._worst_loading(actions[-1]))
            if loadings[-1] < _CALM:
                break
        self._remember(actions, np.array(loadings), "as much dispatch is given back as the forecast allows")
        return actions[int(np.argmin(loadings))]

    def _can_be_followed(self, state: GridState, change: F64) -> bool:
        """Whether generators can make up for what renewables and storage change, with ramp left for the series."""
        gens = continuous_layout(self._grid).redispatch
        ramp = float(np.minimum(state.gen_max_ramp_up, state.gen_max_ramp_down)[gens].sum())
        return float(np.abs(change[len(gens) :]).sum()) <= _RAMP_SHARE * ramp

    def _plans(self, state: GridState, control: Control) -> list[F64]:
        """MW that each control should inject, float64 [control], in each candidate."""
        point = dc_point(state, 0, self._grid, self._network)
        position = control_positions(self._grid)
        effect = sensitivities(self._grid, point)[:, buses(self._grid, point.busbar)[position]]
        share, effect = point.flow / point.limit, effect / point.limit[:, None]
        plans: list[F64] = []
        plan = control.now
        for k in range(_ROUNDS):
            shifts = possible_shifts(control, plan)
            after = loadings_after(shifts, effect, share + effect @ (plan - control.now))
            if len(after) == 0:
                break
            ranked = np.argsort(after, kind="stable")[: _SHORTLIST if k == 0 else 1]
            plans += [shifted(plan, shifts, shift) for shift in ranked.tolist()]
            plan = shifted(plan, shifts, int(ranked[0]))
        return plans


def possible_shifts(control: Control, plan: F64) -> Shifts:
    """All shifts from one control to another, by each of the shares of the room that both have left.

    Args:
        control: the controls.
        plan: what each injects before the shift, MW, [control].
    """
    room_up, room_down = control.most - plan, plan - control.least
    up, down = (x.ravel() for x in np.meshgrid(*(np.arange(len(plan)),) * 2, indexing="ij"))
    room = np.minimum(room_up[up], room_down[down])
    usable = (up != down) & (room > _LEAST_ROOM)
    up, down, room = up[usable], down[usable], room[usable]
    n = len(_SHARES)
    return Shifts(np.tile(up, n), np.tile(down, n), np.concatenate([room * share for share in _SHARES]))


def loadings_after(shifts: Shifts, effect: F64, share: F64) -> F64:
    """The worst DC loading after each shift, float64 [shift].

    Args:
        shifts: the candidates.
        effect: change of each line's loading per MW that each control injects, [line, control].
        share: loadings with their sign before the shift, [line].
    """
    change = (effect[:, shifts.up] - effect[:, shifts.down]) * shifts.power
    worst: F64 = np.abs(share[:, None] + change).max(axis=0)
    return worst


def shifted(plan: F64, shifts: Shifts, shift: int) -> F64:
    """What each control injects after a shift, MW, float64 [control]."""
    result = plan.copy()
    result[shifts.up[shift]] += shifts.power[shift]
    result[shifts.down[shift]] -= shifts.power[shift]
    return result
