"""Constants of a grid that the rules of a step read, beside those in the state and in the network."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rl2grid.grids import STEPS_PER_HOUR, Grid
from rl2grid.mdp.actions import continuous_layout
from rl2grid.mdp.state import F32, I32

INITIAL_CHARGE = np.float32(0.5)
"""Share of a storage unit's capacity that is charged at a reset (``Parameters.INIT_STORAGE_CAPACITY``)."""


class GridConstants(NamedTuple):
    """Arrays without environment axis; shapes in brackets. Names are Grid2Op's where it has the attribute."""

    cooldown_line: I32  # [1] steps
    cooldown_sub: I32  # [1] steps
    reconnection: I32  # [1] steps
    overflow_allowed: I32  # [1] steps
    hard_limit: F32  # [line] A above which a line trips at once
    hours_per_step: F32  # [1]
    storage_emax: F32  # [storage] MWh
    storage_emin: F32  # [storage] MWh
    storage_max_p_prod: F32  # [storage] MW
    storage_max_p_absorb: F32  # [storage] MW
    storage_charging_efficiency: F32  # [storage]
    storage_discharging_efficiency: F32  # [storage]
    storage_loss: F32  # [storage] MW
    redispatch_gen: I32  # [entry] generators of the continuous action's redispatch
    curtail_gen: I32  # [entry] generators of its curtailment


def new_constants(grid: Grid) -> GridConstants:
    """The constants of ``grid``."""
    rules, layout = grid.rules, continuous_layout(grid)
    return GridConstants(
        cooldown_line=np.array([rules.cooldown_line], np.int32),
        cooldown_sub=np.array([rules.cooldown_sub], np.int32),
        reconnection=np.array([rules.reconnection], np.int32),
        overflow_allowed=np.array([rules.overflow_allowed], np.int32),
        hard_limit=np.float32(rules.hard_overflow) * grid.thermal_limit,
        hours_per_step=np.array([1.0 / STEPS_PER_HOUR], np.float32),
        storage_emax=grid.storage_emax,
        storage_emin=grid.storage_emin,
        storage_max_p_prod=grid.storage_max_p_prod,
        storage_max_p_absorb=grid.storage_max_p_absorb,
        storage_charging_efficiency=grid.storage_charging_efficiency,
        storage_discharging_efficiency=grid.storage_discharging_efficiency,
        storage_loss=grid.storage_loss,
        redispatch_gen=layout.redispatch,
        curtail_gen=layout.curtail,
    )
