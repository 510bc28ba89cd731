"""Agents of a user's own, by where they are written: ``package.module:Agent``, ``./agent.py``, ``./agent.py:Agent``."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import os
import re
import sys
import traceback
from pathlib import Path
from types import ModuleType
from typing import Any

from rl2grid.agents.agent import Agent
from rl2grid.errors import UsageError

_MODULE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_METHODS = ("bind", "reset", "act")
_CONTRACT = "an agent has a name and the methods bind(env), reset(i) and act(observation, info)"


def is_own(spec: str) -> bool:
    """Whether ``spec`` says where an agent of a user's own is written."""
    place, colon, _ = _parts(spec)
    return place.endswith(".py") or bool(colon and _MODULE.fullmatch(place) and not Path(spec).exists())


def load_own_agent(spec: str) -> Agent:
    """Import what ``spec`` names, which runs that code, and make the agent.

    A class, or a function without arguments, is called; anything else is the agent itself. Of a file without a name
    the only class that has the methods of an agent is taken. The folder of the file, or the working folder for a
    module, is where further imports are looked for too, as for ``python file.py`` and ``python -m module``. An agent
    that does not say by ``identity`` what it is a version of is identified by the hash of its file.

    Raises:
        UsageError: there is no such module, file or name, it cannot be imported, or what it names is no agent.
    """
    place, _, name = _parts(spec)
    module = _import_file(Path(place)) if place.endswith(".py") else _import_module(place)
    maker = _only_class(module, place) if not name else getattr(module, name, None)
    if maker is None:
        raise UsageError(f"{place} has no {name!r}: {_offered(module)}.")
    agent = _made(maker, spec)
    if not hasattr(agent, "identity"):
        # Of the class, for agents whose attributes are fixed.
        type(agent).identity = {"source_hash": _source_hash(module)}  # type: ignore[attr-defined]
    return agent


def _parts(spec: str) -> tuple[str, str, str]:
    """File or module, colon, name; the colon of a drive belongs to the file."""
    place, colon, name = spec.rpartition(":")
    return (place, colon, name) if colon and name.isidentifier() else (spec, "", "")


def _import_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise UsageError(f"There is no file {str(path)!r}: give the path of a Python file with an agent.")
    if not path.stem.isidentifier():
        raise UsageError(f"{path.name} cannot be imported: use letters, digits and '_' only in the name of the file.")
    _look_in(path.parent)
    module = _import_module(path.stem)
    if module.__file__ is None or not os.path.samefile(module.__file__, path):
        raise UsageError(f"{path.name} has the name of another module, {path.stem}: give the file another name.")
    return module


def _import_module(name: str) -> ModuleType:
    _look_in(Path())
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and (name == error.name or name.startswith(f"{error.name}.")):
            raise UsageError(f"There is no module {name!r}: {error}; install it, or go to its folder.") from None
        raise UsageError(f"{name} cannot be imported: {error}.") from error
    except Exception as error:
        raise UsageError(f"{name} cannot be imported: {_what_went_wrong(error)}.") from error


def _source_hash(module: ModuleType) -> str:
    return "" if module.__file__ is None else hashlib.sha256(Path(module.__file__).read_bytes()).hexdigest()[:16]


def _look_in(folder: Path) -> None:
    # Last: a file of the user takes no module of a library away.
    if str(folder.resolve()) not in sys.path:
        sys.path.append(str(folder.resolve()))


def _what_went_wrong(error: Exception) -> str:
    """The error and the line of the user's code, in one line."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    place = (error.filename, error.lineno) if isinstance(error, SyntaxError) else (last.filename, last.lineno)
    words = " ".join(str(getattr(error, "msg", error)).split()).rstrip(".")
    return f"{type(error).__name__} in line {place[1]} of {Path(str(place[0])).name}: {words}"


def _only_class(module: ModuleType, place: str) -> Any:
    found = _agent_classes(module)
    if len(found) != 1:
        which = f"it has {', '.join(found)}" if found else f"it has none, and {_CONTRACT}"
        raise UsageError(f"{place} does not hold exactly one agent: {which}; name it as {place}:NAME.")
    return getattr(module, found[0])


def _agent_classes(module: ModuleType) -> list[str]:
    return [
        name
        for name, value in vars(module).items()
        if inspect.isclass(value)
        and value.__module__ == module.__name__
        and all(callable(getattr(value, method, None)) for method in _METHODS)
    ]


def _offered(module: ModuleType) -> str:
    found = _agent_classes(module)
    return f"choose one of {', '.join(found)}" if found else f"it has no agent at all, and {_CONTRACT}"


def _made(maker: Any, spec: str) -> Agent:
    made = maker
    if inspect.isclass(maker) or inspect.isroutine(maker):
        try:
            inspect.signature(maker).bind()
        except TypeError as error:
            raise UsageError(f"{spec} cannot be made without arguments: {error}; give them defaults.") from None
        try:
            made = maker()
        except UsageError:
            raise
        except Exception as error:
            raise UsageError(f"{spec} cannot be made: {_what_went_wrong(error)}.") from error
    missing = [method for method in _METHODS if not callable(getattr(made, method, None))]
    if missing:
        raise UsageError(f"{spec} has no {' and no '.join(missing)}: {_CONTRACT}.")
    if not isinstance(getattr(made, "name", None), str) or not made.name:
        raise UsageError(f"{spec} has no name: {_CONTRACT}, such as name = 'mine', which tables call it by.")
    agent: Agent = made
    return agent
