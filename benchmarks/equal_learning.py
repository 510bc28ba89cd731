"""Whether fewer gradients a decision learn as much from each: hyperparameters side by side, on validation months.

``python benchmarks/equal_learning.py [--loops sac,dqn,td3,ppo] [--budget N] [--seeds 2] [--months 30]`` trains every
variant of a loop on bus14 with the same budget of decisions and the same seeds, plays the policy as it is after every
third of the budget on validation months, and adds to ``benchmarks/results/equal_learning.json`` what is not there yet:
survival and processor seconds of training, one thread. Test months are never played.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rl2grid.algorithms.policy_agent import PolicyAgent
from rl2grid.envs.tasks import find_task
from rl2grid.records.files import write_json
from rl2grid.training.request import RunArgs, hyperparameters
from rl2grid.training.runs import train
from rl2grid.training.validation import validator

RESULTS = Path(__file__).resolve().parent / "results" / "equal_learning.json"
PLAYED = 3
"""Times that the policy is validated."""


@dataclass(frozen=True)
class Loop:
    """An algorithm on a task, and the hyperparameters that are compared."""

    algorithm: str
    task: str
    heuristic: str | None
    budget: int
    """Decisions."""
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Changes of the preset, by name."""

    @property
    def name(self) -> str:
        """As in the results."""
        return f"{self.algorithm} {self.task} {self.heuristic or 'plain'} {self.budget}"


_LARGE_STEPS = {"train_frequency": 32, "actor_learning_rate": 1e-3, "critic_learning_rate": 3e-3, "tau": 0.03}
_SMALL_STEPS = {"train_frequency": 4, "actor_learning_rate": 3e-4, "critic_learning_rate": 1e-3, "tau": 0.005}
LOOPS: tuple[Loop, ...] = (
    Loop(
        "sac",
        "bus14-T0",
        "idle",
        30_720,
        {
            "every 4": {**_SMALL_STEPS, "temperature_learning_rate": 1e-3},
            "every 32": {**_LARGE_STEPS, "temperature_learning_rate": 5e-3},
        },
    ),
    Loop(
        "dqn",
        "bus14-T0",
        "idle",
        30_720,
        {
            "every 4": {"train_frequency": 4, "learning_rate": 1e-3},
            "every 32": {"train_frequency": 32, "learning_rate": 3e-3},
        },
    ),
    Loop("td3", "bus14-R", "idle", 30_720, {"every 4": _SMALL_STEPS, "every 32": _LARGE_STEPS}),
    Loop(
        "sac",
        "bus14-R",
        "idle",
        30_720,
        {
            "every 4": {**_SMALL_STEPS, "temperature_learning_rate": 1e-3},
            "every 32": {**_LARGE_STEPS, "temperature_learning_rate": 5e-3},
        },
    ),
    Loop(
        "ppo",
        "bus14-T0",
        "idle",
        98_304,
        {
            "10 epochs": {"update_epochs": 10, "actor_learning_rate": 1e-3, "critic_learning_rate": 1e-3},
            "3 epochs": {"update_epochs": 3, "actor_learning_rate": 3e-3, "critic_learning_rate": 3e-3},
            "10 epochs, 64 environments": {
                "num_envs": 64, "update_epochs": 10, "actor_learning_rate": 1e-3, "critic_learning_rate": 1e-3
            },
            "3 epochs, 64 environments": {
                "num_envs": 64, "update_epochs": 3, "actor_learning_rate": 3e-3, "critic_learning_rate": 3e-3
            },
        },
    ),
    Loop(
        "ppo",
        "bus14-T0",
        "idle",
        196_608,
        {
            "10 epochs, 64 environments": {
                "num_envs": 64, "update_epochs": 10, "actor_learning_rate": 1e-3, "critic_learning_rate": 1e-3
            },
            "3 epochs, 64 environments": {
                "num_envs": 64, "update_epochs": 3, "actor_learning_rate": 3e-3, "critic_learning_rate": 3e-3
            },
        },
    ),
    Loop("dqn", "bus14-T0", "careful", 61_440, {"no lag": {}, "lag": {"lag": 1}}),
    Loop("sac", "bus14-T0", "careful", 61_440, {"no lag": {}, "lag": {"lag": 1}}),
)  # fmt: skip


class Watch:
    """Validation, and the processor seconds of what is not validation."""

    def __init__(self, args: RunArgs) -> None:
        self._validate = validator(args)
        self._began = time.process_time()
        self.seconds = 0.0
        self.survival: list[float] = []

    def __call__(self, agent: PolicyAgent) -> Mapping[str, float]:
        """Means over the validation months."""
        self.seconds += time.process_time() - self._began
        means = self._validate(agent)
        self.survival.append(round(means["survival"], 4))
        self._began = time.process_time()
        return means


def measure(loop: Loop, changes: Mapping[str, Any], seed: int, months: int) -> dict[str, Any]:
    """One training: survival after every third of the budget, and what it took."""
    chosen = hyperparameters(loop.algorithm, loop.task, total_timesteps=loop.budget, seed=seed, **changes)
    iteration = chosen.num_envs * chosen.num_steps
    with tempfile.TemporaryDirectory() as folder:
        args = RunArgs(
            find_task(loop.task),
            chosen,
            loop.algorithm,
            Path(folder) / "run",
            {"heuristic": loop.heuristic},
            num_threads=1,
            checkpoint_seconds=1e9,
            evaluate_every=max(iteration, loop.budget // PLAYED),
            validation_months=months,
            tensorboard=False,
            progress=False,
        )
        watch = Watch(args)
        train(args, evaluate=watch)
    return {
        "survival": watch.survival,
        "processor_seconds": round(watch.seconds, 1),
    }


def main() -> None:
    """Train what is asked for and not there yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--loops", default="sac,dqn,td3,ppo", help="algorithms")
    parser.add_argument("--budget", type=int, default=None, help="only loops of so many decisions")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--months", type=int, default=30)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    results = json.loads(arguments.results.read_text()) if arguments.results.exists() else {}
    for loop in LOOPS:
        if loop.algorithm not in arguments.loops.split(",") or arguments.budget not in (None, loop.budget):
            continue
        for variant, changes in loop.variants.items():
            for seed in range(1, arguments.seeds + 1):
                one = results.setdefault(loop.name, {}).setdefault(variant, {"changes": dict(changes)})
                if f"seed {seed}" in one:
                    continue
                one[f"seed {seed}"] = measure(loop, changes, seed, arguments.months)
                print(loop.name, variant, seed, one[f"seed {seed}"], flush=True)
                write_json(arguments.results, results, indent=1)


if __name__ == "__main__":
    main()
