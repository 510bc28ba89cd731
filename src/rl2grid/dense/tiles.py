"""A tile of a product of two matrices, in registers.

Every number of the tile is a sum in the order of its terms, to which each product is added with one rounding (a fused
multiply-add). So it has the same bits on every processor, and does not depend on what else is in the tile; how large
tiles are does not matter to anything but speed.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.extending import intrinsic

from rl2grid.arrays import F32, Index
from rl2grid.compile import borrowing_jit


def _has_wide_registers() -> bool:
    """Whether Numba compiles for AVX-512, on this machine or by its environment variable."""
    if config.CPU_FEATURES is None:
        return bool(llvmlite.binding.get_host_cpu_features().get("avx512f"))
    return "+avx512f" in config.CPU_FEATURES


_WIDTH = 16 if _has_wide_registers() else 8
"""Numbers of a register."""
_REGISTERS = 2
ROWS = 6
"""Of a tile: twelve registers of sums, two of one factor and one of the other are what AVX2 has."""
COLUMNS = _REGISTERS * _WIDTH
"""Of a tile."""

_INDEX, _LANE, _FLOAT = ir.IntType(64), ir.IntType(32), ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, _WIDTH)


def _tile_of(n_rows: int) -> Any:
    """What computes a tile of so many rows; see :func:`write_tile`, whose arguments it takes but for the number."""

    @intrinsic  # type: ignore[untyped-decorator]
    def write(
        typing_context: Any, left: Any, first: Any, row_step: Any, term_step: Any, panel: Any, n_terms: Any, tile: Any
    ) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            sums = _Sums(context, builder, signature, arguments, n_rows)
            sums.add_terms()
            sums.write()
            return context.get_dummy_value()

        index = types.intp
        return types.void(left, index, index, index, panel, index, tile), generate

    return write


class _Sums:
    """The loop over terms, which keeps all sums in registers."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any, n_rows: int) -> None:
        self._builder, self._n_rows = builder, n_rows
        left, panel, tile = (
            context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 4, 6)
        )
        _, first, row_step, self._term_step, _, self._n_terms, _ = arguments
        self._panel, self._tile = panel, tile
        self._left = [
            builder.gep(left, [builder.add(first, builder.mul(row_step, _INDEX(row)))]) for row in range(n_rows)
        ]
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
        self._fma = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{_WIDTH}f32")

    def add_terms(self) -> None:
        """Add up the products of all terms; there is one at least."""
        builder = self._builder
        before, loop, behind = (
            builder.block,
            builder.append_basic_block("terms"),
            builder.append_basic_block("behind"),
        )
        builder.branch(loop)
        builder.position_at_end(loop)
        term = builder.phi(_INDEX)
        sums = [[builder.phi(_VECTOR) for _ in range(_REGISTERS)] for _ in range(self._n_rows)]
        self._added = self._with_term(term, sums)
        following = builder.add(term, _INDEX(1))
        term.add_incoming(_INDEX(0), before)
        term.add_incoming(following, loop)
        for row, added in zip(sums, self._added, strict=True):
            for old, new in zip(row, added, strict=True):
                old.add_incoming(ir.Constant(_VECTOR, [0.0] * _WIDTH), before)
                old.add_incoming(new, loop)
        builder.cbranch(builder.icmp_signed("<", following, self._n_terms), loop, behind)
        builder.position_at_end(behind)

    def write(self) -> None:
        """Write the sums to the tile."""
        for row, added in enumerate(self._added):
            for register, value in enumerate(added):
                self._builder.store(value, self._vector(self._tile, _INDEX(row), register), align=4)

    def _with_term(self, term: Any, sums: list[list[Any]]) -> list[list[Any]]:
        builder = self._builder
        right = [builder.load(self._vector(self._panel, term, k), align=4) for k in range(_REGISTERS)]
        place = builder.mul(term, self._term_step)
        added = []
        for start, row in zip(self._left, sums, strict=True):
            factor = self._in_all_lanes(builder.load(builder.gep(start, [place])))
            added.append([builder.call(self._fma, [factor, *pair]) for pair in zip(right, row, strict=True)])
        return added

    def _vector(self, data: Any, row: Any, register: int) -> Any:
        """Address of part of a row of a panel or tile."""
        builder = self._builder
        place = builder.add(builder.mul(row, _INDEX(COLUMNS)), _INDEX(register * _WIDTH))
        return builder.bitcast(builder.gep(data, [place]), _VECTOR.as_pointer())

    def _in_all_lanes(self, number: Any) -> Any:
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = self._builder.insert_element(undefined, number, _LANE(0))
        return self._builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_LANE, _WIDTH), [0] * _WIDTH))


_one, _two, _three, _four, _five, _six = map(_tile_of, range(1, ROWS + 1))


@borrowing_jit
def write_tile(
    n_rows: int, left: F32, first: Index, row_step: int, term_step: int, panel: F32, n_terms: int, tile: F32
) -> None:
    """Write ``tile[i, j] = sum over k of left(i, k) panel[k, j]``, without checks.

    Args:
        n_rows: from 1 to :data:`ROWS`.
        left: array with the numbers ``left(i, k)``, at ``first + i * row_step + k * term_step`` counted over all axes.
        first: see ``left``.
        row_step: see ``left``.
        term_step: see ``left``.
        panel: [n_terms, COLUMNS].
        n_terms: one at least.
        tile: [ROWS, COLUMNS].
    """
    if n_rows == 6:
        _six(left, first, row_step, term_step, panel, n_terms, tile)
    elif n_rows == 5:
        _five(left, first, row_step, term_step, panel, n_terms, tile)
    elif n_rows == 4:
        _four(left, first, row_step, term_step, panel, n_terms, tile)
    elif n_rows == 3:
        _three(left, first, row_step, term_step, panel, n_terms, tile)
    elif n_rows == 2:
        _two(left, first, row_step, term_step, panel, n_terms, tile)
    else:
        _one(left, first, row_step, term_step, panel, n_terms, tile)
