"""Heuristics: when they play, what recovery does first, and what careful may try."""

import numpy as np
import pytest

from rl2grid.grids import load_grid
from rl2grid.mdp.actions import ActionKind, is_legal
from rl2grid.mdp.heuristics import (
    CAREFUL_RHO,
    candidate_action,
    careful_candidate,
    is_careful_enough,
    is_safe,
    reconnect_action,
    recovery_action,
    remember_move,
    remember_nothing,
    remember_topology,
)

NOTHING = (ActionKind.NOTHING, 0)


@pytest.fixture
def state(calm):
    return calm(load_grid("bus36-MO-v0"))


def split(state, sub):
    state.topo_vect[0, state.sub_first_element[sub]] = 2


def open_line(state, line, cooldown=0):
    state.line_status[0, line] = False
    state.topo_vect[0, [state.line_or_pos_topo_vect[line], state.line_ex_pos_topo_vect[line]]] = -1
    state.time_before_cooldown_line[0, line] = cooldown


def test_the_grid_is_safe_strictly_below_95_percent(state):
    limit = np.float32(0.95)
    state.rho[0, 7] = np.nextafter(limit, np.float32(0))
    assert is_safe(state, 0)
    state.rho[0, 7] = limit
    assert not is_safe(state, 0)


def test_a_loading_that_is_not_a_number_is_not_safe(state):
    state.rho[0, 7] = np.nan
    assert not is_safe(state, 0)


def test_safety_equals_numpy_s_comparison(random_rows):
    expected = (random_rows.rho < 0.95).all(axis=1)
    assert expected.any()
    assert not expected.all()
    assert [is_safe(random_rows, i) for i in range(len(expected))] == expected.tolist()


def test_the_reference_topology_needs_nothing(state):
    assert recovery_action(state, 0) == NOTHING
    assert reconnect_action(state, 0) == NOTHING


def test_lines_come_before_substations_and_low_numbers_first(state):
    split(state, 2)
    split(state, 9)
    open_line(state, 30)
    open_line(state, 12)
    assert recovery_action(state, 0) == (ActionKind.RECONNECT, 12)
    state.time_before_cooldown_line[0, 12] = 1
    assert recovery_action(state, 0) == (ActionKind.RECONNECT, 30)
    state.time_before_cooldown_line[0, 30] = 2
    assert recovery_action(state, 0) == (ActionKind.RESTORE, 2)
    state.time_before_cooldown_sub[0, 2] = 1
    assert recovery_action(state, 0) == (ActionKind.RESTORE, 9)
    state.time_before_cooldown_sub[0, 9] = 3
    assert recovery_action(state, 0) == NOTHING


def test_disconnected_elements_do_not_make_a_substation_off_reference(state):
    open_line(state, 4, cooldown=5)
    assert recovery_action(state, 0) == NOTHING


def test_the_last_element_of_a_substation_counts(state):
    state.topo_vect[0, -1] = 2
    assert recovery_action(state, 0) == (ActionKind.RESTORE, len(state.sub_info) - 1)


def test_on_continuous_tasks_lines_are_only_reconnected(state):
    split(state, 2)
    assert reconnect_action(state, 0) == NOTHING
    open_line(state, 12)
    assert reconnect_action(state, 0) == (ActionKind.RECONNECT, 12)


def test_decisions_are_those_of_the_definition_and_legal(grid, random_rows):
    for i in range(len(random_rows.step)):
        lines = np.flatnonzero(~random_rows.line_status[i] & (random_rows.time_before_cooldown_line[i] == 0))
        moved = np.unique(grid.element_to_subid[random_rows.topo_vect[i] == 2])
        subs = [sub for sub in moved if random_rows.time_before_cooldown_sub[i, sub] == 0]
        reconnect = (ActionKind.RECONNECT, lines[0]) if len(lines) else NOTHING
        expected = reconnect if len(lines) else (ActionKind.RESTORE, subs[0]) if subs else NOTHING
        assert reconnect_action(random_rows, i) == reconnect
        assert recovery_action(random_rows, i) == expected
        assert is_legal(random_rows, i, *recovery_action(random_rows, i))


def candidates(state):
    """Everything that careful may try, in order, as (:class:`ActionKind`, target)."""
    found, number = [], careful_candidate(state, 0, 0)
    while number >= 0:
        found.append(candidate_action(state, number))
        number = careful_candidate(state, 0, number + 1)
    return found


def at_step(state, step, *, opened=(), closed=(), splits=(), moves=()):
    """Show the next step, and let careful remember it; ``moves`` are the agent's in what is split already."""
    state.step[0] = step
    for line in opened:
        open_line(state, line)
    state.line_status[0, list(closed)] = True
    for sub in splits:
        split(state, sub)
    remember_topology(state, 0)
    for sub in (*splits, *moves):
        remember_move(state, 0, sub)


def test_careful_tries_what_recovery_would_do_and_then_the_rest(state):
    remember_nothing(state, 0)
    at_step(state, 1, splits=(2, 9))
    at_step(state, 2, opened=(30, 12, 13))
    state.time_before_cooldown_line[0, 13] = 4
    closing = [(ActionKind.RECONNECT, 12), (ActionKind.RECONNECT, 30)]
    assert candidates(state) == [*closing, (ActionKind.RESTORE, 2), (ActionKind.RESTORE, 9)]
    assert candidates(state)[0] == recovery_action(state, 0)
    state.time_before_cooldown_sub[0, 2] = 1
    assert candidates(state) == [*closing, (ActionKind.RESTORE, 9)]


def test_careful_leaves_a_split_that_makes_up_for_an_open_line(state):
    remember_nothing(state, 0)
    at_step(state, 1, splits=(4,))
    at_step(state, 2, opened=(12,))
    at_step(state, 3, splits=(9,))
    state.time_before_cooldown_line[0, 12] = 10
    assert candidates(state) == [(ActionKind.RESTORE, 4)], "4 was split before the line was lost"
    at_step(state, 4, moves=(4,))
    assert candidates(state) == [], "4 was divided otherwise after the line was lost"
    at_step(state, 5, closed=(12,))
    assert candidates(state) == [(ActionKind.RESTORE, 4), (ActionKind.RESTORE, 9)]
    at_step(state, 6, opened=(12,))
    state.time_before_cooldown_line[0, 12] = 10
    assert candidates(state) == [(ActionKind.RESTORE, 4), (ActionKind.RESTORE, 9)], "it was lost again, later"


def test_a_line_lost_in_the_step_of_a_split_is_not_what_it_makes_up_for(state):
    remember_nothing(state, 0)
    at_step(state, 3, opened=(12,), splits=(9,))
    state.time_before_cooldown_line[0, 12] = 10
    assert candidates(state) == [(ActionKind.RESTORE, 9)]


def test_careful_forgets_a_substation_that_was_brought_home_and_an_earlier_episode(state):
    remember_nothing(state, 0)
    at_step(state, 1, opened=(12,))
    at_step(state, 2, splits=(9,))
    first = state.sub_first_element[9]
    state.topo_vect[0, first : first + state.sub_info[9]] = 1
    at_step(state, 3)
    assert state.split_since[0, 9] == -1
    assert state.open_since[0, 12] == 1
    remember_nothing(state, 0)
    assert (state.split_since[0] == -1).all()
    assert (state.open_since[0] == -1).all()


def test_careful_needs_a_forecast_without_a_heavy_line_or_a_game_over(state):
    state.rho[0, 7] = np.nextafter(CAREFUL_RHO, np.float32(0))
    assert is_careful_enough(state, 0)
    state.rho[0, 7] = CAREFUL_RHO
    assert not is_careful_enough(state, 0)
    state.rho[0, 7] = 0.0
    state.terminated[0] = True
    assert not is_careful_enough(state, 0)
