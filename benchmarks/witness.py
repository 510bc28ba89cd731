"""An agent that listens to the grid steps that it plays, for benchmarks that look at what happens between decisions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import gymnasium

from rl2grid.agents.agent import Action, Agent
from rl2grid.envs.tasks import Task
from rl2grid.mdp.state import GridState
from rl2grid.scenarios.splits import VALIDATION


class Witness(ABC):
    """Plays what its agent plays; a subclass says what it notes of every grid step.

    Args:
        agent: who decides.
    """

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.env: Any = None
        """That it is bound to, without wrappers."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self.agent, name)

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Listen to the grid steps of ``env``."""
        self.env = env.unwrapped
        self.env.step_listeners.append(self._hear_played)
        self.agent.bind(env)

    def act(self, observation: Any, info: Any) -> Action:
        """The agent's action."""
        return self.agent.act(observation, info)

    @abstractmethod
    def hear(self, state: GridState, row: int) -> None:
        """Note a grid step that was really played."""

    def _hear_played(self, state: GridState, row: int) -> None:
        if not self.env.imagined:
            self.hear(state, row)


def validation_environment(agent: Agent, task: Task, heuristic: str | None) -> gymnasium.Env[Any, Any]:
    """The task on validation months, observed as the agent asks for."""
    keywords = getattr(agent, "env_keywords", {}) | {"split": VALIDATION, "heuristic": heuristic}
    return gymnasium.make(task.id, **keywords, disable_env_checker=True)
