"""Builds every page of results: header, sections, figures in light and dark, commands and identities.

The page needs no other file and no network, and its figures are made smaller until it fits.
"""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from rl2grid.analysis import figures
from rl2grid.analysis.chart import Chart, chart_assets, chart_html
from rl2grid.analysis.page import facts_html, figure_html, identities_html, write_page
from rl2grid.analysis.section import Picture
from rl2grid.drawing.theme import DARK, LIGHT
from rl2grid.envs.tasks import short_id
from rl2grid.records.files import make_folder

MAX_BYTES = 20_000_000
"""Of a page; figures of a larger one are made smaller."""
SMALLEST = 0.4
"""Of their resolution."""
UNFOLDED = 60
"""Figures that stand one below the other; more are folded by task."""

MadeBy = Callable[[Picture], str]
"""HTML behind the caption of a figure, which says what made it."""


@dataclass(frozen=True)
class _Drawn:
    """A figure as PNG, or as a chart."""

    picture: Picture
    light: bytes = b""
    dark: bytes = b""
    chart: Chart | None = None


class PageBuilder:
    """A page in the making: parts in the order in which they are added."""

    def __init__(
        self, title: str, *, on_figure: Callable[[str], None] = lambda name: None, max_bytes: int = MAX_BYTES
    ) -> None:
        """An empty page.

        Args:
            title: of the window, and headline.
            on_figure: told the name of every figure before it is drawn.
            max_bytes: what the page may have; the resolution of the figures is lowered until it fits, within reason.
        """
        self._title, self._on_figure, self._max_bytes = title, on_figure, max_bytes
        self._before: list[str] = []
        self._after: list[str] = []
        self._parts = self._before
        self._drawn: list[_Drawn] = []
        self._made_by: MadeBy = lambda picture: ""
        self._heading = False

    def add(self, *parts: str) -> None:
        """Add HTML."""
        self._parts.extend(part for part in parts if part)

    def add_header(
        self,
        facts: Sequence[tuple[str, str]],
        *,
        introduction: str = "",
        places: Mapping[str, str] | None = None,
        style: str = "",
    ) -> None:
        """Add the headline, facts as cards, and links to places of the page.

        Args:
            facts: names and values.
            introduction: a sentence or two below the headline.
            places: words of each link by the id that it leads to; None: no links.
            style: rules of this page alone.
        """
        lead = f"<p>{html.escape(introduction)}</p>" if introduction else ""
        links = " ".join(f"<a href='#{place}'>{words}</a>" for place, words in (places or {}).items())
        menu = f"<nav>{links}</nav>" if links else ""
        rules = f"<style>{style}</style>" if style else ""
        self.add(f"{rules}<header><h1>{html.escape(self._title)}</h1>{lead}{facts_html(facts)}{menu}</header>")

    def add_section(self, heading: str, body: str, place: str = "") -> None:
        """Add HTML below a heading, with the id ``place``; nothing without a body."""
        if body:
            name = f" id={place}" if place else ""
            self.add(f"<section><h2{name}>{html.escape(heading)}</h2>{body}</section>")

    def add_figures(
        self, pictures: Iterable[Picture], made_by: MadeBy, *, heading: bool = False, folder: Path | None = None
    ) -> None:
        """Draw the figures of the page; there is one such place.

        Args:
            pictures: in this order.
            made_by: what made each of them.
            heading: whether they stand below a heading, folded by task where they are many.
            folder: where they are also written as PNG and PDF; None: nowhere.
        """
        if folder is not None:
            make_folder(folder)
        for picture in pictures:
            self._on_figure(picture.name)
            self._drawn.append(_drawn(picture, folder))
        self._made_by, self._heading, self._parts = made_by, heading, self._after

    def add_identities(self, identities: Sequence[tuple[str, Mapping[str, Any]]]) -> None:
        """Add names and identities, each to be unfolded."""
        self.add(identities_html(identities))

    def write(self, path: Path) -> int:
        """Write the page, whole or not at all, and return its size in bytes."""
        charts = "".join(self._figure(one) for one in self._drawn if one.chart)
        assets = [chart_assets()] if charts else []
        others = sum(len(part.encode()) for part in (*self._before, *self._after, *assets, charts))
        drawn = _fitted(self._drawn, max(self._max_bytes - others, 0))
        write_page(path, self._title, [*self._before, *self._figures(drawn), *self._after, *assets])
        return path.stat().st_size

    def _figures(self, drawn: Sequence[_Drawn]) -> list[str]:
        """All figures; folded by task where they are many."""
        if not drawn:
            return []
        if not self._heading:
            return [*map(self._figure, drawn)]
        if len(drawn) <= UNFOLDED:
            return ["<h2 id=figures>Figures</h2>", *map(self._figure, drawn)]
        by_task: dict[str, list[_Drawn]] = {}
        for one in drawn:
            by_task.setdefault(one.picture.task, []).append(one)
        folded = [
            f"<details><summary>{html.escape(short_id(task) or 'Several tasks')}: {len(group)} figures</summary>"
            f"{''.join(map(self._figure, group))}</details>"
            for task, group in by_task.items()
        ]
        return [f"<section><h2 id=figures>Figures</h2>{''.join(folded)}</section>"]

    def _figure(self, drawn: _Drawn) -> str:
        if drawn.chart:
            return chart_html(drawn.chart, drawn.picture.caption, self._made_by(drawn.picture))
        return figure_html(drawn.picture.caption, drawn.light, drawn.dark, self._made_by(drawn.picture))


def _drawn(picture: Picture, folder: Path | None) -> _Drawn:
    """A figure as the page shows it, also written to a folder if there is one."""
    if folder is None and picture.chart:
        return _Drawn(picture, chart=picture.chart())
    light = picture.draw(LIGHT)
    if folder is not None:
        figures.save_figure(light, folder / picture.name)
    if picture.chart:
        return _Drawn(picture, chart=picture.chart())
    return _Drawn(picture, figures.png_bytes(light), figures.png_bytes(picture.draw(DARK)))


def _fitted(drawn: Sequence[_Drawn], max_bytes: int) -> Sequence[_Drawn]:
    """The figures, smaller if they would be more than ``max_bytes`` in base64."""
    scale = 1.0
    fitting = drawn
    while sum(len(one.light) + len(one.dark) for one in fitting) * 4 / 3 > max_bytes and scale > SMALLEST:
        scale = max(0.8 * scale, SMALLEST)
        fitting = [
            one if one.chart else _Drawn(one.picture, _scaled(one.light, scale), _scaled(one.dark, scale))
            for one in drawn
        ]
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
