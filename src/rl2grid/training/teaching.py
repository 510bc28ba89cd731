"""Labels of training months: a teacher decides in every state that it, or a pupil, meets (``docs/labels.md``).

Months are episodes as training plays them: drawn from the library of training years, from a row drawn in them. Those of
a round, numbered from 0, depend on the seed and their numbers alone, so that more can be added to a round. What is
stored depends neither on the number of workers nor on interruptions; see :mod:`rl2grid.records.labels`.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from rl2grid.agents.agent import Agent
from rl2grid.envs.options import DEFAULTS, OBSERVED_WITH, TaskOptions, changed_options, options_of
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.crew import Job, OnProgress, make_crew
from rl2grid.evaluation.flags import environment_flags, flags
from rl2grid.evaluation.places import default_folder
from rl2grid.evaluation.progress import show_progress, watch_making
from rl2grid.evaluation.protocol import AS_TRAINED, env_keywords
from rl2grid.evaluation.setting import BoundAgent, Setting
from rl2grid.mdp.rewards import resolve_reward
from rl2grid.records.episodes import Episode
from rl2grid.records.files import check_folder, printable
from rl2grid.records.label_folder import LabelFolder, open_labels
from rl2grid.records.labels import MOST_MONTHS, Labels, MonthRow, task_identity
from rl2grid.records.versions import library_versions
from rl2grid.scenarios.library import check_training_room, draw_scenario, generator_version, make_scenarios
from rl2grid.scenarios.splits import TRAIN
from rl2grid.training.labeller import Labeller, says_candidates

MONTHS, PUPIL_SHARE, THIN = 20, 1.0, 10.0
"""Of a round, unless others are asked for."""
CANDIDATES = 8
"""Topology actions of which a teacher that compares them says what it thinks."""
DISCOUNTS = {"T": 0.9, "R": 0.99, "H": 0.99}
"""Of a grid step by kind of task, unless another one is asked for: those of the preset ``default`` of imitation, which
learns joint actions as continuous ones."""
_ROUND = 2**20
"""Episodes of a round in the stream of a seed; more than months that it may have."""
_MOST_SEEDS = 2**31


class Labelled(NamedTuple):
    """A month that was played."""

    episode: Episode
    acted: int
    labels: Labels


@dataclass(frozen=True)
class LabelSetup:
    """What all months of a round have in common."""

    task: Task
    teacher: Agent
    """Not bound yet, as the pupil."""
    pupil: Agent | None
    pupil_share: float
    thin: float
    candidates: int
    gamma: float
    env_keywords: Mapping[str, Any]

    abreast: ClassVar[int] = 1

    def player(self, num_threads: int) -> LabelPlayer:
        """Who plays them in this process."""
        return LabelPlayer(self)


class LabelPlayer:
    """Plays months with a teacher, and a pupil if there is one, that are bound to an environment."""

    def __init__(self, setup: LabelSetup) -> None:
        self._gamma = setup.gamma
        self._labeller = Labeller(
            setup.task, setup.teacher, setup.pupil, setup.pupil_share, setup.thin, setup.candidates
        )
        keywords = {**changed_options(setup.env_keywords), "gamma": setup.gamma}
        self._bound = BoundAgent(Setting(setup.task.id, self._labeller, keywords))

    def play(self, jobs: Sequence[Job], on_progress: OnProgress) -> Iterator[tuple[Job, Labelled]]:
        """Play months and label them."""
        for job in jobs:
            episode = self._bound.play_one(job, on_progress, self._labeller.note)
            yield job, Labelled(episode, self._labeller.acted, self._labeller.labels(self._gamma))

    def close(self) -> None:
        """Free the environment."""
        self._bound.close()


@dataclass(frozen=True)
class Taught:
    """A round of labels that is complete."""

    folder: Path
    round: int
    teacher: str
    """Its name."""
    pupil: str | None
    """The name of who acted; None: the teacher."""
    months: tuple[MonthRow, ...]


def teach(
    teacher: str | Path | Agent,
    task: Task | str,
    *,
    months: int = MONTHS,
    output: Path | None = None,
    seed: int = 0,
    heuristic: str | None = AS_TRAINED,
    pupil: str | Path | Agent | None = None,
    pupil_share: float = PUPIL_SHARE,
    pupil_top_k: int | None = None,
    top_k: int | None = None,
    rehearse: int | None = None,
    gamma: float | None = None,
    thin: float = THIN,
    workers: int | None = None,
    progress: bool = False,
    command: str | None = None,
    **options: Any,
) -> Taught:
    """Label training months with what a teacher decides, or go on with it.

    Args:
        teacher: as :func:`rl2grid.evaluation.protocol.evaluate` takes agents.
        task: the task, or its id, whose namespace and version may be left out.
        months: of the round; of one that is there already, as many or more.
        output: folder of the labels, that of an earlier call to go on with it; None: by task and teacher in ``runs``.
        seed: of which months are played, and which decisions are kept of those that ask for nothing.
        heuristic: None, one of :data:`rl2grid.engines.HEURISTICS`, or the one that the teacher, else the pupil, was
            trained with; none for agents without training.
        pupil: who acts while the teacher says what it would do (DAgger): the next round of a folder that has labels;
            None: the teacher acts.
        pupil_share: probability with which the pupil acts in a decision, else the teacher.
        pupil_top_k: actions that the what-if compares when a pupil given by name or path acts; None: it plays its best.
        top_k: actions that the what-if compares where a policy given by name or path teaches; None: it plays its best.
        rehearse: grid steps of a crisis that such a policy plays in imagined worlds first; None: none are.
        gamma: discount of a grid step in rewards and returns; None: :data:`DISCOUNTS`.
        thin: of so many decisions in which the grid is safe and the teacher does nothing, one is kept, at random.
        workers: processes that play at the same time; 0: this process plays; None: one per processor core, but this one
            for agents that are not given by name or path. No influence on results.
        progress: whether to show a progress bar.
        command: what to type to go on; None: this call.
        options: further keywords of ``gymnasium.make``, such as ``reward`` or ``opponent``.

    Raises:
        UsageError: the request cannot be met, or ``output`` holds other labels. Nothing was written.
    """
    task = find_task(task)
    looking = {name: value for name, value in (("top_k", top_k), ("rehearse", rehearse)) if value is not None}
    if looking and not isinstance(teacher, str | Path):
        raise UsageError(
            "top_k and rehearse are of a teacher that is given by name or path: name it, or leave them out."
        )
    chosen = make_agent(teacher, task, **looking) if isinstance(teacher, str | Path) else teacher
    if pupil_top_k is not None and not isinstance(pupil, str | Path):
        raise UsageError("pupil_top_k is of a pupil that is given by name or path: name it, or leave this out.")
    learner = make_agent(pupil, task, top_k=pupil_top_k) if isinstance(pupil, str | Path) else pupil
    keywords = _keywords(task, chosen, learner, {**options, "heuristic": heuristic})
    gamma = DISCOUNTS[task.kind] if gamma is None else gamma
    _check_numbers(months, seed, pupil_share, gamma, thin, workers)
    if learner is None and pupil_share != PUPIL_SHARE:
        raise UsageError(f"pupil_share={pupil_share!r} is of a pupil, and there is none: name it, or leave this out.")
    setup = LabelSetup(
        task,
        chosen,
        learner,
        float(pupil_share),
        float(thin),
        CANDIDATES if task.changes_topology and says_candidates(chosen) else 0,
        float(gamma),
        keywords,
    )
    folder = output or default_folder(
        teacher if isinstance(teacher, str | Path) else chosen.name,
        chosen,
        task,
        "labels",
        _folder_name(keywords, seed, looking),
    )
    check_folder(folder)
    # What cannot be played, or whose months have no room, is refused before anything is written.
    copy.deepcopy(setup).player(1).close()
    check_training_room(task.grid_id, months)
    watch_making(task.grid_id, *make_scenarios(task.grid_id, [_job(task, seed, 0, 0).scenario]), False)
    call = command or _call(
        teacher, task, keywords, months, seed, pupil, pupil_share, pupil_top_k, looking, gamma, thin, folder
    )
    with open_labels(folder, _request(setup, seed), _round(setup, months, call)) as labels:
        named = all(isinstance(each, str | Path | None) for each in (teacher, pupil))
        rows = _label(setup, labels, seed, _number_of_workers(workers, named), progress)
    who = None if learner is None else printable(learner.name)
    return Taught(folder, labels.number, printable(chosen.name), who, rows)


def _label(setup: LabelSetup, folder: LabelFolder, seed: int, workers: int, progress: bool) -> tuple[MonthRow, ...]:
    """Play the months that are missing; what became of all of them."""
    jobs = [_job(setup.task, seed, folder.number, month) for month in range(folder.n_months)]
    month_of = {job: month for month, job in enumerate(jobs)}
    rows = folder.rows()
    missing = [job for job, month in month_of.items() if month not in rows]
    watch_making(setup.task.grid_id, *make_scenarios(setup.task.grid_id, [job.scenario for job in missing]), progress)
    with show_progress(f"Labelling by {setup.teacher.name}", jobs, progress) as display:
        display.skip(job for job, month in month_of.items() if month in rows)
        if missing:
            with make_crew(setup, min(workers, len(missing))) as crew:
                for job, labelled in crew.play(missing, display.advance):
                    row = _row(folder, month_of[job], job, labelled)
                    folder.add(row, labelled.labels)
                    rows[row.number] = row
                    display.finish(job, row.grid_steps)
    return tuple(rows[month] for month in sorted(rows))


def _job(task: Task, seed: int, number: int, month: int) -> Job:
    """A month of a round: the episode of the stream of ``seed`` that no other round plays."""
    episode = number * _ROUND + month
    return Job(draw_scenario(task.grid_id, TRAIN, seed, episode), (seed << 32) + episode, None)


def _row(folder: LabelFolder, month: int, job: Job, labelled: Labelled) -> MonthRow:
    episode = labelled.episode
    return MonthRow(
        request=folder.request,
        round=folder.number,
        number=month,
        scenario=job.scenario,
        seed=job.seed,
        start=episode.start,
        grid_steps=episode.grid_steps,
        survival=episode.survival,
        decisions=episode.decisions,
        acted=labelled.acted,
        labels=len(labelled.labels),
    )


def _keywords(task: Task, teacher: Agent, pupil: Agent | None, given: dict[str, Any]) -> dict[str, Any]:
    """All keywords of the environments but ``scenario`` and ``gamma``, so that labels stay what they are.

    Raises:
        UsageError: one does not exist, is not allowed, or is not what the pupil was trained with.
    """
    for name in ("scenario", "gamma"):
        if name in given:
            raise UsageError(f"Option {name!r} is not one of the environments here: leave it out.")
    if given.setdefault("split", TRAIN) != TRAIN:
        raise UsageError(f"Labels of the {given['split']} scenarios are refused: they are of the split {TRAIN!r}.")
    trained = teacher if pupil is None or hasattr(teacher, "env_keywords") else pupil
    keywords = env_keywords(trained, given)
    if callable(keywords.get("reward")):
        raise UsageError("Labels store their reward by name: choose a preset or three weights, not a function.")
    options_of(task, keywords)
    resolve_reward(keywords.get("reward", "default"))
    complete = {
        name: value for name, value in vars(TaskOptions(**keywords)).items() if name not in ("scenario", "gamma")
    }
    _check_pupil(pupil, complete)
    return complete


def _check_pupil(pupil: Agent | None, keywords: Mapping[str, Any]) -> None:
    """Refuse a pupil that was trained in other environments than those whose months are labelled."""
    trained = getattr(pupil, "env_keywords", None)
    if trained is None:
        return
    for name in ("heuristic", *OBSERVED_WITH):
        mine = trained.get(name, DEFAULTS[name])
        if mine != keywords[name]:
            raise UsageError(
                f"The pupil was trained with {name}={mine!r}, and the labels are of {name}={keywords[name]!r}: choose "
                "a pupil that was trained as they are."
            )


def _check_numbers(
    months: object, seed: object, pupil_share: object, gamma: object, thin: object, workers: object
) -> None:
    if not _is_whole(months, 1, MOST_MONTHS):
        raise UsageError(f"months={months!r} is not allowed: give a number from 1 to {MOST_MONTHS:,}.")
    if not _is_whole(seed, 0, _MOST_SEEDS - 1):
        raise UsageError(f"seed={seed!r} is not allowed: give an integer from 0 to {_MOST_SEEDS - 1:,}.")
    if not _is_number(pupil_share, 0, 1) or pupil_share == 0:
        raise UsageError(f"pupil_share={pupil_share!r} is not allowed: give a probability above 0 and at most 1.")
    if not _is_number(gamma, 0, 1):
        raise UsageError(f"gamma={gamma!r} is not allowed: give a discount from 0 to 1.")
    if not _is_number(thin, 1, 1000):
        raise UsageError(f"thin={thin!r} is not allowed: give a number from 1, which keeps every decision, to 1000.")
    if workers is not None and not _is_whole(workers, 0, 1000):
        raise UsageError(f"workers={workers!r} is not allowed: give a number of processes, 0 or more.")


def _is_whole(value: object, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _is_number(value: object, least: float, most: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most


def _number_of_workers(workers: int | None, named: bool) -> int:
    """An agent of the caller's own script may not be known in another process."""
    return workers if workers is not None else os.cpu_count() or 1 if named else 0


def _request(setup: LabelSetup, seed: int) -> dict[str, Any]:
    task = setup.task
    return {
        "task": task.id,
        "teacher": printable(setup.teacher.name),
        "teacher_identity": getattr(setup.teacher, "identity", None),
        "env_keywords": dict(setup.env_keywords),
        "gamma": setup.gamma,
        "thin": setup.thin,
        "seed": seed,
        "candidates": setup.candidates,
        "identity": {
            **task_identity(task, setup.env_keywords["operator_features"]),
            "generator_version": generator_version(task.grid_id, TRAIN),
            "versions": library_versions(),
        },
    }


def _round(setup: LabelSetup, months: int, command: str) -> dict[str, Any]:
    pupil = setup.pupil
    who = None if pupil is None else {"agent": printable(pupil.name), "identity": getattr(pupil, "identity", None)}
    return {
        "months": months,
        "pupil": who,
        "pupil_share": 0.0 if pupil is None else setup.pupil_share,
        "command": command,
    }


def _folder_name(keywords: Mapping[str, Any], seed: int, looking: Mapping[str, int]) -> str:
    """What tells labels of the same teacher apart."""
    chosen = [*environment_flags({**keywords, "heuristic": None}), *flags(looking)]
    words = [keywords["heuristic"] or "", *(flag.removeprefix("--") for flag in chosen)]
    return "-".join(filter(None, (f"seed-{seed}", *words)))


def _call(
    teacher: str | Path | Agent,
    task: Task,
    keywords: Mapping[str, Any],
    months: int,
    seed: int,
    pupil: str | Path | Agent | None,
    pupil_share: float,
    pupil_top_k: int | None,
    looking: Mapping[str, int],
    gamma: float,
    thin: float,
    folder: Path,
) -> str:
    arguments: dict[str, Any] = {"months": months, "seed": seed, "gamma": gamma, "thin": thin}
    arguments |= {**changed_options(keywords), **looking}
    if pupil is not None:
        arguments |= {"pupil": _shown(pupil), "pupil_share": pupil_share}
    if pupil_top_k is not None:
        arguments["pupil_top_k"] = pupil_top_k
    words = ", ".join(f"{key}={value!r}" for key, value in arguments.items())
    return f"teach({_shown(teacher)!r}, {task.id!r}, {words}, output={str(folder)!r})"


def _shown(agent: str | Path | Agent) -> str:
    return str(agent) if isinstance(agent, str | Path) else f"<{agent.name}>"


def summary_of(taught: Taught) -> dict[str, Any]:
    """What a round comes to, over its months: survival is a mean, the others are sums."""
    months: Sequence[MonthRow] = taught.months
    return {
        "months": len(months),
        "survival": sum(month.survival for month in months) / len(months),
        "grid_steps": sum(month.grid_steps for month in months),
        "decisions": sum(month.decisions for month in months),
        "acted": sum(month.acted for month in months),
        "labels": sum(month.labels for month in months),
    }
