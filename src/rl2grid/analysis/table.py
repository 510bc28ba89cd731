"""A table of results and what it is written as: for the terminal, and as Markdown, LaTeX (booktabs) and CSV."""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

    from rl2grid.records.comparisons import Difference
    from rl2grid.records.statistics import Estimate


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    heading: str
    group: str = ""
    """Heading that it shares with its neighbours of the same group."""
    words: bool = False
    """Whether it holds words, which are aligned to the left, and not numbers."""


@dataclass(frozen=True)
class Cell:
    """A cell of a table: how it is printed, and the number behind it."""

    text: str
    estimate: Estimate | None = None
    """All digits of the value and its interval, for CSV."""
    best: bool = False
    """Printed bold."""


@dataclass(frozen=True)
class ResultTable:
    """A table, before it is written in one of :data:`WRITERS`."""

    name: str
    """Of its files, and of its label in LaTeX."""
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    """Each with one cell per column."""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"A row of {self.name} has {len(row)} cells, the table {len(self.columns)} columns.")


MISSING = Cell("-")


def mean_cell(estimate: Estimate, *, digits: int = 2, best: bool = False) -> Cell:
    """A value and half the width of its interval, as "0.97 ± 0.02"; the value alone where there is none."""
    half = (estimate.high - estimate.low) / 2
    if math.isnan(half):
        return Cell(f"{estimate.value:,.{digits}f}", estimate, best)
    return Cell(f"{estimate.value:,.{digits}f} ± {half:,.{digits}f}", estimate, best)


def interval_cell(estimate: Estimate, *, digits: int = 3, best: bool = False) -> Cell:
    """A value and both ends of its interval, as "0.970 [0.950, 0.990]"."""
    return Cell(with_interval(estimate, digits), estimate, best)


def share_cell(estimate: Estimate) -> Cell:
    """A share and both ends of its interval, as "97% [95, 99]"."""
    return Cell(share_text(estimate), estimate)


def share_text(estimate: Estimate) -> str:
    """A share and both ends of its interval, as "97% [95, 99]"."""
    return f"{100 * estimate.value:.0f}% [{100 * estimate.low:.0f}, {100 * estimate.high:.0f}]"


def difference_cell(difference: Difference, *, digits: int = 3) -> Cell:
    """A difference and both ends of its interval, as "+0.120 [-0.010, +0.250]"."""
    one = difference.estimate
    ends = "" if math.isnan(one.low) else f" [{one.low:+.{digits}f}, {one.high:+.{digits}f}]"
    return Cell(f"{one.value:+.{digits}f}{ends}", one)


def p_cell(difference: Difference) -> Cell:
    """The corrected p-value of a difference, as "0.012" or "< 0.001"."""
    if math.isnan(difference.holm):
        return MISSING
    return Cell("< 0.001" if difference.holm < 0.001 else f"{difference.holm:.3f}")


def table_text(table: ResultTable, title: str = "") -> str:
    """A table as lines of text, one per row, as wide as its values are: for pipes, files and wide terminals."""
    head = [_heading(column) for column in table.columns]
    lines = [head, *([cell.text for cell in row] for row in table.rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(head))]
    shown = [
        "  ".join(
            text.ljust(width) if column.words else text.rjust(width)
            for text, width, column in zip(line, widths, table.columns, strict=True)
        ).rstrip()
        for line in lines
    ]
    return "\n".join([*([title] if title else []), *shown, *([table.caption] if table.caption else [])])


def table_records(table: ResultTable) -> list[dict[str, object]]:
    """The rows of a table by the headings of its columns, for programs: an estimate with all digits, else the text."""
    return [
        {_heading(column): _record(cell) for column, cell in zip(table.columns, row, strict=True)} for row in table.rows
    ]


def _heading(column: Column) -> str:
    return f"{column.group} {column.heading}".strip()


def _record(cell: Cell) -> object:
    if cell.estimate is None:
        return cell.text
    return {"value": cell.estimate.value, "low": cell.estimate.low, "high": cell.estimate.high}


def result_table_rich(table: ResultTable, title: str | None = None) -> Table:
    """A table for the terminal, with its caption; intervals stand below their values."""
    # Imported here: a command that prints a few lines starts faster without.
    import rich.box
    from rich.table import Table
    from rich.text import Text

    shown = Table(
        title=Text(title or table.name),
        title_justify="left",
        title_style="bold",
        caption=Text(table.caption),
        caption_justify="left",
        box=rich.box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for k, column in enumerate(table.columns):
        shown.add_column(
            _heading(column) if column.words else _narrow(_heading(column), [row[k].text for row in table.rows]),
            justify="left" if column.words else "right",
            no_wrap=not column.words,
            min_width=14 * column.words,
            overflow="fold",
        )
    for row in table.rows:
        shown.add_row(*(Text(_below(cell.text), style="bold" if cell.best else "") for cell in row))
    return shown


def _below(text: str) -> str:
    """An interval below its value."""
    return text.replace(" [", "\n[")


def _narrow(heading: str, texts: Sequence[str]) -> str:
    """A heading that makes no column wider than its numbers where it has a space to be broken at."""
    width = max((len(line) for text in texts for line in _below(text).splitlines()), default=0)
    return heading if len(heading) <= width else heading.replace(" ", "\n", 1)


def table_markdown(table: ResultTable) -> str:
    """A table as Markdown; a column of a group is headed "group heading"."""
    headings = [_heading(column) for column in table.columns]
    lines = [markdown_row(headings), markdown_row([":--" if column.words else "--:" for column in table.columns])]
    for row in table.rows:
        lines.append(markdown_row([highlighted(cell.text, cell.best) for cell in row]))
    return "\n".join(lines) + f"\n\n{table.caption}\n"


def table_latex(table: ResultTable) -> str:
    """A table as LaTeX, in need of the package booktabs."""
    letters = "".join("l" if column.words else "r" for column in table.columns)
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{_latex(table.caption)}}}", rf"\label{{tab:{table.name}}}"]
    lines += [rf"\begin{{tabular}}{{{letters}}}", r"\toprule"]
    if any(column.group for column in table.columns):
        lines += _latex_groups(table.columns)
    lines += [_latex_row([_latex(column.heading) for column in table.columns]), r"\midrule"]
    for row in table.rows:
        lines.append(_latex_row([rf"\textbf{{{_latex(c.text)}}}" if c.best else _latex(c.text) for c in row]))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}"]) + "\n"


def table_csv(table: ResultTable) -> str:
    """A table as CSV with all digits; a column of estimates becomes three: value, low and high."""
    estimates = [any(row[k].estimate for row in table.rows) for k in range(len(table.columns))]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    head: list[str] = []
    for column, is_estimate in zip(table.columns, estimates, strict=True):
        name = _heading(column)
        head += [name, f"{name} low", f"{name} high"] if is_estimate else [name]
    writer.writerow(head)
    for row in table.rows:
        writer.writerow(
            [
                value
                for cell, is_estimate in zip(row, estimates, strict=True)
                for value in (_csv_numbers(cell) if is_estimate else [cell.text])
            ]
        )
    return text.getvalue()


WRITERS: dict[str, Callable[[ResultTable], str]] = {"md": table_markdown, "tex": table_latex, "csv": table_csv}
"""Writer of each format, by the suffix of its files."""


def with_interval(estimate: Estimate, digits: int) -> str:
    """A value and both ends of its interval, as "0.970 [0.950, 0.990]"; the value alone where there is none."""
    if math.isnan(estimate.low):
        return f"{estimate.value:.{digits}f}"
    return f"{estimate.value:.{digits}f} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


def highlighted(text: str, is_best: bool) -> str:
    """A cell of Markdown, bold if it is the best."""
    return f"**{text}**" if is_best else text


def markdown_row(cells: Sequence[str]) -> str:
    """One line of a Markdown table; pipes within cells are escaped."""
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"


def _latex_groups(columns: Sequence[Column]) -> list[str]:
    """The row of the groups, and the rules below them."""
    cells, rules, first = [], [], 1
    for group, members in itertools.groupby(columns, key=lambda column: column.group):
        n = len(list(members))
        cells += [rf"\multicolumn{{{n}}}{{c}}{{{_latex(group)}}}"] if group else [""] * n
        if group:
            rules.append(rf"\cmidrule(lr){{{first}-{first + n - 1}}}")
        first += n
    return [_latex_row(cells), " ".join(rules)]


def _latex_row(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "≤": r"$\le$", ">": r"$>$", "<": r"$<$",
    "|": r"$|$",
}  # fmt: skip


def _latex(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in text)


def _csv_numbers(cell: Cell) -> list[object]:
    if cell.estimate is None:
        return ["", "", ""]
    return [cell.estimate.value, cell.estimate.low, cell.estimate.high]
