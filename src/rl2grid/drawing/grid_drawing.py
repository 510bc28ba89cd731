"""A grid as a drawing: substations, lines coloured by loading, generators, loads and storage units.

::

    disc with number       substation with everything on one busbar
    two bars               split substation: busbar 1 above, busbar 2 below; elements end on theirs
    line                   colour and width: loading; dashed: out of service
    circle with a wave     generator
    triangle               load
    square                 storage unit; the size of all three symbols: MW, where they are known

What never changes (places of symbols, courses of lines, numbers) is computed once; :meth:`GridDrawing.show` moves
and colours what does. :class:`FrameRenderer` draws picture after picture, as animations need.
"""

from __future__ import annotations

import dataclasses
import functools
import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PatchCollection, PolyCollection
from matplotlib.colors import Colormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.textpath import TextPath
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from rl2grid.arrays import I32, Flags
from rl2grid.drawing import theme as themes
from rl2grid.drawing.theme import FULL_SCALE, GREEN, LIGHT, PURPLE, Theme, style
from rl2grid.errors import UsageError
from rl2grid.grids import Grid

Points = NDArray[np.float64]

HIGHLIGHT = "#F0E442"
"""Yellow of Okabe and Ito: behind what a picture is about, as with a text marker."""

# Lengths, in units of the drawing (about the distance of the nearest substations).
_DISC, _BAR, _GAP = 0.21, 0.3, 0.19
_SYMBOL, _SYMBOL_DISTANCE = 0.12, 0.6
_BESIDE = 0.14
"""Distance of parallel lines."""
_DIGIT = 0.22
_DIRECTIONS = 32
SMALLEST_SYMBOL, LARGEST_SYMBOL = 0.5, 1.6
"""Sizes of symbols at no power and at the largest of the grid, as factors."""
_APART = 0.3
"""Least distance of two symbols."""
_SENTENCE_LENGTH = 170
"""Letters that fit on one line of a caption."""


@dataclass(frozen=True, eq=False)
class Scene:
    """What a picture shows of a grid."""

    topo_vect: I32
    """[topo] busbar of each element, 1 or 2; -1 when disconnected."""
    rho: NDArray[np.float32]
    """[line] loading; NaN where it is not known."""
    attacked: Flags
    """[line] out by the opponent."""
    maintained: Flags
    """[line] out for planned maintenance."""
    highlighted: Flags
    """[topo] elements that the picture is about."""
    gen_p: NDArray[np.float32]
    """[gen] MW; NaN where it is not known."""
    load_p: NDArray[np.float32]
    """[load] MW; NaN where it is not known."""
    storage_power: NDArray[np.float32]
    """[storage] MW; NaN where it is not known."""


class Caption(NamedTuple):
    """What is said above a picture."""

    headline: str
    sentence: str


NO_CAPTION = Caption("", "")


def reference_scene(grid: Grid) -> Scene:
    """Everything in service and on busbar 1, loadings not known."""
    no_line = np.zeros(grid.n_line, np.bool_)
    return Scene(
        topo_vect=np.ones(grid.dim_topo, np.int32),
        rho=np.full(grid.n_line, np.nan, np.float32),
        attacked=no_line,
        maintained=no_line,
        highlighted=np.zeros(grid.dim_topo, np.bool_),
        gen_p=np.full(grid.n_gen, np.nan, np.float32),
        load_p=np.full(grid.n_load, np.nan, np.float32),
        storage_power=np.full(grid.n_storage, np.nan, np.float32),
    )


def largest_power(grid: Grid) -> float:
    """The power, in MW, that has the largest symbol."""
    return max(float(grid.gen_pmax.max()), float(grid.load_p_max.max()))


def symbol_scale(grid: Grid, power: NDArray[np.float32]) -> Points:
    """How large symbols are for a power in MW: their area grows with it, and the smallest is still seen.

    Returns:
        Factors of the usual size, the shape of ``power``; 1 where the power is NaN.
    """
    share = np.minimum(1.0, np.abs(power) / largest_power(grid))
    return np.where(np.isnan(power), 1.0, SMALLEST_SYMBOL + (LARGEST_SYMBOL - SMALLEST_SYMBOL) * np.sqrt(share))


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where things are; lengths in the units of ``Grid.layout``."""

    unit: float
    centre: Points
    """[sub, 2]"""
    symbol: Points
    """[generators, loads, storages; 2]"""
    symbol_element: I32
    """[symbol] entry of ``topo_vect``."""
    line_middle: Points
    """[line, 2, 2] where a line begins and ceases to run beside its parallels."""
    towards: Points
    """[topo, 2] unit vector from the substation to where an element lies."""


@functools.cache
def geometry_of(grid: Grid) -> Geometry:
    """Where the substations, lines and symbols of a grid are drawn.

    Raises:
        UsageError: the grid has no layout.
    """
    centre = np.array(grid.layout, np.float64)
    distance = np.linalg.norm(centre[:, None] - centre[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    unit = float(np.quantile(distance.min(axis=1), 0.2))
    if not unit > 0:
        raise UsageError(f"{grid.id} cannot be drawn: its record does not say where its substations are.")
    line_middle = _line_middles(grid, centre, unit)
    element = np.concatenate((grid.gen_pos_topo_vect, grid.load_pos_topo_vect, grid.storage_pos_topo_vect))
    symbol = _place_symbols(grid, centre, unit, grid.element_to_subid[element])
    goal = np.empty((grid.dim_topo, 2))
    goal[grid.line_or_pos_topo_vect] = line_middle[:, 0]
    goal[grid.line_ex_pos_topo_vect] = line_middle[:, 1]
    goal[element] = symbol
    return Geometry(unit, centre, symbol, element, line_middle, _unit_vectors(goal - centre[grid.element_to_subid]))


def _unit_vectors(vectors: Points) -> Points:
    directions: Points = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
    return directions


def _line_middles(grid: Grid, centre: Points, unit: float) -> Points:
    origin, extremity = centre[grid.line_or_to_subid], centre[grid.line_ex_to_subid]
    pairs = [tuple(sorted(pair)) for pair in zip(grid.line_or_to_subid, grid.line_ex_to_subid, strict=True)]
    count, seen = Counter(pairs), Counter[tuple[int, ...]]()
    place = np.zeros(grid.n_line)
    for line, pair in enumerate(pairs):
        place[line] = seen[pair] - (count[pair] - 1) / 2
        seen[pair] += 1
    # Parallel lines need one side of their pair, whichever way each of them runs.
    forward = grid.line_or_to_subid < grid.line_ex_to_subid
    along = _unit_vectors(np.where(forward[:, None], extremity - origin, origin - extremity))
    beside = np.stack((-along[:, 1], along[:, 0]), axis=1) * (place * _BESIDE * unit)[:, None]
    length = np.linalg.norm(extremity - origin, axis=1)
    share = np.minimum(0.5, np.where(place == 0, 0.5, 0.7 * unit / np.maximum(length, 1e-12)))[:, None]
    near = origin + share * (extremity - origin) + beside
    far = extremity + share * (origin - extremity) + beside
    return np.stack((near, far), axis=1)


def _place_symbols(grid: Grid, centre: Points, unit: float, sub: I32) -> Points:
    """Each symbol around its substation where most room is, one after the other."""
    angle = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
    ring = np.stack((np.cos(angle), np.sin(angle)), axis=1) * _SYMBOL_DISTANCE * unit
    ends = np.stack((centre[grid.line_or_to_subid], centre[grid.line_ex_to_subid]), axis=1)
    placed = np.empty((len(sub), 2))
    for k, own in enumerate(sub.tolist()):
        spots = centre[own] + ring
        others = np.concatenate((np.delete(centre, own, axis=0), placed[:k]))
        room = np.linalg.norm(spots[:, None] - others, axis=2).min(axis=1)
        # A symbol may lie on a line where lines are dense, but never on another symbol.
        overlap = np.maximum(0.0, _APART * unit - room)
        placed[k] = spots[int(np.argmax(np.minimum(room, 1.4 * _distance_to_segments(spots, ends)) - 10 * overlap))]
    return placed


def _distance_to_segments(points: Points, segments: Points) -> Points:
    """Distance of each point to the nearest of the segments [segment, 2, 2]."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    relative = points[:, None] - start
    share = np.clip((relative * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12), 0, 1)
    distance: Points = np.linalg.norm(relative - share[..., None] * along, axis=2).min(axis=1)
    return distance


class GridDrawing:
    """The artists of one grid on one pair of axes.

    Args:
        grid: the grid.
        axes: emptied of ticks and frame; in their final place, because widths of lines follow their size.
        theme: colours.
        substations: those that must be in view; None: all.
        border: least distance from them to the edge of the view, in units (the distance of near substations).

    Raises:
        UsageError: the grid has no layout.
    """

    def __init__(
        self,
        grid: Grid,
        axes: Axes,
        *,
        theme: Theme = LIGHT,
        substations: Sequence[int] | None = None,
        border: float = 0.85,
    ) -> None:
        self._grid, self._theme, self._geometry = grid, theme, geometry_of(grid)
        self.unit = self._geometry.unit
        """The length that sizes are measured in, of ``Grid.layout``."""
        self._colours = loading_colours(theme)
        self.points = points = _frame_axes(axes, self._geometry, substations, border)
        """Points per unit."""
        self._width = float(np.clip(0.042 * points, 0.45, 2.6))
        self._edge = 0.55 * self._width
        self._halo = LineCollection([], colors=HIGHLIGHT, linewidths=4.5 * self._width, capstyle="round")
        self._halo_discs = PolyCollection([], facecolors=HIGHLIGHT, edgecolors="none")
        self._out = LineCollection([], linewidths=self._width, linestyles=[(0, (3, 2))])
        self._lines = LineCollection([], capstyle="round", joinstyle="round")
        self._stubs = LineCollection([], colors=theme.muted, linewidths=0.7 * self._width)
        self._bars = LineCollection([], colors=theme.text, linewidths=1.7 * self._width, capstyle="round")
        self._contacts = PolyCollection([], facecolors=theme.text, edgecolors="none")
        self._discs = PolyCollection([], facecolors=theme.background, edgecolors=theme.text, linewidths=self._edge)
        self._outlines, self._inside = self._symbols()
        self.artists: tuple[Artist, ...] = (
            self._halo, self._halo_discs, self._out, self._lines, self._stubs, self._bars, self._contacts, self._discs,
            self._outlines, self._inside, self._numbers(),
        )  # fmt: skip
        """From back to front."""
        for order, artist in enumerate(self.artists):
            artist.set_zorder(2 + 0.01 * order)
            axes.add_artist(artist)
        self._route(np.ones(grid.dim_topo, np.int32))

    def show(self, scene: Scene) -> None:
        """Show ``scene``."""
        # From one picture of an episode to the next the topology seldom changes.
        if not np.array_equal(scene.topo_vect, self._topo_vect):
            self._route(scene.topo_vect)
        self._show_lines(scene)
        self._show_highlights(scene)
        self._show_symbols(scene)

    def _route(self, topo_vect: I32) -> None:
        """Lead every element to its busbar."""
        geometry, grid = self._geometry, self._grid
        self._topo_vect = topo_vect.copy()
        split = self._split(topo_vect)
        end, approach = self._ends(topo_vect, split)
        self._courses = self._courses_between(end, approach)
        self._on = (topo_vect[grid.line_or_pos_topo_vect] > 0) & (topo_vect[grid.line_ex_pos_topo_vect] > 0)
        self._lines.set_segments(list(self._courses[self._on]))
        self._out.set_segments(list(self._courses[~self._on]))
        stubs = np.stack((end, approach), axis=1)[geometry.symbol_element]
        self._stub_courses = np.concatenate((stubs, geometry.symbol[:, None]), axis=1)
        self._stubs.set_segments(list(self._stub_courses))
        bars = geometry.centre[split][:, None, None] + self.unit * np.array(
            [[[-_BAR, _GAP], [_BAR, _GAP]], [[-_BAR, -_GAP], [_BAR, -_GAP]]]
        )
        self._bars.set_segments(list(bars.reshape(-1, 2, 2)))
        touching = split[grid.element_to_subid] & (topo_vect > 0)
        self._contacts.set_verts(list(_circles(end[touching], 0.055 * self.unit)))
        self._discs.set_verts(list(_circles(geometry.centre[~split], _DISC * self.unit)))

    def beside(self, element: int, distance: float) -> tuple[float, float]:
        """The point at ``distance`` units from a substation, towards one of its elements (entry of ``topo_vect``)."""
        geometry = self._geometry
        x, y = geometry.centre[self._grid.element_to_subid[element]] + distance * self.unit * geometry.towards[element]
        return float(x), float(y)

    def reach(self, element: int) -> float:
        """How far from its substation an element may be named, in units: to the middle of a line, or anywhere."""
        grid, centre = self._grid, self._geometry.centre
        line = np.flatnonzero((grid.line_or_pos_topo_vect == element) | (grid.line_ex_pos_topo_vect == element))
        if not line.size:
            return np.inf
        along = centre[grid.line_or_to_subid[line[0]]] - centre[grid.line_ex_to_subid[line[0]]]
        return 0.5 * float(np.linalg.norm(along)) / self.unit

    def _split(self, topo_vect: I32) -> Flags:
        """[sub] whether anything is on busbar 2."""
        on_second = np.bincount(self._grid.element_to_subid, topo_vect == 2, self._grid.n_sub)
        return np.asarray(on_second > 0)

    def _ends(self, topo_vect: I32, split: Flags) -> tuple[Points, Points]:
        """Where each element ends at its substation, and the point before: round the end of the bar in between."""
        geometry, sub = self._geometry, self._grid.element_to_subid
        centre, towards = geometry.centre[sub], geometry.towards
        above = np.where(topo_vect == 2, -1.0, 1.0)
        behind = towards[:, 1] * above < -0.25
        side = np.where(towards[:, 0] >= 0, 1.0, -1.0)
        along = np.where(behind, 0.92 * side, np.clip(1.1 * towards[:, 0], -0.92, 0.92)) * _BAR
        end = np.stack((along, above * _GAP), axis=1) * self.unit
        around = np.stack((side * (_BAR + 0.1), -above * _GAP), axis=1) * self.unit
        end = np.where(split[sub][:, None], end, 0.0)
        around = np.where((split[sub] & behind)[:, None], around, end)
        return centre + end, centre + around

    def _courses_between(self, end: Points, approach: Points) -> Points:
        """[line, 6, 2] from origin to extremity."""
        grid, middle = self._grid, self._geometry.line_middle
        origin, extremity = grid.line_or_pos_topo_vect, grid.line_ex_pos_topo_vect
        points = (end[origin], approach[origin], middle[:, 0], middle[:, 1], approach[extremity], end[extremity])
        return np.stack(points, axis=1)

    def _show_lines(self, scene: Scene) -> None:
        theme, on = self._theme, self._on
        rho = np.where(np.isnan(scene.rho), 0.0, scene.rho)[on]
        colours = self._colours(Normalize(0, FULL_SCALE)(rho))
        colours[np.isnan(scene.rho)[on]] = to_rgba(theme.muted)
        self._lines.set_color(colours)
        self._lines.set_linewidth(list(self._width * (0.9 + 0.9 * np.clip(rho, 0, 1))))
        out = np.tile(to_rgba(theme.out), (len(on), 1))
        out[scene.maintained] = to_rgba(GREEN)
        out[scene.attacked] = to_rgba(PURPLE)
        # A pale line would not be seen on the marker.
        out[scene.highlighted[self._grid.line_or_pos_topo_vect]] = to_rgba(theme.text)
        self._out.set_color(out[~on])

    def _show_highlights(self, scene: Scene) -> None:
        grid, chosen, courses, stubs = self._grid, scene.highlighted, self._courses, self._stub_courses
        middle = courses[:, 2:4].mean(axis=1, keepdims=True)
        at_origin = np.concatenate((courses[:, :3], middle), axis=1)[chosen[grid.line_or_pos_topo_vect]]
        at_extremity = np.concatenate((courses[:, :2:-1], middle), axis=1)[chosen[grid.line_ex_pos_topo_vect]]
        symbols = chosen[self._geometry.symbol_element]
        self._halo.set_segments([*at_origin, *at_extremity, *stubs[symbols]])
        self._halo_discs.set_verts(list(_circles(self._geometry.symbol[symbols], 1.75 * _SYMBOL * self.unit)))

    def _symbols(self) -> tuple[PolyCollection, LineCollection]:
        """Outlines and what is drawn inside them; :meth:`_show_symbols` gives them places and sizes."""
        grid, theme = self._grid, self._theme
        fills = [theme.background] * grid.n_gen + [theme.muted] * grid.n_load + [theme.background] * grid.n_storage
        return (
            PolyCollection([], facecolors=fills, edgecolors=theme.text, linewidths=self._edge),
            LineCollection([], colors=theme.text, linewidths=0.85 * self._edge),
        )

    def _show_symbols(self, scene: Scene) -> None:
        grid = self._grid
        power = np.concatenate((scene.gen_p, scene.load_p, scene.storage_power))
        size = (_SYMBOL * self.unit * symbol_scale(grid, power))[:, None, None]
        parts = [grid.n_gen, grid.n_gen + grid.n_load]
        generator, load, storage = np.split(self._geometry.symbol[:, None], parts)
        of_generator, of_load, of_storage = np.split(size, parts)
        outlines = (
            generator + of_generator * _RING,
            load + of_load * _TRIANGLE,
            storage + of_storage * _SQUARE,
        )
        self._outlines.set_verts([outline for kind in outlines for outline in kind])
        plates = storage[:, None] + of_storage[:, None] * _PLATES
        self._inside.set_segments([*(generator + of_generator * _WAVE), *plates.reshape(-1, 2, 2)])

    def _numbers(self) -> Artist:
        """Numbers of the substations, as outlines of glyphs: drawn much faster than text, and scaled with the rest."""
        font = FontProperties(family="DejaVu Sans", weight="bold")
        height = TextPath((0, 0), "0", size=10, prop=font).get_extents().height
        paths = []
        for sub, centre in enumerate(self._geometry.centre):
            text = TextPath((0, 0), str(sub), size=10, prop=font)
            box = text.get_extents()
            # Three digits have to fit into the disc, too.
            scale = min(_DIGIT * self.unit / height, 1.45 * _DISC * self.unit / box.width)
            placing = (
                Affine2D().translate(-(box.x0 + box.x1) / 2, -(box.y0 + box.y1) / 2).scale(scale).translate(*centre)
            )
            paths.append(placing.transform_path(text))
        return PatchCollection([PathPatch(path) for path in paths], facecolors=self._theme.text, edgecolors="none")


class FrameRenderer:
    """Pictures of one grid as arrays, one scene after the other.

    Args:
        grid: the grid.
        size: width and height, pixels.
        theme: colours.
    """

    def __init__(self, grid: Grid, *, size: tuple[int, int] = (1280, 720), theme: Theme = LIGHT) -> None:
        # One width in inches whatever the size: letters shrink with the picture, and the legend fits.
        dpi = 100 * size[0] / 1280
        with matplotlib.rc_context(style(theme)):
            figure = Figure(figsize=((size[0] + 0.01) / dpi, (size[1] + 0.01) / dpi), dpi=dpi)
            self._canvas = FigureCanvasAgg(figure)
            self._axes = figure.add_axes((0.01, 0.06, 0.98, 0.855))
            self._drawing = GridDrawing(grid, self._axes, theme=theme)
            self._headline = figure.text(0.015, 0.975, "", fontsize=13, fontweight="bold", va="top", animated=True)
            self._sentence = figure.text(0.015, 0.932, "", fontsize=10, va="top", animated=True)
            add_legend(figure, grid, theme, known_loading=True)
            for artist in self._drawing.artists:
                artist.set_animated(True)
            self._canvas.draw()
        self._legend_only = self._canvas.copy_from_bbox(figure.bbox)
        self._background = self._legend_only

    def frame(self, scene: Scene, caption: Caption = NO_CAPTION) -> NDArray[np.uint8]:
        """A picture of ``scene``, uint8 [height, width, 3]."""
        self._drawing.show(scene)
        self._headline.set_text(caption.headline)
        self._say(textwrap.shorten(caption.sentence, _SENTENCE_LENGTH, placeholder=" …"))
        self._canvas.restore_region(self._background)
        for artist in (*self._drawing.artists, self._headline):
            self._axes.draw_artist(artist)
        return np.array(self._canvas.buffer_rgba())[..., :3]

    def _say(self, sentence: str) -> None:
        """Put a sentence into the background: letters are slow to draw, and it stays for many pictures."""
        if sentence == self._sentence.get_text():
            return
        self._sentence.set_text(sentence)
        self._canvas.restore_region(self._legend_only)
        self._axes.draw_artist(self._sentence)
        self._background = self._canvas.copy_from_bbox(self._canvas.figure.bbox)


def add_legend(figure: Figure, grid: Grid, theme: Theme, *, known_loading: bool) -> None:
    """Say below a drawing what its symbols mean and, where loadings are known, its colours."""
    symbol: dict[str, Any] = {"linestyle": "", "markersize": 6, "markeredgecolor": theme.text, "markeredgewidth": 0.7}
    handles = [
        Line2D([], [], marker="o", markerfacecolor=theme.background, label="generator", **symbol),
        Line2D([], [], marker="v", markerfacecolor=theme.muted, label="load", **symbol),
    ]
    if grid.n_storage:
        handles.append(Line2D([], [], marker="s", markerfacecolor=theme.background, label="storage", **symbol))
    if known_loading:
        colours = loading_colours(theme)
        handles += [
            Line2D([], [], color=colours(rho / FULL_SCALE), linewidth=1 + rho, label=f"{rho:.0%} loaded")
            for rho in (0.1, 0.5, 0.95, 1.2)
        ]
        handles.append(Line2D([], [], color=PURPLE, linestyle=(0, (3, 2)), label="attacked"))
        handles.append(Line2D([], [], color=GREEN, linestyle=(0, (3, 2)), label="maintenance"))
    handles.append(Line2D([], [], color=theme.out, linestyle=(0, (3, 2)), label="out"))
    if known_loading:
        handles.append(Line2D([], [], linestyle="", label="symbol size: MW"))
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, handlelength=1.6)


@functools.cache
def loading_colours(theme: Theme) -> Colormap:
    """Colours of lines over loadings 0 to :data:`FULL_SCALE`; even an empty line is seen on the background."""
    return themes.loading_colours(dataclasses.replace(theme, loading=theme.loading[1:]))


def _circles(centres: Points, radius: float) -> Points:
    """Polygons [circle, corner, 2]."""
    angle = np.linspace(0, 2 * np.pi, 25)[:-1]
    return centres[:, None] + radius * np.stack((np.cos(angle), np.sin(angle)), axis=1)


_RING = _circles(np.zeros((1, 2)), 1.0)[0]
_TRIANGLE = np.array([[-1.0, 0.75], [1.0, 0.75], [0.0, -1.0]])
_SQUARE = 0.85 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_PHASE = np.linspace(-np.pi, np.pi, 13)
_WAVE = np.stack((0.6 * _PHASE / np.pi, 0.38 * np.sin(_PHASE)), axis=1)
_PLATES = 0.5 * np.array([[[-1.0, 0.35], [1.0, 0.35]], [[-0.5, -0.35], [0.5, -0.35]]])


def _frame_axes(axes: Axes, geometry: Geometry, substations: Sequence[int] | None, border: float) -> float:
    """Set what is in view; returns the length of a unit in points."""
    shown = np.asarray(range(len(geometry.centre)) if substations is None else substations)
    subs = geometry.centre[shown]
    low, high = subs.min(axis=0) - border * geometry.unit, subs.max(axis=0) + border * geometry.unit
    box = axes.get_window_extent()
    span = high - low
    scale = min(box.width / span[0], box.height / span[1])
    # The view gets the shape of the axes, so that nothing of them is wasted.
    middle, half = (low + high) / 2, np.array([box.width, box.height]) / scale / 2
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))
    axes.set_aspect("equal")
    axes.set_axis_off()
    figure = axes.get_figure()
    assert figure is not None
    return float(scale * geometry.unit * 72 / figure.dpi)
