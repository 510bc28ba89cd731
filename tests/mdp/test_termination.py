"""Reasons of a game over: by hand, against a graph library, and against live Grid2Op."""

import warnings

import numpy as np
import pytest
from random_states import random_topology
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rl2grid.grids import load_grid
from rl2grid.mdp.state import new_state
from rl2grid.mdp.termination import GAME_OVER_TEXT, GameOver, game_over_reason


def reason(state, i=0):
    return GameOver(game_over_reason(state, i))


def lines_at(grid, sub):
    """Lines with an end at the substation."""
    return np.flatnonzero((grid.line_or_to_subid == sub) | (grid.line_ex_to_subid == sub))


def open_lines(grid, state, lines):
    state.final_topo_vect[0, grid.line_or_pos_topo_vect[lines]] = -1
    state.final_topo_vect[0, grid.line_ex_pos_topo_vect[lines]] = -1


def move(state, elements, busbar=2):
    state.final_topo_vect[0, elements] = busbar


@pytest.fixture
def small(calm):
    grid = load_grid("bus14")
    return grid, calm(grid)


@pytest.fixture
def stored(calm):
    grid = load_grid("bus118-MOB-v0")
    return grid, calm(grid)


def test_a_grid_in_one_piece_diverged(small):
    assert reason(small[1]) == GameOver.DIVERGENCE


def test_a_split_substation_in_one_piece_diverged(small):
    grid, state = small
    first, second = lines_at(grid, 3)[:2]
    for line in (first, second):
        ends = grid.line_or_pos_topo_vect[line], grid.line_ex_pos_topo_vect[line]
        at_sub = grid.line_or_to_subid[line] == 3
        move(state, ends[0] if at_sub else ends[1])
    assert reason(state) == GameOver.DIVERGENCE


@pytest.mark.parametrize("busbar", [-1, 2])
def test_a_load_that_is_off_or_alone_on_its_busbar(small, busbar):
    grid, state = small
    move(state, grid.load_pos_topo_vect[4], busbar)
    assert reason(state) == GameOver.LOAD_DISCONNECTED


@pytest.mark.parametrize("busbar", [-1, 2])
def test_a_generator_that_is_off_or_alone_on_its_busbar(small, busbar):
    grid, state = small
    move(state, grid.gen_pos_topo_vect[1], busbar)
    assert reason(state) == GameOver.GENERATOR_DISCONNECTED


def test_the_slack_generator_off(small):
    grid, state = small
    move(state, grid.gen_pos_topo_vect[grid.slack_gen], -1)
    assert reason(state) == GameOver.GENERATOR_DISCONNECTED


def test_a_load_fed_by_a_generator_of_its_busbar_alone_is_cut_off(small):
    grid, state = small
    sub = np.intersect1d(grid.gen_to_subid, grid.load_to_subid)[0]
    gen, load = (np.flatnonzero(subs == sub)[0] for subs in (grid.gen_to_subid, grid.load_to_subid))
    move(state, [grid.gen_pos_topo_vect[gen], grid.load_pos_topo_vect[load]])
    assert reason(state) == GameOver.LOAD_DISCONNECTED


def test_a_busbar_whose_only_line_is_open_is_not_fed(small):
    grid, state = small
    line = lines_at(grid, grid.load_to_subid[0])[0]
    position = (
        grid.line_or_pos_topo_vect[line]
        if grid.line_or_to_subid[line] == grid.load_to_subid[0]
        else grid.line_ex_pos_topo_vect[line]
    )
    move(state, [position, grid.load_pos_topo_vect[0]])
    assert reason(state) == GameOver.DIVERGENCE
    open_lines(grid, state, [line])
    assert reason(state) == GameOver.LOAD_DISCONNECTED


@pytest.mark.parametrize("busbar", [-1, 2])
def test_a_storage_in_use_that_is_off_or_alone(stored, busbar):
    grid, state = stored
    move(state, grid.storage_pos_topo_vect[2], busbar)
    state.storage_power[0, 2] = -0.5
    assert reason(state) == GameOver.STORAGE_DISCONNECTED


def test_an_idle_storage_may_be_off(stored):
    grid, state = stored
    move(state, grid.storage_pos_topo_vect[2], -1)
    state.storage_power[0, 1] = 3.0
    assert reason(state) == GameOver.DIVERGENCE


def test_an_idle_storage_alone_on_a_busbar_is_an_island(stored):
    grid, state = stored
    move(state, grid.storage_pos_topo_vect[2])
    assert reason(state) == GameOver.ISLAND


def test_two_substations_cut_off_together_are_an_island(small):
    grid, state = small
    here, there = 11, 12  # connected with each other, each with a load
    assert np.intersect1d(lines_at(grid, here), lines_at(grid, there)).size
    outside = np.setxor1d(lines_at(grid, here), lines_at(grid, there))
    open_lines(grid, state, outside)
    assert reason(state) == GameOver.ISLAND


def test_a_line_between_two_lonely_busbars_is_an_island(small):
    grid, state = small
    move(state, [grid.line_or_pos_topo_vect[0], grid.line_ex_pos_topo_vect[0]])
    assert reason(state) == GameOver.ISLAND


def test_the_first_reason_in_order_counts(stored):
    grid, state = stored
    move(state, [grid.line_or_pos_topo_vect[0], grid.line_ex_pos_topo_vect[0]])
    assert reason(state) == GameOver.ISLAND
    state.storage_power[0] = 1.0
    move(state, grid.storage_pos_topo_vect[0], -1)
    assert reason(state) == GameOver.STORAGE_DISCONNECTED
    move(state, grid.gen_pos_topo_vect[0], -1)
    assert reason(state) == GameOver.GENERATOR_DISCONNECTED
    move(state, grid.load_pos_topo_vect[0], -1)
    assert reason(state) == GameOver.LOAD_DISCONNECTED


def test_every_reason_has_a_text_of_one_line():
    assert set(GAME_OVER_TEXT) == set(GameOver)
    assert len(set(GAME_OVER_TEXT.values())) == len(GameOver)
    assert all(text and "\n" not in text for text in GAME_OVER_TEXT.values())


def test_the_order_of_the_reasons_is_fixed():
    assert [(member.name, member.value) for member in GameOver] == [
        ("NONE", 0),
        ("LOAD_DISCONNECTED", 1),
        ("GENERATOR_DISCONNECTED", 2),
        ("STORAGE_DISCONNECTED", 3),
        ("ISLAND", 4),
        ("DIVERGENCE", 5),
        ("DISPATCH", 6),
    ]


def expected_reason(grid, topology, storage_power):
    """The definition, with busbars as nodes of a graph."""
    busbar = np.where(topology > 0, grid.element_to_subid + (topology - 1) * grid.n_sub, -1)
    origin, extremity = busbar[grid.line_or_pos_topo_vect], busbar[grid.line_ex_pos_topo_vect]
    closed = (origin >= 0) & (extremity >= 0)
    origin, extremity = origin[closed], extremity[closed]
    fed = np.union1d(origin, extremity)
    for positions, cut_off in (
        (grid.load_pos_topo_vect, GameOver.LOAD_DISCONNECTED),
        (grid.gen_pos_topo_vect, GameOver.GENERATOR_DISCONNECTED),
        (grid.storage_pos_topo_vect[storage_power != 0], GameOver.STORAGE_DISCONNECTED),
    ):
        if not np.isin(busbar[positions], fed).all():
            return cut_off
    edges = coo_array((np.ones(len(origin)), (origin, extremity)), shape=(2 * grid.n_sub,) * 2)
    label = connected_components(edges, directed=False)[1]
    pieces = set(label[busbar[busbar >= 0]])
    return GameOver.ISLAND if len(pieces) > 1 else GameOver.DIVERGENCE


def test_reasons_are_those_of_the_graph(grid):
    rng = np.random.default_rng(3)
    n = 400
    state = new_state(grid, n)
    found = []
    for i in range(n):
        topology = random_topology(grid, rng, rng.choice([0.0, 0.05, 0.3]), rng.choice([0.0, 1.0, 5.0]) / grid.dim_topo)
        off = rng.random(grid.dim_topo) < rng.choice([0.0, 0.5]) / grid.dim_topo
        topology[off & ~np.isin(np.arange(grid.dim_topo), grid.line_or_pos_topo_vect)] = -1
        if grid.n_storage and rng.random() < 0.3:
            topology[rng.choice(grid.storage_pos_topo_vect)] = rng.choice([-1, 2])
        state.final_topo_vect[i] = topology
        state.storage_power[i] = rng.choice([0.0, 1.0, -2.0], grid.n_storage)
        found.append(expected_reason(grid, topology, state.storage_power[i]))
        assert reason(state, i) == found[-1]
    required = set(GameOver) - {GameOver.NONE, GameOver.DISPATCH}
    if not grid.n_storage:
        required.remove(GameOver.STORAGE_DISCONNECTED)
    assert set(found) >= required


@pytest.fixture(scope="module")
def live():
    import grid2op
    from grid2op.Action import CompleteAction
    from grid2op.Parameters import Parameters
    from lightsim2grid import LightSimBackend

    parameters = Parameters()
    parameters.MAX_SUB_CHANGED = parameters.MAX_LINE_STATUS_CHANGED = 999
    parameters.NO_OVERFLOW_DISCONNECTION = True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = grid2op.make(
            "l2rpn_case14_sandbox",
            test=True,
            backend=LightSimBackend(),
            action_class=CompleteAction,
            param=parameters,
        )
    yield env
    env.close()


def test_grid2op_loses_a_grid_that_is_not_in_one_piece_and_keeps_others(live):
    grid = load_grid("bus14")
    rng = np.random.default_rng(8)
    state = new_state(grid, 1)
    lost, kept = [], []
    live.reset(seed=0, options={"time serie id": 0})
    for _ in range(150):
        topology = random_topology(grid, rng, 0.03, 0.04)
        state.final_topo_vect[0] = topology
        _, _, done, _ = live.step(live.action_space({"set_bus": topology}))
        (lost if done else kept).append(reason(state))
        if done:
            live.reset(seed=0, options={"time serie id": 0})
    assert set(kept) == {GameOver.DIVERGENCE}  # nothing is cut off: the flow that Grid2Op found is the only question
    assert min(len(lost), len(kept)) > 30
    assert lost.count(GameOver.DIVERGENCE) <= 0.05 * len(lost)  # connected grids without a flow exist, but are rare
