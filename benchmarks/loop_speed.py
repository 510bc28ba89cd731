"""How fast the training loops are, and where the time goes.

``python benchmarks/loop_speed.py [--seconds 8] [--only NAME ...]`` runs every algorithm for a while, after a warm-up,
with its default hyperparameters, and writes ``benchmarks/results/loop_speed.json``. With one thread for everything:
decisions and grid steps per second of processor time, and the share of it that the environments take. With two, for the
environments and, in turn, for what learns: the same per second. With two and a lag (DQN, SAC, TD3), which learn while
environments play: likewise. Nothing else should run meanwhile.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from gymnasium.vector import VectorEnv, VectorWrapper

from rl2grid.algorithms.registry import find_algorithm
from rl2grid.records.files import write_json
from rl2grid.records.versions import processor
from rl2grid.training.request import RunArgs, hyperparameters
from rl2grid.training.runs import make_envs

RESULTS = Path(__file__).resolve().parent / "results" / "loop_speed.json"
LOOPS: tuple[tuple[str, str, str | None, int], ...] = (
    ("ppo", "bus14-T0", None, 64),
    ("ppo", "bus14-T0", None, 256),
    ("ppo", "bus14-T0", "idle", 64),
    ("ppo", "bus36-MO-v0-T0", "idle", 64),
    ("ppo", "bus118-M-T0", "idle", 64),
    ("ppo", "bus14-T0", "idle", 256),
    ("ppo", "bus36-MO-v0-T0", "idle", 256),
    ("ppo", "bus118-M-T0", "idle", 256),
    ("ppo", "bus14-R", None, 64),
    ("lagrangian-ppo", "bus14-T0-TLO", "idle", 64),
    ("dqn", "bus14-T0", None, 64),
    ("dqn", "bus14-T0", "idle", 64),
    ("sac", "bus14-T0", None, 64),
    ("sac", "bus14-T0", "idle", 64),
    ("sac", "bus14-T0", "recovery", 64),
    ("sac", "bus14-R", None, 64),
    ("td3", "bus14-R", None, 64),
)
"""Algorithm, task, heuristic and environments."""


class Timed(VectorWrapper[Any, Any, Any, Any, Any]):
    """Environments that note the time that their steps take, by a clock."""

    def __init__(self, envs: VectorEnv[Any, Any, Any], clock: Callable[[], float]) -> None:
        super().__init__(envs)
        self.seconds, self._clock = 0.0, clock

    def step(self, actions: Any) -> Any:
        """As of the environments."""
        began = self._clock()
        result = self.env.step(actions)
        self.seconds += self._clock() - began
        return result

    def action_masks(self) -> Any:
        """As of the environments."""
        return self.env.action_masks()  # type: ignore[attr-defined]


def measure(
    algorithm: str,
    task: str,
    heuristic: str | None,
    num_envs: int,
    *,
    num_threads: int,
    seconds: float,
    clock: Callable[[], float],
    **changes: Any,
) -> dict[str, float]:
    """Rates of one loop per second of the clock, and with one thread the share of the environments.

    ``changes`` are of the default hyperparameters.
    """
    changes = {"total_timesteps": 100_000_000, "num_envs": num_envs, **_small(algorithm), **changes}
    chosen = hyperparameters(algorithm, task, **changes)
    arguments = RunArgs(task, chosen, algorithm, env_keywords={"heuristic": heuristic}, num_threads=num_threads)
    envs: Any = Timed(make_envs(arguments), clock)
    trainer = find_algorithm(algorithm).trainer(chosen, envs)
    trainer.iterate()
    # The off-policy algorithms play before they learn.
    while trainer.decisions <= getattr(chosen, "learning_starts", 0):
        trainer.iterate()
    began, decisions, grid_steps, envs.seconds = clock(), trainer.decisions, trainer.grid_steps, 0.0
    while clock() - began < seconds:
        trainer.iterate()
    elapsed = clock() - began
    envs.close()
    rates = {
        "decisions_per_s": round((trainer.decisions - decisions) / elapsed),
        "grid_steps_per_s": round((trainer.grid_steps - grid_steps) / elapsed),
    }
    return rates | ({"environment_share": round(envs.seconds / elapsed, 3)} if num_threads == 1 else {})


def _remembers(algorithm: str) -> bool:
    """Whether it learns from a replay memory."""
    return "buffer_bytes" in find_algorithm(algorithm).type_hints()


def _small(algorithm: str) -> dict[str, Any]:
    """A replay memory is sized by its bytes, not by the budget."""
    return {"buffer_bytes": 256 * 1024**2} if _remembers(algorithm) else {}


def main() -> None:
    """Measure all loops, and write what came out."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--only", nargs="+", default=None, help="loops, by the beginning of their names")
    options = parser.parse_args()
    results: dict[str, Any] = json.loads(RESULTS.read_text()) if options.only and RESULTS.exists() else {}
    results["processor"] = processor()
    for algorithm, task, heuristic, num_envs in LOOPS:
        name = f"{algorithm} {task} {heuristic or 'plain'} {num_envs}"
        if options.only is not None and not name.startswith(tuple(options.only)):
            continue
        rates = partial(measure, algorithm, task, heuristic, num_envs, seconds=options.seconds)
        results[name] = {
            "seconds": options.seconds,
            "one thread": rates(num_threads=1, clock=time.process_time),
            "two threads": rates(num_threads=2, clock=time.perf_counter),
        }
        if _remembers(algorithm):
            results[name]["two threads, lag"] = rates(num_threads=2, clock=time.perf_counter, lag=1)
        print(name, results[name], flush=True)
        write_json(RESULTS, results, indent=1)


if __name__ == "__main__":
    main()
