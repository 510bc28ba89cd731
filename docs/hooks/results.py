"""Figures of the page of the results, drawn from the ledger while the site is built.

``docs/results.md`` names the tasks, with ``<!-- results: bus14-T0 -->``.
"""

from __future__ import annotations

import io
import re
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from rl2grid.analysis.ledger_figure import draw_ledger
from rl2grid.drawing.theme import DARK, LIGHT, Theme
from rl2grid.envs.tasks import find_task
from rl2grid.records.ledger import read_ledger

LEDGER = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "baselines.json"
PAGES = ("results.md", "index.md")
_MARK = re.compile(r"<!-- results: (\S+) -->")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Draw every task that a page asks for."""
    results = read_ledger(LEDGER)
    named = {task for page in PAGES for task in _MARK.findall(files.get_file_from_path(page).content_string)}
    for task in sorted(named):
        for theme in (LIGHT, DARK):
            figure, buffer = draw_ledger(results, find_task(task).id, theme=theme), io.BytesIO()
            FigureCanvasAgg(figure)
            figure.savefig(buffer, format="png", dpi=120)
            files.append(File.generated(config, _picture(task, theme), content=buffer.getvalue()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put the figures where the page asks for them."""
    return _MARK.sub(_shown, markdown) if page.file.src_uri in PAGES else markdown


def _shown(mark: re.Match[str]) -> str:
    pictures = (f"{_picture(mark[1], theme)}#only-{theme.name}" for theme in (LIGHT, DARK))
    return "".join(f"![survival on the test months of {mark[1]}]({picture})" for picture in pictures)


def _picture(task: str, theme: Theme) -> str:
    return f"assets/results/{task}-{theme.name}.png"
