"""Costs: which lines TLO counts and which it excuses, and what each game over costs under LSI."""

import numpy as np
import pytest

from rl2grid.grids import load_grid
from rl2grid.mdp.constraint_table import CONSTRAINTS, THRESHOLDS
from rl2grid.mdp.constraints import lsi_cost, step_costs, tlo_cost, update_excused
from rl2grid.mdp.termination import GameOver

LINE = 3


@pytest.fixture
def state(calm):
    return calm(load_grid("bus36-MO-v0"))


def open_line(state, line, cooldown=0):
    state.line_status[0, line] = False
    state.rho[0, line] = 0.0
    state.time_before_cooldown_line[0, line] = cooldown


def charged(state):
    update_excused(state, 0)
    return tlo_cost(state, 0)


def test_thresholds():
    assert THRESHOLDS == {"LSI": 0.0, "TLO": 50.0}


def test_every_constraint_of_the_table_has_a_cost_and_a_column_in_its_order(state):
    assert [constraint.column for constraint in CONSTRAINTS.values()] == ["cost_lsi", "cost_tlo"]
    assert state.transition_costs.shape[1] == state.episode_costs.shape[1] == len(CONSTRAINTS)
    open_line(state, LINE)
    assert dict(zip(CONSTRAINTS, step_costs(state, 0), strict=True)) == {"LSI": 0.0, "TLO": 1.0}
    state.game_over[0], state.terminated[0] = GameOver.ISLAND, True
    assert dict(zip(CONSTRAINTS, step_costs(state, 0), strict=True)) == {"LSI": 2.0, "TLO": 0.0}


@pytest.mark.parametrize(
    ("reason", "cost"),
    [
        (GameOver.NONE, 0),
        (GameOver.LOAD_DISCONNECTED, 2),
        (GameOver.GENERATOR_DISCONNECTED, 2),
        (GameOver.STORAGE_DISCONNECTED, 2),
        (GameOver.ISLAND, 2),
        (GameOver.DIVERGENCE, 1),
        (GameOver.DISPATCH, 1),
    ],
)
def test_lsi_by_reason(state, reason, cost):
    state.game_over[0] = reason
    assert lsi_cost(state, 0) == cost


def test_completing_the_month_is_not_charged(state):
    state.truncated[0] = True
    assert lsi_cost(state, 0) == 0


def test_tlo_counts_what_the_definition_counts(random_rows):
    alive = ~random_rows.terminated
    counted = ~random_rows.line_status | (random_rows.rho > 1)
    expected = (counted & ~random_rows.excused).sum(axis=1) * alive
    assert [tlo_cost(random_rows, i) for i in range(len(alive))] == expected.tolist()


def test_excuses_follow_the_definition(random_rows):
    begun = random_rows.attacked | (random_rows.time_next_maintenance == 0)
    expected = begun | (random_rows.excused & (random_rows.time_before_cooldown_line > 0))
    for i in range(len(expected)):
        update_excused(random_rows, i)
    np.testing.assert_array_equal(random_rows.excused, expected)


def test_a_line_at_its_limit_is_not_overloaded(state):
    state.rho[0, LINE] = 1.0
    assert tlo_cost(state, 0) == 0
    state.rho[0, LINE] = np.nextafter(np.float32(1), np.float32(2))
    assert tlo_cost(state, 0) == 1


def test_a_line_opened_by_the_agent_or_a_protection_is_charged_while_open(state):
    open_line(state, LINE, cooldown=3)
    assert [charged(state), charged(state)] == [1, 1]


def test_maintenance_is_excused_from_its_onset_until_reconnection_is_legal(state):
    costs = []
    # The observed (time_next, duration, cooldown) of a maintenance of two steps, as Grid2Op counts.
    for time_next, duration, cooldown in [(1, 2, 0), (0, 2, 2), (0, 1, 1), (-1, 0, 0), (-1, 0, 0)]:
        if time_next == 0:
            open_line(state, LINE)
        state.time_next_maintenance[0, LINE] = time_next
        state.duration_next_maintenance[0, LINE] = duration
        state.time_before_cooldown_line[0, LINE] = cooldown
        costs.append(charged(state))
    assert costs == [0, 0, 0, 1, 1]


def test_an_attack_is_excused_until_the_cooldown_behind_it_is_over(state):
    open_line(state, LINE, cooldown=1)
    state.attacked[0, LINE] = True
    assert charged(state) == 0
    state.attacked[0, LINE] = False
    state.time_before_cooldown_line[0, LINE] = 2
    assert charged(state) == 0
    state.time_before_cooldown_line[0, LINE] = 0
    assert charged(state) == 1


def test_an_attack_whose_cooldown_shows_zero_is_excused_while_it_lasts(state):
    open_line(state, LINE, cooldown=0)
    state.attacked[0, LINE] = True
    assert [charged(state), charged(state)] == [0, 0]
    state.attacked[0, LINE] = False
    assert charged(state) == 1


def test_a_line_that_closes_again_is_no_longer_excused(state):
    state.excused[0, LINE] = True
    state.rho[0, LINE] = 1.5
    assert charged(state) == 1


def test_other_lines_are_charged_beside_an_excused_one(state):
    open_line(state, LINE)
    state.attacked[0, LINE] = True
    open_line(state, LINE + 1)
    state.rho[0, LINE + 2] = 1.1
    assert charged(state) == 2


def test_the_step_of_a_game_over_has_no_tlo_cost(state):
    state.line_status[:] = False
    state.terminated[0] = True
    assert charged(state) == 0
