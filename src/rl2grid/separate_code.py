"""Compiled functions that compiled callers reach by address, instead of holding their code.

Numba gives a compiled function the code of all that it calls, which is optimised again with it. What is called through
many levels, from many places, is then compiled that many times: most of what a first run would wait for. A function of
:func:`separate_jit` is compiled once, by itself. Its callers read where it is from a word of memory, which has a name
for the linker; what they have compiled holds for every process. Until the function is :meth:`~Separate.ready`, the word
leads to Python code that makes it so.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import llvmlite.binding
import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic

from rl2grid.compile import jit
from rl2grid.handles import HandleType, opened_type

_NATIVE = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
"""How compiled functions of an opened structure and a row are called: where to write the result and an exception come
first; what is returned says whether there was one."""
_WORD = ir.IntType(64)
_ADDRESS = ir.IntType(8).as_pointer()
Compiled = Callable[[Any, Any], Any]


class Separate:
    """A compiled function of an opened structure and a row that returns an integer, and the word that leads to it."""

    def __init__(self, function: Compiled, handle: HandleType) -> None:
        self._compiled: Any = jit(function)
        self.signature = types.int64(handle, types.int64)
        self.name = f"{function.__module__}.{function.__name__}"
        self._is_ready = False
        self._stand_in = _NATIVE(self._call)
        self._word = ctypes.c_int64(ctypes.cast(self._stand_in, ctypes.c_void_p).value or 0)
        llvmlite.binding.add_symbol(self.name, ctypes.addressof(self._word))

    def ready(self) -> None:
        """Compile the function, or load its code, if that has not been done.

        Compiled callers may do without, but what compiles within their call cannot be interrupted.
        """
        if self._is_ready:
            return
        self._compiled.compile(self.signature)
        result = self._compiled.overloads[self.signature.args]
        self._word.value = result.library.get_pointer_to_function(result.fndesc.llvm_func_name)
        self._is_ready = True

    def _call(self, result: int, exception: int, structure: int, i: int) -> int:
        self.ready()
        return int(_NATIVE(self._word.value)(result, exception, structure, i))


def separate_jit(kind: type[tuple[Any, ...]], separate: list[Separate]) -> Callable[[Compiled], Compiled]:
    """Compile a function ``(structure, i) -> int`` by itself, for compiled callers.

    Args:
        kind: of the structure, which callers have opened.
        separate: the function is added to it.
    """

    def decorate(function: Compiled) -> Compiled:
        if numba.config.DISABLE_JIT:
            return function
        entry = Separate(function, opened_type(kind))
        separate.append(entry)
        return _caller(entry)

    return decorate


def _caller(entry: Separate) -> Compiled:
    """What compiled functions call in the place of the function."""

    @intrinsic  # type: ignore[untyped-decorator]
    def call(typing_context: Any, structure: Any, i: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            word = _word_of(builder, entry.name)
            native = ir.FunctionType(
                ir.IntType(32), [_WORD.as_pointer(), _ADDRESS.as_pointer(), _WORD, _WORD]
            ).as_pointer()
            # Compiled functions raise nothing: what they found is in what they write.
            result = cgutils.alloca_once(builder, _WORD)
            exception = cgutils.alloca_once(builder, _ADDRESS)
            builder.call(builder.inttoptr(builder.load(word), native), [result, exception, *arguments])
            return builder.load(result)

        return entry.signature, generate

    caller: Compiled = call
    return caller


def _word_of(builder: Any, name: str) -> Any:
    known = builder.module.globals.get(name)
    if known is not None:
        return known
    word = ir.GlobalVariable(builder.module, _WORD, name)
    word.linkage = "external"
    return word
