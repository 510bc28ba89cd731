"""A policy that looks before it acts: of its best actions, the one that the what-if prefers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from rl2grid.agents.agent import Action, Considered, Info, Observation
from rl2grid.agents.dispatch import worst_loading_if_legal
from rl2grid.algorithms.policy_agent import PolicyAgent
from rl2grid.arrays import F32
from rl2grid.errors import UsageError
from rl2grid.mdp.heuristics import SAFE_RHO


class TopK:
    """Plays the first of a policy's ``k`` best legal actions that the forecast calls safe.

    Safe is what leaves every line below 95% in the next step. Where none of them does, the one with the least worst
    loading is played. With ``k`` = 1 it is the policy. A topology task on the native engine asks once
    (:meth:`PowerGridEnv.first_safe`); other tasks ask one ``simulate`` after the other until one is safe.

    Continuous actions have no best few: the candidates are the most probable one and, where the forecast does not call
    that safe, ``k`` - 1 around it, :data:`~rl2grid.algorithms.policy_agent.WIDTH` times as far away as the policy
    draws, from the stream of the episode (:meth:`seed_episode`).

    Args:
        policy: a policy, not bound yet.
        k: actions that are compared.

    Raises:
        UsageError: ``k`` is below 1, or the policy's actions are continuous and it has no distribution of them.
    """

    def __init__(self, policy: PolicyAgent, k: int) -> None:
        if k < 1:
            raise UsageError(f"top_k={k} is not allowed: give a number of actions, at least 1.")
        if policy.continuous and policy.is_deterministic:
            raise UsageError("TD3's policy draws no other actions to compare: leave top_k out.")
        self._policy, self._k = policy, k
        self.name = f"{policy.name}, best of {k}"
        self.task, self.env_keywords = policy.task, policy.env_keywords
        self.identity: dict[str, Any] = {**policy.identity, "top_k": k}
        self._considered: Callable[[], Considered] | None = None

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Remember the environment, which is asked for forecasts.

        Raises:
            UsageError: the policy cannot play the task.
        """
        self._policy.bind(env)
        base: Any = env.unwrapped
        self._env = base
        self._asks_at_once = base.task.kind == "T" and base.options.engine == "native"

    def reset(self, i: int) -> None:
        """Nothing to forget."""
        self._policy.reset(i)

    def seed_episode(self, seed: int, episode: int) -> None:
        """Draw from the stream (``seed``, ``episode``) from now on."""
        self._policy.seed_episode(seed, episode)

    def act(self, observation: Observation, info: Info) -> Action:
        """The action to play."""
        if self._policy.continuous:
            return self._drawn(observation, info)
        candidates, order = self._policy.best(observation, self._k)
        chosen, is_safe = self._choice(candidates)
        self._considered = partial(self._compared, candidates, order, _why(chosen, is_safe))
        return candidates[chosen]

    def proposals(self, observation: Observation, info: Info) -> list[Action]:
        """Those of the policy."""
        return self._policy.proposals(observation, info)

    def explain(self) -> Considered | None:
        """What the last decision compared and why it was played: candidates by the policy's preference, continuous ones
        by the worst loading by the forecast.
        """
        return None if self._considered is None else self._considered()

    def _compared(self, candidates: list[Action], order: F32, why: str) -> Considered:
        return Considered(self._policy.preference, candidates, self._policy.preferences_of(order), why)

    def _drawn(self, observation: Observation, info: Info) -> Action:
        """The most probable continuous action if it is safe, else the first that is, or the best, of those drawn."""
        candidates = [self._policy.act(observation, info)]
        if self._k == 1:
            return candidates[0]
        loading = [worst_loading_if_legal(self._env, candidates[0])]
        if loading[0] >= SAFE_RHO:
            for action in self._policy.draws(observation, self._k - 1):
                candidates.append(action)
                loading.append(worst_loading_if_legal(self._env, action))
                if loading[-1] < SAFE_RHO:
                    break
        order = np.argsort(loading, kind="stable").tolist()
        chosen = order[0]
        tried, values = [candidates[k] for k in order], [loading[k] for k in order]
        why = _why(chosen, loading[chosen] < SAFE_RHO)
        self._considered = partial(Considered, "worst loading", tried, values, why)
        return candidates[chosen]

    def _choice(self, candidates: list[Action]) -> tuple[int, bool]:
        """The place of the one to play, and whether the forecast calls it safe; one alone is not looked at."""
        if len(candidates) == 1:
            return 0, True
        if self._asks_at_once:
            found = self._env.first_safe(candidates)
            return found.place, found.is_safe
        loading: list[float] = []
        for k, candidate in enumerate(candidates):
            loading.append(worst_loading_if_legal(self._env, candidate))
            if loading[-1] < SAFE_RHO:
                return k, True
        return int(np.argmin(loading)), False


def _why(chosen: int, is_safe: bool) -> str:
    if is_safe:
        return (
            "the policy's choice is safe by the forecast" if chosen == 0 else "the first that the forecast calls safe"
        )
    return "by the forecast none of the candidates is safe: the one with the least worst loading"
