"""What there was to choose from at a decision, and what it promised."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from rl2grid.agents.agent import Action, Agent, Considered, ExplainingAgent, intervenes, key_of, no_intervention
from rl2grid.agents.dispatch import worst_loading
from rl2grid.errors import UsageError
from rl2grid.mdp.heuristics import SAFE_RHO
from rl2grid.records.recordings import Alternative, Reason

MOST_TRIED = 2000
"""Larger sets of actions are not tried as a whole."""
SHOWN = 4
"""Best actions by promise that are told, and as many by the agent's preference."""
_NOTHING = 0


class Reasons:
    """Asks, after every decision of an agent, what it and its alternatives promised.

    Promises are those of ``what_if`` on topology tasks and of ``simulate`` on others, on the native engine; the agent
    may have looked at them or not. Playing is left as it is.

    Args:
        agent: bound to ``env``.
        env: made by ``gymnasium.make``, or like one.
    """

    def __init__(self, agent: Agent, env: gymnasium.Env[Any, Any]) -> None:
        self._agent, self._env = agent, env.unwrapped
        self._discrete = isinstance(env.action_space, gymnasium.spaces.Discrete)
        self._space = env.action_space

    def of(self, action: Action, step: int) -> Reason | None:
        """The reason of an action that is about to be played; None where the grid is safe and nothing is done.

        Raises:
            UsageError: the agent explains itself with something else than a ``Considered``.
        """
        base: Any = self._env
        if not intervenes(action) and base.state.rho[0].max() < SAFE_RHO:
            return None
        considered = explanation_of(self._agent)
        reason_of = self._among_ids if self._discrete else self._among_plans
        return reason_of(action, step, considered)

    def _among_ids(self, action: Action, step: int, considered: Considered | None) -> Reason:
        base: Any = self._env
        preferences = _by_id(considered)
        named = dict.fromkeys((int(action), _NOTHING, *list(preferences)[:SHOWN]))
        n = int(self._space.n)  # type: ignore[attr-defined]
        promised = self._promises(list(range(n)) if n <= MOST_TRIED else list(named))
        best = sorted((loading, k) for k, loading in promised.items() if np.isfinite(loading))[:SHOWN]
        ids = sorted(dict.fromkeys((*named, *(k for _, k in best))), key=lambda k: (promised.get(k, np.inf), k))
        alternatives = tuple(
            Alternative(
                base.describe_action(k) if k != _NOTHING else "",
                promised.get(k, np.nan),
                preferences.get(k, np.nan),
                k == int(action),
            )
            for k in ids
        )
        return Reason(step, *_said(considered), len(promised), alternatives)

    def _promises(self, ids: list[int]) -> dict[int, float]:
        """Worst loading of the next step after each legal action, where forecasts can be asked for."""
        base: Any = self._env
        if base.options.engine != "native":
            return {}
        try:
            outcomes = base.what_if(ids)
        except UsageError:  # a scenario without forecasts
            return {}
        pairs = zip(ids, outcomes.worst_loading.tolist(), outcomes.legal.tolist(), strict=True)
        return {k: loading for k, loading, legal in pairs if legal}

    def _among_plans(self, action: Action, step: int, considered: Considered | None) -> Reason:
        base: Any = self._env
        nothing = no_intervention(self._space)
        plans: dict[bytes, tuple[Action, float]] = {}
        if considered:
            pairs = list(zip(considered.actions, considered.values, strict=True))[:SHOWN]
            plans = {key_of(plan): (plan, value) for plan, value in pairs}
        for plan in (nothing, action):
            plans.setdefault(key_of(plan), (plan, np.nan))
        alternatives = [
            Alternative(
                base.describe_action(plan) if intervenes(plan) else "",
                self._simulated(plan),
                value,
                key_of(plan) == key_of(action),
            )
            for plan, value in plans.values()
        ]
        tried = len(considered.actions) if considered and len(considered.actions) else len(alternatives)
        ranked = tuple(sorted(alternatives, key=lambda each: np.nan_to_num(each.promised, nan=np.inf)))
        return Reason(step, *_said(considered), tried, ranked)

    def _simulated(self, plan: Action) -> float:
        base: Any = self._env
        if base.options.engine != "native":
            return float("nan")
        try:
            return worst_loading(base, plan)
        except UsageError:  # a scenario without forecasts
            return float("nan")


def explanation_of(agent: Agent) -> Considered | None:
    """What an agent says of its last action, if it says anything.

    Raises:
        UsageError: it is something else than a ``Considered``.
    """
    if not isinstance(agent, ExplainingAgent):
        return None
    considered = agent.explain()
    if considered is None:
        return None
    if not isinstance(considered, Considered) or len(considered.actions) != len(considered.values):
        raise UsageError(
            f"explain() of agent {agent.name!r} returned {considered!r:.80}: return None, or a "
            "rl2grid.agents.agent.Considered with as many values as actions."
        )
    return considered


def _said(considered: Considered | None) -> tuple[str, str]:
    """What the agent's numbers are, and its rule."""
    return (considered.meaning, considered.why) if considered else ("", "")


def _by_id(considered: Considered | None) -> dict[int, float]:
    if considered is None:
        return {}
    return {int(k): float(value) for k, value in zip(considered.actions, considered.values, strict=True)}
