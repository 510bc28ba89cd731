"""Where the grid is going: the trend of its injections and announced maintenance (``docs/algorithms/planner.md``)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rl2grid.agents.contingencies import without_lines
from rl2grid.arrays import F32, F64, I32
from rl2grid.grids import Grid
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.batch import Snapshot

LATER = 6
"""Steps ahead at which the grid is watched as well, by the trend."""
TREND_SHARE = 0.75
"""Of a trend that is expected to go on: flows six steps later are met best with it."""
_PAST = 6
"""Steps over which the trend is measured."""
ANNOUNCED = 12
"""Steps before announced maintenance from which on the grid is looked at without the line."""
_STEPS_FOR_A_TREND = 3
"""Steps that are left to prepare for what the trend brings."""
_LEAST_LOAD, _LEAST_RATIO, _MOST_RATIO = 1e-3, 0.5, 1.5
"""MW of demand below which its reactive part stays, and by how much that may change."""


class _Seen(NamedTuple):
    step: int
    injection: F64  # [topo] MW, as if nothing were dispatched, curtailed or stored


class Trend:
    """How all injections change, by what was seen in the last half hour."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._history: list[_Seen] = []

    def reset(self) -> None:
        """Forget the last episode."""
        self._history.clear()

    def watch(self, state: GridState) -> None:
        """Remember what is injected by the series in row 0.

        Who was brought back to an earlier moment, or is asked twice, forgets what was seen from there on.
        """
        step = int(state.step[0])
        before = [seen for seen in self._history if step - _PAST <= seen.step < step]
        self._history = [*before, _Seen(step, undispatched(state, self._grid))]

    def per_step(self) -> F64:
        """MW more that every element injects in a step, float64 [topo]; zeros where no past is known."""
        if len(self._history) < 2:
            return np.zeros(self._grid.dim_topo)
        first, last = self._history[0], self._history[-1]
        return (last.injection - first.injection) / (last.step - first.step)


class Later(NamedTuple):
    """What is expected of a moment to come, whatever the topology is then."""

    gen_p: F32  # [gen] MW
    load_p: F32  # [load] MW
    load_q: F32  # [load] MVAr
    lost: I32  # [outage] lines that announced maintenance will have taken
    duration: I32  # [outage] steps for which nobody can close them
    steps: int  # that are left to prepare for it

    def of(self, point: Snapshot, grid: Grid) -> Snapshot:
        """The operating point then, with the topology and the cooldowns of another one."""
        cooldown = np.maximum(point.cooldown_line[self.lost], self.duration)
        without = without_lines(point, grid, self.lost, cooldown)
        return without._replace(gen_p=self.gen_p, load_p=self.load_p, load_q=self.load_q)


def later_of(state: GridState, point: Snapshot, grid: Grid, change_per_step: F64) -> Later:
    """The grid half an hour later by the trend, without the lines whose announced maintenance begins within the hour.

    Args:
        state: row 0 is the present.
        point: forecast for the next step.
        grid: the grid.
        change_per_step: of all injections, MW, float64 [topo].
    """
    change = LATER * TREND_SHARE * change_per_step
    load_p = (point.load_p - change[grid.load_pos_topo_vect]).astype(np.float32)
    known = np.abs(point.load_p) > _LEAST_LOAD
    ratio = np.divide(load_p, point.load_p, out=np.ones_like(load_p), where=known)
    until = state.time_next_maintenance[0]
    lost = np.flatnonzero((until > 0) & (until <= ANNOUNCED) & state.line_status[0]).astype(np.int32)
    return Later(
        np.maximum(point.gen_p + change[grid.gen_pos_topo_vect], 0.0).astype(np.float32),
        load_p,
        (point.load_q * np.clip(ratio, _LEAST_RATIO, _MOST_RATIO)).astype(np.float32),
        lost,
        state.duration_next_maintenance[0][lost].astype(np.int32),
        int(until[lost].min()) if len(lost) else _STEPS_FOR_A_TREND,
    )


def without_closing(state: GridState, point: Snapshot) -> Snapshot:
    """The forecast of the next step, where nobody can close a line whose maintenance begins in it.

    ``simulate`` takes the line before the action and lets this close it again; the step takes it after the action.
    """
    begins = state.time_next_maintenance[0] == 1
    if not begins.any():
        return point
    cooldown = point.cooldown_line.copy()
    cooldown[begins] = np.maximum(cooldown[begins], state.duration_next_maintenance[0][begins])
    return point._replace(cooldown_line=cooldown)


def undispatched(state: GridState, grid: Grid) -> F64:
    """MW that every element would inject if nothing were dispatched, curtailed or stored, float64 [topo]."""
    series = state.gen_p[0] - state.actual_dispatch[0]
    injection = np.zeros(grid.dim_topo)
    injection[grid.gen_pos_topo_vect] = np.where(state.gen_renewable, state.gen_p_before_curtail[0], series)
    injection[grid.load_pos_topo_vect] = -state.load_p[0].astype(np.float64)
    return injection
