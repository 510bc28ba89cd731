"""Results on the pages, made from the ledger while the site is built: a figure and a short table of each task.

Pages name the tasks, with ``<!-- results: bus14-T0 -->``, or with ``<!-- figure: bus14-T0 -->`` for the figure alone;
``<!-- overview -->`` is the table of all tasks, ``<!-- learned -->`` that of ways of learning,
``<!-- looks -->`` what learning adds to a look, ``<!-- untrained -->`` that of who learns nothing,
``<!-- heuristics -->`` agents by heuristic, ``<!-- bounds -->`` what those survive who know what comes, beside who does
not.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page
from pictures import add_picture, picture_markdown

from rl2grid.analysis.ledger_bounds import headroom_table
from rl2grid.analysis.ledger_figure import draw_ledger
from rl2grid.analysis.ledger_heuristics import heuristic_table
from rl2grid.analysis.ledger_learned import learned_table
from rl2grid.analysis.ledger_looks import looks_table
from rl2grid.analysis.ledger_overview import overview_table
from rl2grid.analysis.ledger_table import short_ledger_table
from rl2grid.analysis.ledger_untrained import Milliseconds, untrained_table
from rl2grid.envs.tasks import find_task
from rl2grid.records.ledger import HashedTest, read_ledger

RESULTS = Path(__file__).resolve().parents[2] / "benchmarks" / "results"
BASELINES, PAPER, BEGINNINGS, BOUNDS, TIMES = (
    RESULTS / f"{name}.json" for name in ("baselines", "paper", "look_alone", "bounds", "decision_time")
)
LEDGERS = {"results.md": BASELINES, "index.md": BASELINES, "paper.md": PAPER}
"""Of each page."""
_TABLES = {
    "<!-- overview -->": overview_table,
    "<!-- learned -->": learned_table,
    "<!-- looks -->": lambda results: looks_table(results, read_ledger(BEGINNINGS)),
    "<!-- heuristics -->": heuristic_table,
    "<!-- untrained -->": lambda results: untrained_table(results, _milliseconds()),
    "<!-- bounds -->": lambda results: headroom_table(results, read_ledger(BOUNDS)),
}
_MARK = re.compile(r"<!-- (results|figure): (\S+) -->")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Draw every task that a page asks for."""
    for ledger in dict.fromkeys(LEDGERS.values()):
        results, pages = read_ledger(ledger), [page for page, own in LEDGERS.items() if own == ledger]
        named = {mark[2] for page in pages for mark in _MARK.finditer(files.get_file_from_path(page).content_string)}
        for task in sorted(named):
            add_picture(files, config, _picture(ledger, task), partial(draw_ledger, results, find_task(task).id))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put figures and tables where the page asks for them."""
    ledger = LEDGERS.get(page.file.src_uri)
    if ledger is None:
        return markdown
    results = read_ledger(ledger)
    shown = _MARK.sub(partial(_shown, ledger, results), markdown)
    for mark, table in _TABLES.items():
        if mark in shown:
            shown = shown.replace(mark, table(results))
    return shown


def _picture(ledger: Path, task: str) -> str:
    return f"{ledger.stem}/{task}"


def _shown(ledger: Path, results: Mapping[str, HashedTest], mark: re.Match[str]) -> str:
    kind, task = mark.groups()
    figure = picture_markdown(_picture(ledger, task), f"survival on the test months of {task}")
    if kind == "figure":
        return figure
    return f"{figure}\n\n{short_ledger_table(results, find_task(task).id)}"


def _milliseconds() -> Milliseconds:
    """Of decisions, as ``benchmarks/decision_time.py`` has measured them: median and 99 of 100."""
    return {
        (task, *_agent_and_heuristic(name)): tuple(row["milliseconds"][1:])
        for task, measured in json.loads(TIMES.read_text()).items()
        for name, row in measured["rows"].items()
    }


def _agent_and_heuristic(name: str) -> tuple[str, str | None]:
    agent, _, heuristic = name.partition(":")
    return agent, heuristic or None
