"""Plays the episodes of an evaluation side by side: all rows of the native engine in one call, all decisions in one.

What is played is what :func:`rl2grid.evaluation.episode.play_episode` plays of each episode, to the bit.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rl2grid.agents.agent import Actions, Agent, SideBySideAgent, nearest_of, no_intervention, repeated
from rl2grid.arrays import I64
from rl2grid.envs.native_rows import NativeRows
from rl2grid.envs.options import TaskOptions
from rl2grid.evaluation.collapse import collapse, overloaded_lines
from rl2grid.evaluation.crew import REPORT_SECONDS, Job, OnProgress, Progress
from rl2grid.evaluation.episode import TOTALS, Tally, bound_environment, environment_seed, episode_of
from rl2grid.records.episodes import Episode

_ABREAST = 32
"""Episodes that are under way at the same time where many can be."""


def episodes_abreast(agent: Agent, options: TaskOptions) -> int:
    """How many episodes a process plays at a time.

    More than one if the agent decides for many environments at once and compiled code steps them.
    """
    is_compiled = options.engine == "native" and not callable(options.reward)
    return _ABREAST if is_compiled and _decides_side_by_side(agent) else 1


def _decides_side_by_side(agent: Agent) -> bool:
    """Whether it does, and not by inheritance from an agent that acts otherwise, or by a word for another."""
    if "act" in getattr(agent, "__dict__", ()):
        return False
    nearest = nearest_of(type(agent), "act_side_by_side", "act")
    return nearest == "act_side_by_side" and isinstance(agent, SideBySideAgent) and agent.decides_side_by_side


class SideBySidePlayer:
    """Plays many episodes at a time.

    Args:
        task: id of the task.
        agent: not bound yet; a :class:`~rl2grid.agents.agent.SideBySideAgent`.
        env_keywords: keywords of ``gymnasium.make``.
        abreast: so many, at most.
        num_threads: share them.

    Raises:
        UsageError: the environment cannot be made, or the agent cannot play it.
    """

    def __init__(
        self, task: str, agent: Agent, env_keywords: Mapping[str, Any], abreast: int, num_threads: int
    ) -> None:
        self._agent, self._abreast, self._num_threads = agent, abreast, num_threads
        self._rows: NativeRows | None = None
        env = bound_environment(agent, task, env_keywords)
        base: Any = env.unwrapped
        self._task, self._options, self._nothing = base.task, base.options, no_intervention(env.action_space)
        env.close()

    def play(self, jobs: Sequence[Job], on_progress: OnProgress) -> Iterator[tuple[Job, Episode]]:
        """See :class:`~rl2grid.evaluation.crew.Player`."""
        self.close()
        n = min(len(jobs), self._abreast)
        self._rows = NativeRows(self._task, self._options, n, self._num_threads)
        table = _Table(self._agent, self._rows, repeated(self._nothing, n), n)
        yield from table.play(jobs, on_progress)

    def close(self) -> None:
        """Free the environments."""
        if self._rows is not None:
            self._rows.close()


class _Table:
    """The episodes that are under way, a row each."""

    def __init__(self, agent: Any, rows: NativeRows, actions: Actions, n: int) -> None:
        self._agent, self._rows, self._state, self._actions = agent, rows, rows.state, actions
        self._jobs: dict[int, Job] = {}
        self._steps, self._loadings = np.zeros(n, np.int64), np.zeros_like(self._state.rho)  # before the last decision
        self._totals = np.zeros((n, len(TOTALS)))
        self._refused = np.zeros((n, 2), np.int64)  # decisions that were illegal, and ambiguous
        self._seconds = np.zeros(n)

    def play(self, jobs: Sequence[Job], on_progress: OnProgress) -> Iterator[tuple[Job, Episode]]:
        """Play all of them, each as soon as a row is free."""
        waiting = list(reversed(jobs))
        for i in range(len(self._seconds)):
            yield from self._fill(i, waiting)
        told = time.monotonic()
        while self._jobs:
            rows = np.array(sorted(self._jobs))
            self._step(rows)
            over = self._state.terminated[rows] | self._state.truncated[rows]
            for i in rows[over].tolist():
                yield self._finish(i)
                yield from self._fill(i, waiting)
            if time.monotonic() - told >= REPORT_SECONDS:
                told = time.monotonic()
                self._tell(on_progress)

    def _fill(self, i: int, waiting: list[Job]) -> Iterator[tuple[Job, Episode]]:
        """Begin the next episode in row ``i``; one that ends before its first decision is told of at once."""
        while waiting:
            self._begin(i, waiting.pop())
            if not self._rows.is_over(i):
                return
            yield self._finish(i)

    def _begin(self, i: int, job: Job) -> None:
        """Begin an episode in row ``i``."""
        began = time.perf_counter()
        self._rows.begin(i, environment_seed(job.scenario, job.seed), {"scenario": job.scenario, "start": job.start})
        self._jobs[i] = job
        state = self._state
        self._totals[i] = (state.reset_reward[i], *state.reset_components[i], *state.reset_costs[i])
        self._refused[i] = 0
        self._steps[i] = state.step[i]
        self._seconds[i] = time.perf_counter() - began

    def _step(self, rows: I64) -> None:
        """Decide and play a transition in each of ``rows``."""
        began = time.perf_counter()
        state = self._state
        self._steps[rows], self._loadings[rows] = state.step[rows], state.rho[rows]
        observations = self._rows.observations_of(rows)
        _put(self._actions, rows, self._agent.act_side_by_side(observations, lambda: self._rows.action_masks()[rows]))
        self._rows.advance(rows, self._actions)
        self._totals[rows, 0] += state.transition_reward[rows]
        self._totals[rows, 1:] += np.hstack((state.transition_components[rows], state.transition_costs[rows]))
        self._refused[rows, 0] += state.illegal[rows]
        self._refused[rows, 1] += state.ambiguous[rows]
        self._seconds[rows] += (time.perf_counter() - began) / len(rows)

    def _finish(self, i: int) -> tuple[Job, Episode]:
        """The episode of row ``i``, which is over."""
        job, state = self._jobs.pop(i), self._state
        totals = dict(zip(TOTALS, self._totals[i].tolist(), strict=True))
        illegal, ambiguous = self._refused[i].tolist()
        tally = Tally(totals, int(state.decisions[i]), illegal, ambiguous, float(self._seconds[i]))
        # A later step of a transition comes from a state at which the heuristic was at ease.
        overloads = overloaded_lines(self._loadings[i]) if state.step[i] == self._steps[i] + 1 else ""
        ending = collapse(state, i, overloads) if state.terminated[i] else None
        foresight = int(self._rows.foresight[i])
        info, operation = self._rows.info(i), self._rows.operation(i)
        return job, episode_of(job.scenario, job.seed, info, tally, ending, operation, foresight)

    def _tell(self, on_progress: OnProgress) -> None:
        """How far all episodes are."""
        for i, job in self._jobs.items():
            on_progress(Progress(job, int(self._state.step[i]), int(self._state.episode_length[i])))


def _put(all_actions: Actions, rows: I64, actions: Actions) -> None:
    """Write the actions of ``rows`` to those of all."""
    if isinstance(all_actions, dict):
        for name, part in all_actions.items():
            part[rows] = actions[name]
        return
    all_actions[rows] = actions
