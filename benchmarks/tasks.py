"""How hard the grids are for an agent that does nothing, and what they look like in their first emergency.

``python benchmarks/tasks.py`` plays the 20 validation months of every grid doing nothing (seed 0, no heuristic), takes
the first moment of them in which a line is loaded to 95% (:mod:`rl2grid.mdp.heuristics`), and writes
``benchmarks/results/tasks.json``. The page of the tasks is made of it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.evaluation.protocol import evaluate
from rl2grid.grids import GRID_IDS
from rl2grid.scenarios.library import list_scenarios

RESULTS = Path(__file__).resolve().parent / "results" / "tasks.json"
SHOWN = ("topo_vect", "rho", "gen_p", "load_p", "storage_power")


def survival(grid_id: str) -> dict[str, Any]:
    """Mean share of a validation month survived by doing nothing, and the share of months completed."""
    summary = evaluate("do-nothing", f"{grid_id}-T0", heuristic=None, workers=0).summary
    return {
        "survival": round(summary.survival.value, 4),
        "interval": [round(summary.survival.low, 4), round(summary.survival.high, 4)],
        "completed": round(summary.completed.value, 3),
    }


def first_emergency(grid_id: str) -> dict[str, Any]:
    """The grid at the first decision of the first validation month that has one, with the idle heuristic."""
    for scenario in list_scenarios(grid_id, "validation"):
        env = gymnasium.make(f"rl2grid/{grid_id}-T0-v0", heuristic="idle", split="validation", scenario=scenario)
        _, info = env.reset(seed=0)
        if info["over"]:
            continue
        state = env.unwrapped.state
        shown = {name: np.round(getattr(state, name)[0].astype(float), 3).tolist() for name in SHOWN}
        return {"scenario": scenario, "step": info["step"], **shown}
    raise RuntimeError(f"No validation month of {grid_id} reaches a decision.")


def main() -> None:
    results: dict[str, Any] = {}
    for grid_id in GRID_IDS:
        results[grid_id] = {"do_nothing": survival(grid_id), "moment": first_emergency(grid_id)}
        print(grid_id, results[grid_id]["do_nothing"], results[grid_id]["moment"]["step"], flush=True)
    lines = [f"{json.dumps(grid_id)}: {json.dumps(result)}" for grid_id, result in results.items()]
    RESULTS.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
