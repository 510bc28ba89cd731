"""How fast the training loops are, and where the time goes.

``python benchmarks/loop_speed.py [--seconds 20]`` runs every algorithm for a while, after a warm-up, with one thread
for the grid and one for PyTorch, and writes ``benchmarks/results/loop_speed.json``: decisions and grid steps per
second of processor time, and the share of the time spent in the environments.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from rl2grid.algorithms.registry import find_algorithm
from rl2grid.records.files import write_json
from rl2grid.training.request import RunArgs, hyperparameters
from rl2grid.training.runs import make_envs

RESULTS = Path(__file__).resolve().parent / "results" / "loop_speed.json"
LOOPS: tuple[tuple[str, str, str | None], ...] = (
    ("ppo", "bus14-T0", None),
    ("ppo", "bus14-T0", "idle"),
    ("dqn", "bus14-T0", None),
    ("dqn", "bus14-T0", "idle"),
    ("sac", "bus14-T0", None),
    ("sac", "bus14-T0", "idle"),
    ("lagrangian-ppo", "bus14-T0-TLO", "idle"),
    ("ppo", "bus14-R", None),
    ("sac", "bus14-R", None),
    ("td3", "bus14-R", None),
    ("ppo", "bus36-MO-v0-T0", "idle"),
    ("ppo", "bus118-M-T0", "idle"),
)
NUM_ENVS = 64


def measure(algorithm: str, task: str, heuristic: str | None, seconds: float) -> dict[str, Any]:
    """Rates of one loop with its default hyperparameters."""
    chosen = hyperparameters(algorithm, task, total_timesteps=100_000_000, num_envs=NUM_ENVS, **_small(algorithm))
    envs = make_envs(RunArgs(task, chosen, algorithm, env_keywords={"heuristic": heuristic}, num_threads=1))
    trainer = find_algorithm(algorithm).trainer(chosen, envs)
    # The off-policy algorithms play before they learn.
    while trainer.decisions <= getattr(chosen, "learning_starts", 0):
        trainer.iterate()
    began, decisions, grid_steps = time.process_time(), trainer.decisions, trainer.grid_steps
    shares = []
    while time.process_time() - began < seconds:
        iteration = time.process_time()
        share = trainer.iterate()["charts/environment_share"]
        shares.append((time.process_time() - iteration, share))
    elapsed = time.process_time() - began
    envs.close()
    return {
        "num_envs": NUM_ENVS,
        "decisions_per_s": round((trainer.decisions - decisions) / elapsed),
        "grid_steps_per_s": round((trainer.grid_steps - grid_steps) / elapsed),
        "environment_share": round(sum(took * share for took, share in shares) / elapsed, 3),
    }


def _small(algorithm: str) -> dict[str, Any]:
    """A replay memory is sized by its bytes, not by the budget."""
    return {"buffer_bytes": 256 * 1024**2} if "buffer_bytes" in find_algorithm(algorithm).type_hints() else {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    results = {}
    for algorithm, task, heuristic in LOOPS:
        name = f"{algorithm} {task} {heuristic or 'plain'}"
        results[name] = measure(algorithm, task, heuristic, arguments.seconds)
        print(name, results[name], flush=True)
    write_json(RESULTS, results, indent=1)


if __name__ == "__main__":
    main()
