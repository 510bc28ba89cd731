"""What the planner survives on validation months, beside agents that need no training, and what its parts are worth.

``python benchmarks/planner.py TASK ... [--months N] [--skip N] [--heuristic NAME] [--against AGENT ...] [--without]``
plays the first N validation months of each task (after the first ``--skip``), by default without a heuristic, with the
planner, with the agents of ``--against``, and, with ``--without``, with the planner without each of its ingredients. It
writes ``benchmarks/results/planner.json``, one row per task and agent: survival with its interval, paired difference to
the planner, share of completed months, milliseconds of processor time of a decision (mean, 99 of 100, the slowest),
how episodes ended and which lines were overloaded then. Tasks and heuristics that were measured before stay.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from gains import validation_months
from timed import Timed

from rl2grid.agents.agent import Agent
from rl2grid.agents.planner import INGREDIENTS, Planner
from rl2grid.envs.tasks import Task, find_task, short_id
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.protocol import evaluate
from rl2grid.records.comparisons import paired_differences
from rl2grid.records.files import write_json
from rl2grid.records.statistics import Scores

RESULTS = Path(__file__).resolve().parent / "results" / "planner.json"


def measured(agent: Agent, task: Task, months: tuple[str, ...], heuristic: str | None) -> tuple[dict[str, Any], Scores]:
    """One row of the results, and the survival of every month."""
    timed = Timed(agent)
    evaluation = evaluate(timed, task, scenarios=months, heuristic=heuristic, workers=0, progress=True)
    episodes, summary = evaluation.episodes, evaluation.summary
    took = 1e3 * np.array(timed.seconds)
    row = {
        "survival": [round(x, 4) for x in (summary.survival.value, summary.survival.low, summary.survival.high)],
        "completed": [round(x, 3) for x in (summary.completed.value, summary.completed.low, summary.completed.high)],
        "milliseconds": [round(float(x), 2) for x in (took.mean(), np.quantile(took, 0.99), took.max())],
        "endings": dict(Counter(episode.game_over for episode in episodes)),
        "last_overloads": dict(Counter(one.last_overloads for one in episodes if not one.completed).most_common(3)),
    }
    return row, Scores(np.array([episode.survival for episode in episodes])[None, :, None])


def compare(task: Task, months: tuple[str, ...], agents: list[Agent], heuristic: str | None) -> dict[str, Any]:
    """The rows of a task by agent; differences are the agent's survival minus the planner's, by month."""
    rows: dict[str, Any] = {}
    planner: Scores | None = None
    for agent in agents:
        row, scores = measured(agent, task, months, heuristic)
        if planner is None:
            planner = scores
        else:
            (difference,) = paired_differences([scores, planner], [(0, 1)])
            estimate = difference.estimate
            row["beside_planner"] = [round(x, 4) for x in (estimate.value, estimate.low, estimate.high, difference.p)]
        rows[agent.name] = row
        print(task.id, agent.name, json.dumps(row), flush=True)
    return rows


def main() -> None:
    """Play, print every row, and write them beside those of before."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="+", metavar="TASK")
    parser.add_argument("--months", type=int, default=20)
    parser.add_argument("--skip", type=int, default=0)
    parser.add_argument("--against", nargs="*", default=["do-nothing", "greedy"])
    parser.add_argument("--heuristic", default=None)
    parser.add_argument("--without", action="store_true", help="also without each ingredient")
    arguments = parser.parse_args()
    for name in arguments.tasks:
        task = find_task(name)
        months = validation_months(task, arguments.skip, arguments.months)
        agents = [Planner(), *(make_agent(other, task) for other in arguments.against)]
        if arguments.without:
            agents += [Planner(without=[each]) for each in INGREDIENTS]
        result = {
            "months": [arguments.skip, arguments.skip + len(months)],
            "heuristic": arguments.heuristic or "none",
            "rows": compare(task, months, agents, arguments.heuristic),
        }
        results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        results[" ".join((short_id(task.id), *([arguments.heuristic] if arguments.heuristic else [])))] = result
        write_json(RESULTS, results)


if __name__ == "__main__":
    main()
