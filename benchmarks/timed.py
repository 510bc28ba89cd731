"""An agent whose decisions are timed, for benchmarks that say what a decision costs."""

from __future__ import annotations

import time
from typing import Any

from rl2grid.agents.agent import Action, Agent


class Timed:
    """An agent, and the processor time that each of its decisions took."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self.seconds: list[float] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._agent, name)

    def act(self, observation: Any, info: Any) -> Action:
        """The agent's action."""
        began = time.process_time()
        action = self._agent.act(observation, info)
        self.seconds.append(time.process_time() - began)
        return action
