"""Who plays many episodes, those of an evaluation for one: this process, or several worker processes.

What is done with episodes is the part of a :class:`Player`, which every process makes of a copy of the same
:class:`Setup`.

A worker is a Python process that runs :func:`main`: it inherits no threads and does not import the
caller's script again. Messages are pickles on its standard input and output; it ends when its input does.
"""

from __future__ import annotations

import os
import pickle
import queue
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, BinaryIO, Generic, NamedTuple, Protocol, Self, TypeVar

from rl2grid.envs.registration import own_systems, register_system
from rl2grid.errors import UsageError
from rl2grid.processes import kill, take_standard_streams

REPORT_SECONDS = 0.5
"""Between two reports of how far running episodes are."""

_WORKER = "from rl2grid.evaluation.crew import main; main()"
"""Not ``python -m``: what a worker sends must be of the classes of this module, not of a ``__main__``.

With ``-P``, so that no file of the working folder takes the place of a library's; the path of this process is sent.
"""
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Workers are the parallelism: threads of theirs would only compete."""


Result = TypeVar("Result")
Told = TypeVar("Told", covariant=True)


class Job(NamedTuple):
    """One episode to be played."""

    scenario: str
    seed: int
    start: int | None
    """Row of the scenario at which it begins; None: drawn in training, else 0."""


class Progress(NamedTuple):
    """An episode is under way."""

    job: Job
    grid_steps: int
    """Played so far."""
    episode_length: int


OnProgress = Callable[[Progress], None]


class Player(Protocol[Told]):
    """Plays episodes, and tells what is to be known of each."""

    def play(self, jobs: Sequence[Job], on_progress: OnProgress) -> Iterator[tuple[Job, Told]]:
        """Play them, in no particular order."""

    def close(self) -> None:
        """Free what it plays with."""


class Setup(Protocol[Told]):
    """What all episodes have in common; it can be pickled."""

    @property
    def abreast(self) -> int:
        """Episodes that a player plays at a time."""

    def player(self, num_threads: int) -> Player[Told]:
        """Who plays them in this process.

        Args:
            num_threads: that it may use.

        Raises:
            UsageError: the environment or the agent cannot be made, or do not fit.
        """


class Crew(Protocol[Told]):
    """Plays episodes and tells of them as they go."""

    def play(self, jobs: Sequence[Job], on_progress: OnProgress) -> Iterator[tuple[Job, Told]]:
        """Play all jobs, in no particular order; ``on_progress`` is told of running ones at most twice a second.

        Raises:
            UsageError: the environment or the agent cannot be made, or do not fit.
            RuntimeError: an episode failed or a worker died.
        """

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def make_crew(setup: Setup[Result], workers: int) -> Crew[Result]:
    """``workers`` processes, or this one if there are to be none."""
    return WorkerCrew(setup, workers) if workers else LocalCrew(setup)


class LocalCrew(Generic[Result]):
    """Plays in this process."""

    def __init__(self, setup: Setup[Result]) -> None:
        self._setup = setup
        self._player: Player[Result] | None = None

    def play(self, jobs: Sequence[Job], on_progress: OnProgress) -> Iterator[tuple[Job, Result]]:
        """See :class:`Crew`."""
        self._player = self._setup.player(os.cpu_count() or 1)
        yield from self._player.play(jobs, on_progress)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._player is not None:
            self._player.close()


class WorkerCrew(Generic[Result]):
    """Plays in worker processes, each with a player of its own."""

    def __init__(self, setup: Setup[Result], workers: int) -> None:
        self._setup, self._workers = setup, workers
        self._answers: queue.SimpleQueue[tuple[_Worker, str, Any]] = queue.SimpleQueue()
        self._running: list[_Worker] = []

    def play(self, jobs: Sequence[Job], on_progress: OnProgress) -> Iterator[tuple[Job, Result]]:
        """See :class:`Crew`."""
        waiting, open_jobs = self._shares(jobs), len(jobs)
        for _ in range(min(self._workers, len(waiting))):
            worker = _Worker(self._setup, self._answers)
            self._running.append(worker)
            worker.send(waiting.pop())
        while open_jobs:
            worker, outcome, value = self._next_answer()
            if outcome == "refused":
                raise UsageError(value)
            if outcome == "failed":
                raise RuntimeError(f"A worker failed while it played {worker.playing}:\n{value}")
            if outcome == "died":
                raise RuntimeError(f"A worker died with exit status {value} while it played {worker.playing}.")
            if outcome == "progress":
                on_progress(value)
            elif outcome == "done":
                if waiting:
                    worker.send(waiting.pop())
            else:
                open_jobs -= 1
                yield value

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._running:
            worker.kill()

    def _shares(self, jobs: Sequence[Job]) -> list[Sequence[Job]]:
        """What is given to whoever is free, the last one first: an episode, or where many are played abreast all of its
        part.
        """
        if self._setup.abreast == 1:
            return [[job] for job in reversed(jobs)]
        n = min(self._workers, len(jobs))
        return [jobs[k::n] for k in range(n)]

    def _next_answer(self) -> tuple[_Worker, str, Any]:
        while True:
            # With a time limit, so that an interrupt from the keyboard is noticed on every system.
            try:
                return self._answers.get(timeout=REPORT_SECONDS)
            except queue.Empty:
                continue


class _Worker:
    """A worker process, and the thread that collects its answers."""

    def __init__(self, setup: Setup[Any], answers: queue.SimpleQueue[tuple[_Worker, str, Any]]) -> None:
        self._jobs: Sequence[Job] = ()
        self._answers = answers
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _WORKER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | _ONE_THREAD,
        )
        self._thread = threading.Thread(target=self._collect, daemon=True)
        self._thread.start()
        self._send(sys.path)
        self._send(own_systems())
        self._send(setup)

    @property
    def playing(self) -> str:
        """What it plays, in words."""
        return str(self._jobs[0]) if len(self._jobs) == 1 else f"{len(self._jobs)} episodes"

    def send(self, jobs: Sequence[Job]) -> None:
        """Ask for episodes."""
        self._jobs = jobs
        self._send(jobs)

    def kill(self) -> None:
        """End the process, whatever it is doing."""
        kill(self._process, self._thread)

    def _send(self, value: Any) -> None:
        assert self._process.stdin is not None
        try:
            pickle.dump(value, self._process.stdin, pickle.HIGHEST_PROTOCOL)
            self._process.stdin.flush()
        except BrokenPipeError:
            return  # the thread that collects its answers reports the death

    def _collect(self) -> None:
        assert self._process.stdout is not None
        while True:
            try:
                outcome, value = pickle.load(self._process.stdout)
            except (EOFError, pickle.UnpicklingError, ValueError):
                self._answers.put((self, "died", self._process.wait()))
                return
            self._answers.put((self, outcome, value))


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Play the episodes asked for until there are no more requests."""

    def answer(outcome: str, value: Any) -> None:
        pickle.dump((outcome, value), answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()

    try:
        # Before anything that is of the caller's own modules.
        sys.path += [folder for folder in pickle.load(requests) if folder not in sys.path]
        for system in pickle.load(requests):
            register_system(system)
        player = pickle.load(requests).player(1)
        while True:
            try:
                jobs = pickle.load(requests)
            except EOFError:
                break
            for played in player.play(jobs, lambda progress: answer("progress", progress)):
                answer("played", played)
            answer("done", None)
        player.close()
    except UsageError as error:
        answer("refused", str(error))
    except BrokenPipeError:
        return  # the parent is gone, nobody waits for the rest
    except Exception:
        answer("failed", traceback.format_exc())


def main() -> None:
    """Serve on the standard streams."""
    serve(*take_standard_streams())
