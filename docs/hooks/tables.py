"""Tables that fit a phone: every cell is told its heading, so that a row can be shown as a card (``assets/site.css``).

Tables of two columns fit as they are. A table whose headings are all empty loses them.
"""

from __future__ import annotations

import html
import re

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

FITTING = 2
"""Columns that fit a phone."""
LONG = 36
"""Letters of a cell from which on it stands below its heading, and not beside it."""
_TABLE = re.compile(r"<table>.*?</table>", re.DOTALL)
_HEAD = re.compile(r"<thead>.*?</thead>\s*", re.DOTALL)
_HEADING = re.compile(r"<th\b[^>]*>(.*?)</th>", re.DOTALL)
_ROW = re.compile(r"<tr>.*?</tr>", re.DOTALL)
_CELL = re.compile(r"<td(\b[^>]*)>(.*?)</td>", re.DOTALL)
_TAG = re.compile(r"<[^>]+>")


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Name the cells of wide tables by their headings."""
    return _TABLE.sub(lambda found: named_cells(found[0]), content)


def named_cells(table: str) -> str:
    """A table of HTML, ready to be shown as cards."""
    headings = [html.escape(html.unescape(_TAG.sub("", heading)), quote=True) for heading in _HEADING.findall(table)]
    if not any(headings):
        return _HEAD.sub("", table)
    if len(headings) <= FITTING:
        return table
    rows = _ROW.sub(lambda row: _named(row[0], headings), table)
    # The theme makes tables without a class scroll; cards do not have to.
    return rows.replace("<table>", '<table data-cards="">', 1)


def _named(row: str, headings: list[str]) -> str:
    names = iter(headings)

    def named(cell: re.Match[str]) -> str:
        long = ' data-long=""' if len(_TAG.sub("", cell[2])) >= LONG else ""
        return f'<td{cell[1]} data-heading="{next(names, "")}"{long}>{cell[2]}</td>'

    return _CELL.sub(named, row)
