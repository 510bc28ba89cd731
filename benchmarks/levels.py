"""Whether the levels mean something: greedy search on validation months with some of the actions.

``python benchmarks/levels.py [GRID ...] [--months N]`` plays the first N validation months with greedy search that may
play the actions of level 0, of the next level, or as many random ones as level 0 has (three draws), and writes
``benchmarks/results/levels.json``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.greedy import Greedy
from rl2grid.evaluation.protocol import evaluate
from rl2grid.grids import load_grid
from rl2grid.grids.rankings import ranking_hash
from rl2grid.mdp.actions import level_ids
from rl2grid.scenarios.library import list_scenarios

RESULTS = Path(__file__).resolve().parent / "results" / "levels.json"
DRAWS = 3


def measure(grid_id: str, months: int) -> dict[str, Any]:
    """Mean survival and completed months for each set of actions."""
    grid = load_grid(grid_id)
    highest = len(grid.level_sizes) - 1
    sets = {"level 0": level_ids(grid, 0)}
    if highest > 1:
        sets["level 1"] = level_ids(grid, 1)
    random = np.random.default_rng(0)
    for draw in range(DRAWS):
        drawn = random.choice(np.arange(1, grid.level_sizes[-1]), grid.level_sizes[0] - 1, replace=False)
        sets[f"random {draw}"] = drawn
    result: dict[str, Any] = {"months": months, "ranking": ranking_hash(grid_id)}
    task, scenarios = f"{grid_id}-T{highest}", list_scenarios(grid_id, "validation")[:months]
    agents = {"do nothing": DoNothing(), **{name: Greedy(ids.tolist()) for name, ids in sets.items()}}
    if highest == 1:
        agents["all"] = Greedy()
    for name, agent in agents.items():
        summary = evaluate(agent, task, scenarios=scenarios, heuristic=None, workers=0).summary
        result[name] = {
            "actions": len(sets.get(name, ())),
            "survival": round(summary.survival.value, 4),
            "interval": [round(summary.survival.low, 4), round(summary.survival.high, 4)],
            "completed": round(summary.completed.value, 3),
        }
        print(grid_id, name, result[name], flush=True)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("grids", nargs="*", default=["bus14", "bus36-MO-v0", "bus118-M"])
    parser.add_argument("--months", type=int, default=20)
    arguments = parser.parse_args()
    for grid_id in arguments.grids:
        results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        results[grid_id] = measure(grid_id, arguments.months)
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
