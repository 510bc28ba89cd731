"""Worlds: what follows a restored one is what followed the original, and what is imagined knows no more than it may."""

from __future__ import annotations

import copy
import functools
import hashlib
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.entry import reset_one
from rl2grid.engines.native.what_if import forecast_of
from rl2grid.engines.worlds import Outlook, World, world_of_plain
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import DO_NOTHING, StepAction, continuous_layout, inject, level_catalogue, switch
from rl2grid.mdp.opponents import OpponentDraws, draw_opponent
from rl2grid.scenarios.episodes import EpisodePlan, plan_episode
from rl2grid.scenarios.library import list_scenarios, load_scenario
from rl2grid.scenarios.scenario import Scenario
from rl2grid.streams import Purpose, Stream

GRIDS = ("bus14", "bus36-MO-v0", "bus36-MO-v1", "bus118-MOB-v1")
ATTACKED = ("bus36-MO-v0", "bus36-MO-v1", "bus118-MOB-v1")
"""One grid of each kind of opponent."""
N_STEPS = 200


@functools.cache
def engines_of(grid_id: str) -> tuple[NativeEngine, NativeEngine]:
    """One with room for two environments, one for a single one."""
    return NativeEngine(load_grid(grid_id), 2), NativeEngine(load_grid(grid_id), 1)


def plan_of(grid_id: str, number: int = 0) -> EpisodePlan:
    return plan_episode(load_grid(grid_id), "bundled", 3, number)


def early_draws(grid_id: str, wait: int = 6) -> OpponentDraws:
    """Attacks that come soon, one area after the other, and last some steps."""
    draws = draw_opponent(load_grid(grid_id), Stream(5, 0, Purpose.OPPONENT), N_STEPS)
    n_areas, n_attacks = draws.waits.shape
    durations = np.minimum(draws.durations, 20 if load_grid(grid_id).opponent.kind != "weighted" else 48)
    waits = (wait + draws.waits % 5 + 25 * np.arange(n_areas)[:, None]).astype(np.int32)
    return draws._replace(waits=waits, durations=durations, n_attacks=np.full(n_areas, n_attacks - 1, np.int32))


SPARE_LINES = {
    "bus14": (12, 13, 14),
    "bus36-MO-v0": (35, 36, 37),
    "bus36-MO-v1": (35, 36, 37),
    "bus118-M": (10, 11, 12),
    "bus118-MOB-v1": (10, 11, 12),
}
"""Lines that the grid can do without."""


def outages_on(grid_id: str) -> np.ndarray:
    """Line, first row, row after the last."""
    first, second, third = SPARE_LINES[grid_id]
    return np.array([[first, 9, 14], [first, 40, 60], [second, 30, 33], [third, 3, 180]], np.int32)


def begin(
    engine: NativeEngine,
    scenario: Scenario,
    draws: OpponentDraws | None,
    *,
    i: int = 0,
    start: int = 0,
    outages: np.ndarray | None = None,
) -> None:
    engine.begin(i, scenario, start, N_STEPS, outages_on(engine.grid.id) if outages is None else outages, draws)
    reset_one(engine.address, i)


def begin_eventful(engine: NativeEngine, i: int = 0) -> None:
    """An episode with planned outages and, where there is an opponent, attacks."""
    grid = engine.grid
    scenario = load_scenario(grid.id, list_scenarios(grid.id, "bundled")[0])
    begin(engine, scenario, early_draws(grid.id) if grid.opponent.kind != "none" else None, i=i)


def random_actions(grid_id: str, n: int, seed: int) -> list[StepAction]:
    grid, random = load_grid(grid_id), np.random.default_rng(seed)
    catalogue = level_catalogue(grid, 0)
    layout = continuous_layout(grid)
    width = len(layout.redispatch) + len(layout.curtail) + len(layout.storage)
    actions = []
    for _ in range(n):
        draw = random.uniform()
        if draw < 0.1:
            actions.append(catalogue[int(random.integers(len(catalogue)))])
        elif draw < 0.4:
            values = random.uniform(-0.3, 0.3, width).astype(np.float32)
            actions.append(inject(values))
        else:
            actions.append(DO_NOTHING)
    return actions


def over(engine: NativeEngine, i: int) -> bool:
    return bool(engine.state.terminated[i] or engine.state.truncated[i])


def rollout(engine: NativeEngine, i: int, actions: list[StepAction]) -> list[bytes]:
    """All bytes of environment ``i`` after each action, as long as the episode lasts."""
    moments = []
    for action in actions:
        if over(engine, i):
            break
        engine.step(i, action)
        moments.append(engine.save(i).rows.tobytes())
    return moments


def play_to(engine: NativeEngine, i: int, actions: list[StepAction]) -> None:
    for action in actions:
        engine.step(i, action)


# --- True worlds ----------------------------------------------------------------------------------------------------


def test_a_copied_engine_is_independent_of_the_original():
    engine = NativeEngine(load_grid("bus14"), 2)
    engine.reset(0, plan_of("bus14"))
    play_to(engine, 0, [DO_NOTHING] * 3)
    before = engine.save(0)
    copied = copy.deepcopy(engine)
    play_to(copied, 0, [DO_NOTHING] * 5)
    assert engine.state.step[0] == 3
    assert engine.save(0) == before
    play_to(engine, 0, [DO_NOTHING] * 5)
    assert engine.save(0) == copied.save(0)
    # A row that was never reset is as new.
    with pytest.raises(UsageError, match="was not reset yet"):
        copied.save(1)


@pytest.mark.parametrize("grid_id", GRIDS)
def test_what_follows_a_restored_world_is_what_followed_the_original(grid_id: str):
    engine, other = engines_of(grid_id)
    attacks = outages = 0
    for episode in range(4):
        begin_eventful(engine)
        actions = random_actions(grid_id, 60, episode)
        moment = 5 + 9 * episode
        for k in range(moment):
            if not over(engine, 0):
                engine.step(0, actions[k])
        world = engine.save(0)
        attacks += bool(engine.state.attacked[0].any())
        outages += bool((engine.state.time_next_maintenance[0] == 0).any())
        original = rollout(engine, 0, actions[moment:])
        # Into another row, another engine, the same row, and out of a pickle; each where something else was played.
        engine.reset(1, plan_of(grid_id, episode))
        begin_eventful(other)
        for where, i, saved in (
            (engine, 1, world),
            (other, 0, world),
            (engine, 0, world),
            (other, 0, pickle.loads(pickle.dumps(world))),
        ):
            where.restore(i, saved)
            assert where.save(i) == world
            assert rollout(where, i, actions[moment:]) == original
    assert outages
    assert attacks or grid_id == "bus14"


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-M"])
def test_a_flow_that_was_never_warm_and_one_that_ended_are_worlds_too(grid_id: str):
    engine, other = engines_of(grid_id)
    begin_eventful(engine)
    other.restore(0, engine.save(0))
    assert rollout(engine, 0, [DO_NOTHING] * 10) == rollout(other, 0, [DO_NOTHING] * 10)
    lines = [switch(line) for line in range(engine.grid.n_line)]
    for action in lines:
        if not over(engine, 0):
            engine.step(0, action)
    assert engine.state.terminated[0]
    world = engine.save(0)
    other.restore(0, world)
    assert other.state.game_over[0] == engine.state.game_over[0]
    assert other.save(0) == world


def test_a_restored_world_is_simulated_like_the_original():
    engine, other = engines_of("bus118-MOB-v1")
    begin_eventful(engine)
    play_to(engine, 0, random_actions("bus118-MOB-v1", 12, 1)[:8])
    other.restore(0, engine.save(0))
    for horizon in (1, 12):
        expected = {name: array[0].copy() for name, array in engine.simulate(0, DO_NOTHING, horizon)._asdict().items()}
        found = other.simulate(0, DO_NOTHING, horizon)
        for name in ("rho", "gen_p", "time_before_cooldown_line", "time_next_maintenance"):
            np.testing.assert_array_equal(getattr(found, name)[0], expected[name], err_msg=name)
    for name, array in forecast_of(engine, 0)._asdict().items():
        np.testing.assert_array_equal(array, getattr(forecast_of(other, 0), name), err_msg=name)


def test_an_engine_makes_room_for_the_outages_of_a_world():
    grid = load_grid("bus14")
    engine, small = NativeEngine(grid, 1), NativeEngine(grid, 2)
    begin_eventful(engine)
    world = engine.save(0)
    begin(
        small, load_scenario("bus14", list_scenarios("bus14", "bundled")[1]), None, i=1, outages=outages_on("bus14")[:0]
    )
    kept = small.save(1)
    small.restore(0, world)
    assert rollout(small, 0, [DO_NOTHING] * 45) == rollout(engine, 0, [DO_NOTHING] * 45)
    assert small.save(1) == kept
    assert world.nbytes == kept.nbytes + 3 * 4 * 4


def test_a_world_is_a_value():
    engine, _ = engines_of("bus36-MO-v0")
    begin_eventful(engine)
    world = engine.save(0)
    assert world == engine.save(0)
    assert hash(world) == hash(engine.save(0))
    assert copy.deepcopy(world) is world
    assert not world.imagined
    with pytest.raises(ValueError, match="read-only"):
        world.rows[0] = 1
    with pytest.raises(ValueError, match="read-only"):
        pickle.loads(pickle.dumps(world)).rows[0] = 1
    engine.step(0, DO_NOTHING)
    assert world != engine.save(0)
    assert len(pickle.dumps(world)) == pytest.approx(world.nbytes, abs=1000)


@pytest.mark.parametrize("imagined", [False, True])
def test_a_world_has_a_plain_form(imagined: bool):
    engine, _ = engines_of("bus118-MOB-v1")
    begin_eventful(engine)
    world = engine.imagine(0, 4) if imagined else engine.save(0)
    plain = world.to_plain()
    assert_plain(plain)
    again = world_of_plain(plain)
    assert again == world
    assert again.imagined == imagined
    with pytest.raises(UsageError, match="does not hold the worlds"):
        world_of_plain({"seed": 3, "actions": [1, 2]})


def assert_plain(value: object) -> None:
    if isinstance(value, dict):
        for item in value.values():
            assert_plain(item)
    elif isinstance(value, list | tuple):
        for item in value:
            assert_plain(item)
    else:
        assert value is None or type(value) in (bool, int, float, str), type(value)


def test_worlds_of_other_engines_are_refused():
    engine, _ = engines_of("bus14")
    begin_eventful(engine)
    world = engine.save(0)
    silent = NativeEngine(load_grid("bus36-MO-v0"), 1, opponent=False)
    with pytest.raises(UsageError, match=r"of the native engine on bus14.*: it cannot be restored on .* bus36-MO-v0"):
        engines_of("bus36-MO-v0")[0].restore(0, world)
    begin_eventful(engines_of("bus36-MO-v0")[0])
    attacked = engines_of("bus36-MO-v0")[0].save(0)
    with pytest.raises(UsageError, match="without opponent"):
        silent.restore(0, attacked)
    with pytest.raises(UsageError, match="another version"):
        engine.restore(0, replace(world, home=replace(world.home, layout="older")))
    changed = pickle.loads(pickle.dumps(world))
    with pytest.raises(UsageError, match="has other values than when this world was saved"):
        engine.restore(0, replace(changed, series=replace(changed.series, content_hash="other")))


def test_a_world_of_a_series_without_a_name_is_restored_as_long_as_it_is_there():
    engine, other = engines_of("bus14")
    named = load_scenario("bus14", list_scenarios("bus14", "bundled")[0])
    own = replace(named, load_p=(0.9 * named.load_p).astype(np.float32))
    begin(engine, own, None)
    world = engine.save(0)
    begin(other, named, None)
    other.restore(0, world)
    assert rollout(other, 0, [DO_NOTHING] * 5) == rollout(engine, 0, [DO_NOTHING] * 5)
    assert other.state.load_p[0].sum() == pytest.approx(own.load_p[5].sum())


_ELSEWHERE = """
import hashlib, pickle, sys
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.grids import load_grid
world, engine, actions = pickle.load(sys.stdin.buffer)
own = NativeEngine(load_grid(world.home.grid_id), 1)
own.restore(0, world)
for action in actions:
    own.step(0, action)
    engine.step(0, action)
print(*(hashlib.sha256(each.save(0).rows.tobytes()).hexdigest() for each in (own, engine)))
"""


def test_worlds_and_engines_go_on_in_another_process():
    engine, _ = engines_of("bus36-MO-v1")
    begin_eventful(engine)
    actions = random_actions("bus36-MO-v1", 30, 2)
    play_to(engine, 0, actions[:8])
    message = pickle.dumps((engine.save(0), engine, actions[8:20]))
    play_to(engine, 0, actions[8:20])
    expected = hashlib.sha256(engine.save(0).rows.tobytes()).hexdigest()
    answer = subprocess.run([sys.executable, "-c", _ELSEWHERE], input=message, capture_output=True, check=True)
    assert answer.stdout.decode().split() == [expected, expected]


# --- Imagined worlds ------------------------------------------------------------------------------------------------


def changed_future(scenario: Scenario, now: int) -> Scenario:
    """The same series up to row ``now`` and the forecasts made until then; others after it."""
    random = np.random.default_rng(now)
    arrays = {}
    for name, array in scenario.arrays().items():
        if array.dtype != np.float32:
            continue
        other = np.array(array)
        other[now + 1 :] *= random.uniform(0.8, 0.9, other[now + 1 :].shape).astype(np.float32)
        arrays[name] = other
    return replace(scenario, content_hash="another future", **arrays)


def changed_draws(engine: NativeEngine, draws: OpponentDraws) -> OpponentDraws:
    """Other attacks to come, and another end of one that is under way where nobody has seen it."""
    opponent, random = engine.environments.opponent, np.random.default_rng(1)
    waits, durations, choices = draws.waits.copy(), draws.durations.copy(), draws.choices.copy()
    for area, k in enumerate(opponent.attack_counter[0].tolist()):
        waits[area, k] += 7
        waits[area, k + 1 :] = random.integers(1, 9, waits[area, k + 1 :].shape)
        durations[area, k:] = random.integers(12, 40, durations[area, k:].shape)
        choices[area, k:] = random.uniform(size=choices[area, k:].shape)
        if engine.grid.opponent.kind == "multi_area" and opponent.area_duration[0, area] > 0:
            durations[area, k - 1] += 5
    return OpponentDraws(draws.n_attacks + 1, waits, durations, choices)


@pytest.mark.parametrize("grid_id", ["bus14", *ATTACKED])
def test_no_imagined_rollout_depends_on_the_true_future(grid_id: str):
    """Other series, forecasts, maintenance and attacks after the present row change not a bit of what is imagined."""
    scenario = load_scenario(grid_id, list_scenarios(grid_id, "bundled")[0])
    draws = early_draws(grid_id) if grid_id in ATTACKED else None
    under_attack = 0
    for now in (2, 5, 9, 16, 31):
        # New ones: bytes that no step reads are left over from earlier episodes, and are compared as well.
        engine, other = NativeEngine(load_grid(grid_id), 2), NativeEngine(load_grid(grid_id), 1)
        actions = [DO_NOTHING] * (now - 1) + random_actions(grid_id, 40, now)
        begin(engine, scenario, draws)
        play_to(engine, 0, actions[:now])
        assert not over(engine, 0)
        other_draws = None if draws is None else changed_draws(engine, draws)
        # The outages that are announced at that moment stay; those behind them do not.
        outages = outages_on(grid_id)
        if now < 14:
            outages[1, 1:] += 11
        begin(other, changed_future(scenario, now), other_draws, outages=outages)
        play_to(other, 0, actions[:now])
        assert engine.save(0) != other.save(0)
        under_attack += bool(engine.state.attacked[0].any())
        truth = other.save(0)
        for seed in (0, 1):
            other.restore(0, truth)
            world, again = engine.imagine(0, seed), other.imagine(0, seed)
            assert world == again
            engine.restore(1, world)
            other.restore(0, again)
            assert rollout(engine, 1, actions[now:]) == rollout(other, 0, actions[now:])
    assert under_attack or grid_id == "bus14"


@pytest.mark.parametrize("grid_id", ATTACKED)
def test_imagined_rollouts_of_different_seeds_differ_where_there_is_an_opponent(grid_id: str):
    engine, _ = engines_of(grid_id)
    begin_eventful(engine)
    play_to(engine, 0, [DO_NOTHING] * 2)
    histories = set()
    for seed in range(10):
        world = engine.imagine(0, seed)
        assert engine.imagine(0, seed) == world
        engine.restore(1, world)
        histories.add(tuple(rollout(engine, 1, [DO_NOTHING] * 150)))
    assert len(histories) > 3


def test_without_an_opponent_all_seeds_imagine_the_same():
    engine, _ = engines_of("bus14")
    begin_eventful(engine)
    assert engine.imagine(0, 0) == engine.imagine(0, 1)


@pytest.mark.parametrize("grid_id", ATTACKED)
def test_an_attack_under_way_stays_in_imagined_worlds(grid_id: str):
    engine, _ = engines_of(grid_id)
    begin_eventful(engine)
    while not engine.state.attacked[0].any():
        assert not over(engine, 0)
        engine.step(0, DO_NOTHING)
    play_to(engine, 0, [DO_NOTHING])
    attacked, left = engine.state.attacked[0].copy(), engine.environments.opponent.attack_duration[0]
    lengths = set()
    for seed in range(8):
        engine.restore(1, engine.imagine(0, seed))
        np.testing.assert_array_equal(engine.state.attacked[1], attacked)
        assert engine.environments.opponent.budget[1] == engine.environments.opponent.budget[0]
        steps = 0
        while (engine.state.attacked[1] & attacked).any() and not over(engine, 1):
            engine.step(1, DO_NOTHING)
            steps += 1
        lengths.add(steps)
    if engine.grid.opponent.kind == "multi_area":
        # At least what is left of the shortest attack; how long it really takes is not known.
        assert min(lengths) >= engine.grid.opponent.minimum_duration
        assert len(lengths) > 1
    else:
        # The cooldown of the line has shown it.
        assert lengths == {left}


@pytest.mark.parametrize("grid_id", ATTACKED)
def test_imagined_attacks_come_as_often_as_published(grid_id: str):
    """The mean number of steps to the first attack, from a moment at which there is none, is that of new episodes."""
    grid = load_grid(grid_id)
    engine, _ = engines_of(grid_id)
    config = grid.opponent
    begin(engine, load_scenario(grid_id, list_scenarios(grid_id, "bundled")[0]), early_draws(grid_id, wait=150))
    play_to(engine, 0, [DO_NOTHING] * 10)
    layout = engine._layout
    times = [
        layout.view(engine.imagine(0, seed).rows)["opponent.next_attack_time"].astype(float) for seed in range(400)
    ]
    mean = 1 + (config.attack_period - 10 - 1) / 2 if config.kind == "weighted" else 1 / config.hazard_rate
    assert np.mean(times) == pytest.approx(mean, rel=0.12)


def test_an_imagined_future_is_the_forecast_and_then_its_last_row():
    engine, _ = engines_of("bus118-MOB-v1")
    scenario = load_scenario("bus118-MOB-v1", list_scenarios("bus118-MOB-v1", "bundled")[0])
    begin(engine, scenario, None, start=3)
    play_to(engine, 0, [DO_NOTHING] * 4)
    assert scenario.load_p_forecast is not None
    forecast = scenario.load_p_forecast[7]
    world = engine.imagine(0, 0)
    assert world.imagined
    assert isinstance(world.series, Outlook)
    assert world.nbytes == engine.save(0).nbytes + world.series.nbytes - 12 * (4 - len(announced(engine)))
    expected = engine.simulate(0, DO_NOTHING, 1).rho[0].copy()
    engine.restore(1, world)
    np.testing.assert_array_equal(engine.simulate(1, DO_NOTHING, 1).rho[0], expected)
    for k in range(15):
        ahead = engine.simulate(1, DO_NOTHING, 12).load_p[0].copy()
        np.testing.assert_array_equal(ahead, forecast[min(k + 11, 11)])
        engine.step(1, DO_NOTHING)
        np.testing.assert_array_equal(engine.state.load_p[1], forecast[min(k, 11)])
    # What is imagined in an imagined world is the same future.
    assert engine.imagine(1, 0).series == world.series


def announced(engine: NativeEngine) -> np.ndarray:
    return np.flatnonzero(engine.state.time_next_maintenance[0] >= 0)


def test_only_announced_maintenance_happens_in_an_imagined_world():
    engine, _ = engines_of("bus14")
    begin_eventful(engine)
    play_to(engine, 0, [DO_NOTHING] * 10)
    shown = [engine.state.time_next_maintenance[0].copy(), engine.state.duration_next_maintenance[0].copy()]
    engine.restore(1, engine.imagine(0, 0))
    np.testing.assert_array_equal(engine.state.time_next_maintenance[1], shown[0])
    out = []
    for _ in range(55):
        engine.step(0, DO_NOTHING)
        engine.step(1, DO_NOTHING)
        assert not engine.state.terminated[:2].any()
        out.append([engine.state.time_next_maintenance[i, 12] == 0 for i in (0, 1)])
    # Line 12 is out in steps 9 to 13, as announced; of its outage in steps 40 to 59 nothing was said at step 10.
    truly, imagined = np.array(out).T
    np.testing.assert_array_equal(np.flatnonzero(imagined) + 11, [11, 12, 13])
    np.testing.assert_array_equal(np.flatnonzero(truly) + 11, [11, 12, 13, *range(40, 60)])


def test_without_forecasts_the_present_row_goes_on():
    engine, _ = engines_of("bus14")
    scenario = load_scenario("bus14", list_scenarios("bus14", "bundled")[0])
    blind = replace(scenario, load_p_forecast=None, load_q_forecast=None, prod_p_forecast=None, prod_v_forecast=None)
    begin(engine, blind, None)
    play_to(engine, 0, [DO_NOTHING] * 4)
    engine.restore(1, engine.imagine(0, 0))
    demand = engine.state.load_p[0].copy()
    for _ in range(3):
        np.testing.assert_array_equal(engine.simulate(1, DO_NOTHING, 1).load_p[0], demand)
        engine.step(1, DO_NOTHING)
        np.testing.assert_array_equal(engine.state.load_p[1], demand)


def test_nothing_is_imagined_after_the_end():
    engine, _ = engines_of("bus14")
    begin_eventful(engine)
    engine.state.truncated[0] = True
    with pytest.raises(UsageError, match="Nothing can be imagined after the end"):
        engine.imagine(0, 0)
    with pytest.raises(UsageError, match="was not reset yet"):
        NativeEngine(load_grid("bus14"), 1).imagine(0, 0)


# --- The reference engine -------------------------------------------------------------------------------------------


def test_the_reference_engine_comes_back_by_playing_again():
    from rl2grid.engines.reference.engine import ReferenceEngine

    grid = load_grid("bus14")
    engine = ReferenceEngine(grid, 2)
    with pytest.raises(UsageError, match="was not reset yet"):
        engine.save(0)
    engine.reset(0, plan_of("bus14"))
    actions = random_actions("bus14", 20, 4)
    play_to(engine, 0, actions[:6])
    engine.state.episode_return[0] = 5.5  # sums are not the engine's, but belong to the world
    world = engine.save(0)
    assert world_of_plain(world.to_plain()) == world
    copied = copy.deepcopy(engine)
    engine.restore(1, pickle.loads(pickle.dumps(world)))
    assert engine.state.episode_return[1] == 5.5
    for action in actions[6:]:
        for each, i in ((engine, 0), (engine, 1), (copied, 0)):
            each.step(i, action)
        assert_same_rows(engine, 0, engine, 1)
        assert_same_rows(engine, 0, copied, 0)
    with pytest.raises(UsageError, match='choose engine="native"'):
        engine.imagine(0, 0)
    native = engines_of("bus14")[0]
    begin_eventful(native)
    with pytest.raises(UsageError, match="cannot be restored"):
        engine.restore(0, native.save(0))


def assert_same_rows(one: object, i: int, other: object, j: int) -> None:
    mine, theirs = (engine.save(row) for engine, row in ((one, i), (other, j)))
    assert isinstance(mine, World)
    np.testing.assert_array_equal(mine.rows, theirs.rows)
