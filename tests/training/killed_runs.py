"""Trainings in processes of their own that are killed: from outside, or by themselves at the worst moments.

A moment is ``place:count``: the process dies when it comes to the place for that time. Processes are forked from one
that has loaded the libraries, which takes several seconds.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from toy_runs import falling, toy_envs, toy_run

from rl2grid.algorithms import replay
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.errors import UsageError
from rl2grid.records import metrics
from rl2grid.training import runs

KILLED = 9
"""Exit status of a process that died at its moment."""
NEVER = "never:1"
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(["killed_runs", "torch.utils.tensorboard"])


def run_until_killed(
    folder: Path,
    moment: str = NEVER,
    algorithm: str = "ppo",
    task: str = "bus14-T0",
    *,
    after_seconds: float | None = None,
    **changes: Any,
) -> int:
    """Train or resume in a process of its own; returns its exit status."""
    begun = FORKS.Event()
    process = FORKS.Process(target=main, args=(begun.set, folder, moment, algorithm, task, changes))
    process.start()
    assert begun.wait(60)
    if after_seconds is not None:
        time.sleep(after_seconds)
        process.kill()
    process.join()
    assert process.exitcode is not None
    return process.exitcode


def refusal_of_a_second_process(folder: Path) -> str:
    """What another process is told that goes on with a run."""
    mine, theirs = FORKS.Pipe()
    process = FORKS.Process(target=_try_to_resume, args=(folder, theirs))
    process.start()
    refusal: str = mine.recv()
    process.join()
    return refusal


def _try_to_resume(folder: Path, answers: Any) -> None:
    try:
        runs.resume(folder)
    except UsageError as error:
        answers.send(str(error))
    else:
        answers.send("")


class Moment:
    """When this process dies."""

    def __init__(self, moment: str) -> None:
        self.place, _, count = moment.partition(":")
        self.left = int(count)

    def is_next(self, place: str) -> bool:
        """Whether the next :meth:`at` this place is the end."""
        return place == self.place and self.left == 1

    def at(self, place: str) -> None:
        """Die like a killed process, if it is time."""
        if self.is_next(place):
            os._exit(KILLED)
        self.left -= place == self.place


class Csv:
    """A file that dies having written half of a row."""

    def __init__(self, file: Any, moment: Moment) -> None:
        self.file, self.moment = file, moment

    def write(self, text: str) -> int:
        if self.moment.is_next("mid-row"):
            self.file.write(text[: len(text) // 2])
            self.file.flush()
        self.moment.at("mid-row")
        return self.file.write(text)

    def flush(self) -> None:
        self.file.flush()

    def close(self) -> None:
        self.file.close()


def die_while_saving(moment: Moment) -> None:
    """``before-write`` and ``mid-write`` of a checkpoint, ``before-replace`` and ``after-replace`` of any file."""

    def sync(number: int, original: Any = os.fsync) -> None:
        moment.at("before-write")
        if moment.is_next("mid-write"):
            os.truncate(number, os.fstat(number).st_size // 2)
        moment.at("mid-write")
        original(number)

    def replace(source: Any, target: Any, original: Any = os.replace) -> None:
        moment.at("before-replace")
        original(source, target)
        moment.at("after-replace")

    os.fsync, os.replace = sync, replace


def die_while_recording(moment: Moment) -> None:
    """``mid-row`` of ``metrics.csv``."""

    def writer(self: Any, *arguments: Any, original: Any = metrics.MetricsFile.__init__, **keywords: Any) -> None:
        original(self, *arguments, **keywords)
        self._file = Csv(self._file, moment)

    metrics.MetricsFile.__init__ = writer


def die_while_remembering(moment: Moment) -> None:
    """``before-step``, when a step is added to a replay memory, and ``mid-replay``, within one of its writes."""

    def write(path: Path, position: int, content: bytes, original: Any = replay._write_at) -> None:
        if moment.is_next("mid-replay"):
            original(path, position, content[: len(content) // 2])
        moment.at("mid-replay")
        original(path, position, content)

    def add(self: Any, step: Any, original: Any = replay.ReplayMemory.add) -> None:
        moment.at("before-step")
        original(self, step)

    replay._write_at, replay.ReplayMemory.add = write, add


def slow_down(algorithm: str) -> None:
    """Iterations as long as those of a small task, for kills from outside."""
    trainer = find_algorithm(algorithm).trainer
    iterate = trainer.iterate

    def slow(self: Any) -> Any:
        time.sleep(0.02)
        return iterate(self)

    trainer.iterate = slow


def main(
    begin: Callable[[], None], folder: Path, moment: str, algorithm: str, task: str, changes: dict[str, Any]
) -> None:
    """Begin or resume the toy run of :mod:`toy_runs` in the folder."""
    own = Moment(moment)
    die_while_saving(own)
    die_while_recording(own)
    die_while_remembering(own)
    if moment == NEVER:
        slow_down(algorithm)
    begin()
    if folder.exists():
        runs.resume(folder, evaluate=falling, make_envs=toy_envs)
    else:
        runs.train(toy_run(folder, algorithm, task, **changes), evaluate=falling, make_envs=toy_envs)
