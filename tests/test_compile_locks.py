"""Processes that need the same function compile it once, and none waits for one that is gone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numba
import pytest
from filelock import FileLock

from rl2grid import compile_locks, compile_notices
from rl2grid.compile_locks import CompileLock

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")

SCRIPT = """
import time
from numba.core import event
from rl2grid.compile import jit

class Counter(event.Listener):
    compiled = 0

    def on_start(self, what):
        Counter.compiled += 1
        print("compiling", flush=True)
        time.sleep({seconds})

    def on_end(self, what):
        pass

def inner(x):
    return x + 1

def outer(x):
    return inner(x) * 2

inner.__module__ = outer.__module__ = "rl2grid.mdp.state"
inner = jit(inner)
outer = jit(outer)
event.register("numba:compile", Counter())
print(outer(1), Counter.compiled)
"""


def start(folder: Path, seconds: float, cache: Path | None = None) -> subprocess.Popen[str]:
    """A process whose compilation of each of two functions takes so long at least."""
    slow = folder / "seconds.txt"
    slow.write_text(str(seconds))
    script = folder / "script.py"  # machine code belongs to a file and its content
    if not script.exists():  # another process may be reading it
        script.write_text(SCRIPT.format(seconds=f"float(open({str(slow)!r}).read())"))
    variables = {name: value for name, value in os.environ.items() if name != compile_notices.VARIABLE}
    variables["XDG_CACHE_HOME"] = str(cache or folder / "cache")
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, script], stdout=pipe, stderr=pipe, text=True, env=variables)


def end_of(process: subprocess.Popen[str]) -> tuple[int, int, str]:
    """What a process calculated, how many functions it compiled, and what it said."""
    out, said = process.communicate(timeout=60)
    value, compiled = out.splitlines()[-1].split()
    return int(value), int(compiled), said


def test_processes_that_start_at_once_compile_a_function_once(tmp_path: Path):
    processes = [start(tmp_path, seconds=1.5) for _ in range(3)]
    values, compiled, said = zip(*map(end_of, processes), strict=True)
    assert values == (4, 4, 4)
    assert sorted(compiled) == [0, 0, 2]
    for number, words in zip(compiled, said, strict=True):
        lines = [line for line in words.splitlines() if "another process compiles the rules" in line]
        assert len(lines) == (number == 0)
        assert ("compiled 2 functions in" in words) == (number == 2)


def test_a_compiler_that_was_killed_blocks_nobody(tmp_path: Path):
    first = start(tmp_path, seconds=600)
    assert first.stdout is not None
    assert first.stdout.readline() == "compiling\n"
    (tmp_path / "seconds.txt").write_text("0")
    first.send_signal(signal.SIGKILL)
    first.communicate()
    value, compiled, said = end_of(start(tmp_path, seconds=0))
    assert (value, compiled) == (4, 2)
    assert "another process" not in said
    assert end_of(start(tmp_path, seconds=0))[1] == 0


def test_a_folder_that_cannot_be_written_is_said_once(tmp_path: Path):
    file = tmp_path / "file"
    file.touch()
    value, compiled, said = end_of(start(tmp_path, seconds=0, cache=file / "cache"))
    assert (value, compiled) == (4, 2)
    assert said.count("compiled code cannot be kept in") == 1
    assert "every process compiles it again" in said


def test_a_function_that_takes_too_long_elsewhere_is_compiled_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(compile_locks, "_TELL_SECONDS", 0.02)
    monkeypatch.setattr(compile_locks, "_PATIENCE_SECONDS", 0.1)
    path = tmp_path / "code" / "function.lock"
    path.parent.mkdir()
    lock = CompileLock(path, "mine")
    with FileLock(path):
        assert not lock.take()
    assert lock.take()
    lock.release()


@pytest.mark.parametrize("error", [NotImplementedError("no flock"), OSError(37, "No locks available")])
def test_without_locks_everybody_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception):
    def refuse(*_: object, **__: object) -> None:
        raise error

    said: list[str] = []
    monkeypatch.setattr(compile_notices, "say", said.append)
    monkeypatch.setattr(FileLock, "acquire", refuse)
    for name in ("one", "other"):
        assert not CompileLock(tmp_path / "code" / f"{name}.lock", "mine").take()
    assert said == [f"the file system of {tmp_path} has no locks: processes that start at once all compile."]
