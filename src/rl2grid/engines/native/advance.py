"""From one decision to the next for many environments in one call: the agent's step and the heuristic's.

The compiled counterpart of :class:`rl2grid.engines.transition.Transitions`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32
from rl2grid.compile import jit
from rl2grid.engines.native.action_notes import note_action
from rl2grid.engines.native.environments import Environments, open_environments
from rl2grid.engines.native.orders import Orders, order_one_change
from rl2grid.engines.native.side_by_side import step_side_by_side
from rl2grid.engines.native.simulation import begin_simulation, copy_environment, finish_simulation
from rl2grid.engines.native.step import dispatch_or_lose
from rl2grid.mdp.accumulate import accrue, begin_episode, begin_transition, end_reset
from rl2grid.mdp.actions import ActionKind
from rl2grid.mdp.heuristics import (
    candidate_action,
    careful_candidate,
    is_at_rest,
    is_careful_enough,
    is_safe,
    reconnect_action,
    recovery_action,
    remember_move,
    remember_nothing,
    remember_topology,
)
from rl2grid.mdp.observations import (
    write_joint_observation,
    write_redispatch_observation,
    write_topology_observation,
)
from rl2grid.mdp.operator_features import open_security
from rl2grid.mdp.rewards import default_components, paper_components, released_components, trips_components
from rl2grid.mdp.security import is_secure
from rl2grid.mdp.state import GridState
from rl2grid.memory import take_next

ALONE, IDLE, RECOVERY, RECONNECT, CAREFUL, CAREFUL_RECONNECT, SECURE, SECURE_RECONNECT = range(8)
"""Who plays between two decisions: nobody, or a heuristic (all but idle only reconnect on continuous tasks)."""

DEFAULT, PAPER, RELEASED, TRIPS = range(4)
"""Rewards that are compiled in."""

_NOTHING, _MOVE, _RESTORE = int(ActionKind.NOTHING), int(ActionKind.MOVE), int(ActionKind.RESTORE)

MOST_ABREAST = 32
"""Rows that a thread can play at the same time."""

_SPREAD = 6364136223846793005
"""Odd, and large: different topologies are unlikely to have the same key."""

Components = tuple[float, float, float]


@jit
def advance(
    address: int,
    simulated: int,
    security: int,
    rows: NDArray[np.int64],
    order: NDArray[np.int64],
    counter: NDArray[np.int64],
    abreast: int,
    begins: bool,
    first: NDArray[np.int64],
    end: NDArray[np.int64],
    kinds: NDArray[np.int64],
    targets: NDArray[np.int64],
    masks: NDArray[np.uint64],
    injects: NDArray[np.bool_],
    values: F32,
    heuristic: int,
    reward: int,
    weights: Components,
    gamma: float,
) -> None:
    """Play one transition in each of ``rows``, or in those of them that no other thread has taken.

    Args:
        address: of the handle to the :class:`~rl2grid.engines.native.environments.Environments`.
        simulated: address of a handle to one environment, in which careful heuristics try things.
        security: address of a handle to the :class:`~rl2grid.mdp.security.Security` of the thread, for those that
            look at it.
        rows: environments, int64 [k].
        order: in which they are played, int64 [k]; nothing but time depends on it. See :func:`write_topology_keys`.
        counter: int64 [1], how many of ``rows`` were taken so far, by all threads that play them together.
        abreast: how many of them to play at the same time, at most ``MOST_ABREAST``; nothing but time depends on it.
        begins: the first rows of episodes are shown; nobody acts.
        first: the first change of each agent's action, int64 [k].
        end: the change behind its last one, int64 [k].
        kinds: what each change does, an :class:`~rl2grid.mdp.actions.ActionKind`, int64 [change].
        targets: lines or substations, int64 [change].
        masks: moved elements, uint64 [change, word].
        injects: which agents inject, bool [k].
        values: their injections, float32 [k, continuous].
        heuristic: who plays until the next decision.
        reward: which reward.
        weights: of its components.
        gamma: discount between grid steps.
    """
    environments = open_environments(address)
    state, orders = environments.state, environments.orders
    under_way, status = np.empty(MOST_ABREAST, np.int64), np.empty(MOST_ABREAST, np.int64)
    is_agents_step = np.empty(MOST_ABREAST, np.bool_)
    illegal, ambiguous = np.empty(MOST_ABREAST, np.bool_), np.empty(MOST_ABREAST, np.bool_)
    n = taken = 0
    while True:
        # Heuristics play some rows a hundred times as long as others: who is done takes the next.
        while n < abreast and taken < rows.shape[0]:
            taken = take_next(np.int64(counter.ctypes.data))  # type: ignore[call-arg]
            if taken >= rows.shape[0]:
                break
            k = order[taken]
            i = rows[k]
            under_way[n], is_agents_step[n], illegal[n], ambiguous[n] = i, not begins, False, False
            if begins:
                _begin_episode(state, i, heuristic)
                if not _goes_on(environments, simulated, security, i, heuristic):
                    _hand_over(state, i, begins, False, False)
                    continue
            else:
                begin_transition(state, i)
                state.decisions[i] += 1
                _order(orders, i, k, first, end, kinds, targets, masks, injects, values)
            n += 1
        if n == 0:
            break
        step_side_by_side(environments, under_way, n, status)
        n_before, n = n, 0
        for slot in range(n_before):
            i = under_way[slot]
            _accrue(state, i, reward, weights, gamma)
            if is_agents_step[slot]:
                note_action(environments.notes, environments.constants, orders, state, i)
                illegal[slot], ambiguous[slot] = state.illegal[i], state.ambiguous[i]
            if heuristic >= CAREFUL:
                remember_topology(state, i)
                if is_agents_step[slot]:
                    _remember_moves(state, orders, i)
            if not _goes_on(environments, simulated, security, i, heuristic):
                _hand_over(state, i, begins, illegal[slot], ambiguous[slot])
                continue
            under_way[n], is_agents_step[n], illegal[n], ambiguous[n] = i, False, illegal[slot], ambiguous[slot]
            n += 1


@jit
def write_topology_keys(
    address: int,
    rows: NDArray[np.int64],
    first: NDArray[np.int64],
    end: NDArray[np.int64],
    kinds: NDArray[np.int64],
    targets: NDArray[np.int64],
    masks: NDArray[np.uint64],
    keys: NDArray[np.int64],
) -> None:
    """Write a number of each of ``rows`` that is the same where topology and action are, int64 [k].

    Played in its order, rows of one topology are played at the same time, and their power flows solved side by side.
    Arguments as of :func:`advance`.
    """
    state = open_environments(address).state
    for k in range(rows.shape[0]):
        busbar, key = state.topo_vect[rows[k]], np.int64(0)
        for element in range(busbar.shape[0]):
            key += busbar[element] * (_SPREAD * element + 1)
        for change in range(first[k], end[k]):
            key = (key + kinds[change]) * _SPREAD + targets[change]
            for word in range(masks.shape[1]):
                key = key * _SPREAD + np.int64(masks[change, word])
        keys[k] = key


@jit
def _begin_episode(state: GridState, i: int, heuristic: int) -> None:
    begin_episode(state, i)
    remember_nothing(state, i)
    if heuristic >= CAREFUL:
        remember_topology(state, i)


@jit
def _goes_on(environments: Environments, simulated: int, security: int, i: int, heuristic: int) -> bool:
    """Order the heuristic's next step in row ``i``; False if it is over, or the agent's turn."""
    state = environments.state
    if heuristic == ALONE or state.terminated[i] or state.truncated[i] or not is_safe(state, i):
        return False
    kind, target = _heuristic_action(environments, simulated, security, i, heuristic)
    if kind == _NOTHING and _asks(state, i, heuristic, security):
        return False
    order_one_change(environments.orders, i, kind, target)
    return True


@jit
def _hand_over(state: GridState, i: int, begins: bool, illegal: bool, ambiguous: bool) -> None:
    """End the transition of row ``i``; what is said of legality is the agent's action's."""
    state.illegal[i], state.ambiguous[i] = illegal, ambiguous
    if begins:
        end_reset(state, i)


@jit
def _order(
    orders: Orders,
    i: int,
    k: int,
    first: NDArray[np.int64],
    end: NDArray[np.int64],
    kinds: NDArray[np.int64],
    targets: NDArray[np.int64],
    masks: NDArray[np.uint64],
    injects: NDArray[np.bool_],
    values: F32,
) -> None:
    """Note entry ``k`` of the agents' actions as what row ``i`` is to play."""
    count = 0
    for change in range(first[k], end[k]):
        if kinds[change] == _NOTHING:
            continue
        orders.kind[i, count] = kinds[change]
        orders.target[i, count] = targets[change]
        for word in range(masks.shape[1]):
            orders.mask[i, count, word] = masks[change, word]
        count += 1
    orders.n_changes[i] = count
    orders.injects[i] = injects[k]
    if injects[k]:
        for entry in range(values.shape[1]):
            orders.injection[i, entry] = values[k, entry]


@jit
def _asks(state: GridState, i: int, heuristic: int, security: int) -> bool:
    """Whether the agent decides in row ``i``, where the grid is safe and the heuristic has nothing to do."""
    if heuristic < SECURE:
        return False
    return not (is_at_rest(state, i) and is_secure(open_security(security), state, i, state, i))


@jit
def _heuristic_action(
    environments: Environments, simulated: int, security: int, i: int, heuristic: int
) -> tuple[int, int]:
    if heuristic == RECOVERY:
        return recovery_action(environments.state, i)
    if heuristic == RECONNECT:
        return reconnect_action(environments.state, i)
    if heuristic >= CAREFUL:
        return _careful_action(environments, simulated, security, i, heuristic)
    return _NOTHING, 0


@jit
def _careful_action(
    environments: Environments, simulated: int, security: int, i: int, heuristic: int
) -> tuple[int, int]:
    """The first candidate that the forecast allows; else nothing."""
    state = environments.state
    only_lines = heuristic in (CAREFUL_RECONNECT, SECURE_RECONNECT)
    candidate = careful_candidate(state, i, 0)
    while candidate >= 0 and not (only_lines and candidate >= state.line_status.shape[1]):
        kind, target = candidate_action(state, candidate)
        trial = open_environments(simulated)
        if _forecast_allows(environments, trial, i, kind, target) and (
            heuristic < SECURE or kind != _RESTORE or is_secure(open_security(security), state, i, trial.state, 0)
        ):
            return kind, target
        candidate = careful_candidate(state, i, candidate + 1)
    return _NOTHING, 0


@jit
def _forecast_allows(environments: Environments, trial: Environments, i: int, kind: int, target: int) -> bool:
    """Whether the careful heuristic may play an action in row ``i``; tried in row 0 of ``trial``."""
    copy_environment(environments, i, trial, 0)
    order_one_change(trial.orders, 0, kind, target)
    if begin_simulation(trial, environments, i, 1, True) and not dispatch_or_lose(trial, 0):
        return False
    finish_simulation(trial)
    return is_careful_enough(trial.state, 0)


@jit
def _remember_moves(state: GridState, orders: Orders, i: int) -> None:
    """Note the substations that the agent has changed in row ``i``."""
    if state.illegal[i] or state.ambiguous[i]:
        return
    for change in range(orders.n_changes[i]):
        if orders.kind[i, change] == _MOVE:
            remember_move(state, i, orders.target[i, change])


@jit
def _accrue(state: GridState, i: int, reward: int, weights: Components, gamma: float) -> None:
    """What the grid step that row ``i`` has made is worth."""
    survive, overload, cost = _components(state, i, reward)
    accrue(state, i, survive, overload, cost, weights, gamma)


@jit
def _components(state: GridState, i: int, reward: int) -> Components:
    if reward == PAPER:
        return paper_components(state, i)
    if reward == RELEASED:
        return released_components(state, i)
    if reward == TRIPS:
        return trips_components(state, i)
    return default_components(state, i)


@jit
def write_observations(
    address: int, rows: NDArray[np.int64], topology: bool, dispatch: bool, shift: F32, scale: F32, out: F32
) -> None:
    """Write the observations of ``rows`` to the same rows of ``out``, float32 [n, feature].

    Args:
        address: of the handle to the :class:`~rl2grid.engines.native.environments.Environments`.
        rows: environments, int64 [k].
        topology: whether the topology is observed.
        dispatch: whether the dispatch is observed.
        shift: float32 [feature], subtracted.
        scale: float32 [feature], divided by after that.
        out: the observations; what lies behind these features stays.
    """
    state = open_environments(address).state
    for i in rows:
        observation = out[i]
        if topology and dispatch:
            write_joint_observation(state, i, observation)
        elif topology:
            write_topology_observation(state, i, observation)
        else:
            write_redispatch_observation(state, i, observation)
        for entry in range(shift.shape[0]):
            observation[entry] = (observation[entry] - shift[entry]) / scale[entry]
