"""The ledger of test results: every frozen configuration plays the test months once.

``python benchmarks/baselines.py test SUBJECT ...`` plays the test months with each subject, a run folder (the best
policy by validation) or an agent without training as ``greedy@bus14-T0`` or ``random@bus14-T0:idle``, and enters the
result in ``benchmarks/results/baselines.json``. A configuration (task, algorithm, hyperparameters, seed, keywords of
the environment) that is in the ledger is not played again: what was chosen after looking at test results is no test.
``python benchmarks/baselines.py table`` prints the ledger as Markdown.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rl2grid.algorithms.policy_agent import load_agent
from rl2grid.analysis.results import EvaluationResult, identity_hash
from rl2grid.analysis.statistics import Estimate
from rl2grid.analysis.training import read_training_run, read_validations
from rl2grid.envs.tasks import find_task, short_id
from rl2grid.errors import UsageError
from rl2grid.experiments.commands import train_command
from rl2grid.experiments.evaluation import AS_TRAINED, evaluate
from rl2grid.experiments.runs import is_finished, read_config
from rl2grid.experiments.study_cell import trained_seconds

LEDGER = Path(__file__).resolve().parent / "results" / "baselines.json"


@dataclass(frozen=True)
class Subject:
    """Something that may play the test months once."""

    configuration: Mapping[str, Any]
    agent: str | Path
    task: str
    heuristic: str | None
    training: Mapping[str, Any]
    """How it came to be: command, decisions, minutes; empty without training."""

    @property
    def digest(self) -> str:
        """Hash of the frozen configuration."""
        return identity_hash(self.configuration)


def subject(text: str) -> Subject:
    """What the command line names.

    Raises:
        UsageError: a run that is not finished, or no such agent, task or run.
    """
    if "@" in text:
        agent, _, rest = text.partition("@")
        task, _, heuristic = rest.partition(":")
        return _untrained(agent, find_task(task).id, heuristic or None)
    return _trained(Path(text))


def _untrained(agent: str, task: str, heuristic: str | None) -> Subject:
    configuration = {"agent": agent, "task": task, "heuristic": heuristic}
    return Subject(configuration, agent, task, heuristic, {})


def _trained(folder: Path) -> Subject:
    args, identity = read_config(folder)
    if not is_finished(folder):
        raise UsageError(f"The run in {str(folder)!r} is not finished: resume it before its test.")
    configuration = {
        "algorithm": args.algorithm,
        "task": args.task,
        "hyperparameters": asdict(args.hyperparameters),
        "env_keywords": dict(args.env_keywords),
    }
    policy = load_agent(folder)
    reached = read_validations(folder)
    if not reached:
        raise UsageError(f"The run in {str(folder)!r} was never validated: only a best policy is tested.")
    survival = read_training_run(folder).curve.validation
    assert survival is not None
    training = {
        "command": train_command(args),
        "decisions": max(reached),
        "grid_steps": int(survival.grid_steps[-1]),
        "minutes": round(trained_seconds(folder) / 60, 1),
        "best_after": policy.identity["decisions"],
        "validation_survival": reached[policy.identity["decisions"]]["survival"],
        "policy_hash": policy.identity["policy_hash"],
        "identity": dict(identity),
    }
    return Subject(configuration, folder, args.task, args.env_keywords["heuristic"], training)


def test(chosen: Subject) -> dict[str, Any]:
    """Play the test months once; what the ledger keeps."""
    result = evaluate(
        chosen.agent,
        chosen.task,
        split="test",
        heuristic=chosen.heuristic if chosen.training == {} else AS_TRAINED,
        workers=0,
        progress=True,
    )
    return {
        "configuration": dict(chosen.configuration),
        "training": dict(chosen.training),
        "identity_hash": identity_hash(result.identity),
        "episodes_hash": identity_hash({"rows": _rows(result)}),
        "test": _figures(result),
    }


def _rows(result: EvaluationResult) -> list[list[Any]]:
    """What must be equal wherever the episodes are played."""
    return [[row.scenario, row.seed, row.grid_steps, row.decisions, row.episode_return] for row in result.episodes]


def _figures(result: EvaluationResult) -> dict[str, Any]:
    summary = result.summary
    names = ("survival", "completed", "cost_lsi", "cost_tlo", "safe_lsi", "safe_tlo", "decisions")
    return {"episodes": summary.episodes, **{name: _interval(getattr(summary, name)) for name in names}}


def _interval(estimate: Estimate) -> list[float]:
    return [round(float(value), 4) for value in (estimate.value, estimate.low, estimate.high)]


def read_ledger() -> dict[str, Any]:
    """Entries by the hash of their configuration."""
    entries: dict[str, Any] = json.loads(LEDGER.read_text(encoding="utf-8")) if LEDGER.exists() else {}
    return entries


def enter(digest: str, entry: Mapping[str, Any]) -> None:
    """Add an entry."""
    entries = {**read_ledger(), digest: dict(entry)}
    temporary = LEDGER.with_suffix(".tmp")
    temporary.write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, LEDGER)


def table() -> str:
    """The ledger as Markdown: tasks in order, trained agents by validation survival."""
    lines = [
        "| task | agent | heuristic | seed | decisions (grid steps) | minutes | validation | test survival | completed "
        "| cost TLO | P(TLO safe) | P(LSI safe) |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for entry in sorted(read_ledger().values(), key=_place):
        lines.append("| " + " | ".join(_cells(entry)) + " |")
    return "\n".join(lines)


def _place(entry: Mapping[str, Any]) -> tuple[Any, ...]:
    configuration = entry["configuration"]
    trained = "algorithm" in configuration
    name = configuration["algorithm"] if trained else configuration["agent"]
    return configuration["task"], trained, name, str(_heuristic(configuration)), _seed(configuration)


def _cells(entry: Mapping[str, Any]) -> list[str]:
    configuration, training, figures = entry["configuration"], entry["training"], entry["test"]
    survival, low, high = figures["survival"]
    cells = [
        short_id(configuration["task"]),
        configuration.get("algorithm") or configuration["agent"],
        _heuristic(configuration) or "none",
        _seed(configuration),
    ]
    if training:
        cells += [
            f"{training['decisions']:,} ({training['grid_steps'] / 1e6:.1f} M)",
            f"{training['minutes']:.0f}",
            f"{training['validation_survival']:.3f}",
        ]
    else:
        cells += ["", "", ""]
    cells += [f"{survival:.3f} [{low:.3f}, {high:.3f}]", f"{figures['completed'][0]:.0%}"]
    cells += [f"{figures['cost_tlo'][0]:.0f}", f"{figures['safe_tlo'][0]:.0%}", f"{figures['safe_lsi'][0]:.0%}"]
    return cells


def _heuristic(configuration: Mapping[str, Any]) -> str | None:
    keywords = configuration.get("env_keywords", configuration)
    chosen: str | None = keywords["heuristic"]
    return chosen


def _seed(configuration: Mapping[str, Any]) -> str:
    return str(configuration["hyperparameters"]["seed"]) if "hyperparameters" in configuration else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=("test", "table"))
    parser.add_argument("subjects", nargs="*")
    arguments = parser.parse_args()
    if arguments.command == "table":
        print(table())
        return
    for chosen in [subject(text) for text in arguments.subjects]:
        if chosen.digest in read_ledger():
            print(f"{chosen.agent} on {chosen.task} has had its test: see {LEDGER.name}.")
            continue
        enter(chosen.digest, test(chosen))


if __name__ == "__main__":
    main()
