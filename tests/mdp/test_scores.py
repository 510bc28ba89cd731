"""Scores: against NumPy written from the paper's definitions, and by hand."""

import numpy as np

from rl2grid.grids import load_grid
from rl2grid.mdp.rewards import default_components
from rl2grid.mdp.scores import SCORES, margin_score, overload_score, topology_score
from rl2grid.mdp.state import MARGIN_SCORE, OVERLOAD_SCORE, TOPOLOGY_SCORE


def test_names_are_in_the_order_of_the_columns():
    assert [SCORES[column] for column in (MARGIN_SCORE, OVERLOAD_SCORE, TOPOLOGY_SCORE)] == list(SCORES)
    assert SCORES == ("margin", "overload", "topology")


def test_scores_are_those_of_the_definition(random_rows):
    rho = random_rows.rho.astype(np.float64)
    alive = ~random_rows.terminated
    margin = np.where(random_rows.line_status, np.maximum(0, 1 - rho), -1).sum(axis=1) * alive
    distance = (random_rows.topo_vect != 1).sum(axis=1) * alive
    for i in range(len(alive)):
        np.testing.assert_allclose(margin_score(random_rows, i), margin[i], rtol=1e-12)
        assert overload_score(random_rows, i) == default_components(random_rows, i)[1]
        assert topology_score(random_rows, i) == -distance[i]


def test_by_hand(calm):
    state = calm(load_grid("bus14"))
    assert (margin_score(state, 0), overload_score(state, 0), topology_score(state, 0)) == (10, 0, 0)
    state.rho[0, :2] = 1.5, 0.75
    state.line_status[0, 2] = False
    state.rho[0, 2] = 0
    state.topo_vect[0, :3] = -1, -1, 2
    assert margin_score(state, 0) == 17 * 0.5 + 0 + 0.25 - 1
    assert overload_score(state, 0) == -(0.5 + 1) / 20
    assert topology_score(state, 0) == -3


def test_a_game_over_scores_nothing(calm):
    state = calm(load_grid("bus14"))
    state.terminated[0] = True
    state.line_status[:] = False
    state.rho[:] = 0
    state.topo_vect[:] = -1
    assert (margin_score(state, 0), overload_score(state, 0), topology_score(state, 0)) == (0, 0, 0)
