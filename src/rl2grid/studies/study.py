"""The file of a study: many trainings and evaluations named in TOML.

A file has settings, scales of effort to choose from, and groups whose products are the cells of the study::

    name = "heuristics"
    split = "test"

    [scale.quick]
    budget = 20_000
    [scale.full]
    budget = 1_000_000
    seeds = [1, 2, 3]

    [[group]]
    algorithms = ["ppo", "sac"]
    agents = ["do-nothing"]
    tasks = ["bus14-T0"]
    heuristics = ["none", "idle"]

See ``docs/studies.md`` for all keys. Everything is checked before anything begins.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from importlib import resources
from pathlib import Path
from typing import Any

from rl2grid.algorithms.registry import algorithm_names, find_algorithm
from rl2grid.engines import HEURISTICS
from rl2grid.envs.options import TaskOptions, options_of
from rl2grid.envs.tasks import Task, constraint_of, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import AGENTS, kinds_of
from rl2grid.evaluation.protocol import first_months
from rl2grid.mdp.rewards import resolve_reward
from rl2grid.records.trainings import IMITATION
from rl2grid.scenarios.splits import SPLITS
from rl2grid.studies.cells import GOES_ON, Cell, Lessons, Study, Training
from rl2grid.studies.toml_file import (
    as_table,
    check_kind,
    count,
    read_toml,
    refuse_unknown_keys,
    table_of,
    text,
    unknown,
    upper,
    with_tuples,
)
from rl2grid.training import request

NO_HEURISTIC = "none"
DEFAULT_RETRIES = 2
DEFAULT_VALIDATIONS = 10

_ACTIONS = {"T": "discrete", "R": "continuous", "H": "joint"}

_STUDY_KEYS = ("name", "output", "retries", "scale", "group", "slurm")
_PRODUCT_KEYS = ("label", "algorithms", "agents", "tasks", "heuristics", "hyperparameters", "environment")
_SETTINGS = (
    "split",
    "preset",
    "reward",
    "seeds",
    "budget",
    "validations",
    "months",
    "evaluation_seeds",
    "teacher",
    "rounds",
    "pupil_budget",
)
"""May stand in a group, a scale or the study, and count in this order."""


def included_studies() -> dict[str, Path]:
    """The studies of this package, by name."""
    folder = Path(str(resources.files("rl2grid"))) / "studies"
    return {path.stem: path for path in sorted(folder.glob("*.toml"), key=lambda path: path.stem)}


def load_study(file: str, scale: str | None = None, output: Path | None = None) -> Study:
    """Read and check a study.

    Args:
        file: path of a TOML file, or the name of an included study.
        scale: one of the file's scales; None: its first one, if it has any.
        output: where everything is written; None: what the file says, else ``studies/<name>``; a file with scales has
            one folder inside for each.

    Raises:
        UsageError: what is wrong with the file, and what is allowed.
    """
    path = included_studies().get(file) or Path(file)
    if not path.is_file():
        allowed = [*included_studies(), "the path of a TOML file"]
        raise unknown("Study", file, allowed)
    return parse_study(read_toml(path), scale, output)


def parse_study(contents: Mapping[str, Any], scale: str | None = None, output: Path | None = None) -> Study:
    """Check the contents of a file; see :func:`load_study`."""
    refuse_unknown_keys("the study", contents, (*_STUDY_KEYS, *_SETTINGS))
    name = text("the study", contents, "name")
    scales = table_of("the study", contents, "scale")
    for each, values in scales.items():
        refuse_unknown_keys(f"scale {each!r}", as_table(f"scale {each!r}", values), _SETTINGS)
    chosen = _chosen_scale(scales, scale)
    groups = contents.get("group")
    if not isinstance(groups, list) or not groups or not all(isinstance(group, dict) for group in groups):
        raise UsageError("A study needs at least one [[group]] with tasks and algorithms or agents.")
    shared = [scales[chosen] if chosen else {}, contents]
    cells = [
        cell
        for number, group in enumerate(groups, start=1)
        for cell in _Group(f"group {group.get('label', number)}", group, shared, chosen, tuple(scales)).cells()
    ]
    _refuse_equal_names(cells)
    base = output or Path(text("the study", contents, "output", f"studies/{name}"))
    return Study(
        name=name,
        output=base / chosen if chosen else base,
        scale=chosen,
        retries=count("the study", "retries", contents.get("retries", DEFAULT_RETRIES), 0),
        cells=tuple(cells),
        slurm=table_of("the study", contents, "slurm"),
    )


class _Group:
    """One table ``[[group]]`` and what it inherits."""

    def __init__(
        self,
        where: str,
        table: Mapping[str, Any],
        shared: Sequence[Mapping[str, Any]],
        scale: str | None,
        scales: tuple[str, ...],
    ) -> None:
        refuse_unknown_keys(where, table, (*_PRODUCT_KEYS, *_SETTINGS))
        self.where, self.table, self.shared = where, table, shared
        self.scale, self.scales = scale, scales

    def cells(self) -> Iterator[Cell]:
        """The product of what the group lists."""
        algorithms, agents = self._names("algorithms", algorithm_names()), self._names("agents", AGENTS)
        tasks = [find_task(task) for task in self._names("tasks")]
        heuristics = self._names("heuristics", (NO_HEURISTIC, *HEURISTICS)) or [NO_HEURISTIC]
        if not tasks or not (algorithms or agents):
            raise UsageError(f"{upper(self.where)} needs tasks, and algorithms or agents.")
        self._check_hyperparameters(algorithms)
        for task, heuristic in itertools.product(tasks, heuristics):
            for agent in agents:
                self._check_agent(agent, task)
                yield self._cell(agent, task, heuristic, None)
            for algorithm, seed in itertools.product(algorithms, self._seeds() if algorithms else ()):
                yield self._cell(algorithm, task, heuristic, self._training(algorithm, seed, task))

    def _cell(self, agent: str, task: Task, heuristic: str, training: Training | None) -> Cell:
        label = text(self.where, self.table, "label", "")
        learned = f"{agent}-from-{IMITATION}" if training is not None and training.goes_on else agent
        parts = [task.id.removeprefix("rl2grid/"), learned, heuristic if heuristic != NO_HEURISTIC else "", label]
        if training is not None:
            parts.append(str(training.seed))
        chosen = None if heuristic == NO_HEURISTIC else heuristic
        split = self._setting("split", "test")
        if split not in SPLITS:
            raise unknown(f"{upper(self.where)}: split", split, SPLITS)
        months = self._setting("months", None)
        cell = Cell(
            name="-".join(part for part in parts if part),
            agent=agent,
            task=task,
            heuristic=chosen,
            environment=self._environment(chosen),
            split=split,
            months=None if months is None else count(self.where, "months", months, 1),
            evaluation_seeds=count(self.where, "evaluation_seeds", self._setting("evaluation_seeds", 1), 1),
            training=training,
        )
        try:
            _check_training_and_constraint(cell)
            options_of(task, cell.environment)
            first_months(task, split, cell.months)
        except UsageError as error:
            raise UsageError(f"{upper(self.where)}: {error}") from None
        return cell

    def _training(self, algorithm: str, seed: int, task: Task) -> Training:
        changes = self._changes(algorithm)
        budget = self._setting("budget", None)
        if budget is not None:
            changes["total_timesteps"] = count(self.where, "budget", budget, 1)
        preset = text(self.where, {"preset": self._setting("preset", "default")}, "preset")
        validations = count(self.where, "validations", self._setting("validations", DEFAULT_VALIDATIONS), 1)
        lessons = self._lessons(algorithm, task, changes)
        return Training(algorithm, seed, preset, changes, validations, lessons)

    def _lessons(self, algorithm: str, task: Task, changes: Mapping[str, Any]) -> Lessons | None:
        """What is labelled for imitation, and for others where the group itself has a teacher."""
        if algorithm == IMITATION:
            return None if self._is_given("labels", changes) else self._labelled(task, None)
        if "teacher" not in self.table:
            return None
        if algorithm not in GOES_ON:
            raise UsageError(
                f"{upper(self.where)} has a teacher and trains {algorithm}, which cannot go on from a pupil: leave "
                f"teacher out, or choose from {', '.join((IMITATION, *GOES_ON))}."
            )
        if self._is_given("start_from", changes):
            return None
        budget = self._setting("pupil_budget", request.hyperparameters(IMITATION, task).total_timesteps)
        return self._labelled(task, count(self.where, "pupil_budget", budget, 1))

    def _is_given(self, name: str, changes: Mapping[str, Any]) -> bool:
        """Whether what a teacher would make is there already.

        Raises:
            UsageError: and the group has a teacher all the same.
        """
        if name in changes and "teacher" in self.table:
            raise UsageError(f"{upper(self.where)} has {name} and a teacher, who would label again: leave out one.")
        return name in changes

    def _labelled(self, task: Task, pupil_budget: int | None) -> Lessons:
        teacher, rounds = self._setting("teacher", None), self._setting("rounds", None)
        if teacher is None or rounds is None:
            raise UsageError(
                f"{upper(self.where)} trains pupils: give teacher, an agent, and rounds, the months of each round "
                "of labels such as [200, 200], or hyperparameters.labels, folders that 'rl2grid teach' wrote."
            )
        if teacher not in AGENTS:
            raise unknown(f"{upper(self.where)}: teacher", teacher, list(AGENTS))
        self._check_agent(teacher, task)
        return Lessons(teacher, tuple(self._counts("rounds", rounds, 1, "[200, 200]")), pupil_budget)

    def _changes(self, algorithm: str) -> dict[str, Any]:
        """Hyperparameters of the group: those of all its algorithms, then those of this one."""
        table = table_of(self.where, self.table, "hyperparameters")
        common = {name: value for name, value in table.items() if name not in algorithm_names()}
        merged = {**common, **as_table(f"{self.where}, hyperparameters.{algorithm}", table.get(algorithm, {}))}
        return with_tuples(merged)

    def _check_hyperparameters(self, algorithms: Sequence[str]) -> None:
        for name, value in table_of(self.where, self.table, "hyperparameters").items():
            if name in algorithm_names() and name not in algorithms:
                raise UsageError(f"{upper(self.where)} has hyperparameters of {name}, which it does not train.")
            if isinstance(value, dict) and name not in algorithm_names():
                raise unknown(f"{upper(self.where)}: hyperparameters of", name, algorithms)
        for algorithm in algorithms:
            known = find_algorithm(algorithm).type_hints()
            for name, value in self._changes(algorithm).items():
                if name in ("seed", "total_timesteps"):
                    key = {"seed": "seeds", "total_timesteps": "budget"}[name]
                    raise UsageError(f"{upper(self.where)}: {name} is no hyperparameter of a study: give {key}.")
                if name not in known:
                    raise unknown(f"{upper(self.where)}: hyperparameter of {algorithm}", name, list(known))
                check_kind(f"{self.where}, hyperparameter {name}", value, known[name])

    def _check_agent(self, agent: str, task: Task) -> None:
        kind = task.kind
        if kind not in kinds_of(agent):
            able = [other for other in AGENTS if kind in kinds_of(other)]
            raise UsageError(
                f"{upper(self.where)}: agent {agent!r} cannot play {task.id}, which has {_ACTIONS[kind]} actions: "
                f"choose one of {', '.join(able)}."
            )

    def _environment(self, heuristic: str | None) -> dict[str, Any]:
        table = table_of(self.where, self.table, "environment")
        allowed = [item.name for item in fields(TaskOptions) if item.name not in _GIVEN_OTHERWISE]
        for name in table:
            if name not in allowed:
                raise unknown(f"{upper(self.where)}: environment keyword", name, allowed)
        reward = self._setting("reward", None)
        keywords = with_tuples(table if reward is None else {"reward": reward, **table})
        try:
            TaskOptions(heuristic=heuristic, **keywords)
            resolve_reward(keywords.get("reward", "default"))
        except UsageError as error:
            raise UsageError(f"{upper(self.where)}: {error}") from None
        return keywords

    def _seeds(self) -> list[int]:
        return self._counts("seeds", self._setting("seeds", [1]), 0, "[1, 2, 3]")

    def _counts(self, key: str, values: Any, at_least: int, example: str) -> list[int]:
        """The values, if they are a list of whole numbers that are large enough."""
        if not isinstance(values, list) or not values:
            raise UsageError(f"{upper(self.where)}: {key} must be a list such as {example}, not {values!r}.")
        return [count(self.where, f"each of {key}", value, at_least) for value in values]

    def _setting(self, key: str, default: Any) -> Any:
        """The group's value, else the scale's, else the study's; the group may give one per scale."""
        own = self.table.get(key)
        if isinstance(own, dict):
            for name in own:
                if name not in self.scales:
                    raise unknown(f"{upper(self.where)}: scale", name, self.scales)
            own = own.get(self.scale or "")
        return next(
            (value for value in (own, *(table.get(key) for table in self.shared)) if value is not None), default
        )

    def _names(self, key: str, allowed: Sequence[str] | Mapping[str, Any] | None = None) -> list[str]:
        names = self.table.get(key, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise UsageError(f"{upper(self.where)}: {key} must be a list of names in quotation marks, not {names!r}.")
        for name in names:
            if allowed is not None and name not in allowed:
                raise unknown(f"{upper(self.where)}: {key.removesuffix('s')}", name, list(allowed))
        return names


_GIVEN_OTHERWISE = ("heuristic", "split", "scenario", "gamma")


def _check_training_and_constraint(cell: Cell) -> None:
    """Refuse hyperparameters that cannot work, or not under the constraint of the cell."""
    if cell.training is None:
        constraint_of(cell.task, cell.environment.get("constraint"))
        return
    for step in cell.training.steps(cell.task, Path(cell.name)):
        request.find_limits(
            request.RunArgs(cell.task, step.hyperparameters, step.algorithm, env_keywords=cell.environment)
        )


def _chosen_scale(scales: Mapping[str, Any], asked: str | None) -> str | None:
    if asked is None:
        return next(iter(scales), None)
    if not scales:
        raise UsageError(f"Scale {asked!r} does not exist: this study has no scales, leave --scale out.")
    if asked not in scales:
        raise unknown("Scale", asked, list(scales))
    return asked


def _refuse_equal_names(cells: Sequence[Cell]) -> None:
    seen: set[str] = set()
    for cell in cells:
        if cell.name in seen:
            raise UsageError(f"Cell {cell.name} is listed twice: take it out of one group, or give one group a label.")
        seen.add(cell.name)
