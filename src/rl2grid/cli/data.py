"""``rl2grid data``: what series there are, making, importing, exporting, checking and downloading them."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.filesize import decimal
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from rl2grid.analysis.table import Cell, Column, ResultTable
from rl2grid.cli.output import Output
from rl2grid.errors import UsageError
from rl2grid.grids import Grid, load_grid, system_ids
from rl2grid.scenarios import generated, inventory, published
from rl2grid.scenarios.cache import data_folder, remove_damaged, series_folder
from rl2grid.scenarios.download import download_dataset, find_archive
from rl2grid.scenarios.export import export_scenario
from rl2grid.scenarios.full import VARIABLE, full_data_folder
from rl2grid.scenarios.library import import_folder, load_scenario
from rl2grid.scenarios.making import make_packs
from rl2grid.scenarios.month_names import MONTHS, month_name, parse_months
from rl2grid.scenarios.progress import Report
from rl2grid.scenarios.splits import HELD_OUT_SPLITS, TRAIN, TRAINING_SEEDS

ALL_MONTHS = "0-11"
REFUSED = 1
"""Exit status when files could not be removed."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the actions of the command."""
    actions = parser.add_subparsers(dest="action", metavar="action")
    _add_list(actions)
    _add_make(actions)
    _add_import(actions)
    _add_export(actions)
    _add_check(actions)
    _add_clean(actions)
    _add_download(actions)


def _add_list(actions: Any) -> None:
    parser = actions.add_parser("list", help="what there is, and how much space it takes")
    parser.add_argument("grid", nargs="?", default=None, help="only this grid")
    parser.set_defaults(run=_list)


def _list(options: argparse.Namespace, output: Output) -> int:
    grids = [load_grid(grid_id) for grid_id in (system_ids() if options.grid is None else (options.grid,))]
    found = []
    for grid in grids:
        _remove_damaged(grid, output)
        found += [(grid.id, stored) for stored in inventory.inventory(grid)]
    words = ("grid", "source", "what", "size", "where")
    values = [(grid, each.kind, each.what, each.size, str(each.place)) for grid, each in found]
    records = [dict(zip(words, each, strict=True)) for each in values]
    rows = tuple(tuple(map(Cell, (grid, kind, what, decimal(size), where))) for grid, kind, what, size, where in values)
    columns = tuple(Column(name, words=name != "size") for name in words)
    output.table(ResultTable("scenarios", "", columns, rows), records, title="Scenarios on this machine")
    size = inventory.caches_size()
    output.results(data_folder=data_folder(), caches_size=size)
    output.remark(f"Caches in {data_folder()} take {decimal(size)}; `rl2grid data clean` removes them.")
    return 0


def _add_make(actions: Any) -> None:
    parser = actions.add_parser("make", help="make generated months before they are needed")
    parser.add_argument("grid", help="for example bus14")
    wanted = parser.add_mutually_exclusive_group(required=True)
    wanted.add_argument("--seed", type=int, default=None, help="seed of the year")
    wanted.add_argument("--split", default=None, choices=(TRAIN, *HELD_OUT_SPLITS), help="months of a split")
    parser.add_argument(
        "--months",
        default=None,
        help=f"of the year, as 0-11 or 0,3,6 (default {ALL_MONTHS}); of a split, how many (default all)",
    )
    parser.add_argument("--workers", type=int, default=None, help="processes; by default one per core")
    parser.set_defaults(run=_make)


def _make(options: argparse.Namespace, output: Output) -> int:
    grid = load_grid(options.grid)
    workers = _workers(options.workers)
    months = _wanted_months(options)
    with _progress(output, MofNCompleteColumn(), _Rate("/min", 60.0), TimeRemainingColumn()) as bar:
        task = bar.add_task(f"Making months of {grid.id}", total=len(months))
        for done in make_packs(grid, months, workers):
            bar.update(task, completed=done)
    in_library = options.split == TRAIN or options.seed in TRAINING_SEEDS
    folder = series_folder(grid.id) if in_library else generated.pack_folder(grid)
    output.results(grid=grid.id, months=len(months), folder=folder)
    output.remark(f"{len(months):,} months of {grid.id} are in {folder}.")
    if options.split == TRAIN:
        return 0
    _compare_with_published(output, grid, [month_name(*month) for month in months])
    return 0


def _wanted_months(options: argparse.Namespace) -> list[tuple[int, int]]:
    if options.split is None:
        if not 0 <= options.seed < 2**63:
            raise UsageError(f"Seed {options.seed} is no seed of a year: choose an integer from 0 to 2^63 - 1.")
        return [(options.seed, month) for month in _month_numbers(options.months or ALL_MONTHS)]
    if options.split == TRAIN:
        if options.months is not None:
            raise UsageError("Training months are made a year at a time, all of them: leave --months out.")
        return [(seed, month) for seed in TRAINING_SEEDS for month in range(MONTHS)]
    names = HELD_OUT_SPLITS[options.split]
    number = options.months or str(len(names))
    if not number.isdecimal() or not 1 <= int(number) <= len(names):
        raise UsageError(f"The split {options.split} has no first {number} months: choose from 1 to {len(names)}.")
    months = [parse_months(name) for name in names[: int(number)]]
    return [(each.seed, each.first) for each in months]


def _month_numbers(text: str) -> list[int]:
    numbers: set[int] = set()
    try:
        for part in text.split(","):
            first, _, last = part.partition("-")
            numbers |= set(range(int(first), int(last or first) + 1))
    except ValueError:
        numbers = set()
    if not numbers or not numbers <= set(range(MONTHS)):
        raise UsageError(f"Months {text!r} do not exist: give numbers from 0 to 11, as 0-11 or 0,3,6.")
    return sorted(numbers)


def _workers(asked: int | None) -> int:
    if asked is None:
        return len(os.sched_getaffinity(0))
    if asked < 1:
        raise UsageError(f"--workers {asked} is not allowed: at least 1 process is needed.")
    return asked


def _add_import(actions: Any) -> None:
    parser = actions.add_parser("import", help="check and keep a Grid2Op scenario folder")
    parser.add_argument("grid", help="for example bus14")
    parser.add_argument("folder", type=Path, help="a folder with load_p.csv or load_p.csv.bz2 and its companions")
    parser.set_defaults(run=_import)


def _import(options: argparse.Namespace, output: Output) -> int:
    grid = load_grid(options.grid)
    with _progress(output, DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn()) as bar:
        scenario = import_folder(grid, options.folder, _reporting(bar, f"Reading {options.folder}"))
    output.results(scenario=scenario.id, rows=scenario.n_rows, start=str(scenario.start_datetime))
    output.remark(f"Imported {scenario.id}: {scenario.n_rows:,} rows from {scenario.start_datetime:%Y-%m-%d %H:%M}.")
    return 0


def _add_export(actions: Any) -> None:
    parser = actions.add_parser("export", help="write a scenario as a folder that Grid2Op plays")
    parser.add_argument("grid", help="for example bus14")
    parser.add_argument("scenario", help="for example generated/17-03 or bundled/0000")
    parser.add_argument("folder", type=Path, help="folder to be made")
    parser.set_defaults(run=_export)


def _export(options: argparse.Namespace, output: Output) -> int:
    grid = load_grid(options.grid)
    scenario = load_scenario(grid.id, options.scenario)
    with _progress(output, TaskProgressColumn(), _Rate(" values/s", 1.0), TimeRemainingColumn()) as bar:
        folder = export_scenario(grid, scenario, options.folder, _reporting(bar, f"Writing {options.folder}"))
    output.results(scenario=scenario.id, rows=scenario.n_rows, folder=folder)
    output.remark(
        f"Wrote {scenario.n_rows:,} rows of {scenario.id} to {folder} ({decimal(inventory.size_of(folder))})."
    )
    return 0


def _add_check(actions: Any) -> None:
    parser = actions.add_parser("check", help="compare generated with bundled series on a page with plots")
    parser.add_argument("grid", help="for example bus14")
    parser.add_argument("--years", type=int, default=2, help="generated years to compare, with seeds 0, 1, ...")
    parser.add_argument("--output", type=Path, default=None, help="page; by default reports/scenarios-<grid>.html")
    parser.set_defaults(run=_check)


def _check(options: argparse.Namespace, output: Output) -> int:
    grid = load_grid(options.grid)
    if options.years < 1:
        raise UsageError(f"--years {options.years} is not allowed: at least 1 is needed.")
    try:
        from rl2grid.analysis import scenario_check
    except ImportError as error:
        raise UsageError(f"The page needs {error.name}: install it with `pip install rl2grid[analysis]`.") from None
    _remove_damaged(grid, output)
    _compare_with_published(output, grid, published.held_out_months())
    page = options.output or Path("reports") / f"scenarios-{grid.id}.html"
    wanted = scenario_check.wanted_scenarios(grid, options.years)
    samples = []
    with _progress(output, MofNCompleteColumn(), TimeRemainingColumn()) as bar:
        for scenario_id in bar.track(wanted, description=f"Reading series of {grid.id}"):
            samples.append(scenario_check.measure(grid, load_scenario(grid.id, scenario_id)))
    comparison = scenario_check.compare(grid, samples)
    scenario_check.write_page(comparison, page)
    output.table(scenario_check.check_table(comparison), title=f"Series of {grid.id}")
    output.results(page=page)
    output.remark(f"Page written to {page}.")
    return 0


def _add_clean(actions: Any) -> None:
    parser = actions.add_parser("clean", help="remove what can be made again")
    parser.add_argument("--yes", action="store_true", help="do not ask")
    parser.set_defaults(run=_clean)


def _clean(options: argparse.Namespace, output: Output) -> int:
    n_bytes = inventory.caches_size()
    size = decimal(n_bytes)
    where = f"expanded copies and generated months in {data_folder()}"
    if not options.yes:
        if not sys.stdin.isatty():
            raise UsageError(f"The {where} ({size}) were left alone, since nobody can be asked: add --yes.")
        if input(f"Remove the {where} ({size})? They are made again when needed. [y/N] ").strip().lower() != "y":
            output.text("Nothing was removed.")
            output.results(removed=0)
            return 0
    removed = inventory.remove_caches()
    output.results(removed=removed.size, in_use=removed.in_use, refused=removed.refused)
    output.remark(f"Removed the {where}: {decimal(removed.size)}.")
    if removed.in_use:
        output.remark(f"{removed.in_use} files that another process is making were left alone.")
    if removed.refused:
        print(f"rl2grid: {removed.refused} files may not be removed by this user.", file=sys.stderr)
    return REFUSED if removed.refused else 0


def _add_download(actions: Any) -> None:
    parser = actions.add_parser("download", help="fetch the full dataset of a grid from where Grid2Op offers it")
    parser.add_argument("grid", help="for example bus14")
    parser.add_argument("--folder", type=Path, default=None, help="where datasets are kept; by default ~/data_grid2op")
    parser.set_defaults(run=_download)


def _download(options: argparse.Namespace, output: Output) -> int:
    grid = load_grid(options.grid)
    folder: Path = options.folder or full_data_folder()
    archive = find_archive(grid.grid2op_name)
    with _progress(output, DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn()) as bar:
        target = download_dataset(grid, folder, archive, _reporting(bar, f"Downloading {grid.grid2op_name}"))
    output.results(folder=target)
    output.remark(f"Dataset of {grid.id} in {target}. To play it: export {VARIABLE}={folder}")
    return 0


def _remove_damaged(grid: Grid, output: Output) -> None:
    for copy in remove_damaged(grid.id):
        output.remark(f"Removed {copy}, which was damaged; it is made again when needed.")


def _compare_with_published(output: Output, grid: Grid, names: Sequence[str]) -> None:
    comparison = published.compare_with_published(grid, names)
    output.results(deviations=[str(deviation) for deviation in comparison.deviations])
    for deviation in comparison.deviations:
        output.text(str(deviation))
    if comparison.months and not comparison.deviations:
        output.remark(f"{comparison.months} held-out months of {grid.id} are as they were published.")


class _Rate(ProgressColumn):
    """What is done in a unit of time."""

    def __init__(self, unit: str, seconds: float) -> None:
        super().__init__()
        self._unit, self._seconds = unit, seconds

    def render(self, task: Any) -> str:
        if task.speed is None:
            return ""
        rate = self._seconds * task.speed
        return f"{rate:,.0f}{self._unit}" if rate >= 100 else f"{rate:.1f}{self._unit}"


def _reporting(bar: Progress, description: str) -> Report:
    """A task on ``bar`` that shows what it is told."""
    task = bar.add_task(description, total=None)
    return lambda done, total: bar.update(task, completed=done, total=total)


@contextlib.contextmanager
def _progress(output: Output, *columns: ProgressColumn) -> Iterator[Progress]:
    shown: Sequence[ProgressColumn] = (TextColumn("{task.description}"), BarColumn(), *columns)
    bar = output.progress(*shown)
    bar.start()
    try:
        yield bar
    except UsageError:
        bar.live.transient = True  # All that stays is the sentence that says why.
        raise
    finally:
        bar.stop()
