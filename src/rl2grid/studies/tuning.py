"""The file of a search for hyperparameters, a TOML file (see ``docs/studies.md``), checked before anything begins."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from rl2grid.algorithms.registry import Hyperparameters, algorithm_names, find_algorithm
from rl2grid.engines import HEURISTICS
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.mdp.rewards import PRESETS
from rl2grid.studies.study import NO_HEURISTIC
from rl2grid.studies.toml_file import as_table, check_kind, count, read_toml, refuse_unknown_keys, text, unknown
from rl2grid.training import request

TRANSITIONS = "num_envs * num_steps"
"""Name of a parameter that the paper searched in place of ``num_steps``."""
WEIGHTS = ("survive_weight", "overload_weight", "cost_weight")
"""The paper's alpha, beta and eta: weights of the default reward's components, searched beside the hyperparameters."""
WEIGHT_CHOICES: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {"survive_weight": (0.1, 0.5, 1.0), "overload_weight": (0.1, 0.5, 1.0), "cost_weight": (0.1, 0.25, 0.5)}
)
"""The paper's grid."""
_MEASURES = ("constraints", "thresholds")
"""Hyperparameters by which runs are scored."""
_COMBINATIONS = 1_000
"""Of other choices, beside which a choice is tried before it is refused."""
_KEYS = (
    "name",
    "output",
    "algorithm",
    "task",
    "heuristic",
    "preset",
    "seed",
    "seeds",
    "trials",
    "budget",
    "validations",
    "months",
    "hyperparameters",
    "space",
)


@dataclass(frozen=True)
class Tuning:
    """What is searched."""

    name: str
    output: Path
    algorithm: str
    task: Task
    heuristic: str | None
    preset: str
    seed: int
    """Of the search. One process at a time chooses the same configurations again, interrupted or not; with several,
    the choice depends as well on which trials have ended by then."""
    seeds: tuple[int, ...]
    """Of the trainings of each trial, whose mean counts: one training says little of a configuration."""
    trials: int
    budget: int
    """Decisions of a training."""
    validations: int
    """Validations of a training, after each of which it may be ended."""
    months: int | None
    """How many months of the validation split are played; None: all."""
    hyperparameters: Mapping[str, Any]
    """Changes of the preset that all trainings share; :data:`WEIGHTS` may be among them."""
    space: Mapping[str, Any]
    """By hyperparameter, or one of :data:`WEIGHTS`: a list of choices, or ``{"low": ..., "high": ..., "log": ...}``."""

    def environment(self, chosen: Mapping[str, Any]) -> dict[str, Any]:
        """Keywords of the environments of a trial."""
        values = {**self.hyperparameters, **chosen}
        usual = dict(zip(WEIGHTS, PRESETS["default"].weights, strict=True))
        weights = tuple(float(values.get(name, usual[name])) for name in WEIGHTS)
        reward = {"reward": weights} if any(name in values for name in WEIGHTS) else {}
        return {"heuristic": self.heuristic, **reward}

    def resolved(self, chosen: Mapping[str, Any], seed: int | None = None) -> Hyperparameters:
        """All hyperparameters of a trial.

        Args:
            chosen: what was searched.
            seed: of the training; None: the first.

        Raises:
            UsageError: they cannot work together.
        """
        values = {**self.hyperparameters, **chosen}
        changes: dict[str, Any] = {name: value for name, value in values.items() if name not in WEIGHTS}
        transitions = changes.pop(TRANSITIONS, None)
        changes = {name: tuple(value) if isinstance(value, list) else value for name, value in changes.items()}
        fixed = {"seed": self.seeds[0] if seed is None else seed, "total_timesteps": self.budget}
        if transitions is not None:
            num_envs = changes.get("num_envs")
            if num_envs is None:
                num_envs = request.hyperparameters(self.algorithm, self.task, self.preset).num_envs
            changes["num_steps"] = max(int(transitions) // num_envs, 1)
        return request.hyperparameters(self.algorithm, self.task, self.preset, **fixed, **changes)


def load_tuning(file: str, output: Path | None = None) -> Tuning:
    """Read and check a search.

    Raises:
        UsageError: what is wrong with the file, and what is allowed.
    """
    path = Path(file)
    if not path.is_file():
        raise UsageError(f"File {file!r} does not exist: give the path of a TOML file that describes a search.")
    return parse_tuning(read_toml(path), output)


def parse_tuning(contents: Mapping[str, Any], output: Path | None = None) -> Tuning:
    """Check the contents of a file; see :func:`load_tuning`."""
    where = "the search"
    refuse_unknown_keys(where, contents, _KEYS)
    name, algorithm = text(where, contents, "name"), text(where, contents, "algorithm")
    task = find_task(text(where, contents, "task"))
    heuristic = text(where, contents, "heuristic", NO_HEURISTIC)
    if heuristic not in (NO_HEURISTIC, *HEURISTICS):
        raise unknown("Heuristic", heuristic, (NO_HEURISTIC, *HEURISTICS))
    if algorithm not in algorithm_names():
        raise unknown("Algorithm", algorithm, algorithm_names())
    hyperparameters = as_table("the search, hyperparameters", contents.get("hyperparameters", {}))
    space = as_table("the search, space", contents.get("space", _default_space(algorithm, hyperparameters)))
    months = contents.get("months")
    tuning = Tuning(
        name=name,
        output=output or Path(text(where, contents, "output", f"tuning/{name}")),
        algorithm=algorithm,
        task=task,
        heuristic=None if heuristic == NO_HEURISTIC else heuristic,
        preset=text(where, contents, "preset", "default"),
        seed=count(where, "seed", contents.get("seed", 1), 0),
        seeds=_seeds(where, contents.get("seeds", [1, 2, 3])),
        trials=count(where, "trials", contents.get("trials", 50), 1),
        budget=count(where, "budget", contents.get("budget", 200_000), 1),
        validations=count(where, "validations", contents.get("validations", 10), 1),
        months=None if months is None else count(where, "months", months, 1),
        hyperparameters=hyperparameters,
        space=space,
    )
    _check_space(tuning)
    refusal = _refusal(tuning, {})
    if refusal is not None:
        raise refusal
    _check_choices(tuning)
    return tuning


def _seeds(where: str, seeds: Any) -> tuple[int, ...]:
    if not isinstance(seeds, list | tuple) or not seeds or len(set(map(str, seeds))) != len(seeds):
        raise UsageError(f"The seeds of {where} must be a list of different whole numbers such as [1, 2, 3].")
    return tuple(count(where, "seeds", seed, 0) for seed in seeds)


def search_space(algorithm: str) -> dict[str, list[Any]]:
    """The paper's grid for an algorithm (its table of hyperparameters), weights of the reward included."""
    return {name: list(values) for name, values in {**find_algorithm(algorithm).search_space, **WEIGHT_CHOICES}.items()}


def _default_space(algorithm: str, fixed: Mapping[str, Any]) -> dict[str, list[Any]]:
    """The paper's grid without what is fixed."""
    without = {*fixed, TRANSITIONS} if "num_steps" in fixed else set(fixed)
    return {name: values for name, values in search_space(algorithm).items() if name not in without}


def run_args(
    tuning: Tuning, chosen: Mapping[str, Any], folder: Path | None, seed: int | None = None
) -> request.RunArgs:
    """A training of a trial, in ``folder``; None: the usual one.

    Raises:
        UsageError: the choices cannot work together.
    """
    return request.RunArgs(
        task=tuning.task,
        hyperparameters=tuning.resolved(chosen, seed),
        algorithm=tuning.algorithm,
        folder=folder,
        env_keywords=tuning.environment(chosen),
        num_threads=1,
        evaluate_every=max(tuning.budget // tuning.validations, 1),
        validation_months=tuning.months,
        tensorboard=False,
        progress=False,
    )


def _check_space(tuning: Tuning) -> None:
    if not tuning.space:
        raise UsageError("A search needs a [space] with at least one hyperparameter, such as gamma = [0.9, 0.99].")
    kinds = kinds_of(tuning)
    allowed = [name for name in kinds if name not in ("seed", "total_timesteps")]
    for name in (*tuning.space, *tuning.hyperparameters):
        if name not in allowed:
            raise unknown(f"Hyperparameter of {tuning.algorithm}", name, allowed)
        if name in tuning.space and name in tuning.hyperparameters:
            raise UsageError(
                f"{name} is both fixed, in [hyperparameters], and searched, in [space]: take it out of one."
            )
    if {"num_steps", TRANSITIONS} <= {*tuning.space, *tuning.hyperparameters}:
        raise UsageError(f"num_steps and {TRANSITIONS!r} say the same in two ways: take one of them out.")
    for name, value in tuning.hyperparameters.items():
        check_kind(f"the search, hyperparameter {name}", value, kinds[name])
    for name, values in tuning.space.items():
        if name in _MEASURES:
            raise UsageError(
                f"The {name} cannot be searched, because all trials are scored by the same: fix them in "
                "[hyperparameters]."
            )
        for choice in _choices(name, values):
            check_kind(f"each choice for {name}", choice, kinds[name])


def kinds_of(tuning: Tuning) -> dict[str, Any]:
    """Type hint of every name that a search may hold."""
    return {**find_algorithm(tuning.algorithm).type_hints(), TRANSITIONS: int, **dict.fromkeys(WEIGHTS, float)}


def _choices(name: str, values: Any) -> list[Any]:
    """All choices; of a range its ends."""
    if isinstance(values, list) and values:
        return values
    if _is_range(values):
        return [values["low"], values["high"]]
    raise UsageError(
        f"The space of {name} must be a list of choices or a range {{low = 0.1, high = 1.0, log = true}}, "
        f"not {values!r}."
    )


def _check_choices(tuning: Tuning) -> None:
    """Refuse a choice that cannot work beside any of many combinations of the others."""
    draw = random.Random(0)
    choices = {name: _choices(name, values) for name, values in tuning.space.items()}
    for name, values in choices.items():
        for choice in values:
            refusal = _refusal(tuning, {name: choice})
            if refusal is None:
                continue
            combinations = (
                {**{other: draw.choice(each) for other, each in choices.items()}, name: choice}
                for _ in range(_COMBINATIONS)
            )
            if all(_refusal(tuning, combination) for combination in combinations):
                raise UsageError(f"The space of {name} holds {choice!r}, which cannot work: {refusal}")


def _refusal(tuning: Tuning, chosen: Mapping[str, Any]) -> UsageError | None:
    """Why a configuration cannot be trained; None if it can."""
    try:
        args = run_args(tuning, chosen, None)
        request.find_limits(args)
        TaskOptions(**args.env_keywords)
    except UsageError as error:
        return error
    return None


def _is_range(values: Any) -> bool:
    if not isinstance(values, dict) or not {"low", "high"} <= set(values) <= {"low", "high", "log"}:
        return False
    low, high, log = values["low"], values["high"], values.get("log", False)
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in (low, high))
    return numbers and isinstance(log, bool) and low < high and (low > 0 or not log)
