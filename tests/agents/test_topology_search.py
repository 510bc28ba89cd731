"""The search over sequences beside trying all of them, and beside what the environment does."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents.contingencies import NONE, Contingencies, danger
from rl2grid.agents.topology_search import NOTHING, TopologySearch
from rl2grid.agents.trend import Later
from rl2grid.engines.native.what_if import WhatIf, forecast_of, snapshot_of
from rl2grid.mdp.actions import ActionKind, full_catalogue


def overloaded(task: str = "bus14-T0", seed: int = 3) -> Any:
    """A grid that is not safe."""
    env = gymnasium.make(f"rl2grid/{task}-v0", heuristic="idle", disable_env_checker=True).unwrapped
    env.reset(seed=seed)
    return env


def search_of(env: Any, **keywords: Any) -> TopologySearch:
    catalogue = full_catalogue(env.grid).take(env.action_catalogue_ids)
    return TopologySearch(env.grid, catalogue, WhatIf(env.grid), **keywords)


def none(env: Any) -> Any:
    return np.zeros(env.grid.n_line, np.int32)


@pytest.mark.parametrize("seed", range(6))
def test_one_action_alone_is_the_best_by_its_score(seed):
    env = overloaded(seed=seed)
    search, point = search_of(env, longest=0), forecast_of(env.engine, 0)
    assert point is not None
    found = search.best(point, none(env), NONE)
    outcomes, rho = search.outcomes(point)
    score = np.where(outcomes.legal, outcomes.worst_loading, np.inf) + 0.3 * np.clip(rho - 1.0, 0.0, 2.0).sum(axis=1)
    score = score + 3.0 * (rho > env.grid.rules.hard_overflow).any(axis=1)
    assert found.n_actions == 1
    assert np.isclose(score[found.action], np.nanmin(score), atol=1e-5)
    entries, penalties = zip(*search.singles, strict=True)
    np.testing.assert_allclose(penalties, score[list(entries)], atol=1e-5)
    assert sorted(penalties) == list(penalties)
    assert np.isfinite(penalties).all()


def test_a_sequence_is_found_where_no_action_alone_helps():
    """Two moves must work together: every first action leaves an overload, and some second one after it does not."""
    env = overloaded()
    search, point = search_of(env), forecast_of(env.engine, 0)
    assert point is not None
    found_one = False
    for factor in np.arange(1.0, 1.6, 0.05):
        heavy = point._replace(
            load_p=(point.load_p * factor).astype(np.float32), gen_p=(point.gen_p * factor).astype(np.float32)
        )
        first, _ = search.outcomes(heavy)
        single = np.where(first.legal, first.worst_loading, np.inf).min()
        pairs = min(
            float(search.outcomes(search.after(heavy, action))[0].worst_loading.min())
            for action in np.argsort(first.worst_loading)[:20].tolist()
        )
        if single < 0.95 or pairs >= 0.95:
            continue
        found = search.best(heavy, none(env), NONE)
        assert found.n_actions == 2
        assert found.worst_loading < 0.95
        assert found.n_trips == 0
        found_one = True
    assert found_one


def test_after_is_where_the_environment_stands_once_the_action_was_played():
    env: Any = gymnasium.make("rl2grid/bus36-MO-v0-T0-v0", split="bundled", opponent=False, disable_env_checker=True)
    env = env.unwrapped
    env.reset(seed=1)
    search = search_of(env)
    rng = np.random.default_rng(0)
    for _ in range(8):
        before, action = snapshot_of(env.engine, 0), int(rng.choice(np.flatnonzero(env.action_masks())))
        expected = search.after(before, action).topo_vect
        *_, over, _, _ = env.step(action)
        if over:
            break
        tripped = ~env.state.line_status[0] & (expected[env.grid.line_or_pos_topo_vect] > 0)
        kept = ~np.isin(env.grid.element_to_subid, env.grid.line_or_to_subid[tripped])
        kept &= ~np.isin(env.grid.element_to_subid, env.grid.line_ex_to_subid[tripped])
        np.testing.assert_array_equal(expected[kept], env.state.topo_vect[0][kept])


def test_a_line_that_is_about_to_trip_leaves_no_time_for_sequences():
    env = overloaded()
    search, point = search_of(env), forecast_of(env.engine, 0)
    assert point is not None
    allowed = env.grid.rules.overflow_allowed
    heavy = point._replace(load_p=(point.load_p * 1.5).astype(np.float32), gen_p=(point.gen_p * 1.5).astype(np.float32))
    overflow = np.full(env.grid.n_line, allowed, np.int32)
    late = search.best(heavy, overflow, NONE)
    assert late.n_trips > 0 or not np.isfinite(late.worst_loading)
    early = search.best(heavy, none(env), NONE)
    assert early.n_trips <= late.n_trips


def test_of_those_that_make_the_grid_safe_the_least_endangered_is_chosen():
    env = overloaded("bus36-MO-v0-T0", seed=2)
    search, point = search_of(env, longest=0), forecast_of(env.engine, 0)
    assert point is not None
    outcomes, _ = search.outcomes(point)
    safe = np.flatnonzero(outcomes.legal & (outcomes.worst_loading < 0.95))
    if len(safe) < 2:
        pytest.skip("nothing to choose between")
    lines = np.array(sorted(env.grid.opponent.areas[0]), np.int32)
    contingencies = Contingencies(lines, np.ones(len(lines)))
    found = search.best(point, none(env), contingencies)
    what_if = WhatIf(env.grid)
    chosen = danger(what_if, search.after(point, found.action), contingencies)
    first = danger(what_if, search.after(point, int(safe[outcomes.worst_loading[safe].argmin()])), contingencies)
    assert chosen <= first + 1e-6


def test_large_catalogues_are_searched_in_full_first_and_in_part_later():
    env = overloaded("bus36-M-T2")
    search, point = search_of(env), forecast_of(env.engine, 0)
    assert point is not None
    found = search.best(point, none(env), NONE)
    assert 0 <= found.action < len(env.action_catalogue_ids)


def test_a_time_limit_ends_the_search_after_what_it_has():
    env = overloaded()
    point = forecast_of(env.engine, 0)
    assert point is not None
    heavy = point._replace(load_p=(point.load_p * 1.5).astype(np.float32), gen_p=(point.gen_p * 1.5).astype(np.float32))
    found = search_of(env, seconds=1e-9).best(heavy, none(env), NONE)
    assert found.n_actions == 1


def test_what_was_moved_cools_down():
    env = overloaded("bus36-MO-v0-T0")
    search, point = search_of(env), forecast_of(env.engine, 0)
    assert point is not None
    catalogue = full_catalogue(env.grid).take(env.action_catalogue_ids)
    move = int(np.flatnonzero(catalogue.kind == ActionKind.MOVE)[0])
    cooled = search._cooled(point, move)
    assert cooled.cooldown_sub[catalogue.target[move]] == env.grid.rules.cooldown_sub
    assert search._cooled(cooled, NOTHING).cooldown_sub[catalogue.target[move]] == env.grid.rules.cooldown_sub - 1


def made_heavier(point: Any, factor: float) -> Later:
    """A moment to come with more demand and production."""
    nothing = np.zeros(0, np.int32)
    more = [(values * factor).astype(np.float32) for values in (point.gen_p, point.load_p, point.load_q)]
    return Later(more[0], more[1], more[2], nothing, nothing, steps=3)


def test_what_prepares_for_a_moment_to_come_keeps_the_grid_safe_until_then():
    """One action is the best that trying all of them finds; several are worth it where one is not enough."""
    env: Any = gymnasium.make("rl2grid/bus36-M-T1-v0", split="bundled", opponent=False, disable_env_checker=True)
    env = env.unwrapped
    env.reset(seed=0, options={"start": 150})
    search, point = search_of(env), forecast_of(env.engine, 0)
    assert point is not None
    lengths = set()
    for factor in (1.0, 1.2, 1.4, 1.5, 1.6):
        later = made_heavier(point, factor)
        found = search.prepared(point, later)
        now, _ = search.outcomes(point)
        then, _ = search.outcomes(later.of(point, env.grid))
        keeps_safe = now.legal & (now.worst_loading < 0.95)
        least = float(np.where(keeps_safe, then.worst_loading, np.inf).min())
        lengths.add(found.n_actions)
        assert found.worst_loading <= search.worst_later(point, later)
        assert keeps_safe[found.action]
        if found.n_actions == 1:
            assert np.isclose(found.worst_loading, least, atol=1e-5)
        elif found.n_actions > 1:
            assert found.worst_loading < least - 0.01
        elif found.worst_loading >= 0.95:
            assert least > found.worst_loading - 0.02 - 1e-5
    assert lengths == {0, 1, 3}


def test_of_those_that_make_the_grid_safe_the_one_that_stays_so_is_chosen():
    env = overloaded("bus14-T0", seed=1)
    search, point = search_of(env, longest=0), forecast_of(env.engine, 0)
    assert point is not None
    later = made_heavier(point, 1.1)
    alone, looking = search.best(point, none(env), NONE), search.best(point, none(env), NONE, later)
    assert alone.worst_loading < 0.95
    assert looking.worst_loading < 0.95
    then = [search.worst_later(search.after(point, found.action), later) for found in (alone, looking)]
    assert then[1] <= then[0]
