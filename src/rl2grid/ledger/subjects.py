"""What may play the test months once, and what it says of itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rl2grid.envs.tasks import Task, find_task, short_id
from rl2grid.errors import UsageError
from rl2grid.evaluation.protocol import AS_TRAINED, evaluate
from rl2grid.records.evaluations import identity_hash
from rl2grid.records.ledger import HashedTest, hashed_test
from rl2grid.records.metrics import read_validations, trained_seconds
from rl2grid.records.trainings import read_training_run


@dataclass(frozen=True)
class Subject:
    """A run with its best policy, or an agent without training."""

    configuration: Mapping[str, Any]
    agent: str | Path
    task: Task
    heuristic: str | None
    training: Mapping[str, Any]
    """How it came to be: command, decisions, minutes; empty without training."""

    @property
    def digest(self) -> str:
        """Hash of the frozen configuration."""
        return identity_hash(self.configuration)

    def __str__(self) -> str:
        """What messages call it."""
        return f"{self.agent} on {short_id(self.task.id)}, heuristic {self.heuristic}"


def find_subject(text: str) -> Subject:
    """What the command line names: a run folder, or an agent as ``greedy@bus14-T0`` or ``random@bus14-T0:idle``.

    Raises:
        UsageError: a run that is not finished or was never validated, or no such agent, task or run.
    """
    if "@" in text:
        agent, _, rest = text.partition("@")
        task, _, heuristic = rest.partition(":")
        return _untrained(agent, find_task(task), heuristic or None)
    return _trained(Path(text))


def play_test(subject: Subject) -> HashedTest:
    """Play the test months; what the ledger keeps of it."""
    evaluation = evaluate(
        subject.agent,
        subject.task,
        split="test",
        heuristic=AS_TRAINED if subject.training else subject.heuristic,
        workers=0,
        progress=True,
    )
    return hashed_test(subject.configuration, subject.training, evaluation)


def _untrained(agent: str, task: Task, heuristic: str | None) -> Subject:
    configuration = {"agent": agent, "task": task.id, "heuristic": heuristic}
    return Subject(configuration, agent, task, heuristic, {})


def _trained(folder: Path) -> Subject:
    # Imported here: agents without training do without torch.
    from rl2grid.algorithms.hyperparameters import identifying
    from rl2grid.algorithms.policy_agent import load_agent
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
