"""What a step remembers beside the observed state: counters, dispatch, and where its series lies."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from rl2grid.arrays import F32, F64, I32, I64, Flags
from rl2grid.grids import Grid
from rl2grid.grids.axes import axis_sizes
from rl2grid.structures import address, allocate, episode, row, scratch

LOAD_P, LOAD_Q, PROD_P, PROD_V = range(4)
"""Columns of :attr:`HiddenState.series` and of :attr:`HiddenState.forecast`."""


class HiddenState(NamedTuple):
    """Structure of arrays of ``n`` environments. What is blank before an episode begins with it."""

    # From step to step.
    last_bus: Annotated[I32, row("topo", "busbar it is or was on last", grid2op="last_topo_registered", blank=1)]
    protection: Annotated[
        I32, row("line", "overloaded steps that the protections count", grid2op="_protection_counter", blank=0)
    ]
    modified: Annotated[Flags, row("gen", "ever redispatched", grid2op="_already_modified_gen", blank=0)]
    setpoint: Annotated[F32, row("gen", "planned in the last step", "MW", grid2op="_gen_activeprod_t_redisp", blank=0)]
    curtailed: Annotated[
        F32, row("", "curtailed in the last step, negative", "MW", grid2op="_sum_curtailment_mw_prev", blank=0)
    ]
    stored: Annotated[
        F32, row("", "that storage absorbed in the last step", "MW", grid2op="_amount_storage_prev", blank=0)
    ]

    # The last step's, looked at by simulations and what-ifs.
    gen_p: Annotated[F32, row("gen", "production set", "MW")]
    gen_v: Annotated[F64, row("gen", "voltage set-point", "per unit")]
    load_p: Annotated[F32, row("load", "demand", "MW")]
    load_q: Annotated[F32, row("load", "reactive demand", "MVAr")]

    # Within a step.
    new_p: Annotated[F32, scratch("gen", "of the series, after curtailment", "MW")]
    request: Annotated[F32, scratch("gen", "redispatch asked for", "MW")]
    storage_request: Annotated[F32, scratch("storage", "asked for, positive charges", "MW")]
    storage_change: Annotated[
        F32, scratch("", "that storage absorbs more than in the last step", "MW", grid2op="_amount_storage")
    ]
    curtailment_change: Annotated[
        F32, scratch("", "curtailed less than in the last step", "MW", grid2op="_sum_curtailment_mw")
    ]
    charge_before: Annotated[
        F32, scratch("storage", "charge before the step", "MWh", grid2op="_storage_previous_charge")
    ]
    touched_line: Annotated[Flags, scratch("line", "touched by the action played, cools down afterwards")]
    touched_sub: Annotated[Flags, scratch("sub", "touched by the action played, cools down afterwards")]
    tripped: Annotated[Flags, scratch("line", "opened by a protection in this step")]
    counted: Annotated[Flags, scratch("line", "overload counted in this step")]
    running_count: Annotated[I32, scratch("line", "protection counters during the cascade")]

    # The episode.
    series: Annotated[I64, address("4", "of the first row played; 0: none (LOAD_P, LOAD_Q, PROD_P, PROD_V)")]
    forecast: Annotated[
        I64,
        address(
            "4",
            "of the forecasts made in that row; 0: the series is what is forecast. Of training months the first is that"
            " of the handle to the ForecastModel",
        ),
    ]
    year: Annotated[I64, episode("", "seed of the training year whose integers are played; 0: no such year is")]
    month: Annotated[I32, episode("", "first month played of that year, 0 .. 11")]
    n_months: Annotated[I32, episode("", "months played of that year, in a row")]
    month_row: Annotated[I32, episode("", "row of its first month that the reset shows")]
    horizons: Annotated[I32, episode("", "that each row forecasts", "steps")]
    last_row: Annotated[I32, episode("", "whose row of the series all later steps repeat", "step")]
    outage_line: Annotated[I32, episode("outage", "planned outages, by line and begin")]
    outage_begin: Annotated[I32, episode("outage", "step at which it begins")]
    outage_end: Annotated[I32, episode("outage", "first step after it")]
    outage_count: Annotated[I32, episode("", "planned outages")]
    next_outage: Annotated[I32, row("line", "outage under way or next to come; -1 if none", blank=-1)]


def new_hidden_state(grid: Grid, n: int, outages: int) -> HiddenState:
    """A hidden state of zeros with room for ``outages`` planned outages per environment."""
    return allocate(HiddenState, axis_sizes(grid) | {"outage": outages}, n)
