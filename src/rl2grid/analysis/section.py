"""A results section: every table and figure that some evaluations and training runs allow, in one folder.

::

    index.md        what is in the folder, and what made it
    tables/         every table as Markdown, LaTeX (booktabs) and CSV
    figures/        every figure as PNG and PDF
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from matplotlib.figure import Figure

from rl2grid.analysis import comparison_figures as compare
from rl2grid.analysis import figures
from rl2grid.analysis.bounds_table import bounds_table
from rl2grid.analysis.cautions import cautions
from rl2grid.analysis.chart import Chart, lifetime_chart, profile_chart, training_chart
from rl2grid.analysis.curves import MOST_LINES, SMOOTHED_EPISODES
from rl2grid.analysis.ending_figures import draw_ending_bars, draw_ending_map
from rl2grid.analysis.result_tables import Methods, ranking, result_tables
from rl2grid.analysis.table import WRITERS, ResultTable
from rl2grid.analysis.training_figures import COST_PANELS, SCORE_PANELS, SURVIVAL_PANELS, draw_panels, logs
from rl2grid.drawing.theme import LIGHT, Theme
from rl2grid.envs.tasks import short_id
from rl2grid.errors import UsageError
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.files import make_folder, write_text
from rl2grid.records.methods import Method, group_bounds, group_methods
from rl2grid.records.trainings import TrainingCurve, TrainingRun, group_curves

INDEX_FILE, TABLES_FOLDER, FIGURES_FOLDER = "index.md", "tables", "figures"

ENDINGS_DRAWN = 4
"""Methods whose endings are drawn where there are more than can be told apart."""

CurvesByTask = Mapping[str, Mapping[str, Sequence[TrainingCurve]]]
"""By id of the task, then label."""


@dataclass(frozen=True)
class Picture:
    """A figure that can be drawn in any theme."""

    name: str
    """Of its files."""
    caption: str
    draw: Callable[[Theme], Figure]
    task: str = ""
    """Id of the task that it is about; empty where it is about several."""
    chart: Callable[[], Chart] | None = None
    """The same to be read in a browser; None: there is nothing to read that is not seen."""


@dataclass(frozen=True)
class Section:
    """What a results section is made of."""

    methods: Methods
    """By task, without those that know the future beside others; empty where nothing but training runs was given."""
    tables: tuple[ResultTable, ...]
    pictures: tuple[Picture, ...]


OnFile = Callable[[str], None]
"""Told the name of every table and figure before it is written."""


def plan_section(results: Sequence[Evaluation], runs: Sequence[TrainingRun] = ()) -> Section:
    """All tables and figures that apply; nothing is drawn yet.

    Who knows the future stands beside the others in a table of its own, and in no ranking or figure.

    Raises:
        UsageError: nothing is given, or results or runs that do not belong into one table or curve.
    """
    if not results and not runs:
        raise UsageError("There is nothing to analyse: give at least one evaluation or training run.")
    knowing, unaware = ([one for one in results if one.foresight is known] for known in (True, False))
    ranked = unaware or knowing
    methods = group_methods(ranked) if ranked else {}
    bounds = group_bounds(knowing, methods) if unaware and knowing else {}
    curves = group_curves(runs)
    drawn = {task: _trained_first(group, list(curves.get(task, ()))) for task, group in methods.items()}
    pictures = [*training_pictures(curves), *evaluation_pictures(drawn)]
    tables = result_tables(methods) if methods else ()
    if bounds:
        best_first = {task: ranking(group) for task, group in methods.items()}
        tables = (*tables, bounds_table(best_first, bounds))
    return Section(methods, tables, tuple(_distinct(pictures)))


def results_section(
    folder: Path,
    results: Sequence[Evaluation],
    runs: Sequence[TrainingRun] = (),
    *,
    command: str = "",
    theme: Theme = LIGHT,
    on_file: OnFile = lambda name: None,
    plan: Section | None = None,
) -> Path:
    """Write a results section and return the path of its index.

    Args:
        folder: made if need be; files of an earlier section are replaced.
        results: evaluations, of one or several tasks; those of one agent and heuristic are runs of one method.
        runs: training runs; those of one label are runs of one method.
        command: what was typed to obtain the section.
        theme: colours of the figures.
        on_file: told of every table and figure.
        plan: of these results and runs, where :func:`plan_section` made it already; None: it is made.

    Raises:
        UsageError: nothing is given, or results or runs that do not belong together; nothing was written.
    """
    section = plan or plan_section(results, runs)
    for name in (TABLES_FOLDER, FIGURES_FOLDER):
        make_folder(folder / name)
    for table in section.tables:
        on_file(table.name)
        for suffix, writer in WRITERS.items():
            write_text(folder / TABLES_FOLDER / f"{table.name}.{suffix}", writer(table))
    for picture in section.pictures:
        on_file(picture.name)
        figures.save_figure(picture.draw(theme), folder / FIGURES_FOLDER / picture.name)
    # Last: where there is an index, everything it lists is there.
    write_text(folder / INDEX_FILE, _index(section, results, runs, command))
    return folder / INDEX_FILE


def training_pictures(curves: CurvesByTask) -> Iterator[Picture]:
    """Figures over training, for every task."""
    for task, group in curves.items():
        short, runs = short_id(task), [run for labelled in group.values() for run in labelled]
        yield Picture(
            f"training-{short}",
            f"Survival in training on {short}, mean over {SMOOTHED_EPISODES} episodes; diamonds: validation.",
            lambda theme, runs=runs, short=short: figures.training_curves(  # type: ignore[misc]
                runs, theme=theme, title=f"Survival in training: {short}"
            ),
            task,
            lambda group=group, short=short: training_chart(  # type: ignore[misc]
                group, SURVIVAL_PANELS, title=f"Survival in training: {short}"
            ),
        )
        for name, panels, words in (
            ("scores", SCORE_PANELS, "Operational scores"),
            ("costs", COST_PANELS, "Costs against their thresholds"),
        ):
            if logs(group, panels):
                yield Picture(
                    f"training-{name}-{short}",
                    f"{words} of training episodes on {short}.",
                    lambda theme, group=group, panels=panels, title=f"{words}: {short}": draw_panels(  # type: ignore[misc]
                        group, panels, title=title, theme=theme
                    ),
                    task,
                    lambda group=group, panels=panels, title=f"{words}: {short}": training_chart(  # type: ignore[misc]
                        group, panels, title=title
                    ),
                )


def evaluation_pictures(methods: Methods) -> Iterator[Picture]:
    """Figures of evaluations: of every task, and of grids that were played on several levels."""
    for task, group in methods.items():
        for picture in _task_pictures(short_id(task), tuple(group)):
            yield replace(picture, task=task)
    for grid, group in _by_grid(methods).items():
        yield _of_methods("levels", grid, group, "Survival on the levels of difficulty of", compare.draw_levels)


def _trained_first(methods: Sequence[Method], trained: Sequence[str]) -> tuple[Method, ...]:
    """The methods in the order of their training curves, so that a method has one colour in both."""
    places = {label: place for place, label in enumerate(trained)}
    return tuple(sorted(methods, key=lambda method: places.get(method.label, len(places))))


def _task_pictures(short: str, group: tuple[Method, ...]) -> Iterator[Picture]:
    ranked = tuple(ranking(group))
    yield _of_methods("aggregates", short, ranked, "Mean, median, IQM and optimality gap on", compare.draw_aggregates)
    profiles = _of_methods(
        "profiles", short, group, "Share of episodes that survive beyond each share on", compare.draw_profiles
    )
    yield replace(profiles, chart=lambda: profile_chart(group, title=f"Performance profiles: {short}"))
    alive = _of_methods("lifetimes", short, group, "Share of grids alive over time on", compare.draw_lifetimes)
    yield replace(alive, chart=lambda: lifetime_chart(group, title=f"Time to failure: {short}"))
    yield _of_methods("costs", short, ranked, "Costs against their thresholds on", compare.draw_costs)
    yield _of_methods("months", short, group, "Survival by method and month on", compare.draw_scenarios)
    if len(group) > 1:
        yield _of_methods("improvements", short, ranked, "Probability of improvement on", compare.draw_improvements)
        pair = compare.best_pair(group)
        caption = f"The two methods that survive longest on {short}, month by month."
        yield Picture(f"best-two-{short}", caption, lambda theme: compare.draw_two_methods(*pair, theme=theme))
    if compare.varied(group):
        chosen = compare.varied(group)
        yield _of_methods("heuristics", short, chosen, "Survival by heuristic on", compare.draw_heuristics)
    # Of many methods, maps of the best: nobody looks at forty.
    for method in ranked if len(ranked) <= MOST_LINES else ranked[:ENDINGS_DRAWN]:
        if not all(episode.completed for episode in method.episodes):
            yield from _ending_pictures(short, method)


def _ending_pictures(short: str, method: Method) -> Iterator[Picture]:
    grid, episodes = method.task.grid, method.episodes
    title = f"Where grids collapse: {method.label} on {short}"
    name = f"{short}-{_file_name(method.label)}"
    for kind, draw, words in (("bars", draw_ending_bars, "in numbers"), ("map", draw_ending_map, "on the grid")):
        yield Picture(
            f"endings-{kind}-{name}",
            f"Lines and substations with which episodes of {method.label} on {short} were lost, {words}.",
            lambda theme, draw=draw: draw(grid, episodes, title=title, theme=theme),  # type: ignore[misc]
        )


def _file_name(label: str) -> str:
    """A label as part of the name of a file."""
    return re.sub(r"[^\w.]+", "-", label).strip("-")


def _distinct(pictures: Iterable[Picture]) -> Iterator[Picture]:
    """The pictures, those with the name of an earlier one numbered: labels may differ in what names of files lack."""
    taken: set[str] = set()
    for picture in pictures:
        name, number = picture.name, 1
        while name.lower() in taken:
            number += 1
            name = f"{picture.name}-{number}"
        taken.add(name.lower())
        yield replace(picture, name=name)


def _of_methods(name: str, place: str, methods: Sequence[Method], words: str, draw: Callable[..., Figure]) -> Picture:
    return Picture(f"{name}-{place}", f"{words} {place}.", lambda theme: draw(methods, theme=theme))


def _by_grid(methods: Methods) -> dict[str, list[Method]]:
    """Methods of the unconstrained topology tasks of grids of which several levels were played."""
    groups: dict[str, list[Method]] = {}
    for group in methods.values():
        if group[0].task.kind == "T" and group[0].task.constraint is None:
            groups.setdefault(group[0].task.grid_id, []).extend(group)
    return {grid: group for grid, group in groups.items() if len({method.task.level for method in group}) > 1}


def _index(section: Section, results: Sequence[Evaluation], runs: Sequence[TrainingRun], command: str) -> str:
    lines = ["# Results", ""]
    if command:
        lines += ["Everything here was made by", "", f"    {command}", ""]
    mind = cautions(section.methods)
    lines += ["## Mind", "", *(f"- {sentence}" for sentence in mind), ""] if mind else []
    lines += ["## Tables", ""] if section.tables else []
    for table in section.tables:
        links = ", ".join(f"[{suffix}]({TABLES_FOLDER}/{table.name}.{suffix})" for suffix in WRITERS)
        lines.append(f"- **{table.name}** ({links}): {table.caption}")
    lines += ["", "## Figures", ""]
    for picture in section.pictures:
        links = ", ".join(f"[{suffix}]({FIGURES_FOLDER}/{picture.name}.{suffix})" for suffix in ("png", "pdf"))
        lines.append(f"- **{picture.name}** ({links}): {picture.caption}")
    lines += ["", "## What they are made from", ""]
    lines += [f"- {short_id(r.episodes[0].task)}, {r.episodes[0].agent}: `{r.command}`" for r in results]
    lines += [
        f"- {short_id(run.task)}, {run.curve.label}: training run `{run.folder}`, seed {run.seed}" for run in runs
    ]
    return "\n".join(lines) + "\n"
