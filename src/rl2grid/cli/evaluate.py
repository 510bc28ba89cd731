"""``rl2grid evaluate``: play agents on enumerated scenarios, print the aggregates, keep every episode, compare."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from rl2grid.agents.agent import Agent
from rl2grid.analysis.comparison_table import reference_table
from rl2grid.analysis.summary_table import rich_table
from rl2grid.analysis.table import result_table_rich
from rl2grid.cli import keywords
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.flags import environment_flags, evaluate_command
from rl2grid.evaluation.protocol import evaluate, first_months
from rl2grid.records.collection import LAST_POLICY
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.methods import group_methods
from rl2grid.scenarios.splits import TEST


def run(options: argparse.Namespace) -> int:
    """Evaluate as the flags say.

    Raises:
        UsageError: the request cannot be met; nothing was written.
    """
    task = find_task(options.task)
    agents: Sequence[str] = options.agents
    if len(set(agents)) < len(agents):
        raise UsageError("An agent was named twice: name each once.")
    if options.output is not None and len(agents) > 1:
        raise UsageError("--output is the folder of one agent: leave it out, and each gets a folder of its own.")
    # Before anything is played: one that does not exist would be found after an hour of others.
    names = [_name_of_last(agent, make_agent(agent, task)) for agent in agents]
    results = [_evaluated(agent, name, task, options) for agent, name in zip(agents, names, strict=True)]
    console = Console()
    summaries = [result.summary for result in results]
    console.print(rich_table(summaries, title=f"{task.id}, {options.split} scenarios"))
    for result in results:
        if result.foresight:
            print(
                f"{result.summary.agent} stepped saved true worlds: with this foresight it is not ranked with others."
            )
    if len(results) > 1:
        _compare(results, console)
    if options.split == TEST:
        print("These test months were looked at outside of a ledger, which counts looks: 'rl2grid leaderboard test'.")
    for result in results:
        assert result.folder is not None
        print(f"{len(result.episodes)} episodes in {result.folder / 'episodes.csv'}.")
    return 0


def _name_of_last(agent: str, made: Agent) -> str | None:
    """What tables call the last policy of a run, so that it can stand beside the best; None for other agents."""
    path = Path(agent)
    return f"{made.name} (last)" if path.is_file() and path.stem == LAST_POLICY else None


def _evaluated(agent: str, name: str | None, task: Task, options: argparse.Namespace) -> Evaluation:
    chosen = keywords.given(options)
    return evaluate(
        agent,
        task,
        split=options.split,
        scenarios=None if options.months is None else first_months(task, options.split, options.months),
        seeds=range(options.seeds),
        workers=options.workers,
        output=options.output or _default_output(agent, options, task.id.removeprefix("rl2grid/"), chosen),
        progress=True,
        name=name,
        command=evaluate_command(agent, task, options.split, options.seeds, options.months, chosen),
        **chosen,
    )


def _compare(results: Sequence[Evaluation], console: Console) -> None:
    try:
        (methods,) = group_methods(results).values()
    except UsageError as error:
        print(f"Not compared: {error}")
        return
    if len(methods) < 2:
        return
    # A table cut to the width of a pipe would lose columns.
    wide = console if console.is_terminal else Console(width=120)
    wide.print(result_table_rich(reference_table(methods), title="Paired differences"))


def _default_output(agent: str, options: argparse.Namespace, task: str, chosen: Mapping[str, Any]) -> Path:
    """Inside the run for one of its policies; else by task and agent."""
    parts = [options.split]
    if "heuristic" in chosen:
        parts.append(str(chosen["heuristic"]))
    if options.months is not None:
        parts.append(f"{options.months}-months")
    parts += [flag.removeprefix("--") for flag in environment_flags({**chosen, "heuristic": None})]
    name = "-".join(parts)
    path = Path(agent)
    if path.is_dir():
        return path / "evaluation" / name
    if path.is_file():
        return path.parent / "evaluation" / f"{path.stem}-{name}"
    return Path("runs") / f"{task}-{agent}" / "evaluation" / name
