"""Drawings of a grid: where things are, what a scene changes, and that frames leave nothing behind."""

import dataclasses

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from rl2grid.drawing.grid_drawing import (
    NO_CAPTION,
    Caption,
    FrameRenderer,
    GridDrawing,
    geometry_of,
    loading_colours,
    reference_scene,
)
from rl2grid.drawing.theme import DARK, GREEN, LIGHT, PURPLE
from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid

BUS14 = load_grid("bus14")


@pytest.fixture
def drawing():
    return GridDrawing(BUS14, Figure().add_axes((0, 0, 1, 1)))


def elements_of(grid, sub):
    first = grid.sub_first_element[sub]
    return np.arange(first, first + grid.sub_info[sub])


def scene_with(grid, **changes):
    """The reference scene with some entries of its arrays changed: name=(entries, value)."""
    scene = reference_scene(grid)
    arrays = {name: getattr(scene, name).copy() for name in changes}
    for name, (entries, value) in changes.items():
        arrays[name][entries] = value
    return dataclasses.replace(scene, **arrays)


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_symbols_cover_neither_each_other_nor_another_substation(grid_id):
    grid = load_grid(grid_id)
    geometry = geometry_of(grid)
    own = grid.element_to_subid[geometry.symbol_element]
    to_substations = np.linalg.norm(geometry.symbol[:, None] - geometry.centre, axis=2)
    np.testing.assert_allclose(to_substations[np.arange(len(own)), own], 0.6 * geometry.unit)
    # A symbol of radius 0.12 units touches the disc of a substation, of radius 0.21, at 0.33.
    assert to_substations.min() > 0.33 * geometry.unit
    between = np.linalg.norm(geometry.symbol[:, None] - geometry.symbol, axis=2)
    np.fill_diagonal(between, np.inf)
    # Two symbols, each of radius 0.12 units, touch at 0.24.
    assert between.min() > 0.24 * geometry.unit


def test_parallel_lines_are_drawn_apart():
    grid = load_grid("bus36-M")
    middles = geometry_of(grid).line_middle.mean(axis=1)
    between = np.linalg.norm(middles[:, None] - middles, axis=2)
    np.fill_diagonal(between, np.inf)
    pairs = {tuple(sorted(pair)) for pair in zip(grid.line_or_to_subid, grid.line_ex_to_subid, strict=True)}
    assert len(pairs) < grid.n_line
    assert between.min() > 0.1 * geometry_of(grid).unit


def test_a_split_substation_has_two_bars_and_elements_end_on_theirs(drawing):
    moved = elements_of(BUS14, 5)[[1, 3, 5]]
    drawing.show(scene_with(BUS14, topo_vect=(moved, 2)))
    bars = np.array(drawing._bars.get_segments())
    assert bars.shape == (2, 2, 2)
    first, second = bars[:, 0, 1]
    assert first > BUS14.layout[5][1] > second
    assert len(drawing._discs.get_paths()) == BUS14.n_sub - 1
    end, _ = drawing._ends(scene_with(BUS14, topo_vect=(moved, 2)).topo_vect, np.arange(BUS14.n_sub) == 5)
    for element in elements_of(BUS14, 5):
        assert end[element, 1] == pytest.approx(second if element in moved else first)
        assert abs(end[element, 0] - BUS14.layout[5][0]) < abs(bars[0, 1, 0] - BUS14.layout[5][0])
    others = np.setdiff1d(np.arange(BUS14.dim_topo), elements_of(BUS14, 5))
    assert (end[others] == np.array(BUS14.layout)[BUS14.element_to_subid[others]]).all()


def test_lines_have_the_colour_of_their_loading_and_grow_with_it(drawing):
    loading = np.linspace(0.0, 1.4, BUS14.n_line).astype(np.float32)
    drawing.show(dataclasses.replace(reference_scene(BUS14), rho=loading))
    expected = loading_colours(LIGHT)(loading / 1.5)
    np.testing.assert_allclose(drawing._lines.get_colors(), expected, atol=1e-6)
    widths = drawing._lines.get_linewidths()
    assert (np.diff(widths)[loading[1:] <= 1] > 0).all()


def test_lines_out_of_service_are_dashed_and_say_why(drawing):
    out = [2, 7, 11]
    ends = np.concatenate((BUS14.line_or_pos_topo_vect[out], BUS14.line_ex_pos_topo_vect[out]))
    drawing.show(scene_with(BUS14, topo_vect=(ends, -1), attacked=(7, True), maintained=(11, True)))
    assert len(drawing._out.get_segments()) == 3
    assert len(drawing._lines.get_segments()) == BUS14.n_line - 3
    colours = [tuple(colour) for colour in drawing._out.get_colors()]
    assert colours == [to_rgba(LIGHT.out), to_rgba(PURPLE), to_rgba(GREEN)]
    drawing.show(reference_scene(BUS14))
    assert len(drawing._out.get_segments()) == 0


def test_only_what_is_highlighted_gets_a_marker(drawing):
    load, line = int(BUS14.load_pos_topo_vect[3]), int(BUS14.line_ex_pos_topo_vect[6])
    drawing.show(scene_with(BUS14, highlighted=([load, line], True)))
    assert len(drawing._halo.get_segments()) == 2
    (disc,) = drawing._halo_discs.get_paths()
    symbol = geometry_of(BUS14).symbol[geometry_of(BUS14).symbol_element == load][0]
    np.testing.assert_allclose(disc.vertices[:-1].mean(axis=0), symbol, atol=1e-6)
    drawing.show(reference_scene(BUS14))
    assert not drawing._halo.get_segments()


def test_the_view_can_be_narrowed_to_some_substations():
    figure = Figure()
    near = GridDrawing(BUS14, figure.add_axes((0, 0, 0.5, 1)), substations=[5], border=1.5)
    whole = GridDrawing(BUS14, figure.add_axes((0.5, 0, 0.5, 1)))
    assert near.points > 2 * whole.points


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)
def test_a_frame_depends_on_its_scene_alone(theme):
    renderer = FrameRenderer(BUS14, size=(640, 360), theme=theme)
    calm = reference_scene(BUS14)
    stressed = scene_with(BUS14, topo_vect=(elements_of(BUS14, 3)[:3], 2), rho=(slice(None), 1.2))
    first = renderer.frame(calm)
    assert first.shape == (360, 640, 3)
    assert first.dtype == np.uint8
    other = renderer.frame(stressed)
    assert (first != other).any(axis=2).mean() > 0.005
    assert (renderer.frame(calm) == first).all()
    assert (FrameRenderer(BUS14, size=(640, 360), theme=theme).frame(stressed) == other).all()


def test_a_grid_without_layout_is_refused():
    nowhere = dataclasses.replace(BUS14, layout=((0.0, 0.0),) * BUS14.n_sub)
    with pytest.raises(UsageError, match="bus14 cannot be drawn"):
        FrameRenderer(nowhere)


def test_a_caption_leaves_nothing_of_the_one_before():
    renderer, scene = FrameRenderer(BUS14, size=(640, 360)), reference_scene(BUS14)
    captions = (Caption("a", "one"), Caption("b", "one"), Caption("b", "another"), NO_CAPTION, Caption("a", "one"))
    for caption in captions:
        expected = FrameRenderer(BUS14, size=(640, 360)).frame(scene, caption)
        np.testing.assert_array_equal(renderer.frame(scene, caption), expected)
