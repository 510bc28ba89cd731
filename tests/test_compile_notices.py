"""What is compiled is said, before and after; what is read from the cache is not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rl2grid import compile_notices

SCRIPT = """
import sys
from rl2grid.compile import jit

def inner(x):
    return x + 1

def outer(x):
    return inner(x) * 2

inner.__module__ = outer.__module__ = {module!r}
inner = jit(inner)
outer = jit(outer)
print(outer(1))
"""


def told(folder: Path, module: str = "rl2grid.mdp.state", **environment: str) -> str:
    script = folder / "script.py"
    script.write_text(SCRIPT.format(module=module))
    variables = {name: value for name, value in os.environ.items() if name != compile_notices.VARIABLE}
    variables |= {"XDG_CACHE_HOME": str(folder / "cache"), **environment}
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, env=variables, check=True)
    assert done.stdout == "4\n"
    return done.stderr


def test_a_first_compilation_has_a_line_before_and_one_after(tmp_path: Path):
    first, last = told(tmp_path).splitlines()
    assert first.startswith("rl2grid: compiling the rules for this machine, once per installation")
    assert last.startswith("rl2grid: compiled 2 functions in ")
    assert told(tmp_path) == ""  # it was kept


@pytest.mark.parametrize(
    ("module", "environment"), [("mine", {}), ("rl2grid.mdp.state", {compile_notices.VARIABLE: "1"})]
)
def test_functions_of_a_user_and_quiet_commands_say_nothing(tmp_path: Path, module: str, environment: dict[str, str]):
    assert told(tmp_path, module, **environment) == ""


def event(*, start: bool, module: str = "rl2grid.engines.native.advance") -> Any:
    dispatcher = SimpleNamespace(py_func=SimpleNamespace(__module__=module))
    return SimpleNamespace(is_start=start, data={"dispatcher": dispatcher})


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is said; every look at the clock is six seconds after the last one."""
    words: list[str] = []
    clock = iter(range(0, 1000, 6))
    monkeypatch.setattr(compile_notices, "say", words.append)
    monkeypatch.setattr(compile_notices.time, "monotonic", lambda: next(clock))
    return words


def test_a_long_compilation_says_how_far_it_is(said: list[str]):
    notices = compile_notices.Notices()
    notices.notify(event(start=True))
    for _ in range(3):
        notices.notify(event(start=True))
        notices.notify(event(start=False))
    notices.notify(event(start=True, module="mine"))
    notices.finish()  # not yet: the outermost is not over
    notices.notify(event(start=False))
    notices.finish()
    notices.finish()
    assert said == [
        "compiling the engine for this machine, once per installation; this may take a minute or two, on a busy "
        "machine several.",
        "still compiling the engine: 2 functions in 12 s so far.",
        "still compiling the engine: 4 functions in 24 s so far.",
        "compiled 4 functions in 24.0 s.",
    ]


def test_who_waits_for_another_process_says_so(said: list[str]):
    notices = compile_notices.Notices()
    notices.wait("mine")
    for _ in range(3):
        notices.wait("rl2grid.engines.native.advance")
    notices.finish()
    assert said == [
        "another process compiles the engine for this machine, which may take a minute or two, on a busy machine "
        "several; this one waits.",
        "still compiling the engine in another process: 12 s so far.",
        "another process has compiled it in 18.0 s.",
    ]
