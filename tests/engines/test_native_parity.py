"""The native engine equals the reference engine, value by value; and the comparison finds what does not."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest

from rl2grid.engines.differential import (
    COMPARED,
    DISPATCH_SOLVER,
    DIVERGENCE,
    THRESHOLD,
    TOLERANCES,
    Detour,
    SideBySide,
    TransitionsSideBySide,
    near_threshold,
)
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.transitions import NativeTransitions
from rl2grid.engines.probes import PROBES, make_probe
from rl2grid.engines.reference.engine import ReferenceEngine
from rl2grid.engines.transition import Transitions
from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp.actions import StepAction, full_catalogue, switch
from rl2grid.mdp.rewards import PRESETS
from rl2grid.mdp.state import new_state
from rl2grid.mdp.termination import GameOver
from rl2grid.scenarios.episodes import EpisodePlan
from rl2grid.scenarios.library import list_scenarios, load_scenario

ROWS = 3
IDLE = PROBES["topology"]["idle"]
PARTS = [(kind, name) for kind, probes in PROBES.items() for name in probes]


@functools.cache
def engines(grid_id, dispatch):
    grid = load_grid(grid_id)
    return ReferenceEngine(grid, 1, dispatch), NativeEngine(grid, ROWS, dispatch)


def plan(grid_id, seed, number):
    """An episode from a random row of a bundled series; plans of one number differ by seed."""
    random = np.random.default_rng((seed, number, 1))
    scenarios = list_scenarios(grid_id, "bundled")
    scenario = scenarios[int(random.integers(len(scenarios)))]
    n_steps = load_scenario(grid_id, scenario).n_steps
    start = int(random.integers(n_steps // 2))
    return EpisodePlan(seed, number, scenario, start, n_steps - start)


def compare(grid_id, kind, name, steps, seed, dispatch="exact"):
    """Play ``steps`` steps of a probe on both engines; returns the tally."""
    reference, native = engines(grid_id, dispatch)
    pair = SideBySide(reference, native, dispatch=dispatch, simulate_every=10)
    probe, number = make_probe(load_grid(grid_id), kind, name), 0
    while pair.tally.steps < steps:
        pair.play(plan(grid_id, seed, number), probe, steps - pair.tally.steps)
        number += 1
    return pair.tally


def report(tally):
    return "\n".join(str(each) for each in tally.unexplained)


@pytest.mark.parametrize(("kind", "name"), PARTS)
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_engines_agree(grid_id, kind, name):
    tally = compare(grid_id, kind, name, steps=50, seed=1)
    assert not tally.unexplained, report(tally)
    assert tally.steps == 50
    assert tally.simulations >= 2


@pytest.mark.parametrize("kind", ["continuous", "mixed", "joint"])
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_engines_agree_with_the_dispatch_of_grid2op(grid_id, kind):
    tally = compare(grid_id, kind, "adversarial", steps=50, seed=2, dispatch="grid2op")
    assert not tally.unexplained, report(tally)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "name"), PARTS)
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_engines_agree_for_long(grid_id, kind, name):
    for dispatch in ("exact",) if kind == "topology" else ("exact", "grid2op"):
        tally = compare(grid_id, kind, name, steps=600, seed=3, dispatch=dispatch)
        assert not tally.unexplained, report(tally)


@pytest.mark.slow
def test_the_steps_compared_hold_everything_that_happens():
    seen = {name for grid_id in GRID_IDS for name, count in _long_tally(grid_id).counts.items() if count}
    assert seen == {*_long_tally("bus14").counts} - {"ambiguous"}  # a Box action is never ambiguous
    endings = {name for grid_id in GRID_IDS for name in _long_tally(grid_id).game_overs}
    assert {"LOAD_DISCONNECTED", "GENERATOR_DISCONNECTED", "ISLAND", "DIVERGENCE", "DISPATCH"} <= endings


@functools.cache
def _long_tally(grid_id):
    return compare(grid_id, "mixed", "adversarial", steps=3000, seed=4)


@pytest.mark.parametrize("heuristic", ["idle", "recovery", "careful", "secure"])
@pytest.mark.parametrize("grid_id", ["bus14", "bus36-MO-v0", "bus118-MOB-v1"])
def test_transitions_agree(grid_id, heuristic):
    """With the heuristic deciding on each engine's own state, transitions have the same length and sums."""
    row, grid = 1, load_grid(grid_id)
    pair = [Transitions(each, heuristic, "T", PRESETS["default"], 0.99) for each in engines(grid_id, "exact")]
    states, rows = [each.engine.state for each in pair], (0, row)
    episode = plan(grid_id, 5, row)
    short = EpisodePlan(5, row, episode.scenario_id, episode.start, 60)
    random = np.random.default_rng(5)
    for transitions, i in zip(pair, rows, strict=True):
        transitions.reset(i, short)
    while not (states[0].terminated[0] or states[0].truncated[0]):
        action = full_catalogue(grid)[int(random.integers(len(full_catalogue(grid))))]
        for transitions, i in zip(pair, rows, strict=True):
            transitions.play(i, action)
        for name in ("step", "n_steps", "decisions", "terminated", "truncated", "open_since", "split_since"):
            np.testing.assert_array_equal(getattr(states[0], name)[0], getattr(states[1], name)[row], name)
        for name in ("transition_reward", "transition_discounted", "transition_costs", "episode_scores"):
            np.testing.assert_allclose(getattr(states[1], name)[row], getattr(states[0], name)[0], rtol=0, atol=1e-4)


@functools.cache
def second_reference():
    return ReferenceEngine(load_grid("bus14"), 1)


class Tampered:
    """A reference engine whose state is changed after one of its steps, or in its simulations."""

    def __init__(self, at_step, tamper, simulated=None):
        self._engine, self._at_step, self._tamper = second_reference(), at_step, tamper
        self.grid, self.state = self._engine.grid, self._engine.state
        self._simulated = simulated

    def reset(self, i, plan):
        self._engine.reset(i, plan)

    def step(self, i, action):
        self._engine.step(i, action)
        if self.state.step[i] == self._at_step:
            self._tamper(self.state, i)

    def simulate(self, i, action, horizon):
        result = self._engine.simulate(i, action, horizon)
        if self._simulated is not None:
            self._simulated(result, 0)
        return result

    def close(self):
        self._engine.close()


def play_beside(tampered):
    """Play 30 idle steps on bus14; returns the tally."""
    reference, _ = engines("bus14", "exact")
    pair = SideBySide(reference, tampered, simulate_every=10)
    pair.play(EpisodePlan(0, 3, list_scenarios("bus14", "bundled")[0], 0, 100), IDLE(load_grid("bus14")), 30)
    return pair.tally


def find_fault(tamper=lambda state, i: None, simulated=None):
    """The disagreements with an engine that is tampered with after step 17."""
    return play_beside(Tampered(17, tamper, simulated)).disagreements


def change(name, value, element=2):
    def tamper(state, i):
        array = getattr(state, name)
        if array.ndim == 1:
            array[i] = array[i] + value if array.dtype != np.bool_ else not array[i]
        else:
            array[i, element] = array[i, element] + value if array.dtype != np.bool_ else not array[i, element]

    return tamper


def lose(reason):
    """The engine believes that the grid was lost."""

    def tamper(state, i):
        state.terminated[i], state.game_over[i] = True, int(reason)
        state.rho[i] = 0

    return tamper


# Attributes of a step's sums are computed by the comparison itself, from the others.
OWN = [name for name in COMPARED if not name.startswith(("transition_", "episode_scores", "storage", "excused"))]


@pytest.mark.parametrize("name", OWN)
def test_a_fault_of_one_value_is_found(name):
    faulty = change(name, 3 * TOLERANCES.get(name, 1) if name != "a_or" else 1e-3)
    disagreements = find_fault(faulty)
    assert [each.step for each in disagreements] == [17]
    assert name in {each.attribute for each in disagreements[0].differences}
    assert disagreements[0].cause == ""


def test_no_fault_is_found_where_there_is_none():
    assert find_fault() == []


def test_a_difference_within_the_tolerance_is_admitted_and_remembered():
    tally = play_beside(Tampered(17, change("rho", 5e-6)))
    assert tally.disagreements == []
    assert tally.largest["rho"] == pytest.approx(5e-6, rel=0.02)


class Forgetful(Tampered):
    """A reference engine that plays only a part of every action."""

    def __init__(self, part):
        super().__init__(0, lambda state, i: None)
        self._part = part

    def step(self, i, action):
        super().step(i, self._part(action))


@pytest.mark.parametrize(
    "part",
    [
        lambda action: StepAction(action.changes[1:], action.values),
        lambda action: StepAction(action.changes[:1], action.values),
        lambda action: StepAction(action.changes, action.values if len(action.changes) < 2 else None),
    ],
    ids=["without the first change", "the first change alone", "without the injection beside changes"],
)
def test_a_part_of_a_joint_action_that_is_not_played_is_found(part):
    reference, _ = engines("bus14", "exact")
    pair, probe = SideBySide(reference, Forgetful(part)), make_probe(load_grid("bus14"), "joint", "within limits")
    for number in range(20):
        pair.play(plan("bus14", 6, number), probe, 50)
        if pair.tally.disagreements:
            break
    assert pair.tally.unexplained


def test_nan_is_a_fault():
    (disagreement,) = find_fault(change("gen_p", np.nan))
    assert disagreement.cause == ""


def test_a_fault_of_a_simulation_is_found():
    (disagreement,) = find_fault(simulated=change("rho", 1e-3))
    assert (disagreement.step, disagreement.horizon) == (6, 1)
    assert disagreement.cause == ""


def test_a_loading_at_a_threshold_explains_a_difference():
    def tamper(state, i):
        state.rho[i, 2] = 1.0000004
        state.timestep_overflow[i, 2] = 1

    (disagreement,) = find_fault(tamper)
    assert disagreement.cause == THRESHOLD
    assert "line 2" in disagreement.evidence


@pytest.mark.parametrize("rho", [1.0, 0.999995, 2.000001])
def test_near_a_threshold(rho):
    loadings = np.full(20, 0.5, np.float32)
    assert near_threshold((1.0, 2.0), loadings) == ""
    loadings[7] = rho
    assert near_threshold((1.0, 2.0), loadings).startswith("line 7 ")


def test_another_dispatch_is_explained_with_the_solver_of_grid2op_alone():
    for dispatch, cause in (("exact", ""), ("grid2op", DISPATCH_SOLVER)):
        reference, _ = engines("bus14", "exact")
        pair = SideBySide(reference, Tampered(17, change("actual_dispatch", 1.0)), dispatch=dispatch)
        pair.play(EpisodePlan(0, 3, list_scenarios("bus14", "bundled")[0], 0, 100), IDLE(load_grid("bus14")), 30)
        assert [each.cause for each in pair.tally.disagreements] == [cause]


def test_another_attack_is_explained_by_another_order_of_loadings_alone():
    """Two loadings of attackable lines, admissibly different, whose order is not the same in the engines."""
    grid = load_grid("bus36-MO-v1")
    pair = SideBySide(*(SimpleNamespace(grid=grid, state=new_state(grid, 1)) for _ in range(2)))
    first, second = grid.opponent.areas[0][:2]
    rho = np.full((2, grid.n_line), 0.3, np.float32)
    assert not pair.ranks_differ(rho)
    rho[0, [first, second]] = 0.500004, 0.500006
    rho[1, [first, second]] = 0.500006, 0.500004
    assert pair.ranks_differ(rho)


def test_only_a_divergence_explains_a_lost_flow():
    (disagreement,) = find_fault(lose(GameOver.DIVERGENCE))
    assert disagreement.cause == DIVERGENCE
    (disagreement,) = find_fault(lose(GameOver.ISLAND))
    assert disagreement.cause == ""


def test_the_last_topology_of_a_lost_game_is_compared():
    """Opening the only line of substation 7 of bus14 cuts its generator off."""
    grid = load_grid("bus14")
    (line,) = np.flatnonzero((grid.line_or_to_subid == 7) | (grid.line_ex_to_subid == 7))
    fatal = SimpleNamespace(begin=lambda random: None, choose=lambda state, i: switch(int(line)))
    reference, _ = engines("bus14", "exact")
    for tamper, expected in ((change("final_topo_vect", 1), ["final_topo_vect"]), (lambda state, i: None, [])):
        pair = SideBySide(reference, Tampered(1, tamper))
        pair.play(EpisodePlan(0, 0, list_scenarios("bus14", "bundled")[0], 0, 100), fatal)
        assert pair.tally.game_overs == {"GENERATOR_DISCONNECTED": 1}
        assert [each.attribute for found in pair.tally.disagreements for each in found.differences] == expected


def test_unknown_probes_are_refused():
    with pytest.raises(UsageError, match="Kind of probe"):
        make_probe(load_grid("bus14"), "redispatch", "random")
    with pytest.raises(UsageError, match="choose one of random, adversarial, moved lines, recovery, idle"):
        make_probe(load_grid("bus14"), "topology", "evil")


@pytest.mark.parametrize(
    "heuristic",
    [pytest.param("recovery", marks=pytest.mark.slow), "careful", pytest.param("secure", marks=pytest.mark.slow)],
)
def test_transitions_are_compared_and_a_heuristic_that_differs_is_found(heuristic):
    reference, native = engines("bus36-MO-v0", "exact")

    def play(other):
        settings = ("T", PRESETS["default"], 0.99)
        pair = TransitionsSideBySide(
            Transitions(reference, heuristic, *settings), NativeTransitions(native, other, *settings)
        )
        probe = make_probe(native.grid, "topology", "random")
        for number in range(3):
            pair.play(plan("bus36-MO-v0", 8, number), probe, 60)
        return pair.tally

    tally = play(heuristic)
    assert not tally.disagreements, report(tally)
    assert tally.steps >= 60
    assert play("idle").unexplained


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-MOB-v1"])
def test_environments_that_are_saved_and_brought_back_still_agree(grid_id):
    reference, native = engines(grid_id, "exact")
    detour = Detour(native, make_probe(native.grid, "mixed", "random"), every=5)
    pair = SideBySide(reference, detour, simulate_every=10)
    probe = make_probe(native.grid, "joint", "adversarial")
    for number in range(2):
        pair.play(plan(grid_id, 9, number), probe, 40)
    assert not pair.tally.unexplained, report(pair.tally)
    assert pair.tally.steps >= 10


def test_a_detour_that_is_not_taken_back_is_found(monkeypatch):
    reference, native = engines("bus14", "exact")
    detour = Detour(native, make_probe(native.grid, "mixed", "random"), every=5)
    monkeypatch.setattr(native, "restore", lambda i, world: None)
    pair = SideBySide(reference, detour)
    pair.play(plan("bus14", 9, 0), make_probe(native.grid, "joint", "adversarial"), 40)
    assert pair.tally.unexplained
