"""``rl2grid study``: many trainings and evaluations from one file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from rl2grid.cli.train import INTERRUPTED
from rl2grid.errors import UsageError
from rl2grid.records.logs import LOG_FILE

if TYPE_CHECKING:
    from rl2grid.studies.cells import Study

FAILED = 1
"""Exit status when cells were given up."""


def add_parser(commands: Any) -> None:
    """Add the subcommand to those of ``rl2grid``."""
    parser = commands.add_parser("study", help="run, follow and tune many trainings and evaluations from one file")
    parser.set_defaults(run=lambda options: _print_help(parser))
    actions = parser.add_subparsers(dest="action", metavar="action")
    _add_run(actions)
    _add_status(actions)
    _add_list(actions)
    _add_tune(actions)


def _print_help(parser: argparse.ArgumentParser) -> int:
    parser.print_help()
    return 0


def _add_run(actions: Any) -> None:
    parser = actions.add_parser("run", help="train and evaluate all cells; the same command goes on after a stop")
    _add_file(parser)
    parser.add_argument("--backend", default="local", help="local (default), ray or slurm")
    parser.add_argument("--jobs", type=int, default=None, help="cells at the same time; by default one per core")
    parser.set_defaults(run=_run)


def _add_status(actions: Any) -> None:
    parser = actions.add_parser("status", help="how far the cells are, and what the finished ones reached")
    _add_file(parser)
    parser.set_defaults(run=_status)


def _add_file(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", help="a TOML file, or the name of an included study (rl2grid study list)")
    parser.add_argument("--scale", default=None, help="one of the file's scales; by default the first")
    parser.add_argument("--output", type=Path, default=None, help="folder of everything; by default the file's own")


def _add_list(actions: Any) -> None:
    parser = actions.add_parser("list", help="the included studies")
    parser.set_defaults(run=_list)


def _add_tune(actions: Any) -> None:
    parser = actions.add_parser("tune", help="search for hyperparameters; the same command goes on after a stop")
    parser.add_argument("file", help="a TOML file, see docs/studies.md")
    parser.add_argument("--jobs", type=int, default=None, help="trials at the same time; by default one per core")
    parser.add_argument("--output", type=Path, default=None, help="folder of everything; by default the file's own")
    parser.set_defaults(run=_tune)


def _run(options: argparse.Namespace) -> int:
    study = _load(options)
    from rl2grid.studies.backends import make_backend
    from rl2grid.studies.progress import results_table, study_table
    from rl2grid.studies.run import run_study
    from rl2grid.studies.states import State

    console = Console()
    backend = make_backend(options.backend, study.output / "jobs", options.jobs, study.slurm)
    try:
        states = run_study(study, backend, console)
    except KeyboardInterrupt:
        console.print("Study stopped. The same command goes on.")
        return INTERRUPTED
    if not console.is_terminal:
        console.print(study_table(study, states, None))
    console.print(results_table(states))
    print(f"All episodes are in {study.output / 'episodes.csv'}.")
    failed = [state for state in states if state.state == State.FAILED]
    if failed:
        print(f"{len(failed)} cells failed; their {LOG_FILE} says why. The same command tries them again.")
    return FAILED if failed else 0


def _status(options: argparse.Namespace) -> int:
    study = _load(options)
    from rl2grid.studies.progress import results_table, study_table
    from rl2grid.studies.states import read_states

    console, states = Console(), read_states(study)
    console.print(study_table(study, states, None))
    if any(state.result for state in states):
        console.print(results_table(states))
    return 0


def _list(options: argparse.Namespace) -> int:
    _check_installed()
    from rl2grid.studies.study import included_studies, parse_study
    from rl2grid.studies.toml_file import read_toml

    table = Table(box=None, pad_edge=False)
    for column in ("study", "scale", "cells", "decisions"):
        table.add_column(column, no_wrap=True, justify="left" if column in ("study", "scale") else "right")
    for name, path in included_studies().items():
        contents = read_toml(path)
        for scale in contents.get("scale", {None: {}}):
            cells = parse_study(contents, scale).cells
            table.add_row(name, scale or "", str(len(cells)), f"{sum(cell.decisions for cell in cells):,}")
    Console().print(table)
    return 0


def _tune(options: argparse.Namespace) -> int:
    _check_installed()
    from rl2grid.studies.search import best_command, run_tuning
    from rl2grid.studies.tuning import load_tuning

    tuning = load_tuning(options.file, options.output)
    best = run_tuning(tuning, options.jobs, Console())
    if best is None:
        print("Search stopped. The same command goes on.")
        return INTERRUPTED
    print(f"Best validation survival: {best.survival:.3f} (trial {best.trial}), in {tuning.output / 'best.json'}.")
    print(best_command(tuning, best))
    return 0


def _load(options: argparse.Namespace) -> Study:
    _check_installed()
    from rl2grid.studies.study import load_study

    return load_study(options.file, options.scale, options.output)


def _check_installed() -> None:
    try:
        import torch  # noqa: F401
    except ImportError:
        raise UsageError("Studies need torch: install it with `pip install rl2grid[train]`.") from None
