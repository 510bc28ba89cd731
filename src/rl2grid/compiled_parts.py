"""Compiled functions that compiled functions call: optimised where they are called, and not before.

Numba optimises every function that it compiles, makes machine code of it, and gives to callers what it has optimised,
which is optimised again with them, at every level of calls. Here a function that a compiled one calls is a *part*: its
types are inferred, it is lowered, and that is all. One that Python calls is a *whole*: it is optimised once, with all
its parts, and machine code is made of it. A function may be both, each of which is compiled when it is asked for.

Only wholes are kept between runs. What parts compute does not depend on where they are optimised: floating point is
strict.
"""

from __future__ import annotations

import threading
from typing import Any

from numba.core import sigutils
from numba.core.caching import NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher


class _Asked(threading.local):
    """What this thread asks for."""

    part = False


_ASKED = _Asked()


class Part(JITCodeLibrary):  # type: ignore[misc]
    """The code of a function and of its parts, for callers to link."""

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self.environments: dict[str, Any] = {}
        """What functions need of Python, by the name of the variable that leads to it."""

    @property
    def codegen(self) -> Any:
        """Where Numba puts the environment of the function when it has machine code, which a part never has."""
        return _Environments(self.environments)

    def finalize(self) -> None:
        """Link, and nothing else."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self.environments.update(_environments_of(self._linking_libraries))
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """None: there is no machine code."""
        self._ensure_finalized()
        return 0


class _Environments:
    """Takes environments from Numba."""

    def __init__(self, taken: dict[str, Any]) -> None:
        self._taken = taken

    def set_env(self, name: str, environment: Any) -> None:
        """Numba calls it."""
        self._taken[name] = environment


class Whole(JITCodeLibrary):  # type: ignore[misc]
    """The machine code of a function, with its parts."""

    def finalize(self) -> None:
        """As Numba does; the variables of parts lead to their environments, which live as long as the code."""
        super().finalize()
        self._environments = _environments_of(self._linking_libraries)
        for variable in self._final_module.global_variables:
            if variable.name in self._environments:
                self._codegen.set_env(variable.name, self._environments[variable.name])


def _environments_of(libraries: list[Any]) -> dict[str, Any]:
    """Environments of all parts among some libraries."""
    found: dict[str, Any] = {}
    for library in libraries:
        if isinstance(library, Part):
            found.update(library.environments)
    return found


class Pipeline(Compiler):  # type: ignore[misc]
    """Numba's, which makes a part or a whole."""

    def compile_extra(self, function: Any) -> Any:
        """Numba calls it, with a Python function."""
        state = self.state
        state.flags.no_cfunc_wrapper = True
        state.flags.no_cpython_wrapper = _ASKED.part
        kind = Part if _ASKED.part else Whole
        state.library = kind(state.targetctx.codegen(), function.__qualname__)
        state.library.enable_object_caching()
        return super().compile_extra(function)


def part_for_compiled_callers(compiled: Any) -> None:
    """Compile a function of ``numba.njit`` with :class:`Pipeline` as a part for those that are compiled themselves."""
    if not hasattr(compiled, "get_call_template"):  # Numba is told not to compile
        return
    typed, compile_whole, add_whole = compiled.get_call_template, compiled.compile, compiled.add_overload

    def get_call_template(*arguments: Any) -> Any:
        with _Asking(part=True):
            return typed(*arguments)

    def compile_asked(signature: Any) -> Any:
        if _ASKED.part:
            return _compile_part(compiled, signature)
        with global_compiler_lock, _Asking(part=False):
            _forget_part(compiled, signature)
            return compile_whole(signature)

    def add_overload(result: Any) -> None:
        if isinstance(result.library, Part):  # Python cannot call it
            compiled.overloads[tuple(result.signature.args)] = result
        else:
            add_whole(result)

    compiled.get_call_template, compiled.compile, compiled.add_overload = get_call_template, compile_asked, add_overload


class _Asking:
    """What this thread asks for, as long as the context lasts."""

    def __init__(self, part: bool) -> None:
        self._part, self._before = part, _ASKED.part

    def __enter__(self) -> None:
        self._before, _ASKED.part = _ASKED.part, self._part

    def __exit__(self, *error: object) -> None:
        _ASKED.part = self._before


def _compile_part(compiled: Any, signature: Any) -> Any:
    """Compile without files: parts are not kept."""
    with global_compiler_lock:
        kept, compiled._cache = compiled._cache, NullCache()
        try:
            return Dispatcher.compile(compiled, signature)
        finally:
            compiled._cache = kept


def _forget_part(compiled: Any, signature: Any) -> None:
    """Numba has one result for each type of arguments: a whole takes the place of a part."""
    types, _ = sigutils.normalize_signature(signature)
    result = compiled.overloads.get(tuple(types))
    if result is not None and isinstance(result.library, Part):
        del compiled.overloads[tuple(types)]
