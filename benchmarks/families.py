"""Hyperparameters of PPO and SAC on larger grids, each changed alone, and what looked best again with other seeds.

``python benchmarks/families.py search FAMILY --folder F`` trains PPO's preset ``default`` and variants of it on a task
of the family, with two seeds, each on 100,000 decisions, keeps the policy that survives longest on the first 20
validation months and plays it on the 60 behind these. ``... compare FAMILY --folder F`` trains the preset, the
variants that were best on 36 substations, and their changes at once, with seeds that the search did not use, and plays
them on the 120 validation months that it did not play. ``--algorithm sac`` does the same with SAC's preset ``tuned``
and variants of it. The family ``36-R`` is of redispatch; what is compared there of SAC was found without a search. All
go on after an interruption, write ``benchmarks/results/families.json`` and print what they wrote. ``--only NAME``
trains one variant and writes nothing, for several processes side by side. Test months are never played.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from gains import CHOSEN_ON, begin_or_go_on, compared, survival_behind

import rl2grid
from rl2grid.records.files import write_json

RESULTS = Path(__file__).resolve().parent / "results" / "families.json"
BUDGET, VALIDATIONS = 100_000, 5
SEARCHED = 60
"""How many of the months behind those that chose a policy are played by a search; others compare what it found."""
PRESET = "preset"
"""The variant that changes nothing."""


@dataclass(frozen=True)
class Candidates:
    """What is trained of an algorithm: variants of a preset, each named after what it changes."""

    preset: str
    variants: Mapping[str, Mapping[str, Mapping[str, Any]]]
    """By stage. Compared are the preset, what was best of the search and its changes at once; of SAC, where nothing was
    better, what was searched.
    """


_SLOWER: dict[str, Any] = {"actor_learning_rate": 3e-4, "critic_learning_rate": 3e-4}
_LARGER: dict[str, Any] = {"num_envs": 64, "num_steps": 32, "num_minibatches": 8}
_OF_SAC: dict[str, dict[str, Any]] = {
    PRESET: {},
    "rates 0.001": {"actor_learning_rate": 1e-3, "critic_learning_rate": 1e-3},
    "an update every 8 decisions": {"train_frequency": 8},
}
TOPOLOGY = {
    "ppo": Candidates(
        "default",
        {
            "search": {
                PRESET: {},
                "gamma 0.95": {"gamma": 0.95},
                "gamma 0.99": {"gamma": 0.99},
                "rates 0.0003": _SLOWER,
                "rates 0.003": {"actor_learning_rate": 3e-3, "critic_learning_rate": 3e-3},
                "layers of 64": {"actor_layers": [64, 64], "critic_layers": [64, 64]},
                "layers of 256": {"actor_layers": [256, 256], "critic_layers": [256, 256]},
                "updates of 2,048": _LARGER,
            },
            "compare": {
                PRESET: {},
                "rates 0.0003": _SLOWER,
                "updates of 2,048": _LARGER,
                "updates of 2,048, rates 0.0003": {**_LARGER, **_SLOWER},
            },
        },
    ),
    "sac": Candidates("tuned", {"search": _OF_SAC, "compare": _OF_SAC}),
}
_WIDE: dict[str, Any] = {"initial_log_std": 0.0}
"""First draws with a deviation of 1, all that can be asked for, in place of 0.37."""
_CALM: dict[str, Any] = {
    "tune_temperature": False,
    "initial_temperature": 3e-4,
    "train_frequency": 32,
    "batch_size": 512,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 3e-3,
    "tau": 0.03,
    "last_learning_rate_share": 0.05,
}
"""A temperature at which entropy is worth less than what is earned, and few large updates, which are ever smaller."""
REDISPATCH = {
    "ppo": Candidates(
        "default",
        {
            "search": {
                PRESET: {},
                "wide": _WIDE,
                "wide, gamma 0.95": {**_WIDE, "gamma": 0.95},
                "wide, gamma 0.998": {**_WIDE, "gamma": 0.998},
                "wide, rates 0.001": {**_WIDE, "actor_learning_rate": 1e-3, "critic_learning_rate": 1e-3},
                "wide, updates of 256": {**_WIDE, "num_steps": 16},
                "wide, updates of 2,048": {**_WIDE, **_LARGER},
            },
            "compare": {PRESET: {}, "wide": _WIDE},
        },
    ),
    "sac": Candidates("default", {"compare": {PRESET: {}, "temperature 0.0003": _CALM}}),
}


@dataclass(frozen=True)
class Family:
    """Where hyperparameters of a family of grids are searched for."""

    task: str
    heuristic: str
    """By which greedy search survives longest, or of redispatch what policies learned."""
    candidates: Mapping[str, Candidates]
    """By algorithm."""


FAMILIES = {
    "36": Family("bus36-M-T0", "careful", TOPOLOGY),
    "118": Family("bus118-M-T0", "careful", TOPOLOGY),
    "36-R": Family("bus36-M-R", "recovery", REDISPATCH),
}


@dataclass(frozen=True)
class Stage:
    """A search, or what compares its finds: with which seeds, and the months that are played."""

    seeds: tuple[int, ...]
    skip: int
    """Months behind those that choose a policy which are not played."""
    months: int | None
    """How many are played then; None: all."""


STAGES = {"search": Stage((1, 2), 0, SEARCHED), "compare": Stage((11, 12, 13), SEARCHED, None)}


@dataclass(frozen=True)
class Trainings:
    """Trainings of variants on a family of grids, kept in a folder."""

    algorithm: str
    family: Family
    stage: Stage
    folder: Path

    def survival(self, variant: str, changes: Mapping[str, Any], seed: int) -> list[float]:
        """Train a variant, or go on, and play the best policy: survival of the months; kept in the folder."""
        task = self.family.task
        label = f"{self.algorithm}-{task}-{variant.replace(',', '').replace(' ', '-')}-{seed}"
        run, kept = self.folder / label, self.folder / f"{label}.json"
        if kept.exists():
            survival: list[float] = json.loads(kept.read_text())
            return survival
        begin_or_go_on(run, lambda: self._begin(run, {**changes, "seed": seed}))
        survival = survival_behind(run, task, self.stage.months, skip=self.stage.skip)
        write_json(kept, survival)
        print(self.algorithm, task, variant, seed, round(float(np.mean(survival)), 3), flush=True)
        return survival

    def _begin(self, run: Path, changes: Mapping[str, Any]) -> None:
        """Train from the beginning."""
        rl2grid.train(
            self.algorithm,
            self.family.task,
            folder=run,
            preset=self.family.candidates[self.algorithm].preset,
            hyperparameters={**changes, "total_timesteps": BUDGET},
            num_threads=1,
            validation_months=CHOSEN_ON,
            evaluate_every=BUDGET // VALIDATIONS,
            progress=False,
            heuristic=self.family.heuristic,
        )


def main() -> None:
    """Train what is asked for and not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=tuple(STAGES))
    parser.add_argument("family", choices=tuple(FAMILIES))
    parser.add_argument("--algorithm", choices=tuple(TOPOLOGY), default="ppo")
    parser.add_argument("--only", metavar="NAME", help="train this variant and write nothing else")
    parser.add_argument("--folder", type=Path, default=Path("families"), help="where trainings are kept")
    arguments = parser.parse_args()
    family, stage = FAMILIES[arguments.family], STAGES[arguments.what]
    if arguments.algorithm not in family.candidates:
        parser.error(f"Of family {arguments.family}, train {', '.join(family.candidates)}.")
    stages = family.candidates[arguments.algorithm].variants
    if arguments.what not in stages:
        parser.error(f"Of family {arguments.family} and {arguments.algorithm}, there is only: {', '.join(stages)}.")
    variants = stages[arguments.what]
    if arguments.only and arguments.only not in variants:
        parser.error(f"To {arguments.what}, train one of {', '.join(map(repr, variants))}.")
    trainings = Trainings(arguments.algorithm, family, stage, arguments.folder)
    survival = {
        name: [trainings.survival(name, variants[name], seed) for seed in stage.seeds]
        for name in ([arguments.only] if arguments.only else variants)
    }
    if arguments.only:
        return
    found: dict[str, Any] = {
        "trainings": {name: [round(float(np.mean(run)), 4) for run in runs] for name, runs in survival.items()}
    }
    if arguments.what == "compare":
        found["compared"] = compared(survival, PRESET)
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    where = {"task": family.task, "heuristic": family.heuristic}
    results.setdefault(arguments.family, where).setdefault(arguments.algorithm, {})[arguments.what] = found
    write_json(RESULTS, results, indent=1)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
