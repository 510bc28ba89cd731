"""The AC power flow equals LightSim2Grid's, keeps its promises alone, and survives bad input."""

from __future__ import annotations

import functools
import sys
from typing import Any, NamedTuple

import numpy as np
import pytest
from grid2op_copies import copied_environment
from hypothesis import given, settings
from hypothesis import strategies as st

from rl2grid.grids import GRID_IDS, Grid, load_grid
from rl2grid.powerflow.ac import (
    CONVERGED,
    DISCONNECTED,
    DIVERGED,
    FlowState,
    forget_flow,
    new_flow_state,
    run_flow,
    write_currents,
    write_flow,
)
from rl2grid.powerflow.model import Network, load_network
from rl2grid.scenarios.library import list_scenarios, load_scenario
from rl2grid.structures import copy_row

CURRENT_TOLERANCE = 1e-4  # A; beside it float32 is allowed two units in the last place
POWER_TOLERANCE = 1e-4  # MW
ANGLE_TOLERANCE = 1e-5  # degrees
FLOAT32 = 2 * float(np.finfo(np.float32).eps)


class Injections(NamedTuple):
    """Arguments of ``run_flow`` after the topology."""

    gen_p: Any
    gen_v: Any
    load_p: Any
    load_q: Any
    storage_p: Any


class Results(NamedTuple):
    """What a flow shows, by Grid2Op's names."""

    a_or: Any
    p_or: Any
    gen_p: Any
    gen_theta: Any
    load_theta: Any
    storage_theta: Any


class Reference:
    """LightSim2Grid as ``LightSimBackend.runpf`` uses it."""

    def __init__(self, grid_id: str) -> None:
        self.grid = load_grid(grid_id)
        backend = copied_environment(self.grid.bundled_names[0]).backend
        self._model = backend._grid.copy()
        self._recipe = (backend.max_it, backend.tol)

    def run(self, topo_vect: Any, injections: Injections) -> Results | None:
        """The results, or None where Grid2Op would end the game."""
        storage_bus = topo_vect[self.grid.storage_pos_topo_vect]
        if np.any(injections.storage_p[storage_bus < 1] != 0):
            return None  # checked by LightSimBackend, not by the model
        try:
            return self._run(topo_vect, injections, storage_bus > 0)
        except RuntimeError:
            self._model.reactivate_result_computation()
            self._model.tell_solver_need_reset()
            return None

    def _run(self, topo_vect: Any, injections: Injections, storage_connected: Any) -> Results | None:
        model, grid = self._model, self.grid
        model.update_topo(np.ones(grid.dim_topo, bool), topo_vect)
        every_gen, every_load = np.ones(grid.n_gen, bool), np.ones(grid.n_load, bool)
        model.update_gens_p(every_gen, injections.gen_p)
        for gen in range(grid.n_gen):
            model.change_v_gen(gen, float(injections.gen_v[gen]))
        model.update_loads_p(every_load, injections.load_p)
        model.update_loads_q(every_load, injections.load_q)
        if grid.n_storage:
            model.update_storages_p(storage_connected, injections.storage_p)
        model.deactivate_result_computation()
        voltage = model.dc_pf(np.ones(2 * grid.n_sub, np.complex128), *self._recipe)
        model.reactivate_result_computation()
        if len(voltage):
            voltage = model.ac_pf(voltage, *self._recipe)
        if not len(voltage):
            model.tell_solver_need_reset()
            return None
        both = zip(model.get_line_res1_full(), model.get_trafo_res1_full(), strict=True)
        lines = [np.concatenate(pair) for pair in both]
        single = np.float32
        gens, loads = model.get_gen_res_full(), model.get_loads_res_full()
        return Results(
            a_or=lines[3].astype(single) * single(1000),
            p_or=lines[0].astype(single),
            gen_p=gens[0].astype(single),
            gen_theta=gens[3].astype(single),
            load_theta=loads[3].astype(single),
            storage_theta=model.get_storages_res_full()[3].astype(single),
        )


@functools.cache
def reference(grid_id: str) -> Reference:
    return Reference(grid_id)


class Rows:
    """Our flow, called from Python."""

    def __init__(self, grid_id: str, n: int = 1) -> None:
        self.grid = load_grid(grid_id)
        self.network: Network = load_network(self.grid)
        self.flow: FlowState = new_flow_state(self.network, n)
        self.status = CONVERGED

    def run(self, topo_vect: Any, injections: Injections, i: int = 0) -> Results | None:
        self.status = run_flow(self.network, self.flow, i, topo_vect, *injections)
        if self.status != CONVERGED:
            return None
        grid = self.grid
        sizes = (grid.n_line, grid.n_line, grid.n_gen, grid.n_gen, grid.n_load, grid.n_storage)
        results = Results(*(np.full(size, np.nan, np.float32) for size in sizes))
        write_currents(self.network, self.flow, i, results.a_or)
        write_flow(self.network, self.flow, i, *results[1:])
        return results

    def voltage(self, i: int = 0) -> Any:
        """Complex voltage of each bus, per unit; 0 where nothing is connected."""
        node = self.flow.node_of_bus[i]
        used = node != 0xFFFF
        voltage = np.zeros(len(node), np.complex128)
        voltage[used] = self.flow.voltage[i].view(np.complex128)[node[used], 0]
        return voltage


@functools.cache
def series(grid_id: str) -> tuple[Injections, ...]:
    """Injections of the rows of the first bundled series."""
    grid = load_grid(grid_id)
    network = load_network(grid)
    scenario = load_scenario(grid_id, list_scenarios(grid_id, "bundled")[0])
    rows = []
    for row in range(min(scenario.n_rows, 250)):
        gen_v = network.gen_setpoint if scenario.prod_v is None else scenario.prod_v[row] / network.gen_kilovolt
        storage_p = np.zeros(grid.n_storage, np.float32)
        arrays = (scenario.prod_p[row], gen_v, scenario.load_p[row], scenario.load_q[row], storage_p)
        rows.append(Injections(*(np.array(array, array.dtype) for array in arrays)))
    return tuple(rows)


def scaled(injections: Injections, scale: Any, storage_p: Any = None) -> Injections:
    """Loads and generators times ``scale``."""
    values = {name: (getattr(injections, name) * scale).astype(np.float32) for name in ("gen_p", "load_p", "load_q")}
    if storage_p is not None:
        values["storage_p"] = storage_p.astype(np.float32)
    return injections._replace(**values)


def all_on_first(grid: Grid) -> Any:
    return np.ones(grid.dim_topo, np.int32)


def random_topology(grid: Grid, draw: np.random.Generator, n_split: int, n_open: int) -> Any:
    """Some substations divided at random and some lines open."""
    topo_vect = all_on_first(grid)
    for sub in draw.choice(grid.n_sub, n_split, replace=False):
        here = np.flatnonzero(grid.element_to_subid == sub)
        topo_vect[here] = draw.integers(1, 3, len(here))
    for line in draw.choice(grid.n_line, n_open, replace=False):
        open_line(grid, topo_vect, line)
    return topo_vect


def open_line(grid: Grid, topo_vect: Any, line: int) -> None:
    topo_vect[[grid.line_or_pos_topo_vect[line], grid.line_ex_pos_topo_vect[line]]] = -1


def assert_same(ours: Results | None, theirs: Results | None, what: str) -> None:
    assert (ours is None) == (theirs is None), f"{what}: ours {ours is not None}, theirs {theirs is not None}"
    if ours is None or theirs is None:
        return
    tolerances = (
        CURRENT_TOLERANCE,
        POWER_TOLERANCE,
        POWER_TOLERANCE,
        ANGLE_TOLERANCE,
        ANGLE_TOLERANCE,
        ANGLE_TOLERANCE,
    )
    for name, mine, other, tolerance in zip(Results._fields, ours, theirs, tolerances, strict=True):
        np.testing.assert_allclose(mine, other, rtol=FLOAT32, atol=tolerance, err_msg=f"{what}: {name}")


def assert_identical(ours: Results | None, theirs: Results | None) -> None:
    """Converged both, and the same bits."""
    assert ours is not None
    assert theirs is not None
    for name, mine, other in zip(Results._fields, ours, theirs, strict=True):
        np.testing.assert_array_equal(mine, other, err_msg=name)


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_consecutive_rows_equal_lightsim2grid(grid_id: str) -> None:
    rows, theirs = Rows(grid_id), reference(grid_id)
    topo_vect = all_on_first(rows.grid)
    for number, injections in enumerate(series(grid_id)[:100]):
        ours = rows.run(topo_vect, injections)
        assert_same(ours, theirs.run(topo_vect, injections), f"{grid_id} row {number}")
        assert ours is not None


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_random_topologies_equal_lightsim2grid(grid_id: str) -> None:
    rows, theirs, grid = Rows(grid_id), reference(grid_id), load_grid(grid_id)
    draw = np.random.default_rng(5)
    seen = set()
    for number in range(120):
        topo_vect = random_topology(grid, draw, int(draw.integers(0, 4)), int(draw.integers(0, 4)))
        injections = scaled(series(grid_id)[number], draw.uniform(0.5, 1.5), draw.uniform(-9, 9, grid.n_storage))
        for repetition in range(2):  # the second time it begins from the first solution
            ours = rows.run(topo_vect, injections)
            assert_same(ours, theirs.run(topo_vect, injections), f"{grid_id} topology {number} time {repetition}")
            seen.add(rows.status)
    assert {CONVERGED, DISCONNECTED} <= seen, "the sample shows too little"


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-M", "bus118-MOB-v1"])
def test_the_verdict_near_collapse_is_that_of_the_cold_recipe(grid_id: str) -> None:
    check_collapses(grid_id, n_ramps=6)


@pytest.mark.slow
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_many_verdicts_near_collapse(grid_id: str) -> None:
    check_collapses(grid_id, n_ramps=300)


def check_collapses(grid_id: str, n_ramps: int) -> None:
    """Raise all injections in steps until no flow exists, back off, and go again in smaller steps."""
    rows, theirs, grid = Rows(grid_id), reference(grid_id), load_grid(grid_id)
    draw = np.random.default_rng(11)
    n_diverged = 0
    for ramp in range(n_ramps):
        topo_vect = random_topology(grid, draw, ramp % 3, ramp % 2)
        scale, step = draw.uniform(0.8, 1.2), draw.choice([0.3, 0.1, 0.03])
        noise = draw.uniform(0.9, 1.1, grid.n_load)
        for _ in range(40):
            base = series(grid_id)[draw.integers(250)]
            injections = scaled(base, scale)._replace(load_p=(base.load_p * scale * noise).astype(np.float32))
            assert_same(rows.run(topo_vect, injections), theirs.run(topo_vect, injections), f"scale {scale}")
            n_diverged += rows.status == DIVERGED
            scale, step = (scale * 0.9, step / 2) if rows.status == DIVERGED else (scale * (1 + step), step)
    assert n_diverged > 0, "no ramp reached collapse"


@pytest.mark.slow
@pytest.mark.parametrize("grid_id", ["bus14", "bus36-M", "bus118-M"])
def test_a_warm_row_gives_up_exactly_where_a_cold_one_does(grid_id: str) -> None:
    """Tiny steps past the largest load: without its guard a warm start goes on farther, or to another solution."""
    rows, grid = Rows(grid_id, 2), load_grid(grid_id)
    draw = np.random.default_rng(3)
    warm, cold = 0, 1

    def run_cold(topo_vect: Any, injections: Injections) -> Results | None:
        forget_flow(rows.flow, cold)
        return rows.run(topo_vect, injections, cold)

    for _ in range(150):
        topo_vect = random_topology(grid, draw, int(draw.integers(0, 4)), int(draw.integers(0, 3)))
        base = series(grid_id)[draw.integers(250)]
        base = base._replace(load_p=base.load_p * draw.uniform(0.8, 1.2, grid.n_load))
        solvable, unsolvable = 0.7, 12.0
        if run_cold(topo_vect, scaled(base, solvable)) is None:
            continue
        for _ in range(40):
            middle = (solvable + unsolvable) / 2
            is_solved = run_cold(topo_vect, scaled(base, middle)) is not None
            solvable, unsolvable = (middle, unsolvable) if is_solved else (solvable, middle)
        forget_flow(rows.flow, warm)
        for scale in np.linspace(0.97 * solvable, 1.006 * solvable, 80):
            expected = run_cold(topo_vect, scaled(base, scale))
            ours = rows.run(topo_vect, scaled(base, scale), warm)
            assert (ours is None) == (expected is None), f"scale {scale / solvable}"
            if ours is not None:
                np.testing.assert_allclose(rows.voltage(warm), rows.voltage(cold), rtol=0, atol=1e-6)


def test_islands_are_disconnected() -> None:
    rows, theirs = Rows("bus14"), reference("bus14")
    grid, injections = rows.grid, series("bus14")[0]
    lonely = all_on_first(grid)
    for line in np.flatnonzero((grid.line_or_to_subid == 7) | (grid.line_ex_to_subid == 7)):
        open_line(grid, lonely, line)
    shunt_alone = all_on_first(grid)
    shunt_sub = int(rows.network.shunt_sub[0])
    shunt_alone[grid.element_to_subid == shunt_sub] = 2
    line_alone = all_on_first(grid)
    line_alone[grid.line_or_pos_topo_vect[0]] = 2
    no_lines = all_on_first(grid)
    for line in range(grid.n_line):
        open_line(grid, no_lines, line)
    for topo_vect in (lonely, shunt_alone, no_lines):
        assert theirs.run(topo_vect, injections) is None
        assert rows.run(topo_vect, injections) is None
        assert rows.status == DISCONNECTED
    # A line end alone on a busbar hangs on its other end: a dead end, but no island.
    assert_same(rows.run(line_alone, injections), theirs.run(line_alone, injections), "line alone")
    assert rows.status == CONVERGED


@pytest.mark.parametrize("position", ["load_pos_topo_vect", "gen_pos_topo_vect"])
def test_disconnected_loads_and_generators(position: str) -> None:
    rows = Rows("bus14")
    for element in getattr(rows.grid, position):
        topo_vect = all_on_first(rows.grid)
        topo_vect[element] = -1
        assert rows.run(topo_vect, series("bus14")[0]) is None
        assert rows.status == DISCONNECTED


def test_a_disconnected_storage_must_rest() -> None:
    rows, theirs = Rows("bus118-MOB-v1"), reference("bus118-MOB-v1")
    injections = series("bus118-MOB-v1")[0]
    topo_vect = all_on_first(rows.grid)
    topo_vect[rows.grid.storage_pos_topo_vect[2]] = -1
    ours = rows.run(topo_vect, injections)
    assert_same(ours, theirs.run(topo_vect, injections), "resting storage")
    assert ours is not None
    assert ours.storage_theta[2] == 0
    power = np.zeros(rows.grid.n_storage, np.float32)
    power[2] = -3
    for _ in range(2):  # the second row meets the topology with working storage first
        assert rows.run(topo_vect, injections._replace(storage_p=power)) is None
        assert rows.status == DISCONNECTED
        assert_same(rows.run(topo_vect, injections), theirs.run(topo_vect, injections), "resting again")
        rows = Rows("bus118-MOB-v1")


def test_generators_on_one_bus_must_agree() -> None:
    rows, theirs = Rows("bus14"), reference("bus14")
    grid, injections = rows.grid, series("bus14")[0]
    first, second = np.flatnonzero(grid.gen_to_subid == 5)
    for difference, converges in ((1e-2, False), (3e-7, False), (5e-8, True)):
        gen_v = injections.gen_v.astype(np.float64)
        gen_v[second] = gen_v[first] + difference
        given = injections._replace(gen_v=gen_v)
        topo_vect = all_on_first(grid)
        assert (theirs.run(topo_vect, given) is not None) == converges
        assert (rows.run(topo_vect, given) is not None) == converges


BAD = {
    "nan load": ("load_p", np.nan),
    "nan reactive load": ("load_q", np.nan),
    "nan generator": ("gen_p", np.nan),
    "infinite load": ("load_p", np.inf),
    "nan set-point": ("gen_v", np.nan),
    "zero set-point": ("gen_v", 0.0),
    "no possible load": ("load_p", 1e9),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("warm", [False, True], ids=["cold", "warm"])
def test_bad_injections_diverge_and_leave_no_trace(case: str, warm: bool) -> None:
    rows = Rows("bus14")
    topo_vect, good = all_on_first(rows.grid), series("bus14")[0]
    before = rows.run(topo_vect, good)
    if not warm:
        forget_flow(rows.flow, 0)
    name, value = BAD[case]
    spoiled = getattr(good, name).copy()
    spoiled[:] = value
    assert rows.run(topo_vect, good._replace(**{name: spoiled})) is None
    assert rows.status == DIVERGED
    assert_identical(rows.run(topo_vect, good), before)  # cold both times


def test_one_spoiled_element_is_enough() -> None:
    rows = Rows("bus36-M")
    topo_vect, good = all_on_first(rows.grid), series("bus36-M")[0]
    for load in range(rows.grid.n_load):
        load_q = good.load_q.copy()
        load_q[load] = np.nan
        on_held_bus = np.isin(rows.grid.load_to_subid[load], rows.grid.gen_to_subid)
        result = rows.run(topo_vect, good._replace(load_q=load_q))
        # Reactive load on a bus whose voltage is held enters no equation and no result.
        assert (result is not None) == on_held_bus
        assert result is None or all(np.isfinite(values).all() for values in result)


def test_a_row_depends_only_on_its_own_history() -> None:
    together, alone = Rows("bus36-M", 3), Rows("bus36-M")
    draw = np.random.default_rng(3)
    topologies = [random_topology(together.grid, draw, k % 3, 0) for k in range(6)]
    for number, injections in enumerate(series("bus36-M")[:60]):
        mine = together.run(topologies[number // 10], injections, 1)
        voltage = together.voltage(1)
        for other in (0, 2):
            together.run(topologies[draw.integers(6)], series("bus36-M")[draw.integers(200)], other)
        assert (mine is None) == (alone.run(topologies[number // 10], injections) is None)
        np.testing.assert_array_equal(voltage, alone.voltage())
        np.testing.assert_array_equal(together.voltage(1), alone.voltage())


def test_a_copied_row_goes_on_like_the_original() -> None:
    source, target = Rows("bus36-M", 2), Rows("bus36-M", 3)
    topo_vect = random_topology(source.grid, np.random.default_rng(1), 0, 2)
    rows = series("bus36-M")
    for injections in rows[:5]:
        source.run(topo_vect, injections, 1)
    copy_row(source.flow, 1, target.flow, 2)
    np.testing.assert_array_equal(source.voltage(1), target.voltage(2))
    for injections in rows[5:10]:
        assert target.run(topo_vect, injections, 2) is not None
        source.run(topo_vect, injections, 1)
        np.testing.assert_array_equal(source.voltage(1), target.voltage(2))


def test_a_forgotten_row_starts_cold() -> None:
    rows, fresh = Rows("bus14"), Rows("bus14")
    topo_vect = all_on_first(rows.grid)
    for injections in series("bus14")[:5]:
        rows.run(topo_vect, injections)
    forget_flow(rows.flow, 0)
    assert_identical(rows.run(topo_vect, series("bus14")[9]), fresh.run(topo_vect, series("bus14")[9]))
    np.testing.assert_array_equal(rows.voltage(), fresh.voltage())


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-M"])
def test_more_fill_than_the_row_has_room_for(grid_id: str) -> None:
    roomy, narrow = Rows(grid_id), Rows(grid_id)
    narrow.flow = narrow.flow._replace(column=narrow.flow.column[:, :20].copy(), panel=narrow.flow.panel[:, :20].copy())
    for injections in series(grid_id)[:3]:
        forget_flow(roomy.flow, 0)
        expected = roomy.run(all_on_first(roomy.grid), injections)
        ours = narrow.run(all_on_first(roomy.grid), injections)
        assert_identical(ours, expected)


def test_every_substation_may_be_divided() -> None:
    """The largest number of buses there can be: each line, load and generator alternates between busbars."""
    rows, theirs, grid = Rows("bus118-M"), reference("bus118-M"), load_grid("bus118-M")
    topo_vect = all_on_first(grid)
    for sub in range(grid.n_sub):
        here = np.flatnonzero(grid.element_to_subid == sub)
        topo_vect[here[1::2]] = 2
    assert_same(rows.run(topo_vect, series("bus118-M")[0]), theirs.run(topo_vect, series("bus118-M")[0]), "divided")


def test_references_are_neither_lost_nor_kept() -> None:
    rows = Rows("bus14", 2)
    topo_vect, injections = all_on_first(rows.grid), series("bus14")[0]
    divided = topo_vect.copy()
    divided[rows.grid.element_to_subid == 1] = [1, 2, 1, 2, 1, 2][: rows.grid.sub_info[1]]
    held = (*rows.flow, *rows.network, topo_vect, divided, *injections)

    def play() -> None:
        for number in range(50):
            rows.run(divided if number % 3 == 0 else topo_vect, injections)
            copy_row(rows.flow, 0, rows.flow, 1)
            forget_flow(rows.flow, 1)
        narrow = Rows("bus14")
        narrow.flow = narrow.flow._replace(panel=narrow.flow.panel[:, :20].copy())
        for _ in range(50):
            narrow.run(topo_vect, injections)

    play()
    before = [sys.getrefcount(array) for array in held]
    play()
    assert [sys.getrefcount(array) for array in held] == before


def test_an_environment_fits_into_120_kb() -> None:
    flow = new_flow_state(load_network(load_grid("bus118-MOB-v1")), 10)
    assert sum(array.nbytes for array in flow) < 10 * 120_000


def line_powers(network: Network, topo_vect: Any, voltage: Any) -> tuple[Any, Any]:
    """Complex power entering each line at its two ends, per unit, by textbook formula."""
    busbar_or, busbar_ex = topo_vect[network.line_or_position], topo_vect[network.line_ex_position]
    is_closed = (busbar_or > 0) & (busbar_ex > 0)
    n_sub = len(network.nominal_voltage)
    v_or = voltage[network.line_or_sub + n_sub * (busbar_or == 2)] * is_closed
    v_ex = voltage[network.line_ex_sub + n_sub * (busbar_ex == 2)] * is_closed
    y = network.line_admittance.copy().view(np.complex128)
    return v_or * np.conj(y[:, 0] * v_or + y[:, 1] * v_ex), v_ex * np.conj(y[:, 2] * v_or + y[:, 3] * v_ex)


def bus_of(network: Network, sub: Any, position: Any, topo_vect: Any) -> Any:
    return sub + len(network.nominal_voltage) * (topo_vect[position] == 2)


situations = st.tuples(
    st.sampled_from(["bus14", "bus36-M", "bus118-MOB-v0"]),
    st.integers(0, 2**32 - 1),
    st.integers(0, 3),
    st.integers(0, 3),
    st.floats(0.3, 1.6),
)


def situation(values: tuple[str, int, int, int, float]) -> tuple[Rows, Any, Injections]:
    grid_id, seed, n_split, n_open, scale = values
    draw, grid = np.random.default_rng(seed), load_grid(grid_id)
    noise = scale * draw.uniform(0.8, 1.2)
    injections = scaled(series(grid_id)[seed % 250], noise, draw.uniform(-9, 9, grid.n_storage))
    return Rows(grid_id), random_topology(grid, draw, n_split, n_open), injections


@settings(max_examples=80, deadline=None)
@given(situations)
def test_power_balances_at_every_bus(values: tuple[str, int, int, int, float]) -> None:
    rows, topo_vect, injections = situation(values)
    results = rows.run(topo_vect, injections)
    if results is None:
        return
    network, voltage = rows.network, rows.voltage()
    n_bus = len(voltage)
    balance = np.zeros(n_bus, np.complex128)
    for sub, position, power in zip(
        (network.line_or_sub, network.line_ex_sub),
        (network.line_or_position, network.line_ex_position),
        line_powers(network, topo_vect, voltage),
        strict=True,
    ):
        np.add.at(balance, bus_of(network, sub, position, topo_vect), power)
    admittance = network.shunt_admittance.copy().view(np.complex128)[:, 0]
    np.add.at(balance, network.shunt_sub, np.abs(voltage[network.shunt_sub]) ** 2 * np.conj(admittance))
    base = network.base_power[0]
    load = injections.load_p.astype(np.float64) + 1j * injections.load_q
    np.add.at(balance, bus_of(network, network.load_sub, network.load_position, topo_vect), load / base)
    storage = injections.storage_p.astype(np.float64) / base
    np.add.at(balance, bus_of(network, network.storage_sub, network.storage_position, topo_vect), storage)
    gen_bus = bus_of(network, network.gen_sub, network.gen_position, topo_vect)
    np.subtract.at(balance, gen_bus, results.gen_p.astype(np.float64) / base)
    # The slack's production is a float32; reactive power of generators is whatever their voltage needs.
    others = np.setdiff1d(np.arange(n_bus), gen_bus)
    slack_bus = gen_bus[network.slack_gen[0]]
    active = np.delete(balance.real, slack_bus)
    assert np.abs(active).max() < 2 * network.tolerance[0]
    assert np.abs(balance.imag[others]).max() < 2 * network.tolerance[0]
    assert abs(balance.real[slack_bus]) * base < 1e-4
    held = np.abs(voltage[gen_bus])
    np.testing.assert_allclose(held, injections.gen_v, rtol=1e-14)


@settings(max_examples=80, deadline=None)
@given(situations)
def test_no_line_produces_power(values: tuple[str, int, int, int, float]) -> None:
    rows, topo_vect, injections = situation(values)
    if rows.run(topo_vect, injections) is None:
        return
    network = rows.network
    y = network.line_admittance.copy().view(np.complex128).reshape(-1, 2, 2)
    # A line is passive if the Hermitian part of its admittance is positive semidefinite; losses are its quadratic form.
    passive = np.linalg.eigvalsh((y + y.conj().swapaxes(1, 2)) / 2).min(axis=1) >= -1e-12
    assert passive.mean() > 0.5
    origin, extremity = line_powers(network, topo_vect, rows.voltage())
    assert (origin + extremity).real[passive].min() > -1e-9


@settings(max_examples=80, deadline=None)
@given(situations, st.integers(0, 117))
def test_busbars_are_only_names(values: tuple[str, int, int, int, float], chosen: int) -> None:
    rows, topo_vect, injections = situation(values)
    grid = rows.grid
    sub = chosen % grid.n_sub
    if sub in rows.network.shunt_sub:
        return  # a shunt stays on busbar 1
    renamed = topo_vect.copy()
    here = (grid.element_to_subid == sub) & (topo_vect > 0)
    renamed[here] = 3 - renamed[here]
    results, status = rows.run(topo_vect, injections), rows.status
    others = rows.run(renamed, injections)
    assert rows.status == status
    if results is None or others is None:
        return
    for name, mine, other in zip(Results._fields, results, others, strict=True):
        np.testing.assert_allclose(mine, other, rtol=FLOAT32, atol=1e-4 if name != "a_or" else 1e-3, err_msg=name)
