"""How well the trend of the last half hour tells the flows of some steps later, by the share of it that goes on.

``python benchmarks/trend.py`` plays validation months of one grid per size while nobody acts, without attacks and
maintenance, and writes ``benchmarks/results/trend.json``: per grid and number of steps ahead, the root mean square
error of the flows, MW, on the 15 lines that carry most, for every share of the trend. The planner's share is chosen by
it (``docs/algorithms/planner.md``).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import gymnasium
import numpy as np

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.arrays import F64
from rl2grid.records.files import write_json

RESULTS = Path(__file__).resolve().parent / "results" / "trend.json"
TASKS = ("bus14-R", "bus36-M-R", "bus118-MOB-v0-R")
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
AHEAD = (3, 6, 12)
TREND = 6
"""Steps over which the trend is measured."""
LINES = 15


def flows(task: str, months: int) -> list[F64]:
    """What all lines carry while nobody acts, MW, float64 [step, line], one array per episode."""
    env = gymnasium.make(f"rl2grid/{task}-v0", split="validation", opponent=False, maintenance=False)
    nothing = np.zeros(env.action_space.shape or (), np.float32)
    found = []
    for seed in range(months):
        env.reset(seed=seed)
        carried, over = [], False
        while not over:
            carried.append(env.unwrapped.state.p_or[0].astype(np.float64))  # type: ignore[attr-defined]
            *_, terminated, truncated, _ = env.step(nothing)
            over = terminated or truncated
        if len(carried) > 4 * max(AHEAD):
            found.append(np.array(carried))
    return found


def error(episodes: list[F64], ahead: int, share: float) -> float:
    """Root mean square of what is wrongly foretold, MW."""
    squares = []
    for carried in episodes:
        busiest = np.argsort(-np.abs(carried).mean(axis=0))[:LINES]
        now = np.arange(TREND, len(carried) - ahead)
        foretold = carried[now] + share * ahead / TREND * (carried[now] - carried[now - TREND])
        squares.append(((carried[now + ahead] - foretold)[:, busiest] ** 2).mean())
    return round(float(np.sqrt(np.mean(squares))), 3)


def main() -> None:
    """Measure, print every row, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--months", type=int, default=12)
    arguments = parser.parse_args()
    result = {}
    for task in TASKS:
        episodes = flows(task, arguments.months)
        result[task] = {
            str(ahead): {str(share): error(episodes, ahead, share) for share in SHARES} for ahead in AHEAD
        } | {"episodes": len(episodes)}
        print(task, json.dumps(result[task]), flush=True)
    write_json(RESULTS, result)


if __name__ == "__main__":
    main()
