"""What continuous actions can do, in MW: shared by the agents that plan redispatch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.agent import Action, has_injections, injecting_action
from rl2grid.arrays import F64
from rl2grid.errors import UsageError
from rl2grid.grids import STEPS_PER_HOUR, Grid
from rl2grid.handles import AsOpened
from rl2grid.mdp.actions import continuous_layout
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.model import load_network

_CURTAILMENT_PRICE = 10.0
_STORAGE_PRICE = 5.0
_REDISPATCH_PRICE = 1.0
"""Price per MW curtailed, stored or redispatched (times the relative cost of the generator)."""
_NEGLIGIBLE = 0.01
"""MW of dispatch, curtailment or storage that is as good as none."""


REQUESTS_COUNTED = {"R": 2, "H": 2}
"""Second rules of all that dispatch: the first request to a generator is added to what it was given to balance."""


class Control(NamedTuple):
    """Something that injects power: how much it injects now, may inject in the next step, and what that costs."""

    now: F64  # [control] MW
    least: F64  # [control] MW
    most: F64  # [control] MW
    at_rest: F64  # [control] MW at which it costs nothing
    price: F64  # [control] per MW away from rest


class DispatchAgent:
    """What agents that plan redispatch on the DC flow have in common: the grid and its electrical model."""

    kinds = ("R", "H")
    rules: ClassVar[Mapping[str, int]] = REQUESTS_COUNTED
    refusal: ClassVar[str]
    """What is said of tasks without continuous actions."""

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Look up the electrical model of the grid.

        Raises:
            UsageError: the task has no continuous actions.
        """
        if not has_injections(env.action_space):
            raise UsageError(self.refusal)
        base: Any = env.unwrapped
        self._env, self._space = base, env.action_space
        self._opened: AsOpened[GridState] = AsOpened()
        self._topology = 0
        self._grid: Grid = base.grid
        self._network = load_network(self._grid)
        self._nothing = np.zeros(continuous_layout(self._grid).size, np.float32)

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def _as_action(self, values: NDArray[np.float32]) -> Action:
        """The action that injects ``values``; on joint tasks with the topology action that was chosen before."""
        return injecting_action(self._space, values, self._topology)

    def _worst_loading(self, values: NDArray[np.float32]) -> float:
        """What :func:`worst_loading` foresees of that action."""
        return worst_loading(self._env, self._as_action(values))


def controls(state: GridState, grid: Grid) -> Control:
    """What the continuous actions can do in the next step of row 0, in the order of their entries.

    A generator injects its actual dispatch, a renewable minus what it is curtailed by, a storage unit minus its power.
    Generators keep to ramps, limits and, for what the next request can ask for, targets within one ramp.
    """
    layout = continuous_layout(grid)
    gens, renewables, units = layout.redispatch, layout.curtail, layout.storage
    dispatch, base = state.actual_dispatch[0][gens].astype(np.float64), requested_from(state, gens)
    up = np.minimum(state.gen_max_ramp_up[gens], state.gen_margin_up[0][gens])
    down = np.minimum(state.gen_max_ramp_down[gens], state.gen_margin_down[0][gens])
    reach = (state.gen_pmax - state.gen_pmin)[gens]
    least = np.maximum.reduce([dispatch - down, base - state.gen_max_ramp_down[gens], -reach])
    most = np.minimum.reduce([dispatch + up, base + state.gen_max_ramp_up[gens], reach])
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


def requested_from(state: GridState, gens: NDArray[np.int32]) -> F64:
    """What a request to each generator is added to, MW, float64 [gen]: its target.

    The first one is added to what the generator was given to balance others: it has no target yet, which shows as 0.
    """
    target, actual = (x[0][gens].astype(np.float64) for x in (state.target_dispatch, state.actual_dispatch))
    base: F64 = np.where(target == 0.0, actual, target)
    return base


def encode(state: GridState, grid: Grid, planned: F64) -> NDArray[np.float32]:
    """The continuous action that asks for what was planned, as far as a step can, float32 [continuous]."""
    action: NDArray[np.float32] = np.clip(encode_all(state, grid, planned), -1.0, 1.0)
    return action


def encode_all(state: GridState, grid: Grid, planned: F64) -> NDArray[np.float32]:
    """What :func:`encode` clips: requests to generators beyond 1 are more than the ramp of a step."""
    layout = continuous_layout(grid)
    gens, renewables = layout.redispatch, layout.curtail
    dispatch, curtailed, delivered = np.split(planned, [len(gens), len(gens) + len(renewables)])
    request = dispatch - requested_from(state, gens)
    ramp = np.where(request > 0, state.gen_max_ramp_up[gens], state.gen_max_ramp_down[gens])
    moves = np.divide(request, ramp, out=np.zeros(len(gens)), where=ramp > 0)
    available = np.maximum(state.gen_p_before_curtail[0], state.gen_p[0])[renewables]
    share = (available + curtailed) / state.gen_pmax[renewables]
    limits = np.where(curtailed < -_NEGLIGIBLE, np.minimum(share - 1.0, 0.0), 0.0)
    most = np.where(delivered < 0, grid.storage_max_p_absorb, grid.storage_max_p_prod)
    powers = np.divide(-delivered, most, out=np.zeros(len(delivered)), where=most > 0)
    moves[np.abs(request) < _NEGLIGIBLE] = 0.0
    powers[np.abs(delivered) < _NEGLIGIBLE] = 0.0
    within = np.clip(np.concatenate((limits, powers)), -1.0, 1.0)
    return np.concatenate((moves, within)).astype(np.float32)


def anything_dispatched(state: GridState) -> bool:
    """Whether a generator is redispatched or curtailed, or a storage unit in use, in row 0."""
    away = (state.actual_dispatch[0], state.target_dispatch[0], state.storage_power[0])
    curtailed = np.where(state.gen_renewable, state.gen_p_before_curtail[0] - state.gen_p[0], 0.0)
    return any(np.abs(values).max(initial=0.0) > _NEGLIGIBLE for values in (*away, curtailed))


def control_positions(grid: Grid) -> NDArray[np.int32]:
    """Entry of ``topo_vect`` at which each control injects, int32 [control]."""
    layout = continuous_layout(grid)
    gens = np.concatenate((layout.redispatch, layout.curtail))
    return np.concatenate((grid.gen_pos_topo_vect[gens], grid.storage_pos_topo_vect[layout.storage])).astype(np.int32)


def worst_loading(env: Any, action: Action) -> float:
    """The largest loading that :meth:`PowerGridEnv.simulate` foresees; infinite where the game would be lost."""
    return _loading_of(env, env.simulate(action))


def worst_loading_if_legal(env: Any, action: Action) -> float:
    """The same; infinite as well where the action would be refused, of which nothing is foreseen."""
    result = env.simulate(action)
    return np.inf if result.info["illegal"] else _loading_of(env, result)


def _loading_of(env: Any, result: Any) -> float:
    return np.inf if result.terminated else float(result.observation[env.observation_slices["rho"]].max())
