"""PPO's discount, learning rates, size and updates on larger grids, each changed alone.

``python benchmarks/families.py FAMILY --folder F`` trains PPO's preset ``default`` and variants of it on a task
of the family, with two seeds, each on 100,000 decisions, keeps the policy that survives longest on the first 20
validation months and plays it on the 60 behind these. It goes on after an interruption, writes
``benchmarks/results/families.json`` and prints what it wrote. ``--only NAME`` trains one variant, for several processes
side by side. Test months are never played.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from gains import CHOSEN_ON, go_on, survival_behind

import rl2grid
from rl2grid.records.files import write_json

RESULTS = Path(__file__).resolve().parent / "results" / "families.json"
BUDGET, VALIDATIONS, SEEDS, MONTHS = 100_000, 5, (1, 2), 60
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "gamma 0.95": {"gamma": 0.95},
    "gamma 0.99": {"gamma": 0.99},
    "rates 0.0003": {"actor_learning_rate": 3e-4, "critic_learning_rate": 3e-4},
    "rates 0.003": {"actor_learning_rate": 3e-3, "critic_learning_rate": 3e-3},
    "layers of 64": {"actor_layers": [64, 64], "critic_layers": [64, 64]},
    "layers of 256": {"actor_layers": [256, 256], "critic_layers": [256, 256]},
    "updates of 2,048": {"num_envs": 64, "num_steps": 32, "num_minibatches": 8},
}
"""What each changes of the preset ``default``."""


@dataclass(frozen=True)
class Family:
    """Where hyperparameters of a family of grids are searched for."""

    task: str
    heuristic: str
    """By which greedy search survives longest."""


FAMILIES = {"36": Family("bus36-M-T0", "careful"), "118": Family("bus118-M-T0", "careful")}


def played(family: Family, name: str, seed: int, folder: Path) -> list[float]:
    """Train a variant, or go on, and play the best policy: survival of the months; kept in the folder."""
    label = f"{family.task}-{name.replace(' ', '-')}-{seed}"
    run, kept = folder / label, folder / f"{label}.json"
    if kept.exists():
        survival: list[float] = json.loads(kept.read_text())
        return survival
    if (run / "config.json").exists():
        go_on(run)
    else:
        rl2grid.train(
            "ppo",
            family.task,
            folder=run,
            hyperparameters={**VARIANTS[name], "total_timesteps": BUDGET, "seed": seed, "torch_threads": 1},
            validation_months=CHOSEN_ON,
            evaluate_every=BUDGET // VALIDATIONS,
            progress=False,
            heuristic=family.heuristic,
        )
    survival = survival_behind(run, family.task, MONTHS)
    write_json(kept, survival)
    print(family.task, name, seed, round(float(np.mean(survival)), 3), flush=True)
    return survival


def main() -> None:
    """Train what is asked for and not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("family", choices=tuple(FAMILIES))
    parser.add_argument("--only", choices=tuple(VARIANTS), help="train this variant and write nothing else")
    parser.add_argument("--folder", type=Path, default=Path("families"), help="where trainings are kept")
    arguments = parser.parse_args()
    family = FAMILIES[arguments.family]
    names: Sequence[str] = [arguments.only] if arguments.only else list(VARIANTS)
    survival = {name: [played(family, name, seed, arguments.folder) for seed in SEEDS] for name in names}
    if arguments.only:
        return
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    results[arguments.family] = {
        "task": family.task,
        "heuristic": family.heuristic,
        "survival": {name: round(float(np.mean(runs)), 4) for name, runs in survival.items()},
        "trainings": {name: [round(float(np.mean(run)), 4) for run in runs] for name, runs in survival.items()},
    }
    write_json(RESULTS, results, indent=1)
    print(json.dumps(results[arguments.family], indent=1))


if __name__ == "__main__":
    main()
