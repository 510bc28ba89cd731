"""Rounds of cascades, and reasons of decisions: what a recording tells beside the states."""

from __future__ import annotations

import itertools

import gymnasium
import numpy as np
import pytest
from fake_grid import FakeGrid

from rl2grid.agents.agent import Considered
from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.greedy import Greedy
from rl2grid.agents.random_agent import RandomAgent
from rl2grid.envs.registration import register_all
from rl2grid.errors import UsageError
from rl2grid.evaluation.recording import record_episode
from rl2grid.grids import load_grid
from rl2grid.mdp.heuristics import SAFE_RHO
from rl2grid.records.recordings import Recording
from rl2grid.scenarios.library import list_scenarios

BUS14 = load_grid("bus14")


def record(agent, task="bus14-T0", steps=None, seed=0, **keywords):
    register_all()
    env = gymnasium.make(f"rl2grid/{task}-v0", disable_env_checker=True, **keywords)
    agent.bind(env)
    scenario = list_scenarios("bus14", keywords["split"])[0]
    try:
        return record_episode(agent, env, scenario=scenario, seed=seed, steps=steps)
    finally:
        env.close()


@pytest.fixture(scope="module")
def lost() -> Recording:
    """A month that ends in a cascade."""
    return record(DoNothing(), split="validation", heuristic="recovery")


def test_the_rounds_of_a_cascade_lead_from_the_last_row_to_the_ending(lost):
    cascade = lost.cascades[-1]
    assert cascade.step == lost.n_steps + 1
    opened = [trip.line for each in cascade.rounds for trip in each.trips]
    assert len(opened) == len(set(opened)) > 1
    out = lost.ending.topo_vect[BUS14.line_or_pos_topo_vect] < 0
    assert set(opened) == set(np.flatnonzero(out & lost.line_status[-1]).tolist())
    np.testing.assert_array_equal(cascade.rounds[-1].topo_vect, lost.ending.topo_vect)
    assert np.isnan(cascade.rounds[-1].rho).all()
    assert lost.ending.lost.any()


def test_protections_open_what_their_rules_say(lost):
    rules = BUS14.rules
    before = lost.rho[-rules.overflow_allowed :] > 1.0
    for each in lost.cascades[-1].rounds:
        for line, loading, overloaded in each.trips:
            assert loading == pytest.approx(float(each.rho[line]))
            if overloaded:
                assert loading > 1.0
                assert before[:, line].all()
                assert overloaded > rules.overflow_allowed
            else:
                assert loading > rules.hard_overflow


def test_each_round_has_lost_what_the_last_one_opened(lost):
    rounds = lost.cascades[-1].rounds
    origin = BUS14.line_or_pos_topo_vect
    for before, after in itertools.pairwise(rounds):
        gone = np.flatnonzero((before.topo_vect[origin] > 0) & (after.topo_vect[origin] < 0))
        assert gone.tolist() == [trip.line for trip in before.trips]


def test_a_cascade_that_the_grid_survives_ends_with_what_was_recorded():
    recorded = record(RandomAgent(), split="validation", heuristic="idle", seed=18)
    survived = [cascade for cascade in recorded.cascades if cascade.step <= recorded.n_steps]
    assert survived
    for step, rounds in survived:
        np.testing.assert_array_equal(rounds[-1].topo_vect, recorded.topo_vect[step])
        np.testing.assert_allclose(rounds[-1].rho, recorded.rho[step], atol=1e-4)
        assert [bool(each.trips) for each in rounds] == [True] * (len(rounds) - 1) + [False]
        opened = [trip.line for each in rounds for trip in each.trips]
        assert recorded.line_status[step - 1][opened].all()
        assert not recorded.line_status[step][opened].any()


def test_reasons_hold_what_greedy_compared():
    recorded = record(Greedy(), split="validation", heuristic="idle", steps=1200)
    assert recorded.reasons
    for reason in recorded.reasons:
        chosen = [each for each in reason.alternatives if each.chosen]
        assert [each.action for each in chosen] == [recorded.actions[recorded.decision_steps.index(reason.step)]]
        assert "" in [each.action for each in reason.alternatives]
        promised = [each.promised for each in reason.alternatives]
        assert promised == sorted(promised)
        assert reason.tried <= 50
        assert recorded.rho[reason.step].max() >= SAFE_RHO
    acted = [reason for reason in recorded.reasons if any(each.chosen and each.action for each in reason.alternatives)]
    assert acted
    assert all("best of those" in reason.why or "least worst loading" in reason.why for reason in acted)
    for reason in acted:
        by_action = {each.action: each.promised for each in reason.alternatives}
        assert min(by_action.values()) < by_action[""]


def test_what_the_heuristic_did_is_told():
    recorded = record(Greedy(), split="validation", heuristic="recovery", steps=1500)
    for step, words in recorded.heuristic_acts:
        assert "reconnect line" in words or "back to busbar 1" in words
        assert step - 1 not in recorded.decision_steps
        assert (recorded.topo_vect[step] != recorded.topo_vect[step - 1]).any()
    assert recorded.heuristic_acts


class Opinionated(DoNothing):
    """Says what it thinks."""

    def explain(self):
        return Considered("liking", [2, 0], [0.75, 0.25])


def test_an_agent_of_ones_own_may_say_what_it_considered():
    env = FakeGrid()
    agent = Opinionated()
    agent.bind(env)
    recorded = record_episode(agent, env, scenario="april", seed=2)
    reason = recorded.reasons[0]
    assert reason.preference == "liking"
    told = {each.action: each.preference for each in reason.alternatives}
    assert told == {"": 0.25, "action 2": 0.75}
    assert all(np.isnan(each.promised) for each in reason.alternatives)


@pytest.mark.parametrize("said", ["because", Considered("liking", [1, 2], [0.5])])
def test_an_explanation_of_another_kind_is_refused(said):
    env = FakeGrid()
    agent = Opinionated()
    agent.explain = lambda: said
    agent.bind(env)
    with pytest.raises(UsageError, match=r"explain\(\) of agent 'do-nothing' returned"):
        record_episode(agent, env, scenario="april", seed=2)


def test_redispatch_promises_are_those_of_simulate():
    recorded = record(Greedy(), "bus14-R", split="validation", heuristic="idle", steps=700)
    reason = recorded.reasons[0]
    assert reason.preference == "worst loading"
    assert reason.tried > len(reason.alternatives) - 2
    told = [each for each in reason.alternatives if not np.isnan(each.preference)]
    assert [each.promised for each in told] == pytest.approx([each.preference for each in told])
