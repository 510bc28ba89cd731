"""Substations of more than 32 and of more than 64 elements: moves, what-if questions, agents' use of masks."""

import numpy as np
import pytest
from star_grid import star_engine, star_grid

from rl2grid.agents.greedy_topology import effects
from rl2grid.engines.native.what_if import what_if
from rl2grid.envs.outages_after_action import busbars_after
from rl2grid.mdp.actions import ActionKind, describe, joint, limited_catalogue, move, restore, switch

SIZES = [40, 70]


def last_pair(n_elements):
    """The first of the two lines to the last substation, of which the ends have the highest bits."""
    return n_elements - 4


@pytest.mark.parametrize("n_elements", SIZES)
def test_the_highest_bits_move_as_the_lowest_do(n_elements):
    """All lines are equal: moving one to a busbar of its own leaves its current to the other line of the pair."""
    loadings = []
    for line in (2, last_pair(n_elements)):
        engine = star_engine(n_elements)
        engine.step(0, move(0, 1 << line))
        state = engine.state
        assert not state.terminated[0]
        assert not state.illegal[0]
        assert np.flatnonzero(state.topo_vect[0] == 2).tolist() == [line]
        assert state.rho[0, line] < 1e-3 < 0.01 < state.rho[0, line + 1]
        rho = state.rho[0].reshape(-1, 2)
        loadings.append(np.concatenate((rho[line // 2], np.delete(rho, line // 2, axis=0).ravel())))
        assert state.time_before_cooldown_sub[0, 0] == 3
    np.testing.assert_allclose(loadings[0], loadings[1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("n_elements", SIZES)
def test_two_moves_and_a_switch_and_back_again(n_elements):
    engine, line = star_engine(n_elements), last_pair(n_elements)
    engine.step(0, joint(move(0, 1 << line), move(1, 0b10), switch(3)))
    assert np.flatnonzero(engine.state.topo_vect[0] == 2).tolist() == [line, engine.grid.line_ex_pos_topo_vect[1]]
    assert not engine.state.line_status[0, 3]
    for _ in range(3):
        engine.step(0, joint())
    engine.step(0, joint(restore(0), restore(1), switch(3)))
    assert not engine.state.illegal[0]
    assert (engine.state.topo_vect[0] == 1).all()


@pytest.mark.parametrize("n_elements", SIZES)
def test_what_if_answers_what_a_step_shows(n_elements):
    engine = star_engine(n_elements)
    catalogue = limited_catalogue(engine.grid, max_elements=2, most=400)
    outcomes = what_if(engine, 0, catalogue)
    assert outcomes.legal.all()
    line = last_pair(n_elements)
    moves = [move(0, 1 << each) for each in (2, line, n_elements - 2)]
    ids = [catalogue.find(*each.changes[0]) for each in moves]
    chosen = [0, *ids, len(catalogue) - 1]
    for k in chosen:
        other = star_engine(n_elements)
        other.step(0, catalogue[k])
        assert int(other.state.game_over[0]) == outcomes.verdict[k], describe(engine.grid, catalogue[k])
        if not other.state.terminated[0]:
            assert outcomes.worst_loading[k] == pytest.approx(float(other.state.rho[0].max()), abs=1e-6)


@pytest.mark.parametrize("n_elements", SIZES)
def test_agents_see_what_restores_and_what_can_be_undone(n_elements):
    engine, line = star_engine(n_elements), last_pair(n_elements)
    grid, state = engine.grid, engine.state
    catalogue = limited_catalogue(grid, max_elements=1, most=10_000)
    own, other = (catalogue.find(ActionKind.MOVE, 0, 1 << each) for each in (line, 2))
    close = catalogue.find(ActionKind.SWITCH, line)
    engine.step(0, move(0, 1 << line))
    few = effects(grid, state, catalogue.take(np.array([0, own, other, close], np.int32)))
    assert few.restores.tolist() == [False, True, False, False]
    assert few.can_be_undone.tolist() == [True, True, False, True]
    busbars = state.topo_vect[0]
    after = busbars_after(grid, busbars, busbars, joint(move(0, 1 << line | 1 << 2), switch(line + 1)))
    assert np.flatnonzero(after == 2).tolist() == [2]
    assert (after[[grid.line_or_pos_topo_vect[line + 1], grid.line_ex_pos_topo_vect[line + 1]]] == -1).all()


def test_words_name_the_elements():
    grid = star_grid(70)
    words = describe(grid, move(0, 1 << 66 | 1 << 33 | 1 << 69))
    assert words == "substation 0: move lines 33 and 66 with load 34 to the other busbar"
