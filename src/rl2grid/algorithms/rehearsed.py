"""A policy whose crises are rehearsed before they are played (``docs/algorithms/rehearsal.md``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from rl2grid.agents.rehearsal import Rehearsal
from rl2grid.algorithms.policy_agent import PolicyAgent
from rl2grid.algorithms.top_k import TopK
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError


class Rehearsed(Rehearsal):
    """Plays what a policy plays; in a crisis, only after it went well in an imagined world.

    What :class:`~rl2grid.agents.rehearsal.Rehearsal` does with the planner as its guide, with a policy in its place,
    which plays on in rehearsals in a fraction of the planner's time.

    Args:
        policy: the guide, not bound yet.
        steps: grid steps of a rehearsal.

    Raises:
        UsageError: ``steps`` is below 1, or the policy plays a redispatching task.
    """

    rules: ClassVar[Mapping[str, int]] = {}

    def __init__(self, policy: PolicyAgent | TopK, steps: int) -> None:
        if steps < 1:
            raise UsageError(f"rehearse={steps} is not allowed: give a number of grid steps, at least 1.")
        if find_task(policy.task).kind not in self.kinds:
            raise UsageError(f"A policy of {policy.task} has no topology actions to rehearse: leave rehearse out.")
        super().__init__(policy, ahead=steps)
        self.name = f"{policy.name}, rehearsing {steps} steps"
        self.task, self.env_keywords = policy.task, policy.env_keywords
        self.identity: dict[str, Any] = {**policy.identity, "rehearse": steps}
