"""The ledger of test results: every frozen configuration plays the test months once.

``python benchmarks/baselines.py test SUBJECT ...`` plays the test months with each subject, a run folder (the best
policy by validation) or an agent without training as ``greedy@bus14-T0`` or ``random@bus14-T0:idle``, and enters the
result in ``benchmarks/results/baselines.json``. A configuration (task, algorithm, hyperparameters, seed, keywords of
the environment) that is in the ledger is not played again: what was chosen after looking at test results is no test.
``python benchmarks/baselines.py verify SUBJECT ...`` plays them again and says whether policy and episodes are those of
the ledger, bit for bit; ``python benchmarks/baselines.py table`` prints the ledger as Markdown.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rl2grid.algorithms.hyperparameters import identifying
from rl2grid.algorithms.policy_agent import load_agent
from rl2grid.envs.tasks import find_task, short_id
from rl2grid.errors import UsageError
from rl2grid.evaluation.protocol import AS_TRAINED, evaluate
from rl2grid.records.evaluations import Evaluation, identity_hash
from rl2grid.records.files import write_json
from rl2grid.records.statistics import Estimate
from rl2grid.records.trainings import read_training_run, read_validations
from rl2grid.studies.cell import trained_seconds
from rl2grid.training.commands import train_command
from rl2grid.training.runs import is_finished, read_config

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
        "hyperparameters": identifying(args.hyperparameters),
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


def _rows(result: Evaluation) -> list[list[Any]]:
    """What must be equal wherever the episodes are played."""
    return [[row.scenario, row.seed, row.grid_steps, row.decisions, row.episode_return] for row in result.episodes]


def _figures(result: Evaluation) -> dict[str, Any]:
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
    write_json(LEDGER, {**read_ledger(), digest: dict(entry)}, indent=1)


def verify(chosen: Subject) -> list[str]:
    """Play the test months of an entry again; the names of what differs from the ledger.

    Raises:
        UsageError: the ledger has no such entry.
    """
    entry = read_ledger().get(chosen.digest)
    if entry is None:
        raise UsageError(f"The ledger has no test of {str(chosen.agent)!r} on {chosen.task} to compare with.")
    again = test(chosen)
    differing = [name for name in ("episodes_hash", "test") if again[name] != entry[name]]
    if chosen.training and chosen.training["policy_hash"] != entry["training"]["policy_hash"]:
        differing.append("policy_hash")
    return differing


def table() -> str:
    """The ledger as Markdown: a row per configuration, its seeds together; tasks in order, trained agents last."""
    lines = [
        "| task | agent | heuristic | decisions (grid steps) | minutes | validation | test survival | completed "
        "| cost TLO | P(TLO safe) | P(LSI safe) |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    entries = sorted(read_ledger().values(), key=_place)
    for _, group in itertools.groupby(entries, key=lambda entry: _place(entry)[:-1]):
        lines.append("| " + " | ".join(_cells(list(group))) + " |")
    return "\n".join(lines)


def _place(entry: Mapping[str, Any]) -> tuple[Any, ...]:
    """Where an entry stands; entries that differ in the last element alone are seeds of one configuration."""
    configuration = entry["configuration"]
    others = dict(configuration.get("hyperparameters", {}))
    seed = others.pop("seed", 0)
    name = configuration.get("algorithm") or configuration["agent"]
    what = identity_hash({**configuration, "hyperparameters": others})
    trained = "algorithm" in configuration
    return configuration["task"], trained, name, str(_heuristic(configuration)), what, seed


def _cells(group: Sequence[Mapping[str, Any]]) -> list[str]:
    configuration, training = group[0]["configuration"], [entry["training"] for entry in group]
    cells = [
        short_id(configuration["task"]),
        configuration.get("algorithm") or configuration["agent"],
        _heuristic(configuration) or "none",
    ]
    if training[0]:
        steps = sum(run["grid_steps"] for run in training) / len(group) / 1e6
        minutes, validation = ([run[name] for run in training] for name in ("minutes", "validation_survival"))
        cells += [f"{training[0]['decisions']:,} ({steps:.1f} M)", _seeds(minutes, ".0f"), _seeds(validation, ".3f")]
    else:
        cells += ["", "", ""]
    _, low, high = group[0]["test"]["survival"]
    survival = _seeds(_tested(group, "survival"), ".3f")
    cells.append(f"{survival} [{low:.3f}, {high:.3f}]" if len(group) == 1 else f"**{_mean(group):.3f}** of {survival}")
    cells += [_seeds(_tested(group, name), form) for name, form in _TESTED.items()]
    return cells


_TESTED = {"completed": ".0%", "cost_tlo": ".0f", "safe_tlo": ".0%", "safe_lsi": ".0%"}


def _tested(group: Sequence[Mapping[str, Any]], name: str) -> list[float]:
    return [entry["test"][name][0] for entry in group]


def _mean(group: Sequence[Mapping[str, Any]]) -> float:
    return sum(_tested(group, "survival")) / len(group)


def _seeds(values: Sequence[float], form: str) -> str:
    return ", ".join(format(value, form) for value in values)


def _heuristic(configuration: Mapping[str, Any]) -> str | None:
    keywords = configuration.get("env_keywords", configuration)
    chosen: str | None = keywords["heuristic"]
    return chosen


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=("test", "verify", "table"))
    parser.add_argument("subjects", nargs="*")
    arguments = parser.parse_args()
    if arguments.command == "table":
        print(table())
        return 0
    try:
        subjects = [subject(text) for text in arguments.subjects]
        return _verify_all(subjects) if arguments.command == "verify" else _test_all(subjects)
    except UsageError as error:
        parser.exit(2, f"{error}\n")


def _test_all(subjects: Sequence[Subject]) -> int:
    for chosen in subjects:
        if chosen.digest in read_ledger():
            print(f"{chosen.agent} on {chosen.task} has had its test: see {LEDGER.name}.")
            continue
        enter(chosen.digest, test(chosen))
    return 0


def _verify_all(subjects: Sequence[Subject]) -> int:
    found = []
    for chosen in subjects:
        found.append(verify(chosen))
        words = f"differs in {', '.join(found[-1])}" if found[-1] else "the same, bit for bit"
        print(f"{chosen.agent} on {short_id(chosen.task)}, heuristic {chosen.heuristic}: {words}.", flush=True)
    return 1 if any(found) else 0


if __name__ == "__main__":
    raise SystemExit(main())
