"""What the loss of each line would do after a topology action, by the forecast for the next step."""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import I32
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.what_if import OutageOutcomes, WhatIf, forecast_of
from rl2grid.grids import Grid
from rl2grid.mdp.actions import ActionKind, StepAction, moved_elements
from rl2grid.mdp.termination import GameOver
from rl2grid.powerflow.batch import Snapshot


def outages_after(engine: NativeEngine, i: int, action: StepAction, solver: WhatIf) -> OutageOutcomes:
    """The flow after an action and the loss of each line, on the forecast for the next step of environment ``i``.

    Where the generators cannot follow the forecast, every verdict is DISPATCH.
    """
    snapshot = forecast_of(engine, i)
    if snapshot is None:
        return _all_lost(engine.grid.n_line)
    return solver.outages(point_after(engine.grid, snapshot, action))


def point_after(grid: Grid, point: Snapshot, action: StepAction) -> Snapshot:
    """An operating point after an action of changes of kind MOVE and SWITCH; injections and cooldowns stay."""
    topology = busbars_after(grid, point.topo_vect, point.last_bus, action)
    last_bus = np.where(topology > 0, topology, point.last_bus).astype(np.int32)
    return point._replace(topo_vect=topology, last_bus=last_bus)


def busbars_after(grid: Grid, busbar: I32, last_busbar: I32, action: StepAction) -> I32:
    """The busbar of each element after an action, int32 [topo]; a copy.

    Args:
        grid: the grid.
        busbar: busbar of each element, -1 when off, int32 [topo].
        last_busbar: the busbar to which the end of an open line returns, int32 [topo].
        action: changes of kind MOVE and SWITCH.
    """
    result = busbar.copy()
    for change in action.changes:
        if change.kind == ActionKind.SWITCH:
            ends = [int(grid.line_or_pos_topo_vect[change.target]), int(grid.line_ex_pos_topo_vect[change.target])]
            result[ends] = -1 if (result[ends] > 0).any() else last_busbar[ends]
    for change in action.changes:
        if change.kind == ActionKind.MOVE:
            elements = moved_elements(grid, change.target, change.mask)
            elements = elements[result[elements] > 0]
            result[elements] = 3 - result[elements]
    return result


def _all_lost(n_line: int) -> OutageOutcomes:
    nothing = np.zeros(n_line, np.int32)
    verdict = np.full(n_line, int(GameOver.DISPATCH), np.int8)
    return OutageOutcomes(np.full(n_line, np.inf, np.float32), verdict, nothing, nothing > 0)
