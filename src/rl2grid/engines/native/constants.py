"""Constants of a grid that the rules of a step read, beside those in the state and in the network."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import numpy as np

from rl2grid.arrays import F32, I32
from rl2grid.grids import STEPS_PER_HOUR, Grid
from rl2grid.mdp.actions import continuous_layout
from rl2grid.structures import allocate, constant

INITIAL_CHARGE = np.float32(0.5)
"""Share of a storage unit's capacity that is charged at a reset (``Parameters.INIT_STORAGE_CAPACITY``)."""


class GridConstants(NamedTuple):
    """Rules of a grid, its storage, and the continuous action. Names are Grid2Op's where it has the attribute."""

    cooldown_line: Annotated[I32, constant("1", "after an action on a line", "steps")]
    cooldown_sub: Annotated[I32, constant("1", "after an action on a substation", "steps")]
    reconnection: Annotated[I32, constant("1", "after a protection has opened a line", "steps")]
    overflow_allowed: Annotated[I32, constant("1", "that a line may be overloaded", "steps")]
    hard_limit: Annotated[F32, constant("line", "current above which a line trips at once", "A")]
    hours_per_step: Annotated[F32, constant("1", "duration of a step", "hours")]
    storage_emax: Annotated[F32, constant("storage", "largest charge", "MWh")]
    storage_emin: Annotated[F32, constant("storage", "smallest charge", "MWh")]
    storage_max_p_prod: Annotated[F32, constant("storage", "largest discharge", "MW")]
    storage_max_p_absorb: Annotated[F32, constant("storage", "largest absorption", "MW")]
    storage_charging_efficiency: Annotated[F32, constant("storage", "share that is stored")]
    storage_discharging_efficiency: Annotated[F32, constant("storage", "share that comes out")]
    storage_loss: Annotated[F32, constant("storage", "loss", "MW")]
    redispatch_gen: Annotated[I32, constant("redispatch", "generators of the continuous action's redispatch")]
    curtail_gen: Annotated[I32, constant("curtail", "generators of its curtailment")]


def new_constants(grid: Grid) -> GridConstants:
    """The constants of ``grid``."""
    rules, layout = grid.rules, continuous_layout(grid)
    steps = ("cooldown_line", "cooldown_sub", "reconnection", "overflow_allowed")
    given: dict[str, Any] = {name: np.array([getattr(rules, name)], np.int32) for name in steps}
    given |= {name: getattr(grid, name) for name in GridConstants._fields if name.startswith("storage_")}
    return allocate(
        GridConstants,
        {},
        hard_limit=np.float32(rules.hard_overflow) * grid.thermal_limit,
        hours_per_step=np.array([1.0 / STEPS_PER_HOUR], np.float32),
        redispatch_gen=layout.redispatch,
        curtail_gen=layout.curtail,
        **given,
    )
