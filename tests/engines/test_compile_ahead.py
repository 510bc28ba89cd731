"""What is compiled beside a process is what the process calls, and nobody outlives his parent."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import gymnasium
import numba
import pytest

from rl2grid import compile_beside
from rl2grid.compile import cache_directory
from rl2grid.compile_beside import take_turn
from rl2grid.compiled_files import is_kept
from rl2grid.engines.native import compile_ahead
from rl2grid.engines.native.advance import advance

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")

PARENT = """
import sys, time
from pathlib import Path
from rl2grid.compile_beside import _STARTED, compile_beside
compile_beside("sleeper", Path({folder!r}))
print(_STARTED[0].pid, flush=True)
time.sleep({seconds})
"""
SLEEPER = """
import time
from rl2grid.compile_beside import end_with_the_parent
end_with_the_parent()
time.sleep(600)
"""


def test_the_transition_is_called_with_what_is_compiled_ahead():
    env = gymnasium.make("rl2grid/bus14-T0-v0", split="bundled")
    env.reset(seed=0)
    env.step(0)
    assert tuple(advance.nopython_signatures[0].args) == compile_ahead.SIGNATURE
    assert len(advance.signatures) == 1
    assert is_kept(advance, compile_ahead.SIGNATURE)


def test_what_is_there_is_not_compiled_ahead(monkeypatch: pytest.MonkeyPatch):
    asked: list[tuple[str, Path]] = []
    monkeypatch.setattr(compile_ahead, "compile_beside", lambda *arguments: asked.append(arguments))
    monkeypatch.setattr(compile_ahead, "is_kept", lambda *_: True)
    compile_ahead.compile_ahead()
    assert asked == []
    monkeypatch.setattr(compile_ahead, "is_kept", lambda *_: False)
    compile_ahead.compile_ahead()
    assert asked == [("rl2grid.engines.native.compile_ahead", cache_directory())]


def test_one_process_compiles_beside_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    started: list[list[str]] = []

    class Process:
        def __init__(self, command: list[str], **_: object) -> None:
            started.append(command)

        def wait(self) -> None:
            pass

    monkeypatch.setattr(subprocess, "Popen", Process)
    monkeypatch.setattr(compile_beside, "_STARTED", [])
    monkeypatch.setattr(compile_beside, "_cores", lambda: 2)
    monkeypatch.delenv(compile_beside.VARIABLE, raising=False)
    compile_beside.compile_beside("module", tmp_path / "code")
    assert [command[-1] for command in started] == ["module"]
    turn = take_turn(tmp_path / "code")
    compile_beside.compile_beside("module", tmp_path / "code")
    assert turn is not None
    turn.release()
    monkeypatch.setattr(compile_beside, "_cores", lambda: 1)
    compile_beside.compile_beside("module", tmp_path / "code")
    monkeypatch.setenv(compile_beside.VARIABLE, "0")
    monkeypatch.setattr(compile_beside, "_cores", lambda: 2)
    compile_beside.compile_beside("module", tmp_path / "code")
    assert len(started) == 1


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks at processes as Linux shows them")
@pytest.mark.parametrize("killed", [True, False])
def test_it_ends_with_its_parent(tmp_path: Path, killed: bool):
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    code = PARENT.format(folder=str(tmp_path), seconds=600 if killed else 0)
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    variables = os.environ | {"PYTHONPATH": paths, compile_beside.VARIABLE: "1"}
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=variables)
    assert parent.stdout is not None
    child = Path("/proc", parent.stdout.readline().strip())
    if killed:
        parent.kill()
    parent.communicate(timeout=30)
    deadline = time.monotonic() + 30
    while _runs(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _runs(child)


def _runs(process: Path) -> bool:
    try:
        return process.joinpath("stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
