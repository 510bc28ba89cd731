"""What a step remembers beside the observed state: counters, dispatch, and where its series lies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.mdp.state import F32, F64, I32, Flags

I64 = NDArray[np.int64]

LOAD_P, LOAD_Q, PROD_P, PROD_V = range(4)
"""Columns of :attr:`HiddenState.series` and of :attr:`HiddenState.forecast`."""


class HiddenState(NamedTuple):
    """Structure of arrays of ``n`` environments; shapes in brackets, Grid2Op's attribute in parentheses."""

    # From step to step.
    last_bus: I32  # [n, topo] busbar each element is on or was on last (last_topo_registered)
    protection: I32  # [n, line] overloaded steps counted by the protections (_protection_counter)
    modified: Flags  # [n, gen] ever redispatched (_already_modified_gen)
    setpoint: F32  # [n, gen] MW planned in the last step (_gen_activeprod_t_redisp)
    curtailed: F32  # [n] MW curtailed in the last step, negative (_sum_curtailment_mw_prev)
    stored: F32  # [n] MW that storage absorbed in the last step (_amount_storage_prev)
    charge_before: F32  # [n, storage] MWh before the step (_storage_previous_charge)

    # Within a step.
    new_p: F32  # [n, gen] MW of the series, after curtailment
    gen_p: F32  # [n, gen] MW set
    gen_v: F64  # [n, gen] voltage set-points, per unit
    load_p: F32  # [n, load] MW
    load_q: F32  # [n, load] MVAr
    request: F32  # [n, gen] MW of redispatch asked for
    storage_request: F32  # [n, storage] MW asked for, positive charges
    storage_change: F32  # [n] MW that storage absorbs more than in the last step (_amount_storage)
    curtailment_change: F32  # [n] MW curtailed less than in the last step (_sum_curtailment_mw)
    changed_line: I32  # [n] line that the agent's action touches, -1 if none
    changed_sub: I32  # [n] substation that it touches, -1 if none
    tripped: Flags  # [n, line] opened by a protection in this step
    counted: Flags  # [n, line] overload counted in this step
    running_count: I32  # [n, line] protection counters during the cascade
    final_storage_power: F32  # [n, storage] MW in the step of a game over

    # The episode.
    series: I64  # [n, 4] address of the first row played; 0: none (LOAD_P, LOAD_Q, PROD_P, PROD_V)
    forecast: I64  # [n, 4] address of the forecasts made in that row
    horizons: I32  # [n] steps that each row forecasts
    outage_line: I32  # [n, outage] planned outages, by line and begin
    outage_begin: I32  # [n, outage] step at which it begins
    outage_end: I32  # [n, outage] first step after it
    outage_count: I32  # [n]
    next_outage: I32  # [n, line] outage under way or next to come; -1 if none


def new_hidden_state(grid: Grid, n: int, outages: int) -> HiddenState:
    """A blank hidden with room for ``outages`` planned outages per environment."""
    line, gen, load, storage, topo = grid.n_line, grid.n_gen, grid.n_load, grid.n_storage, grid.dim_topo

    def floats(*shape: int) -> F32:
        return np.zeros((n, *shape), np.float32)

    def ints(*shape: int) -> I32:
        return np.zeros((n, *shape), np.int32)

    def flags(*shape: int) -> Flags:
        return np.zeros((n, *shape), np.bool_)

    return HiddenState(
        last_bus=ints(topo),
        protection=ints(line),
        modified=flags(gen),
        setpoint=floats(gen),
        curtailed=floats(),
        stored=floats(),
        charge_before=floats(storage),
        new_p=floats(gen),
        gen_p=floats(gen),
        gen_v=np.zeros((n, gen), np.float64),
        load_p=floats(load),
        load_q=floats(load),
        request=floats(gen),
        storage_request=floats(storage),
        storage_change=floats(),
        curtailment_change=floats(),
        changed_line=ints(),
        changed_sub=ints(),
        tripped=flags(line),
        counted=flags(line),
        running_count=ints(line),
        final_storage_power=floats(storage),
        series=np.zeros((n, 4), np.int64),
        forecast=np.zeros((n, 4), np.int64),
        horizons=ints(),
        outage_line=ints(outages),
        outage_begin=ints(outages),
        outage_end=ints(outages),
        outage_count=ints(),
        next_outage=ints(line),
    )


@jit
def begin_hidden_state(hidden: HiddenState, i: int) -> None:
    """Forget the last episode of row ``i``; series and outages are the engine's to set."""
    hidden.last_bus[i] = 1
    hidden.protection[i] = 0
    hidden.modified[i] = False
    hidden.setpoint[i] = 0.0
    hidden.curtailed[i] = 0.0
    hidden.stored[i] = 0.0
