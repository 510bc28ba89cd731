"""Redispatch by optimal power flow on the DC approximation (``docs/algorithms/dc_opf.md``)."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.agent import Action, Info, Observation
from rl2grid.agents.dc_flow import buses, dc_point, sensitivities
from rl2grid.agents.linear_programme import F64, Affine, Programme
from rl2grid.errors import UsageError
from rl2grid.grids import STEPS_PER_HOUR, Grid
from rl2grid.mdp.actions import continuous_layout
from rl2grid.mdp.heuristics import is_safe
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.model import load_network

_MARGIN = 0.9
"""Share of a line's limit up to which it may be loaded."""
_OVERLOAD_PRICE = 1000.0
_CURTAILMENT_PRICE = 10.0
_STORAGE_PRICE = 5.0
_REDISPATCH_PRICE = 1.0
"""Price per MW above a line's margin, curtailed, stored or redispatched (times the relative cost of the generator)."""
_NEGLIGIBLE = 0.01
"""MW of dispatch, curtailment or storage that is as good as none."""
_TIME_LIMIT = 10.0
"""Seconds; a programme of the largest grid takes a fraction of one."""
_WORTHWHILE = 1e-3
"""Least decrease of the worst loading for which an action is played."""


class Control(NamedTuple):
    """Something that injects power: how much it injects now, may inject in the next step, and what that costs."""

    now: F64  # [control] MW
    least: F64  # [control] MW
    most: F64  # [control] MW
    at_rest: F64  # [control] MW at which it costs nothing
    price: F64  # [control] per MW away from rest


class DcOpf:
    """Redispatches, curtails and stores so that no line is loaded above 90%, at the least cost.

    A linear programme on the DC approximation, solved at every decision in which the grid is not safe or something is
    dispatched; in the latter case, it brings the dispatch back towards zero as far as the lines allow. While the grid
    is not safe, the action must leave a lower worst loading than doing nothing by ``simulate``; else nothing is done.
    """

    name = "dc-opf"

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Look up the electrical model of the grid.

        Raises:
            UsageError: the task has no continuous actions.
        """
        if not isinstance(env.action_space, gymnasium.spaces.Box):
            raise UsageError(
                "Agent 'dc-opf' cannot play a topology task (-T0-, -T1-, ...), which has no redispatch: "
                "choose a redispatching task (-R-) or the agent 'milp'."
            )
        base: Any = env.unwrapped
        self._env = base
        self._grid: Grid = base.grid
        self._network = load_network(self._grid)
        self._nothing = np.zeros(continuous_layout(self._grid).size, np.float32)

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The action that the programme asks for, if the forecast confirms it; zeros otherwise."""
        state: GridState = self._env.state
        safe = is_safe(state, 0)
        if safe and not _anything_dispatched(state):
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
        layout = continuous_layout(grid)
        gens, renewables, units = layout.redispatch, layout.curtail, layout.storage
        control = controls(state, grid)
        positions = np.concatenate(
            (grid.gen_pos_topo_vect[gens], grid.gen_pos_topo_vect[renewables], grid.storage_pos_topo_vect[units])
        )
        effect = sensitivities(grid, point)[:, buses(grid, point.busbar)[positions]]
        planned = optimal_injections(point.flow, point.limit * _MARGIN, effect, control)
        return None if planned is None else encode(state, grid, planned)

    def _worst_loading(self, action: NDArray[np.float32]) -> float:
        """By the forecast; infinite where the game would be lost."""
        result = self._env.simulate(action)
        return np.inf if result.terminated else float(result.observation[self._env.observation_slices["rho"]].max())


def controls(state: GridState, grid: Grid) -> Control:
    """What the continuous actions can do in the next step of row 0, in the order of their entries.

    A generator injects its actual dispatch, a renewable minus what it is curtailed by, a storage unit minus its power.
    Generators keep to ramps, limits and, for what the next request can ask for, targets within one ramp.
    """
    layout = continuous_layout(grid)
    gens, renewables, units = layout.redispatch, layout.curtail, layout.storage
    dispatch, target = (x[0][gens].astype(np.float64) for x in (state.actual_dispatch, state.target_dispatch))
    up = np.minimum(state.gen_max_ramp_up[gens], state.gen_margin_up[0][gens])
    down = np.minimum(state.gen_max_ramp_down[gens], state.gen_margin_down[0][gens])
    reach = (state.gen_pmax - state.gen_pmin)[gens]
    least = np.maximum.reduce([dispatch - down, target - state.gen_max_ramp_down[gens], -reach])
    most = np.minimum.reduce([dispatch + up, target + state.gen_max_ramp_up[gens], reach])
    available = np.maximum(state.gen_p_before_curtail[0], state.gen_p[0])[renewables].astype(np.float64)
    curtailed = state.gen_p[0][renewables] - available
    charge = state.storage_charge[0].astype(np.float64)
    store = np.minimum(
        grid.storage_max_p_absorb,
        (grid.storage_emax - charge) * STEPS_PER_HOUR / np.maximum(grid.storage_charging_efficiency, 1e-6),
    )
    deliver = np.minimum(
        grid.storage_max_p_prod, (charge - grid.storage_emin) * STEPS_PER_HOUR * grid.storage_discharging_efficiency
    )
    cost = state.gen_cost_per_mw[gens].astype(np.float64)
    relative = cost / max(float(cost.mean()), 1e-6) if len(cost) else cost
    none = np.zeros(len(renewables) + len(units))
    return Control(
        np.concatenate((dispatch, curtailed, -state.storage_power[0].astype(np.float64))),
        np.concatenate((np.minimum(least, dispatch), -available, np.minimum(-store, 0.0))),
        np.concatenate((np.maximum(most, dispatch), none[: len(renewables)], np.maximum(deliver, 0.0))),
        np.concatenate((np.zeros(len(gens)), none)),
        np.concatenate(
            (
                _REDISPATCH_PRICE * np.maximum(relative, 0.1),
                np.full(len(renewables), _CURTAILMENT_PRICE),
                np.full(len(units), _STORAGE_PRICE),
            )
        ),
    )


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


def encode(state: GridState, grid: Grid, planned: F64) -> NDArray[np.float32]:
    """The continuous action that asks for what :func:`optimal_injections` planned, float32 [continuous]."""
    layout = continuous_layout(grid)
    gens, renewables = layout.redispatch, layout.curtail
    dispatch, curtailed, delivered = np.split(planned, [len(gens), len(gens) + len(renewables)])
    request = dispatch - state.target_dispatch[0][gens]
    ramp = np.where(request > 0, state.gen_max_ramp_up[gens], state.gen_max_ramp_down[gens])
    moves = np.divide(request, ramp, out=np.zeros(len(gens)), where=ramp > 0)
    available = np.maximum(state.gen_p_before_curtail[0], state.gen_p[0])[renewables]
    share = (available + curtailed) / state.gen_pmax[renewables]
    limits = np.where(curtailed < -_NEGLIGIBLE, np.minimum(share - 1.0, 0.0), 0.0)
    most = np.where(delivered < 0, grid.storage_max_p_absorb, grid.storage_max_p_prod)
    powers = np.divide(-delivered, most, out=np.zeros(len(delivered)), where=most > 0)
    moves[np.abs(request) < _NEGLIGIBLE] = 0.0
    powers[np.abs(delivered) < _NEGLIGIBLE] = 0.0
    action: NDArray[np.float32] = np.clip(np.concatenate((moves, limits, powers)), -1.0, 1.0).astype(np.float32)
    return action


def _anything_dispatched(state: GridState) -> bool:
    away = (state.actual_dispatch[0], state.target_dispatch[0], state.storage_power[0])
    curtailed = np.where(state.gen_renewable, state.gen_p_before_curtail[0] - state.gen_p[0], 0.0)
    return any(np.abs(values).max(initial=0.0) > _NEGLIGIBLE for values in (*away, curtailed))
