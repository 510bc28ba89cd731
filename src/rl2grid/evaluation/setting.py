"""What all episodes of an evaluation have in common, and who plays them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rl2grid.agents.agent import Action, Agent, Info
from rl2grid.evaluation.crew import REPORT_SECONDS, Job, OnProgress, Player, Progress
from rl2grid.evaluation.episode import OnTransition, bound_environment, play_episode
from rl2grid.evaluation.side_by_side import SideBySidePlayer
from rl2grid.records.episodes import Episode


@dataclass(frozen=True)
class Setting:
    """What all episodes of an evaluation have in common."""

    task: str
    agent: Agent
    """Not bound yet; workers play copies of it."""
    env_keywords: Mapping[str, Any] = field(default_factory=dict)
    """Keywords of ``gymnasium.make``."""
    abreast: int = 1
    """Episodes that a process plays at a time; see :func:`rl2grid.evaluation.side_by_side.episodes_abreast`."""

    def player(self, num_threads: int) -> Player[Episode]:
        """Who plays them in this process."""
        if self.abreast == 1:
            return BoundAgent(self)
        return SideBySidePlayer(self.task, self.agent, self.env_keywords, self.abreast, num_threads)


class BoundAgent:
    """One environment and the agent bound to it."""

    def __init__(self, setting: Setting) -> None:
        self._agent = setting.agent
        self._env = bound_environment(setting.agent, setting.task, setting.env_keywords)

    def play(self, jobs: Sequence[Job], on_progress: OnProgress) -> Iterator[tuple[Job, Episode]]:
        """See :class:`~rl2grid.evaluation.crew.Player`: one after the other."""
        for job in jobs:
            yield job, self.play_one(job, on_progress)

    def play_one(self, job: Job, on_progress: OnProgress, on_transition: OnTransition | None = None) -> Episode:
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
