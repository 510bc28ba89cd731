"""What a policy is told of a task: checked against the grid, the environments and the engine's own functions."""

from __future__ import annotations

import pickle
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

from rl2grid.envs.registration import register_all
from rl2grid.envs.spec import Spec, spec_from_state, spec_of, task_spec
from rl2grid.envs.tasks import all_tasks, find_task
from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS
from rl2grid.mdp.actions import DO_NOTHING, ActionCatalogue, ContinuousLayout
from rl2grid.mdp.features import physical_scale

TASKS = [f"{grid}-{kind}" for grid in GRID_IDS for kind in ("T0", "R", "H0")]


@pytest.mark.parametrize("name", TASKS)
def test_every_entry_of_an_observation_is_of_an_element(name: str):
    task = find_task(name)
    spec, grid = task_spec(task), task.grid
    counts = {
        "time": 1,
        "gen": grid.n_gen,
        "load": grid.n_load,
        "line": grid.n_line,
        "element": grid.dim_topo,
        "sub": grid.n_sub,
        "storage": grid.n_storage,
    }
    assert [feature.end for feature in spec.features[:-1]] == [feature.begin for feature in spec.features[1:]]
    assert (spec.features[0].begin, spec.features[-1].end) == (0, spec.observation_size)
    for feature in spec.features:
        assert feature.end - feature.begin == counts[feature.of], feature
    assert spec.grid is grid
    assert spec.continuous == (task.kind != "T")


def test_actions_are_those_of_the_task():
    discrete, continuous = task_spec(find_task("bus36-M-T1")), task_spec(find_task("bus118-MOB-v0-R"))
    assert isinstance(discrete.actions, ActionCatalogue)
    assert len(discrete.actions) == discrete.action_size == 302
    assert discrete.actions[0] == DO_NOTHING
    assert isinstance(continuous.actions, ContinuousLayout)
    assert continuous.actions.size == continuous.action_size == 69


def test_entries_in_physical_units():
    task = find_task("bus14-T0")
    physical, raw = task_spec(task), task_spec(task, None)
    assert physical.shift is not None
    assert physical.scale is not None
    shift, scale = physical_scale(task.grid, "T")
    values = np.random.default_rng(0).normal(size=physical.observation_size).astype(np.float32)
    np.testing.assert_allclose((values - shift) / scale * physical.scale + physical.shift, values, rtol=1e-5, atol=1e-5)
    assert raw.scale is not None
    assert (raw.scale == 1.0).all()
    busbars = physical.feature("topo_vect")
    assert (busbars.of, busbars.end - busbars.begin) == ("element", task.grid.dim_topo)
    with pytest.raises(UsageError, match="'voltage' is not observed here: there are t, gen_p, "):
        physical.feature("voltage")


def same(one: Spec, other: Spec) -> bool:
    """Whether all that two specs say is equal."""
    return pickle.dumps(one) == pickle.dumps(other)


@pytest.mark.parametrize("name", ["bus14-T0", "bus14-R", "bus14-H0"])
def test_it_is_small_survives_a_pickle_and_comes_back_from_plain_values(name: str):
    spec = task_spec(find_task(name), None)
    stored = pickle.dumps(spec)
    assert len(stored) < 40_000
    copy = pickle.loads(stored)
    assert copy.state_dict() == spec.state_dict()
    assert copy.features == spec.features
    np.testing.assert_array_equal(copy.grid.line_or_to_subid, spec.grid.line_or_to_subid)  # type: ignore[union-attr]
    again = spec_from_state(spec.state_dict())
    assert again.grid is spec.grid
    assert all(isinstance(value, int | str | None) for value in spec.state_dict().values())
    with pytest.raises(AttributeError):
        spec.action_size = 3  # type: ignore[misc]
    assert {field.name for field in fields(spec)} >= spec.state_dict().keys()


def test_of_any_gymnasium_task():
    spec = spec_of(gymnasium.make("CartPole-v1"))
    assert (spec.observation_size, spec.action_size, spec.continuous) == (4, 2, False)
    assert (spec.task, spec.grid, spec.features, spec.actions) == (None, None, (), None)
    assert same(spec_from_state(spec.state_dict()), spec)
    pendulum = spec_of(gymnasium.make_vec("Pendulum-v1", num_envs=2, vectorization_mode="sync"))
    assert (pendulum.observation_size, pendulum.action_size, pendulum.continuous) == (3, 1, True)
    with pytest.raises(UsageError, match="this environment has no grid"):
        spec.graph_builder()
    with pytest.raises(UsageError, match="is not observed here: there are nothing but numbers without names"):
        spec.feature("rho")


def space(**changes: Any) -> Any:
    """An environment that has spaces and nothing else."""
    spaces: dict[str, Any] = {
        "observation_space": gymnasium.spaces.Box(-1.0, 1.0, (4,)),
        "action_space": gymnasium.spaces.Discrete(3),
        **changes,
    }
    env = SimpleNamespace(**spaces)
    env.unwrapped = env
    return env


def test_what_policies_cannot_read_or_play_is_refused():
    assert spec_of(space()).action_size == 3
    with pytest.raises(UsageError, match="flat observations, not observations of shape"):
        spec_of(space(observation_space=gymnasium.spaces.Box(-1.0, 1.0, (4, 2))))
    with pytest.raises(UsageError, match="Discrete actions and vectors, not MultiDiscrete"):
        spec_of(space(action_space=gymnasium.spaces.MultiDiscrete([2, 2])))


def test_environments_of_a_task_have_its_spec_unless_a_wrapper_changed_what_is_seen():
    register_all()
    env = gymnasium.make("rl2grid/bus14-T0-v0", normalize=None)
    spec = spec_of(env)
    assert spec.state_dict() == task_spec(find_task("bus14-T0"), None).state_dict()
    assert spec.graph_builder().graph(np.zeros(spec.observation_size, np.float32))["nodes"].shape[0] == 2 * 14
    flattened = gymnasium.wrappers.TransformObservation(
        env, lambda seen: seen[:3], gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    )
    assert spec_of(flattened).task is None
    assert spec_of(flattened).observation_size == 3


def test_a_task_that_has_changed_since_is_known_by_its_sizes_alone():
    stored = {**task_spec(find_task("bus14-T0")).state_dict(), "observation_size": 7}
    assert spec_from_state(stored).grid is None
    assert spec_from_state(stored).observation_size == 7


def test_every_task_has_one():
    for task in all_tasks().values():
        if task.kind == "R" or task.level < 2:
            assert task_spec(task).action_size == task.n_actions
