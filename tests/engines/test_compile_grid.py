"""Compiled grids hold what the environment says; what is not simulated is refused by name."""

import json
import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest
from grid2op.Action import PowerlineSetAction
from grid2op.Environment import MaskedEnvironment
from grid2op.Environment.dispatch import DefaultRedispatchSolver
from grid2op.Opponent import NeverAttackBudget, RandomLineOpponent
from grid2op.Parameters import Parameters
from grid2op.Rules import AlwaysLegal
from grid2op.VoltageControler import ControlVoltageFromFile
from grid2op_copies import copied_environment
from grids_of_tests import SHORTER_OR_ALL
from lightsim2grid.algorithm import AlgorithmType

from rl2grid.engines.reference.compile_grid import compile_grid, compiled_path, load_compiled
from rl2grid.engines.reference.extract import make_environment
from rl2grid.engines.reference.supported import (
    FREE_PARAMETERS,
    PARAMETERS,
    require_supported,
    require_supported_model,
)
from rl2grid.errors import UsageError
from rl2grid.grids import System, load_grid
from rl2grid.mdp.actions import full_catalogue
from rl2grid.powerflow.model import load_network


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "data"))
    return tmp_path / "data" / "grids" / "v1"


@pytest.fixture
def small():
    """An environment of five substations."""
    environment = copied_environment("rte_case5_example")
    yield environment
    environment.close()


def assert_same(one: System, other: System) -> None:
    for field in fields(one.grid):
        np.testing.assert_equal(getattr(one.grid, field.name), getattr(other.grid, field.name), field.name)
    for name, value in one.network._asdict().items():
        np.testing.assert_array_equal(value, getattr(other.network, name), name)
        assert value.dtype == getattr(other.network, name).dtype
    assert one.hash == other.hash == one.grid.hash == other.grid.hash


@pytest.mark.parametrize("grid_id", SHORTER_OR_ALL)
def test_benchmark_grids_compile_to_what_is_shipped(grid_id):
    shipped = load_grid(grid_id)
    environment = copied_environment(shipped.bundled_names[0])
    compiled = compile_grid(environment)
    environment.close()
    ours = {"id", "grid2op_name", "bundled_names", "level_sizes", "load_p_max"}
    if grid_id == "bus14":
        ours.add("maintenance")
    for field in fields(shipped):
        if field.name not in ours:
            value = getattr(compiled.grid, field.name)
            np.testing.assert_equal(value, getattr(shipped, field.name), field.name)
            assert getattr(value, "dtype", None) == getattr(getattr(shipped, field.name), "dtype", None), field.name
    for name, value in load_network(shipped)._asdict().items():
        np.testing.assert_array_equal(getattr(compiled.network, name), value, name)
    assert compiled.grid.level_sizes == (shipped.level_sizes[-1],)
    assert (compiled.grid.load_p_max <= shipped.load_p_max).all()
    assert compiled.grid.load_p_max.max() > 0.5 * shipped.load_p_max.max()


@pytest.mark.parametrize(
    ("name", "sizes"),
    [("rte_case5_example", (5, 8, 2, 3)), pytest.param("rte_case118_example", None, marks=pytest.mark.slow)],
)
def test_foreign_environments_compile(name, sizes):
    environment = copied_environment(name)
    compiled = compile_grid(environment)
    grid, network = compiled.grid, compiled.network
    assert (grid.id, grid.grid2op_name, grid.bundled_names) == (name, name, ())
    assert (grid.n_sub, grid.n_line, grid.n_gen, grid.n_load) == (
        sizes or (environment.n_sub, environment.n_line, environment.n_gen, environment.n_load)
    )
    assert grid.level_sizes == (len(full_catalogue(grid)),)
    assert grid.opponent.kind == "none"
    assert grid.maintenance.lines == ()
    np.testing.assert_array_equal(grid.thermal_limit, environment.get_thermal_limit())
    np.testing.assert_array_equal(grid.gen_pmax, environment.gen_pmax)
    np.testing.assert_array_equal(grid.load_p_max >= environment.reset().load_p, True)
    assert len(network.line_admittance) == grid.n_line
    assert (np.abs(network.line_admittance).sum(axis=1) > 0).all()
    assert_same(load_compiled(compiled.hash), compiled)
    environment.close()


def test_hash_names_what_was_read_and_nothing_else(small, folder):
    first = compile_grid(small)
    small.reset()
    _, _, over, _ = small.step(small.action_space({"set_line_status": [(1, -1)]}))
    assert not over
    assert not small.get_obs().line_status[1]
    assert_same(compile_grid(small), first)
    assert [path.name for path in folder.glob("*.json")] == [f"{first.hash}.json"]
    small.set_thermal_limit(small.get_thermal_limit() + 1)
    changed = compile_grid(small)
    assert changed.hash != first.hash
    np.testing.assert_array_equal(changed.grid.thermal_limit, first.grid.thermal_limit + 1)


def test_compiling_leaves_the_environment_as_it_was():
    played = []
    for compiles in (False, True):
        environment = copied_environment("l2rpn_icaps_2021")
        environment.seed(3)
        environment.reset()
        rows = []
        for step in range(6):
            if compiles and step == 2:
                compile_grid(environment)
            rows.append(environment.step(environment.action_space())[0].to_vect())
        rows.append(environment.reset().to_vect())
        environment.close()
        played.append(np.array(rows))
    np.testing.assert_array_equal(*played)


def test_arrays_are_read_only(small):
    compiled = compile_grid(small)
    assert not compiled.grid.thermal_limit.flags.writeable
    assert not compiled.network.line_admittance.flags.writeable


def test_file_is_written_once_and_nothing_else_is_left(small, folder):
    compiled = compile_grid(small)
    path = compiled_path(compiled.hash)
    before = path.stat().st_mtime_ns
    compile_grid(small)
    assert path.stat().st_mtime_ns == before
    assert sorted(each.suffix for each in folder.iterdir()) == [".json", ".lock"]


def test_loading_needs_no_grid2op(small, tmp_path):
    compiled = compile_grid(small)
    elsewhere = tmp_path / "elsewhere.json"
    elsewhere.write_bytes(compiled_path(compiled.hash).read_bytes())
    code = (
        "import sys; from rl2grid.engines.reference.compile_grid import load_compiled;"
        "print([load_compiled(each).network.line_admittance.sum().hex() for each in sys.argv[1:]]);"
        "print({'grid2op', 'lightsim2grid', 'pandapower'} & sys.modules.keys())"
    )
    command = [sys.executable, "-c", code, compiled.hash, str(elsewhere)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    total = compiled.network.line_admittance.sum().hex()
    assert done.stdout.splitlines() == [str([total, total]), "set()"]


@pytest.mark.parametrize("damage", ["missing", "truncated", "changed", "not an object", "another format"])
def test_damaged_file_is_refused_and_made_again(small, damage):
    compiled = compile_grid(small)
    path = compiled_path(compiled.hash)
    content = path.read_text()
    if damage == "missing":
        path.unlink()
    elif damage == "truncated":
        path.write_text(content[:-10])
    elif damage == "changed":
        path.write_text(content.replace('"cooldown_line": 0', '"cooldown_line": 1'))
    elif damage == "not an object":
        path.write_text("[1]")
    else:
        path.write_text(json.dumps({"hash": compiled.hash, "grid": {}}))
    with pytest.raises(UsageError, match=rf"Compiled grid {compiled.hash} is missing or damaged"):
        load_compiled(compiled.hash)
    compile_grid(small)
    assert_same(load_compiled(compiled.hash), compiled)


def test_folder_that_cannot_be_written_is_refused(small, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "file"))
    with pytest.raises(UsageError, match="cannot be written"):
        compile_grid(small)


def test_every_parameter_of_grid2op_has_been_thought_of():
    without_effect = {"ALARM_BEST_TIME", "ALARM_WINDOW_SIZE", "ALERT_TIME_WINDOW"}
    assert set(PARAMETERS) | set(FREE_PARAMETERS) | without_effect == set(Parameters.__slots__)


@pytest.mark.parametrize("name", PARAMETERS)
def test_other_values_of_parameters_are_refused(small, name):
    simulated = PARAMETERS[name]
    changed = not simulated if isinstance(simulated, bool) else simulated + 1
    setattr(small._parameters, name, changed)
    with pytest.raises(UsageError, match=rf"parameter {name} is {changed}, only {simulated} is simulated\.$"):
        compile_grid(small)


@pytest.mark.parametrize("name", FREE_PARAMETERS)
def test_free_parameters_are_read_but_must_hold_for_forecasts_as_well(small, name):
    before = compile_grid(small)
    value = getattr(small._parameters, name) + 4
    setattr(small._parameters, name, value)
    with pytest.raises(UsageError, match=f"parameter {name} of its forecasts differs"):
        compile_grid(small)
    setattr(small._observation_space.obs_env._parameters, name, value)
    rules = compile_grid(small).grid.rules
    assert sum(getattr(rules, each.name) != getattr(before.grid.rules, each.name) for each in fields(rules)) == 1


class Changed:
    """An object with some attributes replaced."""

    def __init__(self, original, **replaced):
        self._original = original
        self.__dict__.update(replaced)

    def __getattr__(self, name):
        return getattr(self._original, name)


class OtherController(ControlVoltageFromFile):
    pass


class OtherSolver(DefaultRedispatchSolver):
    pass


def change_type(environment, **attributes):
    """Give the environment a class of its own with other class attributes."""
    kind = type(environment)
    environment.__class__ = type(kind.__name__, (kind,), attributes)


def change_hazards(environment):
    data = environment.chronics_handler.real_data.data
    data.hazards = np.zeros_like(data.load_p, dtype=bool)
    data.hazards[7, 0] = True


def change_initial_topology(environment):
    data = environment.chronics_handler.real_data
    data.get_init_action = lambda names: environment.action_space({"set_bus": {"loads_id": [(0, 2)]}})


ENVIRONMENT_CHANGES = {
    r"its backend is \w+, only LightSimBackend": lambda e: setattr(e, "backend", Changed(e.backend)),
    "distributes the slack": lambda e: setattr(e.backend, "_dist_slack_non_renew", True),
    "lets idle generators float": lambda e: setattr(e.backend, "_turned_off_pv", False),
    "does not start from a DC flow": lambda e: setattr(e.backend, "initdc", False),
    "its power flow algorithm is .*Gauss.*, only those of Newton": lambda e: e.backend._grid.change_algorithm(
        AlgorithmType.GaussSeidel
    ),
    "its rules are AlwaysLegal, only DefaultRules and RulesByArea": lambda e: setattr(
        e._game_rules, "legal_action", AlwaysLegal()
    ),
    "its redispatch_solver is OtherSolver": lambda e: setattr(e, "_redispatch_solver", OtherSolver()),
    "its tol_poly and epsilon_poly must be 0.01 and": lambda e: setattr(e, "_tol_poly", np.float32(0.1)),
    "its voltage controller is OtherController": lambda e: setattr(e._voltage_controler, "__class__", OtherController),
    "its substations have 3 busbars, only 2": lambda e: change_type(e, n_busbar_per_sub=3),
    "loads and generators may be detached": lambda e: change_type(e, detachment_is_allowed=True),
    "its generators have no limits and costs": lambda e: change_type(e, redispatching_unit_commitment_availble=False),
    "it has 16,384 substations and 8 lines, only up to 16,383 substations": lambda e: change_type(e, n_sub=16_384),
    "it has 5 substations and 32,763 lines, .* up to 32,767 of both": lambda e: change_type(e, n_line=32_763),
    "its time step is 900 s, only 300 s": lambda e: setattr(e, "delta_time_seconds", 900.0),
    "its opponent is RandomLineOpponent, only BaseOpponent, Weighted": lambda e: setattr(
        e._oppSpace, "opponent", RandomLineOpponent(e.action_space)
    ),
    "its time series have hazards": change_hazards,
    "its episodes begin with a topology of their own": change_initial_topology,
}


@pytest.mark.parametrize("problem", ENVIRONMENT_CHANGES)
def test_environments_with_other_features_are_refused(small, problem, folder):
    require_supported(small)
    ENVIRONMENT_CHANGES[problem](small)
    with pytest.raises(UsageError, match=rf"^Environment rte_case5_example cannot be compiled: .*{problem}"):
        compile_grid(small)
    assert not folder.exists()


def test_budget_of_an_attacker_must_be_the_usual_one():
    environment = copied_environment("l2rpn_icaps_2021")
    environment._oppSpace.compute_budget = NeverAttackBudget(PowerlineSetAction)
    with pytest.raises(UsageError, match="the budget of its opponent is NeverAttackBudget, only BaseActionBudget"):
        compile_grid(environment)
    environment.close()


def test_what_is_no_plain_environment_is_refused(small):
    masked = MaskedEnvironment(small, lines_of_interest=np.ones(small.n_line, bool))
    several = make_environment("l2rpn_neurips_2020_track2")
    for other in (masked, several, "rte_case5_example"):
        with pytest.raises(UsageError, match=rf"^A {type(other).__name__} cannot be compiled: give a plain grid2op"):
            compile_grid(other)
    several.close()


def first_changed(elements, **replaced):
    first, *others = elements
    return lambda: [Changed(first, **replaced), *others]


MODEL_CHANGES = {
    "its grid has static generators": lambda m: {"get_static_generators": lambda: [1]},
    "its grid has HVDC lines": lambda m: {"get_dclines": lambda: [1]},
    "its grid has static VAR compensators": lambda m: {"get_svcs": lambda: [1]},
    "other substations than Grid2Op": lambda m: {"get_n_sub": lambda: 13},
    "some of its lines begin": lambda m: {"get_lines": first_changed(m.get_lines(), bus2_id=-1)},
    "some of its generators begin": lambda m: {"get_generators": first_changed(m.get_generators(), bus_id=-1)},
    "some of its loads begin": lambda m: {"get_loads": first_changed(m.get_loads(), bus_id=-1)},
    "some of its storage units begin": lambda m: {"get_storages": first_changed(m.get_storages(), bus_id=-1)},
    "2 generators share the slack": lambda m: {"get_generators": first_changed(m.get_generators(), is_slack=True)},
    "generator 0 does not regulate the voltage of its own bus": lambda m: {
        "get_generators": first_changed(m.get_generators(), voltage_regulator_on=False)
    },
    "generator 0 does not regulate": lambda m: {
        "get_generators": first_changed(m.get_generators(), regulated_bus_id=9)
    },
    "transformer 0 shifts the phase": lambda m: {"get_trafos": first_changed(m.get_trafos(), yac_12=1 - 2j)},
    "transformer 0 shifts the": lambda m: {"get_trafos": first_changed(m.get_trafos(), ydc_21=-3.0 + 0j)},
}


@pytest.fixture(scope="module")
def stored_energy():
    environment = copied_environment("educ_case14_storage")
    yield environment
    environment.close()


@pytest.mark.parametrize("problem", MODEL_CHANGES)
def test_electrical_models_with_other_features_are_refused(stored_energy, problem):
    model = stored_energy.backend._grid
    require_supported_model(stored_energy, model)
    changed = Changed(model, **MODEL_CHANGES[problem](model))
    with pytest.raises(UsageError, match=rf"^Environment educ_case14_storage cannot be compiled: .*{problem}"):
        require_supported_model(stored_energy, changed)
