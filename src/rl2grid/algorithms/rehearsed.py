"""A policy whose crises are rehearsed before they are played (``docs/algorithms/rehearsal.md``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from rl2grid.agents.agent import seed_together
from rl2grid.agents.rehearsal import Rehearsal
from rl2grid.algorithms.policy_agent import PolicyAgent
from rl2grid.algorithms.top_k import TopK
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError


class Rehearsed(Rehearsal):
    """Plays what a policy plays; in a crisis, only after it went well in an imagined world.

    What :class:`~rl2grid.agents.rehearsal.Rehearsal` does with the planner as its guide, with a policy in its place,
    which plays on in rehearsals in a fraction of the planner's time. In a redispatching task other injections are
    tried: of a hundred, drawn around the policy's, those that leave the least worst loading in the next step.

    Args:
        policy: the guide, not bound yet.
        steps: grid steps of a rehearsal.

    Raises:
        UsageError: ``steps`` is below 1, or the policy plays a redispatching task and draws nothing.
    """

    kinds = ("T", "R", "H")
    rules: ClassVar[Mapping[str, int]] = {}

    def __init__(self, policy: PolicyAgent | TopK, steps: int) -> None:
        if steps < 1:
            raise UsageError(f"rehearse={steps} is not allowed: give a number of grid steps, at least 1.")
        if isinstance(policy, PolicyAgent) and policy.is_deterministic and find_task(policy.task).kind == "R":
            raise UsageError("TD3's policy draws no other actions to rehearse: leave rehearse out.")
        super().__init__(policy, ahead=steps)
        self.name = f"{policy.name}, rehearsing {steps} steps"
        self.task, self.env_keywords = policy.task, policy.env_keywords
        self.identity: dict[str, Any] = {**policy.identity, "rehearse": steps}

    def seed_episode(self, seed: int, episode: int) -> None:
        """Draw from the stream (``seed``, ``episode``) from now on, in rehearsals from another one."""
        seed_together((self._guide, self._understudy), seed, episode)
