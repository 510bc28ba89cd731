"""Threads of the native engine are there in a process that was forked."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from rl2grid.engines.native.threads import Threads


def test_a_forked_process_has_threads_of_its_own():
    threads = Threads(2, "test")
    assert list(threads.map(abs, [-1, 2])) == [1, 2]
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # one that waits for its parent's threads waits for ever
        os._exit(0 if list(threads.map(abs, [-3, 4])) == [3, 4] else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_the_thread_that_asks_works_too_and_waits_for_the_others():
    done: list[tuple[int, str]] = []

    def note(number: int) -> int:
        done.append((number, threading.current_thread().name))
        if number == 0:
            raise ValueError("the first part cannot be played")
        time.sleep(0.05)
        return number

    threads = Threads(2, "test")
    with pytest.raises(ValueError, match="first part"):
        threads.map(note, range(3))
    assert [number for number, _ in sorted(done)] == [0, 1, 2], "what was handed out is over"
    names = {name for _, name in done}
    assert threading.current_thread().name in names
    assert len(names) == 2
