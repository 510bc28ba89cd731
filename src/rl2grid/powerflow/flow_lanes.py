"""Power flows of several rows, one per lane: what those that go on and those that begin anew have in common."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from rl2grid.arrays import I8, I64, Flags, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.flow_state import Equations, FlowState
from rl2grid.powerflow.lane_flow import EMPTY, FAILED
from rl2grid.powerflow.lanes import WIDTH, Lanes, load, splat, store, where_less
from rl2grid.powerflow.newton import RENEW
from rl2grid.structures import allocate, workspace

LOST = EMPTY + 1
"""State of a lane whose flow is known to diverge, beside those of :mod:`rl2grid.powerflow.lane_flow`."""


class FlowLanes(NamedTuple):
    """Power flows side by side; what is not explained is as in :class:`~rl2grid.powerflow.flow_state.FlowState`."""

    magnitude: Annotated[Lanes, workspace("bus lane")]
    angle: Annotated[Lanes, workspace("bus lane")]
    admittance: Annotated[Lanes, workspace("entry 2 lane")]
    voltage: Annotated[Lanes, workspace("bus 2 lane")]
    injection: Annotated[Lanes, workspace("bus 2 lane")]
    power: Annotated[Lanes, workspace("bus 2 lane")]
    step: Annotated[Lanes, workspace("unknown lane")]
    panel: Annotated[Lanes, workspace("value lane")]
    new_panel: Annotated[Lanes, workspace("value lane", "factors at the present voltages, of lanes that want them")]
    sparse_row: Annotated[Lanes, workspace("unknown 2 lane")]
    mismatch: Annotated[Lanes, workspace("1 lane", "largest, not a number if any is not finite", "per unit")]
    mismatch_before: Annotated[Lanes, workspace("1 lane", "a step ago", "per unit")]
    active: Annotated[Lanes, workspace("1 lane", "1.0 in lanes that take a step")]
    renews: Annotated[Lanes, workspace("1 lane", "1.0 in lanes that want new factors for it")]
    sound: Annotated[Lanes, workspace("1 lane", "0.0 in lanes whose new factors are of a singular matrix")]
    current: Annotated[Lanes, workspace("line lane", "at the origin", "kA")]
    row: Annotated[I64, workspace("lane", "that it works for")]
    place: Annotated[I64, workspace("lane", "of the row among those of the caller")]
    state: Annotated[I8, workspace("lane", "RUNNING, DONE, LOST or FAILED")]
    renewed: Annotated[Flags, workspace("lane", "the factors are not those of the last flow")]


def new_flow_lanes(flow: FlowState) -> FlowLanes:
    """Blank lanes for rows of ``flow``."""
    sizes = {
        "bus": flow.magnitude.shape[1],
        "unknown": len(flow.step),
        "entry": flow.admittance.shape[1],
        "value": 2 * flow.panel.shape[1],  # rows of different topologies need more than one of them
        "line": flow.line_or_node.shape[1],
        "lane": WIDTH,
    }
    return allocate(FlowLanes, sizes)


@borrowing_jit
def any_marked(marks: Lanes, n: Index) -> bool:
    """Whether any of the first ``n`` lanes is marked with 1.0."""
    marked = False
    for lane in range(n):
        marked |= marks[0, lane] > 0.0
    return marked


@borrowing_jit
def forget_marks(lanes: FlowLanes) -> None:
    """Let no lane take a step."""
    store(lanes.active, 0, splat(0.0))
    store(lanes.renews, 0, splat(0.0))


@borrowing_jit
def mark(lanes: FlowLanes, lane: Index, verdict: int) -> None:
    """Let a lane take a step, with new factors if the verdict is RENEW."""
    lanes.active[0, lane] = 1.0
    lanes.renews[0, lane] = 1.0 if verdict == RENEW else 0.0


@borrowing_jit
def take_new_factors(lanes: FlowLanes, panel: Lanes, new_panel: Lanes, n_values: Index) -> None:
    """Replace the factors of lanes that want new ones."""
    renews = load(lanes.renews, 0)
    for k in range(n_values):
        store(panel, k, where_less(splat(0.0), renews, load(new_panel, k), load(panel, k)))


@borrowing_jit
def give_up_singular(lanes: FlowLanes, n: Index) -> None:
    """Let lanes whose new factors are of a singular matrix go no further."""
    for lane in range(n):
        if lanes.renews[0, lane] > 0.0:
            lanes.renewed[lane] = True
            if lanes.sound[0, lane] == 0.0:
                lanes.state[lane] = FAILED


@borrowing_jit
def hold_still(lanes: FlowLanes, equations: Equations) -> None:
    """Let lanes that have arrived take a step of nothing."""
    active = load(lanes.active, 0)
    for unknown in range(equations.first_unknown[equations.n_free]):
        store(lanes.step, unknown, where_less(splat(0.0), active, load(lanes.step, unknown), splat(0.0)))
