"""Everything that some evaluations and training runs allow, as one HTML page that needs no other file and no network.

A ranking of every task, all tables and figures of a results section, a table of episodes to sort and filter, and the
command behind every number.
"""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from rl2grid.analysis import figures
from rl2grid.analysis.explorer import explorer_html
from rl2grid.analysis.page import (
    commands_html,
    facts_html,
    figure_html,
    identities_html,
    result_table_html,
    write_page,
)
from rl2grid.analysis.result_tables import Methods, ranking, ranking_table
from rl2grid.analysis.section import Picture, Section, plan_section
from rl2grid.drawing.theme import DARK, LIGHT
from rl2grid.envs.tasks import short_id
from rl2grid.records.collection import Collection
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.methods import Method, method_label
from rl2grid.records.trainings import TrainingRun

MAX_BYTES = 20_000_000
"""Of a page; figures of a larger one are made smaller."""
SMALLEST = 0.4
"""Of their resolution."""
UNFOLDED = 60
"""Figures that stand one below the other; more are folded by task."""


@dataclass(frozen=True)
class _Drawn:
    """A figure as PNG."""

    picture: Picture
    light: bytes
    dark: bytes


def write_results_page(
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
    drawn = [_draw(picture, on_figure) for picture in section.pictures]
    before = [_header(title, collection, section.methods)]
    before += [*_missing(collection.missing), *_rankings(section.methods, collection.evaluations)]
    before += _tables(section)
    after = (
        [explorer_html(collection.evaluations, _places("e", collection.evaluations))] if collection.evaluations else []
    )
    after += [_commands(collection, command, train_commands)]
    after += [identities_html([(_name(result), result.identity) for result in collection.evaluations])]
    others = sum(len(part.encode()) for part in (*before, *after))
    fitting = _fitted(drawn, max(max_bytes - others, 0))
    write_page(path, title, [*before, *_figures(fitting), *after])
    return path.stat().st_size


def _draw(picture: Picture, on_figure: Callable[[str], None]) -> _Drawn:
    on_figure(picture.name)
    return _Drawn(picture, figures.png_bytes(picture.draw(LIGHT)), figures.png_bytes(picture.draw(DARK)))


def _fitted(drawn: Sequence[_Drawn], max_bytes: int) -> Sequence[_Drawn]:
    """The figures, smaller if they would be more than ``max_bytes`` in base64."""
    scale = 1.0
    fitting = drawn
    while sum(len(one.light) + len(one.dark) for one in fitting) * 4 / 3 > max_bytes and scale > SMALLEST:
        scale = max(0.8 * scale, SMALLEST)
        fitting = [_Drawn(one.picture, _scaled(one.light, scale), _scaled(one.dark, scale)) for one in drawn]
    return fitting


def _scaled(png: bytes, scale: float) -> bytes:
    image = Image.open(io.BytesIO(png)).convert("RGB")
    size = (round(scale * image.width), round(scale * image.height))
    file = io.BytesIO()
    # 256 colours are enough for figures, and a third of the bytes.
    image.resize(size, Image.Resampling.LANCZOS).quantize(256, dither=Image.Dither.NONE).save(
        file, "png", optimize=True
    )
    return file.getvalue()


def _header(title: str, collection: Collection, methods: Methods) -> str:
    episodes = sum(len(result.episodes) for result in collection.evaluations)
    tasks = {*methods, *(run.task for run in collection.runs)}
    labels = {method.label for group in methods.values() for method in group}
    facts = [
        ("tasks", f"{len(tasks)}"),
        ("methods", f"{len(labels)}"),
        ("training runs", f"{len(collection.runs)}"),
        ("episodes", f"{episodes:,}"),
    ]
    places = {"ranking": "Ranking", "tables": "Tables", "figures": "Figures", "episodes": "Episodes"}
    if not methods:
        places = {"figures": "Figures"}
    places |= {"commands": "Commands", "identity": "Identity"}
    links = " ".join(f"<a href='#{place}'>{words}</a>" for place, words in places.items())
    return f"<style>{_STYLE}</style><header><h1>{html.escape(title)}</h1>{facts_html(facts)}<nav>{links}</nav></header>"


def _missing(sentences: Sequence[str]) -> list[str]:
    if not sentences:
        return []
    items = "".join(f"<li>{html.escape(sentence)}</li>" for sentence in sentences)
    return [f"<section><h2>What is missing</h2><ul class=note>{items}</ul></section>"]


def _rankings(methods: Methods, results: Sequence[Evaluation]) -> list[str]:
    parts = []
    for task, group in methods.items():
        links = [_method_links(method, results) for method in ranking(group)]
        short = html.escape(task.removeprefix("rl2grid/"))
        parts.append(f"<h3>{short}</h3>{result_table_html(ranking_table(group), links=links)}")
    return [f"<section><h2 id=ranking>Ranking</h2>{''.join(parts)}</section>"] if parts else []


def _method_links(method: Method, results: Sequence[Evaluation]) -> str:
    ids = {id(result) for result in method.evaluations}
    return " ".join(_link(f"e{k}") for k, result in enumerate(results, start=1) if id(result) in ids)


def _tables(section: Section) -> list[str]:
    parts = []
    for table in section.tables:
        heading = html.escape(table.name.replace("-", " ").capitalize())
        parts.append(f"<section><h3>{heading}</h3>{result_table_html(table, made=_made_by(''))}</section>")
    return ["<h2 id=tables>Tables</h2>", *parts] if parts else []


def _figures(drawn: Sequence[_Drawn]) -> list[str]:
    """All figures; folded by task where they are many."""
    if not drawn:
        return []
    if len(drawn) <= UNFOLDED:
        return ["<h2 id=figures>Figures</h2>", *map(_figure, drawn)]
    by_task: dict[str, list[_Drawn]] = {}
    for one in drawn:
        by_task.setdefault(one.picture.task, []).append(one)
    folded = [
        f"<details><summary>{html.escape(short_id(task) or 'Several tasks')}: {len(group)} figures</summary>"
        f"{''.join(map(_figure, group))}</details>"
        for task, group in by_task.items()
    ]
    return [f"<section><h2 id=figures>Figures</h2>{''.join(folded)}</section>"]


def _figure(drawn: _Drawn) -> str:
    return figure_html(drawn.picture.caption, drawn.light, drawn.dark, _made_by(drawn.picture.task))


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
    return f"<section><h2 id=commands>What made every number</h2><p class=note>{legend}</p>{''.join(parts)}</section>"


def _made_by(task: str) -> str:
    return f" Made by <a href='#{_task_id(task)}'>these commands</a>."


def _named(place: str, name: str) -> str:
    return f"<span id={place}>{place}: {html.escape(name)}</span>"


def _name(result: Evaluation) -> str:
    first = result.episodes[0]
    folder = f", {result.folder}" if result.folder else ""
    return f"{method_label(first)} on {first.task.removeprefix('rl2grid/')}, {len(result.episodes)} episodes{folder}"


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
@media (max-width: 40rem) { td:first-child { min-width: 5.5rem; white-space: normal; } }
"""
