"""Storage, curtailment and redispatch within a step (Grid2Op's ``StorageModule``, ``CurtailmentModule``).

Single precision, operation by operation as in Grid2Op, so that both agree on what is feasible.
"""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import F32
from rl2grid.compile import jit
from rl2grid.engines.dispatch import (
    NEGLIGIBLE,
    add_request,
    dispatch_is_needed,
    find_dispatch,
    redispatch_is_impossible,
    rounded_sum,
)
from rl2grid.engines.native.constants import INITIAL_CHARGE
from rl2grid.engines.native.environments import Environments
from rl2grid.mdp.state import GridState

_FULL = np.float32(1.0)
_NONE = np.float32(0.0)


@jit
def begin_generation(environments: Environments, i: int) -> None:
    """Dispatch, limits and charge of row ``i`` as a reset finds them."""
    constants, state = environments.constants, environments.state
    state.target_dispatch[i] = 0.0
    state.actual_dispatch[i] = 0.0
    state.curtailment_limit[i] = 1.0
    state.gen_p_before_curtail[i] = 0.0
    state.storage_power[i] = 0.0
    state.storage_power_target[i] = 0.0
    for unit in range(constants.storage_emax.shape[0]):
        lost = constants.storage_loss[unit] * constants.hours_per_step[0]
        state.storage_charge[i, unit] = INITIAL_CHARGE * constants.storage_emax[unit] + lost


@jit
def decode_injection(environments: Environments, i: int) -> None:
    """Write what the injection asks for: redispatch, curtailment limits, storage.

    :func:`rl2grid.mdp.actions.decode_continuous`, compiled; limits go into effect at once.
    """
    constants, state, hidden = environments.constants, environments.state, environments.hidden
    values = environments.orders.injection[i]
    entry = 0
    for gen in constants.redispatch_gen:
        ramp = state.gen_max_ramp_up[gen] if values[entry] > 0 else state.gen_max_ramp_down[gen]
        hidden.request[i, gen] = values[entry] * ramp
        entry += 1
    for gen in constants.curtail_gen:
        state.curtailment_limit[i, gen] = _FULL + min(values[entry], _NONE)
        entry += 1
    for unit in range(constants.storage_emax.shape[0]):
        most = constants.storage_max_p_absorb[unit] if values[entry] > 0 else constants.storage_max_p_prod[unit]
        hidden.storage_request[i, unit] = values[entry] * most
        entry += 1


@jit
def request_is_impossible(environments: Environments, i: int) -> bool:
    """Whether the redispatch of the injection can never be carried out; writes ``request``."""
    constants, state, hidden = environments.constants, environments.state, environments.hidden
    values = environments.orders.injection[i]
    hidden.request[i] = 0.0
    for entry in range(constants.redispatch_gen.shape[0]):
        gen = constants.redispatch_gen[entry]
        ramp = state.gen_max_ramp_up[gen] if values[entry] > 0 else state.gen_max_ramp_down[gen]
        hidden.request[i, gen] = values[entry] * ramp
    return redispatch_is_impossible(
        hidden.request[i],
        state.target_dispatch[i],
        state.actual_dispatch[i],
        hidden.modified[i],
        state.gen_pmin,
        state.gen_pmax,
    )


@jit
def use_storage(environments: Environments, i: int) -> None:
    """Charge and discharge as asked for in ``storage_request``, within what the units hold."""
    constants, state, hidden = environments.constants, environments.state, environments.hidden
    hours = constants.hours_per_step[0]
    hidden.charge_before[i] = state.storage_charge[i]
    in_use = False
    for unit in range(constants.storage_emax.shape[0]):
        power = hidden.storage_request[i, unit]
        state.storage_power_target[i, unit] = 0.0
        state.storage_power[i, unit] = 0.0
        if abs(power) < NEGLIGIBLE:
            continue
        in_use = True
        # Grid2Op multiplies by a double-precision efficiency here.
        efficiency = np.float64(constants.storage_charging_efficiency[unit])
        if power < 0:
            efficiency = 1.0 / np.float64(constants.storage_discharging_efficiency[unit])
        energy = np.float64(power * hours) * efficiency
        state.storage_charge[i, unit] = np.float32(np.float64(state.storage_charge[i, unit]) + energy)
        state.storage_power_target[i, unit] = power
        state.storage_power[i, unit] = power
    if in_use:
        for unit in range(constants.storage_emax.shape[0]):
            _keep_within_capacity(environments, i, unit)
    absorbed = rounded_sum(state.storage_power[i], constants.storage_emax.shape[0]) if in_use else _NONE
    hidden.storage_change[i] = absorbed - hidden.stored[i]
    hidden.stored[i] = absorbed
    lose_charge(environments, i)


@jit
def _keep_within_capacity(environments: Environments, i: int, unit: int) -> None:
    constants, state = environments.constants, environments.state
    per_hour = _FULL / constants.hours_per_step[0]
    too_much = state.storage_charge[i, unit] - constants.storage_emax[unit]
    if too_much > 0:
        state.storage_power[i, unit] -= per_hour * too_much / constants.storage_charging_efficiency[unit]
        state.storage_charge[i, unit] = constants.storage_emax[unit]
    too_little = state.storage_charge[i, unit] - constants.storage_emin[unit]
    if too_little < 0:
        state.storage_power[i, unit] -= per_hour * too_little * constants.storage_discharging_efficiency[unit]
        state.storage_charge[i, unit] = constants.storage_emin[unit]


@jit
def lose_charge(environments: Environments, i: int) -> None:
    """Withdraw what storage units lose in a step."""
    constants, state = environments.constants, environments.state
    for unit in range(constants.storage_emax.shape[0]):
        left = state.storage_charge[i, unit] - constants.storage_loss[unit] * constants.hours_per_step[0]
        state.storage_charge[i, unit] = max(left, _NONE)


@jit
def curtail(environments: Environments, i: int) -> None:
    """Hold renewables to their limits: lowers ``new_p``, notes the change of the curtailed power."""
    state, hidden = environments.state, environments.hidden
    new_p, before = hidden.new_p[i], state.gen_p_before_curtail[i]
    is_limited = False
    for gen in range(new_p.shape[0]):
        if state.gen_renewable[gen]:
            before[gen] = new_p[gen]
            is_limited |= not abs(state.curtailment_limit[i, gen] - _FULL) < NEGLIGIBLE
    curtailed = _hold_to_limits(state, i, new_p, before) if is_limited else _NONE
    hidden.curtailment_change[i] = curtailed - hidden.curtailed[i]
    hidden.curtailed[i] = curtailed


@jit
def _hold_to_limits(state: GridState, i: int, new_p: F32, before: F32) -> np.float32:
    """Lower ``new_p`` [gen] to the limits; the change of the production, MW, 0 or negative."""
    limited = np.empty((2, new_p.shape[0]), np.float32)
    count = 0
    for gen in range(new_p.shape[0]):
        limit = state.curtailment_limit[i, gen]
        if not state.gen_renewable[gen] or abs(limit - _FULL) < NEGLIGIBLE:
            continue
        new_p[gen] = min(state.gen_pmax[gen] * limit, new_p[gen])
        limited[0, count] = new_p[gen]
        limited[1, count] = before[gen]
        count += 1
    return rounded_sum(limited[0], count) - rounded_sum(limited[1], count)


@jit
def request_redispatch(environments: Environments, i: int) -> None:
    """Add the redispatch asked for in ``request`` to the targets."""
    state, hidden = environments.state, environments.hidden
    add_request(hidden.request[i], state.target_dispatch[i], state.actual_dispatch[i], hidden.modified[i])


@jit
def target_is_out_of_reach(state: GridState, i: int) -> bool:
    """Whether a target lies further from zero than a generator's range from pmin to pmax."""
    for gen in range(state.gen_pmax.shape[0]):
        target, widest = state.target_dispatch[i, gen], state.gen_pmax[gen] - state.gen_pmin[gen]
        if target > widest or target < -widest:
            return True
    return False


@jit
def take_back_request(environments: Environments, i: int) -> None:
    """What Grid2Op does about an impossible redispatch: the targets are restored, and storage goes wrong.

    Its charge is restored while its power still flows, and the balance counts it anew.
    """
    constants, state, hidden = environments.constants, environments.state, environments.hidden
    for gen in range(state.gen_pmax.shape[0]):
        state.target_dispatch[i, gen] -= hidden.request[i, gen]
    if constants.storage_emax.shape[0] == 0:
        return
    state.storage_charge[i] = hidden.charge_before[i]
    hidden.storage_change[i] -= hidden.stored[i]
    lose_charge(environments, i)


@jit
def needs_dispatch(environments: Environments, i: int) -> bool:
    """Whether the generators have to be dispatched in this step."""
    state, hidden = environments.state, environments.hidden
    return dispatch_is_needed(
        state.actual_dispatch[i], state.target_dispatch[i], hidden.storage_change[i], hidden.curtailment_change[i]
    )


@jit
def dispatch(environments: Environments, i: int) -> bool:
    """Find the exact dispatch; False, a game over, if there is none."""
    state, hidden = environments.state, environments.hidden
    power = np.float64(hidden.storage_change[i]) - np.float64(hidden.curtailment_change[i])
    return find_dispatch(
        hidden.new_p[i],
        hidden.setpoint[i],
        state.target_dispatch[i],
        state.actual_dispatch[i],
        hidden.modified[i],
        state.gen_pmin,
        state.gen_pmax,
        state.gen_max_ramp_up,
        state.gen_max_ramp_down,
        state.gen_redispatchable,
        power,
        state.actual_dispatch[i],
    )


@jit
def set_generators(environments: Environments, i: int) -> None:
    """The production that the generators are set to: the series' plus the dispatch."""
    state, hidden = environments.state, environments.hidden
    for gen in range(hidden.new_p.shape[1]):
        dispatched = state.actual_dispatch[i, gen]
        hidden.gen_p[i, gen] = hidden.new_p[i, gen]
        if abs(dispatched) >= NEGLIGIBLE:
            hidden.gen_p[i, gen] += dispatched
