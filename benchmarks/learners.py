"""What learners take beside their environments, before and now.

``python benchmarks/learners.py --before REVISION [--rounds 5]`` plays random legal actions once, keeps what the
environments showed, and lets every algorithm learn from that again and again: acting, counting, remembering and
updating as in a training, with environments that take no time. Two processes, one with the sources of the revision and
one with those of this checkout, take turns on one thread; ``benchmarks/results/learners.json`` gets the median
microseconds of processor time per decision of each, and the median of the ratios of every round.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper

from rl2grid.algorithms.registry import find_algorithm
from rl2grid.envs.tasks import find_task
from rl2grid.training.request import RunArgs, hyperparameters
from rl2grid.training.runs import make_envs

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "learners.json"
RECORDED = 48
"""Steps of all environments that are played again and again."""
READ = {
    "n_steps", "discounted_reward", "over", "illegal", "ambiguous", "reset_steps", "reset_reward", "reset_costs",
    "costs", "survival", "scores", "episode_costs", "final_obs", "final_info",
}  # fmt: skip
"""What learners read of ``infos``."""

Shown = tuple[Any, ...]
"""What a step returns (five things), and the masks after it, None for continuous actions."""


@dataclass(frozen=True)
class Case:
    """A learner."""

    algorithm: str
    task: str
    num_envs: int
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Changes of its default hyperparameters."""

    @property
    def name(self) -> str:
        """As in the results."""
        changes = "".join(f" {name}={value}" for name, value in self.changes.items())
        return f"{self.algorithm} {self.task} {self.num_envs}{changes}"


CASES = (
    Case("ppo", "bus14-T0", 64),
    Case("ppo", "bus14-T0", 256),
    Case("ppo", "bus14-R", 64),
    Case("ppo", "bus14-R", 256),
    Case("lagrangian-ppo", "bus14-T0-TLO", 64),
    Case("dqn", "bus14-T0", 64),
    Case("sac", "bus14-T0", 64),
    Case("sac", "bus14-R", 64),
    Case("td3", "bus14-R", 64),
)


def args_of(case: Case) -> RunArgs:
    """The training whose learner is measured."""
    sizes: dict[str, Any] = {"total_timesteps": 100_000_000, "num_envs": case.num_envs}
    if "buffer_bytes" in find_algorithm(case.algorithm).type_hints():
        # A memory is sized by its bytes, not by the budget; short iterations are measured as well as long ones.
        sizes |= {"buffer_bytes": 256 * 1024**2, "num_steps": 4}
    chosen = hyperparameters(case.algorithm, case.task, **sizes, **case.changes)
    return RunArgs(find_task(case.task), chosen, case.algorithm, num_threads=1)


# --- Environments that take no time ---------------------------------------------------------------------------------


def record(case: Case) -> list[Shown]:
    """What a reset and some steps of random legal actions show, half of which do nothing."""
    envs = make_envs(args_of(case))
    random = np.random.default_rng(0)
    discrete = case.task.split("-")[1].startswith("T")
    masks = envs.action_masks if discrete else lambda: None  # type: ignore[attr-defined]
    observations, infos = envs.reset(seed=0)
    nothing = np.zeros(case.num_envs, np.bool_)
    steps: list[Shown] = [_copied((observations, nothing.astype(float), nothing, nothing, infos, masks()))]
    for _ in range(RECORDED):
        played = steps[-1][-1]
        if played is None:
            actions = random.uniform(-0.3, 0.3, (case.num_envs, *envs.single_action_space.shape)).astype(np.float32)
        else:
            actions = (random.random(played.shape) * played).argmax(axis=1)
            actions[random.random(case.num_envs) < 0.5] = 0
        steps.append(_copied((*envs.step(actions), masks())))
    envs.close()
    return steps


def _copied(step: Any) -> Shown:
    observations, rewards, terminated, truncated, infos, masks = step
    return (
        observations.copy(),
        rewards.copy(),
        terminated.copy(),
        truncated.copy(),
        _read(infos),
        None if masks is None else masks.copy(),
    )


def _read(infos: Mapping[str, Any]) -> dict[str, Any]:
    """Copies of what learners read; what is in groups, all of it."""
    found: dict[str, Any] = {}
    for key in infos:
        if key.removeprefix("_") not in READ:
            continue
        value = infos[key]
        found[key] = _read_all(value) if isinstance(value, Mapping) else np.array(value)
    return found


def _read_all(group: Mapping[str, Any]) -> dict[str, Any]:
    nested = any(key in READ and isinstance(group[key], Mapping) for key in group)
    return _read(group) if nested else {key: np.array(group[key]) for key in group}


class Recorded(VectorWrapper[Any, Any, Any, Any, Any]):
    """An environment that shows what was recorded, again and again, whatever is played."""

    def __init__(self, envs: VectorEnv[Any, Any, Any], steps: list[Shown]) -> None:
        super().__init__(envs)
        self._steps, self._now = steps, 0

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """The first of what was recorded."""
        self._now = 0
        return self._steps[0][0], self._steps[0][4]

    def step(self, actions: Any) -> Any:
        """The next of what was recorded."""
        self._now = self._now % RECORDED + 1
        return self._steps[self._now][:5]

    def action_masks(self) -> Any:
        """As recorded there."""
        return self._steps[self._now][5]


# --- One process ----------------------------------------------------------------------------------------------------


def serve(folder: Path) -> None:
    """Measure what the lines of standard input name, with the sources that are imported here."""
    trainers: dict[str, Any] = {}
    cases = {case.name: case for case in CASES}
    for line in sys.stdin:
        request = json.loads(line)
        case = cases[request["case"]]
        if case.name not in trainers:
            trainers[case.name] = _warm_trainer(case, folder)
        print(json.dumps(_measured(trainers[case.name], request["seconds"])), flush=True)


def _warm_trainer(case: Case, folder: Path) -> Any:
    args = args_of(case)
    steps = pickle.loads((folder / f"{case.task}-{case.num_envs}.pickle").read_bytes())
    trainer = find_algorithm(case.algorithm).trainer(args.hyperparameters, Recorded(make_envs(args), steps))
    trainer.iterate()
    while trainer.decisions <= getattr(args.hyperparameters, "learning_starts", 0):
        trainer.iterate()
    return trainer


def _measured(trainer: Any, seconds: float) -> dict[str, float]:
    """Microseconds of processor time per decision, over so many seconds."""
    decisions, began, epochs = trainer.decisions, time.process_time(), []
    while time.process_time() - began < seconds:
        metrics = trainer.iterate()
        epochs.append(metrics.get("charts/update_epochs", 0.0))
    spent = time.process_time() - began
    return {"us": 1e6 * spent / (trainer.decisions - decisions), "epochs": statistics.fmean(epochs)}


# --- Two of them ----------------------------------------------------------------------------------------------------


class Process:
    """A process with certain sources."""

    def __init__(self, sources: Path, folder: Path) -> None:
        environment = os.environ | {"PYTHONPATH": str(sources / "src"), "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )

    def measure(self, case: Case, seconds: float) -> dict[str, float]:
        """See :func:`_measured`."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps({"case": case.name, "seconds": seconds}) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError(f"the process that was to measure {case.name} ended")
        measured: dict[str, float] = json.loads(answer)
        return measured

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


@contextmanager
def checkout(revision: str, folder: Path) -> Iterator[Path]:
    """A worktree of a revision."""
    git = ["git", "-C", str(ROOT), "worktree"]
    subprocess.run([*git, "add", "--quiet", "--detach", str(folder), revision], check=True)
    try:
        yield folder
    finally:
        subprocess.run([*git, "remove", "--force", str(folder)], check=True)


def compare(before: Process, now: Process, case: Case, rounds: int, seconds: float) -> dict[str, Any]:
    """Medians of both, which take turns."""
    pairs = [(before.measure(case, seconds), now.measure(case, seconds)) for _ in range(rounds)]
    was, is_ = ([one[k]["us"] for one in pairs] for k in (0, 1))
    result: dict[str, Any] = {
        "before_us_per_decision": round(statistics.median(was), 1),
        "now_us_per_decision": round(statistics.median(is_), 1),
        "ratio": round(statistics.median(a / b for a, b in zip(was, is_, strict=True)), 2),
    }
    if any(one["epochs"] for pair in pairs for one in pair):
        for k, name in ((0, "before_epochs"), (1, "now_epochs")):
            result[name] = round(statistics.fmean(pair[k]["epochs"] for pair in pairs), 1)
    return result


def main() -> None:
    """Measure both, and write what came out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", help="a git revision")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="processor time of one measurement")
    parser.add_argument("--cases", default="", help="only those whose name contains this")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        serve(arguments.serve)
        return
    chosen = [case for case in CASES if arguments.cases in case.name]
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root)
        for case in chosen:
            path = folder / f"{case.task}-{case.num_envs}.pickle"
            if not path.exists():
                path.write_bytes(pickle.dumps(record(case)))
        with checkout(arguments.before, folder / "before") as earlier:
            results: dict[str, Any] = {"before": _commit(earlier), "now": _commit(ROOT), "rounds": arguments.rounds}
            before, now = Process(earlier, folder), Process(ROOT, folder)
            for case in chosen:
                results[case.name] = compare(before, now, case, arguments.rounds, arguments.seconds)
                print(case.name, results[case.name], flush=True)
            before.close()
            now.close()
    arguments.results.write_text(json.dumps(results, indent=1) + "\n")


def _commit(checkout: Path) -> str:
    command = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    main()
