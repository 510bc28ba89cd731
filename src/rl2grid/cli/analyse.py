"""``rl2grid analyse``: tables and figures of a results section, from evaluations and training runs."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from rl2grid.analysis.results import EVALUATION_FILE, EvaluationResult, load_evaluation
from rl2grid.analysis.training import RUN_FILE, TrainingRun, read_training_run
from rl2grid.errors import UsageError
from rl2grid.scenarios.splits import SPLITS

if TYPE_CHECKING:
    from collections.abc import Sequence

THEMES = ("light", "dark")


def add_parser(commands: Any) -> None:
    """Add the subcommand to those of ``rl2grid``."""
    parser = commands.add_parser("analyse", help="tables and figures from evaluations and training runs")
    parser.add_argument(
        "folders",
        nargs="+",
        metavar="folder",
        help="an evaluation, or a run, whose evaluations on --split are taken too; LABEL=FOLDER names it",
    )
    parser.add_argument("--output", type=Path, required=True, help="folder of the tables and figures")
    parser.add_argument("--split", default="validation", choices=SPLITS, help="which evaluations of a run are taken")
    parser.add_argument("--theme", default=THEMES[0], choices=THEMES, help="colours of the figures")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    results, runs = _load(options.folders, options.split)
    try:
        from rl2grid.analysis import section
        from rl2grid.drawing import theme as themes
    except ImportError as error:
        raise UsageError(f"Figures need {error.name}: install it with `pip install rl2grid[analysis]`.") from None
    plan = section.plan_section(results, runs)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, transient=True) as bar:
        task = bar.add_task("Analysing", total=len(plan.tables) + len(plan.pictures))
        index = section.results_section(
            options.output,
            results,
            runs,
            command=_command(options),
            theme=themes.DARK if options.theme == "dark" else themes.LIGHT,
            on_file=lambda name: bar.update(task, advance=1, description=name),
        )
    print(f"{len(plan.tables)} tables and {len(plan.pictures)} figures, listed in {index}.")
    return 0


def _load(folders: Sequence[str], split: str) -> tuple[list[EvaluationResult], list[TrainingRun]]:
    """Evaluations and runs, in the order given."""
    results: list[EvaluationResult] = []
    runs: list[TrainingRun] = []
    for words in folders:
        label, folder = _parse(words)
        evaluations = _evaluations(folder, split)
        results += [_named(load_evaluation(evaluation), label) for evaluation in evaluations]
        if (folder / RUN_FILE).is_file():
            runs.append(read_training_run(folder, label))
        elif not evaluations:
            raise UsageError(
                f"{folder} holds neither a run nor an evaluation on {split}: give folders that 'rl2grid train' or "
                "'rl2grid evaluate' wrote."
            )
    return results, runs


def _evaluations(folder: Path, split: str) -> list[Path]:
    """The folder itself, or those below it of the split, which 'rl2grid evaluate' names after what else was asked."""
    if (folder / EVALUATION_FILE).is_file():
        return [folder]
    below = (folder / "evaluation").glob(f"{split}*")
    return sorted(path for path in below if (path / EVALUATION_FILE).is_file())


def _parse(words: str) -> tuple[str | None, Path]:
    """Label and folder; a folder whose own name has an equals sign is a folder."""
    label, equals, folder = words.partition("=")
    if not equals or Path(words).exists():
        return None, Path(words)
    if not label or not folder:
        raise UsageError(f"{words!r} is not allowed: give FOLDER or LABEL=FOLDER.")
    return label, Path(folder)


def _named(result: EvaluationResult, label: str | None) -> EvaluationResult:
    if label is None:
        return result
    return replace(result, episodes=tuple(replace(episode, agent=label) for episode in result.episodes))


def _command(options: argparse.Namespace) -> str:
    words = ["rl2grid", "analyse", *options.folders, "--output", str(options.output), "--split", options.split]
    return shlex.join([*words, "--theme", options.theme])
