"""One grid step, in the order of ``grid2op.Environment.BaseEnv.step``.

:func:`begin_step` does everything up to the redispatch, :func:`finish_step` everything after it; between them
:func:`dispatch_or_lose` finds the exact dispatch (Grid2Op's own is found by SciPy, see
:mod:`rl2grid.engines.native.engine`).
"""

from __future__ import annotations

from rl2grid.compile import jit
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
from rl2grid.engines.native.memory import Memory, begin_memory
from rl2grid.engines.native.observation import blank_row, observe
from rl2grid.engines.native.plant import Plant
from rl2grid.engines.native.protections import flow_with_cascade
from rl2grid.engines.native.series import begin_outages, plan_outages, read_row
from rl2grid.engines.native.topology import act_on_topology, open_line, remember_busbars
from rl2grid.mdp.actions import ActionKind
from rl2grid.mdp.opponents import OpponentState, opponent_step
from rl2grid.mdp.state import F32, GridState
from rl2grid.mdp.termination import GameOver, game_over_reason
from rl2grid.powerflow.ac import FlowState, forget_flow
from rl2grid.powerflow.model import Network

_INJECTION = int(ActionKind.INJECTION)
_DISPATCH = int(GameOver.DISPATCH)


@jit
def reset_row(plant: Plant, network: Network, state: GridState, memory: Memory, flow: FlowState, i: int) -> None:
    """Show the first row of the series of environment ``i``.

    Grid2Op plays a step for that: nobody acts, overloads are not counted, but lines above the hard limit trip.
    """
    begin_memory(memory, i)
    begin_generation(plant, state, memory, i)
    begin_outages(memory, i)
    forget_flow(flow, i)
    state.topo_vect[i] = 1
    state.time_before_cooldown_line[i] = 0
    state.time_before_cooldown_sub[i] = 0
    state.timestep_overflow[i] = 0
    _nobody_acts(memory, i)
    read_row(memory, network, i, 0)
    plan_outages(memory, state, i, 0)
    use_storage(plant, state, memory, i)
    curtail(plant, state, memory, i)
    _open_for_maintenance(state, i)
    set_generators(state, memory, i)
    if not flow_with_cascade(plant, network, state, memory, flow, i, False):
        lose(state, i, game_over_by_flow(state, i))
        return
    remember_busbars(state, memory, i)
    memory.setpoint[i] = memory.new_p[i] + state.actual_dispatch[i]
    observe(network, state, memory, flow, i)


@jit
def begin_step(
    plant: Plant,
    network: Network,
    state: GridState,
    memory: Memory,
    i: int,
    kind: int,
    target: int,
    mask: int,
    values: F32,
    refuse_impossible: bool,
) -> bool:
    """Play the step of environment ``i`` up to the redispatch; whether generators have to be dispatched.

    Args:
        plant: constants of the grid.
        network: the electrical model.
        state: row ``i`` holds the last observation.
        memory: row ``i`` holds what the last step left.
        i: the row.
        kind: an :class:`~rl2grid.mdp.actions.ActionKind`.
        target: line or substation.
        mask: moved elements.
        values: float32 [continuous], read if ``kind`` is INJECTION.
        refuse_impossible: make an action do nothing whose redispatch can never be carried out.
    """
    state.step[i] += 1
    act_on_topology(state, memory, i, kind, target, mask)
    injects = kind == _INJECTION
    if injects and refuse_impossible and request_is_impossible(plant, state, memory, i, values):
        state.illegal[i] = True
        injects = False
    nobody_injects(memory, i)
    if injects:
        decode_injection(plant, state, memory, i, values)
    read_row(memory, network, i, state.step[i])
    plan_outages(memory, state, i, state.step[i])
    return prepare_dispatch(plant, state, memory, i)


@jit
def prepare_dispatch(plant: Plant, state: GridState, memory: Memory, i: int) -> bool:
    """Storage, curtailment and the new targets; whether generators have to be dispatched."""
    use_storage(plant, state, memory, i)
    curtail(plant, state, memory, i)
    request_redispatch(state, memory, i)
    if target_is_out_of_reach(state, i):
        take_back_request(plant, state, memory, i)
        state.illegal[i] = True
        memory.changed_line[i] = -1
        memory.changed_sub[i] = -1
    return needs_dispatch(state, memory, i)


@jit
def dispatch_or_lose(state: GridState, memory: Memory, i: int) -> bool:
    """Find the exact dispatch of row ``i``; without one the game is over."""
    if dispatch(state, memory, i):
        return True
    lose_by_dispatch(state, i)
    return False


@jit
def lose_by_dispatch(state: GridState, i: int) -> None:
    """The game is over before the opponent's turn and without a power flow."""
    state.attacked[i] = False
    lose(state, i, _DISPATCH)


@jit
def finish_step(
    plant: Plant,
    network: Network,
    state: GridState,
    memory: Memory,
    flow: FlowState,
    opponent: OpponentState,
    i: int,
) -> None:
    """Play the step of environment ``i`` from after the redispatch to the observation."""
    _open_for_maintenance(state, i)
    set_generators(state, memory, i)
    opponent_step(state, opponent, i)
    state.attacked[i] = opponent.attacked[i]
    for line in range(state.attacked.shape[1]):
        if state.attacked[i, line]:
            open_line(state, i, line)
            written = opponent.cooldown_written[i, line]
            state.time_before_cooldown_line[i, line] = max(state.time_before_cooldown_line[i, line], written)
    run_and_register(plant, network, state, memory, flow, i)
    if not state.terminated[i]:
        state.truncated[i] = state.step[i] >= state.episode_length[i]


@jit
def run_and_register(plant: Plant, network: Network, state: GridState, memory: Memory, flow: FlowState, i: int) -> None:
    """Power flow and cascade, then the counters and the observation; or the game over."""
    if not flow_with_cascade(plant, network, state, memory, flow, i, True):
        lose(state, i, game_over_by_flow(state, i))
        return
    remember_busbars(state, memory, i)
    _count_down_lines(plant, state, memory, i)
    _count_overloads(state, memory, i)
    _count_down_substations(plant, state, memory, i)
    memory.setpoint[i] = memory.new_p[i] + state.actual_dispatch[i]
    observe(network, state, memory, flow, i)


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
def _nobody_acts(memory: Memory, i: int) -> None:
    memory.changed_line[i] = -1
    memory.changed_sub[i] = -1
    nobody_injects(memory, i)


@jit
def nobody_injects(memory: Memory, i: int) -> None:
    memory.request[i] = 0.0
    memory.storage_request[i] = 0.0


@jit
def _open_for_maintenance(state: GridState, i: int) -> None:
    for line in range(state.time_next_maintenance.shape[1]):
        if state.time_next_maintenance[i, line] == 0:
            open_line(state, i, line)


@jit
def _count_down_lines(plant: Plant, state: GridState, memory: Memory, i: int) -> None:
    """Cooldowns of lines: one step less, then what protections, maintenance and the agent impose."""
    cooldown = state.time_before_cooldown_line[i]
    for line in range(cooldown.shape[0]):
        if cooldown[line] > 0:
            cooldown[line] -= 1
        if memory.tripped[i, line]:
            cooldown[line] = plant.reconnection[0]
        if state.time_next_maintenance[i, line] == 0:
            cooldown[line] = max(cooldown[line], state.duration_next_maintenance[i, line])
    changed = memory.changed_line[i]
    if changed >= 0 and plant.cooldown_line[0] > 0:
        cooldown[changed] = max(cooldown[changed], plant.cooldown_line[0])


@jit
def _count_overloads(state: GridState, memory: Memory, i: int) -> None:
    for line in range(state.a_or.shape[1]):
        if state.a_or[i, line] > state.thermal_limit[line]:
            state.timestep_overflow[i, line] += 1
            memory.protection[i, line] += 1
        else:
            state.timestep_overflow[i, line] = 0
            memory.protection[i, line] = 0


@jit
def _count_down_substations(plant: Plant, state: GridState, memory: Memory, i: int) -> None:
    if plant.cooldown_sub[0] == 0:
        return
    cooldown = state.time_before_cooldown_sub[i]
    for sub in range(cooldown.shape[0]):
        if cooldown[sub] > 0:
            cooldown[sub] -= 1
    changed = memory.changed_sub[i]
    if changed >= 0:
        cooldown[changed] = plant.cooldown_sub[0]
