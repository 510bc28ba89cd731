"""``rl2grid actions``: the actions of a level, one of them explained and drawn, and figures of action spaces."""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from types import ModuleType

from rl2grid.analysis.action_space import ActionRow, ElementChange, explain_action, list_actions, select_actions
from rl2grid.analysis.table import Cell, Column, ResultTable
from rl2grid.cli.output import Output
from rl2grid.errors import UsageError
from rl2grid.grids import Grid, load_grid
from rl2grid.mdp.actions import StepAction, full_catalogue
from rl2grid.records.files import make_folder

SHOWN = 50
"""Actions listed unless --all is given."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
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


def _run(options: argparse.Namespace, output: Output) -> int:
    grid = load_grid(options.grid)
    if options.draw is not None and options.explain is None:
        raise UsageError("--draw needs an action: say which one with --explain.")
    if options.figures is not None:
        return _write_figures(grid, options.figures, output)
    if options.explain is not None:
        return _explain(grid, options.level, options.explain, options.draw, output)
    return _list(grid, options, output)


def _list(grid: Grid, options: argparse.Namespace, output: Output) -> int:
    chosen = select_actions(grid, options.level, substation=options.substation, line=options.line)
    if options.format == "csv":
        _write_csv(list_actions(grid, options.level, chosen))
        return 0
    rows = list_actions(grid, options.level, chosen if options.all else chosen[:SHOWN])
    size = f"{grid.level_sizes[options.level]:,} actions"
    counted = size if len(chosen) == grid.level_sizes[options.level] else f"{len(chosen):,} of {size}"
    numbers = ("action", "catalogue", "rank", "survival", "95% interval", "margin")
    table = ResultTable(
        "actions",
        "",
        (*map(Column, numbers), Column("what it does", words=True)),
        tuple(tuple(map(Cell, _cells(row))) for row in rows),
    )
    records = [asdict(row) for row in rows]
    output.table(table, records, title=f"Level {options.level} of {grid.id}: {counted}")
    if len(rows) < len(chosen):
        output.remark(f"{len(rows)} of {len(chosen):,} are shown; --all shows every one.")
    return 0


def _cells(row: ActionRow) -> tuple[str, ...]:
    return (
        str(row.action),
        str(row.catalogue),
        "-" if row.rank is None else f"{row.rank:,}",
        _percent(row.survival),
        f"{_percent(row.survival_low)} to {_percent(row.survival_high)}" if row.trials else "-",
        _signed(row.margin),
        row.words,
    )


def _write_csv(rows: Sequence[ActionRow]) -> None:
    names = tuple(ActionRow.__dataclass_fields__)
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        values = (getattr(row, name) for name in names)
        writer.writerow([f"{value:.6g}" if isinstance(value, float) else value for value in values])


def _explain(grid: Grid, level: int, action: int, drawing: Path | None, output: Output) -> int:
    (row,) = list_actions(grid, level, [action])
    chosen = full_catalogue(grid)[row.catalogue]
    explanation = explain_action(grid, chosen)
    if drawing is not None:
        drawing = _draw(grid, chosen, drawing)
    output.results(grid=grid.id, level=level, action=row, explanation=explanation, drawing=drawing)
    output.text(f"Action {action} of level {level} of {grid.id}: {row.words}")
    output.text("")
    rank = "not ranked" if row.rank is None else f"rank {row.rank:,}"
    output.text(f"In the ranking   {rank}; catalogue id {row.catalogue}")
    if row.trials:
        interval = f"95% interval {_percent(row.survival_low)} to {_percent(row.survival_high)}"
        output.text(f"Survival         {_percent(row.survival)} of {row.trials:,} trials ({interval})")
        output.text(f"Mean margin      {_signed(row.margin)}")
    output.text(f"Cooldown         {explanation.cooldown}")
    output.text(f"Taking it back   {explanation.reversal}")
    if not explanation.changes:
        return 0
    columns = tuple(Column(name, words=True) for name in ("element", "before", "after"))
    rows = tuple(_change_cells(each) for each in explanation.changes)
    output.text("")
    if not output.json:
        title = "In the reference topology, everything in service and on busbar 1:"
        output.table(ResultTable("changes", "", columns, rows), title=title)
    output.text(explanation.consequence)
    if drawing is not None:
        output.remark(f"Drawn in {drawing}.")
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


def _write_figures(grid: Grid, folder: Path, output: Output) -> int:
    action_figures, figures = _figure_modules()
    drawn = {
        "shares": action_figures.draw_shares(grid),
        "trials": action_figures.draw_trials(grid),
        "ranking": action_figures.draw_ranking(grid),
    }
    make_folder(folder)
    written = []
    for name, figure in drawn.items():
        paths = figures.save_figure(figure, folder / f"{grid.id}-{name}")
        output.remark(f"Written: {', '.join(str(path) for path in paths)}")
        written += paths
    output.results(figures=written)
    return 0


def _figure_modules() -> tuple[ModuleType, ModuleType]:
    try:
        from rl2grid.analysis import action_figures, figures
    except ImportError as error:
        raise UsageError(f"Drawing needs {error.name}: install it with `pip install rl2grid[analysis]`.") from None
    return action_figures, figures


def _change_cells(change: ElementChange) -> tuple[Cell, ...]:
    moved = change.before != change.after
    return tuple(Cell(text, best=moved) for text in (change.name, _place(change.before), _place(change.after)))


def _place(busbar: int | None) -> str:
    return "out of service" if busbar is None else f"busbar {busbar}"


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100 * share:.1f}%"


def _signed(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:+.3f}"
