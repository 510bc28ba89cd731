"""What to type to make a training run, or labels, again."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rl2grid.envs.tasks import Task, short_id
from rl2grid.evaluation.flags import environment_flags, flags
from rl2grid.training import request


def train_command(args: request.RunArgs, preset: str = "default", folder: Path | None = None) -> str:
    """The shortest ``rl2grid train`` that makes a run again: everything that its preset does not say.

    The number of PyTorch's threads and the device are in it, because results are the same bit for bit for these only;
    what has no influence on results is not.

    Args:
        args: the run.
        preset: where its hyperparameters came from.
        folder: to write it to; None: the usual one.
    """
    words = ["rl2grid", "train", args.algorithm, short_id(args.task.id)]
    words += ["--preset", preset] if preset != "default" else []
    chosen, usual = asdict(args.hyperparameters), request.hyperparameters(args.algorithm, args.task, preset)
    deciding = {name: chosen[name] for name in request.DECIDING if chosen.get(name) != getattr(usual, name, None)}
    original = asdict(request.hyperparameters(args.algorithm, args.task, preset, **deciding))
    changes = deciding | {name: value for name, value in chosen.items() if value != original[name]}
    words += [*environment_flags(args.env_keywords), *flags(changes)]
    if args.evaluate_every != request.RunArgs.evaluate_every:
        words += ["--evaluate-every", str(args.evaluate_every)]
    if args.validation_months != request.RunArgs.validation_months:
        words += ["--validation-months", str(args.validation_months)]
    words += [] if folder is None else ["--output", str(folder)]
    return shlex.join(words)


def training_command(folder: Path) -> str:
    """The command that makes the run in ``folder`` again.

    Raises:
        UsageError: the folder holds no run.
    """
    args, _ = request.read_config(folder)
    return train_command(args, folder=folder)


def teach_command(
    teacher: str,
    task: Task,
    keywords: Mapping[str, Any],
    *,
    months: int,
    seed: int,
    pupil: str | Path | None,
    pupil_share: float,
    gamma: float | None,
    thin: float,
    output: Path | None,
    pupil_top_k: int | None = None,
    looking: Mapping[str, int] | None = None,
) -> str:
    """The ``rl2grid teach`` that labels a round, or goes on with it, whatever is the default then.

    Args:
        teacher: who labels.
        task: whose months.
        keywords: of the environments that were given; a heuristic of None is told as well.
        months: of the round.
        seed: of the labels.
        pupil: who plays; None: the teacher.
        pupil_share: how often.
        pupil_top_k: actions of it that are compared; None: it plays its best.
        looking: how a policy that teaches looks before it acts; None: it does not.
        gamma: the discount; None: the usual one.
        thin: one is kept of so many safe states in which nothing is done.
        output: the folder; None: the usual one.
    """
    words = ["rl2grid", "teach", teacher, short_id(task.id), *flags(looking or {}), "--months", str(months)]
    words += ["--seed", str(seed)] if seed else []
    words += [] if pupil is None else ["--pupil", str(pupil), "--pupil-share", f"{pupil_share:g}"]
    words += [] if pupil_top_k is None else ["--pupil-top-k", str(pupil_top_k)]
    words += [] if gamma is None else ["--gamma", f"{gamma:g}"]
    words += ["--thin", f"{thin:g}"]
    words += ["--heuristic", str(keywords["heuristic"])] if "heuristic" in keywords else []
    words += environment_flags({**keywords, "heuristic": None})
    words += [] if output is None else ["--output", str(output)]
    return shlex.join(words)
