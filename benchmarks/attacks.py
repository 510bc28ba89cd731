"""How often opponents attack where attacked lines are closed again, and where they stay open.

``python benchmarks/attacks.py [GRID ...] [--months 24]`` plays validation months without a heuristic, doing nothing and
with the agent that closes lines as soon as they may be closed (``recovery``), and writes
``benchmarks/results/attacks.json``: grid steps, attacks that began, and the longest time between two.

Grid2Op's geometric opponent gives an attack up while any of the lines that it may attack is open, whoever opened it
(``GeometricOpponent.attack``: ``if ~status.all(): return None``, under a comment that speaks of all lines).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from rl2grid.agents.agent import Agent
from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.recovery import Recovery
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.protocol import first_months
from rl2grid.records.files import write_json
from rl2grid.scenarios.splits import VALIDATION

RESULTS = Path(__file__).resolve().parent / "results" / "attacks.json"
GRIDS = ("bus36-MO-v0", "bus36-MO-v1", "bus118-MOB-v0", "bus118-MOB-v1")


def attacks_of(grid_id: str, agent: Agent, months: int) -> dict[str, Any]:
    """Attacks that began in the first months of the validation list, all of its episodes together."""
    task = find_task(f"{grid_id}-T0")
    steps = attacks = longest = 0
    for scenario in first_months(task, VALIDATION, months):
        env = gymnasium.make(task.id, scenario=scenario, split=VALIDATION, disable_env_checker=True)
        agent.bind(env)
        observation, info = env.reset(seed=0)
        agent.reset(0)
        held, quiet, over = np.zeros_like(info["attacked_lines"]), 0, False
        while not over:
            observation, _, terminated, truncated, info = env.step(agent.act(observation, info))
            over = terminated or truncated
            begun = int((info["attacked_lines"] & ~held).sum())
            held, quiet = info["attacked_lines"], 0 if begun else quiet + 1
            steps, attacks, longest = steps + 1, attacks + begun, max(longest, quiet)
        env.close()
    return {"grid_steps": steps, "attacks": attacks, "per_day": round(288 * attacks / steps, 2), "longest": longest}


def main() -> None:
    """Play and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grids", nargs="*", default=list(GRIDS))
    parser.add_argument("--months", type=int, default=24)
    arguments = parser.parse_args()
    results: dict[str, Any] = {"command": f"python benchmarks/attacks.py --months {arguments.months}"}
    for grid_id in arguments.grids:
        results[grid_id] = {
            "lines stay open": attacks_of(grid_id, DoNothing(), arguments.months),
            "lines are closed": attacks_of(grid_id, Recovery(), arguments.months),
        }
        print(grid_id, results[grid_id], flush=True)
    write_json(RESULTS, results, indent=1)


if __name__ == "__main__":
    main()
