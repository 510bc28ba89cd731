"""Pictures that hooks draw while the site is built: each in light and dark, of which pages show the one that fits."""

from __future__ import annotations

import io
from collections.abc import Callable

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from rl2grid.drawing.theme import DARK, LIGHT, Theme

DPI = 150


def add_picture(files: Files, config: MkDocsConfig, name: str, draw: Callable[..., Figure]) -> None:
    """Add a picture to the site, such as ``grids/bus14``; ``draw(theme=...)`` is called for both themes."""
    for theme in (LIGHT, DARK):
        figure, buffer = draw(theme=theme), io.BytesIO()
        FigureCanvasAgg(figure)
        figure.savefig(buffer, format="png", dpi=DPI)
        files.append(File.generated(config, _path(name, theme), content=buffer.getvalue()))


def picture_markdown(name: str, words: str) -> str:
    """What shows a picture on a page at the root of the site; ``words`` say what is to be seen."""
    return "".join(f"![{words}]({_path(name, theme)}#only-{theme.name})" for theme in (LIGHT, DARK))


def _path(name: str, theme: Theme) -> str:
    return f"assets/{name}-{theme.name}.png"
