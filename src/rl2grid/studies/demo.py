"""The demonstration: train, evaluate beside simple agents, and write a report, in a few minutes.

Everything is written below one folder. The demonstration may be interrupted and started again: a
training goes on from its checkpoint, an evaluation with the episodes that are missing.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import gymnasium
from rich.console import Console

from rl2grid.analysis.demo_report import write_demo_report
from rl2grid.envs.registration import register_all
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.flags import evaluate_command, flags
from rl2grid.evaluation.protocol import evaluate
from rl2grid.evaluation.recording import record_episode
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.files import make_own_folder
from rl2grid.records.recordings import Recording
from rl2grid.records.trainings import read_training_curve
from rl2grid.records.versions import library_versions, processor
from rl2grid.scenarios.library import list_scenarios
from rl2grid.training import request, runs
from rl2grid.training.validation import validator

TASK = "rl2grid/bus14-T0-v0"
HEURISTIC = "idle"
ALGORITHM, NAME = "dqn", "DQN"
DECISIONS = 49_152
"""A minute on two cores, after which three seeds survived 0.87 to 0.90 of 100 months of validation."""
NUM_ENVS = 64
"""Enough to keep the cores busy while some environments play hours of calm between two decisions."""
MONTHS = 100
"""Of the 500 test months: what a minute makes and plays."""
PUBLISHED = "demo.json"
"""Figures of the README, written by ``benchmarks/demonstration.py``."""
SEEDS = (0,)
"""Of maintenance and of the random agent: episodes per test month."""


@dataclass(frozen=True)
class Demonstration:
    """What the demonstration made."""

    report: Path
    evaluations: tuple[Evaluation, ...]


def run_demo(output: Path, decisions: int | None = None, *, progress: bool = True) -> Demonstration:
    """Train DQN with the idle heuristic on bus14, evaluate it on held-out months, write a report.

    Args:
        output: folder of the report, ``report.html`` in it; ``output / "run"`` holds the training.
        decisions: how long to train.
        progress: whether to show how far it is, on standard error.

    Raises:
        UsageError: ``decisions`` is too small, or ``output`` holds a training of another length.
    """
    make_own_folder(output, ("run", "report.html"), "demonstration")
    console = Console(stderr=True, quiet=not progress)
    register_all()
    console.rule(f"1/4 Training {NAME} with the idle heuristic on bus14", align="left")
    console.print("Whenever a line is loaded to 95%, the agent chooses one of 50 topology actions.")
    run = _train(output / "run", DECISIONS if decisions is None else decisions, progress)
    if not runs.is_finished(run):
        raise KeyboardInterrupt

    console.rule(f"2/4 Playing {MONTHS} months that no agent has seen", align="left")
    results = [_evaluate(agent, heuristic, output, progress) for agent, heuristic in _contestants(run)]

    console.rule("3/4 Recording one episode", align="left")
    recording = _record(run)

    console.rule("4/4 Writing the report", align="left")
    report = write_demo_report(
        output,
        results,
        title=f"{NAME} on bus14",
        introduction=(
            "An agent that acts only when a line is loaded to 95%, trained for a minute, beside doing nothing and "
            f"acting at random, on {MONTHS} months that none of them has seen."
        ),
        curves=[read_training_curve(run, f"{NAME} with the idle heuristic")],
        recordings=[recording],
        commands=dict.fromkeys(("training", "episodes"), demo_command(output, decisions)),
    )
    return Demonstration(report, tuple(results))


def demo_command(output: Path, decisions: int | None) -> str:
    """What to type for :func:`run_demo` to be called like that."""
    length = {} if decisions is None else {"decisions": decisions}
    return shlex.join(["rl2grid", "demo", *flags({**length, "output": output})])


def published() -> dict[str, Any]:
    """The figures of the README: ``processor`` and ``versions`` that they hold on, ``survival`` by agent."""
    text = resources.files("rl2grid.studies").joinpath(PUBLISHED).read_text(encoding="utf-8")
    return dict(json.loads(text))


def figures(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """What :func:`published` holds, of a demonstration that was made here."""
    survival = {each.summary.agent: each.summary.survival.value for each in evaluations}
    return {"processor": processor(), "versions": library_versions(), "survival": survival}


def what_differs(here: Mapping[str, Any], there: Mapping[str, Any]) -> str:
    """How a demonstration compares with the published one, in a sentence or two."""
    kinds = {"processor": there["processor"], **there["versions"]}
    mine = {"processor": here["processor"], **here["versions"]}
    other = [
        f"{name} {kinds[name]} there, {mine.get(name, 'none')} here" for name in kinds if kinds[name] != mine.get(name)
    ]
    changed = [
        f"{agent} {there['survival'][agent]:.3f} there, {value:.3f} here"
        for agent, value in here["survival"].items()
        if value != there["survival"].get(agent)
    ]
    if not changed:
        return f"The same survival as in the README, to the last bit (made on {there['processor']})."
    reasons = f"What else differs: {'; '.join(other)}." if other else "Processor and versions are the same."
    return f"Other survival than in the README: {'; '.join(changed)}. {reasons}"


def _contestants(run: Path) -> list[tuple[str, str | None]]:
    return [("do-nothing", None), ("random", HEURISTIC), (str(run), HEURISTIC)]


def _train(folder: Path, decisions: int, progress: bool) -> Path:
    """Begin the run, or go on with it; a complete run is left as it is."""
    hyperparameters = request.hyperparameters(ALGORITHM, TASK, total_timesteps=decisions, num_envs=NUM_ENVS)
    if folder.exists():
        stored, _ = request.read_config(folder)
        if stored.hyperparameters != hyperparameters:
            raise UsageError(f"{folder} holds another training: remove it, or choose another folder with --output.")
        return runs.resume(folder, evaluate=validator(stored))
    args = request.RunArgs(
        task=find_task(TASK),
        hyperparameters=hyperparameters,
        algorithm=ALGORITHM,
        folder=folder,
        env_keywords={"heuristic": HEURISTIC},
        evaluate_every=max(decisions // 8, 1),
        progress=progress,
    )
    return runs.train(args, evaluate=validator(args))


def _evaluate(agent: str, heuristic: str | None, output: Path, progress: bool) -> Evaluation:
    name = agent if agent in ("do-nothing", "random") else NAME
    return evaluate(
        agent,
        TASK,
        split="test",
        scenarios=list_scenarios("bus14", "test")[:MONTHS],
        seeds=SEEDS,
        heuristic=heuristic,
        output=output / "evaluation" / name,
        progress=progress,
        name=name,
        command=evaluate_command(agent, find_task(TASK), "test", len(SEEDS), MONTHS, {"heuristic": heuristic}),
    )


def _record(run: Path) -> Recording:
    scenario = list_scenarios("bus14", "test")[MONTHS - 1]
    env = gymnasium.make(TASK, split="test", heuristic=HEURISTIC, disable_env_checker=True)
    try:
        agent = make_agent(run, find_task(TASK))
        agent.bind(env)
        return record_episode(agent, env, scenario=scenario)
    finally:
        env.close()
