"""The report of a demonstration, about one task: a page, the same table as Markdown, and the figures as files.

::

    report.html      the page: no other file and no network needed, for phones and desks, light and dark
    results.md       the table
    figures/         every figure as PNG and PDF
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from rl2grid.analysis import figures, summary_table
from rl2grid.analysis.cautions import cautions
from rl2grid.analysis.chart import training_chart
from rl2grid.analysis.comparison_table import reference_table
from rl2grid.analysis.page import (
    cautions_html,
    cell_html,
    code_html,
    commands_html,
    result_table_html,
    scrolling,
    table_html,
)
from rl2grid.analysis.page_builder import PageBuilder
from rl2grid.analysis.section import Picture
from rl2grid.analysis.table import table_markdown
from rl2grid.analysis.training_figures import SURVIVAL_PANELS
from rl2grid.drawing.theme import Theme
from rl2grid.records.evaluations import Evaluation, check_comparable
from rl2grid.records.files import write_text
from rl2grid.records.methods import group_methods
from rl2grid.records.recordings import Recording
from rl2grid.records.summary import Summary
from rl2grid.records.trainings import TrainingCurve

REPORT_FILE, TABLE_FILE, FIGURES_FOLDER = "report.html", "results.md", "figures"


def write_demo_report(
    folder: Path,
    results: Sequence[Evaluation],
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
        results: evaluations of one task, at least one; the table has the best first, and compares them with the
            first given.
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
    ranked = sorted(summaries, key=lambda summary: -summary.survival.value)
    page = PageBuilder(title)
    # Wide enough for all columns of the table on a desk.
    page.add_header(_facts(summaries), introduction=introduction, style="body { max-width: 72rem; }")
    legend = f"<p class=note>{html.escape(summary_table.LEGEND)}</p>"
    by_task = group_methods(results)
    (methods,) = by_task.values()
    page.add(cautions_html(cautions(by_task)))
    differences = [reference_table(methods)] if len(methods) > 1 else []
    page.add_section("Results", f"{_table_html(ranked)}{legend}{''.join(map(result_table_html, differences))}")
    pictures = _pictures(results, curves, recordings)
    page.add_figures(pictures, lambda picture: _made_by(picture, commands), folder=folder / FIGURES_FOLDER)
    page.add_section("How episodes ended", _endings_html(ranked))
    page.add_section("What made every number", _commands_html(results, commands))
    page.add_identities([(result.summary.agent, result.identity) for result in results])
    tables = [f"{summary_table.markdown_table(ranked)}\n{summary_table.LEGEND}\n", *map(table_markdown, differences)]
    write_text(folder / TABLE_FILE, "\n".join([f"# {title}\n", *tables]))
    page.write(folder / REPORT_FILE)
    return folder / REPORT_FILE


def _pictures(
    results: Sequence[Evaluation],
    curves: Sequence[TrainingCurve],
    recordings: Sequence[Recording],
) -> list[Picture]:
    pictures = [
        Picture(
            "survival",
            "Survival of every evaluated episode, with mean and 95% interval.",
            lambda theme: figures.survival_by_agent(results, theme=theme),
        )
    ]
    if curves:
        pictures.append(
            Picture(
                "training",
                "Survival of the episodes that ended in training, smoothed; diamonds: validation scenarios.",
                lambda theme: figures.training_curves(curves, theme=theme),
                chart=lambda: training_chart({"": curves}, SURVIVAL_PANELS, title="Survival in training"),
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
        pictures.append(Picture(f"episode-{number}-{recording.agent}", caption, draw))
    return pictures


def _made_by(picture: Picture, commands: Mapping[str, str]) -> str:
    """The command of a figure."""
    kind = "episodes" if picture.name.startswith("episode-") else picture.name
    return code_html(commands.get(kind, ""))


def _facts(summaries: Sequence[Summary]) -> list[tuple[str, str]]:
    best = max(summaries, key=lambda summary: summary.survival.value)
    first = summaries[0]
    return [
        ("task", first.task.removeprefix("rl2grid/")),
        ("best survival", f"{100 * best.survival.value:.1f}%"),
        ("by", best.agent + ("" if best.heuristic == "none" else f" + {best.heuristic}")),
        ("episodes per agent", str(first.episodes)),
    ]


def _table_html(summaries: Sequence[Summary]) -> str:
    head = "".join(f"<th>{html.escape(heading)}</th>" for heading in summary_table.HEADINGS)
    rows = []
    for summary in summaries:
        cells = "".join(f"<td>{cell_html(cell)}</td>" for cell in summary_table.table_cells(summary))
        rows.append(f"<tr{' class=best' if summary_table.is_best(summary, summaries) else ''}>{cells}</tr>")
    return scrolling(head, "".join(rows))


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
    return table_html(headings, rows)


def _commands_html(results: Sequence[Evaluation], commands: Mapping[str, str]) -> str:
    made = [(f"results of {html.escape(result.summary.agent)}", result.command) for result in results]
    made += [(html.escape(purpose), command) for purpose, command in commands.items()]
    return commands_html(made)
