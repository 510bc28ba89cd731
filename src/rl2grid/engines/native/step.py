"""One grid step, in the order of ``grid2op.Environment.BaseEnv.step``.

:func:`begin_step` does everything up to the redispatch, :func:`finish_step` everything after it; between them
:func:`dispatch_or_lose` finds the exact dispatch (Grid2Op's own is found by SciPy, see
:mod:`rl2grid.engines.native.engine`).
"""

from __future__ import annotations

from rl2grid.compile import jit
from rl2grid.engines.native.environments import Environments, separate
from rl2grid.engines.native.generation import (
    begin_generation,
    curtail,
    decode_injection,
    dispatch,
    needs_dispatch,
    request_is_impossible,
    request_redispatch,
    set_generators,
    take_back_request,
    target_is_out_of_reach,
    use_storage,
)
from rl2grid.engines.native.hidden_state import HiddenState
from rl2grid.engines.native.observation import observe
from rl2grid.engines.native.protections import flow_with_cascade
from rl2grid.engines.native.series import begin_outages, plan_outages, read_row
from rl2grid.engines.native.topology import judge_order, merge_topology, open_line, remember_busbars, touch_nothing
from rl2grid.mdp.opponents import opponent_step
from rl2grid.mdp.state import GridState
from rl2grid.mdp.termination import GameOver, game_over_reason
from rl2grid.powerflow.ac import forget_flow
from rl2grid.structures import blank_row

_DISPATCH = int(GameOver.DISPATCH)


@separate
def reset_row(environments: Environments, i: int) -> int:
    """Show the first row of the series of environment ``i``; 1 if it has a power flow, else 0.

    Grid2Op plays a step for that: nobody acts, overloads are not counted, but lines above the hard limit trip.
    """
    begin_reset(environments, i)
    return finish_reset(environments, i, flow_with_cascade(environments, i, False))


@jit
def begin_reset(environments: Environments, i: int) -> None:
    """:func:`reset_row` up to the power flow."""
    state, hidden = environments.state, environments.hidden
    blank_row(hidden, i)
    begin_generation(environments, i)
    begin_outages(hidden, i)
    forget_flow(environments.flow, i)
    state.topo_vect[i] = 1
    state.time_before_cooldown_line[i] = 0
    state.time_before_cooldown_sub[i] = 0
    state.timestep_overflow[i] = 0
    _nobody_acts(hidden, i)
    read_row(environments, i, 0)
    plan_outages(environments, i, 0)
    use_storage(environments, i)
    curtail(environments, i)
    _open_for_maintenance(state, i)
    set_generators(environments, i)


@jit
def finish_reset(environments: Environments, i: int, has_flow: bool) -> int:
    """:func:`reset_row` from after the power flow and the cascade, which found a flow or not."""
    state, hidden = environments.state, environments.hidden
    if not has_flow:
        lose(state, i, game_over_by_flow(state, i))
        return 0
    remember_busbars(environments, i)
    hidden.setpoint[i] = hidden.new_p[i] + state.actual_dispatch[i]
    observe(environments, i)
    return 1


@jit
def begin_step(environments: Environments, i: int, refuse_impossible: bool) -> bool:
    """Play the step of environment ``i`` up to the redispatch; whether generators have to be dispatched.

    Args:
        environments: row ``i`` holds the last observation, what the last step left, and the action to be played.
        i: the row.
        refuse_impossible: make an action do nothing whose redispatch can never be carried out.
    """
    state = environments.state
    state.step[i] += 1
    play_order(environments, i, judge_order(environments, i), refuse_impossible)
    read_row(environments, i, state.step[i])
    plan_outages(environments, i, state.step[i])
    return prepare_dispatch(environments, i)


@jit
def play_order(environments: Environments, i: int, is_legal: bool, refuse_impossible: bool) -> None:
    """Merge an action that is legal and possible into the topology and the injections; of another, nothing."""
    state, hidden, injects = environments.state, environments.hidden, environments.orders.injects[i]
    plays = is_legal
    if plays and injects and refuse_impossible and request_is_impossible(environments, i):
        state.illegal[i] = True
        plays = False
    _nobody_acts(hidden, i)
    if plays and environments.orders.n_changes[i] > 0:
        merge_topology(environments, i)
    if plays and injects:
        decode_injection(environments, i)


@jit
def prepare_dispatch(environments: Environments, i: int) -> bool:
    """Storage, curtailment and the new targets; whether generators have to be dispatched."""
    state, hidden = environments.state, environments.hidden
    use_storage(environments, i)
    curtail(environments, i)
    request_redispatch(environments, i)
    if target_is_out_of_reach(state, i):
        take_back_request(environments, i)
        state.illegal[i] = True
        touch_nothing(hidden, i)
    return needs_dispatch(environments, i)


@jit
def dispatch_or_lose(environments: Environments, i: int) -> bool:
    """Find the exact dispatch of row ``i``; without one the game is over."""
    state = environments.state
    if dispatch(environments, i):
        return True
    lose_by_dispatch(state, i)
    return False


@jit
def lose_by_dispatch(state: GridState, i: int) -> None:
    """The game is over before the opponent's turn and without a power flow."""
    state.attacked[i] = False
    lose(state, i, _DISPATCH)


@jit
def finish_step(environments: Environments, i: int) -> None:
    """Play the step of environment ``i`` from after the redispatch to the observation."""
    set_scene(environments, i)
    end_step(environments, i, flow_with_cascade(environments, i, True))


@jit
def set_scene(environments: Environments, i: int) -> None:
    """Maintenance, generators and the opponent's turn: all that the power flow of row ``i`` depends on."""
    state, opponent = environments.state, environments.opponent
    _open_for_maintenance(state, i)
    set_generators(environments, i)
    opponent_step(state, opponent, i)
    state.attacked[i] = opponent.attacked[i]
    for line in range(state.attacked.shape[1]):
        if state.attacked[i, line]:
            open_line(state, i, line)
            written = opponent.cooldown_written[i, line]
            state.time_before_cooldown_line[i, line] = max(state.time_before_cooldown_line[i, line], written)


@jit
def end_step(environments: Environments, i: int, is_found: bool) -> None:
    """Register the power flow of a step; whether the episode is completed."""
    state = environments.state
    register(environments, i, is_found)
    if not state.terminated[i]:
        state.truncated[i] = state.step[i] >= state.episode_length[i]


@jit
def register(environments: Environments, i: int, is_found: bool) -> None:
    """The counters and the observation after power flow and cascade; the game over if no flow was found."""
    state, hidden = environments.state, environments.hidden
    if not is_found:
        lose(state, i, game_over_by_flow(state, i))
        return
    remember_busbars(environments, i)
    _count_down_lines(environments, i)
    _count_overloads(environments, i)
    _count_down_substations(environments, i)
    hidden.setpoint[i] = hidden.new_p[i] + state.actual_dispatch[i]
    observe(environments, i)


@jit
def game_over_by_flow(state: GridState, i: int) -> int:
    """The reason of a game over for which no power flow was found."""
    state.final_topo_vect[i] = state.topo_vect[i]
    return game_over_reason(state, i)


@jit
def lose(state: GridState, i: int, reason: int) -> None:
    """End the episode of row ``i``, and blank its observation as Grid2Op does."""
    state.terminated[i] = True
    state.game_over[i] = reason
    state.final_topo_vect[i] = state.topo_vect[i]
    blank_row(state, i)


@jit
def _nobody_acts(hidden: HiddenState, i: int) -> None:
    touch_nothing(hidden, i)
    hidden.request[i] = 0.0
    hidden.storage_request[i] = 0.0


@jit
def _open_for_maintenance(state: GridState, i: int) -> None:
    for line in range(state.time_next_maintenance.shape[1]):
        if state.time_next_maintenance[i, line] == 0:
            open_line(state, i, line)


@jit
def _count_down_lines(environments: Environments, i: int) -> None:
    """Cooldowns of lines: one step less, then what protections, maintenance and the agent impose."""
    constants, state, hidden = environments.constants, environments.state, environments.hidden
    cooldown, tripped, touched = state.time_before_cooldown_line[i], hidden.tripped[i], hidden.touched_line[i]
    maintenance = state.time_next_maintenance[i]
    any_imposed = False
    for line in range(cooldown.shape[0]):
        cooldown[line] -= cooldown[line] > 0
        any_imposed |= tripped[line] | touched[line] | (maintenance[line] == 0)
    if not any_imposed:
        return
    for line in range(cooldown.shape[0]):
        if tripped[line]:
            cooldown[line] = constants.reconnection[0]
        if maintenance[line] == 0:
            cooldown[line] = max(cooldown[line], state.duration_next_maintenance[i, line])
        if touched[line] and constants.cooldown_line[0] > 0:
            cooldown[line] = max(cooldown[line], constants.cooldown_line[0])


@jit
def _count_overloads(environments: Environments, i: int) -> None:
    state, hidden = environments.state, environments.hidden
    overflow, protection = state.timestep_overflow[i], hidden.protection[i]
    for line in range(state.a_or.shape[1]):
        is_over = state.a_or[i, line] > state.thermal_limit[line]
        overflow[line] = overflow[line] + 1 if is_over else 0
        protection[line] = protection[line] + 1 if is_over else 0


@jit
def _count_down_substations(environments: Environments, i: int) -> None:
    constants, state, hidden = environments.constants, environments.state, environments.hidden
    if constants.cooldown_sub[0] == 0:
        return
    cooldown = state.time_before_cooldown_sub[i]
    for sub in range(cooldown.shape[0]):
        if cooldown[sub] > 0:
            cooldown[sub] -= 1
        if hidden.touched_sub[i, sub]:
            cooldown[sub] = constants.cooldown_sub[0]
