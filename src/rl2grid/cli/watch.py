"""``rl2grid watch``: play one episode, and write it as a page with a time slider and as an animation."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from rl2grid.cli import keywords
from rl2grid.cli.main import INTERRUPTED
from rl2grid.cli.output import Output
from rl2grid.engines import HEURISTICS
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.records.files import check_folder, in_file_name, make_folder
from rl2grid.scenarios.splits import SPLITS

if TYPE_CHECKING:
    from rich.progress import Progress

    from rl2grid.records.recordings import Recording

FRAMES = 300
"""Frames of an animation unless --every is given: 25 seconds."""
FORMATS = ("html", "gif", "mp4")


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    parser.add_argument("agent", help=keywords.AGENT_HELP)
    parser.add_argument("task", help="for example bus14-T0")
    parser.add_argument(
        "--against", nargs="+", default=[], metavar="AGENT", help="others who play the same month, on the same page"
    )
    parser.add_argument("--split", default="validation", choices=SPLITS)
    parser.add_argument("--scenario", default=None, help="by default the first of the split")
    parser.add_argument("--seed", type=int, default=0, help="of maintenance, opponent and agent")
    parser.add_argument("--heuristic", default=None, choices=("None", *HEURISTICS), help="by default the agent's own")
    parser.add_argument("--steps", type=int, default=None, help="play no more grid steps than these")
    keywords.add_looking(parser, "; those of --against do not look")
    parser.add_argument(
        "--every", type=int, default=None, help=f"grid steps between two frames; by default at most {FRAMES} frames"
    )
    parser.add_argument("--format", nargs="+", default=["html", "gif"], choices=FORMATS, help="by default html and gif")
    parser.add_argument("--output", type=Path, default=Path("watched"), help="folder of the files")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, output: Output) -> int:
    task = find_task(options.task)
    if options.every is not None and options.every < 1:
        raise UsageError(f"every={options.every} is not allowed: give a number of grid steps, at least 1.")
    animation, watch_page = _drawing_modules()
    _check_agents(task, options)
    for suffix in options.format:
        animation.check_encoder(suffix)
    check_folder(options.output)
    try:
        with _progress(output) as progress:
            recordings = [_play(agent, task, options, looking, progress) for agent, looking in _players(options)]
            make_folder(options.output)
            files = _files(task, recordings, options)
            there = {file for file in files if file.exists()}
            for file, shown in files.items():
                if file.suffix == ".html":
                    watch_page.write_watch_page(file, task.grid, shown)
                    continue
                steps = _frame_steps(len(shown[0].rho), options.every)
                pictures = animation.frames(task.grid, shown[0], steps)
                drawing = f"Drawing {file.suffix[1:]}"
                animation.write_animation(file, progress.track(pictures, len(steps), description=drawing))
    except KeyboardInterrupt:
        print("rl2grid: interrupted; no file was left half written.", file=sys.stderr)
        return INTERRUPTED
    _tell(output, recordings, watch_page.labels_of(recordings))
    for file in files:
        output.remark(f"{'Replaced' if file in there else 'Written'}: {file}")
    results = [_result(recording) for recording in recordings]
    others = {"against": results[1:]} if len(results) > 1 else {}
    output.results(**results[0], **others, files=[str(file) for file in files])
    return 0


def _check_agents(task: Task, options: argparse.Namespace) -> None:
    """Refuse agents that are not to be had, or cannot play the task, before the first of several has played."""
    from rl2grid.evaluation.agents import make_agent
    from rl2grid.evaluation.protocol import check_playable

    asked = {"split": options.split, "heuristic": _heuristic(options)}
    for agent, looking in _players(options):
        check_playable(make_agent(agent, task, **looking), task, asked)


def _players(options: argparse.Namespace) -> list[tuple[str, dict[str, int]]]:
    """Who plays, and how it looks before it acts."""
    return [(options.agent, keywords.looking(options)), *((agent, {}) for agent in options.against)]


def _files(task: Task, recordings: Sequence[Recording], options: argparse.Namespace) -> dict[Path, list[Recording]]:
    """What is to be written, and of whom: one page of all agents, and an animation of each."""
    begin, first = task.id.removeprefix("rl2grid/"), recordings[0]
    end = f"{first.scenario.replace('/', '-')}-{options.seed}"
    agents = [f"{k + 1}-{each.agent}" if len(recordings) > 1 else each.agent for k, each in enumerate(recordings)]
    files: dict[Path, list[Recording]] = {}
    for suffix in options.format:
        if suffix == "html":
            together = in_file_name("-against-".join(each.agent for each in recordings))
            files[options.output / f"{begin}-{together}-{end}.html"] = list(recordings)
            continue
        for agent, recording in zip(agents, recordings, strict=True):
            files[options.output / f"{begin}-{in_file_name(agent)}-{end}.{suffix}"] = [recording]
    return files


def _tell(output: Output, recordings: Sequence[Recording], labels: Sequence[str]) -> None:
    for recording, label in zip(recordings, labels, strict=True):
        ending = f"game over: {recording.game_over}" if recording.game_over else "alive at the end"
        who = f"{label}: " if len(recordings) > 1 else ""
        output.text(
            f"{who}{recording.n_steps:,} of {recording.episode_length:,} steps, {recording.n_acts:,} actions; {ending}."
        )


def _result(recording: Recording) -> dict[str, Any]:
    return {
        "steps": recording.n_steps,
        "episode_length": recording.episode_length,
        "actions": recording.n_acts,
        "game_over": recording.game_over or None,
    }


def _play(
    agent: str, task: Task, options: argparse.Namespace, looking: dict[str, int], progress: Progress
) -> Recording:
    from rl2grid.evaluation.watching import play_to_watch

    playing = progress.add_task("Playing", total=None)
    return play_to_watch(
        agent,
        task,
        split=options.split,
        scenario=options.scenario,
        seed=options.seed,
        heuristic=_heuristic(options),
        steps=options.steps,
        **looking,
        on_step=lambda step, length: progress.update(
            playing, completed=step, total=min(length, options.steps or length)
        ),
    )


def _heuristic(options: argparse.Namespace) -> str | None:
    from rl2grid.evaluation.protocol import AS_TRAINED

    given: str | None = options.heuristic
    return {None: AS_TRAINED, "None": None}.get(given, given)


def _frame_steps(n_rows: int, every: int | None) -> Sequence[int]:
    """Steps that are drawn: the last one always."""
    stride = every or -(-n_rows // FRAMES)
    steps = list(range(0, n_rows, stride))
    return steps if steps[-1] == n_rows - 1 else [*steps, n_rows - 1]


def _progress(output: Output) -> Progress:
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    return output.progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())


def _drawing_modules() -> tuple[ModuleType, ModuleType]:
    try:
        from rl2grid.analysis import animation, watch_page
    except ImportError as error:
        raise UsageError(f"Watching needs {error.name}: install it with `pip install rl2grid[analysis]`.") from None
    return animation, watch_page
