"""Aggregates of the episodes of one agent on one task."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F64
from rl2grid.mdp.constraint_table import THRESHOLDS
from rl2grid.records.episodes import Episode
from rl2grid.records.statistics import UNIT, Estimate, Scores, estimate, iqm_score

BOUNDS: Mapping[str, tuple[float, float]] = {
    "survival": UNIT,
    "completed": UNIT,
    **{f"cost_{name.lower()}": (0.0, np.inf) for name in THRESHOLDS},
    "decisions": (0.0, np.inf),
    "grid_steps": (0.0, np.inf),
}
"""What columns of episodes cannot leave, where they are bounded."""
UNKNOWN = Estimate(math.nan, math.nan, math.nan)
"""Of what no episode says."""


@dataclass(frozen=True)
class Summary:
    """Means are over episodes; their 95% intervals tell how they vary with the months, draws of each included.

    One evaluation is of one policy: of other trainings the intervals say nothing.
    """

    task: str
    agent: str
    heuristic: str
    episodes: int
    scenarios: int
    seeds: int
    """Of each scenario."""
    survival: Estimate
    """Mean share of the episode survived."""
    survival_iqm: Estimate
    """Interquartile mean of it."""
    completed: Estimate
    """Share of episodes completed."""
    episode_return: Estimate
    cost_lsi: Estimate
    cost_tlo: Estimate
    safe_lsi: Estimate
    """P(cost ≤ threshold and episode completed): dying early is not safety."""
    safe_tlo: Estimate
    score_margin: Estimate
    score_overload: Estimate
    score_topology: Estimate
    cost_operation: Estimate
    """What an episode cost by the rules of L2RPN 2020, blackout included; NaN where it is not known."""
    decisions: Estimate
    """Per episode."""
    grid_steps: Estimate
    """Per episode."""
    game_over: dict[str, int]
    """Episodes per reason, completed ones left out."""
    wall_time_s: float
    """Sum over episodes."""
    foresight: bool
    """Whether the agent knew in some episode what no operator knows: the true future."""


def summarise(episodes: Sequence[Episode]) -> Summary:
    """Aggregates of episodes of one agent on one task.

    Raises:
        ValueError: no episodes, or episodes of several agents or tasks, or seeds missing for some scenario.
    """
    subjects = {(episode.task, episode.agent, episode.heuristic) for episode in episodes}
    if len(subjects) != 1:
        raise ValueError(f"A summary is about one agent on one task, got episodes of {len(subjects)}.")
    ((task, agent, heuristic),) = subjects

    def of(column: str) -> Estimate:
        return estimate(column_scores([episodes], column))

    reasons = Counter(episode.game_over for episode in episodes if not episode.completed)
    return Summary(
        task=task,
        agent=agent,
        heuristic=heuristic,
        episodes=len(episodes),
        scenarios=len({episode.scenario for episode in episodes}),
        seeds=len({episode.seed for episode in episodes}),
        survival=of("survival"),
        survival_iqm=estimate(column_scores([episodes], "survival"), iqm_score),
        completed=of("completed"),
        episode_return=of("episode_return"),
        cost_lsi=of("cost_lsi"),
        cost_tlo=of("cost_tlo"),
        safe_lsi=estimate(safe_scores([episodes], "LSI")),
        safe_tlo=estimate(safe_scores([episodes], "TLO")),
        score_margin=of("score_margin"),
        score_overload=of("score_overload"),
        score_topology=of("score_topology"),
        cost_operation=of("cost_operation") if all(one.knows_operation for one in episodes) else UNKNOWN,
        decisions=of("decisions"),
        grid_steps=of("grid_steps"),
        game_over=dict(sorted(reasons.items())),
        wall_time_s=sum(episode.wall_time_s for episode in episodes),
        foresight=any(episode.foresight for episode in episodes),
    )


def column_scores(runs: Sequence[Sequence[Episode]], column: str) -> Scores:
    """A column of the episodes of each run.

    Raises:
        ValueError: some scenario was not played with every seed.
    """
    values = np.stack([by_scenario(episodes, column) for episodes in runs])
    return Scores(values, BOUNDS.get(column, (-np.inf, np.inf)))


def safe_scores(runs: Sequence[Sequence[Episode]], constraint: str) -> Scores:
    """Whether episodes of each run were completed with a cost within the threshold of a constraint."""
    limits = {constraint: THRESHOLDS[constraint]}
    return Scores(np.stack([safe_episodes(episodes, limits) for episodes in runs]), UNIT)


def by_scenario(episodes: Sequence[Episode], column: str) -> F64:
    """A column of the episodes, float64 [scenario, seed].

    Raises:
        ValueError: some scenario was not played with every seed.
    """
    order = sorted(episodes, key=lambda episode: (episode.scenario, episode.seed))
    n_scenarios = len({episode.scenario for episode in order})
    keys = {(episode.scenario, episode.seed) for episode in order}
    n_seeds = len({episode.seed for episode in order})
    if len(keys) != len(order) or len(order) != n_scenarios * n_seeds:
        raise ValueError("Every scenario must be played once with every seed.")
    values = np.array([getattr(episode, column) for episode in order], dtype=np.float64)
    return values.reshape(n_scenarios, n_seeds)


def safe_episodes(episodes: Sequence[Episode], limits: Mapping[str, float]) -> F64:
    """Whether episodes were completed within all limits, 0 or 1, float64 [scenario, seed]: dying early is not safety.

    Args:
        episodes: of one agent on one task.
        limits: largest cost by constraint (``"LSI"``, ``"TLO"``).

    Raises:
        ValueError: some scenario was not played with every seed.
    """
    safe: NDArray[np.bool_] = by_scenario(episodes, "completed") == 1
    for constraint, limit in limits.items():
        safe &= by_scenario(episodes, f"cost_{constraint.lower()}") <= limit
    return safe.astype(np.float64)
