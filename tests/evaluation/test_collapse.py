"""What the rows of lost episodes name: by hand, and against every step of played episodes."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from rl2grid.agents.random_agent import RandomAgent
from rl2grid.envs.registration import register_all
from rl2grid.evaluation.collapse import collapse, overloaded_lines
from rl2grid.evaluation.episode import play_episode
from rl2grid.grids import load_grid
from rl2grid.mdp.state import new_state
from rl2grid.scenarios.library import list_scenarios


@pytest.fixture
def state():
    state = new_state(load_grid("bus14"), 2)
    state.final_topo_vect[:] = 1
    return state


def open_line(state, line):
    for ends in (state.line_or_pos_topo_vect, state.line_ex_pos_topo_vect):
        state.final_topo_vect[1, ends[line]] = -1


def test_lines_above_their_limit_are_named(state):
    state.rho[1, [3, 17]] = 1.01
    state.rho[1, 4] = 1.0
    assert overloaded_lines(state.rho[1]) == "3 17"
    assert overloaded_lines(state.rho[0]) == ""


def test_a_whole_grid_has_nothing_cut_off(state):
    open_line(state, 5)
    assert collapse(state, 1, "3") == ("3", "5", "")


def test_a_substation_without_its_lines_is_cut_off(state):
    grid = load_grid("bus14")
    lines = np.flatnonzero((grid.line_or_to_subid == 13) | (grid.line_ex_to_subid == 13))
    for line in lines:
        open_line(state, line)
    ending = collapse(state, 1, "")
    assert ending.last_outages == " ".join(map(str, lines))
    assert ending.last_cut_off == "13"


def test_a_busbar_apart_is_cut_off_and_an_open_end_is_not(state):
    load = int(state.load_pos_topo_vect[4])
    state.final_topo_vect[1, load] = 2
    assert collapse(state, 1, "").last_cut_off == str(state.element_to_subid[load])
    state.final_topo_vect[1, load] = -1
    assert collapse(state, 1, "").last_cut_off == str(state.element_to_subid[load])


def test_without_the_balancing_generator_everything_is_cut_off(state):
    state.final_topo_vect[1, state.gen_pos_topo_vect[state.slack_gen[0]]] = -1
    assert collapse(state, 1, "").last_cut_off == " ".join(map(str, range(14)))


@pytest.mark.parametrize("heuristic", [pytest.param(None, marks=pytest.mark.slow), "idle"])
def test_rows_name_what_the_state_before_the_game_over_showed(heuristic):
    register_all()
    env = gymnasium.make("rl2grid/bus14-T0-v0", disable_env_checker=True, split="validation", heuristic=heuristic)
    agent = RandomAgent()
    agent.bind(env)
    shown = []
    env.unwrapped.step_listeners.append(lambda state, i: shown.append((state.rho[i] > 1).nonzero()[0].tolist()))
    overloaded = 0
    for scenario in list_scenarios("bus14", "validation")[:6]:
        shown.clear()
        played = play_episode(agent, env, scenario=scenario, seed=0)
        if played.completed:
            continue
        # The last step is that of the game over, which shows no flow.
        assert played.last_overloads == " ".join(map(str, shown[-2]))
        overloaded += bool(shown[-2])
    env.close()
    assert overloaded
