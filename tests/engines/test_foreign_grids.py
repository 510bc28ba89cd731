"""Grids that the project does not ship: compiled from a Grid2Op environment, then simulated without Grid2Op."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.entry import reset_one
from rl2grid.engines.reference.compile_grid import compile_grid, load_compiled
from rl2grid.engines.reference.extract import make_environment
from rl2grid.envs.registration import register_system, unregister_system
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import ActionKind, full_catalogue, moved_elements
from rl2grid.mdp.state import OBSERVED
from rl2grid.scenarios.scenario import Scenario

NO_OUTAGES = np.zeros((0, 3), np.int32)
TOLERANCE = {"a_or": 1e-3, "gen_theta": 1e-4, "load_theta": 1e-4, "rho": 1e-5}
"""Absolute; A, degrees. Currents of thousands of A are float32, whose resolution is 2e-4 A there."""


@pytest.fixture(
    scope="module", params=["rte_case5_example", pytest.param("rte_case118_example", marks=pytest.mark.slow)]
)
def environment(request, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RL2GRID_DATA", str(tmp_path_factory.mktemp("data")))
        environment = make_environment(request.param)
        register_system(compile_grid(environment))
        yield environment
        unregister_system(request.param)


def scenario_of(environment, name):
    data = environment.chronics_handler.real_data.data
    # Grid2Op's reset shows the first row of the file.
    arrays = {key: np.ascontiguousarray(getattr(data, key), np.float32) for key in ("load_p", "load_q", "prod_p")}
    prod_v = None if data.prod_v is None else np.ascontiguousarray(data.prod_v, np.float32)
    rows = len(arrays["load_p"])
    return Scenario(
        id=name, grid_id=name, source="folder", start_datetime=data.start_datetime, content_hash="",
        first_row=0, series_rows=rows, prod_v=prod_v, **arrays,
    )  # fmt: skip


def begin(engine, scenario):
    engine.begin(0, scenario, 0, scenario.n_steps, NO_OUTAGES, None)
    reset_one(engine.address, 0)


def play_in_grid2op(environment, grid, action):
    played = environment.action_space()
    for kind, target, mask in action.changes:
        if kind == ActionKind.MOVE:
            moved = np.zeros(grid.dim_topo, np.bool_)
            moved[moved_elements(grid, target, mask)] = True
            played.change_bus = moved
        elif kind == ActionKind.SWITCH:
            played.line_change_status = [target]
    return environment.step(played)


def assert_equal(state, observation, step):
    for name in OBSERVED:
        ours, theirs = getattr(state, name)[0], getattr(observation, name)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=TOLERANCE.get(name, 2e-4), err_msg=f"{name}, step {step}")


def test_a_compiled_grid_plays_like_its_environment(environment):
    compiled = compile_grid(environment)
    name = compiled.id
    engine = NativeEngine(load_grid(name), 1)
    catalogue, generator = full_catalogue(compiled.grid), np.random.default_rng(0)
    observation, ends, changes = environment.reset(), 0, 0
    begin(engine, scenario_of(environment, name))
    assert_equal(engine.state, observation, 0)
    for step in range(1, 201):
        action = catalogue[int(generator.integers(len(catalogue))) if generator.random() < 0.3 else 0]
        engine.step(0, action)
        observation, _, over, info = play_in_grid2op(environment, compiled.grid, action)
        changes += len(action.changes)
        assert bool(engine.state.illegal[0]) == info["is_illegal"], step
        assert bool(engine.state.terminated[0] or engine.state.truncated[0]) == over, step
        assert_equal(engine.state, observation, step)
        if over:
            ends += 1
            observation = environment.reset()
            begin(engine, scenario_of(environment, name))
            assert_equal(engine.state, observation, 0)
    assert changes > 30
    assert ends > 0


def test_a_kept_grid_is_the_compiled_one(environment):
    compiled = compile_grid(environment)
    kept = load_compiled(compiled.hash)
    assert kept.hash == compiled.hash
    for ours, theirs in zip(kept.network, compiled.network, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_both_engines_play_its_tasks_alike(environment):
    name = compile_grid(environment).id
    native, reference = (gymnasium.make(f"rl2grid/{name}-R-v0", engine=engine) for engine in ("native", "reference"))
    rng = np.random.default_rng(0)
    observations = [env.reset(seed=1)[0] for env in (native, reference)]
    for _ in range(10):
        np.testing.assert_allclose(*observations, rtol=0, atol=1e-4)
        action = rng.uniform(-0.1, 0.1, native.action_space.shape).astype(np.float32)
        one, other = native.step(action), reference.step(action)
        assert one[2:4] == other[2:4]
        np.testing.assert_allclose(one[1], other[1], rtol=0, atol=1e-6)
        if one[2] or one[3]:
            break
        observations = [one[0], other[0]]
