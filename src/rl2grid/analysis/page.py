"""One look for all pages: what HTML pages that need no other file and no network are made of."""

from __future__ import annotations

import base64
import html
import itertools
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from rl2grid.analysis.table import Cell, ResultTable
from rl2grid.records.evaluations import identity_hash
from rl2grid.records.files import printable, write_text

FOLDED_FROM = 15
"""Rows of a table that are always shown."""


def write_page(path: Path, title: str, parts: Sequence[str]) -> None:
    """Write one HTML page that needs no other file, in the place of an earlier one; ``parts`` are HTML."""
    page = filled(_PAGE, title=html.escape(printable(title)), body="\n".join(parts), first_folded=str(FOLDED_FROM + 1))
    write_text(path, page)


def resource_text(name: str) -> str:
    """A template, script or style sheet of this package."""
    return (resources.files("rl2grid.analysis") / name).read_text(encoding="utf-8")


def filled(template: str, **parts: str) -> str:
    """A template with a text in the place of each ``{name}``; what looks like one in a text stays as it is."""
    return re.sub("|".join(rf"\{{{name}\}}" for name in parts), lambda found: parts[found[0][1:-1]], template)


def embedded(value: Any) -> str:
    """A value as JSON that may stand inside a script element, where no text of it can end or begin an element."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def facts_html(facts: Sequence[tuple[str, str]]) -> str:
    """Names and values as cards."""
    cards = "".join(f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>" for name, value in facts)
    return f"<dl class=facts>{cards}</dl>"


def table_html(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table that scrolls sideways on narrow screens; the first two columns are words."""
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in headings)
    body = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return scrolling(head, body)


def result_table_html(
    table: ResultTable, *, links: Sequence[str] = (), made: str = "", best_first: bool = False
) -> str:
    """A table of results with its caption; of a long one, the rows behind the first are shown on demand.

    Args:
        table: the table.
        links: HTML of one more cell at the end of each row, which says what made it; none: there is no such column.
        made: HTML behind the caption, which says what made the table.
        best_first: whether the first of several rows is the best, and is marked.
    """
    grouped = any(column.group for column in table.columns)
    groups = ""
    if grouped:
        for group, members in itertools.groupby(table.columns, key=lambda column: column.group):
            rule = " class=group" if group else ""
            groups += f"<th colspan={len(list(members))}{rule}>{html.escape(group)}</th>"
        groups = f"<tr>{groups}{'<th></th>' if links else ''}</tr>"
    words = [" class=words" if column.words else "" for column in table.columns]
    head = "".join(f"<th{w}>{html.escape(c.heading)}</th>" for c, w in zip(table.columns, words, strict=True))
    head += "<th class=words>Made by</th>" if links else ""
    rows = []
    for number, row in enumerate(table.rows):
        cells = "".join(f"<td{w}>{_result_cell(cell)}</td>" for cell, w in zip(row, words, strict=True))
        cells += f"<td class='words links'>{links[number]}</td>" if links else ""
        is_best = best_first and number == 0 and len(table.rows) > 1
        rows.append(f"<tr{' class=best' if is_best else ''}>{cells}</tr>")
    return (
        f"<div>{_fold(table)}<div class=scroll><table class=typed><thead>{groups}<tr>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div></div><p class=note>{html.escape(table.caption)}{made}</p>"
    )


def cautions_html(sentences: Sequence[str]) -> str:
    """What results are too few to prove, so that it is seen; nothing without sentences."""
    items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in sentences)
    return f"<aside class=caution><b>Mind</b><ul>{items}</ul></aside>" if items else ""


def figure_html(caption: str, light: bytes, dark: bytes, made: str = "") -> str:
    """A figure, PNG in both themes, and below it what is to be seen and, as HTML, what made it."""
    return (
        f"<section><figure><picture><source media='(prefers-color-scheme: dark)' srcset='{_data_uri(dark)}'>"
        f"<img src='{_data_uri(light)}' alt='{html.escape(caption, quote=True)}'></picture>"
        f"<figcaption>{html.escape(caption)}{made}</figcaption></figure></section>"
    )


def scrolling(head: str, body: str) -> str:
    """A table of HTML cells that scrolls sideways on narrow screens."""
    return f"<div class=scroll><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def cell_html(text: str) -> str:
    """A cell; an interval goes below its value, in small print."""
    value, bracket, interval = html.escape(text).partition(" [")
    return f"{value}<small>[{interval}</small>" if bracket else value


def code_html(command: str) -> str:
    """A command; nothing for none."""
    return f"<code>{html.escape(command)}</code>" if command else ""


def commands_html(commands: Sequence[tuple[str, str]]) -> str:
    """What was made, as HTML, and the command that made it."""
    items = "".join(f"<dt>{name}</dt><dd>{code_html(command)}</dd>" for name, command in commands)
    return f"<dl class=commands>{items}</dl>"


def identities_html(identities: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """The section of names and identities, each to be unfolded."""
    parts = [
        f"<details><summary>{html.escape(name)} <code>{identity_hash(identity)}</code></summary>"
        f"<pre>{html.escape(json.dumps(dict(identity), indent=2, default=str))}</pre></details>"
        for name, identity in identities
    ]
    return (
        "<section><h2 id=identity>Identity</h2><p class=note>Results are comparable when everything but the agent is "
        f"the same: task, scenarios, actions, engine and versions.</p>{''.join(parts)}</section>"
    )


def _fold(table: ResultTable) -> str:
    """The switch of a long table, which has to stand before it; it works without a script."""
    if len(table.rows) <= FOLDED_FROM:
        return ""
    name = html.escape(f"all-{table.name}")
    return f"<input type=checkbox class=more id='{name}'><label for='{name}'>Show all {len(table.rows)} rows</label>"


def _result_cell(cell: Cell) -> str:
    text = cell_html(cell.text)
    return f"<b>{text}</b>" if cell.best else text


def _data_uri(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>
:root { --paper: #fff; --ink: #1b1f24; --muted: #5c666f; --rule: #e4e7ea; --card: #f6f8fa; --accent: #0072b2;
  --shadow: rgb(0 0 0 / .22); }
@media (prefers-color-scheme: dark) {
  :root { --paper: #15181c; --ink: #e8eaed; --muted: #9aa3ad; --rule: #30363d; --card: #1c2127; --accent: #56b4e9;
    --shadow: rgb(255 255 255 / .3); }
}
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1rem 4rem; max-width: 60rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; -webkit-text-size-adjust: 100%; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: .5rem 0; }
h2 { font-size: 1.15rem; margin: 2.5rem 0 .75rem; }
.note, figcaption { color: var(--muted); font-size: .85rem; }
.facts { display: grid; grid-template-columns: repeat(4, 1fr); gap: .75rem; margin: 1.25rem 0 0; }
@media (max-width: 40rem) { .facts { grid-template-columns: repeat(2, 1fr); } }
.facts div { background: var(--card); border-radius: .5rem; padding: .6rem .8rem; }
.facts dt { color: var(--muted); font-size: .8rem; }
.facts dd { margin: 0; font-size: 1.1rem; font-weight: 600; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; -webkit-overflow-scrolling: touch; scrollbar-width: thin;
  background: linear-gradient(to left, var(--paper) 30%, transparent) right / 2.5rem 100% no-repeat local,
    linear-gradient(to left, var(--shadow), transparent) right / .9rem 100% no-repeat scroll; }
table { border-collapse: collapse; width: 100%; font-size: .85rem; font-variant-numeric: tabular-nums; }
th, td { padding: .45rem .6rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--rule);
  vertical-align: top; }
th { color: var(--muted); font-weight: 500; }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left; }
td:first-child, th:first-child { position: sticky; left: 0; background: var(--paper); }
td small { display: block; color: var(--muted); font-size: .75rem; font-weight: 400; }
tr.best td { font-weight: 650; }
tr.best td:first-child { box-shadow: inset 3px 0 var(--accent); }
table.typed th, table.typed td { text-align: right; }
table.typed tr.best td { font-weight: inherit; }
table.typed tr.best td:first-child { font-weight: 650; }
tr.best td:first-child::after { content: "best"; margin-left: .5rem; padding: .05rem .4rem; border-radius: 1rem;
  background: var(--accent); color: var(--paper); font-size: .7rem; font-weight: 600; vertical-align: .1em; }
table.typed .words { text-align: left; }
th.group { border-bottom: 2px solid var(--rule); text-align: center !important; }
.more { position: absolute; opacity: 0; }
.more + label { display: inline-block; margin: .25rem 0 .5rem; padding: .3rem .7rem; border: 1px solid var(--rule);
  border-radius: .4rem; background: var(--card); font-size: .85rem; cursor: pointer; }
.more:focus-visible + label { outline: 2px solid var(--accent); }
.more:checked + label { color: var(--muted); }
.more:not(:checked) ~ .scroll tbody tr:nth-child(n+{first_folded}) { display: none; }
.caution { margin: 1.25rem 0 0; padding: .6rem .9rem; border-left: 4px solid #e69f00; background: var(--card);
  border-radius: .25rem; font-size: .9rem; }
.caution ul { margin: .2rem 0 0; padding-left: 1.1rem; }
button, select, input { font: inherit; color: inherit; background: var(--card); border: 1px solid var(--rule);
  border-radius: .4rem; padding: .35rem .8rem; }
a { color: var(--accent); }
figure { margin: 2.5rem 0 0; }
img { display: block; width: 100%; height: auto; border: 1px solid var(--rule); border-radius: .5rem; }
figcaption { margin-top: .5rem; }
figcaption code { display: block; margin-top: .25rem; }
code, pre { font: .8rem/1.5 ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; overflow-wrap: anywhere; }
dl.commands dt { color: var(--muted); font-size: .85rem; }
dl.commands dd { margin: .15rem 0 .9rem; padding: .5rem .7rem; background: var(--card); border-radius: .4rem; }
details { border-bottom: 1px solid var(--rule); padding: .5rem 0; }
summary { cursor: pointer; }
pre { overflow-x: auto; background: var(--card); border-radius: .4rem; padding: .75rem; }
@media print { .more ~ .scroll tbody tr:nth-child(n) { display: table-row; } body { max-width: none; }
  figure, table { break-inside: avoid; } }
</style>
</head>
<body>
{body}
</body>
</html>
"""
