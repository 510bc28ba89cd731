"""``rl2grid evaluate``: play an agent on enumerated scenarios, print the aggregates, keep every episode."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from rl2grid.analysis.summary_table import rich_table
from rl2grid.cli import keywords
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation.flags import environment_flags, evaluate_command
from rl2grid.evaluation.protocol import evaluate, first_months


def run(options: argparse.Namespace) -> int:
    """Evaluate as the flags say.

    Raises:
        UsageError: the request cannot be met; nothing was written.
    """
    task = find_task(options.task)
    chosen = keywords.given(options)
    output: Path = options.output or _default_output(options, task.id.removeprefix("rl2grid/"), chosen)
    result = evaluate(
        options.agent,
        task,
        split=options.split,
        scenarios=None if options.months is None else first_months(task, options.split, options.months),
        seeds=range(options.seeds),
        workers=options.workers,
        output=output,
        progress=True,
        command=evaluate_command(options.agent, task, options.split, options.seeds, options.months, chosen),
        **chosen,
    )
    Console().print(rich_table([result.summary], title=f"{task.id}, {options.split} scenarios"))
    if result.foresight:
        print("The agent stepped saved true worlds: with this foresight it is not ranked with others.")
    print(f"{len(result.episodes)} episodes in {output / 'episodes.csv'}.")
    return 0


def _default_output(options: argparse.Namespace, task: str, chosen: Mapping[str, Any]) -> Path:
    """Inside the run for one of its policies; else by task and agent."""
    parts = [options.split]
    if "heuristic" in chosen:
        parts.append(str(chosen["heuristic"]))
    if options.months is not None:
        parts.append(f"{options.months}-months")
    parts += [flag.removeprefix("--") for flag in environment_flags({**chosen, "heuristic": None})]
    name = "-".join(parts)
    path = Path(options.agent)
    if path.is_dir():
        return path / "evaluation" / name
    if path.is_file():
        return path.parent / "evaluation" / f"{path.stem}-{name}"
    return Path("runs") / f"{task}-{options.agent}" / "evaluation" / name
