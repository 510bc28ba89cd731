"""``rl2grid report``: everything that evaluations, runs and studies say, as one HTML page."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

from rl2grid.cli.analyse import SPLIT_HELP
from rl2grid.cli.output import Output
from rl2grid.envs.tasks import short_id
from rl2grid.errors import UsageError
from rl2grid.records.collection import Collection, collect
from rl2grid.records.files import make_own_folder
from rl2grid.records.trainings import TrainingRun
from rl2grid.scenarios.splits import SPLITS

PAGE_FILE = "report.html"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    parser.add_argument(
        "folders",
        nargs="+",
        metavar="folder",
        help="a study, an evaluation, the demonstration, or a run, whose evaluations on --split are taken too; "
        "LABEL=FOLDER names it",
    )
    parser.add_argument("--output", type=Path, default=Path("report"), help="folder of the page")
    parser.add_argument("--split", default=None, choices=SPLITS, help=SPLIT_HELP)
    parser.add_argument("--title", default=None, help="headline; by default what was played")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, output: Output) -> int:
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

    collection = collect(options.folders, options.split)
    try:
        from rl2grid.analysis import section
        from rl2grid.analysis.cautions import cautions
        from rl2grid.analysis.report import write_report
    except ImportError as error:
        raise UsageError(f"Reports need {error.name}: install it with `pip install rl2grid[analysis]`.") from None
    plan = section.plan_section(collection.evaluations, collection.runs)
    number = len(plan.pictures)
    train_commands = _train_commands(collection.runs)
    path = options.output / PAGE_FILE
    make_own_folder(options.output, (PAGE_FILE,), "report")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with output.progress(*columns, transient=True) as bar:
        task = bar.add_task("Drawing", total=number)
        size = write_report(
            path,
            collection,
            title=options.title or _title(collection),
            command=_command(options),
            train_commands=train_commands,
            on_figure=lambda name: bar.update(task, advance=1, description=name),
            plan=plan,
        )
    for sentence in (*collection.missing, *cautions(plan.methods)):
        output.remark(sentence)
    episodes = sum(len(result.episodes) for result in collection.evaluations)
    output.results(page=path, figures=number, episodes=episodes, missing=collection.missing)
    output.remark(f"{number} figures, {episodes:,} episodes.")
    output.remark(f"Written: {path} ({size / 1e6:.1f} MB).")
    return 0


def _train_commands(runs: Sequence[TrainingRun]) -> dict[Path, str]:
    if not runs:
        return {}
    try:
        from rl2grid.training.commands import training_command
    except ImportError as error:
        raise UsageError(f"Reports of runs need {error.name}: install it with `pip install rl2grid[train]`.") from None
    return {run.folder: training_command(run.folder) for run in runs}


def _title(collection: Collection) -> str:
    tasks = list(
        dict.fromkeys(
            [
                *(str(result.identity["task"]) for result in collection.evaluations),
                *(run.task for run in collection.runs),
            ]
        )
    )
    if len(tasks) > 3:
        return f"Results on {len(tasks)} tasks"
    return f"Results on {', '.join(short_id(task) for task in tasks)}"


def _command(options: argparse.Namespace) -> str:
    words = ["rl2grid", "report", *options.folders, "--output", str(options.output)]
    words += [] if options.split is None else ["--split", options.split]
    return shlex.join([*words, *([] if options.title is None else ["--title", options.title])])
