"""Sums over transitions and episodes."""

import numpy as np
import pytest

from rl2grid.grids import load_grid
from rl2grid.mdp.accumulate import accrue, begin_episode, begin_transition, end_reset
from rl2grid.mdp.constraints import lsi_cost, tlo_cost
from rl2grid.mdp.scores import margin_score, overload_score, topology_score
from rl2grid.mdp.termination import GameOver

WEIGHTS = (1.0, 0.5, 0.25)
GAMMA = 0.9
TRANSITION_SUMS = ("transition_reward", "transition_discounted", "transition_components", "transition_costs", "n_steps")
RESET_SUMS = ("reset_steps", "reset_reward", "reset_components", "reset_costs")
EPISODE_SUMS = ("episode_return", "episode_components", "episode_costs", "episode_scores", "decisions")


@pytest.fixture
def state(calm):
    state = calm(load_grid("bus36-MO-v0"))
    begin_episode(state, 0)
    return state


def play(state, rewards):
    for components in rewards:
        accrue(state, 0, *components, WEIGHTS, GAMMA)


def test_one_step(state):
    play(state, [(1.0, -0.5, -0.25)])
    assert state.transition_reward[0] == state.transition_discounted[0] == state.episode_return[0] == 0.6875
    assert state.transition_components[0].tolist() == state.episode_components[0].tolist() == [1.0, -0.5, -0.25]
    assert state.n_steps[0] == 1


def test_a_transition_adds_up_and_discounts_from_its_first_step(state):
    play(state, [(1.0, 0.0, 0.0), (2.0, -1.0, 0.0), (4.0, 0.0, -1.0)])
    assert state.transition_reward[0] == 1 + 1.5 + 3.75
    assert state.transition_discounted[0] == pytest.approx(1 + 0.9 * 1.5 + 0.81 * 3.75, rel=1e-15)
    assert state.transition_discount[0] == pytest.approx(0.9**3, rel=1e-15)
    assert state.n_steps[0] == 3


def test_a_new_transition_starts_from_zero_and_the_episode_goes_on(state):
    play(state, [(1.0, 0.0, 0.0)] * 3)
    begin_transition(state, 0)
    for name in TRANSITION_SUMS:
        assert not getattr(state, name)[0].any(), name
    play(state, [(1.0, 0.0, 0.0)] * 2)
    assert (state.transition_reward[0], state.episode_return[0], state.n_steps[0]) == (2, 5, 2)
    assert state.transition_discounted[0] == 1.9


def test_a_new_episode_starts_from_zero_and_leaves_flags_alone(state):
    state.decisions[0] = 4
    state.excused[0, 2] = state.attacked[0, 2] = True
    state.line_status[0, 3:5] = False
    play(state, [(1.0, -1.0, -1.0)])
    end_reset(state, 0)
    play(state, [(1.0, -1.0, -1.0)])
    assert state.episode_scores[0].any()
    begin_episode(state, 0)
    for name in TRANSITION_SUMS + RESET_SUMS + EPISODE_SUMS:
        assert not getattr(state, name)[0].any(), name
    assert state.transition_discount[0] == 1
    assert state.excused[0, 2]


def test_costs_and_scores_are_added(state):
    state.rho[0, 0] = 1.2
    state.line_status[0, 1] = False
    state.topo_vect[0, 5] = 2
    play(state, [(1.0, 0.0, 0.0)] * 2)
    assert state.transition_costs[0].tolist() == [0, 4]
    begin_transition(state, 0)
    play(state, [(1.0, 0.0, 0.0)])
    assert state.transition_costs[0].tolist() == [0, 2]
    assert state.episode_costs[0].tolist() == [0, 6]
    scores = margin_score(state, 0), overload_score(state, 0), topology_score(state, 0)
    np.testing.assert_allclose(state.episode_scores[0], 3 * np.array(scores), rtol=1e-14)


def test_excuses_are_updated_before_the_cost_is_counted(state):
    state.line_status[0, 1] = False
    state.attacked[0, 1] = True
    play(state, [(1.0, 0.0, 0.0)])
    assert state.excused[0, 1]
    assert state.transition_costs[0, 1] == 0


def test_a_game_over_is_charged_once(state):
    state.terminated[0] = True
    state.game_over[0] = GameOver.ISLAND
    state.line_status[:] = False
    play(state, [(0.0, 0.0, 0.0)])
    assert state.episode_costs[0].tolist() == [2, 0]
    assert not state.episode_scores[0].any()


def test_rows_are_independent(random_rows):
    n = len(random_rows.step)
    for i in range(n):
        begin_episode(random_rows, i)
    for i in range(0, n, 2):
        accrue(random_rows, i, 1.0, -0.5, 0.0, WEIGHTS, GAMMA)
    for i in range(n):
        assert random_rows.n_steps[i] == 1 - i % 2
        assert random_rows.episode_return[i] == (0.75 if i % 2 == 0 else 0.0)
        expected = [lsi_cost(random_rows, i), tlo_cost(random_rows, i)] if i % 2 == 0 else [0, 0]
        assert random_rows.episode_costs[i].tolist() == expected


def test_what_a_reset_played_is_put_aside(state):
    play(state, [(1.0, 0.0, 0.0)] * 3)
    expected = {name: getattr(state, f"transition_{name}")[0].copy() for name in ("reward", "components", "costs")}
    end_reset(state, 0)
    assert state.reset_steps[0] == 3
    for name, value in expected.items():
        np.testing.assert_array_equal(getattr(state, f"reset_{name}")[0], value)
    for name in TRANSITION_SUMS:
        assert not getattr(state, name)[0].any(), name
    assert state.transition_discount[0] == 1
    assert state.episode_return[0] == 3


def test_sums_of_the_reset_and_of_transitions_are_the_sums_of_the_episode(state):
    rng = np.random.default_rng(0)
    play(state, [(1.0, -0.5, 0.25)] * 2)
    end_reset(state, 0)
    totals = np.array([state.reset_reward[0], *state.reset_components[0], *state.reset_costs[0]])
    for n_steps in (5, 1, 3):
        begin_transition(state, 0)
        state.decisions[0] += 1
        for _ in range(n_steps):
            state.line_status[0] = rng.random(59) < 0.9
            play(state, [tuple(rng.normal(size=3))])
        totals += [state.transition_reward[0], *state.transition_components[0], *state.transition_costs[0]]
    sums = [state.episode_return[0], *state.episode_components[0], *state.episode_costs[0]]
    np.testing.assert_allclose(totals, sums, rtol=1e-12)
