"""The exact redispatch inside Grid2Op, through its ``redispatch_solver=`` keyword.

Grid2Op copies the solver to the environment behind ``obs.simulate``, to the mixes of a multi-mix
environment and to every copy of an environment, so that all of them dispatch alike.
"""

from __future__ import annotations

import numpy as np
from grid2op.Environment.dispatch import (
    BaseRedispatchSolver,
    RedispatchConstraints,
    RedispatchResult,
    RedispatchState,
)
from grid2op.Exceptions import ImpossibleRedispatching

from rl2grid.engines.dispatch import find_dispatch, redispatch_is_impossible

__all__ = ["ExactRedispatchSolver", "redispatch_is_impossible"]


class ExactRedispatchSolver(BaseRedispatchSolver):  # type: ignore[misc]
    """Grid2Op's redispatch problem, solved by :func:`rl2grid.engines.dispatch.find_dispatch`."""

    def solve(self, constraints: RedispatchConstraints, state: RedispatchState) -> RedispatchResult:
        """The best feasible dispatch of this step, or a failure, which ends the episode."""
        dispatch = np.empty_like(state.actual_dispatch)
        found = find_dispatch(
            constraints.new_p,
            state.gen_activeprod_t_redisp,
            state.target_dispatch,
            state.actual_dispatch,
            state.already_modified_gen,
            constraints.pmin,
            constraints.pmax,
            constraints.ramp_up,
            constraints.ramp_down,
            constraints.redispatchable_mask,
            constraints.power_to_compensate_mw,
            dispatch,
        )
        if found:
            return RedispatchResult(success=True, actual_dispatch=dispatch)
        return RedispatchResult.failed(
            ImpossibleRedispatching(
                f"The generators cannot produce {constraints.power_to_compensate_mw:+.2f} MW beside the time series "
                "within their limits and ramps."
            )
        )
