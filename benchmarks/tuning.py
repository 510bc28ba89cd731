"""Hyperparameters of PPO, DQN and SAC searched for with equal effort, and what was found beside the defaults.

``python benchmarks/tuning.py search [SEARCH ...] --folder F`` searches, as ``rl2grid study tune`` does, each
algorithm with the same number of trials, seeds and decisions, on the first 20 validation months: ``ppo``, ``dqn`` and
``sac`` the hyperparameters, ``ppo-rewards`` and the like the weights of the reward, with the discount. ``... compare
--folder F`` trains the defaults, the defaults with falling learning rates and what was found, with seeds that the
search did not use, and plays the policies on the 180 validation months behind these. Both go on after an interruption
and write ``benchmarks/results/tuning.json``. Test months are never played.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"

from gains import CHOSEN_ON, begin_or_go_on, compared, survival_behind
from rich.console import Console

from rl2grid.records.files import write_json
from rl2grid.records.searches import JOURNAL_FILE
from rl2grid.studies.search import run_tuning
from rl2grid.studies.tuning import WEIGHT_CHOICES, Tuning, parse_tuning, run_args
from rl2grid.training.runs import train
from rl2grid.training.validation import find_validator

RESULTS = Path(__file__).resolve().parent / "results" / "tuning.json"
EFFORT: dict[str, Any] = {
    "task": "bus14-T0",
    "heuristic": "careful",
    "trials": 14,
    "budget": 40_000,
    "validations": 4,
    "months": CHOSEN_ON,
    "seeds": [1, 2],
}
"""The same for all."""
_RATES = {"low": 1e-4, "high": 5e-3, "log": True}
_LAYERS = [[64, 64], [128, 128], [256, 256]]
_OFF_POLICY: dict[str, Any] = {
    "gamma": [0.9, 0.95, 0.99, 0.995],
    "train_frequency": [8, 16, 32],
    "batch_size": [128, 256, 512],
}
SPACES: dict[str, dict[str, Any]] = {
    "ppo": {
        "gamma": [0.9, 0.95, 0.99, 0.995],
        "gae_lambda": [0.8, 0.95, 1.0],
        "actor_learning_rate": _RATES,
        "critic_learning_rate": _RATES,
        "num_steps": [16, 32, 64],
        "update_epochs": [3, 5, 10],
        "entropy_coefficient": [0.0, 0.003, 0.01, 0.03],
        "actor_layers": _LAYERS,
    },
    "dqn": {
        **_OFF_POLICY,
        "learning_rate": _RATES,
        "target_frequency": [500, 1000, 2000],
        "epsilon_decay_fraction": [0.1, 0.3, 0.5],
        "exploration_do_nothing": [0.02, 0.3, 0.6],
        "layers": _LAYERS,
    },
    "sac": {
        **_OFF_POLICY,
        "actor_learning_rate": _RATES,
        "critic_learning_rate": _RATES,
        "tau": [0.005, 0.01, 0.03],
        "last_entropy_share": [0.02, 0.05, 0.1],
        "actor_layers": _LAYERS,
    },
}
"""What is searched: as many hyperparameters of each."""
REWARDS: dict[str, Any] = {
    "gamma": _OFF_POLICY["gamma"],
    **{name: list(choices) for name, choices in WEIGHT_CHOICES.items()},
}
"""What is searched of the reward: the paper's weights, and the discount, without which they mean little."""
FIXED: dict[str, dict[str, Any]] = {
    "ppo": {},
    "dqn": {"last_learning_rate_share": 0.05},
    "sac": {"last_learning_rate_share": 0.05},
}
"""The same in all trials: learning rates fall until the end, as PPO's do."""
SEEDS = (11, 12, 13)
"""Of the trainings that are compared."""


@dataclass(frozen=True)
class Search:
    """One search: of an algorithm, in a space."""

    algorithm: str
    space: Mapping[str, Any]

    @property
    def fixed(self) -> dict[str, Any]:
        """The same in all trials."""
        return FIXED[self.algorithm]


SEARCHES = {name: Search(name, space) for name, space in SPACES.items()} | {
    f"{name}-rewards": Search(name, REWARDS) for name in SPACES
}


def search(name: str, folder: Path) -> dict[str, Any] | None:
    """What was found, what was spent, and every trial; None when interrupted."""
    tuning = _tuning(name, SEARCHES[name].fixed, folder)
    if run_tuning(tuning, jobs=1, console=Console(stderr=True)) is None:
        return None
    found: dict[str, Any] = json.loads((tuning.output / "best.json").read_text())
    return {**found, "space": SEARCHES[name].space, "trials": _trials(tuning.output)}


def _tuning(name: str, fixed: Mapping[str, Any], folder: Path) -> Tuning:
    """The search, with some hyperparameters fixed."""
    contents = {
        "name": f"{name}-bus14",
        "algorithm": SEARCHES[name].algorithm,
        "hyperparameters": fixed,
        "space": SEARCHES[name].space,
        **EFFORT,
    }
    return parse_tuning(contents, folder / name)


def _trials(folder: Path) -> list[dict[str, Any]]:
    """Every trial that ended: whether it was ended early, the survival it had reached, what it chose."""
    import optuna
    from optuna.storages.journal import JournalFileBackend

    storage = optuna.storages.JournalStorage(JournalFileBackend(str(folder / JOURNAL_FILE)))
    return [
        {
            "state": trial.state.name.lower(),
            "survival": round(trial.user_attrs.get("survival", 0.0), 4),
            "chosen": trial.params,
        }
        for trial in optuna.load_study(study_name=None, storage=storage).get_trials(deepcopy=False)
    ]


def variants(name: str, found: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """What is compared, as changes of the preset ``default``, weights of the reward among them."""
    fixed = SEARCHES[name].fixed
    falling = {"falling": fixed} if fixed else {}
    return {"default": {}, **falling, "found": {**fixed, **found["hyperparameters"]}}


def survival(name: str, variant: str, changes: Mapping[str, Any], seed: int, folder: Path) -> list[float]:
    """Train, or go on, and play the best policy: survival of each of the months that no trial was chosen by."""
    run = folder / f"{name}-{variant}-{seed}"
    args = run_args(_tuning(name, {}, folder), changes, run, seed)
    begin_or_go_on(run, lambda: train(args, evaluate=find_validator(args)))
    return survival_behind(run, EFFORT["task"])


def compare(name: str, found: dict[str, Any], folder: Path, keep: Callable[[], None]) -> None:
    """Train and play what is not there yet, and compare."""
    all_variants = variants(name, found)
    played = found.setdefault("played", {})
    for seed in SEEDS:
        for variant, changes in all_variants.items():
            months_of = played.setdefault(variant, {})
            if f"seed {seed}" not in months_of:
                months_of[f"seed {seed}"] = survival(name, variant, changes, seed, folder)
                keep()
    found["compared"] = compared({variant: list(runs.values()) for variant, runs in played.items()}, "default")
    keep()
    print(name, json.dumps(found["compared"]))


def main() -> None:
    """Search, or compare, what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("search", "compare"))
    parser.add_argument("searches", nargs="*", metavar="SEARCH", help=f"of {', '.join(SEARCHES)}; default: all")
    parser.add_argument("--folder", type=Path, default=Path("tuning"), help="where trainings are kept")
    arguments = parser.parse_args()
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {"effort": EFFORT, "algorithms": {}}
    for name in arguments.searches or SEARCHES:
        if name not in SEARCHES:
            parser.error(f"There is no search {name!r}: choose among {', '.join(SEARCHES)}.")
        if arguments.what == "search":
            found = search(name, arguments.folder)
            if found is None:
                return
            results["algorithms"][name] = found
            write_json(RESULTS, results, indent=1)
            print(name, found["survival"], found["command"])
        else:
            found = results["algorithms"][name]
            compare(name, found, arguments.folder, lambda: write_json(RESULTS, results, indent=1))


if __name__ == "__main__":
    main()
