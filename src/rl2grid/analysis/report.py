"""A report: one self-contained HTML page, the same table as Markdown, and the figures as files.

::

    report.html      the page: no other file and no network needed, for phones and desks, light and dark
    results.md       the table
    figures/         every figure as PNG and PDF
"""

from __future__ import annotations

import base64
import html
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from rl2grid.analysis import figures, tables
from rl2grid.analysis.recordings import Recording
from rl2grid.analysis.results import EvaluationResult, check_comparable, identity_hash
from rl2grid.analysis.summary import Summary
from rl2grid.analysis.training import TrainingCurve
from rl2grid.drawing.theme import DARK, LIGHT, Theme

REPORT_FILE, TABLE_FILE, FIGURES_FOLDER = "report.html", "results.md", "figures"


@dataclass(frozen=True)
class _Picture:
    """A figure that can be drawn in any theme."""

    name: str
    caption: str
    command: str
    draw: Callable[[Theme], Figure]


def write_report(
    folder: Path,
    results: Sequence[EvaluationResult],
    *,
    title: str,
    introduction: str = "",
    curves: Sequence[TrainingCurve] = (),
    recordings: Sequence[Recording] = (),
    commands: Mapping[str, str] | None = None,
) -> Path:
    """Write a report and return the path of its page.

    Args:
        folder: made if need be; files of an earlier report are replaced.
        results: evaluations of one task, at least one; agents appear in this order in the table.
        title: headline of the page.
        introduction: a sentence or two below it.
        curves: training runs; none: no training curve.
        recordings: episodes to be shown line by line.
        commands: what was typed, by what it made, beside the commands of the evaluations; ``training`` and
            ``episodes`` also stand under their figures.

    Raises:
        UsageError: no results, or results that do not belong into one table.
    """
    check_comparable(results)
    commands = dict(commands or {})
    summaries = [result.summary for result in results]
    pictures = _pictures(results, curves, recordings, commands)
    (folder / FIGURES_FOLDER).mkdir(parents=True, exist_ok=True)
    drawn = []
    for picture in pictures:
        light = picture.draw(LIGHT)
        figures.save_figure(light, folder / FIGURES_FOLDER / picture.name)
        dark = figures.png_bytes(picture.draw(DARK))
        drawn.append(figure_html(picture.caption, figures.png_bytes(light), dark, picture.command))
    _write(folder / TABLE_FILE, f"# {title}\n\n{tables.markdown_table(summaries)}\n{tables.LEGEND}\n")
    body = [
        _header(title, introduction, summaries),
        f"<section><h2>Results</h2>{_table_html(summaries)}<p class=note>{html.escape(tables.LEGEND)}</p></section>",
        *drawn,
        _endings_html(summaries),
        _commands_html(results, commands),
        _identity_html(results),
    ]
    write_page(folder / REPORT_FILE, title, body)
    return folder / REPORT_FILE


def write_page(path: Path, title: str, parts: Sequence[str]) -> None:
    """Write one HTML page that needs no other file, in the place of an earlier one; ``parts`` are HTML."""
    page = _PAGE.replace("{title}", html.escape(title)).replace("{body}", "\n".join(parts))
    _write(path, page)


def facts_html(facts: Sequence[tuple[str, str]]) -> str:
    """Names and values as cards."""
    cards = "".join(f"<div><dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd></div>" for name, value in facts)
    return f"<dl class=facts>{cards}</dl>"


def table_html(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table that scrolls sideways on narrow screens; the first two columns are words."""
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in headings)
    body = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return _scrolling(head, body)


def figure_html(caption: str, light: bytes, dark: bytes, command: str = "") -> str:
    """A figure, PNG in both themes, and below it what is to be seen and what made it."""
    made = f"<code>{html.escape(command)}</code>" if command else ""
    return (
        f"<section><figure><picture><source media='(prefers-color-scheme: dark)' srcset='{_data_uri(dark)}'>"
        f"<img src='{_data_uri(light)}' alt='{html.escape(caption, quote=True)}'></picture>"
        f"<figcaption>{html.escape(caption)}{made}</figcaption></figure></section>"
    )


def _pictures(
    results: Sequence[EvaluationResult],
    curves: Sequence[TrainingCurve],
    recordings: Sequence[Recording],
    commands: Mapping[str, str],
) -> list[_Picture]:
    pictures = [
        _Picture(
            "survival",
            "Survival of every evaluated episode, with mean and 95% interval.",
            "",
            lambda theme: figures.survival_by_agent(results, theme=theme),
        )
    ]
    if curves:
        pictures.append(
            _Picture(
                "training",
                "Survival of the episodes that ended in training, smoothed; diamonds: validation scenarios.",
                commands.get("training", ""),
                lambda theme: figures.training_curves(curves, theme=theme),
            )
        )
    for number, recording in enumerate(recordings):
        # Bound now: the loop's variable would be another one by the time it is drawn.
        def draw(theme: Theme, recording: Recording = recording) -> Figure:
            return figures.episode_loading(recording, theme=theme)

        caption = (
            "Loading of every line through one episode, the most loaded on top; orange and red are above the limit. "
            "Below: where the agent was asked, and where it did something."
        )
        pictures.append(_Picture(f"episode-{number}-{recording.agent}", caption, commands.get("episodes", ""), draw))
    return pictures


def _header(title: str, introduction: str, summaries: Sequence[Summary]) -> str:
    best = max(summaries, key=lambda summary: summary.survival.value)
    first = summaries[0]
    facts = [
        ("task", first.task.removeprefix("rl2grid/")),
        ("best survival", f"{100 * best.survival.value:.1f}%"),
        ("by", best.agent + ("" if best.heuristic == "none" else f" + {best.heuristic}")),
        ("episodes per agent", str(first.episodes)),
    ]
    lead = f"<p>{html.escape(introduction)}</p>" if introduction else ""
    return f"<header><h1>{html.escape(title)}</h1>{lead}{facts_html(facts)}</header>"


def _table_html(summaries: Sequence[Summary]) -> str:
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in tables.HEADINGS)
    rows = []
    for summary in summaries:
        cells = "".join(f"<td>{_cell(cell)}</td>" for cell in tables.table_cells(summary))
        rows.append(f"<tr{' class=best' if tables.is_best(summary, summaries) else ''}>{cells}</tr>")
    return _scrolling(head, "".join(rows))


def _scrolling(head: str, body: str) -> str:
    return f"<div class=scroll><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _cell(text: str) -> str:
    """A cell; an interval goes below its value, in small print."""
    value, bracket, interval = html.escape(text).partition(" [")
    return f"{value}<small>[{interval}</small>" if bracket else value


def _endings_html(summaries: Sequence[Summary]) -> str:
    reasons = sorted({reason for summary in summaries for reason in summary.game_over})
    if not reasons:
        return ""
    headings = ("agent", "heuristic", "completed", *(reason.replace("_", " ").lower() for reason in reasons))
    rows = [
        (
            summary.agent,
            summary.heuristic,
            str(summary.episodes - sum(summary.game_over.values())),
            *(str(summary.game_over.get(reason, 0)) for reason in reasons),
        )
        for summary in summaries
    ]
    return f"<section><h2>How episodes ended</h2>{table_html(headings, rows)}</section>"


def _commands_html(results: Sequence[EvaluationResult], commands: Mapping[str, str]) -> str:
    made = [(f"results of {result.summary.agent}", result.command) for result in results]
    made += [(purpose, command) for purpose, command in commands.items()]
    items = "".join(
        f"<dt>{html.escape(name)}</dt><dd><code>{html.escape(command)}</code></dd>" for name, command in made
    )
    return f"<section><h2>What made every number</h2><dl class=commands>{items}</dl></section>"


def _identity_html(results: Sequence[EvaluationResult]) -> str:
    parts = []
    for result in results:
        words = json.dumps(dict(result.identity), indent=2, default=str)
        parts.append(
            f"<details><summary>{html.escape(result.summary.agent)} "
            f"<code>{identity_hash(result.identity)}</code></summary><pre>{html.escape(words)}</pre></details>"
        )
    return (
        "<section><h2>Identity</h2><p class=note>Results are comparable when everything but the agent is the same: "
        f"task, scenarios, actions, engine and versions.</p>{''.join(parts)}</section>"
    )


def _data_uri(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def _write(path: Path, text: str) -> None:
    temporary = path.with_name(f"{path.name}.tmp")
    temporary.write_text(text, encoding="utf-8", newline="\n")
    os.replace(temporary, path)


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>
:root { --paper: #fff; --ink: #1b1f24; --muted: #5c666f; --rule: #e4e7ea; --card: #f6f8fa; --accent: #0072b2; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #15181c; --ink: #e8eaed; --muted: #9aa3ad; --rule: #30363d; --card: #1c2127; --accent: #56b4e9; }
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
.scroll { overflow-x: auto; -webkit-overflow-scrolling: touch; }
table { border-collapse: collapse; width: 100%; font-size: .85rem; font-variant-numeric: tabular-nums; }
th, td { padding: .45rem .6rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--rule);
  vertical-align: top; }
th { color: var(--muted); font-weight: 500; }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left; }
td:first-child, th:first-child { position: sticky; left: 0; background: var(--paper); }
td small { display: block; color: var(--muted); font-size: .75rem; font-weight: 400; }
tr.best td { font-weight: 650; }
tr.best td:first-child { box-shadow: inset 3px 0 var(--accent); }
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
@media print { body { max-width: none; } figure, table { break-inside: avoid; } }
</style>
</head>
<body>
{body}
</body>
</html>
"""
