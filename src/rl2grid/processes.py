"""Processes that serve their parent: requests on the standard input, answers on the standard output."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from typing import BinaryIO


def take_standard_streams() -> tuple[BinaryIO, BinaryIO]:
    """Where a worker process reads requests and writes answers; what a library prints goes to the standard error."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    # An interrupt from the keyboard reaches the whole group: the parent decides when workers end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return sys.stdin.buffer, answers


def kill(process: subprocess.Popen[bytes], reader: threading.Thread) -> None:
    """End a worker process, whatever it is doing, and the parent's thread that collects its answers."""
    process.kill()
    process.wait()
    reader.join()
    for pipe in (process.stdin, process.stdout):
        assert pipe is not None
        with contextlib.suppress(BrokenPipeError):  # what was not sent yet is lost with the process
            pipe.close()
