"""Where generators should be: what the network reads, what it asks for, and that units get there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor, nn

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.algorithms.networks import PER_ACTION, VALUE, VALUE_OF_ACTION, NetworkFactory, Output, orthogonal
from rl2grid.algorithms.networks.mlp import Layers
from rl2grid.algorithms.networks.set_point import LEAST_SPREAD, SPREAD, USUAL, SetPoints, balanced
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.envs.spec import Spec, task_spec
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import continuous_layout

FEATURES = "calendar,attacks,security"


def spec_of_task(name: str, normalize: str | None = "physical") -> Spec:
    return task_spec(find_task(name), normalize, FEATURES)


def made(spec: Spec, output: Output = PER_ACTION) -> nn.Module:
    factory = NetworkFactory(spec, "set-point", torch.Generator().manual_seed(0))
    return factory.make(output, (16, 16), orthogonal(1.0))


def observed(spec: Spec, n: int = 20) -> Tensor:
    """Random observations in physical units; some lines are out, some maintenance is not planned."""
    generator = torch.Generator().manual_seed(1)
    drawn = torch.rand(n, spec.observation_size, generator=generator)
    physical = drawn * torch.tensor(spec.scale) + torch.tensor(spec.shift)
    for name, share, missing in (("rho", 0.1, 0.0), ("time_next_maintenance", 0.5, -1.0)):
        part = spec.feature(name)
        nothing = torch.rand(n, part.end - part.begin, generator=generator) < share
        physical[:, part.begin : part.end] = torch.where(nothing, missing, physical[:, part.begin : part.end])
    return physical


def shown(spec: Spec, physical: Tensor) -> Tensor:
    """The same as the network is given them."""
    return (physical - torch.tensor(spec.shift)) / torch.tensor(spec.scale)


def moved(spec: Spec, physical: Tensor, name: str, by: Tensor | float) -> Tensor:
    part, changed = spec.feature(name), physical.clone()
    changed[:, part.begin : part.end] += by
    return changed


def evened(changes: Any) -> Any:
    """The changes of one observation, the side that is more shortened to the other."""
    up, down = changes[changes > 0].sum(), -changes[changes < 0].sum()
    shares = np.where(changes > 0, min(1.0, down / max(up, 1e-9)), min(1.0, up / max(down, 1e-9)))
    return changes * shares


@pytest.mark.parametrize("task", ["bus14-R", "bus118-MOB-v0-R", "bus36-MO-v0-H1"])
def test_means_are_what_a_step_can_do_of_what_is_missing_of_the_set_point(task: str):
    spec = spec_of_task(task)
    grid, network = spec.grid, made(spec)
    assert grid is not None
    assert isinstance(network, SetPoints)
    layout = continuous_layout(grid)
    gens, n_topology = layout.redispatch, spec.action_size - layout.size
    physical = observed(spec)
    physical[:5, spec.feature("target_dispatch").begin : spec.feature("target_dispatch").end] = 0.0  # never asked
    target, dispatch, up, down = (
        physical[:, spec.feature(name).begin :][:, gens].numpy()
        for name in ("target_dispatch", "actual_dispatch", "gen_margin_up", "gen_margin_down")
    )
    asked = np.where(target == 0.0, dispatch, target)
    assert (asked[:5] == dispatch[:5]).all()

    def requests(missing: Any) -> Any:
        return missing / np.where(missing > 0.0, grid.gen_max_ramp_up[gens], grid.gen_max_ramp_down[gens])

    points = network.layers((network.reads(shown(spec, physical)) - USUAL) / SPREAD).detach().numpy()
    wanted, others = points[:, : len(gens)] * grid.gen_pmax[gens], points[:, len(gens) :]
    changes = np.array([evened(row) for row in np.clip(wanted - dispatch, -down, up)])
    np.testing.assert_allclose(changes.sum(axis=1), 0.0, atol=1e-3)
    means = requests(dispatch + changes - asked).clip(-1.0, 1.0)
    for outputs, expected in zip(
        network.aims_and_means(shown(spec, physical)), (requests(wanted - asked), means), strict=True
    ):
        assert outputs.shape == (len(physical), spec.action_size)
        injections = outputs.detach().numpy()[:, n_topology:]
        np.testing.assert_allclose(injections[:, : len(gens)], expected, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(injections[:, len(gens) :], others, rtol=1e-6)
    torch.testing.assert_close(network(shown(spec, physical)), network.aims_and_means(shown(spec, physical))[1])


def test_balanced_changes_sum_to_zero_and_nothing_is_done_where_all_want_the_same():
    changes = torch.tensor([[3.0, -1.0, 0.0], [3.0, 1.0, 0.0], [1.0, -2.0, -2.0], [0.0, 0.0, 0.0]])
    expected = torch.tensor([[1.0, -1.0, 0.0], [0.0, 0.0, 0.0], [1.0, -0.5, -0.5], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(balanced(changes), expected)


@pytest.mark.parametrize("task", ["bus14-R", "bus36-MO-v0-R"])
def test_set_points_do_not_see_the_dispatch(task: str):
    spec = spec_of_task(task)
    network, physical = made(spec), observed(spec)
    assert isinstance(network, SetPoints)

    def points(these: Tensor) -> Tensor:
        given: Tensor = network.given(shown(spec, these))
        return given

    part = spec.feature("actual_dispatch")
    dispatch = torch.rand(len(physical), part.end - part.begin) * 20.0
    changed = moved(spec, moved(spec, physical, "actual_dispatch", dispatch), "gen_p", dispatch)
    for name in ("gen_theta", "load_theta", "gen_margin_up", "gen_margin_down", "target_dispatch"):
        changed = moved(spec, changed, name, 3.0)
    torch.testing.assert_close(points(changed), points(physical), rtol=0.0, atol=1e-4)
    for name in (
        "load_p",
        "gen_p",
        "rho",
        "loading_after_loss",
        "time_before_cooldown_line",
        "attacked",
        "day_sine",
        "gen_p_before_curtail",
    ):
        assert not torch.allclose(points(moved(spec, physical, name, 1.0)), points(physical), atol=1e-4), name
    rho, out = spec.feature("rho"), physical.clone()
    out[:, rho.begin : rho.end] = 0.0
    assert not torch.allclose(points(out), points(physical))


def test_what_is_read_is_standardised_by_what_was_learned_from():
    spec = spec_of_task("bus36-MO-v0-R")
    network, physical = made(spec), observed(spec, 50)
    assert isinstance(network, SetPoints)
    read = network.reads(shown(spec, physical)).double().numpy()
    network.standardise(read.mean(axis=0), read.std(axis=0))
    standard = (read - read.mean(axis=0)) / (read.std(axis=0) + LEAST_SPREAD)
    points = network.layers(torch.from_numpy(standard).float())
    again = made(spec)  # as from a checkpoint
    again.load_state_dict(network.state_dict())
    assert isinstance(again, SetPoints)
    n = len(network.largest)
    means = again(shown(spec, physical))
    torch.testing.assert_close(means[:, n:], points[:, n:], rtol=1e-3, atol=1e-4)


def test_maintenance_counts_more_the_nearer_it_is_and_not_at_all_where_none_is_planned():
    spec = spec_of_task("bus36-MO-v0-R")
    network, physical = made(spec), observed(spec)
    assert isinstance(network, SetPoints)
    assert spec.grid is not None
    part = spec.feature("time_next_maintenance")
    for steps, urgency in ((-1.0, 0.0), (0.0, 1.0), (72.0, np.exp(-1.0))):
        physical[:, part.begin : part.end] = steps
        last = network.given(shown(spec, physical))[:, -spec.grid.n_line :]
        torch.testing.assert_close(last, torch.full_like(last, float(urgency)))


def test_observations_in_physical_units_mean_the_same():
    scaled, raw = spec_of_task("bus36-MO-v0-H1"), spec_of_task("bus36-MO-v0-H1", None)
    physical = observed(scaled)
    mine, theirs = made(scaled), made(raw)
    assert isinstance(mine, SetPoints)
    assert isinstance(theirs, SetPoints)
    n = mine.topology[-1].out_features if mine.topology is not None else 0  # whose layers read what they are given
    torch.testing.assert_close(mine(shown(scaled, physical))[:, n:], theirs(physical)[:, n:], rtol=1e-4, atol=1e-3)


def test_units_come_to_where_they_should_be_and_stay_there():
    env = gymnasium.make("rl2grid/bus14-R-v0", normalize="physical")
    spec = task_spec(find_task("bus14-R"))
    network = made(spec)
    assert isinstance(network, SetPoints)
    grid = spec.grid
    assert grid is not None
    gens = continuous_layout(grid).redispatch
    wanted = np.zeros(len(gens), np.float32)
    wanted[0], wanted[1] = 6.0, -6.0
    last = network.layers[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight.zero_()
        last.bias.zero_()
        last.bias[: len(gens)] = torch.from_numpy(wanted / grid.gen_pmax[gens])
    observation, _ = env.reset(seed=3)
    part = spec.feature("target_dispatch")
    for _ in range(12):
        with torch.no_grad():
            means = network(torch.from_numpy(observation).unsqueeze(0))[0].numpy()
        observation, _, terminated, truncated, info = env.step(np.clip(means, -1.0, 1.0))
        assert not terminated
        assert not truncated
        assert not info["illegal"]
    target = (observation * spec.scale + spec.shift)[part.begin : part.end][gens]
    np.testing.assert_allclose(target, wanted, atol=0.01)
    assert np.abs(means).max() < 0.01


def test_values_have_layers_over_the_whole_observation():
    for output in (VALUE, VALUE_OF_ACTION):
        assert isinstance(made(spec_of_task("bus14-R"), output), Layers)


def test_what_has_no_set_points_is_refused():
    for spec in (spec_of_task("bus14-T0"), replace(spec_of_task("bus14-H0"), continuous=False)):
        with pytest.raises(UsageError, match="for redispatching tasks, and for joint ones"):
            made(spec)
    with pytest.raises(UsageError, match="means alone, which SAC's policy is not: choose ppo"):
        made(spec_of_task("bus14-R"), Output(per_action=2))
    envs = gymnasium.make_vec("rl2grid/bus14-R-v0", num_envs=2)
    algorithm = find_algorithm("ppo")
    args = algorithm.preset("default", continuous=True, num_envs=2, network="set-point")
    with pytest.raises(UsageError, match="set normalize_observations to False"):
        algorithm.trainer(args, envs)
