"""What announced maintenance leaves, and what topology can make of it beforehand, level by level.

``python benchmarks/maintenance.py TASK [--levels K ...] [--months N]`` goes, in the first N validation months of a
topology task's grid, to the hour before every maintenance, with the topology as it is by default and all other lines in
service, and asks what is overloaded without the line: if nobody acts, and after the best preparation that the planner's
search finds among the actions of each level (``docs/algorithms/planner.md``). It writes
``benchmarks/results/maintenance.json``: per line, how many maintenances there are, how many leave an overload, and, of
these, the worst loading of each month and what is left of it by level.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.topology_search import TopologySearch
from rl2grid.agents.trend import ANNOUNCED, later_of
from rl2grid.engines.native.what_if import WhatIf, forecast_of
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.episode import environment_seed
from rl2grid.evaluation.protocol import first_months
from rl2grid.grids import Grid, load_grid
from rl2grid.mdp.actions import level_catalogue
from rl2grid.records.files import write_json
from rl2grid.scenarios.splits import VALIDATION

RESULTS = Path(__file__).resolve().parent / "results" / "maintenance.json"


def searches(grid: Grid, levels: list[int]) -> dict[int, TopologySearch]:
    """What prepares with the actions of each level."""
    what_if = WhatIf(grid)
    return {level: TopologySearch(grid, level_catalogue(grid, level), what_if) for level in levels}


def starts(env: Any, seed: int) -> list[int]:
    """The steps of a month at which maintenance begins."""
    _, info = env.reset(seed=seed, options={"start": 0})
    length, step, found = int(info["episode_length"]), 0, list[int]()
    while step < length - ANNOUNCED:
        env.reset(seed=seed, options={"start": step})
        until = env.state.time_next_maintenance[0]
        if not (until > 0).any():
            break
        found.append(step + int(until[until > 0].min()))
        step = found[-1]
    return [start for start in found if start > ANNOUNCED]


def left_by(env: Any, seed: int, start: int, levels: dict[int, TopologySearch]) -> tuple[str, dict[str, float]] | None:
    """The lines whose maintenance begins at a step, and the worst loading without them by who prepares."""
    env.reset(seed=seed, options={"start": start - ANNOUNCED})
    point = forecast_of(env.engine, 0)
    if point is None:
        return None
    later = later_of(env.state, point, env.grid, np.zeros(env.grid.dim_topo))
    worst = {"nobody": next(iter(levels.values())).worst_later(point, later)}
    if worst["nobody"] > 1.0:
        worst |= {f"T{level}": search.prepared(point, later).worst_loading for level, search in levels.items()}
    return " ".join(map(str, later.lost)), {who: round(value, 3) for who, value in worst.items()}


def main() -> None:
    """Look at all months, print every overload, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", metavar="TASK")
    parser.add_argument("--levels", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--months", type=int, default=40)
    arguments = parser.parse_args()
    task = find_task(arguments.task)
    levels = searches(load_grid(task.grid_id), arguments.levels)
    found: dict[str, dict[str, Any]] = {}
    for month in first_months(task, VALIDATION, arguments.months):
        env: Any = gymnasium.make(task.id, split="validation", scenario=month, opponent=False).unwrapped
        seed = environment_seed(month, 0)
        for start in starts(env, seed):
            left = left_by(env, seed, start, levels)
            if left is None:
                continue
            lines, worst = left
            row = found.setdefault(lines, {"maintenances": 0, "overloads": {}})
            row["maintenances"] += 1
            if len(worst) > 1:
                row["overloads"][f"{month} {start}"] = worst
                print(month, start, lines, json.dumps(worst), flush=True)
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    write_json(RESULTS, {**results, task.grid_id: {"months": arguments.months, "lines": found}})


if __name__ == "__main__":
    main()
