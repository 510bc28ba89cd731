"""The electrical models say what the live LightSim2Grid models say."""

import json
from importlib import resources

import numpy as np
import pytest
from grid2op_copies import copied_environment

from rl2grid.engines.reference.extract import SOURCES, describe_network, read_initial_network
from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.grids.network import network_from_record
from rl2grid.powerflow.model import load_network, network_hash


@pytest.fixture(scope="module", params=GRID_IDS)
def live(request):
    """Grid, network and the environment in its first row, all elements on busbar 1."""
    grid = load_grid(request.param)
    environment = copied_environment(grid.bundled_names[0])
    yield grid, load_network(grid), environment
    environment.close()


def test_file_is_what_extract_writes(live):
    grid, _, environment = live
    stored = json.loads((resources.files("rl2grid.grids") / "data" / f"{grid.id}.network.json").read_text())
    record = read_initial_network(environment)
    environment.reset()
    assert record == stored


def test_nodal_admittances_are_the_live_ones(live):
    """The whole matrix of the AC flow from lines and shunts, per unit, within rounding."""
    grid, network, environment = live
    environment.reset()  # the matrix is made with the first flow
    nodal = np.zeros((2 * grid.n_sub, 2 * grid.n_sub), np.complex128)
    admittance = network.line_admittance.view(np.complex128)
    ends = network.line_or_sub, network.line_ex_sub
    for k, (row, column) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1)]):
        np.add.at(nodal, (ends[row], ends[column]), admittance[:, k])
    np.add.at(nodal, (network.shunt_sub, network.shunt_sub), network.shunt_admittance.view(np.complex128)[:, 0])
    expected = environment.backend._grid.get_Ybus().toarray()
    np.testing.assert_allclose(nodal, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_susceptances_are_those_of_the_live_direct_current_flow(live):
    grid, network, environment = live
    nodal = np.zeros((2 * grid.n_sub, 2 * grid.n_sub))
    for row, column, sign in [(0, 0, 1), (0, 1, -1), (1, 0, -1), (1, 1, 1)]:
        ends = network.line_or_sub, network.line_ex_sub
        np.add.at(nodal, (ends[row], ends[column]), sign * network.line_susceptance)
    expected = environment.backend._grid.get_dcYbus().toarray()
    np.testing.assert_allclose(nodal, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_units_and_limits_are_those_of_the_live_backend(live):
    grid, network, environment = live
    backend = environment.backend
    np.testing.assert_array_equal(network.gen_kilovolt, backend.prod_pu_to_kv)
    assert network.gen_kilovolt.dtype == np.float32
    np.testing.assert_array_equal(network.nominal_voltage, backend._grid.get_bus_vn_kv()[: grid.n_sub])
    assert network.base_power.tolist() == [backend._grid.get_sn_mva()]
    assert network.tolerance.tolist() == [backend.tol / backend._grid.get_sn_mva()]
    assert network.max_iterations.tolist() == [backend.max_it]
    slack = [generator.is_slack for generator in backend._grid.get_generators()]
    assert network.slack_gen.tolist() == np.flatnonzero(slack).tolist()


def test_set_points_are_those_before_any_series(live):
    """The series of bus14 moves the set-points away from those of the grid."""
    grid, network, environment = live
    in_force = [generator.target_vm_pu for generator in environment.backend._grid.get_generators()]
    if grid.id == "bus14":
        assert in_force[:2] == pytest.approx([1.02971, 1.02971], abs=1e-5)
        assert network.gen_setpoint[:2].tolist() == [1.045, 1.01]
    assert (np.abs(network.gen_setpoint - 1) < 0.1).all()


def test_shunts_in_service_are_those_of_the_live_grid(live):
    _, network, environment = live
    connected = [shunt.bus_id for shunt in environment.backend._grid.get_shunts() if shunt.connected]
    assert network.shunt_sub.tolist() == connected
    assert network.shunt_admittance.shape == (len(connected), 2)


def test_both_mixes_of_a_grid_have_one_network():
    records = [describe_network(name) for name in SOURCES["bus118-M"].bundled_names]
    assert len(records) == 2
    assert records[0] == records[1]


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_arrays_have_the_shapes_and_types_of_the_grid(grid_id):
    grid, network = load_grid(grid_id), load_network(load_grid(grid_id))
    sizes = {"line": grid.n_line, "gen": grid.n_gen, "load": grid.n_load, "storage": grid.n_storage}
    for name, value in network._asdict().items():
        assert not value.flags.writeable, name
        assert value.flags.c_contiguous, name
        owner = name.partition("_")[0]
        if owner in sizes:
            assert len(value) == sizes[owner], name
    assert network.line_admittance.shape == (grid.n_line, 8)
    assert load_network(grid) is network


def test_hashes_name_the_contents():
    hashes = {grid_id: network_hash(load_grid(grid_id)) for grid_id in GRID_IDS}
    assert all(len(digits) == 16 and int(digits, 16) >= 0 for digits in hashes.values())
    # The three grids of 118 substations are electrically one, so are the two that were opened to opponents.
    assert len({hashes[grid_id] for grid_id in GRID_IDS if grid_id.startswith("bus118")}) == 1
    assert hashes["bus36-MO-v0"] == hashes["bus36-MO-v1"] != hashes["bus36-M"]
    assert len(set(hashes.values())) == 4


def test_record_survives_json():
    record = describe_network("rte_case5_example")
    assert json.loads(json.dumps(record)) == record


def test_grid_without_a_file_is_refused():
    class Foreign:
        id = "bus15"

    for function in (load_network, network_hash):
        with pytest.raises(UsageError, match=r"The network of grid 'bus15' does not exist: choose one of bus14,"):
            function(Foreign())


def test_network_without_shunts_keeps_its_shapes():
    grid = load_grid("bus118-M")
    record = json.loads((resources.files("rl2grid.grids") / "data" / "bus118-M.network.json").read_text())
    network = network_from_record(grid, record | {"shunt_sub": [], "shunt_admittance": []})
    assert network.shunt_admittance.shape == (0, 2)
    assert network.shunt_sub.shape == (0,)
