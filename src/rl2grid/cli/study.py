"""``rl2grid study``: many trainings and evaluations from one file."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl2grid.analysis.table import Cell, Column, ResultTable
from rl2grid.cli.main import INTERRUPTED
from rl2grid.cli.output import Output
from rl2grid.errors import UsageError
from rl2grid.records.logs import LOG_FILE

if TYPE_CHECKING:
    from rl2grid.studies.cells import Study
    from rl2grid.studies.states import CellState

FAILED = 1
"""Exit status when cells were given up."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    actions = parser.add_subparsers(dest="action", metavar="action")
    _add_run(actions)
    _add_status(actions)
    _add_list(actions)
    _add_tune(actions)


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


def _run(options: argparse.Namespace, output: Output) -> int:
    study = _load(options)
    from rich.console import Console

    from rl2grid.studies.backends import make_backend
    from rl2grid.studies.run import run_study
    from rl2grid.studies.states import State

    console = Console(stderr=True)
    backend = make_backend(options.backend, study.output / "jobs", options.jobs, study.slurm)
    try:
        states = run_study(study, backend, console if output.talks else None)
    except KeyboardInterrupt:
        console.print("Study stopped. The same command goes on.")
        return INTERRUPTED
    _show(study, states, output)
    episodes = study.output / "episodes.csv"
    output.results(episodes=episodes)
    output.remark(f"All episodes are in {episodes}.")
    failed = [state for state in states if state.state == State.FAILED]
    if failed:
        output.text(f"{len(failed)} cells failed; their {LOG_FILE} says why. The same command tries them again.")
    return FAILED if failed else 0


def _status(options: argparse.Namespace, output: Output) -> int:
    study = _load(options)
    from rl2grid.studies.states import read_states

    _show(study, read_states(study), output)
    return 0


def _show(study: Study, states: Sequence[CellState], output: Output) -> None:
    """How far the cells are, why some failed, and what the finished ones reached."""
    from rl2grid.studies.progress import cells_table, failures, headline, results_table

    output.results(study=study.name, scale=study.scale, cells=[_record(state) for state in states])
    if output.json:
        return
    output.text(headline(study, states, None))
    for table in (cells_table(states), results_table(states)):
        if table.rows:
            output.table(table)
    for sentence in failures(states):
        output.text(sentence)


def _record(state: CellState) -> dict[str, Any]:
    record = {"cell": state.cell.name, "state": state.state, "share": state.share, "error": state.error or None}
    return record if state.result is None else record | vars(state.result)


def _list(options: argparse.Namespace, output: Output) -> int:
    _check_installed()
    from rl2grid.studies.study import included_studies, parse_study
    from rl2grid.studies.toml_file import read_toml

    records = []
    for name, path in included_studies().items():
        contents = read_toml(path)
        for scale in contents.get("scale", {None: {}}):
            cells = parse_study(contents, scale).cells
            decisions = sum(cell.decisions for cell in cells)
            records.append({"study": name, "scale": scale, "cells": len(cells), "decisions": decisions})
    columns = (Column("study", words=True), Column("scale", words=True), Column("cells"), Column("decisions"))
    rows = tuple(
        tuple(map(Cell, (each["study"], each["scale"] or "", str(each["cells"]), f"{each['decisions']:,}")))
        for each in records
    )
    output.table(ResultTable("studies", "", columns, rows), records)
    return 0


def _tune(options: argparse.Namespace, output: Output) -> int:
    _check_installed()
    from rich.console import Console

    from rl2grid.studies.search import best_command, run_tuning
    from rl2grid.studies.tuning import load_tuning

    tuning = load_tuning(options.file, options.output)
    best = run_tuning(tuning, options.jobs, Console(stderr=True) if output.talks else None)
    if best is None:
        print("Search stopped. The same command goes on.", file=sys.stderr)
        return INTERRUPTED
    output.results(best=best, command=best_command(tuning, best), file=tuning.output / "best.json")
    output.text(
        f"Best validation survival: {best.survival:.3f} (trial {best.trial}), in {tuning.output / 'best.json'}."
    )
    output.text(best_command(tuning, best))
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
