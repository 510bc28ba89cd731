"""The numbers of :mod:`rl2grid.streams` in compiled code, from any place of a stream on.

A block of Philox4x64-10 (Salmon et al., 2011) is a function of the key and of its number: nobody has to draw the
numbers before it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.extending import intrinsic

from rl2grid.arrays import F64
from rl2grid.compile import jit

_ROUNDS = 10
_MULTIPLIERS = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_INCREMENTS = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_BLOCK = 4
_UNUSED_BITS = np.uint64(11)


@intrinsic  # type: ignore[untyped-decorator]
def _high_word(typing_context: Any, first: Any, second: Any) -> Any:
    """The upper 64 of the 128 bits of a product."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        wide, word = ir.IntType(128), ir.IntType(64)
        product = builder.mul(*(builder.zext(argument, wide) for argument in arguments))
        return builder.trunc(builder.lshr(product, wide(64)), word)

    return types.uint64(types.uint64, types.uint64), generate


@jit
def fill_uniforms(seed: int, key: int, first: int, out: F64) -> None:
    """Numbers in [0, 1) of a stream: ``Stream.uniform(first + out.size)[first:]``, bit for bit.

    Args:
        seed: of the stream, not negative.
        key: ``(episode << 8) | purpose``, see :func:`stream_key`.
        first: place of the first number in the stream.
        out: float64 [number].
    """
    place = -(first % _BLOCK)
    block = np.uint64(first // _BLOCK)
    while place < out.size:
        block += np.uint64(1)  # NumPy counts before it draws
        numbers = _block(np.uint64(seed), np.uint64(key), block)
        for k in range(_BLOCK):
            if 0 <= place + k < out.size:
                out[place + k] = np.float64(numbers[k] >> _UNUSED_BITS) * 2.0**-53
        place += _BLOCK


@jit
def stream_key(episode: int, purpose: int) -> int:
    """What tells the streams of a seed apart: the second word of the key of :class:`rl2grid.streams.Stream`."""
    return (episode << 8) | purpose


@jit
def _block(
    first_key: np.uint64, second_key: np.uint64, number: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    a, b, c, d = number, np.uint64(0), np.uint64(0), np.uint64(0)
    for _ in range(_ROUNDS):
        high_a: np.uint64 = _high_word(_MULTIPLIERS[0], a)  # type: ignore[call-arg]
        high_c: np.uint64 = _high_word(_MULTIPLIERS[1], c)  # type: ignore[call-arg]
        low_a, low_c = _MULTIPLIERS[0] * a, _MULTIPLIERS[1] * c
        a, b, c, d = high_c ^ b ^ first_key, low_c, high_a ^ d ^ second_key, low_a
        first_key += _INCREMENTS[0]
        second_key += _INCREMENTS[1]
    return a, b, c, d
