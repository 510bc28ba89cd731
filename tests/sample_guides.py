"""Agents that guide others, and how long somebody survives the first validation month."""

from __future__ import annotations

from typing import Any

import numpy as np

from rl2grid.agents.agent import Agent
from rl2grid.agents.do_nothing import DoNothing
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.protocol import evaluate, first_months
from rl2grid.records.episodes import Episode


class Shifting(DoNothing):
    """Redispatches a little in every step, and leaves the topology as it is."""

    injection = np.array([0.1, -0.1, 0.0, 0.0, 0.0, 0.0], np.float32)

    def act(self, observation: Any, info: Any) -> Any:
        return {"topology": 0, "injection": self.injection}


def survived(agent: Agent, task: str = "bus14-T0") -> Episode:
    """A week of the first validation month."""
    months = first_months(find_task(task), "validation", 1)
    return evaluate(agent, task, scenarios=months, episode_length=2016).episodes[0]
