"""TD3: targets, losses and delays against values computed by hand; and it finds a known optimum."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from specs import networks
from torch import Tensor
from toy_grid import ToyGrid
from toy_tasks import Follow, vector

from rl2grid.algorithms.off_policy import Batch, TwinCritics
from rl2grid.algorithms.td3 import TD3, Actor, Args, critic_loss, preset, targets
from rl2grid.errors import UsageError

SMALL = Args(
    seed=3,
    total_timesteps=1000,
    num_envs=4,
    num_steps=5,
    learning_starts=20,
    batch_size=8,
    actor_layers=(8,),
    critic_layers=(8,),
)


class Fixed(Actor):
    """Actions as given, whatever is observed."""

    def __init__(self, actions: list[list[float]]) -> None:
        super().__init__(networks(1, len(actions[0]), continuous=True), ())
        self.actions = torch.tensor(actions)

    def forward(self, observations: Tensor) -> Tensor:
        return self.actions


class Sums(TwinCritics):
    """Q_1 = sum of the action, Q_2 = 1 - 2 sum of the action."""

    def __init__(self) -> None:
        super().__init__(networks(1, 2, continuous=True), ())

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        total = actions.sum(dim=-1)
        return torch.stack([total, 1.0 - 2.0 * total])


def test_targets_by_hand():
    batch = Batch(
        observations=torch.zeros(3, 1),
        masks=None,
        actions=torch.zeros(3, 2),
        rewards=torch.tensor([1.0, 2.0, 3.0]),
        discounts=torch.tensor([0.9, 0.9**3, 0.0]),
        next_observations=torch.zeros(3, 1),
        next_masks=None,
    )
    actor = Fixed([[0.2, -0.3], [0.8, 0.9], [0.0, 0.0]])
    noise = torch.tensor([[0.1, -2.0], [0.5, 0.05], [0.0, 0.0]])
    # Noise clipped to 0.4: actions 0.3, -0.7 and 1.2, 0.95, the former clipped to 1: sums -0.4 and 1.95.
    expected = [1.0 + 0.9 * min(-0.4, 1.8), 2.0 + 0.9**3 * min(1.95, -2.9), 3.0]
    aims = targets(actor, Sums(), batch, noise, 0.4)
    assert aims.tolist() == pytest.approx(expected)
    assert not aims.requires_grad


def test_the_critics_loss_by_hand():
    values = torch.tensor([[1.0, 2.0], [0.0, 4.0]])
    assert float(critic_loss(values, torch.tensor([2.0, 2.0]))) == pytest.approx((1.0 + 0.0) / 2 + (4.0 + 4.0) / 2)


def test_the_critics_differ_and_their_first_is_the_first():
    critics = TwinCritics(networks(3, 2, continuous=True), (4,))
    observations, actions = torch.randn(6, 3), torch.randn(6, 2)
    values = critics(observations, actions)
    assert values.shape == (2, 6)
    assert not torch.allclose(values[0], values[1])
    assert torch.equal(critics.first(observations, actions), values[0])


@pytest.mark.parametrize("frequency", [1, 2, 3])
def test_policy_and_slow_copies_are_updated_with_delay(frequency: int):
    td3 = TD3(replace(SMALL, policy_frequency=frequency, total_timesteps=1000), ToyGrid(4, continuous=True))
    moved = []
    for _ in range(2):
        td3.iterate()
    for _ in range(6):
        names = ("actor", "slow_actor", "slow_critics", "critics")
        before = {name: [p.clone() for p in getattr(td3, name).parameters()] for name in names}
        td3.updates += 1
        td3.learn(td3.minibatch())
        change = {
            name: any(not torch.equal(a, b) for a, b in zip(before[name], getattr(td3, name).parameters(), strict=True))
            for name in names
        }
        assert change["critics"]
        assert change["actor"] == change["slow_actor"] == change["slow_critics"]
        moved.append((td3.updates, change["actor"]))
    assert all(change == (k % frequency == 0) for k, change in moved)


def test_exploration_is_noise_around_the_policy_within_bounds():
    td3 = TD3(replace(SMALL, exploration_noise=0.2, learning_starts=0), ToyGrid(4, continuous=True))
    observations = torch.zeros(20_000, 4)
    with torch.no_grad():
        mean = td3.actor(observations)[0]
        played = td3.explore(observations, None)
        td3.actor.network[-1].bias[:] = 5.0
        extreme = td3.explore(observations, None)
    np.testing.assert_allclose(played.mean(0), mean, atol=0.01)
    np.testing.assert_allclose(played.std(0), [0.2, 0.2], rtol=0.03)
    assert float(extreme.max()) == 1.0


def test_actions_are_uniform_before_it_learns():
    td3 = TD3(SMALL, ToyGrid(4, continuous=True))
    played = td3.explore(torch.zeros(20_000, 4), None)
    np.testing.assert_allclose(played.mean(0), [0.0, 0.0], atol=0.02)
    np.testing.assert_allclose(played.std(0), np.full(2, 1 / np.sqrt(3)), rtol=0.02)
    assert float(played.abs().max()) <= 1.0


def test_the_preset_paper_is_the_papers_table():
    args = preset("paper", continuous=True)
    assert args.actor_learning_rate == args.critic_learning_rate == 3e-5
    assert args.buffer_size == 1_000_000
    assert (args.tau, args.policy_frequency) == (0.005, 2)
    assert (args.policy_noise, args.noise_clip, args.exploration_noise) == (0.2, 0.5, 0.1)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"tau": 0.0}, "positive tau"),
        ({"tau": 1.5}, "tau between 0 and 1"),
        ({"actor_layers": (-3,)}, "actor_layers of widths of at least 1"),
        ({"critic_layers": (8, 0)}, "critic_layers of widths of at least 1"),
        ({"policy_frequency": 0}, "policy_frequency of at least 1"),
        ({"exploration_noise": -0.1}, "exploration_noise of at least 0"),
    ],
)
def test_values_that_cannot_work_are_refused(changes: dict[str, Any], sentence: str):
    with pytest.raises(UsageError, match=f"TD3 needs .*{sentence}"):
        replace(SMALL, **changes)


def test_the_best_action_is_found():
    args = Args(
        seed=1,
        total_timesteps=3_200,
        num_envs=8,
        learning_starts=200,
        train_frequency=2,
        batch_size=64,
        reward_scale=1.0,
        actor_learning_rate=2e-3,
        critic_learning_rate=2e-3,
        tau=0.05,
        normalize_observations=False,
        actor_layers=(32,),
        critic_layers=(32, 32),
    )
    td3 = TD3(args, vector(Follow, 8))
    while not td3.finished:
        td3.iterate()
    shown = torch.linspace(-0.7, 0.7, 15).unsqueeze(-1)
    with torch.no_grad():
        np.testing.assert_allclose(td3.actor(shown), shown, atol=0.15)


@pytest.mark.slow
def test_the_toy_grid_is_kept_alive():
    args = replace(SMALL, total_timesteps=16_000, num_envs=8, num_steps=64, learning_starts=512, batch_size=64)
    td3 = TD3(replace(args, actor_layers=(32,), critic_layers=(32,)), ToyGrid(8, continuous=True))
    survival = []
    while not td3.finished:
        survival.append(td3.iterate()["charts/survival"])
    assert np.mean(survival[:2]) < 0.7
    assert np.mean(survival[-5:]) > 0.82
