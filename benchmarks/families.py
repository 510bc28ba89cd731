"""PPO's discount, learning rates, size and updates on larger grids, each changed alone, and what looked best again.

``python benchmarks/families.py search FAMILY --folder F`` trains PPO's preset ``default`` and variants of it on a task
of the family, with two seeds, each on 100,000 decisions, keeps the policy that survives longest on the first 20
validation months and plays it on the 60 behind these. ``... compare FAMILY --folder F`` trains the default, the two
variants that were best on 36 substations and both changes at once with seeds that the search did not use, and plays
them on the 120 validation months that it did not play. Both go on after an interruption, write
``benchmarks/results/families.json`` and print what they wrote. ``--only NAME`` trains one variant and
writes nothing, for several processes side by side. Test months are never played.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from gains import CHOSEN_ON, compared, go_on, survival_behind

import rl2grid
from rl2grid.records.files import write_json

RESULTS = Path(__file__).resolve().parent / "results" / "families.json"
BUDGET, VALIDATIONS = 100_000, 5
SEARCHED = slice(0, 60)
"""Of the months behind those that chose a policy, the ones that the search played."""
NOT_SEARCHED = slice(60, None)
"""And the ones that compare what it found."""
SEARCH_SEEDS, COMPARED_SEEDS = (1, 2), (11, 12, 13)
_SLOWER: dict[str, Any] = {"actor_learning_rate": 3e-4, "critic_learning_rate": 3e-4}
_LARGER: dict[str, Any] = {"num_envs": 64, "num_steps": 32, "num_minibatches": 8}
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "gamma 0.95": {"gamma": 0.95},
    "gamma 0.99": {"gamma": 0.99},
    "rates 0.0003": _SLOWER,
    "rates 0.003": {"actor_learning_rate": 3e-3, "critic_learning_rate": 3e-3},
    "layers of 64": {"actor_layers": [64, 64], "critic_layers": [64, 64]},
    "layers of 256": {"actor_layers": [256, 256], "critic_layers": [256, 256]},
    "updates of 2,048": _LARGER,
}
"""What each changes of the preset ``default``."""
FINALISTS: dict[str, dict[str, Any]] = {
    "default": {},
    "rates 0.0003": _SLOWER,
    "updates of 2,048": _LARGER,
    "updates of 2,048, rates 0.0003": {**_LARGER, **_SLOWER},
}
"""What is compared: what was best of the search, and the default."""


@dataclass(frozen=True)
class Family:
    """Where hyperparameters of a family of grids are searched for."""

    task: str
    heuristic: str
    """By which greedy search survives longest."""


FAMILIES = {"36": Family("bus36-M-T0", "careful"), "118": Family("bus118-M-T0", "careful")}


@dataclass(frozen=True)
class Training:
    """One training and the months that its best policy plays."""

    family: Family
    name: str
    changes: Mapping[str, Any]
    seed: int
    months: slice

    def survival(self, folder: Path) -> list[float]:
        """Train, or go on, and play the best policy: survival of the months; kept in the folder."""
        label = f"{self.family.task}-{self.name.replace(',', '').replace(' ', '-')}-{self.seed}"
        run, kept = folder / label, folder / f"{label}.json"
        if kept.exists():
            survival: list[float] = json.loads(kept.read_text())
            return survival
        if (run / "config.json").exists():
            go_on(run)
        else:
            self._begin(run)
        survival = survival_behind(run, self.family.task, self.months.stop)[self.months]
        write_json(kept, survival)
        print(self.family.task, self.name, self.seed, round(float(np.mean(survival)), 3), flush=True)
        return survival

    def _begin(self, run: Path) -> None:
        rl2grid.train(
            "ppo",
            self.family.task,
            folder=run,
            hyperparameters={**self.changes, "total_timesteps": BUDGET, "seed": self.seed, "torch_threads": 1},
            validation_months=CHOSEN_ON,
            evaluate_every=BUDGET // VALIDATIONS,
            progress=False,
            heuristic=self.family.heuristic,
        )


def searched(family: Family) -> dict[str, list[Training]]:
    """The trainings of a search by variant."""
    return {
        name: [Training(family, name, changes, seed, SEARCHED) for seed in SEARCH_SEEDS]
        for name, changes in VARIANTS.items()
    }


def search(family: Family, folder: Path) -> dict[str, Any]:
    """Every variant on the family's task: mean survival, of all trainings and of each."""
    survival = {name: [one.survival(folder) for one in trainings] for name, trainings in searched(family).items()}
    return {
        "task": family.task,
        "heuristic": family.heuristic,
        "survival": {name: round(float(np.mean(runs)), 4) for name, runs in survival.items()},
        "trainings": _means(survival),
    }


def finalists(family: Family) -> dict[str, list[Training]]:
    """The trainings that are compared by variant."""
    return {
        name: [Training(family, name, changes, seed, NOT_SEARCHED) for seed in COMPARED_SEEDS]
        for name, changes in FINALISTS.items()
    }


def compare(family: Family, folder: Path) -> dict[str, Any]:
    """The finalists: survival and gain over the default, and the mean of every training."""
    survival = {name: [one.survival(folder) for one in trainings] for name, trainings in finalists(family).items()}
    return {"compared": compared(survival, "default"), "trainings": _means(survival)}


def _means(survival: Mapping[str, Sequence[Sequence[float]]]) -> dict[str, list[float]]:
    return {name: [round(float(np.mean(run)), 4) for run in runs] for name, runs in survival.items()}


def main() -> None:
    """Train what is asked for and not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("search", "compare"))
    parser.add_argument("family", choices=tuple(FAMILIES))
    parser.add_argument("--only", metavar="NAME", help="train this variant and write nothing else")
    parser.add_argument("--folder", type=Path, default=Path("families"), help="where trainings are kept")
    arguments = parser.parse_args()
    family = FAMILIES[arguments.family]
    if arguments.only:
        trainings = (searched if arguments.what == "search" else finalists)(family)
        if arguments.only not in trainings:
            parser.error(f"To {arguments.what}, train one of {', '.join(map(repr, trainings))}.")
        for training in trainings[arguments.only]:
            training.survival(arguments.folder)
        return
    found = (search if arguments.what == "search" else compare)(family, arguments.folder)
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    results.setdefault(arguments.family, {})[arguments.what] = found
    write_json(RESULTS, results, indent=1)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
