"""Actions of several changes on the native engine, and batches of them."""

import dataclasses

import numpy as np
import pytest

from rl2grid.engines.differential import SideBySide
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.transitions import NativeTransitions, commands_of
from rl2grid.engines.probes import make_probe
from rl2grid.engines.reference.engine import ReferenceEngine
from rl2grid.engines.transition import Transitions
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import (
    DO_NOTHING,
    continuous_layout,
    full_catalogue,
    inject,
    joint,
    move,
    reconnect,
    restore,
    switch,
)
from rl2grid.mdp.rewards import PRESETS
from rl2grid.scenarios.episodes import EpisodePlan
from rl2grid.scenarios.library import list_scenarios

BUS14 = load_grid("bus14")
LINE = 3
"""From substation 1 to substation 3."""
ORIGIN, EXTREMITY = int(BUS14.line_or_pos_topo_vect[LINE]), int(BUS14.line_ex_pos_topo_vect[LINE])
SUB = int(BUS14.line_ex_to_subid[LINE])
END = 1 << int(EXTREMITY - BUS14.sub_first_element[SUB])
OTHER = 1 << int(BUS14.line_ex_pos_topo_vect[5] - BUS14.sub_first_element[SUB])
"""The end of line 5 in the same substation."""


def plan(number=0, n_steps=100):
    return EpisodePlan(0, number, list_scenarios("bus14", "bundled")[0], 0, n_steps)


@pytest.fixture
def engine():
    engine = NativeEngine(BUS14, 1)
    engine.reset(0, plan())
    return engine


def ends(engine):
    return engine.state.topo_vect[0, [ORIGIN, EXTREMITY]].tolist()


def test_a_line_is_switched_before_its_end_is_moved(engine):
    engine.step(0, joint(move(SUB, END | OTHER), switch(LINE)))
    assert ends(engine) == [-1, -1]
    assert engine.state.topo_vect[0, BUS14.line_ex_pos_topo_vect[5]] == 2
    engine.step(0, joint(move(SUB, END), switch(LINE)))
    assert ends(engine) == [1, 2]
    assert not engine.state.illegal[0]


def test_a_restoration_closes_the_line_that_the_same_action_opens(engine):
    engine.step(0, move(SUB, END | OTHER))
    engine.step(0, joint(restore(SUB), switch(LINE)))
    assert ends(engine) == [1, 1]
    assert engine.state.line_status[0, LINE]


def test_a_restoration_leaves_a_line_that_the_same_action_closes_on_busbar_2(engine):
    engine.step(0, move(SUB, END | OTHER))
    engine.step(0, switch(LINE))
    engine.step(0, joint(restore(SUB), reconnect(LINE)))
    assert ends(engine) == [1, 2]
    assert engine.state.topo_vect[0, BUS14.line_ex_pos_topo_vect[5]] == 1


def test_of_an_ambiguous_or_illegal_action_nothing_is_kept(engine):
    values = np.full(6, 0.5, np.float32)
    engine.step(0, joint(reconnect(LINE), move(SUB, END), inject(values)))
    assert (engine.state.ambiguous[0], engine.state.illegal[0]) == (True, False)
    assert ends(engine) == [1, 1]
    assert not engine.state.target_dispatch.any()
    engine.step(0, joint(switch(LINE), switch(7), inject(values)))
    assert (engine.state.ambiguous[0], engine.state.illegal[0]) == (False, True)
    assert engine.state.line_status.all()
    assert not engine.state.target_dispatch.any()
    engine.step(0, joint(switch(LINE), move(SUB, OTHER), inject(values)))
    assert (engine.state.ambiguous[0], engine.state.illegal[0]) == (False, False)
    assert not engine.state.line_status[0, LINE]
    assert engine.state.target_dispatch.any()


def test_of_an_impossible_redispatch_no_change_is_kept(engine):
    """The same request again and again leaves the range of the generator, 140 MW, at last."""
    values = np.zeros(6, np.float32)
    values[0] = 1.0
    for _ in range(40):
        engine.step(0, joint(inject(values), switch(19)))
        if engine.state.illegal[0] or engine.state.terminated[0]:
            break
    assert engine.state.illegal[0]
    before = engine.state.line_status[0].copy()
    engine.step(0, joint(inject(values), switch(19)))
    assert engine.state.illegal[0]
    np.testing.assert_array_equal(engine.state.line_status[0], before)


def test_all_that_is_touched_cools_down():
    grid = load_grid("bus36-MO-v0")
    engine = NativeEngine(grid, 1, opponent=False)
    engine.reset(0, EpisodePlan(0, 0, list_scenarios(grid.id, "bundled")[0], 0, 100))
    sub = int(grid.sub_info.argmax())
    two = grid.line_or_pos_topo_vect[grid.line_or_to_subid == sub][:2] - grid.sub_first_element[sub]
    engine.step(0, joint(switch(0), move(sub, sum(1 << int(k) for k in two))))
    assert not engine.state.terminated[0]
    assert np.flatnonzero(engine.state.time_before_cooldown_line[0]).tolist() == [0]
    assert np.flatnonzero(engine.state.time_before_cooldown_sub[0]).tolist() == [sub]
    engine.step(0, joint(switch(0), move(30, 0b11)))
    assert engine.state.illegal[0]
    assert engine.state.time_before_cooldown_sub[0, 30] == 0


@pytest.mark.parametrize("action", [switch(20), restore(99), move(0, 1 << 40)])
def test_engines_refuse_what_the_grid_does_not_have(engine, action):
    with pytest.raises(UsageError, match="bus14 does"):
        engine.step(0, action)
    with pytest.raises(UsageError, match="bus14 does"):
        commands_of(BUS14, [DO_NOTHING, action])


def test_a_simulated_joint_action_is_the_step_itself():
    engine = NativeEngine(BUS14, 2)
    for i in range(2):
        engine.reset(i, plan())
    action = joint(switch(LINE), move(SUB, OTHER), inject(np.full(6, 0.1, np.float32)))
    topology = engine.simulate(0, action, 1).topo_vect[0].copy()
    assert engine.state.line_status[0].all()
    engine.step(1, action)
    np.testing.assert_array_equal(topology, engine.state.topo_vect[1])


ACTIONS = [
    DO_NOTHING,
    joint(switch(2), move(3, 0b110)),
    inject(np.full(6, 0.25, np.float32)),
    joint(reconnect(1), inject(np.full(6, -0.5, np.float32))),
    joint(move(5, 0b110), switch(4)),
]


def same(one, other):
    assert one.changes == other.changes
    np.testing.assert_equal(one.values, other.values)


def test_batches_keep_every_action():
    commands = commands_of(BUS14, ACTIONS)
    assert commands.first.tolist() == [0, 0, 2, 2, 3]
    assert commands.end.tolist() == [0, 2, 2, 3, 5]
    for k, action in enumerate(ACTIONS):
        same(commands.action(k), action)
    for chosen in ([0, 1, 2, 3, 4], [4, 1], [3], [2, 0]):
        taken = commands.take(np.array(chosen))
        assert len(taken) == len(chosen)
        for k, original in enumerate(chosen):
            same(taken.action(k), ACTIONS[original])
    for k, action in enumerate(ACTIONS[1:4]):
        same(commands[1:4].action(k), action)


def test_a_batch_of_joint_actions_is_played_as_one_by_one():
    def transitions():
        return NativeTransitions(NativeEngine(BUS14, 5), "recovery", "T", PRESETS["default"], 0.9)

    batch, single = transitions(), transitions()
    for i in range(5):
        batch.reset(i, plan(i))
        single.reset(i, plan(i))
    commands = commands_of(BUS14, ACTIONS)
    for _ in range(3):
        batch.play_rows(np.arange(5), commands, 1)
        for i, action in enumerate(ACTIONS):
            single.play(i, action)
        words = [str(effect) for effect in batch.action_effects_of(commands)]
        assert words == [single.action_effects[i] for i in range(5)]
        for name in ("topo_vect", "rho", "actual_dispatch", "transition_reward", "n_steps", "step"):
            np.testing.assert_array_equal(getattr(batch.engine.state, name), getattr(single.engine.state, name), name)


def test_refusals_in_words_are_the_same_on_both_engines():
    reference, native = ReferenceEngine(BUS14, 1), NativeEngine(BUS14, 1)
    refused = [
        (joint(switch(LINE), switch(7)), "refused: one action may change 1 line"),
        (joint(move(SUB, OTHER), restore(1), move(5, 2)), "refused: one action may change 1 substation"),
        (joint(reconnect(LINE), move(SUB, END)), "refused: the action has no single meaning"),
    ]
    for kind, engine in ((Transitions, reference), (NativeTransitions, native)):
        transitions = kind(engine, None, True, PRESETS["default"], 1.0)
        transitions.reset(0, plan())
        for action, words in refused:
            transitions.play(0, action)
            assert transitions.action_effects[0] == words
        assert engine.state.line_status.all()
    reference.close()


@pytest.mark.parametrize(("lines", "subs"), [(2, 3), (3, 1)])
def test_engines_agree_where_the_rules_allow_more(lines, subs):
    reference = ReferenceEngine(BUS14, 1)
    environment = reference.grid2op_environment(0)
    parameters = environment.parameters
    parameters.MAX_LINE_STATUS_CHANGED, parameters.MAX_SUB_CHANGED = lines, subs
    environment.change_parameters(parameters)
    environment.change_forecast_parameters(parameters)
    grid = dataclasses.replace(
        BUS14, rules=dataclasses.replace(BUS14.rules, max_line_changes=lines, max_sub_changes=subs)
    )
    pair = SideBySide(reference, NativeEngine(grid, 2, network=NativeEngine(BUS14, 1).environments.network))
    number = 0
    while pair.tally.steps < 150:
        pair.play(plan(number), make_probe(grid, "joint", "adversarial"), 150 - pair.tally.steps)
        number += 1
    assert not pair.tally.unexplained, "\n".join(map(str, pair.tally.unexplained))
    assert pair.tally.steps == 150
    reference.close()


class BeyondReach:
    """Asks one generator for more until its range is exhausted, and opens or closes a line beside it from then on."""

    def __init__(self, grid):
        self._size, generators = continuous_layout(grid).size, continuous_layout(grid).redispatch
        self._entry = int(np.argmin(grid.gen_pmax[generators] / grid.gen_max_ramp_up[generators]))
        self._gen = generators[self._entry]
        self._last = grid.gen_pmax[self._gen] - grid.gen_max_ramp_up[self._gen]

    def begin(self, random):
        self._random = random

    def choose(self, state, i):
        values = np.zeros(self._size, np.float32)
        values[self._entry] = 1.0
        if state.target_dispatch[i, self._gen] <= self._last:
            return inject(values)
        free = state.time_before_cooldown_line[i] == 0
        opened = np.flatnonzero(free & ~state.line_status[i])
        change = reconnect(int(opened[0])) if len(opened) else switch(int(self._random.choice(np.flatnonzero(free))))
        return joint(inject(values), change)


@pytest.mark.parametrize("dispatch", ["exact", "grid2op"])
@pytest.mark.parametrize("grid_id", ["bus36-MO-v0", "bus118-MOB-v1"])
def test_engines_agree_on_the_changes_beside_a_redispatch_out_of_reach(grid_id, dispatch):
    """Grid2Op keeps such changes, without a cooldown; with the exact dispatch nothing of the action is kept."""
    grid = load_grid(grid_id)
    reference = ReferenceEngine(grid, 1, dispatch)
    pair, number = SideBySide(reference, NativeEngine(grid, 2, dispatch), dispatch=dispatch, simulate_every=5), 0
    while pair.tally.steps < 80:
        series = list_scenarios(grid_id, "bundled")[0]
        pair.play(EpisodePlan(0, number, series, 0, 200), BeyondReach(grid), 80 - pair.tally.steps)
        number += 1
    assert not pair.tally.disagreements, "\n".join(map(str, pair.tally.disagreements))
    assert pair.tally.counts["illegal"] >= 10
    assert pair.tally.simulations >= 10
    reference.close()


def test_the_catalogue_is_played_as_before():
    """Every action of the catalogue is one change, which an engine plays as a batch does."""
    catalogue = full_catalogue(BUS14)
    actions = [catalogue[k] for k in range(0, len(catalogue), 13)]
    commands = commands_of(BUS14, actions)
    np.testing.assert_array_equal(commands.end - commands.first, [len(action.changes) for action in actions])
    np.testing.assert_array_equal(commands.masks[:, 0], catalogue.mask[13::13, 0])
