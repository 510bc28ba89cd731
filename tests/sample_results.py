"""Made-up episodes, results, curves and recordings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rl2grid.records.episodes import Episode
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.recordings import Recording
from rl2grid.records.trainings import Metric, TrainingCurve

TASK = "rl2grid/bus14-T0-v0"


def episode(scenario: str = "may", seed: int = 0, survival: float = 1.0, **changes: Any) -> Episode:
    completed = survival == 1.0
    values: dict[str, Any] = {
        "task": TASK,
        "agent": "someone",
        "heuristic": "none",
        "split": "validation",
        "scenario": scenario,
        "seed": seed,
        "start": 0,
        "episode_length": 100,
        "grid_steps": round(100 * survival) + (not completed),
        "decisions": 7,
        "survival": survival,
        "completed": completed,
        "game_over": "NONE" if completed else "DIVERGENCE",
        "last_overloads": "" if completed else "3 17",
        "last_outages": "" if completed else "4",
        "last_cut_off": "",
        "episode_return": 90.0 * survival,
        "return_survive": 100.0 * survival,
        "return_overload": -1.0 / 3.0,
        "return_cost": -5.0,
        "cost_lsi": 0.0 if completed else 1.0,
        "cost_tlo": 10.0,
        "score_margin": 11.0,
        "score_overload": -0.25,
        "score_topology": -2.0,
        "illegal": 1,
        "ambiguous": 0,
        "wall_time_s": 0.5,
        "engine": "reference",
        "scenario_pack_hash": "pack",
        "action_set_hash": "actions",
        "agent_hash": "",
        "identity": "identity",
    }
    return Episode(**{**values, **changes})


def result(
    agent: str, survivals: list[list[float]], heuristic: str | None = None, agent_hash: str = "", **identity: Any
) -> Evaluation:
    """Survivals by scenario, then seed."""
    words = {"task": TASK, "agent": agent, "heuristic": heuristic, "split": "validation", "versions": {"rl2grid": "0"}}
    words |= identity
    of_all = {"agent": agent, "heuristic": heuristic or "none", "agent_hash": agent_hash, "task": words["task"]}
    episodes = tuple(
        episode(f"scenario {k}", seed, survival, **of_all)
        for k, row in enumerate(survivals)
        for seed, survival in enumerate(row)
    )
    return Evaluation(episodes, words, f"rl2grid evaluate {agent}")


def with_foresight(result: Evaluation) -> Evaluation:
    """The same of an agent that knew the future in some decisions of every episode."""
    return replace(result, episodes=tuple(replace(each, foresight=5) for each in result.episodes))


def curve(label: str = "ppo", seed: int = 0, n: int = 30) -> TrainingCurve:
    """Survival, a score and a cost of ``n`` iterations with 300 episodes each."""
    random = np.random.default_rng(seed)
    decisions = 100.0 * np.arange(1, n + 1)
    survival = np.clip(decisions / 3000 + random.normal(0, 0.1, n), 0, 1)
    score, cost = random.normal(11, 1, n), random.uniform(0, 100, n)

    def metric(values: Any, points: slice = slice(None)) -> Metric:
        return Metric(decisions[points], 12 * decisions[points], values[points], np.full(n, 300.0)[points])

    validated = metric(survival, slice(9, None, 10))
    return TrainingCurve(
        label,
        {
            "charts/survival": metric(survival),
            "charts/score_margin": metric(score),
            "charts/cost_tlo": metric(cost),
            "validation/survival": validated,
        },
    )


def recording(n_steps: int = 700, n_line: int = 6, game_over: str = "the grid fell into several pieces") -> Recording:
    random = np.random.default_rng(1)
    rho = random.uniform(0.2, 0.9, (n_steps + 1, n_line)).astype(np.float32)
    rho[-5:, 2] = 1.2
    status = np.ones((n_steps + 1, n_line), np.bool_)
    status[n_steps // 2 :, 1] = False
    attacked = np.zeros_like(status)
    attacked[n_steps // 2 : n_steps // 2 + 40, 1] = True
    return Recording(
        TASK,
        "someone",
        "idle",
        "may",
        0,
        0,
        "2020-05-01T00:00:00",
        2 * n_steps if game_over else n_steps,
        game_over,
        tuple(f"line {k}" for k in range(n_line)),
        (3, n_steps // 2),
        ("", "switch line 1"),
        rho,
        status,
        attacked,
        np.zeros_like(status),
        np.ones((n_steps + 1, 2 * n_line), np.int8),
        *(np.zeros((n_steps + 1, n), np.float32) for n in (2, 3, 1, n_line, 2)),
    )
