"""Double DQN: targets, losses and schedules against values computed by hand; and it finds known values.

Stable-Baselines3, an alternative reference, is no dependency: everything here is computed independently of the package.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from specs import networks
from torch import Tensor
from toy_grid import ToyGrid
from toy_tasks import Chain, vector

from rl2grid.algorithms.dqn import DQN, Args, QNetwork, best_actions, loss, preset, targets
from rl2grid.algorithms.off_policy import Batch
from rl2grid.errors import UsageError

SMALL = Args(seed=3, total_timesteps=1000, num_envs=4, num_steps=5, learning_starts=20, batch_size=8, layers=(8,))


class Table(QNetwork):
    """Values as given, whatever is observed."""

    def __init__(self, values: list[list[float]]) -> None:
        super().__init__(networks(1, len(values[0])), ())
        self.values = torch.tensor(values)

    def forward(self, observations: Tensor) -> Tensor:
        return self.values


def batch(**changes: Any) -> Batch:
    return Batch(
        observations=torch.zeros(3, 1),
        masks=None,
        actions=torch.tensor([0, 1, 2]),
        rewards=torch.tensor([1.0, 2.0, 3.0]),
        discounts=torch.tensor([0.9, 0.9**3, 0.0]),
        next_observations=torch.zeros(3, 1),
        next_masks=None,
    )._replace(**changes)


ONLINE = Table([[1.0, 5.0, 2.0], [7.0, 0.0, 1.0], [0.0, 0.0, 9.0]])
OLD = Table([[10.0, 20.0, 30.0], [40.0, 50.0, 60.0], [70.0, 80.0, 90.0]])


def test_the_online_network_chooses_and_the_old_one_says_what_it_is_worth():
    # The online network prefers actions 1, 0, 2. The third transition ended in a game over.
    expected = [1.0 + 0.9 * 20.0, 2.0 + 0.9**3 * 40.0, 3.0]
    assert targets(ONLINE, OLD, batch()).tolist() == pytest.approx(expected)


def test_illegal_actions_are_not_chosen_in_targets():
    masks = torch.tensor([[True, False, True], [False, True, True], [True, False, False]])
    # Of the legal ones, the online network prefers 2, 2, 0.
    expected = [1.0 + 0.9 * 30.0, 2.0 + 0.9**3 * 60.0, 3.0]
    assert targets(ONLINE, OLD, batch(next_masks=masks)).tolist() == pytest.approx(expected)


def test_legal_actions_are_best_even_if_their_values_are_very_negative():
    values = torch.tensor([[-1e6, 5.0, -2e6]])
    assert int(best_actions(values, torch.tensor([[True, False, True]]))) == 0
    assert int(best_actions(values, None)) == 1


def test_targets_carry_no_gradient():
    network = QNetwork(networks(1, 3), (4,))
    assert not targets(network, network, batch()).requires_grad


def test_losses_by_hand():
    values, aims = torch.tensor([0.0, 1.0, 5.0]), torch.tensor([0.5, 1.0, 2.0])
    assert float(loss(values, aims, None)) == pytest.approx((0.25 + 0.0 + 9.0) / 3)
    # Beyond 1, 2 |e| - 1 instead of e squared.
    assert float(loss(values, aims, 1.0)) == pytest.approx((0.25 + 0.0 + 5.0) / 3)
    assert float(loss(values, aims, 2.0)) == pytest.approx((0.25 + 0.0 + 2.0 * (6.0 - 2.0)) / 3)


def test_a_dueling_head_adds_advantages_without_their_mean_to_the_value_of_the_state():
    network = QNetwork(networks(1, 3), (), head="dueling")
    (layer,) = network.networks[0]
    with torch.no_grad():
        layer.weight[:] = torch.tensor([[1.0], [0.0], [2.0], [4.0]])
        layer.bias[:] = torch.tensor([10.0, 3.0, 0.0, 0.0])
    # At observation 1: V = 11, A = (3, 2, 4), whose mean is 3.
    assert network(torch.tensor([[1.0]])).tolist() == [[11.0, 10.0, 12.0]]


def test_of_several_networks_the_least_value_counts():
    network = QNetwork(networks(1, 2), (), count=2)
    with torch.no_grad():
        for (layer,), biases in zip(network.networks, ([1.0, 5.0], [3.0, 2.0]), strict=True):
            layer.weight[:] = 0.0
            layer.bias[:] = torch.tensor(biases)
    observations = torch.zeros(3, 1)
    assert network.each(observations)[:, 0].tolist() == [[1.0, 5.0], [3.0, 2.0]]
    assert network(observations).tolist() == [[1.0, 2.0]] * 3
    assert network.act(observations, None, None).tolist() == [1, 1, 1]
    following = batch(actions=torch.zeros(3, dtype=torch.int64))
    assert targets(network, network, following).tolist() == pytest.approx([1.0 + 0.9 * 2.0, 2.0 + 0.9**3 * 2.0, 3.0])


def test_several_networks_learn_independently_from_one_target():
    dqn = DQN(replace(SMALL, networks=2, huber_delta=None), ToyGrid(4))
    transitions = batch(observations=torch.randn(3, 4), next_observations=torch.randn(3, 4))
    aims = targets(dqn.network, dqn.target, transitions)
    before = dqn.network.each(transitions.observations).detach()
    expected = sum(float(((each[range(3), range(3)] - aims) ** 2).mean()) for each in before)
    metrics = dqn.learn(transitions)
    assert float(metrics["losses/qf_loss"].detach()) == pytest.approx(expected, rel=1e-5)
    first, second = (network[-1].weight for network in dqn.network.networks)
    assert not torch.equal(first, second)


def test_only_the_values_of_actions_played_are_moved():
    dqn = DQN(replace(SMALL, huber_delta=None), ToyGrid(4))
    transitions = Batch(
        observations=torch.randn(1, 4),
        masks=None,
        actions=torch.tensor([2]),
        rewards=torch.tensor([1.0]),
        discounts=torch.tensor([0.0]),
        next_observations=torch.randn(1, 4),
        next_masks=None,
    )
    before = float(dqn.network(transitions.observations)[0, 2].detach())
    metrics = dqn.learn(transitions)
    assert float(metrics["losses/qf_loss"].detach()) == pytest.approx((before - 1.0) ** 2, rel=1e-5)
    assert float(metrics["losses/qf_values"].detach()) == pytest.approx(before)
    gradient = dqn.network.networks[0][-1].bias.grad
    assert gradient.tolist() == pytest.approx([0.0, 0.0, 2.0 * (before - 1.0)], rel=1e-5)


def test_epsilon_falls_linearly_in_decisions_and_stays():
    dqn = DQN(replace(SMALL, first_epsilon=0.9, last_epsilon=0.1, epsilon_decay_fraction=0.5), ToyGrid(4))
    for decisions, expected in ((0, 0.9), (125, 0.7), (250, 0.5), (500, 0.1), (900, 0.1)):
        dqn.decisions = decisions
        assert dqn.epsilon == pytest.approx(expected)
    dqn = DQN(replace(SMALL, epsilon_decay_fraction=0.0), ToyGrid(4))
    assert dqn.epsilon == pytest.approx(0.05)


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_random_actions_are_as_frequent_as_epsilon_says(epsilon: float):
    dqn = DQN(replace(SMALL, first_epsilon=epsilon, last_epsilon=epsilon), ToyGrid(4))
    with torch.no_grad():
        dqn.network.networks[0][-1].bias[2] = 100.0
        dqn.network.networks[0][-1].bias[1] = 200.0
    masks = torch.tensor([[True, False, True]]).expand(20_000, 3)
    shares = dqn.explore(torch.zeros(20_000, 4), masks).bincount(minlength=3) / 20_000
    np.testing.assert_allclose(shares, [epsilon / 2, 0.0, 1.0 - epsilon / 2], atol=0.015)


def test_the_target_network_is_renewed_when_decisions_pass_its_frequency():
    dqn = DQN(replace(SMALL, target_frequency=50, train_frequency=1), ToyGrid(4))
    changed = []
    for _ in range(10):  # 20 decisions each
        before = [parameter.clone() for parameter in dqn.target.parameters()]
        dqn.iterate()
        after = list(dqn.target.parameters())
        changed.append(any(not torch.equal(one, other) for one, other in zip(before, after, strict=True)))
    # 50, 100, 150, 200 are passed in iterations 3, 5, 8 and 10.
    assert [k + 1 for k, change in enumerate(changed) if change] == [3, 5, 8, 10]


def test_the_preset_paper_is_the_papers_table():
    args = preset("paper", continuous=False)
    assert args.train_frequency == 50
    assert args.target_frequency == 5_000
    assert args.buffer_size == 1_000_000
    assert args.learning_rate == 3e-4
    assert args.epsilon_decay_fraction == 0.5


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"learning_rate": 0.0}, "positive learning_rate"),
        ({"target_frequency": 0}, "target_frequency of at least 1"),
        ({"layers": (8, 0)}, "layers of widths of at least 1"),
        ({"last_epsilon": 1.5}, "last_epsilon between 0 and 1"),
        ({"huber_delta": -1.0}, "positive huber_delta"),
        ({"exploration_do_nothing": math.nan}, "exploration_do_nothing between 0 and 1"),
    ],
)
def test_values_that_cannot_work_are_refused(changes: dict[str, Any], sentence: str):
    with pytest.raises(UsageError, match=f"DQN needs .*{sentence}"):
        replace(SMALL, **changes)


def test_the_values_of_a_chain_are_found():
    """Q(s, right) = gamma^(4 - s), also though episodes are given up after 15 steps, which ends nothing."""
    args = Args(
        seed=1,
        total_timesteps=6_400,
        num_envs=8,
        learning_starts=400,
        train_frequency=4,
        batch_size=64,
        gamma=0.8,
        reward_scale=1.0,
        target_frequency=200,
        learning_rate=2e-3,
        last_epsilon=0.3,
        mask_actions=False,
        normalize_observations=False,
        layers=(32,),
    )
    dqn = DQN(args, vector(Chain, 8))
    while not dqn.finished:
        dqn.iterate()
    with torch.no_grad():
        values = dqn.network(torch.eye(5))
    right = [0.8 ** (4 - s) for s in range(5)]
    left = [0.8 * right[max(s - 1, 0)] for s in range(5)]
    np.testing.assert_allclose(values, np.stack([left, right], axis=1), atol=0.05)


@pytest.mark.slow
def test_the_toy_grid_is_kept_alive():
    args = replace(SMALL, total_timesteps=16_000, num_envs=8, num_steps=64, learning_starts=512, layers=(32,))
    args = replace(args, learning_rate=1e-3, batch_size=64, target_frequency=500)
    dqn = DQN(args, ToyGrid(8))
    survival = []
    while not dqn.finished:
        survival.append(dqn.iterate()["charts/survival"])
    # One episode in ten is lost inside reset, with survival 0.
    assert np.mean(survival[:2]) < 0.7
    assert np.mean(survival[-5:]) > 0.82
