"""What a graphics card is worth to a training, and whether it learns the same there.

``python benchmarks/devices.py [--threads N] [--rounds 3] [--only TEXT]`` trains each case on the processor, on the
processor with all of PyTorch's threads, and on the card (``--device cuda``), with as many threads for the environments
in all three. It writes ``benchmarks/results/devices.json``:

- decisions per second of wall clock, the median of the rounds, devices taking turns in each, months and resets
  included, and the share of the time that acting and learning take, without the environments;
- how far the weights after the first update on the card are from those on the processor, as a share of what the update
  moved them: rounding, not another method;
- whether two trainings on the card have the same weights, to the last bit, after each of three iterations.

With ``--only`` other cases stay in the results as they are. It needs a card, and refuses to run without one.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from loop_speed import Timed

from rl2grid.algorithms.devices import find_device
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.envs.tasks import find_task
from rl2grid.records.files import write_json
from rl2grid.records.versions import library_versions, processor
from rl2grid.training.request import RunArgs, hyperparameters
from rl2grid.training.runs import make_envs

RESULTS = Path(__file__).resolve().parent / "results" / "devices.json"


@dataclass(frozen=True)
class Case:
    """A training."""

    algorithm: str
    task: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes of its default hyperparameters."""

    @property
    def name(self) -> str:
        """As in the results."""
        return " ".join([self.algorithm, self.task, *(f"{name}={value}" for name, value in self.changes.items())])


LARGE: dict[str, Any] = {"num_envs": 256, "num_steps": 32, "num_minibatches": 4}
"""Updates of 8,192 decisions in minibatches of 2,048."""
WIDE: dict[str, Any] = {"actor_layers": (1024, 1024, 1024), "critic_layers": (1024, 1024, 1024)}
CASES = (
    Case("ppo", "bus14-T0"),
    Case("ppo", "bus36-MO-v0-T0", LARGE),
    Case("ppo", "bus36-MO-v0-T0", LARGE | WIDE),
    Case("ppo", "bus36-MO-v0-T1", LARGE | {"network": "gnn"}),
    Case("ppo", "bus36-MO-v0-T4", LARGE | {"network": "action-embedding"}),
    Case("ppo", "bus36-MO-v0-R", LARGE | WIDE),
    Case("lagrangian-ppo", "bus36-MO-v0-T0-LSI", LARGE),
    Case("dqn", "bus14-T0"),
    Case("sac", "bus14-T0"),
    Case("sac", "bus36-MO-v0-T0", {"num_envs": 64, "batch_size": 4096, "train_frequency": 256}),
    Case("td3", "bus14-R"),
)


class Training:
    """A case on a device."""

    def __init__(self, case: Case, device: str, torch_threads: int, num_threads: int) -> None:
        changes: dict[str, Any] = {"total_timesteps": 100_000_000, "device": device, "torch_threads": torch_threads}
        fields = find_algorithm(case.algorithm).type_hints()
        if "buffer_bytes" in fields:
            changes |= {"buffer_bytes": 256 * 1024**2, "learning_starts": 1024, "num_steps": 16}
        chosen = hyperparameters(case.algorithm, case.task, **(changes | dict(case.changes)))
        heuristic = None if find_task(case.task).kind == "R" else "idle"
        args = RunArgs(
            find_task(case.task), chosen, case.algorithm, num_threads=num_threads, env_keywords={"heuristic": heuristic}
        )
        self.envs = Timed(make_envs(args), time.perf_counter)
        self.trainer: Any = find_algorithm(case.algorithm).trainer(chosen, self.envs)
        self._threads = torch_threads

    def weights(self) -> list[torch.Tensor]:
        """Of the policy, on the processor."""
        return [each.detach().cpu().clone() for each in self.trainer.policy()[0].state_dict().values()]

    def rate(self, at_least: float) -> tuple[float, float]:
        """Decisions per second of iterations that take ``at_least`` so many seconds, and the share of the learner."""
        torch.set_num_threads(self._threads)
        decisions, steps, began = self.trainer.decisions, self.envs.seconds, time.perf_counter()
        while (took := time.perf_counter() - began) < at_least:
            self.trainer.iterate()
        return (self.trainer.decisions - decisions) / took, 1.0 - (self.envs.seconds - steps) / took


def distance(these: list[torch.Tensor], those: list[torch.Tensor]) -> float:
    """Of two lists of weights."""
    return float(sum((a.double() - b.double()).square().sum() for a, b in zip(these, those, strict=True)).sqrt())  # type: ignore[union-attr]


def until_updated(training: Training) -> None:
    """Iterate until the policy was updated once: algorithms with a memory fill it first."""
    before = training.weights()
    for _ in range(1000):
        training.trainer.iterate()
        if distance(before, training.weights()) > 0.0:
            return
    raise RuntimeError("a thousand iterations did not change the policy")


def measured(case: Case, options: argparse.Namespace) -> dict[str, Any]:
    """What the results say of a case."""
    cores = os.cpu_count() or 1
    devices = {"cpu": ("cpu", 1), f"cpu, {cores} threads": ("cpu", cores), "cuda": ("cuda", 1)}
    trainings = {name: Training(case, *where, options.threads) for name, where in devices.items()}
    again = Training(case, "cuda", 1, options.threads)
    start = trainings["cpu"].weights()
    for training in (*trainings.values(), again):
        until_updated(training)
    moved = distance(start, trainings["cpu"].weights())
    row: dict[str, Any] = {
        "rounds": options.rounds,
        "apart_of_moved": distance(trainings["cpu"].weights(), trainings["cuda"].weights()) / moved,
        "same_again": [distance(trainings["cuda"].weights(), again.weights()) == 0.0],
    }
    for _ in range(2):
        trainings["cuda"].trainer.iterate()
        again.trainer.iterate()
        row["same_again"].append(distance(trainings["cuda"].weights(), again.weights()) == 0.0)
    rates: dict[str, list[tuple[float, float]]] = {name: [] for name in trainings}
    for _ in range(options.rounds):
        for name, training in trainings.items():
            rates[name].append(training.rate(options.seconds))
    for name, pairs in rates.items():
        decisions, shares = zip(*pairs, strict=True)
        row[name] = {
            "decisions_per_second": round(statistics.median(decisions)),
            "learner": round(statistics.median(shares), 3),
        }
    for training in (*trainings.values(), again):
        training.envs.close()
    return row


def main() -> None:
    """Measure, and write what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="of the environments")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each device in each round")
    parser.add_argument("--only", default="", help="cases whose names contain this")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    card = find_device("cuda")
    result: dict[str, Any] = {
        "command": f"python benchmarks/devices.py --threads {options.threads}",
        "card": torch.cuda.get_device_name(card),
        "processor": processor(),
        "cores": os.cpu_count(),
        "versions": library_versions(),
        "cases": json.loads(options.results.read_text())["cases"] if options.only and options.results.exists() else {},
    }
    for case in CASES:
        if options.only not in case.name:
            continue
        row = result["cases"][case.name] = measured(case, options)
        print(case.name, row, flush=True)
        write_json(options.results, result, indent=1)


if __name__ == "__main__":
    main()
