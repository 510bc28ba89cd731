"""Networks as a choice: a user's own, built from what the task is, with every kind of algorithm."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor, nn

import rl2grid
from rl2grid.algorithms import networks
from rl2grid.algorithms.dqn import QNetwork
from rl2grid.algorithms.hyperparameters import identifying
from rl2grid.algorithms.networks import (
    PER_ACTION,
    VALUE,
    VALUE_OF_ACTION,
    Network,
    NetworkFactory,
    Output,
    Request,
    find_network,
    mlp,
    network_names,
    register_network,
)
from rl2grid.algorithms.networks.mlp import Layers, freeze
from rl2grid.algorithms.on_policy import ActorCritic
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.algorithms.sac import CategoricalActor, GaussianActor
from rl2grid.algorithms.td3 import Actor
from rl2grid.dense.choices import NEVER
from rl2grid.envs.registration import register_all
from rl2grid.envs.spec import Spec, task_spec
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import ActionCatalogue
from rl2grid.records.evaluations import identity_hash
from rl2grid.training.request import RunArgs, hyperparameters
from rl2grid.training.runs import make_envs, train

LEDGER = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "baselines.json"


class Lines(nn.Module):
    """A network of a grid in a few lines: every line is read alike, substations sum their lines, and an action is worth
    what its substation or line is.
    """

    def __init__(self, request: Request) -> None:
        super().__init__()
        spec, output = request.spec, request.output
        assert spec.grid is not None
        self.output, width = output, request.layers[0]
        rho = spec.feature("rho")
        self.lines = slice(rho.begin, rho.end)
        self.actions = slice(spec.observation_size, output.inputs(spec))
        self.each = request.style.linear(1, width, last=False, generator=request.generator)
        self.whole = request.style.linear(
            width + output.inputs(spec) - spec.observation_size,
            output.per_state + output.per_action,
            last=True,
            generator=request.generator,
        )
        self.first = nn.Parameter(torch.tensor(request.first_action or 0.0))
        at = torch.zeros(spec.grid.n_sub + spec.grid.n_line, spec.grid.n_line)
        lines = torch.arange(spec.grid.n_line)
        at[torch.as_tensor(spec.grid.line_or_to_subid, dtype=torch.int64), lines] = 1.0
        at[torch.as_tensor(spec.grid.line_ex_to_subid, dtype=torch.int64), lines] = 1.0
        at[spec.grid.n_sub + lines, lines] = 1.0
        places = np.zeros(spec.action_size, np.int64)
        if isinstance(spec.actions, ActionCatalogue):
            places = spec.actions.target + np.where(spec.actions.kind == 2, spec.grid.n_sub, 0)
        self.register_buffer("lines_of_action", at[torch.as_tensor(places)], persistent=False)

    def forward(self, inputs: Tensor) -> Tensor:
        each = self.each(inputs[..., self.lines].unsqueeze(-1)).relu()
        whole = self.whole(torch.cat([each.sum(dim=-2), inputs[..., self.actions]], dim=-1))
        if not self.output.per_action:
            return whole
        acted_on = self.lines_of_action @ each
        if self.actions.stop > self.actions.start:
            raise AssertionError("numbers of actions are not asked for where an action is read")
        per_action = self.whole(acted_on)[..., self.output.per_state :]
        preferred = torch.zeros(per_action.shape[-2:])
        preferred[0, 0] = 1.0
        per_action = per_action + self.first * preferred
        return torch.cat([whole[..., : self.output.per_state], per_action.transpose(-1, -2).flatten(-2)], dim=-1)


@pytest.fixture(autouse=True)
def lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one line of a user."""
    monkeypatch.setattr(networks, "_ADDED", {})
    register_network(Network("lines", Lines, reads_normalized=False, needs_grid=True))


def args(algorithm: str, task: str, **changes: Any) -> Any:
    small = {"total_timesteps": 4 * 8 * 6, "num_envs": 4, "num_steps": 8, "network": "lines"}
    off_policy = {"learning_starts": 40, "batch_size": 16, "buffer_bytes": 2**20}
    own = off_policy if algorithm in ("dqn", "sac", "td3") else {}
    return hyperparameters(algorithm, task, **{**small, **own, "normalize_observations": False, **changes})


@pytest.mark.parametrize(
    ("algorithm", "task"),
    [("ppo", "bus14-T0"), ("dqn", "bus14-T0"), ("sac", "bus14-T0"), ("sac", "bus14-R"), ("ppo", "bus14-R")],
)
def test_a_network_of_ones_own_is_trained_saved_and_played(algorithm: str, task: str, tmp_path: Path):
    chosen = args(algorithm, task)
    folder = train(
        RunArgs(task, chosen, algorithm, tmp_path / "run", validation_months=0, tensorboard=False, progress=False)
    )
    request = RunArgs(task, chosen, algorithm, env_keywords={})
    envs = make_envs(request)
    begun = find_algorithm(algorithm).trainer(chosen, envs).policy()[0]  # type: ignore[attr-defined]
    envs.close()
    agent = rl2grid.load(folder)
    layers = [module for module in agent._network.modules() if isinstance(module, Lines)]
    assert layers, "another network was made"
    moved = [
        name
        for name, tensor in begun.state_dict().items()
        if not torch.equal(tensor, agent._network.state_dict()[name]) and name.endswith("weight")
    ]
    assert any("each.weight" in name for name in moved)
    env = gymnasium.make(f"rl2grid/{task}-v0")
    agent.bind(env)
    observation, info = env.reset(seed=3)
    agent.reset(0)
    for _ in range(5):
        observation, _, terminated, truncated, info = env.step(agent.act(observation, info))
        if terminated or truncated:
            break
    env.close()


def test_observations_that_it_cannot_read_and_tasks_without_grid_are_refused():
    register_all()
    envs = make_envs(RunArgs("bus14-T0", args("ppo", "bus14-T0"), "ppo"))
    with pytest.raises(UsageError, match=r"'lines' reads observations as .*: set normalize_observations to False"):
        find_algorithm("ppo").trainer(args("ppo", "bus14-T0", normalize_observations=True), envs)
    with pytest.raises(
        UsageError, match="'transformer' does not exist: choose one of mlp, action-embedding, gnn, set-point, lines"
    ):
        find_algorithm("ppo").trainer(args("ppo", "bus14-T0", network="transformer"), envs)
    envs.close()
    cartpole = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.make("CartPole-v1")] * 4, autoreset_mode=AutoresetMode.SAME_STEP
    )
    with pytest.raises(UsageError, match="'lines' is for tasks of rl2grid: this environment has no grid"):
        find_algorithm("ppo").trainer(args("ppo", "bus14-T0", mask_actions=False), cartpole)


def test_names_are_given_once():
    assert network_names() == ("mlp", "action-embedding", "gnn", "set-point", "lines")
    register_network(Network("lines", Lines, reads_normalized=False, needs_grid=True))
    with pytest.raises(UsageError, match="'lines' exists already"):
        register_network(Network("lines", Lines))
    with pytest.raises(UsageError, match="'mlp' exists already"):
        register_network(Network("mlp", Lines))


def test_installed_packages_offer_theirs(monkeypatch: pytest.MonkeyPatch):
    theirs = Network("theirs", Lines)
    points = [SimpleNamespace(name="theirs", load=lambda: theirs), SimpleNamespace(name="wrong", load=lambda: Lines)]
    monkeypatch.setattr(networks, "entry_points", lambda group: points if group == "rl2grid.networks" else [])
    monkeypatch.setattr(networks, "_installed", networks._installed.__wrapped__)
    assert network_names() == ("mlp", "action-embedding", "gnn", "set-point", "theirs", "wrong", "lines")
    assert find_network("theirs") is theirs
    with pytest.raises(UsageError, match="'wrong' is offered by an entry point that is no Network"):
        find_network("wrong")


# --- What is asked for ----------------------------------------------------------------------------------------------

SPEC = Spec(5, 3, continuous=False)


@pytest.mark.parametrize(
    ("output", "inputs", "width"),
    [(VALUE, 5, 1), (PER_ACTION, 5, 3), (VALUE_OF_ACTION, 8, 1), (Output(1, 1), 5, 4), (Output(per_action=2), 5, 6)],
)
def test_the_mlp_gives_the_numbers_asked_for(output: Output, inputs: int, width: int):
    network = NetworkFactory(SPEC, generator=torch.Generator().manual_seed(0)).make(output, (7,))
    assert network(torch.zeros(2, inputs)).shape == (2, width)
    assert [tuple(p.shape) for p in network.parameters()] == [(7, inputs), (7,), (width, 7), (width,)]


def test_doing_nothing_has_the_probability_asked_for():
    factory = NetworkFactory(Spec(5, 40, continuous=False), generator=torch.Generator().manual_seed(0))
    network = factory.make(PER_ACTION, (), networks.orthogonal(0.01), do_nothing=0.6)
    probabilities = network(torch.zeros(1, 5)).softmax(dim=-1)[0].detach()
    assert float(probabilities[0]) == pytest.approx(0.6, abs=1e-5)
    assert float(probabilities[1:].max()) == pytest.approx(0.4 / 39, abs=1e-5)


def test_a_factory_comes_back_from_plain_values():
    factory = NetworkFactory(task_spec(find_task("bus14-T0")), "lines", torch.Generator())
    again = NetworkFactory.from_state(json.loads(json.dumps(factory.state_dict())))
    assert (again.name, again.spec.grid, again.generator) == ("lines", factory.spec.grid, None)


@pytest.mark.parametrize("name", ["mlp", "gnn", "action-embedding"])
def test_weights_for_all_actions_of_a_level_fit_a_shortlist_of_them(name: str):
    lower, higher = (task_spec(find_task(task)) for task in ("bus36-M-T0", "bus36-M-T1"))
    first = NetworkFactory(lower, name, torch.Generator().manual_seed(0)).make(Output(1, 1), (8,))
    then = NetworkFactory(higher, name, torch.Generator().manual_seed(1), 50).make(Output(1, 1), (8,))
    then.load_state_dict(first.state_dict())
    inputs = torch.randn(3, lower.observation_size, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        numbers, of_shortlist = first(inputs), then(inputs)
    assert of_shortlist.shape == (3, 1 + higher.action_size)
    assert torch.equal(of_shortlist[:, :51], numbers)
    assert (of_shortlist[:, 51:] == NEVER).all()


def test_weights_do_not_come_from_the_global_random_state():
    weights = []
    before = torch.get_rng_state()
    for _ in range(2):
        network = NetworkFactory(SPEC, generator=torch.Generator().manual_seed(3)).make(PER_ACTION, (7,))
        weights.append(nn.utils.parameters_to_vector(network.parameters()))
    assert torch.equal(*weights)
    assert torch.equal(torch.get_rng_state(), before)


# --- What identifies a training -------------------------------------------------------------------------------------


def entries_without_a_network() -> list[tuple[str, dict[str, Any]]]:
    """Trainings whose hyperparameters name none: an ``mlp`` is left out of what identifies them."""
    ledger = json.loads(LEDGER.read_text(encoding="utf-8"))
    trained = [(digest, entry) for digest, entry in ledger.items() if "algorithm" in entry["configuration"]]
    return [(digest, entry) for digest, entry in trained if "network" not in entry["configuration"]["hyperparameters"]]


def tuples(values: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


@pytest.mark.parametrize(
    ("digest", "entry"), entries_without_a_network(), ids=lambda part: part if isinstance(part, str) else ""
)
def test_a_result_from_before_networks_could_be_chosen_is_found_again(digest: str, entry: dict[str, Any]):
    configuration = entry["configuration"]
    make: Callable[..., Any] = find_algorithm(configuration["algorithm"]).args
    now = make(**tuples(configuration["hyperparameters"]))
    assert now.network == "mlp"
    assert identity_hash({**configuration, "hyperparameters": identifying(now)}) == digest
    other = identity_hash({**configuration, "hyperparameters": identifying(replace(now, network="lines"))})
    assert other != digest


def test_tanh_and_its_gradient_are_those_of_pytorch():
    inputs = torch.linspace(-12.0, 12.0, 4001, requires_grad=True)
    outputs = mlp.Layers(nn.Tanh())(inputs)
    expected = torch.tanh(inputs)
    torch.testing.assert_close(outputs, expected, rtol=0.0, atol=2e-7)
    (mine,), (theirs,) = (torch.autograd.grad(each.square().sum(), inputs) for each in (outputs, expected))
    torch.testing.assert_close(mine, theirs, rtol=0.0, atol=1e-6)
    with torch.no_grad():
        assert torch.equal(mlp.Layers(nn.Tanh())(inputs), outputs)


@pytest.mark.parametrize("shape", [(7, 3), (3, 7), (5, 5)])
def test_orthogonal_weights_are_orthogonal_and_scaled(shape):
    layer = networks.orthogonal(0.3).linear(*shape, last=False, generator=torch.Generator().manual_seed(0))
    weight = layer.weight.detach().double()
    product = weight @ weight.T if len(weight) <= len(weight.T) else weight.T @ weight
    torch.testing.assert_close(product, 2.0 * torch.eye(min(shape), dtype=torch.float64), rtol=0, atol=1e-6)
    assert float(layer.bias.detach().abs().sum()) == 0.0


def test_orthogonal_weights_are_drawn_evenly():
    """Without the signs of the triangular factor, the first weight of a row of two would always be negative."""
    generator = torch.Generator().manual_seed(0)
    style = networks.orthogonal(1.0)
    first = torch.stack([style.linear(2, 2, last=True, generator=generator).weight[0, 0] for _ in range(400)])
    assert abs(float((first > 0).float().mean()) - 0.5) < 0.1


def test_layers_may_be_exchanged_and_of_other_kinds():
    """Compiled code or not, they are what PyTorch would give."""
    mixed = [nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 5), nn.GELU(), nn.Linear(5, 2)]
    inputs = torch.randn(6, 3)
    layers = Layers(*mixed)
    torch.testing.assert_close(layers(inputs), nn.Sequential(*mixed)(inputs))
    layers[3] = nn.ReLU()
    layers[0] = nn.Linear(3, 4)
    torch.testing.assert_close(layers(inputs), nn.Sequential(*layers)(inputs))
    torch.testing.assert_close(layers(inputs.view(2, 3, 3)), layers(inputs).view(2, 3, 2))


@pytest.mark.parametrize("batch", [1, 3, 70])
def test_frozen_layers_give_the_same_bits_and_learn_no_more(batch: int):
    layers = Layers(nn.Linear(37, 40), nn.Tanh(), nn.Linear(40, 65), nn.ReLU(), nn.Linear(65, 3))
    inputs = torch.randn(batch, 37)
    with torch.no_grad():
        before = layers(inputs)
        mlp.freeze(nn.ModuleList([nn.Identity(), layers]))
        assert torch.equal(layers(inputs), before)
        assert torch.equal(layers(inputs.unsqueeze(1)), before.unsqueeze(1))
        assert torch.equal(layers(torch.cat([inputs, inputs], dim=1)[:, :37]), before)
        layers[0].weight.zero_()
        assert torch.equal(layers(inputs), before)
    mixed = Layers(nn.Linear(3, 4), nn.GELU())
    expected = mixed(torch.ones(1, 3))
    mixed.freeze()
    with torch.no_grad():
        assert torch.equal(mixed(torch.ones(1, 3)), expected)


@pytest.mark.parametrize(
    ("name", "task", "shortlist"),
    [
        ("mlp", "bus14-T0", None),
        ("mlp", "bus14-T0", 20),
        ("mlp", "bus36-M-R", None),
        ("set-point", "bus36-M-R", None),
    ],
)
def test_policies_whose_network_says_so_decide_the_same_beside_others(name: str, task: str, shortlist: int | None):
    spec = task_spec(find_task(task))
    assert find_network(name).row_by_row

    def factory() -> NetworkFactory:
        return NetworkFactory(spec, name, torch.Generator().manual_seed(1), shortlist)

    layers: dict[str, Any] = {"layers": (64, 64)}
    policies: list[Any] = [ActorCritic(factory(), actor_layers=(64, 64), critic_layers=(8,))]
    if spec.continuous:
        policies.append(Actor(factory(), **layers))
        policies += [GaussianActor(factory(), **layers)] if name == "mlp" else []
    else:
        policies += [CategoricalActor(factory(), **layers), QNetwork(factory(), **layers)]
        policies += [QNetwork(factory(), head="dueling", **layers)] if shortlist is None else []
    observations = torch.randn(33, spec.observation_size, generator=torch.Generator().manual_seed(2))
    masks = None if spec.continuous else torch.ones(33, spec.action_size, dtype=torch.bool)
    for policy in policies:
        freeze(policy)
        say = policy.act if spec.continuous else lambda rows, legal, _, policy=policy: policy.preferences(rows, legal)
        with torch.no_grad():
            together = say(observations, masks, None)
            alone = [say(observations[k : k + 1], None if masks is None else masks[k : k + 1], None) for k in range(33)]
        assert torch.equal(together, torch.cat(alone)), type(policy).__name__


@pytest.mark.parametrize("frozen", [True, False])
@pytest.mark.parametrize(("name", "shortlist"), [("mlp", None), ("mlp", 20), ("gnn", None), ("gnn", 20)])
def test_scores_are_what_tensors_say(name: str, shortlist: int | None, frozen: bool):
    spec = task_spec(find_task("bus14-T0"))

    def factory() -> NetworkFactory:
        return NetworkFactory(spec, name, torch.Generator().manual_seed(1), shortlist)

    draws = torch.Generator().manual_seed(2)
    observations = torch.randn(5, spec.observation_size, generator=draws)
    masks = torch.rand(5, spec.action_size, generator=draws) < 0.7
    policies: list[Any] = [ActorCritic(factory(), actor_layers=(32, 24), critic_layers=(8,))]
    policies += [CategoricalActor(factory(), (32, 24)), QNetwork(factory(), (32, 24))]
    policies += [QNetwork(factory(), (32,), count=2)]
    policies += [QNetwork(factory(), (32,), head="dueling")] if shortlist is None else []
    for policy in policies:
        if frozen:
            freeze(policy)
        with torch.no_grad():
            preferences = policy.preferences(observations, masks)
        scores = policy.scores(observations.numpy(), masks.numpy())
        assert scores.dtype == np.float32
        said = torch.from_numpy(scores)
        assert torch.equal(said.exp() if policy.preference == "probability" else said, preferences), type(policy)


def test_networks_of_ones_own_are_not_taken_for_such():
    assert not Network("own", Lines).row_by_row
    assert not any(find_network(name).row_by_row for name in ("gnn", "action-embedding"))


def test_second_derivatives_are_refused():
    inputs = torch.randn(6, 3, requires_grad=True)
    layers = Layers(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1))
    (first,) = torch.autograd.grad(layers(inputs).sum(), inputs, create_graph=True)
    with pytest.raises(RuntimeError, match="does not require grad"):
        torch.autograd.grad(first.sum(), inputs)
