"""How hard the grids are for an agent that does nothing, and what they look like in their first emergency.

``python benchmarks/tasks.py [GRID ...] [--months N]`` plays the first N validation months doing nothing (seed 0, no
heuristic), takes the first moment of them in which a line is loaded to 95% (:mod:`rl2grid.mdp.heuristics`), and writes
``benchmarks/results/tasks.json``. The page of the tasks is made of it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.protocol import evaluate, first_months
from rl2grid.grids import GRID_IDS
from rl2grid.scenarios.splits import VALIDATION

RESULTS = Path(__file__).resolve().parent / "results" / "tasks.json"
SHOWN = ("topo_vect", "rho", "gen_p", "load_p", "storage_power")


def survival(grid_id: str, scenarios: Sequence[str]) -> dict[str, Any]:
    """Mean share of a month survived by doing nothing, and the share of months completed."""
    task = f"{grid_id}-T0"
    summary = evaluate("do-nothing", task, scenarios=scenarios, heuristic=None, workers=0, progress=True).summary
    return {
        "months": len(scenarios),
        "survival": round(summary.survival.value, 4),
        "interval": [round(summary.survival.low, 4), round(summary.survival.high, 4)],
        "completed": round(summary.completed.value, 3),
    }


def first_emergency(grid_id: str, scenarios: Sequence[str]) -> dict[str, Any]:
    """The grid at the first decision of the first month that has one, with the idle heuristic."""
    for scenario in scenarios:
        env = gymnasium.make(f"rl2grid/{grid_id}-T0-v0", heuristic="idle", split=VALIDATION, scenario=scenario)
        _, info = env.reset(seed=0)
        if info["over"]:
            continue
        state = env.unwrapped.state
        shown = {name: np.round(getattr(state, name)[0].astype(float), 3).tolist() for name in SHOWN}
        return {"scenario": scenario, "step": info["step"], **shown}
    raise RuntimeError(f"No validation month of {grid_id} reaches a decision.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grids", nargs="*", default=list(GRID_IDS))
    parser.add_argument("--months", type=int, default=None, help="by default all")
    arguments = parser.parse_args()
    for grid_id in arguments.grids:
        scenarios = first_months(find_task(f"{grid_id}-T0"), VALIDATION, arguments.months)
        measured = {"do_nothing": survival(grid_id, scenarios), "moment": first_emergency(grid_id, scenarios)}
        print(grid_id, measured["do_nothing"], measured["moment"]["step"], flush=True)
        results = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
        results[grid_id] = measured
        lines = [f"{json.dumps(each)}: {json.dumps(results[each])}" for each in GRID_IDS if each in results]
        RESULTS.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
