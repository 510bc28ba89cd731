"""Verdicts on actions of several changes, against live Grid2Op."""

import dataclasses

import numpy as np
import pytest

from rl2grid.engines.probes import make_probe
from rl2grid.engines.reference.engine import ReferenceEngine
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import joint, move, reconnect, restore, switch
from rl2grid.mdp.legality import (
    AMBIGUOUS,
    LEGAL,
    LINE_COOLS_DOWN,
    SUB_COOLS_DOWN,
    TOO_MANY_LINES,
    TOO_MANY_SUBS,
    Verdict,
    verdict_on,
)
from rl2grid.mdp.state import new_state
from rl2grid.scenarios.episodes import EpisodePlan
from rl2grid.scenarios.library import list_scenarios


def calm(grid_id="bus14", **rules):
    grid = load_grid(grid_id)
    grid = dataclasses.replace(grid, rules=dataclasses.replace(grid.rules, **rules))
    state = new_state(grid, 2)
    state.topo_vect[:], state.line_status[:] = 1, True
    return grid, state


def reason(state, *actions):
    return verdict_on(state, 1, joint(*actions)).reason


def test_a_line_and_a_substation_go_together_and_two_of_a_kind_do_not():
    _, state = calm()
    assert reason(state, switch(3), move(5, 0b10)) == LEGAL
    assert reason(state, switch(3), switch(4)) == TOO_MANY_LINES
    assert reason(state, move(3, 2), move(5, 0b10)) == TOO_MANY_SUBS
    _, state = calm(max_line_changes=2, max_sub_changes=3)
    assert reason(state, switch(3), switch(4), move(3, 2), move(5, 2), move(6, 2)) == LEGAL
    assert reason(state, switch(3), switch(4), switch(5)) == TOO_MANY_LINES
    assert reason(state, move(3, 2), move(5, 2), move(6, 2), move(4, 2)) == TOO_MANY_SUBS


def test_limits_hold_in_each_area():
    grid, state = calm("bus118-MOB-v1")
    lines = [int(np.flatnonzero(grid.sub_area[grid.line_or_to_subid] == area)[0]) for area in range(3)]
    subs = [int(np.flatnonzero(grid.sub_area == area)[0]) for area in range(3)]
    assert reason(state, *map(switch, lines), *(move(sub, 2) for sub in subs)) == LEGAL
    another = int(np.flatnonzero(grid.sub_area[grid.line_or_to_subid] == 1)[1])
    assert reason(state, *map(switch, lines), switch(another)) == TOO_MANY_LINES


def test_every_cooldown_counts_and_is_named():
    _, state = calm()
    state.time_before_cooldown_line[1, 3] = 4
    state.time_before_cooldown_sub[1, 5] = 2
    assert verdict_on(state, 1, joint(switch(3), move(4, 2))) == Verdict(LINE_COOLS_DOWN, 3, 4)
    assert verdict_on(state, 1, joint(switch(2), move(5, 2))) == Verdict(SUB_COOLS_DOWN, 5, 2)
    assert verdict_on(state, 0, joint(switch(3), move(5, 2))).reason == LEGAL
    assert verdict_on(state, 1, switch(3)) == Verdict(LINE_COOLS_DOWN, 3, 4)
    assert verdict_on(state, 1, move(5, 2)) == Verdict(SUB_COOLS_DOWN, 5, 2)


def test_a_substation_without_an_element_on_busbar_2_is_not_touched_by_its_restoration():
    _, state = calm()
    state.time_before_cooldown_sub[1, 5] = 2
    assert verdict_on(state, 1, restore(5)).reason == reason(state, restore(5), switch(1)) == LEGAL
    state.topo_vect[1, state.sub_first_element[5] + 1] = 2
    assert verdict_on(state, 1, restore(5)).reason == reason(state, restore(5), switch(1)) == SUB_COOLS_DOWN


def test_a_line_that_is_reconnected_may_not_be_moved():
    grid, state = calm()
    line = 7
    for positions, subs in (
        (grid.line_or_pos_topo_vect, grid.line_or_to_subid),
        (grid.line_ex_pos_topo_vect, grid.line_ex_to_subid),
    ):
        sub = int(subs[line])
        end = 1 << int(positions[line] - grid.sub_first_element[sub])
        assert reason(state, reconnect(line), move(sub, end)) == AMBIGUOUS
        assert reason(state, switch(line), move(sub, end)) == LEGAL
        other = next(1 << k for k in range(int(grid.sub_info[sub])) if 1 << k != end)
        assert reason(state, reconnect(line), move(sub, other)) == LEGAL


def test_the_end_of_an_open_line_that_is_switched_does_not_touch_its_substation():
    grid, state = calm()
    line, sub = 7, int(grid.line_or_to_subid[7])
    end = 1 << int(grid.line_or_pos_topo_vect[line] - grid.sub_first_element[sub])
    state.time_before_cooldown_sub[1, sub] = 3
    assert reason(state, switch(line), move(sub, end)) == SUB_COOLS_DOWN
    state.line_status[1, line] = False
    assert reason(state, switch(line), move(sub, end)) == LEGAL
    assert reason(state, switch(6), move(sub, end)) == SUB_COOLS_DOWN


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-MO-v0", "bus118-MOB-v1"])
def test_verdicts_are_those_of_grid2op(grid_id):
    """What Grid2Op says of the joint actions of the probes, in the states to which they lead."""
    grid, reasons = load_grid(grid_id), set()
    engine, number = ReferenceEngine(grid, 1), 0
    scenario = list_scenarios(grid_id, "bundled")[0]
    for name in ("within limits", "adversarial"):
        probe, left = make_probe(grid, "joint", name), 120
        while left:
            engine.reset(0, EpisodePlan(3, number, scenario, 0, 200))
            probe.begin(np.random.default_rng((3, number)))
            number += 1
            while left and not (engine.state.terminated[0] or engine.state.truncated[0]):
                left -= 1
                action = probe.choose(engine.state, 0)
                verdict = verdict_on(engine.state, 0, action)
                assert expected(engine, action) == (verdict.reason == AMBIGUOUS, verdict.reason == LEGAL), action
                reasons.add(verdict.reason)
                engine.step(0, action)
    engine.close()
    assert {LEGAL, AMBIGUOUS, TOO_MANY_LINES, TOO_MANY_SUBS} <= reasons


def expected(engine, action):
    """Whether Grid2Op finds an action ambiguous, and whether it is neither that nor illegal."""
    environment = engine.grid2op_environment(0)
    ambiguous = bool(engine._grid2op_action(0, action).is_ambiguous()[0])
    # Before the first step, _game_rules itself allows everything.
    allowed, _ = environment._game_rules.legal_action(engine._grid2op_action(0, action), environment)
    return ambiguous, bool(allowed) and not ambiguous
