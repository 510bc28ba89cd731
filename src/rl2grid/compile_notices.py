"""Says when something is compiled, which takes up to minutes the first time and would be silent otherwise.

Numba tells of every function that it compiles, and of none that it finds in the cache. One line on standard error says
that compilation begins, here or in another process for which this one waits, others how far it is, and one that it is
over; with or without a terminal.
"""

from __future__ import annotations

import atexit
import os
import sys
import threading
import time
from typing import Any

VARIABLE = "RL2GRID_QUIET"
"""Environment variable: when it is set, nothing is said."""

_LONG = "a minute or two, on a busy machine several"
_PAUSE_SECONDS = 2.0
"""Compilation is over when none begins for this long: one call of a user compiles many functions in turn."""
_PROGRESS_SECONDS = 10.0

_PARTS = {
    "rl2grid.engines": "the engine",
    "rl2grid.powerflow": "the power flow",
    "rl2grid.scenarios": "what makes the months",
    "rl2grid.mdp": "the rules",
    "rl2grid.dense": "the networks",
}
"""What the functions of a layer are, for people."""


class Notices:
    """Told by Numba of the beginning and the end of every compilation; those within one another are of one call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth = self._functions = 0
        self._began: float | None = None
        self._ended = self._told = 0.0
        self._timer: threading.Timer | None = None

    def notify(self, event: Any) -> None:
        """Numba calls it."""
        part = _part(str(getattr(event.data["dispatcher"].py_func, "__module__", "")))
        if part is not None:
            self._begin(part) if event.is_start else self._end(part)

    def wait(self, module: str) -> None:
        """Called about once a second while another process compiles a function of a module."""
        part = _part(module)
        if part is None:
            return
        with self._lock:
            self._open(f"another process compiles {part} for this machine, which may take {_LONG}; this one waits.")
            self._go_on(part)
            if self._depth == 0:
                self._close_later()

    def _begin(self, part: str) -> None:
        with self._lock:
            self._depth += 1
            self._open(f"compiling {part} for this machine, once per installation; this may take {_LONG}.")

    def _end(self, part: str) -> None:
        with self._lock:
            self._depth = max(self._depth - 1, 0)
            self._functions += 1
            self._go_on(part)
            if self._depth == 0:
                self._close_later()

    def _open(self, words: str) -> None:
        """Say the first line, if nothing was going on."""
        self._stop_timer()
        if self._began is None:
            self._began = self._told = time.monotonic()
            self._functions = 0
            say(words)

    def _go_on(self, part: str) -> None:
        """Say how far it is, now and then."""
        self._ended = time.monotonic()
        if self._began is not None and self._ended - self._told >= _PROGRESS_SECONDS:
            self._told = self._ended
            done = f": {self._counted} in" if self._functions else " in another process:"
            say(f"still compiling {part}{done} {self._ended - self._began:.0f} s so far.")

    def _close_later(self) -> None:
        """Say the last line in a while, unless it goes on."""
        self._stop_timer()
        self._timer = threading.Timer(_PAUSE_SECONDS, self.finish)
        self._timer.daemon = True
        self._timer.start()

    def finish(self) -> None:
        """Say that it is over, unless it is not."""
        with self._lock:
            if self._depth or self._began is None:
                return
            seconds, self._began = self._ended - self._began, None
            did = f"compiled {self._counted}" if self._functions else "another process has compiled it"
            say(f"{did} in {seconds:.1f} s.")

    @property
    def _counted(self) -> str:
        return "1 function" if self._functions == 1 else f"{self._functions} functions"

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def _part(module: str) -> str | None:
    """What the functions of a module belong to; None: it is not of this package."""
    if not module.startswith("rl2grid."):
        return None
    return _PARTS.get(".".join(module.split(".")[:2]), "rl2grid")


def say(words: str) -> None:
    """A line on standard error, unless nothing is to be said."""
    if VARIABLE not in os.environ and sys.stderr is not None:
        print(f"rl2grid: {words}", file=sys.stderr, flush=True)


NOTICES = Notices()
"""Of this process."""


def install() -> None:
    """Have Numba tell of its compilations from now on."""
    # Imported here: the name of the variable is wanted where nothing is compiled.
    from numba.core import event

    event.Listener.register(Notices)
    event.register("numba:compile", NOTICES)
    atexit.register(NOTICES.finish)
