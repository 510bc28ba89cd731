"""``rl2grid actions``: the actions of a level, one of them explained and drawn, and figures of action spaces."""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import rich.box
from rich.console import Console
from rich.table import Table

from rl2grid.analysis.action_space import ActionRow, explain_action, list_actions, select_actions
from rl2grid.errors import UsageError
from rl2grid.grids import Grid, load_grid
from rl2grid.mdp.actions import StepAction, full_catalogue
from rl2grid.records.files import make_folder

SHOWN = 50
"""Actions listed unless --all is given."""


def add_parser(commands: Any) -> None:
    """Add the subcommand to those of ``rl2grid``."""
    parser = commands.add_parser("actions", help="list, explain and draw a grid's topology actions")
    parser.add_argument("grid", help="for example bus14")
    parser.add_argument("--level", type=int, default=0, help="difficulty level (default 0)")
    parser.add_argument("--substation", type=int, default=None, help="only moves at this substation")
    parser.add_argument("--line", type=int, default=None, help="only the switch of this line and moves of its ends")
    parser.add_argument("--all", action="store_true", help=f"list every action, not only the first {SHOWN}")
    parser.add_argument(
        "--format", default="table", choices=("table", "csv"), help="csv lists every action, for other programs"
    )
    parser.add_argument("--explain", type=int, default=None, metavar="ACTION", help="say what this action does")
    parser.add_argument(
        "--draw", type=Path, default=None, metavar="FILE", help="with --explain: draw it (png, pdf, svg)"
    )
    parser.add_argument("--figures", type=Path, default=None, metavar="FOLDER", help="write figures of all levels")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    grid = load_grid(options.grid)
    if options.draw is not None and options.explain is None:
        raise UsageError("--draw needs an action: say which one with --explain.")
    if options.figures is not None:
        return _write_figures(grid, options.figures)
    if options.explain is not None:
        return _explain(grid, options.level, options.explain, options.draw)
    return _list(grid, options)


def _list(grid: Grid, options: argparse.Namespace) -> int:
    chosen = select_actions(grid, options.level, substation=options.substation, line=options.line)
    if options.format == "csv":
        _write_csv(list_actions(grid, options.level, chosen))
        return 0
    rows = list_actions(grid, options.level, chosen if options.all else chosen[:SHOWN])
    size = f"{grid.level_sizes[options.level]:,} actions"
    counted = size if len(chosen) == grid.level_sizes[options.level] else f"{len(chosen):,} of {size}"
    table = _table(f"Level {options.level} of {grid.id}: {counted}")
    for name in ("action", "catalogue", "rank", "survival", "95% interval", "margin"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("what it does")
    for row in rows:
        table.add_row(
            str(row.action),
            str(row.catalogue),
            "-" if row.rank is None else f"{row.rank:,}",
            _percent(row.survival),
            f"{_percent(row.survival_low)} to {_percent(row.survival_high)}" if row.trials else "-",
            _signed(row.margin),
            row.words,
        )
    _console().print(table)
    if len(rows) < len(chosen):
        print(f"{len(rows)} of {len(chosen):,} are shown; --all shows every one.")
    return 0


def _write_csv(rows: Sequence[ActionRow]) -> None:
    names = tuple(ActionRow.__dataclass_fields__)
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        values = (getattr(row, name) for name in names)
        writer.writerow([f"{value:.6g}" if isinstance(value, float) else value for value in values])


def _explain(grid: Grid, level: int, action: int, drawing: Path | None) -> int:
    (row,) = list_actions(grid, level, [action])
    chosen = full_catalogue(grid)[row.catalogue]
    explanation = explain_action(grid, chosen)
    if drawing is not None:
        drawing = _draw(grid, chosen, drawing)
    print(f"Action {action} of level {level} of {grid.id}: {row.words}")
    print()
    rank = "not ranked" if row.rank is None else f"rank {row.rank:,}"
    print(f"In the ranking   {rank}; catalogue id {row.catalogue}")
    if row.trials:
        interval = f"95% interval {_percent(row.survival_low)} to {_percent(row.survival_high)}"
        print(f"Survival         {_percent(row.survival)} of {row.trials:,} trials ({interval})")
        print(f"Mean margin      {_signed(row.margin)}")
    print(f"Cooldown         {explanation.cooldown}")
    print(f"Taking it back   {explanation.reversal}")
    if not explanation.changes:
        return 0
    table = _table(None)
    for name in ("element", "before", "after"):
        table.add_column(name, no_wrap=True)
    for change in explanation.changes:
        moved = change.before != change.after
        table.add_row(change.name, _place(change.before), _place(change.after), style="bold" if moved else None)
    print()
    print("In the reference topology, everything in service and on busbar 1:")
    _console().print(table)
    print(explanation.consequence)
    if drawing is not None:
        print(f"Drawn in {drawing}.")
    return 0


def _draw(grid: Grid, action: StepAction, path: Path) -> Path:
    action_figures, figures = _figure_modules()
    suffix = path.suffix.removeprefix(".").lower()
    if suffix not in ("png", "pdf", "svg"):
        raise UsageError(f"{path.name} is no picture that can be drawn: end its name with .png, .pdf or .svg.")
    figure = action_figures.draw_action(grid, action)
    make_folder(path.parent)
    (written,) = figures.save_figure(figure, path.with_suffix(""), formats=(suffix,))
    return Path(written)


def _write_figures(grid: Grid, folder: Path) -> int:
    action_figures, figures = _figure_modules()
    drawn = {
        "shares": action_figures.draw_shares(grid),
        "trials": action_figures.draw_trials(grid),
        "ranking": action_figures.draw_ranking(grid),
    }
    make_folder(folder)
    for name, figure in drawn.items():
        paths = figures.save_figure(figure, folder / f"{grid.id}-{name}")
        print(f"Written: {', '.join(str(path) for path in paths)}")
    return 0


def _figure_modules() -> tuple[ModuleType, ModuleType]:
    try:
        from rl2grid.analysis import action_figures, figures
    except ImportError as error:
        raise UsageError(f"Drawing needs {error.name}: install it with `pip install rl2grid[analysis]`.") from None
    return action_figures, figures


def _table(title: str | None) -> Table:
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=rich.box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 2, 0, 0),
    )


def _place(busbar: int | None) -> str:
    return "out of service" if busbar is None else f"busbar {busbar}"


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.1f}%"


def _signed(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:+.3f}"


def _console() -> Console:
    console = Console()
    # A table cut to the width of a pipe would lose columns.
    return Console(width=console.width if console.is_terminal else 200)
