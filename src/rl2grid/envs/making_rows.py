"""Who plays the rows of a vector environment is chosen by its engine."""

from __future__ import annotations

import os

from rl2grid.envs.options import TaskOptions
from rl2grid.envs.rows import Rows
from rl2grid.envs.tasks import Task
from rl2grid.errors import UsageError


def make_rows(
    task: Task, options: TaskOptions, n: int, *, num_threads: int | None = None, num_workers: int | None = None
) -> Rows:
    """``n`` rows of ``task`` on the engine of ``options``.

    Args:
        task: the task.
        options: the keywords that the environments are made with.
        n: number of rows.
        num_threads: native engine: threads that share the rows; None takes one per processor core.
        num_workers: reference engine: processes that share them; 0 plays in this one; None takes one per core.

    Raises:
        UsageError: threads for the reference engine, or processes for the native one.
    """
    # Each engine is imported where it is used: it loads much that the other does not need.
    if options.engine == "native":
        _refuse("num_workers", num_workers, "num_threads", options.engine)
        from rl2grid.envs.native_rows import NativeRows

        return NativeRows(task, options, n, num_threads)
    _refuse("num_threads", num_threads, "num_workers", options.engine)
    workers = min(n, os.cpu_count() or 1) if num_workers is None else min(n, num_workers)
    if workers == 0:
        from rl2grid.envs.local_rows import LocalRows

        return LocalRows(task, options, n)
    from rl2grid.envs.remote_rows import RemoteRows

    return RemoteRows(task, options, n, workers)


def _refuse(keyword: str, value: int | None, instead: str, engine: str) -> None:
    if value is not None:
        raise UsageError(f"{keyword}={value!r} is not for engine={engine!r}: give {instead}.")
