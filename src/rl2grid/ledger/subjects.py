"""What may play the test months once, and what it says of itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rl2grid.agents.agent import RevisedAgent
from rl2grid.agents.foresight import Foresight
from rl2grid.algorithms.pretrained import is_pretrained, pretrained
from rl2grid.engines import INJECTION_RULES
from rl2grid.envs.tasks import Task, find_task, short_id
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.flags import LOOKING
from rl2grid.evaluation.protocol import AS_TRAINED, check_playable, evaluate, first_months
from rl2grid.records.collection import was_evaluated
from rl2grid.records.evaluations import Evaluation, identity_hash
from rl2grid.records.ledger import STARTED_FROM, HashedTest, agent_of, choice_hash, hashed_test, looking_of
from rl2grid.records.looks import LOOKS, earlier_choices, looks
from rl2grid.records.metrics import read_validations, trained_seconds
from rl2grid.records.trainings import read_training_run
from rl2grid.scenarios.library import split_version
from rl2grid.scenarios.splits import TEST

_OF_LABELS = ("teacher", "rounds", "months", "labels")


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
    def looking(self) -> dict[str, int]:
        """How a policy looks before it acts, as :func:`rl2grid.evaluation.agents.make_agent` takes it."""
        return {name: self.configuration[name] for name in LOOKING if name in self.configuration}

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
        return self.task.id, agent_of(self.configuration), self.heuristic, self.configuration["test"]["split_version"]

    def __str__(self) -> str:
        """What messages call it."""
        return f"{self.agent}{looking_of(self.configuration)} on {short_id(self.task.id)}, heuristic {self.heuristic}"


def find_subject(text: str, months: int | None = None, **looking: int) -> Subject:
    """What the command line names.

    Args:
        text: a run folder, a policy of the package as ``pretrained/bus14-T0``, or an agent as ``greedy@bus14-T0`` or
            ``random@bus14-T0:idle``.
        months: how many of the test months it plays, the first of the list; None: all.
        **looking: how a policy looks before it acts, of :data:`rl2grid.evaluation.flags.LOOKING`.

    Raises:
        UsageError: a run that is not finished or was never validated, no such agent, task, heuristic or run, an agent
            that cannot play the task or knows the future, or what is no policy and is to look.
    """
    if "@" in text:
        agent, _, rest = text.partition("@")
        task, _, heuristic = rest.partition(":")
        subject = _untrained(agent, find_task(task), heuristic or None, months)
    elif is_pretrained(text):
        subject = _of_the_package(text, months)
    else:
        subject = _trained(Path(text), months)
    if not looking:
        return subject
    make_agent(subject.agent, subject.task, **looking)  # refuses agents that are no policies
    return replace(subject, configuration={**subject.configuration, **looking})


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
    """Play the test months, with a bar or without; what the ledger keeps of it.

    Raises:
        UsageError: the agent knew the future.
    """
    best = _play(subject, subject.agent, progress)
    last = None if subject.last is None else _play(subject, subject.last, progress)
    return hashed_test(subject.configuration, subject.training, best, last)


def _play(subject: Subject, agent: str | Path, progress: bool) -> Evaluation:
    result = evaluate(
        make_agent(agent, subject.task, **subject.looking) if subject.looking else agent,
        subject.task,
        split=TEST,
        scenarios=first_months(subject.task, TEST, subject.configuration["test"]["months"]),
        heuristic=AS_TRAINED if subject.training else subject.heuristic,
        progress=progress,
    )
    if result.foresight:
        raise UsageError(f"{subject} stepped saved true worlds: who knows the future is not ranked, and has no test.")
    return result


def tested_months(task: Task, months: int | None) -> dict[str, Any]:
    """Which months a configuration is tested on: on others, it is another one."""
    number = len(first_months(task, TEST, months))
    return {"split_version": split_version(task.grid_id, TEST), "months": number}


def heuristic_rules(task: Task, heuristic: str | None) -> dict[str, int]:
    """An entry of a configuration: the version of a heuristic's rules; empty where it is the first."""
    if heuristic is None or not task.injects or heuristic not in INJECTION_RULES:
        return {}
    return {"heuristic_rules": INJECTION_RULES[heuristic]}


_LATER = ("episode_length", "operator_features")
"""Keywords that came after the first results."""


def _frozen(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """The keywords of a training; later ones only where they were given: others are called as they were before."""
    return {name: value for name, value in keywords.items() if name not in _LATER or value is not None}


def _learned_from(identity: Mapping[str, Any]) -> dict[str, Any]:
    """By content: which labels a training learned from, and which policy it began with; empty where there are none."""
    found: dict[str, Any] = {}
    if "labels" in identity:
        found["labels"] = {name: value for name, value in identity["labels"].items() if name in _OF_LABELS}
    if "start" in identity:
        found[STARTED_FROM] = {name: value for name, value in identity["start"].items() if name != "path"}
    return found


def _untrained(agent: str, task: Task, heuristic: str | None, months: int | None) -> Subject:
    made = make_agent(agent, task)
    if isinstance(made, Foresight):
        raise UsageError(f"Agent {agent!r} knows the future: it is not ranked, and has no test.")
    check_playable(made, task, {"split": TEST, "heuristic": heuristic})
    configuration: dict[str, Any] = {"agent": agent, "task": task.id, "heuristic": heuristic}
    configuration["test"] = tested_months(task, months)
    if isinstance(made, RevisedAgent) and task.kind in made.rules:
        configuration["rules"] = made.rules[task.kind]
    configuration |= heuristic_rules(task, heuristic)
    return Subject(configuration, agent, task, heuristic, {})


def _of_the_package(name: str, months: int | None) -> Subject:
    card = pretrained(name)
    task = find_task(card.task)
    configuration = {
        "agent": name,
        "policy_hash": card.policy_hash,
        "task": task.id,
        "heuristic": card.heuristic,
        "test": tested_months(task, months),
    }
    return Subject(configuration, name, task, card.heuristic, {})


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
        "test": tested_months(args.task, months),
        **_learned_from(identity),
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
