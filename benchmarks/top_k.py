"""What it costs, and what it gains, to look before acting: the what-if, or rehearsals of crises.

``python benchmarks/top_k.py RUN [RUN ...] [--k 3 10 ...] [--rehearse 24 ...] [--months M]`` plays the best policy of
each training as it is, with the what-if among its best K actions, and with crises rehearsed for so many steps, on M
validation months behind the first 20, by which it was picked, and adds survival, paired gains and processor time of a
decision to ``benchmarks/results/top_k.json``. Test months are never played.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from gains import compared, survival_behind
from timed import Timed

import rl2grid
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.agents import make_agent
from rl2grid.records.files import write_json
from rl2grid.records.versions import processor

RESULTS = Path(__file__).resolve().parent / "results" / "top_k.json"


def play(run: str, looking: dict[str, int], months: int) -> tuple[list[float], dict[str, Any]]:
    """Survival of each month, and what decisions cost."""
    policy = rl2grid.load(run)
    agent = Timed(make_agent(run, find_task(policy.task), **looking))
    survival = survival_behind(agent, policy.task, months)
    microseconds = 1e6 * float(np.mean(agent.seconds))
    return survival, {"decisions": len(agent.seconds), "microseconds": round(microseconds, 1)}


def main() -> None:
    """Play what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="trainings of one method, which differ in their seed")
    parser.add_argument("--k", nargs="*", type=int, default=[3, 10], help="best actions that the what-if compares")
    parser.add_argument("--rehearse", nargs="*", type=int, default=[], metavar="STEPS", help="of a crisis")
    parser.add_argument("--months", type=int, default=60)
    arguments = parser.parse_args()
    first = rl2grid.load(arguments.runs[0])
    name = f"{first.name} {first.task.removeprefix('rl2grid/')} {first.env_keywords['heuristic'] or 'no heuristic'}"
    survival: dict[str, list[list[float]]] = {}
    costs: dict[str, list[dict[str, Any]]] = {}
    ways: dict[str, dict[str, int]] = {"1": {}}
    ways |= {str(k): {"top_k": k} for k in arguments.k}
    ways |= {f"rehearsing {steps}": {"rehearse": steps} for steps in arguments.rehearse}
    for way, looking in ways.items():
        for run in arguments.runs:
            months, cost = play(run, looking, arguments.months)
            survival.setdefault(way, []).append(months)
            costs.setdefault(way, []).append(cost)
            print(name, f"K = {way}", run, round(float(np.mean(months)), 3), cost, flush=True)
    found = compared(survival, "1")
    for way, each in costs.items():
        decisions = sum(cost["decisions"] for cost in each)
        total = sum(cost["microseconds"] * cost["decisions"] for cost in each)
        found[way] |= {"decisions": decisions, "microseconds": round(total / decisions, 1)}
    usual: dict[str, Any] = {"processor": processor(), "methods": {}}
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else usual
    results["methods"][name] = {"runs": len(arguments.runs), "months": arguments.months, "k": found}
    print(json.dumps(found, indent=1))
    write_json(RESULTS, results, indent=1)


if __name__ == "__main__":
    main()
