"""Threads of the native engine are there in a process that was forked."""

from __future__ import annotations

import os
import signal

from rl2grid.engines.native.threads import Threads


def test_a_forked_process_has_threads_of_its_own():
    threads = Threads(2, "test")
    assert list(threads.map(abs, [-1, 2])) == [1, 2]
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # one that waits for its parent's threads waits for ever
        os._exit(0 if list(threads.map(abs, [-3, 4])) == [3, 4] else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
