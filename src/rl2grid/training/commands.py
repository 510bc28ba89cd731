"""What to type to make a training run again."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from pathlib import Path

from rl2grid.envs.tasks import short_id
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
