"""What the AC power flow keeps about each environment between calls."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I32, U16, U32, U64, Flags, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.model import Network
from rl2grid.powerflow.ordering import elimination_order, reference_fill
from rl2grid.structures import allocate, constant, row, scratch, workspace

ABSENT = 0xFFFF
"""Node of what is disconnected."""
_SPARE = 1.6
"""Room for fill beyond that of the reference topology; a topology that needs more still works, slower."""


class FlowState(NamedTuple):
    """Rows of ``n`` environments, and the workspace of the thread that works on one of them.

    A *node* is a bus with at least one element, numbered in elimination order; the slack bus comes last. Every
    other node has one unknown (its angle) if a generator holds its voltage, else two (angle, then magnitude).

    Matrices have room for open lines, between the nodes of busbar 1 at their ends: rows that differ only in the lines
    that are open have one pattern, and can be solved side by side. It is equal where ``pattern`` is.

    Threads that work on different rows need workspaces of their own
    (:func:`rl2grid.structures.with_own_workspace`).
    """

    order: Annotated[I32, constant("bus", "buses in elimination order; the slack substation's last")]

    topo_vect: Annotated[I32, row("topo", "of the last call")]
    pattern: Annotated[I32, row("topo", "topo_vect, but ends of open lines on busbar 1 where that has a node")]
    known: Annotated[Flags, row("", "the arrays below describe topo_vect")]
    connected: Annotated[Flags, row("", "no load or generator is disconnected and no bus is cut off from the slack")]
    warm: Annotated[Flags, row("", "voltages solve the last flow, which had this topology")]
    anchor_steps: Annotated[I32, row("", "Newton steps that led to the anchor")]

    gen_p: Annotated[F32, scratch("gen", "of the last call", "MW")]

    n_node: Annotated[I32, row("", "nodes, the slack's included")]
    node_of_bus: Annotated[U16, row("bus")]
    line_or_node: Annotated[U16, row("line", "ABSENT when open")]
    line_ex_node: Annotated[U16, row("line", "ABSENT when open")]
    gen_node: Annotated[U16, row("gen")]
    load_node: Annotated[U16, row("load")]
    storage_node: Annotated[U16, row("storage", "ABSENT when disconnected")]

    admittance_first: Annotated[U16, row("pointer", "row pointers of the admittance matrix")]
    admittance_node: Annotated[U16, row("entry", "columns, ascending within a row")]
    admittance: Annotated[F64, row("entry 2", "real and imaginary, 0 where only open lines lead", "per unit")]
    admittance_panel: Annotated[U32, row("entry", "where the entry's block of the Jacobian begins in panel")]
    line_entry: Annotated[U16, row("line 2", "entries (origin, extremity) and (extremity, origin)")]
    diagonal_entry: Annotated[U16, row("bus")]

    first_unknown: Annotated[U16, row("pointer")]
    node_of_unknown: Annotated[U16, row("unknown")]
    first_column: Annotated[U32, row("pointer", "where the columns of each node's rows begin in column")]
    own_column: Annotated[U32, row("bus", "where the node's own unknowns are in column")]
    first_panel: Annotated[U32, row("pointer", "where each node's values begin in panel")]
    own_panel: Annotated[U32, row("bus", "where the node's diagonal block is in panel")]
    column: Annotated[U16, row("column", "unknowns, ascending; both rows of a node share them")]
    panel: Annotated[
        F64, row("value", "Jacobian, then its factors: per column the values of the node's one or two rows")
    ]

    magnitude: Annotated[F64, row("bus", "by node as all that follows", "per unit")]
    angle: Annotated[F64, row("bus", "slack 0", "radians")]
    voltage: Annotated[F64, row("bus 2", "real and imaginary", "per unit")]
    anchor: Annotated[F64, row("bus 2", "magnitude and angle of the last flow of this topology that was solved cold")]
    injection: Annotated[F64, scratch("bus 2", "active and reactive, as set", "per unit")]
    power: Annotated[F64, scratch("bus 2", "active and reactive, as the voltages give it", "per unit")]

    step: Annotated[F64, workspace("unknown", "mismatch, then Newton step")]
    sparse_row: Annotated[F64, workspace("unknown 2", "of the factorisation")]
    sets: Annotated[U64, workspace("3 bus word", "of the symbolic factorisation")]


class Factors(NamedTuple):
    """Views of one row: a sparse matrix and its LU factors. Fields as in :class:`FlowState`."""

    n_free: np.int64  # nodes other than the slack's
    first_unknown: U16
    node_of_unknown: U16
    first_column: U32
    own_column: U32
    first_panel: U32
    own_panel: U32
    column: U16
    panel: F64
    sparse_row: F64


class Equations(NamedTuple):
    """Views of one row: the power flow equations and where they stand. Fields as in :class:`FlowState`."""

    n_free: np.int64
    first_unknown: U16
    admittance_first: U16
    admittance_node: U16
    admittance: F64
    admittance_panel: U32
    magnitude: F64
    angle: F64
    voltage: F64
    injection: F64
    power: F64
    step: F64


def new_flow_state(network: Network, n: int) -> FlowState:
    """Rows for ``n`` environments, all cold, and one workspace.

    About 60 KB per environment at 118 substations.
    """
    n_bus = 2 * len(network.nominal_voltage)
    n_line, n_gen = len(network.line_or_sub), len(network.gen_sub)
    n_load, n_storage = len(network.load_sub), len(network.storage_sub)
    order = elimination_order(network)
    columns, values = (int(_SPARE * size) + 64 for size in reference_fill(network, order))
    sizes = {
        "bus": n_bus,
        "line": n_line,
        "gen": n_gen,
        "load": n_load,
        "storage": n_storage,
        "topo": 2 * n_line + n_gen + n_load + n_storage,
        "pointer": n_bus + 1,
        "unknown": 2 * n_bus,
        "entry": n_bus + 2 * n_line,
        "column": columns,
        "value": values,
        "word": -(-n_bus // 64),
    }
    return allocate(FlowState, sizes, n, order=order)


@borrowing_jit
def forget_flow(flow: FlowState, i: int) -> None:
    """Make the next flow of row ``i`` start cold, as after a reset."""
    flow.known[i] = False
    flow.warm[i] = False


@borrowing_jit
def equations_of(flow: FlowState, i: Index) -> Equations:
    """The equations of row ``i``, where they lie."""
    return Equations(
        np.int64(flow.n_node[i]) - 1,
        flow.first_unknown[i],
        flow.admittance_first[i],
        flow.admittance_node[i],
        flow.admittance[i],
        flow.admittance_panel[i],
        flow.magnitude[i],
        flow.angle[i],
        flow.voltage[i],
        flow.injection[i],
        flow.power[i],
        flow.step,
    )


@borrowing_jit
def factors_of(flow: FlowState, i: Index, column: U16, panel: F64, sparse_row: F64) -> Factors:
    """Factors of the topology of row ``i``.

    Args:
        flow: rows of environments.
        i: row.
        column: columns of all panels, those of the row or of arrays of its own.
        panel: values, of the row or of lanes.
        sparse_row: workspace, likewise.
    """
    return Factors(
        np.int64(flow.n_node[i]) - 1,
        flow.first_unknown[i],
        flow.node_of_unknown[i],
        flow.first_column[i],
        flow.own_column[i],
        flow.first_panel[i],
        flow.own_panel[i],
        column,
        panel,
        sparse_row,
    )
