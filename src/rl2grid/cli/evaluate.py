"""``rl2grid evaluate``: play an agent on enumerated scenarios, print the aggregates, keep every episode."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from rich.console import Console

from rl2grid.analysis.tables import rich_table
from rl2grid.engines import ENGINES
from rl2grid.envs.tasks import find_task
from rl2grid.experiments.evaluation import AS_TRAINED, evaluate, evenly_spread


def run(options: argparse.Namespace) -> int:
    """Evaluate as the flags say.

    Raises:
        UsageError: the request cannot be met; nothing was written.
    """
    task = find_task(options.task)
    heuristic = AS_TRAINED if options.heuristic is None else None if options.heuristic == "None" else options.heuristic
    output: Path = options.output or _default_output(options, task.id.removeprefix("rl2grid/"))
    result = evaluate(
        options.agent,
        task.id,
        split=options.split,
        scenarios=None if options.months is None else evenly_spread(task.id, options.split, options.months),
        seeds=range(options.seeds),
        heuristic=heuristic,
        constraint=None if options.constraint == "None" else options.constraint,
        engine=options.engine,
        workers=options.workers,
        output=output,
        progress=True,
        command=_command(options),
    )
    Console().print(rich_table([result.summary], title=f"{task.id}, {options.split} scenarios"))
    print(f"{len(result.episodes)} episodes in {output / 'episodes.csv'}.")
    return 0


def _default_output(options: argparse.Namespace, task: str) -> Path:
    """Inside the run for one of its policies; else by task and agent."""
    name = options.split if options.heuristic is None else f"{options.split}-{options.heuristic}"
    if options.constraint not in (None, "None"):
        name = f"{name}-{options.constraint}"
    if options.months is not None:
        name = f"{name}-{options.months}-months"
    if options.engine != ENGINES[0]:
        name = f"{name}-{options.engine}"
    path = Path(options.agent)
    if path.is_dir():
        return path / "evaluation" / name
    if path.is_file():
        return path.parent / "evaluation" / f"{path.stem}-{name}"
    return Path("runs") / f"{task}-{options.agent}" / "evaluation" / name


def _command(options: argparse.Namespace) -> str:
    words = ["rl2grid", "evaluate", str(options.agent), options.task, "--split", options.split]
    words += ["--seeds", str(options.seeds)]
    if options.months is not None:
        words += ["--months", str(options.months)]
    if options.heuristic is not None:
        words += ["--heuristic", options.heuristic]
    if options.constraint is not None:
        words += ["--constraint", options.constraint]
    if options.engine != ENGINES[0]:
        words += ["--engine", options.engine]
    return shlex.join(words)
