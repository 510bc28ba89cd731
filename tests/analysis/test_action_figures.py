"""Figures of action spaces hold what the tables say."""

import numpy as np
import pytest
from made_up_ranking import made_up_arrays, use_ranking

from rl2grid.analysis.action_figures import MAX_POINTS, draw_action, draw_ranking, draw_shares, draw_trials
from rl2grid.analysis.action_space import substation_shares, switches_held
from rl2grid.analysis.figures import png_bytes
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import DO_NOTHING, move, switch

BUS14 = load_grid("bus14")


@pytest.fixture
def arrays(tmp_path, monkeypatch):
    """What the ranking of bus14 holds."""
    made_up = made_up_arrays("bus14")
    made_up["trials"][9] = made_up["survived"][9] = 0
    use_ranking(monkeypatch, tmp_path, "bus14", made_up)
    return made_up


def test_the_bars_are_the_shares():
    figure = draw_shares(BUS14)
    shares = substation_shares(BUS14)
    heights = [bar.get_height() for bar in figure.axes[0].patches]
    expected = [share.held[0] / share.moves for share in shares] + [switches_held(BUS14, 0) / BUS14.n_line]
    np.testing.assert_allclose(heights, expected)
    labels = [label.get_text() for label in figure.axes[1].get_xticklabels()]
    assert labels == [*(str(share.substation) for share in shares), "lines"]


def test_the_curve_is_the_ranking_and_levels_end_where_they_end(arrays):
    figure = draw_ranking(BUS14)
    ids = arrays["ids"]
    upper = figure.axes[0]
    rank, survival = upper.get_lines()[0].get_data()
    assert rank.tolist() == list(range(1, 209))
    known = arrays["trials"][ids] > 0
    np.testing.assert_allclose(survival[known], (arrays["survived"] / np.maximum(arrays["trials"], 1))[ids][known])
    assert np.isnan(survival[~known]).all()
    dashed = [line.get_xdata()[0] for line in upper.get_lines() if len(set(line.get_xdata())) == 1]
    assert dashed == [49.5]


def test_every_action_tried_is_a_dot(arrays):
    axes = draw_trials(BUS14).axes[0]
    position, count = axes.get_lines()[0].get_data()
    assert position == pytest.approx(np.arange(1, 209))
    assert (np.asarray(count) == arrays["trials"][1:]).all()


def test_many_actions_are_pooled(tmp_path, monkeypatch):
    grid = load_grid("bus36-MO-v0")
    arrays = made_up_arrays(grid.id, mean_trials=50)
    use_ranking(monkeypatch, tmp_path, grid.id, arrays)
    position, survival = draw_ranking(grid).axes[0].get_lines()[0].get_data()
    assert len(position) <= MAX_POINTS
    assert position[-1] <= len(arrays["ids"])
    best = arrays["ids"][0]
    assert survival[0] == pytest.approx(arrays["survived"][best] / arrays["trials"][best])


@pytest.mark.parametrize("action", [move(5, 0b1010), switch(17)])
def test_an_action_is_drawn_and_its_elements_named(action):
    figure = draw_action(BUS14, action)
    assert png_bytes(figure).startswith(b"\x89PNG")
    _, before, after = figure.axes
    words = {"line 17"} if action == switch(17) else {"line 8", "line 17"}
    for axes in (before, after):
        assert {text.get_text() for text in axes.texts} == words


def test_doing_nothing_is_not_drawn():
    with pytest.raises(UsageError, match="there is nothing to draw"):
        draw_action(BUS14, DO_NOTHING)
