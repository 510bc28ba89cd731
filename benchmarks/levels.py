"""Whether the levels mean something: greedy search on validation months with some of the actions, by heuristic.

``python benchmarks/levels.py [GRID ...] [--months N] [--before FOLDER]`` plays the first N validation months with
greedy search that may play the actions of level 0, of level 1, or as many random ones as level 0 has, without a
heuristic and with each that closes lines, and writes ``benchmarks/results/levels.json``. ``--before`` names a folder
with other rankings (``<grid>.ranking.npz``), whose levels are played as well; differences are paired by month.
``--add 2 3 --heuristics careful idle`` plays these levels, and beside them level 1 and doing nothing, and adds the rows
to those that are there; their gain is that over level 1.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.greedy import Greedy
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.protocol import evaluate, first_months
from rl2grid.grids import load_grid
from rl2grid.grids.rankings import ranking_hash
from rl2grid.mdp.actions import level_ids
from rl2grid.records.comparisons import paired_differences
from rl2grid.records.statistics import Scores
from rl2grid.scenarios.splits import VALIDATION

RESULTS = Path(__file__).resolve().parent / "results" / "levels.json"
HEURISTICS = ("none", "recovery", "careful")
Sets = dict[str, NDArray[np.int32] | None]
"""Catalogue ids of what may be played, by name; None: nothing is done."""


def sets_of(grid_id: str, before: Path | None) -> Sets:
    """What is compared by default."""
    grid = load_grid(grid_id)
    levels = range(min(2, len(grid.level_sizes)))
    sets: Sets = {"do nothing": None}
    drawn = np.random.default_rng(0).choice(np.arange(1, grid.level_sizes[-1]), grid.level_sizes[0] - 1, replace=False)
    sets["random"] = drawn.astype(np.int32)
    sets |= {f"level {level}": level_ids(grid, level) for level in levels}
    if before is not None:
        with np.load(before / f"{grid_id}.ranking.npz") as arrays:
            ranked = arrays["ids"].astype(np.int32)
        sets |= {f"level {level} before": ranked[: grid.level_sizes[level] - 1] for level in levels}
    return sets


def sets_of_levels(grid_id: str, levels: Sequence[int]) -> Sets:
    """Some levels that the grid has, and what they are set beside."""
    grid = load_grid(grid_id)
    known = [level for level in (1, *levels) if level < len(grid.level_sizes)]
    return {"do nothing": None} | {f"level {level}": level_ids(grid, level) for level in known}


def measure(grid_id: str, months: int, sets: Sets, heuristics: Sequence[str]) -> dict[str, Any]:
    """Survival for each set of actions and each heuristic, and how levels differ from those they are set beside."""
    task = find_task(f"{grid_id}-T{len(load_grid(grid_id).level_sizes) - 1}")
    scenarios = first_months(task, VALIDATION, months)
    result: dict[str, Any] = {"months": len(scenarios), "ranking": ranking_hash(grid_id), "rows": []}
    for heuristic in heuristics:
        scores: dict[str, Scores] = {}
        for name, ids in sets.items():
            agent = DoNothing() if ids is None else Greedy(ids.tolist())
            asked = None if heuristic == "none" else heuristic
            evaluation = evaluate(agent, task, scenarios=scenarios, heuristic=asked, workers=0)
            survival = np.array([episode.survival for episode in evaluation.episodes])
            scores[name] = Scores(survival[None, :, None])
            summary = evaluation.summary
            row = {
                "heuristic": heuristic,
                "actions": name,
                "survival": [
                    round(x, 4) for x in (summary.survival.value, summary.survival.low, summary.survival.high)
                ],
                "completed": round(summary.completed.value, 3),
            }
            if name.endswith(" before"):
                row["gain"] = _gain(scores[name.removesuffix(" before")], scores[name])
            elif "level 1" in scores and name != "level 1":
                row["gain"] = _gain(scores[name], scores["level 1"])
            result["rows"].append(row)
            print(grid_id, json.dumps(row), flush=True)
    return result


def _gain(now: Scores, before: Scores) -> list[float]:
    """Mean difference by month, its interval, and p."""
    (difference,) = paired_differences([now, before], [(0, 1)])
    estimate = difference.estimate
    return [round(float(x), 4) for x in (estimate.value, estimate.low, estimate.high, difference.p)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grids", nargs="*", default=["bus14", "bus36-MO-v0", "bus118-MOB-v0"])
    parser.add_argument("--months", type=int, default=100)
    parser.add_argument("--before", type=Path, default=None, help="folder of other rankings")
    parser.add_argument(
        "--add", type=int, nargs="+", default=None, metavar="LEVEL", help="levels to add to the results"
    )
    parser.add_argument("--heuristics", nargs="+", default=list(HEURISTICS))
    arguments = parser.parse_args()
    for grid_id in arguments.grids:
        results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        if arguments.add is None:
            sets, kept = sets_of(grid_id, arguments.before), []
        else:
            sets, kept = sets_of_levels(grid_id, arguments.add), results[grid_id]["rows"]
        measured = measure(grid_id, arguments.months, sets, arguments.heuristics)
        new = {(row["heuristic"], row["actions"]) for row in measured["rows"]}
        kept = [row for row in kept if (row["heuristic"], row["actions"]) not in new]
        results[grid_id] = {**measured, "rows": [*kept, *measured["rows"]]}
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
