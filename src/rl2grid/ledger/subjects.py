"""What may play the test months once, and what it says of itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rl2grid.envs.tasks import Task, find_task, short_id
from rl2grid.errors import UsageError
from rl2grid.evaluation.protocol import AS_TRAINED, evaluate, first_months
from rl2grid.records.collection import was_evaluated
from rl2grid.records.evaluations import Evaluation, identity_hash
from rl2grid.records.ledger import HashedTest, choice_hash, hashed_test
from rl2grid.records.looks import LOOKS, earlier_choices, looks
from rl2grid.records.metrics import read_validations, trained_seconds
from rl2grid.records.trainings import read_training_run
from rl2grid.scenarios.library import split_version
from rl2grid.scenarios.splits import TEST


@dataclass(frozen=True)
class Subject:
    """A run with its best and last policies, or an agent without training."""

    configuration: Mapping[str, Any]
    agent: str | Path
    task: Task
    heuristic: str | None
    training: Mapping[str, Any]
    """How it came to be: command, decisions, minutes; empty without training."""
    last: Path | None = None
    """The checkpoint of the last policy; None where that is the best one, or nothing was trained."""

    @property
    def digest(self) -> str:
        """Hash of the frozen configuration."""
        return identity_hash(self.configuration)

    @property
    def choice(self) -> str:
        """Hash of what was chosen: all but the seed."""
        return choice_hash(self.configuration)

    @property
    def method(self) -> tuple[Any, ...]:
        """What other configurations of it have in common, see :func:`rl2grid.records.looks.earlier_choices`."""
        name = self.configuration.get("algorithm") or self.configuration["agent"]
        return self.task.id, name, self.heuristic, self.configuration["test"]["split_version"]

    def __str__(self) -> str:
        """What messages call it."""
        return f"{self.agent} on {short_id(self.task.id)}, heuristic {self.heuristic}"


def find_subject(text: str, months: int | None = None) -> Subject:
    """What the command line names: a run folder, or an agent as ``greedy@bus14-T0`` or ``random@bus14-T0:idle``.

    Args:
        text: the name.
        months: how many of the test months it plays, the first of the list; None: all.

    Raises:
        UsageError: a run that is not finished or was never validated, or no such agent, task or run.
    """
    if "@" in text:
        agent, _, rest = text.partition("@")
        task, _, heuristic = rest.partition(":")
        return _untrained(agent, find_task(task), heuristic or None, months)
    return _trained(Path(text), months)


def count_look(subject: Subject, results: Mapping[str, HashedTest]) -> str:
    """What the test of a subject would be: which look at its months, and after which others.

    Args:
        subject: not tested yet.
        results: of the ledger.

    Returns:
        One or two sentences.

    Raises:
        UsageError: the months are used up.
    """
    version = subject.configuration["test"]["split_version"]
    done = looks(results, subject.task.grid_id, version)
    months = f"the test months of {subject.task.grid_id}{f', version {version}' if version else ''}"
    if subject.choice in done:
        return f"A further seed of look {done.index(subject.choice) + 1} of {LOOKS} at {months}."
    if len(done) >= LOOKS:
        raise UsageError(
            f"{months[0].upper()}{months[1:]} are used up: {LOOKS} configurations had their test on them. Compare on "
            "validation months, until there is another list."
        )
    seen = earlier_choices(results, subject.method, subject.choice)
    after = f" It is marked as entered after {len(seen)} other configurations of its method." if seen else ""
    return f"Look {len(done) + 1} of {LOOKS} at {months}.{after}"


def play_test(subject: Subject, progress: bool = True) -> HashedTest:
    """Play the test months, with a bar or without; what the ledger keeps of it."""
    best = _play(subject, subject.agent, progress)
    last = None if subject.last is None else _play(subject, subject.last, progress)
    return hashed_test(subject.configuration, subject.training, best, last)


def _play(subject: Subject, agent: str | Path, progress: bool) -> Evaluation:
    return evaluate(
        agent,
        subject.task,
        split=TEST,
        scenarios=first_months(subject.task, TEST, subject.configuration["test"]["months"]),
        heuristic=AS_TRAINED if subject.training else subject.heuristic,
        progress=progress,
    )


def _test_of(task: Task, months: int | None) -> dict[str, Any]:
    """Which months a configuration is tested on: on others, it is another one."""
    number = len(first_months(task, TEST, months))
    return {"split_version": split_version(task.grid_id, TEST), "months": number}


def _frozen(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """The keywords of a training; ``episode_length`` only where it was given: others are called as they were before."""
    return {name: value for name, value in keywords.items() if name != "episode_length" or value is not None}


def _untrained(agent: str, task: Task, heuristic: str | None, months: int | None) -> Subject:
    configuration = {"agent": agent, "task": task.id, "heuristic": heuristic, "test": _test_of(task, months)}
    return Subject(configuration, agent, task, heuristic, {})


def _trained(folder: Path, months: int | None) -> Subject:
    # Imported here: agents without training do without torch.
    from rl2grid.algorithms.hyperparameters import identifying
    from rl2grid.algorithms.policy_agent import CHECKPOINT_FILE, load_agent
    from rl2grid.training.commands import train_command
    from rl2grid.training.request import read_config
    from rl2grid.training.runs import is_finished

    args, identity = read_config(folder)
    if not is_finished(folder):
        raise UsageError(f"The run in {str(folder)!r} is not finished: resume it before its test.")
    configuration = {
        "algorithm": args.algorithm,
        "task": args.task.id,
        "hyperparameters": identifying(args.hyperparameters),
        "env_keywords": _frozen(args.env_keywords),
        "targets_version": identity.get("targets_version", 1),
        "test": _test_of(args.task, months),
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
        "validations": len(reached),
        "validation_months": args.validation_months,
        "grid_steps": int(survival.grid_steps[-1]),
        "minutes": round(trained_seconds(folder) / 60, 1),
        "best_after": policy.identity["decisions"],
        "validation_survival": reached[policy.identity["decisions"]]["survival"],
        "policy_hash": policy.identity["policy_hash"],
        "tested_before": was_evaluated(folder, TEST),
        "identity": dict(identity),
    }
    last = None if training["best_after"] == training["decisions"] else folder / CHECKPOINT_FILE
    return Subject(configuration, folder, args.task, args.env_keywords["heuristic"], training, last)
