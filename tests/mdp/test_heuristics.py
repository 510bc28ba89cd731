"""Heuristics: when they play, and what recovery does first."""

import numpy as np
import pytest

from rl2grid.grids import load_grid
from rl2grid.mdp.actions import ActionKind, is_legal
from rl2grid.mdp.heuristics import is_safe, reconnect_action, recovery_action

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
