"""What the AC power flow keeps about each environment between calls."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.powerflow.borrowing import borrowing_jit
from rl2grid.powerflow.model import Network
from rl2grid.powerflow.ordering import elimination_order, reference_fill

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]
U64 = NDArray[np.uint64]
Bools = NDArray[np.bool_]
Row = NDArray[Any]
Index = int | np.integer[Any]

ABSENT = 0xFFFF
"""Node of what is disconnected."""
_SPARE = 1.6
"""Room for fill beyond that of the reference topology; a topology that needs more still works, slower."""


class FlowState(NamedTuple):
    """Rows of ``n`` environments; everything but ``order`` has the environment as first axis.

    A *node* is a bus with at least one element, numbered in elimination order; the slack bus comes last. Every
    other node has one unknown (its angle) if a generator holds its voltage, else two (angle, then magnitude).
    """

    order: I32  # [bus] buses in elimination order; the slack substation's last

    topo_vect: I32  # [n, topo] of the last call
    known: Bools  # [n] the arrays below describe topo_vect
    connected: Bools  # [n] no load or generator is disconnected and no bus is cut off from the slack
    warm: Bools  # [n] voltages solve the last flow, which had this topology
    anchor_steps: I32  # [n] Newton steps that led to the anchor

    gen_p: F32  # [n, gen] MW of the last call

    n_node: I32  # [n] nodes, the slack's included
    node_of_bus: U16  # [n, bus]
    line_or_node: U16  # [n, line] ABSENT when open
    line_ex_node: U16  # [n, line]
    gen_node: U16  # [n, gen]
    load_node: U16  # [n, load]
    storage_node: U16  # [n, storage] ABSENT when disconnected

    admittance_first: U16  # [n, bus + 1] row pointers of the admittance matrix
    admittance_node: U16  # [n, entry] columns, ascending within a row
    admittance: F64  # [n, entry, 2] per unit, real and imaginary
    admittance_panel: U32  # [n, entry] where the entry's block of the Jacobian begins in panel
    line_entry: U16  # [n, line, 2] entries (origin, extremity) and (extremity, origin)
    diagonal_entry: U16  # [n, bus]

    first_unknown: U16  # [n, bus + 1]
    node_of_unknown: U16  # [n, 2 * bus]
    first_column: U32  # [n, bus + 1] where the columns of each node's rows begin in column
    own_column: U32  # [n, bus] where the node's own unknowns are in column
    first_panel: U32  # [n, bus + 1] where each node's values begin in panel
    own_panel: U32  # [n, bus] where the node's diagonal block is in panel
    column: U16  # [n, columns] unknowns, ascending; both rows of a node share them
    panel: F64  # [n, values] Jacobian, then its factors: per column the values of the node's one or two rows

    magnitude: F64  # [n, bus] per unit, by node as all that follows
    angle: F64  # [n, bus] radians, slack 0
    voltage: F64  # [n, bus, 2] real and imaginary
    anchor: F64  # [n, bus, 2] magnitude and angle of the last flow of this topology that was solved cold
    injection: F64  # [n, bus, 2] per unit, active and reactive, as set
    power: F64  # [n, bus, 2] per unit, active and reactive, as the voltages give it
    step: F64  # [n, 2 * bus] mismatch, then Newton step
    sparse_row: F64  # [n, 2 * bus, 2] workspace of the factorisation
    sets: U64  # [n, 3, bus, words] workspace of the symbolic factorisation


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
    """Rows for ``n`` environments, all cold.

    About 90 KB per environment at 118 substations.
    """
    n_bus = 2 * len(network.nominal_voltage)
    n_line, n_gen = len(network.line_or_sub), len(network.gen_sub)
    n_load, n_storage = len(network.load_sub), len(network.storage_sub)
    n_entry = n_bus + 2 * n_line
    order = elimination_order(network)
    columns, values = (int(_SPARE * size) + 64 for size in reference_fill(network, order))
    n_topo = 2 * n_line + n_gen + n_load + n_storage
    words = -(-n_bus // 64)

    def zeros(dtype: Any, *shape: int) -> NDArray[Any]:
        return np.zeros((n, *shape), dtype)

    u16, u32, f64 = np.uint16, np.uint32, np.float64
    return FlowState(
        order=order,
        topo_vect=zeros(np.int32, n_topo),
        known=zeros(np.bool_),
        connected=zeros(np.bool_),
        warm=zeros(np.bool_),
        anchor_steps=zeros(np.int32),
        gen_p=zeros(np.float32, n_gen),
        n_node=zeros(np.int32),
        node_of_bus=zeros(u16, n_bus),
        line_or_node=zeros(u16, n_line),
        line_ex_node=zeros(u16, n_line),
        gen_node=zeros(u16, n_gen),
        load_node=zeros(u16, n_load),
        storage_node=zeros(u16, n_storage),
        admittance_first=zeros(u16, n_bus + 1),
        admittance_node=zeros(u16, n_entry),
        admittance=zeros(f64, n_entry, 2),
        admittance_panel=zeros(u32, n_entry),
        line_entry=zeros(u16, n_line, 2),
        diagonal_entry=zeros(u16, n_bus),
        first_unknown=zeros(u16, n_bus + 1),
        node_of_unknown=zeros(u16, 2 * n_bus),
        first_column=zeros(u32, n_bus + 1),
        own_column=zeros(u32, n_bus),
        first_panel=zeros(u32, n_bus + 1),
        own_panel=zeros(u32, n_bus),
        column=zeros(u16, columns),
        panel=zeros(f64, values),
        magnitude=zeros(f64, n_bus),
        angle=zeros(f64, n_bus),
        voltage=zeros(f64, n_bus, 2),
        anchor=zeros(f64, n_bus, 2),
        injection=zeros(f64, n_bus, 2),
        power=zeros(f64, n_bus, 2),
        step=zeros(f64, 2 * n_bus),
        sparse_row=zeros(f64, 2 * n_bus, 2),
        sets=zeros(np.uint64, 3, n_bus, words),
    )


@borrowing_jit
def forget_flow(flow: FlowState, i: int) -> None:
    """Make the next flow of row ``i`` start cold, as after a reset."""
    flow.known[i] = False
    flow.warm[i] = False


@borrowing_jit
def copy_flow(source: FlowState, i: int, target: FlowState, j: int) -> None:
    """Copy row ``i`` of ``source`` to row ``j`` of ``target``, a state of the same network."""
    target.known[j] = source.known[i]
    target.connected[j] = source.connected[i]
    target.warm[j] = source.warm[i]
    target.anchor_steps[j] = source.anchor_steps[i]
    target.n_node[j] = source.n_node[i]
    _copy_row(source.topo_vect, i, target.topo_vect, j)
    _copy_row(source.gen_p, i, target.gen_p, j)
    _copy_row(source.node_of_bus, i, target.node_of_bus, j)
    _copy_row(source.line_or_node, i, target.line_or_node, j)
    _copy_row(source.line_ex_node, i, target.line_ex_node, j)
    _copy_row(source.gen_node, i, target.gen_node, j)
    _copy_row(source.load_node, i, target.load_node, j)
    _copy_row(source.storage_node, i, target.storage_node, j)
    _copy_row(source.admittance_first, i, target.admittance_first, j)
    _copy_row(source.admittance_node, i, target.admittance_node, j)
    _copy_pairs(source.admittance, i, target.admittance, j)
    _copy_row(source.admittance_panel, i, target.admittance_panel, j)
    _copy_pairs(source.line_entry, i, target.line_entry, j)
    _copy_row(source.diagonal_entry, i, target.diagonal_entry, j)
    _copy_row(source.first_unknown, i, target.first_unknown, j)
    _copy_row(source.node_of_unknown, i, target.node_of_unknown, j)
    _copy_row(source.first_column, i, target.first_column, j)
    _copy_row(source.own_column, i, target.own_column, j)
    _copy_row(source.own_panel, i, target.own_panel, j)
    _copy_row(source.first_panel, i, target.first_panel, j)
    _copy_row(source.column, i, target.column, j)
    _copy_row(source.panel, i, target.panel, j)
    _copy_row(source.magnitude, i, target.magnitude, j)
    _copy_row(source.angle, i, target.angle, j)
    _copy_pairs(source.voltage, i, target.voltage, j)
    _copy_pairs(source.anchor, i, target.anchor, j)
    _copy_pairs(source.injection, i, target.injection, j)
    _copy_pairs(source.power, i, target.power, j)


@borrowing_jit
def _copy_row(source: Row, i: int, target: Row, j: int) -> None:
    """Copy row ``i`` of a matrix to row ``j`` of another; for short rows a loop costs less than slices."""
    for k in range(source.shape[1]):
        target[j, k] = source[i, k]


@borrowing_jit
def _copy_pairs(source: Row, i: int, target: Row, j: int) -> None:
    """The same for rows of pairs."""
    for k in range(source.shape[1]):
        target[j, k, 0] = source[i, k, 0]
        target[j, k, 1] = source[i, k, 1]
