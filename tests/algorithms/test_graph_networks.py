"""Networks that know the grid: what they hear, how they score actions, and the shortlist."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from test_descent import pytorchs_step
from torch import Tensor

from rl2grid.algorithms.descent import Adam, descend
from rl2grid.algorithms.networks import (
    NEVER,
    PER_ACTION,
    VALUE,
    VALUE_OF_ACTION,
    NetworkFactory,
    Output,
    orthogonal,
    shortlist,
)
from rl2grid.algorithms.networks.action_table import KINDS, Places, action_table, element_order
from rl2grid.algorithms.networks.gnn import GraphNetwork
from rl2grid.envs.joint import discrete_of
from rl2grid.envs.spec import Spec, task_spec
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import ActionKind, level_catalogue, moved_elements

NETWORKS = ("gnn", "action-embedding")
needs_a_card = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a graphics card")


@functools.cache
def spec_of_task(name: str, *, discrete: bool = False) -> Spec:
    task = find_task(name)
    spec = task_spec(task)
    if not discrete:
        return spec
    return replace(spec, action_size=int(discrete_of(task).n), continuous=False)


def factory(spec: Spec, network: str, seed: int = 0, **more: Any) -> NetworkFactory:
    return NetworkFactory(spec, network, torch.Generator().manual_seed(seed), **more)


def observations(spec: Spec, n: int, *, split: float = 0.1, seed: int = 0) -> Tensor:
    """Random observations, in which some elements are on busbars 2 and some lines out of service."""
    generator = np.random.default_rng(seed)
    drawn = generator.random((n, spec.observation_size)).astype(np.float32)
    grid = spec.grid
    assert grid is not None
    if any(feature.name == "topo_vect" for feature in spec.features):
        part = spec.feature("topo_vect")
        topology = (generator.random((n, grid.dim_topo)) < split).astype(np.float32)
        out = generator.random((n, grid.n_line)) < split
        for positions in (grid.line_or_pos_topo_vect, grid.line_ex_pos_topo_vect):
            topology[:, positions] = np.where(out, -2.0, topology[:, positions])
        drawn[:, part.begin : part.end] = topology
    return torch.from_numpy(drawn)


# --- What every network must do -------------------------------------------------------------------------------------


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_a_card)])
@pytest.mark.parametrize("network", ["mlp", *NETWORKS])
@pytest.mark.parametrize(
    ("spec", "output"),
    [(spec_of_task("bus14-T0"), PER_ACTION), (spec_of_task("bus14-H0"), VALUE), (spec_of_task("bus14-R"), PER_ACTION)],
)
def test_steps_down_a_gradient_are_those_of_pytorchs_plain_optimiser(
    network: str, spec: Spec, output: Output, device: str
):
    """Its gradients are those of ``backward``; Adam magnifies the roundings of small ones."""
    inputs = observations(spec, 16)
    ours, theirs = (factory(spec, network).make(output, (32, 32), orthogonal(1.0)) for _ in range(2))
    ours = ours.to(device)
    before = torch.cat([weight.detach().flatten() for weight in theirs.parameters()])
    optimizer = Adam(ours.parameters(), lr=1e-3, eps=1e-5)
    reference = torch.optim.Adam(theirs.parameters(), lr=1e-3, eps=1e-5, fused=False, foreach=False)
    for _ in range(5):
        descend(optimizer, ours(inputs.to(device)).square().mean(), 10.0)
        pytorchs_step(reference, theirs(inputs).square().mean(), 10.0)
    mine, other = (torch.cat([w.detach().cpu().flatten() for w in made.parameters()]) for made in (ours, theirs))
    assert torch.linalg.vector_norm(mine - other) < 1e-3 * torch.linalg.vector_norm(other - before)


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize(
    ("spec", "output"),
    [
        (spec_of_task("bus14-T0"), PER_ACTION),
        (spec_of_task("bus14-T0"), VALUE),
        (spec_of_task("bus14-T0"), Output(per_state=1, per_action=1)),
        (spec_of_task("bus14-R"), Output(per_action=2)),
        (spec_of_task("bus14-R"), VALUE_OF_ACTION),
        (spec_of_task("bus14-H0"), PER_ACTION),
        (spec_of_task("bus14-H0"), VALUE_OF_ACTION),
        (spec_of_task("bus14-H0", discrete=True), PER_ACTION),
        (spec_of_task("bus118-MOB-v0-R"), VALUE_OF_ACTION),
    ],
    ids=lambda part: f"{part.task}-{part.action_size}" if isinstance(part, Spec) else "",
)
def test_the_numbers_asked_for_depend_on_every_row_alone_and_can_be_learned(network: str, spec: Spec, output: Output):
    module = factory(spec, network).make(output, (32, 32))
    inputs = observations(spec, 6)
    if output.reads_action:
        inputs = torch.cat([inputs, torch.rand(6, spec.action_size) * 2.0 - 1.0], dim=1)
    numbers = module(inputs)
    assert numbers.shape == (6, output.width(spec))
    assert len(numbers.detach().unique(dim=0)) == 6, "it does not see what differs"
    for row in range(6):
        torch.testing.assert_close(module(inputs[row : row + 1])[0], numbers[row], rtol=1e-5, atol=1e-5)
    numbers.square().sum().backward()
    unused = [name for name, weights in module.named_parameters() if weights.grad is None]
    assert all(".moves." in name for name in unused), "of elements that no action of the task moves"
    again = factory(spec, network, seed=1).make(output, (32, 32))
    again.load_state_dict(module.state_dict())
    assert torch.equal(again(inputs), module(inputs))


@pytest.mark.parametrize("network", NETWORKS)
def test_more_actions_need_no_more_weights(network: str):
    def weights(task: str) -> int:
        module = factory(spec_of_task(task), network).make(PER_ACTION, (32, 32))
        return sum(each.numel() for each in module.parameters())

    assert weights("bus14-T0") == weights("bus14-T1")
    assert weights("bus36-MO-v0-T0") == weights("bus36-MO-v0-T4")


@pytest.mark.parametrize("network", NETWORKS)
def test_an_action_that_is_read_changes_the_value(network: str):
    for task in ("bus14-R", "bus14-H0"):
        spec = spec_of_task(task)
        module = factory(spec, network).make(VALUE_OF_ACTION, (32, 32))
        inputs = torch.cat([observations(spec, 1), torch.zeros(1, spec.action_size)], dim=1)
        for entry in range(spec.action_size):
            if task == "bus14-H0" and entry == 0:
                continue  # doing nothing is nowhere: what counts is that the other entries are lower
            other = inputs.clone()
            other[0, spec.observation_size + entry] = 1.0
            assert not torch.equal(module(other), module(inputs)), entry


@pytest.mark.parametrize("network", NETWORKS)
def test_doing_nothing_begins_with_the_probability_asked_for(network: str):
    spec = spec_of_task("bus14-T0")
    module = factory(spec, network).make(PER_ACTION, (32, 32), orthogonal(0.01), do_nothing=0.6)
    probabilities = module(observations(spec, 50)).softmax(dim=-1)[:, 0].detach()
    assert float(probabilities.mean()) == pytest.approx(0.6, abs=0.1)


# --- What actions are about -----------------------------------------------------------------------------------------


def test_the_table_tells_kind_place_and_elements_of_every_action():
    task = find_task("bus14-T0")
    grid, table = task.grid, action_table(task_spec(task))
    catalogue, order, places = level_catalogue(grid, 0), element_order(grid), Places.of(grid)
    bounds = [*table.offsets.tolist(), len(table.elements)]
    for action, (kind, target, mask) in enumerate(
        zip(catalogue.kind, catalogue.target, catalogue.masks(), strict=True)
    ):
        assert KINDS[int(table.kinds[action].argmax())] == ActionKind(kind).name.lower()
        expected = {ActionKind.NOTHING: places.nowhere, ActionKind.SWITCH: places.lines + target}.get(kind, target)
        assert table.places[action] == expected
        elements = table.elements[bounds[action] : bounds[action + 1]]
        moved = moved_elements(grid, int(target), mask) if kind == ActionKind.MOVE else np.zeros(0, np.int32)
        assert sorted(elements) == sorted(order[moved])


def test_the_table_tells_controls_and_the_direction_in_which_they_are_moved():
    spec = spec_of_task("bus14-H0", discrete=True)
    table = action_table(spec)
    assert len(table) == spec.action_size
    moves = table.kinds[spec.actions.topology.kind.shape[0] :]  # type: ignore[union-attr]
    up, down = (moves[:, KINDS.index(name)] for name in ("up", "down"))
    assert (up + down == 1).all()
    assert not (up & moves[:, KINDS.index("curtail")]).any(), "a renewable cannot be moved up"
    assert (moves[:, [KINDS.index(name) for name in ("redispatch", "curtail", "storage")]].sum(axis=1) == 1).all()


# --- Messages -------------------------------------------------------------------------------------------------------


def naive_states(network: GraphNetwork, spec: Spec, observation: Tensor) -> NDArray[np.float64]:
    """The states of lines by the equations of the module, one line after the other, float64 [line, width]."""
    grid, messages = spec.grid, network.messages
    assert grid is not None
    elements = network.features(observation.unsqueeze(0))
    second, in_service = elements.second[:, 0].numpy() > 0, elements.in_service[:, 0, 0].numpy() > 0

    def layer(of: Any, values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(of.weight.detach().double() @ torch.from_numpy(values) + of.bias.detach().double())

    def read(of: Any, values: Tensor) -> list[NDArray[np.float64]]:
        return [layer(of, each) for each in values[:, :, 0].double().numpy()]

    subs = np.concatenate((grid.line_or_to_subid, grid.line_ex_to_subid, grid.gen_to_subid, grid.load_to_subid))
    subs = np.concatenate((subs, grid.storage_to_subid))
    n = grid.n_line
    busbar = [(int(sub), bool(on)) for sub, on in zip(subs, second, strict=True)]
    units = read(messages.read_gen, elements.gen) + read(messages.read_load, elements.load)
    if messages.read_storage is not None:
        units += read(messages.read_storage, elements.storage)
    learned = messages.of_line.detach().double().numpy()
    own = [values + learned[line] for line, values in enumerate(read(messages.read_line, elements.line))]
    states = [np.maximum(values, 0.0) for values in own]
    for to_self, to_others in zip(messages.to_self, messages.to_others, strict=True):
        following = []
        for line in range(n):
            heard = np.zeros_like(states[0])
            for end in (line, n + line) if in_service[line] else ():
                at = [states[k % n] for k in range(2 * n) if busbar[k] == busbar[end] and in_service[k % n]]
                at += [units[k - 2 * n] for k in range(2 * n, len(busbar)) if busbar[k] == busbar[end]]
                degree = int((subs[: 2 * n] == subs[end]).sum())
                heard += np.sum(at, axis=0) / np.sqrt(degree)
            following.append(np.maximum(layer(to_self, states[line]) + layer(to_others, heard) + own[line], 0.0))
        states = following
    return np.array(states)


@pytest.mark.parametrize(("task", "split"), [("bus14-T0", 0.2), ("bus36-MO-v0-T0", 0.05), ("bus14-R", 0.0)])
def test_lines_hear_what_the_equations_say(task: str, split: float):
    spec = spec_of_task(task)
    network = factory(spec, "gnn").make(PER_ACTION, (64, 64))
    assert isinstance(network, GraphNetwork)
    shown = observations(spec, 3, split=split)
    with torch.no_grad():
        states = network.messages(network.features(shown)).lines
    for row in range(len(shown)):
        expected = naive_states(network, spec, shown[row])
        np.testing.assert_allclose(states[:, :, row].numpy(), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("task", "output"),
    [
        ("bus14-T0", Output(per_state=1, per_action=2)),
        ("bus14-T0", PER_ACTION),
        ("bus14-H0", VALUE_OF_ACTION),
        ("bus118-MOB-v0-R", VALUE_OF_ACTION),
    ],
)
def test_derivatives_written_by_hand_are_those_of_the_numbers(task: str, output: Output):
    spec = spec_of_task(task)
    network = factory(spec, "gnn").make(output, (16, 16)).double()
    shown = observations(spec, 2, split=0.2).double()
    if output.reads_action:
        generator = torch.Generator().manual_seed(0)
        shown = torch.cat([shown, torch.rand(2, spec.action_size, generator=generator).double()], dim=1)
    shown.requires_grad_()
    mixed = torch.randn(output.width(spec), generator=torch.Generator().manual_seed(0)).double()
    (network(shown) @ mixed).sum().backward()
    # Along random directions of all weights, with the action that is read.
    varied = [each for each in network.parameters() if each.grad is not None]
    generator = torch.Generator().manual_seed(1)
    for _ in range(5):
        directions = [torch.randn(each.shape, generator=generator).double() for each in varied]
        of_shown = torch.zeros_like(shown)
        of_shown[:, spec.observation_size :] = 1.0
        expected = sum(float((each.grad * by).sum()) for each, by in zip(varied, directions, strict=True))
        assert shown.grad is not None
        expected += float((shown.grad * of_shown).sum())
        numbers = []
        for step in (1e-6, -1e-6):
            with torch.no_grad():
                for each, by in zip(varied, directions, strict=True):
                    each.add_(by, alpha=step)
                numbers.append(float((network(shown + step * of_shown) @ mixed).sum()))
                for each, by in zip(varied, directions, strict=True):
                    each.sub_(by, alpha=step)
        assert (numbers[0] - numbers[1]) / 2e-6 == pytest.approx(expected, rel=1e-5)


def test_what_is_far_away_is_not_heard_in_two_rounds():
    spec = spec_of_task("bus36-MO-v0-T0")
    grid = spec.grid
    assert grid is not None
    network = factory(spec, "gnn").make(PER_ACTION, (64, 64))
    assert isinstance(network, GraphNetwork)
    ends = np.stack((grid.line_or_to_subid, grid.line_ex_to_subid))
    near, reached = {0}, set(ends[:, 0].tolist())
    for _ in range(2):
        near |= {k for k in range(grid.n_line) if set(ends[:, k].tolist()) & reached}
        reached |= {int(sub) for k in near for sub in ends[:, k]}
    shown = observations(spec, 1, split=0.0)
    other = shown.clone()
    other[0, spec.feature("rho").begin] += 0.5
    with torch.no_grad():
        states = [network.messages(network.features(each)).lines[:, :, 0].T for each in (shown, other)]
    differ = (states[0] != states[1]).any(dim=0).nonzero().flatten().tolist()
    assert 0 in differ
    assert len(differ) > 1
    assert set(differ) <= near
    assert len(near) < grid.n_line


def test_observations_in_physical_units_say_the_same():
    task = find_task("bus14-T0")
    scaled, raw = spec_of_task("bus14-T0"), task_spec(task, None)
    shown = observations(scaled, 4)
    assert scaled.scale is not None
    assert scaled.shift is not None
    units = shown * torch.tensor(scaled.scale) + torch.tensor(scaled.shift)
    networks = [factory(spec, "gnn").make(PER_ACTION, (32, 32)) for spec in (scaled, raw)]
    torch.testing.assert_close(networks[0](shown), networks[1](units), rtol=1e-4, atol=1e-4)


# --- Shortlist ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("network", ["mlp", *NETWORKS])
@pytest.mark.parametrize(("task", "discrete"), [("bus14-T1", False), ("bus14-T0", False), ("bus14-H0", True)])
def test_what_is_not_on_the_shortlist_is_never_played(network: str, task: str, discrete: bool):
    spec = spec_of_task(task, discrete=discrete)
    made = factory(spec, network, shortlist=7)
    chosen = shortlist(spec, 7)
    module = made.make(Output(per_state=1, per_action=2), (32,), do_nothing=0.6)
    numbers = module(observations(spec, 5))
    assert numbers.shape == (5, 1 + 2 * spec.action_size)
    for part in numbers[:, 1:].chunk(2, dim=1):
        assert ((part == NEVER).sum(dim=1) == spec.action_size - len(chosen)).all()
        assert sorted((part[0] != NEVER).nonzero().flatten().tolist()) == chosen.tolist()
    probabilities = numbers[:, 1 : 1 + spec.action_size].log_softmax(dim=1).exp()
    torch.testing.assert_close(probabilities.sum(dim=1), torch.ones(5))
    assert NetworkFactory.from_state(made.state_dict()).shortlist == 7


def test_the_shortlist_has_the_best_ranked_actions():
    low, all_actions = find_task("bus36-MO-v0-T0"), find_task("bus36-MO-v0-T4")
    chosen = shortlist(task_spec(all_actions), len(level_catalogue(low.grid, 0)))
    catalogue, best = level_catalogue(low.grid, 4), level_catalogue(low.grid, 0)
    named = {(int(catalogue.kind[k]), int(catalogue.target[k]), int(catalogue.mask[k, 0])) for k in chosen}
    assert named == {(int(a), int(b), int(c)) for a, b, c in zip(best.kind, best.target, best.mask[:, 0], strict=True)}
    assert chosen[0] == 0


def test_impossible_shortlists_are_refused():
    with pytest.raises(UsageError, match=r"shortlist=0 is not allowed: choose from 1 to 50"):
        shortlist(spec_of_task("bus14-T0"), 0)
    with pytest.raises(UsageError, match="Only the discrete actions of tasks of rl2grid have a shortlist"):
        factory(spec_of_task("bus14-R"), "mlp", shortlist=5)
    with pytest.raises(UsageError, match="have a shortlist"):
        NetworkFactory(Spec(4, 2, continuous=False), shortlist=2)
