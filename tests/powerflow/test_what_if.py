"""The DC what-if against a plain DC solution of every topology, the AC check against Grid2Op."""

import time

import numpy as np
import pytest

from rl2grid.engines.reference.extract import make_environment
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import ActionKind, full_catalogue, moved_elements
from rl2grid.powerflow.lightsim import AcCheck, read_snapshot
from rl2grid.powerflow.network import read_branches, stack, unstack
from rl2grid.powerflow.what_if import WhatIf

GRIDS = ["bus14", "bus36-MO-v0", "bus118-MOB-v1"]


class Case:
    """A live environment and snapshots of it: nominal, then with random splits and open lines."""

    def __init__(self, grid_id):
        self.grid = load_grid(grid_id)
        self.environment = make_environment(self.grid.bundled_names[0])
        parameters = self.environment.parameters
        parameters.NO_OVERFLOW_DISCONNECTION = True  # no cascade, here and in simulate
        self.environment.change_parameters(parameters)
        self.environment.change_forecast_parameters(parameters)
        self.environment.seed(0)
        self.branches = read_branches(self.grid, self.environment.backend._grid)
        self.what_if = WhatIf(self.grid, self.branches)
        self.snapshots = self._play(4)

    def _play(self, n):
        rng = np.random.default_rng(1)
        environment = self.environment
        observation = environment.reset()
        snapshots = [read_snapshot(environment)]
        while len(snapshots) < n:
            for _ in range(4):
                actions = (self._random_move(rng), {"change_line_status": [int(rng.integers(self.grid.n_line))]})
                for action in map(environment.action_space, actions):
                    if not observation.simulate(action)[2]:
                        observation, _, done, _ = environment.step(action)
                        if done:
                            observation = environment.reset()
            snapshots.append(read_snapshot(environment))
        self.observation = observation
        return snapshots

    def _random_move(self, rng):
        sub = int(rng.choice(np.flatnonzero(self.grid.sub_info >= 4)))
        first, n = int(self.grid.sub_first_element[sub]), int(self.grid.sub_info[sub])
        change = np.zeros(self.grid.dim_topo, bool)
        change[first : first + n] = rng.random(n) < 0.5
        return {"change_bus": change}


@pytest.fixture(scope="module", params=GRIDS)
def case(request):
    made = Case(request.param)
    yield made
    made.environment.close()


def topology_after(grid, snapshot, action):
    topology = snapshot.topo_vect.copy()
    if action.kind == ActionKind.MOVE:
        for element in moved_elements(grid, action.target, action.mask):
            if topology[element] > 0:
                topology[element] = 3 - topology[element]
    if action.kind == ActionKind.SWITCH:
        for positions in (grid.line_or_pos_topo_vect, grid.line_ex_pos_topo_vect):
            end = positions[action.target]
            topology[end] = -1 if topology[end] > 0 else snapshot.last_bus[end]
    return topology


def plain_flows(grid, branches, snapshot, topology):
    """DC flows [line] of a topology, solved from scratch; None when the grid falls apart."""
    node = grid.element_to_subid + grid.n_sub * (topology - 1)
    injection = np.zeros(2 * grid.n_sub)
    np.add.at(injection, node[grid.gen_pos_topo_vect], snapshot.gen_p)
    np.add.at(injection, node[grid.load_pos_topo_vect], -snapshot.load_p)
    attached = topology[grid.storage_pos_topo_vect] > 0
    np.add.at(injection, node[grid.storage_pos_topo_vect][attached], -snapshot.storage_p[attached])
    slack = node[grid.gen_pos_topo_vect[grid.slack_gen]]
    injection[slack] -= injection.sum()
    closed = np.flatnonzero(topology[grid.line_or_pos_topo_vect] > 0)
    origin, extremity = node[grid.line_or_pos_topo_vect], node[grid.line_ex_pos_topo_vect]
    matrix = np.zeros((2 * grid.n_sub, 2 * grid.n_sub))
    reached, waiting = {slack}, [slack]
    neighbours = {}
    for line in closed:
        a, b, strength = origin[line], extremity[line], branches.susceptance[line]
        matrix[[a, b], [a, b]] += strength
        matrix[[a, b], [b, a]] -= strength
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    while waiting:
        for other in neighbours.get(waiting.pop(), []):
            if other not in reached:
                reached.add(other)
                waiting.append(other)
    if not set(node[topology > 0].tolist()) <= reached:
        return None
    others = sorted(reached - {slack})
    theta = np.zeros(2 * grid.n_sub)
    theta[others] = np.linalg.solve(matrix[np.ix_(others, others)], injection[others])
    flows = np.zeros(grid.n_line)
    flows[closed] = branches.susceptance[closed] * (theta[origin[closed]] - theta[extremity[closed]])
    return flows


def plain_worst_loading(grid, branches, snapshot, base, topology):
    flows = plain_flows(grid, branches, snapshot, topology)
    if flows is None:
        return np.inf
    closed = topology[grid.line_or_pos_topo_vect] > 0
    was_closed = snapshot.v_or > 0
    p = np.where(was_closed, snapshot.p_or, 0) + flows - base
    voltage = np.where(was_closed, snapshot.v_or, branches.nominal_voltage)
    loading = (
        np.hypot(p, np.where(was_closed, snapshot.q_or, 0)) * 1000 / (np.sqrt(3) * voltage * snapshot.thermal_limit)
    )
    return loading[closed].max()


def test_snapshots_cover_splits_and_open_lines(case):
    assert any((snapshot.topo_vect == 2).any() for snapshot in case.snapshots)
    assert any((snapshot.v_or <= 0).any() for snapshot in case.snapshots)


def test_loading_is_grid2ops_rho(case):
    np.testing.assert_allclose(case.snapshots[-1].loading(), case.observation.rho, atol=1e-5)


def test_what_if_equals_a_plain_solution_of_each_topology(case):
    catalogue = full_catalogue(case.grid)
    assert case.what_if.n_actions == len(catalogue)
    rng = np.random.default_rng(2)
    for snapshot in case.snapshots:
        ours = case.what_if.worst_loadings(snapshot)
        base = plain_flows(case.grid, case.branches, snapshot, snapshot.topo_vect)
        split = np.unique(case.grid.element_to_subid[snapshot.topo_vect == 2])
        at_split = np.flatnonzero(np.isin(catalogue.target, split) & (catalogue.kind == ActionKind.MOVE))
        switches = np.flatnonzero(catalogue.kind == ActionKind.SWITCH)
        tried = np.concatenate(
            (
                [0],
                rng.choice(len(catalogue), 15),
                rng.choice(at_split, 10) if len(at_split) else [],
                rng.choice(switches, 8),
                switches[snapshot.v_or <= 0],
            )
        ).astype(int)
        for action in tried:
            topology = topology_after(case.grid, snapshot, catalogue[int(action)])
            expected = plain_worst_loading(case.grid, case.branches, snapshot, base, topology)
            assert ours[action] == pytest.approx(expected, rel=1e-4, abs=1e-5), catalogue[int(action)]


def test_what_if_collapses_where_grid2op_does(case):
    """Every action that the DC what-if condemns ends a simulated step of Grid2Op."""
    catalogue = full_catalogue(case.grid)
    snapshot = case.snapshots[-1]
    condemned = np.flatnonzero(np.isinf(case.what_if.worst_loadings(snapshot)))
    assert len(condemned)
    check = AcCheck(case.grid, case.environment.backend)
    check.load(snapshot)
    for action in np.random.default_rng(3).choice(condemned, 20):
        assert check.worst_loading(topology_after(case.grid, snapshot, catalogue[int(action)])) == np.inf


def test_ac_check_is_grid2ops_power_flow(case):
    catalogue, observation = full_catalogue(case.grid), case.observation
    snapshot = case.snapshots[-1]
    check = AcCheck(case.grid, case.environment.backend)
    check.load(snapshot)
    assert check.worst_loading(snapshot.topo_vect) == pytest.approx(observation.rho.max(), abs=1e-5)
    moves = np.flatnonzero(catalogue.kind == ActionKind.MOVE)
    moves = moves[snapshot.cooldown_sub[catalogue.target[moves]] == 0]
    ends = 0
    for action in np.random.default_rng(4).choice(moves, 25):
        move = catalogue[int(action)]
        change = np.zeros(case.grid.dim_topo, bool)
        change[moved_elements(case.grid, move.target, move.mask)] = True
        played = case.environment.action_space({"change_bus": change})
        simulated, _, done, _ = observation.simulate(played, time_step=0)
        ours = check.worst_loading(topology_after(case.grid, snapshot, move))
        assert ours == (np.inf if done else pytest.approx(simulated.rho.max(), abs=2e-4))
        ends += done
    assert ends < 20


def test_dc_ranks_actions_like_ac(case):
    """Not exact, but good enough to choose what to try in AC."""
    catalogue, snapshot = full_catalogue(case.grid), case.snapshots[0]
    check = AcCheck(case.grid, case.environment.backend)
    check.load(snapshot)
    loadings = case.what_if.worst_loadings(snapshot)
    tried = np.argsort(loadings)[:150]
    exact = [check.worst_loading(topology_after(case.grid, snapshot, catalogue[int(k)])) for k in tried]
    assert min(exact[:20]) <= min(exact) + 0.02
    assert min(exact) <= loadings[0] + 1e-5


def test_a_what_if_of_the_largest_grid_takes_microseconds_per_action(case):
    case.what_if.worst_loadings(case.snapshots[0])
    begin = time.perf_counter()
    case.what_if.worst_loadings(case.snapshots[-1])
    assert (time.perf_counter() - begin) / case.what_if.n_actions < 10e-6


def test_stacking_keeps_snapshots(case):
    for before, after in zip(case.snapshots, unstack(stack(case.snapshots)), strict=True):
        for name in vars(before):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
