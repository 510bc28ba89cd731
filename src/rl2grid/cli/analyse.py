"""``rl2grid analyse``: tables and figures of a results section, from evaluations and training runs."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from rl2grid.cli.output import Output
from rl2grid.errors import UsageError
from rl2grid.records.collection import collect
from rl2grid.records.files import check_own
from rl2grid.scenarios.splits import SPLITS

THEMES = ("light", "dark")
SPLIT_HELP = "which evaluations are taken; by default those on validation, and all of a study or the demo"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    parser.add_argument(
        "folders",
        nargs="+",
        metavar="folder",
        help="an evaluation, a study, the demonstration, or a run, whose evaluations on --split are taken too; "
        "LABEL=FOLDER names it",
    )
    parser.add_argument("--output", type=Path, required=True, help="folder of the tables and figures")
    parser.add_argument("--split", default=None, choices=SPLITS, help=SPLIT_HELP)
    parser.add_argument("--theme", default=THEMES[0], choices=THEMES, help="colours of the figures")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, output: Output) -> int:
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

    collection = collect(options.folders, options.split)
    results, runs = collection.evaluations, collection.runs
    try:
        from rl2grid.analysis import section
        from rl2grid.analysis.cautions import cautions
        from rl2grid.drawing import theme as themes
    except ImportError as error:
        raise UsageError(f"Figures need {error.name}: install it with `pip install rl2grid[analysis]`.") from None
    plan = section.plan_section(results, runs)
    check_own(options.output, (section.INDEX_FILE, section.TABLES_FOLDER), "analysis")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with output.progress(*columns, transient=True) as bar:
        task = bar.add_task("Analysing", total=len(plan.tables) + len(plan.pictures))
        index = section.results_section(
            options.output,
            results,
            runs,
            command=_command(options),
            theme=themes.DARK if options.theme == "dark" else themes.LIGHT,
            on_file=lambda name: bar.update(task, advance=1, description=name),
            plan=plan,
        )
    for sentence in (*collection.missing, *cautions(plan.methods)):
        output.remark(sentence)
    output.results(index=index, tables=len(plan.tables), figures=len(plan.pictures), missing=collection.missing)
    output.remark(f"{len(plan.tables)} tables and {len(plan.pictures)} figures, listed in {index}.")
    return 0


def _command(options: argparse.Namespace) -> str:
    words = ["rl2grid", "analyse", *options.folders, "--output", str(options.output)]
    words += [] if options.split is None else ["--split", options.split]
    return shlex.join([*words, "--theme", options.theme])
