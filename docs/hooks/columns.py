"""The table of the columns of ``episodes.csv``, made from their declaration while the site is built.

A page names its place with ``<!-- columns: episodes.csv -->``.
"""

from __future__ import annotations

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

from rl2grid.records.episodes import COLUMNS, Column

MARK = "<!-- columns: episodes.csv -->"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put the table where the page asks for it."""
    return markdown.replace(MARK, _table()) if MARK in markdown else markdown


def _table() -> str:
    return "\n".join(["| column | type | unit | meaning | decided by |", "|---|---|---|---|---|", *map(_row, COLUMNS)])


def _row(column: Column) -> str:
    return f"| `{column.name}` | {column.type.__name__} | {column.unit} | {column.meaning} | {column.origin} |"
