"""What operator features cost, and whether policies that observe them survive longer.

``python benchmarks/operator_features.py cost`` measures the processor time of the observations of 256 environments, one
thread, without them and with each group. ``... learn [--task T] [--heuristic H] [--seeds N] [--budget D] [--months M]``
trains PPO with and without them, equal seeds and budgets, the policy that survives longest on the first 20 validation
months being kept, and plays it on the M validation months behind these; the difference is paired by month. Both write
``benchmarks/results/operator_features.json``; what is there is not measured again. Test months are never played.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import gymnasium
import numpy as np
from gains import CHOSEN_ON, compared, survival_behind

import rl2grid
from rl2grid.mdp.features import OPERATOR_FEATURES
from rl2grid.records.files import write_json
from rl2grid.records.versions import processor

RESULTS = Path(__file__).resolve().parent / "results" / "operator_features.json"
TASKS = ("bus14-T0", "bus36-MO-v0-T0", "bus118-MOB-v0-T0")
GROUPS: tuple[str | None, ...] = (None, *OPERATOR_FEATURES, "all")
NUM_ENVS, WARM_STEPS, STEPS = 256, 10, 60


def cost(task: str, groups: str | None) -> float:
    """Microseconds of processor time of an observation, during random play."""
    envs: Any = gymnasium.make_vec(
        f"rl2grid/{task}-v0", num_envs=NUM_ENVS, num_threads=1, operator_features=groups
    ).unwrapped
    envs.reset(seed=0)
    rng, times = np.random.default_rng(0), []
    for step in range(WARM_STEPS + STEPS):
        envs.step(rng.integers(0, envs.single_action_space.n, NUM_ENVS))
        began = time.process_time()
        envs._rows._observations()
        if step >= WARM_STEPS:
            times.append(time.process_time() - began)
    return round(1e6 * statistics.median(times) / NUM_ENVS, 2)


def survival(arguments: argparse.Namespace, groups: str | None, seed: int) -> list[float]:
    """Train, keep the best, and play it: survival of each month."""
    with tempfile.TemporaryDirectory() as folder:
        run = rl2grid.train(
            "ppo",
            arguments.task,
            folder=Path(folder) / "run",
            hyperparameters={"total_timesteps": arguments.budget, "seed": seed},
            validation_months=CHOSEN_ON,
            evaluate_every=max(arguments.budget // 4, 1),
            progress=False,
            heuristic=arguments.heuristic,
            operator_features=groups,
        )
        return survival_behind(run, arguments.task, arguments.months)


def main() -> None:
    """Measure what is asked for and not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("cost", "learn"))
    parser.add_argument("--task", default="bus36-MO-v0-T0")
    parser.add_argument("--heuristic", default="careful")
    parser.add_argument("--groups", nargs="+", default=["none", "all"], help="none, or values of the keyword")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--budget", type=int, default=200_000, help="decisions of each training")
    parser.add_argument("--months", type=int, default=60)
    arguments = parser.parse_args()
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    if arguments.what == "cost":
        measured = {task: {groups or "none": cost(task, groups) for groups in GROUPS} for task in TASKS}
        results["cost"] = {"processor": processor(), "microseconds": measured}
        print(json.dumps(results["cost"], indent=1))
        write_json(RESULTS, results, indent=1)
        return
    name = f"ppo {arguments.task} {arguments.heuristic} {arguments.budget} decisions {arguments.months} months"
    family = results.setdefault("learn", {}).setdefault(name, {"survival": {}})
    for seed in range(1, arguments.seeds + 1):
        for groups in arguments.groups:
            runs = family["survival"].setdefault(groups, {})
            if f"seed {seed}" not in runs:
                runs[f"seed {seed}"] = survival(arguments, None if groups == "none" else groups, seed)
                print(groups, seed, round(float(np.mean(runs[f"seed {seed}"])), 4), flush=True)
                write_json(RESULTS, results, indent=1)
    family["compared"] = compared({name: list(runs.values()) for name, runs in family["survival"].items()}, "none")
    print(json.dumps(family["compared"], indent=1))
    write_json(RESULTS, results, indent=1)


if __name__ == "__main__":
    main()
