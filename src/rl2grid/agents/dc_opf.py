"""Redispatch by optimal power flow on the DC approximation (``docs/algorithms/dc_opf.md``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.agent import Action, Info, Observation
from rl2grid.agents.dc_flow import buses, dc_point, sensitivities
from rl2grid.agents.dispatch import (
    Control,
    DispatchAgent,
    anything_dispatched,
    control_positions,
    controls,
    encode,
)
from rl2grid.agents.linear_programme import Affine, Programme
from rl2grid.arrays import F64
from rl2grid.mdp.heuristics import is_safe
from rl2grid.mdp.state import GridState

_MARGIN = 0.9
"""Share of a line's limit up to which it may be loaded."""
_OVERLOAD_PRICE = 1000.0
"""Price per MW above a line's margin; those of the controls are in :func:`rl2grid.agents.dispatch.controls`."""
_TIME_LIMIT = 10.0
"""Seconds; a programme of the largest grid takes a fraction of one."""
_WORTHWHILE = 1e-3
"""Least decrease of the worst loading for which an action is played."""


class DcOpf(DispatchAgent):
    """Redispatches, curtails and stores so that no line is loaded above 90%, at the least cost.

    A linear programme on the DC approximation, solved at every decision in which the grid is not safe or something is
    dispatched; in the latter case, it brings the dispatch back towards zero as far as the lines allow. While the grid
    is not safe, the action must leave a lower worst loading than doing nothing by ``simulate``; else nothing is done.
    On joint tasks it leaves the topology as it is.
    """

    name = "dc-opf"

    refusal = (
        "Agent 'dc-opf' cannot play a topology task (-T0-, -T1-, ...), which has no redispatch: "
        "choose a redispatching task (-R-), a joint one (-H0-, -H1-, ...) or the agent 'milp'."
    )

    def act(self, observation: Observation, info: Info) -> Action:
        """The action that the programme asks for, if the forecast confirms it; else the one that changes nothing."""
        return self._as_action(self._choose())

    def _choose(self) -> NDArray[np.float32]:
        state: GridState = self._env.state
        safe = is_safe(self._opened(state), 0)
        if safe and not anything_dispatched(state):
            return self._nothing.copy()
        action = self._plan(state)
        if action is None:
            return self._nothing.copy()
        worst, worst_of_nothing = self._worst_loading(action), self._worst_loading(self._nothing)
        keeps_safe = safe and worst < _MARGIN + (1.0 - _MARGIN) / 2
        return action if keeps_safe or worst < worst_of_nothing - _WORTHWHILE else self._nothing.copy()

    def _plan(self, state: GridState) -> NDArray[np.float32] | None:
        grid = self._grid
        point = dc_point(state, 0, grid, self._network)
        control = controls(state, grid)
        effect = sensitivities(grid, point)[:, buses(grid, point.busbar)[control_positions(grid)]]
        planned = optimal_injections(point.flow, point.limit * _MARGIN, effect, control)
        return None if planned is None else encode(state, grid, planned)


def optimal_injections(flow: F64, bound: F64, effect: F64, control: Control) -> F64 | None:
    """MW that each control should inject, float64 [control]; None if nothing balances.

    Minimises the price of everything away from rest plus that of flows above their bounds; the changes of all controls
    sum to zero.

    Args:
        flow: present flows, MW, [line].
        bound: largest flows wanted, MW, [line].
        effect: change of each flow per MW injected by each control, [line, control].
        control: the controls.
    """
    programme = Programme()
    injected = [programme.column(least, most) for least, most in zip(control.least, control.most, strict=True)]
    for column, rest, price in zip(injected, control.at_rest, control.price, strict=True):
        away = programme.column(0.0, np.inf, cost=float(price))
        programme.within([(column, 1.0)], Affine(0.0, {away: 1.0}), float(rest))
    total = float(control.now.sum())
    programme.row(total, ((column, 1.0) for column in injected), total)
    unchanged = flow - effect @ control.now
    for line in range(len(flow)):
        above = programme.column(0.0, np.inf, cost=_OVERLOAD_PRICE)
        terms = [(column, float(value)) for column, value in zip(injected, effect[line], strict=True) if value != 0.0]
        programme.within(terms, Affine(float(bound[line]), {above: 1.0}), -float(unchanged[line]))
    values = programme.solve(_TIME_LIMIT)
    return None if values is None else values[injected]
