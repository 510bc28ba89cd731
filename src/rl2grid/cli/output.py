"""How every command speaks: results on standard output, as tables or as JSON; all else on standard error."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl2grid.compile_notices import VARIABLE

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

    from rl2grid.analysis.table import ResultTable


class Output:
    """What a command says.

    Args:
        json: whether results are one JSON object on standard output, and nothing else is said.
        quiet: whether the results alone are printed.
    """

    def __init__(self, *, json: bool = False, quiet: bool = False) -> None:
        self.json, self.quiet = json, quiet
        if quiet:  # for the processes that it starts, too
            os.environ.setdefault(VARIABLE, "1")
        self._results: dict[str, Any] = {}

    @property
    def talks(self) -> bool:
        """Whether progress and remarks are shown."""
        return not (self.json or self.quiet)

    def remark(self, sentence: str) -> None:
        """What was done, or is worth knowing."""
        if self.talks:
            print(sentence, flush=True)

    def text(self, words: str) -> None:
        """A result in words."""
        if not self.json:
            print(words)

    def table(self, table: ResultTable, records: Sequence[Mapping[str, Any]] | None = None, title: str = "") -> None:
        """A result as a table.

        Folded to the width of a terminal, where it is wider. Else one line per row, whatever its width: what reads
        a pipe reads lines.

        Args:
            table: what is printed.
            records: its rows for ``--json``; None: the cells as they are printed.
            title: of the table; its name if empty.
        """
        # Imported here, as all else that is not always needed: help is to be there at once.
        from rl2grid.analysis.table import result_table_rich, table_records, table_text

        if self.json:
            self._results[table.name] = table_records(table) if records is None else records
            return
        text = table_text(table, title)
        width = max(map(len, text.splitlines()), default=0)
        if not sys.stdout.isatty() or (width < shutil.get_terminal_size().columns and not _has_best(table)):
            print(text)
            return
        from rich.console import Console

        Console().print(result_table_rich(table, title))

    def results(self, **values: Any) -> None:
        """Results by name, for ``--json``: plain values, paths, arrays' numbers, and dataclasses of them."""
        self._results |= values

    def progress(self, *columns: ProgressColumn | str, transient: bool = False) -> Progress:
        """A progress bar on standard error, which shows nothing where only results are asked for."""
        from rich.console import Console
        from rich.progress import Progress

        return Progress(*columns, console=Console(stderr=True), transient=transient, disable=not self.talks)

    @contextmanager
    def counting(self, words: str, total: int) -> Iterator[Callable[[float], None]]:
        """A progress bar, to be told how many of ``total`` are done."""
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with self.progress(*columns, transient=True) as bar:
            task = bar.add_task(words, total=total)
            yield lambda done: bar.update(task, completed=done)

    def close(self) -> None:
        """Print what ``--json`` asked for."""
        if self.json:
            print(json.dumps(_plain(self._results), indent=2, allow_nan=False))


def _has_best(table: ResultTable) -> bool:
    return any(cell.best for row in table.rows for cell in row)


def _plain(value: Any) -> Any:
    """A value as JSON knows it: not a number is null."""
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple | set | range):
        return [_plain(each) for each in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
