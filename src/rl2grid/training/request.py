"""The request for a training: what is to be trained, on what and where, checked, and as a run folder stores it.

How it is met is the part of :mod:`rl2grid.training.runs`, which imports this module and not the other way round.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from rl2grid.algorithms.registry import Algorithm, Hyperparameters, algorithms_for, find_algorithm
from rl2grid.envs.options import TaskOptions, options_of
from rl2grid.envs.tasks import Task, constraint_of, find_task
from rl2grid.errors import UsageError, one_of
from rl2grid.evaluation.protocol import first_months
from rl2grid.mdp.actions import action_set_hash
from rl2grid.mdp.constraint_table import CONSTRAINTS, THRESHOLDS
from rl2grid.mdp.rewards import resolve_reward
from rl2grid.records.trainings import RUN_FILE, is_run, read_configuration
from rl2grid.records.versions import TARGETS_VERSION, library_versions
from rl2grid.scenarios.library import check_in_split, generator_version, scenario_pack_hash, split_version
from rl2grid.scenarios.splits import TRAIN, VALIDATION, VALIDATION_MONTHS
from rl2grid.training.tracking import check_tracking

DECIDING = ("network", "joint_actions")
"""Hyperparameters by which a preset has other values of others."""
_ACTIONS = {"T": "discrete", "R": "continuous"}


@dataclass(frozen=True)
class RunArgs:
    """What is to be trained, on what, and where."""

    task: Task
    """May be given by its id, such as ``rl2grid/bus14-T0-v0``, whose namespace and version may be left out."""
    hyperparameters: Hyperparameters
    """Of the algorithm, the seed and the budget among them; see :func:`hyperparameters`."""
    algorithm: str = "ppo"
    """Name of the algorithm."""
    folder: Path | None = None
    """Where the run is written, a folder that does not exist yet; None: ``runs/<task>-<algorithm>-<seed>``."""
    env_keywords: Mapping[str, Any] = field(default_factory=dict)
    """Keywords of ``gymnasium.make_vec`` (``heuristic``, ``reward``, ...); ``gamma`` is the algorithm's."""
    num_threads: int | None = None
    """Native engine: threads that play the environments; None: one per processor core. No influence on results."""
    num_workers: int | None = None
    """Reference engine: processes that play them; None: one per core, 0: this one. No influence on results."""
    checkpoint_seconds: float = 60.0
    """A checkpoint is written when the last one is older than this, and at the end."""
    evaluate_every: int = 50_000
    """Decisions between two evaluations on the validation scenarios; there is one more at the end."""
    validation_months: int | None = VALIDATION_MONTHS
    """How many of the validation scenarios are played; None: all; 0: none, so that there is no ``best.pt``."""
    tensorboard: bool = True
    """Whether to write TensorBoard events beside ``metrics.csv``."""
    wandb_project: str | None = None
    """Project of Weights & Biases that gets the metrics; None: they stay here."""
    progress: bool = True
    """Whether to show a progress bar."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "task", find_task(self.task))


def hyperparameters(algorithm: str, task: Task | str, preset: str = "default", **changes: Any) -> Hyperparameters:
    """A preset of an algorithm for a task, some values changed.

    Raises:
        UsageError: no such algorithm, task, preset or hyperparameter, or an algorithm that cannot learn the task.
    """
    task = find_task(task)
    chosen = _checked_algorithm(algorithm, task)
    known = [parameter.name for parameter in fields(chosen.args)]
    for name in changes:
        if name not in known:
            raise one_of(f"Hyperparameter of {algorithm}", name, known)
    if "network" in changes and not _reads_normalized(changes["network"]):
        changes = {"normalize_observations": False} | changes
    continuous = chosen.plays_continuous(task.kind, changes.get("joint_actions"))
    resolved: Hyperparameters = chosen.preset(preset, continuous=continuous, **changes)
    return resolved


def _reads_normalized(network: str) -> bool:
    # Imported here: to look at a run without playing it takes no PyTorch.
    from rl2grid.algorithms.networks import find_network

    return find_network(network).reads_normalized


def find_limits(args: RunArgs) -> dict[str, float]:
    """What the costs of a safe episode may reach, by constraint; empty without a constraint.

    The constraint is the task's, or that of the keyword ``constraint``; an algorithm may have others of its own.

    Raises:
        UsageError: Lagrangian PPO without a constraint, or with one whose costs the environments do not report, or a
            keyword that contradicts the task's id.
    """
    constraint = constraint_of(args.task, args.env_keywords.get("constraint"))
    algorithm = find_algorithm(args.algorithm)
    if algorithm.find_limits is not None:
        limits = algorithm.find_limits(args.hyperparameters, constraint)
        for name in limits:
            if name not in CONSTRAINTS:
                raise one_of("Constraint", name, tuple(CONSTRAINTS))
        return limits
    return {constraint: THRESHOLDS[constraint]} if constraint else {}


def find_folder(args: RunArgs) -> Path:
    """Where a run is written."""
    task = args.task.id.removeprefix("rl2grid/")
    return Path(args.folder or Path("runs") / f"{task}-{args.algorithm}-{args.hyperparameters.seed}")


def complete(args: RunArgs) -> RunArgs:
    """The same request, checked, with everything filled in that a default decides: its folder and all keywords.

    Raises:
        UsageError: the request cannot be met.
    """
    task = args.task
    _checked_algorithm(args.algorithm, task)
    keywords = dict(args.env_keywords)
    if "gamma" in keywords:
        raise UsageError("gamma belongs to the algorithm's hyperparameters, not to the environment's keywords.")
    allowed = [option.name for option in fields(TaskOptions) if option.name != "gamma"]
    for name in keywords:
        if name not in allowed:
            raise one_of("Environment keyword", name, allowed)
    if callable(keywords.get("reward")):
        raise UsageError("A run stores its reward by name: choose a preset or three weights, not a function.")
    options_of(task, keywords)
    resolve_reward(keywords.get("reward", "default"))
    # Every keyword is stored, so that the run stays what it is when a default changes.
    keywords = {name: getattr(TaskOptions(**keywords), name) for name in allowed}
    if keywords["split"] != TRAIN:
        raise UsageError(f"Training on the {keywords['split']} scenarios is refused: choose split {TRAIN!r}.")
    if keywords["scenario"] is not None:
        check_in_split(task.grid_id, TRAIN, keywords["scenario"])
    if args.evaluate_every < 1:
        raise UsageError(f"evaluate_every must be at least 1 decision, not {args.evaluate_every}.")
    months = args.validation_months
    if months is not None and not 0 <= months <= VALIDATION_MONTHS:  # the usual number is an upper limit
        first_months(task, VALIDATION, months)
    check_tracking(args.wandb_project)
    resolved = replace(args, folder=find_folder(args), env_keywords=keywords)
    find_limits(resolved)  # refuses what cannot be constrained
    return resolved


def identity_of(args: RunArgs) -> dict[str, Any]:
    """What results of this run must name (the normaliser's hash changes with training: checkpoints know it)."""
    task = args.task
    return {
        "task": task.id,
        "engine": args.env_keywords["engine"],
        "grid_hash": task.grid.hash,
        "generator_version": generator_version(task.grid_id, args.env_keywords["split"]),
        "scenario_pack_hash": scenario_pack_hash(task.grid_id, args.env_keywords["split"]),
        "action_set_hash": action_set_hash(task.grid, task.level) if task.changes_topology else None,
        # Of the list by which the best policy is picked.
        "split_version": split_version(task.grid_id, VALIDATION),
        "targets_version": TARGETS_VERSION,
        "budget": {
            "decisions": args.hyperparameters.total_timesteps,
            "evaluate_every": args.evaluate_every,
            "validation_months": args.validation_months,
        },
        "versions": library_versions(),
        "seed": args.hyperparameters.seed,
    }


def configuration_of(args: RunArgs, identity: Mapping[str, Any]) -> dict[str, Any]:
    """What a run folder says of its run, of which :func:`read_config` makes the request again."""
    seeds = {
        "algorithm": args.hyperparameters.seed,
        "first_environment": args.hyperparameters.seed * args.hyperparameters.num_envs,
    }
    return {"request": stored_request(args), "identity": dict(identity), "seeds": seeds}


def stored_request(args: RunArgs) -> dict[str, Any]:
    """The request as it is stored: wherever the folder is, it is the same run."""
    request = asdict(args)
    del request["folder"]
    return request | {"task": args.task.id}


def read_config(folder: Path) -> tuple[RunArgs, dict[str, Any]]:
    """The request and the identity stored in a run folder.

    Raises:
        UsageError: the folder holds no run.
    """
    if not is_run(folder):
        raise UsageError(
            f"{str(folder)!r} holds no run: there is no {RUN_FILE} in it; give a folder that 'rl2grid train' wrote."
        )
    config = read_configuration(folder)
    request = dict(config["request"])
    try:
        algorithm = find_algorithm(request["algorithm"])
        request["hyperparameters"] = algorithm.args(**_tuples(request["hyperparameters"]))
        request["env_keywords"] = _tuples(request["env_keywords"])
        TaskOptions(**request["env_keywords"])
        return RunArgs(**request, folder=folder), config["identity"]
    except TypeError as error:
        raise UsageError(
            f"File {str(folder / RUN_FILE)!r} does not describe a run of this version of rl2grid ({error})."
        ) from error


def _checked_algorithm(name: str, task: Task) -> Algorithm:
    algorithm = find_algorithm(name)
    if not algorithm.learns(task.kind):
        able = algorithms_for(task.kind)
        raise UsageError(
            f"Algorithm {name!r} cannot learn {task.id}, which has {_ACTIONS[task.kind]} actions: "
            f"choose one of {', '.join(able)}."
        )
    return algorithm


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values read from JSON, where tuples are stored as lists."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
