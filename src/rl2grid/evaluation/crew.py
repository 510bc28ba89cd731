"""Who plays many episodes, those of an evaluation for one: this process, or several worker processes.

What is done with an episode is the part of a :class:`Player`, which every process makes of a copy of the same
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
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, BinaryIO, Generic, NamedTuple, Protocol, Self, TypeVar

import gymnasium

from rl2grid.agents.agent import Action, Agent, Info
from rl2grid.envs.registration import own_systems, register_all, register_system
from rl2grid.errors import UsageError
from rl2grid.evaluation.episode import OnTransition, play_episode
from rl2grid.processes import kill, take_standard_streams
from rl2grid.records.episodes import Episode

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
    """Plays one episode after the other, and tells what is to be known of each."""

    def play(self, job: Job, on_progress: OnProgress) -> Told:
        """Play an episode."""

    def close(self) -> None:
        """Free what it plays with."""


class Setup(Protocol[Told]):
    """What all episodes have in common; it can be pickled."""

    def player(self) -> Player[Told]:
        """Who plays them in this process.

        Raises:
            UsageError: the environment or the agent cannot be made, or do not fit.
        """


@dataclass(frozen=True)
class Setting:
    """What all episodes of an evaluation have in common."""

    task: str
    agent: Agent
    """Not bound yet; workers play copies of it."""
    env_keywords: Mapping[str, Any] = field(default_factory=dict)
    """Keywords of ``gymnasium.make``."""
    abreast: int = 1
    """Episodes that this process plays at the same time, where it plays them."""

    def player(self) -> BoundAgent:
        """The agent, bound to an environment."""
        return BoundAgent(self)


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


class BoundAgent:
    """One environment and the agent bound to it."""

    def __init__(self, setting: Setting) -> None:
        register_all()
        self._env = gymnasium.make(setting.task, disable_env_checker=True, **setting.env_keywords)
        try:
            self._agent = setting.agent
            self._agent.bind(self._env)
        except BaseException:
            self._env.close()
            raise

    def play(self, job: Job, on_progress: OnProgress, on_transition: OnTransition | None = None) -> Episode:
        """Play an episode; ``on_transition`` is told what came of every action."""
        told = time.monotonic()

        def tell(action: Action, info: Info) -> None:
            nonlocal told
            if time.monotonic() - told >= REPORT_SECONDS:
                told = time.monotonic()
                on_progress(Progress(job, int(info["step"]), int(info["episode_length"])))

        return play_episode(
            self._agent,
            self._env,
            scenario=job.scenario,
            seed=job.seed,
            start=job.start,
            on_decision=tell,
            on_transition=on_transition,
        )

    def close(self) -> None:
        """Free the environment."""
        self._env.close()


class LocalCrew(Generic[Result]):
    """Plays in this process, one episode after the other."""

    def __init__(self, setup: Setup[Result]) -> None:
        self._setup = setup
        self._player: Player[Result] | None = None

    def play(self, jobs: Sequence[Job], on_progress: OnProgress) -> Iterator[tuple[Job, Result]]:
        """See :class:`Crew`."""
        self._player = self._setup.player()
        for job in jobs:
            yield job, self._player.play(job, on_progress)

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
        waiting = list(reversed(jobs))
        open_jobs = len(waiting)
        for _ in range(min(self._workers, open_jobs)):
            worker = _Worker(self._setup, self._answers)
            self._running.append(worker)
            worker.send(waiting.pop())
        while open_jobs:
            worker, outcome, value = self._next_answer()
            if outcome == "refused":
                raise UsageError(value)
            if outcome == "failed":
                raise RuntimeError(f"A worker failed while it played {worker.job}:\n{value}")
            if outcome == "died":
                raise RuntimeError(f"A worker died with exit status {value} while it played {worker.job}.")
            if outcome == "progress":
                on_progress(value)
                continue
            open_jobs -= 1
            job = worker.job
            assert job is not None
            if waiting:
                worker.send(waiting.pop())
            yield job, value

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._running:
            worker.kill()

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
        self.job: Job | None = None
        """What it plays."""
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

    def send(self, job: Job) -> None:
        """Ask for an episode."""
        self.job = job
        self._send(job)

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
        player = pickle.load(requests).player()
        while True:
            try:
                job = pickle.load(requests)
            except EOFError:
                break
            answer("played", player.play(job, lambda progress: answer("progress", progress)))
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
