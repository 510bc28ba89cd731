"""``rl2grid evaluate``: play agents on enumerated scenarios, print the aggregates, keep every episode, compare."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rl2grid.agents.agent import Agent
from rl2grid.agents.planner import Planner
from rl2grid.analysis.comparison_table import reference_table
from rl2grid.analysis.summary_table import summary_table
from rl2grid.analysis.table import table_records
from rl2grid.cli import keywords
from rl2grid.cli.output import Output
from rl2grid.cli.scoring import add_scores_flag, scored_table
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.flags import environment_flags, evaluate_command, flag_of
from rl2grid.evaluation.places import default_folder
from rl2grid.evaluation.protocol import check_playable, evaluate
from rl2grid.records.collection import LAST_POLICY
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.methods import Method, group_methods
from rl2grid.scenarios.splits import SPLITS, TEST


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    parser.add_argument(
        "agents",
        nargs="+",
        metavar="agent",
        help=f"{keywords.AGENT_HELP}; several are compared with the first on the same months",
    )
    parser.add_argument("task", help="for example bus14-T0")
    parser.add_argument("--split", default="validation", choices=SPLITS, help="validation picks models; test is last")
    parser.add_argument(
        "--months", type=int, default=None, help="the first of the split, balanced over the seasons; by default all"
    )
    parser.add_argument("--seeds", type=int, default=1, help="episodes per scenario, with seeds 0, 1, ...")
    keywords.add_flags(parser)
    parser.add_argument(
        "--workers",
        type=int,
        default=None,
        help="processes; by default this one for few native episodes, or one per core",
    )
    parser.add_argument(
        "--seconds", type=float, default=None, help="that the planner may search per decision; by default unlimited"
    )
    keywords.add_looking(parser)
    parser.add_argument("--output", type=Path, default=None, help="folder of the results of one agent")
    add_scores_flag(parser)
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, output: Output) -> int:
    task = find_task(options.task)
    agents: Sequence[str] = options.agents
    if options.seeds < 1:
        raise UsageError(f"--seeds {options.seeds} is not allowed: give a number of episodes per month, at least 1.")
    if len(set(agents)) < len(agents):
        raise UsageError("An agent was named twice: name each once.")
    if options.output is not None and len(agents) > 1:
        raise UsageError("--output is the folder of one agent: leave it out, and each gets a folder of its own.")
    if options.seconds is not None and Planner.called not in agents:
        raise UsageError(f"--seconds is for the agent planner, which searches: leave it out for {', '.join(agents)}.")
    # Before anything is played: one that does not exist, or cannot play it, would be found after an hour of others.
    made = [_made(agent, task, options) for agent in agents]
    for agent in agents:
        check_playable(_made(agent, task, options), task, {**keywords.given(options), "split": options.split})
    results = [_evaluated(agent, one, task, options, output) for agent, one in zip(agents, made, strict=True)]
    summaries = [result.summary for result in results]
    records = [asdict(result.summary) | {"folder": result.folder} for result in results]
    length = results[0].identity.get("episode_length")
    of_length = "" if length is None else f", episodes of {length} steps"
    output.table(summary_table(summaries), records, title=f"{task.id}, {options.split} scenarios{of_length}")
    for result in results:
        if result.foresight:
            output.remark(
                f"{result.summary.agent} stepped saved true worlds: with this foresight it is not ranked with others."
            )
    if options.l2rpn:
        table = scored_table([Method((result,)) for result in results], output)
        output.table(table, table_records(table), title="Scores of the L2RPN competitions")
    ranked = [result for result in results if not result.foresight]
    if len(ranked) > 1:
        _compare(ranked, output)
    if options.split == TEST:
        output.remark(
            "These test months were looked at outside of a ledger, which counts looks: 'rl2grid leaderboard test'."
        )
    for result in results:
        assert result.folder is not None
        output.remark(f"{len(result.episodes)} episodes in {result.folder / 'episodes.csv'}.")
    return 0


def _made(agent: str, task: Task, options: argparse.Namespace) -> Agent:
    if agent == Planner.called and options.seconds is not None:
        return Planner(seconds=options.seconds)
    return make_agent(agent, task, **keywords.looking(options))


def _own_flags(agent: str, options: argparse.Namespace) -> dict[str, str]:
    """Flags that say how this agent decides, and their values."""
    flags: dict[str, float] = {flag_of(name): value for name, value in keywords.looking(options).items()}
    if agent == Planner.called and options.seconds is not None:
        flags["seconds"] = options.seconds
    return {name: f"{value:g}" for name, value in flags.items()}


def _name_of_last(agent: str, made: Agent) -> str | None:
    """What tables call the last policy of a run, so that it can stand beside the best; None for other agents."""
    path = Path(agent)
    return f"{made.name} (last)" if path.is_file() and path.stem == LAST_POLICY else None


def _evaluated(agent: str, made: Agent, task: Task, options: argparse.Namespace, output: Output) -> Evaluation:
    chosen = keywords.given(options)
    command = evaluate_command(agent, task, options.split, options.seeds, options.months, chosen)
    own = _own_flags(agent, options)
    return evaluate(
        made if own else agent,
        task,
        split=options.split,
        months=options.months,
        seeds=range(options.seeds),
        workers=options.workers,
        output=options.output or _default_output(agent, made, options, task, chosen),
        progress=output.talks,
        name=_name_of_last(agent, made),
        command=" ".join([command, *(f"--{name} {value}" for name, value in own.items())]),
        **chosen,
    )


def _compare(results: Sequence[Evaluation], output: Output) -> None:
    try:
        (methods,) = group_methods(results).values()
    except UsageError as error:
        output.remark(f"Not compared: {error}")
        return
    if len(methods) > 1:
        table = reference_table(methods)
        output.table(table, table_records(table), title="Paired differences")


def _default_output(
    agent: str, made: Agent, options: argparse.Namespace, task: Task, chosen: Mapping[str, Any]
) -> Path:
    parts = [options.split]
    if "heuristic" in chosen:
        parts.append(str(chosen["heuristic"]))
    if options.months is not None:
        parts.append(f"{options.months}-months")
    parts += [f"{value}-{name}" for name, value in _own_flags(agent, options).items()]
    parts += [flag.removeprefix("--") for flag in environment_flags({**chosen, "heuristic": None})]
    return default_folder(agent, made, task, "evaluation", "-".join(parts))
