"""A report: everything that some evaluations and training runs allow, as one HTML page.

A ranking of every task, all tables and figures of a results section, a table of episodes to sort and filter, and the
command behind every number.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from rl2grid.analysis.cautions import cautions
from rl2grid.analysis.explorer import explorer_html
from rl2grid.analysis.page import cautions_html, commands_html, result_table_html
from rl2grid.analysis.page_builder import MAX_BYTES, PageBuilder
from rl2grid.analysis.result_tables import Methods, ranking, ranking_table
from rl2grid.analysis.section import Section, plan_section
from rl2grid.records.collection import Collection
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.methods import Method
from rl2grid.records.trainings import TrainingRun

UNFOLDED_TASKS = 4
"""Tasks whose rankings stand one below the other; of more, all but the first are folded."""
WIDEST = 12
"""Columns of a table that fit a desk."""


def write_report(
    path: Path,
    collection: Collection,
    *,
    title: str,
    command: str,
    train_commands: Mapping[Path, str],
    on_figure: Callable[[str], None] = lambda name: None,
    max_bytes: int = MAX_BYTES,
    plan: Section | None = None,
) -> int:
    """Write the page, whole or not at all, and return its size in bytes.

    Args:
        path: of the page, in a folder that exists.
        collection: evaluations and runs.
        title: headline.
        command: what was typed to obtain the page.
        train_commands: what was typed to obtain each run, by its folder.
        on_figure: told the name of every figure before it is drawn.
        max_bytes: what the page may have; the resolution of the figures is lowered until it fits, within reason.
        plan: of this collection, where :func:`plan_section` made it already; None: it is made.

    Raises:
        UsageError: nothing is given, or results or runs that do not belong together; nothing was written.
    """
    section = plan or plan_section(collection.evaluations, collection.runs)
    page = PageBuilder(title, on_figure=on_figure, max_bytes=max_bytes)
    page.add_header(_facts(collection, section.methods), places=_menu(section.methods), style=_STYLE)
    page.add_section("What is missing", _missing(collection.missing))
    page.add(cautions_html(cautions(section.methods)))
    page.add_section("Ranking", _rankings(section.methods, collection.evaluations), "ranking")
    page.add(*_tables(section))
    page.add_figures(section.pictures, lambda picture: _made_by(picture.task), heading=True)
    if collection.evaluations:
        page.add(explorer_html(collection.evaluations, _places("e", collection.evaluations)))
    page.add_section("What made every number", _commands(collection, command, train_commands), "commands")
    page.add_identities([(_name(result), result.identity) for result in collection.evaluations])
    return page.write(path)


def _facts(collection: Collection, methods: Methods) -> list[tuple[str, str]]:
    episodes = sum(len(result.episodes) for result in collection.evaluations)
    tasks = {*methods, *(run.task for run in collection.runs)}
    labels = {method.label for group in methods.values() for method in group}
    return [
        ("tasks", f"{len(tasks)}"),
        ("methods", f"{len(labels)}"),
        ("training runs", f"{len(collection.runs)}"),
        ("episodes", f"{episodes:,}"),
    ]


def _menu(methods: Methods) -> dict[str, str]:
    """Words of the links by place."""
    places = {"ranking": "Ranking", "tables": "Tables", "figures": "Figures", "episodes": "Episodes"}
    if not methods:
        places = {"figures": "Figures"}
    return places | {"commands": "Commands", "identity": "Identity"}


def _missing(sentences: Sequence[str]) -> str:
    items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in sentences)
    return f"<ul class=note>{items}</ul>" if items else ""


def _rankings(methods: Methods, results: Sequence[Evaluation]) -> str:
    """A table for each task; of many tasks, all but the first are folded, with the best method to be seen."""
    parts = []
    for number, (task, group) in enumerate(methods.items()):
        ranked = ranking(group)
        links = [_method_links(method, results) for method in ranked]
        short = html.escape(task.removeprefix("rl2grid/"))
        table = result_table_html(ranking_table(group), links=links, best_first=True)
        if len(methods) <= UNFOLDED_TASKS:
            parts.append(f"<h3>{short}</h3>{table}")
            continue
        best = f"{html.escape(ranked[0].label)}, survival {ranked[0].survival:.3f}"
        unfolded = " open" if number == 0 else ""
        parts.append(
            f"<details{unfolded}><summary><b>{short}</b> best of {len(ranked)}: {best}</summary>{table}</details>"
        )
    return "".join(parts)


def _method_links(method: Method, results: Sequence[Evaluation]) -> str:
    ids = {id(result) for result in method.evaluations}
    return " ".join(_link(f"e{k}") for k, result in enumerate(results, start=1) if id(result) in ids)


def _tables(section: Section) -> list[str]:
    parts = []
    for table in section.tables:
        # What does not fit in width stands in the overview the other way round.
        if table.name.startswith("survival-") and len(table.columns) > WIDEST and len(section.methods) > 1:
            continue
        heading = html.escape(table.name.replace("-", " ").capitalize())
        html_ = result_table_html(table, made=_made_by(""), best_first=table.name == "overview")
        parts.append(f"<section><h3>{heading}</h3>{html_}</section>")
    return ["<h2 id=tables>Tables</h2>", *parts] if parts else []


def _commands(collection: Collection, command: str, train_commands: Mapping[Path, str]) -> str:
    parts = [commands_html([("this page", command)])]
    tasks = dict.fromkeys(
        [*(result.episodes[0].task for result in collection.evaluations), *(run.task for run in collection.runs)]
    )
    for task in tasks:
        runs = [(f"r{k}", run) for k, run in enumerate(collection.runs, start=1) if run.task == task]
        results = [
            (f"e{k}", one) for k, one in enumerate(collection.evaluations, start=1) if one.episodes[0].task == task
        ]
        made = [(_named(place, _run_name(run)), train_commands[run.folder]) for place, run in runs]
        made += [(_named(place, _name(result)), result.command) for place, result in results]
        parts.append(
            f"<h3 id='{_task_id(task)}'>{html.escape(task.removeprefix('rl2grid/'))}</h3>{commands_html(made)}"
        )
    legend = (
        "e: evaluations, r: training runs. Tables, figures and intervals are computed from their episodes and metrics "
        "by the first command."
    )
    return f"<p class=note>{legend}</p>{''.join(parts)}"


def _made_by(task: str) -> str:
    return f" Made by <a href='#{_task_id(task)}'>these commands</a>."


def _named(place: str, name: str) -> str:
    return f"<span id={place}>{place}: {html.escape(name)}</span>"


def _name(result: Evaluation) -> str:
    task = result.episodes[0].task.removeprefix("rl2grid/")
    folder = f", {result.folder}" if result.folder else ""
    return f"{Method((result,)).label} on {task}, {len(result.episodes)} episodes{folder}"


def _run_name(run: TrainingRun) -> str:
    return f"{run.curve.label}, seed {run.seed}, {run.folder}"


def _places(letter: str, items: Sequence[object]) -> list[str]:
    return [f"{letter}{number}" for number in range(1, len(items) + 1)]


def _link(place: str) -> str:
    return f"<a href='#{place}'>{place}</a>"


def _task_id(task: str) -> str:
    return f"commands-{html.escape(task.removeprefix('rl2grid/'))}" if task else "commands"


_STYLE = """
body { max-width: 72rem; }
nav { display: flex; flex-wrap: wrap; gap: .4rem 1.2rem; margin-top: 1.25rem; }
h3 { font-size: 1rem; margin: 1.75rem 0 .5rem; }
section > figure { max-width: 60rem; }
td.links { max-width: 12rem; min-width: 4rem; white-space: normal; }
.typed td.words, .typed tr:last-child th { white-space: normal; }
.typed td.words:not(.links) { min-width: 6.2rem; }
@media (max-width: 40rem) { .scroll td:first-child { min-width: 5.5rem; white-space: normal; } }
"""
