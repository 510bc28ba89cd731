"""Trainings in processes of their own that are killed: from outside, or by themselves at the worst moments.

As a program, ``killed_runs.py <folder> <moment> <algorithm> <task> <changes>`` begins or resumes the toy run of
:mod:`toy_runs` in the folder. A moment is ``place:count``: it dies when it comes to the place for that time.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from toy_runs import environment, falling, toy_envs, toy_run

from rl2grid.algorithms import replay
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.records import metrics
from rl2grid.training import runs

KILLED = 9
"""Exit status of a process that died at its moment."""
NEVER = "never:1"


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
    words = [sys.executable, __file__, str(folder), moment, algorithm, task, json.dumps(changes)]
    with subprocess.Popen(words, env=environment(), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        if after_seconds is not None:
            time.sleep(after_seconds)
            process.kill()
        return process.wait()


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

    def save(value: Any, file: Any, original: Any = torch.save) -> None:
        moment.at("before-write")
        original(value, file)
        if moment.is_next("mid-write"):
            file.truncate(file.tell() // 2)
            file.flush()
        moment.at("mid-write")

    def replace(source: Any, target: Any, original: Any = os.replace) -> None:
        moment.at("before-replace")
        original(source, target)
        moment.at("after-replace")

    torch.save, os.replace = save, replace


def die_while_recording(moment: Moment) -> None:
    """``mid-row`` of ``metrics.csv``."""

    def writer(self: Any, *arguments: Any, original: Any = metrics.MetricsFile.__init__, **keywords: Any) -> None:
        original(self, *arguments, **keywords)
        self._file = Csv(self._file, moment)
        self._csv = metrics.csv.writer(self._file, lineterminator="\n")

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


def main(folder: Path, moment: str, algorithm: str, task: str, changes: dict[str, Any]) -> None:
    own = Moment(moment)
    die_while_saving(own)
    die_while_recording(own)
    die_while_remembering(own)
    if moment == NEVER:
        slow_down(algorithm)
    print("ready", flush=True)
    if folder.exists():
        runs.resume(folder, evaluate=falling, make_envs=toy_envs)
    else:
        runs.train(toy_run(folder, algorithm, task, **changes), evaluate=falling, make_envs=toy_envs)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:5], json.loads(sys.argv[5]))
