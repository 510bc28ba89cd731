"""The registry of systems."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from own_grid import own_system

from rl2grid.benchmark import BENCHMARK
from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, Network, System, find_system, load_grid, system_ids
from rl2grid.grids.rankings import ranking, trials
from rl2grid.grids.systems import add_system, remove_system


@pytest.fixture
def mine():
    system = own_system()
    add_system(system)
    yield system
    remove_system("mine")


def test_the_seven_are_registered_like_any_other():
    assert tuple(system.id for system in BENCHMARK) == GRID_IDS == system_ids()
    for system in BENCHMARK:
        assert find_system(system.id) is system
        assert load_grid(system.id) is system.grid


def test_a_system_of_ones_own_is_found_beside_them(mine):
    assert system_ids() == (*GRID_IDS, "mine")
    assert load_grid("mine") is mine.grid
    with pytest.raises(UsageError, match=r"Grid 'other' does not exist: choose one of bus14, .*, mine\.$"):
        load_grid("other")


def test_a_system_of_the_same_grid_takes_the_place_and_another_grid_is_refused(mine):
    other = own_system()
    add_system(other)
    assert find_system("mine") is other
    weaker = replace(mine.grid, thermal_limit=mine.grid.thermal_limit / 2)
    with pytest.raises(UsageError, match="Another grid is registered as 'mine': give this one an id of its own"):
        add_system(replace(mine, grid=weaker))
    with pytest.raises(UsageError, match="Another grid is registered as 'bus14'"):
        add_system(own_system("bus14"))


@pytest.mark.parametrize("name", ["", "a/b", "a b", "-a", "a:b"])
def test_names_that_cannot_be_part_of_an_id_are_refused(name):
    with pytest.raises(UsageError, match="cannot name tasks"):
        add_system(own_system(name))
    assert system_ids() == GRID_IDS


def test_the_hash_names_every_value():
    grid = own_system().grid
    assert len(grid.hash) == 16
    assert replace(grid).hash == grid.hash
    others = [
        replace(grid, id="other"),
        replace(grid, thermal_limit=grid.thermal_limit + np.float32(1)),
        replace(grid, rules=replace(grid.rules, cooldown_sub=9)),
        replace(grid, opponent=replace(grid.opponent, cooldown=9)),
    ]
    assert len({grid.hash, *(other.hash for other in others)}) == 5


def test_parts_given_as_functions_are_made_once_and_only_when_needed():
    made = []

    def make(name, value):
        made.append(name)
        return value

    shipped = find_system("bus14")
    system = System(
        shipped.grid,
        lambda: make("network", shipped.network),
        lambda: make("scenarios", shipped.scenarios),
        ranking=lambda: make("ranking", None),
    )
    assert made == []
    assert system.network is system.network is shipped.network
    assert system.ranking is system.ranking is None
    assert made == ["network", "ranking"]


def test_parts_that_may_be_left_out_are_none():
    shipped = find_system("bus14")
    system = System(shipped.grid, shipped.network, shipped.scenarios)
    assert (system.ranking, system.environment, system.constants) == (None, None, None)
    with pytest.raises(TypeError, match="network"):
        System(shipped.grid)
    with pytest.raises(AttributeError):
        system.grid = shipped.grid


@pytest.mark.parametrize("grid_id", [*GRID_IDS, "mine"])
def test_a_system_travels_as_a_value(grid_id, mine):
    system = find_system(grid_id)
    copy = pickle.loads(pickle.dumps(system))
    assert (copy.id, copy.hash) == (system.id, system.hash)
    assert isinstance(copy.network, Network)
    for ours, theirs in zip(copy.network, system.network, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert copy.scenarios.listed(copy.grid, "bundled") == system.scenarios.listed(system.grid, "bundled")
    assert (copy.ranking is None) == (system.ranking is None)


def test_without_a_ranking_there_is_one_level(mine):
    assert mine.grid.level_sizes == (209,)
    for look_up in (ranking, trials):
        with pytest.raises(UsageError, match="The ranking of mine is missing: make it with `rl2grid rank mine`"):
            look_up("mine")


def test_a_ranking_gives_levels_below_the_highest():
    system, ranked = own_system(), find_system("bus14").ranking
    levelled = system.ranked(ranked, 20, 50)
    assert levelled.grid.level_sizes == (20, 50, 209)
    assert levelled.ranking is ranked
    assert (levelled.network, levelled.scenarios) == (system.network, system.scenarios)
    assert levelled.hash != system.hash


@pytest.mark.parametrize("sizes", [(50, 20), (20, 20), (1,), (209,), (0, 5)])
def test_levels_that_do_not_increase_are_refused(sizes):
    with pytest.raises(UsageError, match="give increasing sizes from 2 to 208"):
        own_system().ranked(find_system("bus14").ranking, *sizes)


def test_a_level_larger_than_the_ranking_is_refused():
    ranked = replace(find_system("bus14").ranking, ids=np.arange(1, 11, dtype=np.int32))
    assert own_system().ranked(ranked, 11).grid.level_sizes == (11, 209)
    with pytest.raises(UsageError, match="A level of 12 actions of mine is not allowed: its ranking has 10"):
        own_system().ranked(ranked, 12)
