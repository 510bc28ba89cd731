"""Locks: one holder at a time, and none once its process has ended."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rl2grid.records.locks import LockedError, is_locked, locked, take_lock

HOLDER = """
import os, sys
from filelock import FileLock
lock = FileLock(sys.argv[1])
lock.acquire()
print("held", flush=True)
sys.stdin.read()
os._exit(9)
"""


def test_a_lock_has_one_holder_and_is_given_back(tmp_path: Path):
    assert not is_locked(tmp_path)
    assert list(tmp_path.iterdir()) == []  # to look makes no file
    with locked(tmp_path):
        assert is_locked(tmp_path)
        with pytest.raises(LockedError):
            take_lock(tmp_path)
        take_lock(tmp_path, ".search.lock").release()  # another lock of the same folder
    assert (tmp_path / ".lock").exists()
    assert not is_locked(tmp_path)
    with pytest.raises(ZeroDivisionError), locked(tmp_path):
        raise ZeroDivisionError
    take_lock(tmp_path).release()


def test_a_lock_goes_with_its_process(tmp_path: Path):
    holder = [sys.executable, "-c", HOLDER, str(tmp_path / ".lock")]
    with subprocess.Popen(holder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        assert is_locked(tmp_path)
        process.communicate()
    assert process.returncode == 9
    assert not is_locked(tmp_path)
