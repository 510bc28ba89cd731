"""A process that plays some rows of a vector environment.

Started as ``python -m rl2grid.envs.worker``: unlike a forked process it inherits no threads, and unlike
:mod:`multiprocessing`'s spawn it does not import the caller's script again, which therefore needs no
``if __name__ == "__main__"``. Messages are pickles on its standard input and output; the series are
memory-mapped, so that all workers share one copy. It ends when its input does.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import traceback
from collections.abc import Callable
from typing import IO, Any, BinaryIO

import cloudpickle

from rl2grid.envs.local_rows import LocalRows
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.registration import own_systems, register_system
from rl2grid.envs.tasks import Task
from rl2grid.errors import UsageError
from rl2grid.processes import take_standard_streams


class Worker:
    """:class:`~rl2grid.envs.local_rows.LocalRows` in a process of its own.

    Call a method with :meth:`send`, collect its answer with :meth:`receive`.
    """

    def __init__(self, task: Task, options: TaskOptions, n: int) -> None:
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rl2grid.envs.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
        )
        # A reward may be a function of the caller's script, which this process does not import.
        self._write(lambda stream: cloudpickle.dump(("make", (own_systems(), task, options, n)), stream))

    def send(self, method: str, *arguments: Any) -> None:
        """Ask for ``method(*arguments)`` without waiting."""
        self._write(lambda stream: pickle.dump((method, arguments), stream, pickle.HIGHEST_PROTOCOL))

    def _write(self, dump: Callable[[IO[bytes]], None]) -> None:
        assert self._process.stdin is not None
        try:
            dump(self._process.stdin)
            self._process.stdin.flush()
        except BrokenPipeError:
            raise self._death() from None

    def receive(self) -> Any:
        """The answer to the oldest call that was not answered yet.

        Raises:
            UsageError: the call was refused.
            RuntimeError: the call failed, or the process died.
        """
        assert self._process.stdout is not None
        try:
            outcome, value = pickle.load(self._process.stdout)
        except EOFError:
            raise self._death() from None
        if outcome == "refused":
            raise UsageError(value)
        if outcome == "failed":
            raise RuntimeError(f"A worker of the vector environment failed:\n{value}")
        return value

    def close(self) -> None:
        """End the process."""
        if self._process.poll() is None and self._process.stdin is not None:
            self._process.stdin.close()
            try:
                self._process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _death(self) -> RuntimeError:
        code = self._process.wait()
        return RuntimeError(f"A worker of the vector environment died with exit status {code}.")


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer requests until they end."""
    rows: LocalRows | None = None
    while True:
        try:
            method, arguments = pickle.load(requests)
        except EOFError:
            break
        answer: tuple[str, Any] = ("done", None)
        try:
            if method == "make":
                systems, *description = arguments
                for system in systems:
                    register_system(system)
                rows = LocalRows(*description)
            else:
                answer = ("done", getattr(rows, method)(*arguments))
        except UsageError as error:
            answer = ("refused", str(error))
        except Exception:
            answer = ("failed", traceback.format_exc())
        pickle.dump(answer, answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()
    if rows is not None:
        rows.close()


def main() -> None:
    """Serve on the standard streams."""
    serve(*take_standard_streams())


if __name__ == "__main__":
    main()
