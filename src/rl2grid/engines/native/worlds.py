"""Saving and restoring environments of the native engine: the rows of all its arrays, one after the other.

Which arrays follows from their declarations (:mod:`rl2grid.structures`): those that matter beyond a step, addresses
excepted, which hold in this process only. Planned outages are as many as an environment has.
"""

from __future__ import annotations

import hashlib
import math
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic
from numpy.typing import NDArray

from rl2grid.arrays import I64
from rl2grid.compile import jit
from rl2grid.engines.native.environments import Environments
from rl2grid.engines.worlds import Bytes
from rl2grid.structures import Role, fields_of

OUTAGES = ("hidden.outage_line", "hidden.outage_begin", "hidden.outage_end")
"""Arrays of which only as many columns are saved as the environment has planned outages."""
_OUTAGE_BYTES = 4


class Place(NamedTuple):
    """Where an array's row is in the bytes of a world."""

    offset: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]


class RowLayout:
    """Which bytes of an engine's arrays are one environment.

    Args:
        environments: the arrays, which must not be replaced while the layout is used.
    """

    def __init__(self, environments: Environments) -> None:
        saved = saved_arrays(environments)
        self._places: dict[str, Place] = {}
        table, offset = [], 0
        for name, array in saved.items():
            shape = array.shape[1:]
            size = array.dtype.itemsize * math.prod(shape)
            self._places[name] = Place(offset, array.dtype, shape)
            if size:
                table.append((array.ctypes.data, array.strides[0], size))
            offset += size
        self.table: I64 = np.array(table, np.int64)
        """int64 [array, 3]: address of row 0, bytes from row to row, bytes saved of each."""
        outages = [getattr(environments.hidden, name.removeprefix("hidden.")) for name in OUTAGES]
        self.outages: I64 = np.array([(array.ctypes.data, array.strides[0]) for array in outages], np.int64)
        """int64 [3, 2]: address of row 0, bytes from row to row."""
        self.size = offset
        """Bytes of an environment without planned outages."""
        words = repr([(name, place.dtype.str, place.shape) for name, place in self._places.items()])
        self.hash = hashlib.sha256(words.encode()).hexdigest()[:16]
        """Of names, types and shapes."""

    def room(self, n_outages: int) -> Bytes:
        """Uninitialised bytes for an environment with that many planned outages."""
        return np.empty(self.size + len(OUTAGES) * _OUTAGE_BYTES * n_outages, np.uint8)

    def n_outages(self, rows: Bytes) -> int:
        """Planned outages of a saved environment."""
        return (rows.size - self.size) // (len(OUTAGES) * _OUTAGE_BYTES)

    def view(self, rows: Bytes) -> dict[str, NDArray[Any]]:
        """What is saved, by structure and field, such as ``"state.rho"``: views, without an axis of environments."""
        views = {
            name: np.ndarray(place.shape, place.dtype, rows, place.offset)  # type: ignore[call-overload]
            for name, place in self._places.items()
        }
        n = self.n_outages(rows)
        for k, name in enumerate(OUTAGES):
            views[name] = np.ndarray((n,), np.int32, rows, self.size + k * _OUTAGE_BYTES * n)  # type: ignore[call-overload]
        return views


def saved_arrays(environments: Environments) -> dict[str, NDArray[Any]]:
    """The arrays whose rows are saved whole, by structure and field; the environment is their first axis."""
    saved = {}
    for part in ("state", "hidden", "flow", "opponent"):
        structure = getattr(environments, part)
        for name in fields_of(type(structure), Role.EPISODE, Role.KEPT):
            if f"{part}.{name}" not in OUTAGES:
                saved[f"{part}.{name}"] = getattr(structure, name)
    return saved


@jit
def save_row(table: I64, outages: I64, n_outages: int, i: int, rows: Bytes) -> None:
    """Copy environment ``i`` to ``rows``, uint8 [byte]; tables as in :class:`RowLayout`."""
    place = np.int64(rows.ctypes.data)
    for k in range(table.shape[0]):
        _copy_bytes(place, table[k, 0] + i * table[k, 1], table[k, 2])  # type: ignore[call-arg]
        place += table[k, 2]
    for k in range(outages.shape[0]):
        size = np.int64(n_outages * _OUTAGE_BYTES)
        _copy_bytes(place, outages[k, 0] + i * outages[k, 1], size)  # type: ignore[call-arg]
        place += size


@jit
def restore_row(table: I64, outages: I64, n_outages: int, i: int, rows: Bytes) -> None:
    """Copy ``rows`` to environment ``i``; the opposite of :func:`save_row`."""
    place = np.int64(rows.ctypes.data)
    for k in range(table.shape[0]):
        _copy_bytes(table[k, 0] + i * table[k, 1], place, table[k, 2])  # type: ignore[call-arg]
        place += table[k, 2]
    for k in range(outages.shape[0]):
        size = np.int64(n_outages * _OUTAGE_BYTES)
        _copy_bytes(outages[k, 0] + i * outages[k, 1], place, size)  # type: ignore[call-arg]
        place += size


@intrinsic  # type: ignore[untyped-decorator]
def _copy_bytes(typing_context: Any, target: Any, source: Any, size: Any) -> Any:
    """Copy ``size`` bytes from the address ``source`` to the address ``target``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        byte = ir.IntType(8).as_pointer()
        to, origin = (builder.inttoptr(address, byte) for address in arguments[:2])
        cgutils.raw_memcpy(builder, to, origin, arguments[2], 1)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), generate
