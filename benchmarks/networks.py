"""What networks cost: weights, and the time of a pass beside an ``mlp`` of the same layers in the same run.

``python benchmarks/networks.py [TASK ...] [--batch N] [--repeats N] [--decisions N]`` measures, for each network of the
package, the processor time of one forward and backward pass of a policy and of a critic on one thread (the least of the
repetitions, networks taking turns), and decisions a second of PPO through ``gymnasium.make_vec``, months and resets
included. It writes ``benchmarks/results/networks.json``. Observations are random; in them one element in a thousand is
on busbar 2.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rl2grid.algorithms.networks import PER_ACTION, VALUE, NetworkFactory, Output, orthogonal
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.envs.spec import Spec, task_spec
from rl2grid.envs.tasks import find_task
from rl2grid.records.files import write_json
from rl2grid.records.versions import processor
from rl2grid.training import request
from rl2grid.training.runs import make_envs

RESULTS = Path(__file__).resolve().parent / "results" / "networks.json"
NETWORKS = ("mlp", "action-embedding", "gnn")
LAYERS = (128, 128)
TASKS = ("bus14-T0", "bus36-MO-v0-T0", "bus36-MO-v0-T1", "bus118-M-T1", "bus14-R")


def observations(spec: Spec, batch: int) -> Tensor:
    """Random observations with a few divided substations."""
    generator = torch.Generator().manual_seed(0)
    drawn = torch.rand(batch, spec.observation_size, generator=generator)
    for feature in spec.features:
        if feature.name == "topo_vect":
            size = (batch, feature.end - feature.begin)
            drawn[:, feature.begin : feature.end] = (torch.rand(size, generator=generator) < 1e-3).float()
    return drawn


def made(spec: Spec, name: str, output: Output) -> nn.Module:
    return NetworkFactory(spec, name, torch.Generator().manual_seed(0)).make(output, LAYERS, orthogonal(0.01))


def seconds(module: nn.Module, inputs: Tensor) -> float:
    """Processor time of one forward and backward pass, which other processes on the machine do not count into."""
    began = time.process_time()
    module(inputs).square().mean().backward()
    return time.process_time() - began


def passes(spec: Spec, batch: int, repeats: int) -> dict[str, dict[str, float]]:
    """Weights of the policy, and milliseconds of a pass of policy and critic together."""
    inputs = observations(spec, batch)
    modules = {name: [made(spec, name, output) for output in (PER_ACTION, VALUE)] for name in NETWORKS}
    best = dict.fromkeys(NETWORKS, float("inf"))
    for _ in range(repeats):
        for name, pair in modules.items():
            best[name] = min(best[name], sum(seconds(module, inputs) for module in pair))
    return {
        name: {
            "weights": sum(weights.numel() for weights in pair[0].parameters()),
            "milliseconds": round(1e3 * best[name], 2),
            "to_mlp": round(best[name] / best["mlp"], 2),
        }
        for name, pair in modules.items()
    }


def decisions_a_second(task: str, name: str, decisions: int) -> float:
    """Of PPO with its defaults, without validation and files; months are there."""
    heuristic = None if find_task(task).kind == "R" else "idle"
    chosen = request.hyperparameters("ppo", task, network=name, total_timesteps=decisions)
    with tempfile.TemporaryDirectory() as folder:
        args = request.RunArgs(task, chosen, "ppo", Path(folder) / "run", env_keywords={"heuristic": heuristic})
        envs = make_envs(request.complete(args))
        trainer = find_algorithm("ppo").trainer(chosen, envs)
        trainer.iterate()
        began, before = time.perf_counter(), trainer.decisions
        while not trainer.finished:
            trainer.iterate()
        took = time.perf_counter() - began
        envs.close()
        return (trainer.decisions - before) / took


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=TASKS)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--decisions", type=int, default=20_000)
    options = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, Any] = {"processor": processor(), "batch": options.batch, "layers": LAYERS, "tasks": {}}
    for task in options.tasks:
        rows = passes(task_spec(find_task(task)), options.batch, options.repeats)
        for name in NETWORKS if options.decisions else ():
            rows[name]["ppo_decisions_per_second"] = round(decisions_a_second(task, name, options.decisions))
        results["tasks"][task] = rows
        print(task, json.dumps(rows, indent=1))
    everything = find_task("bus36-MO-v0-T4")
    results["weights_of_all_actions"] = {
        name: sum(weights.numel() for weights in made(task_spec(everything), name, PER_ACTION).parameters())
        for name in NETWORKS
    }
    write_json(RESULTS, results)


if __name__ == "__main__":
    main()
