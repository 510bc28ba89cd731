"""SAC: densities, soft values and the temperature against independent values; and it finds known policies."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from specs import networks
from torch import Tensor
from torch.distributions import Normal, TanhTransform, TransformedDistribution
from toy_grid import ToyGrid
from toy_tasks import Arms, Follow, vector

from rl2grid.algorithms.off_policy import Batch, TwinCritics
from rl2grid.algorithms.sac import (
    SAC,
    Args,
    CategoricalActor,
    ContinuousObjective,
    DiscreteObjective,
    GaussianActor,
    TwinActionCritics,
    critic_loss,
    preset,
    squashed_log_densities,
    temperature_loss,
)
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
SMALL_CONTINUOUS = replace(SMALL, mask_actions=False)
BOTH = pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])


def trainer(continuous: bool, **changes: Any) -> SAC:
    return SAC(replace(SMALL_CONTINUOUS if continuous else SMALL, **changes), ToyGrid(4, continuous=continuous))


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


# --- Squashed Gaussians ---------------------------------------------------------------------------------------------


def test_log_densities_are_those_of_torch():
    means, log_stds = random(200, 3).double(), 0.5 * random(200, 3, seed=1).double() - 1.0
    unsquashed = means + log_stds.exp() * random(200, 3, seed=2).double()
    reference = TransformedDistribution(Normal(means, log_stds.exp()), [TanhTransform(cache_size=1)])
    actions = unsquashed.tanh()
    expected = Normal(means, log_stds.exp()).log_prob(unsquashed) - TanhTransform().log_abs_det_jacobian(
        unsquashed, actions
    )
    mine = squashed_log_densities(unsquashed, means, log_stds)
    torch.testing.assert_close(mine, expected.sum(-1), rtol=1e-12, atol=1e-12)
    # From the actions alone, whose inverse is inexact near the bounds.
    inner = actions.abs().amax(-1) < 0.999
    torch.testing.assert_close(mine[inner], reference.log_prob(actions).sum(-1)[inner], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("mean", "std"), [(0.0, 0.3), (0.8, 1.0), (-1.5, 0.5), (0.0, 2.0)])
def test_log_densities_are_those_of_a_change_of_variables(mean: float, std: float):
    """The density integrates to the probability between its bounds, and is the slope of the distribution function."""
    actions = torch.linspace(-1.0, 1.0, 400_001, dtype=torch.float64)[1:-1]
    means, log_stds = torch.full((1,), mean).double(), torch.full((1,), math.log(std)).double()
    density = squashed_log_densities(actions.atanh().unsqueeze(-1), means, log_stds).exp()
    distribution = Normal(means, log_stds.exp()).cdf
    probability = float(distribution(actions[-1].atanh()) - distribution(actions[0].atanh()))
    assert probability > 0.99
    assert float(torch.trapezoid(density, actions)) == pytest.approx(probability, abs=1e-4)
    inner = actions[2000:-2000:5000]
    step = 1e-6
    slope = (distribution((inner + step).atanh()) - distribution((inner - step).atanh())) / (2 * step)
    mine = squashed_log_densities(inner.atanh().unsqueeze(-1), means, log_stds).exp()
    torch.testing.assert_close(mine, slope, rtol=1e-4, atol=1e-6)


def test_log_densities_and_gradients_are_finite_and_exact_far_out():
    """Where 1 - tanh(u)^2 rounds to zero, its logarithm is still 2 log 2 - 2 |u|."""
    unsquashed = torch.tensor([[-50.0], [-15.0], [15.0], [50.0]], requires_grad=True)
    zeros = torch.zeros(4, 1)
    mine = squashed_log_densities(unsquashed, zeros, zeros)
    expected = [-0.5 * u * u - 0.5 * math.log(2 * math.pi) - 2 * math.log(2) + 2 * abs(u) for u in (50, 15, 15, 50)]
    assert mine.tolist() == pytest.approx(expected, rel=1e-6)
    mine.sum().backward()
    assert unsquashed.grad is not None
    assert unsquashed.grad.flatten().tolist() == pytest.approx([48.0, 13.0, -13.0, -48.0], rel=1e-5)


def test_samples_follow_the_density_that_is_told():
    actor = GaussianActor(networks(2, 1, continuous=True, seed=1), (4,))
    observations = torch.zeros(100_000, 2)
    with torch.no_grad():
        actions, log_densities = actor.sample(observations, random(100_000, 1))
    assert float(actions.abs().max()) <= 1.0
    counts = torch.histc(actions, 20, -1.0, 1.0)
    for k, count in enumerate(counts.tolist()):
        inside = (actions[:, 0] >= -1.0 + 0.1 * k) & (actions[:, 0] < -0.9 + 0.1 * k)
        if count > 2000:
            # The harmonic mean of the density over a bin is the share of samples per width.
            harmonic = 1.0 / float((-log_densities[inside]).exp().mean())
            assert harmonic == pytest.approx(count / 100_000 / 0.1, rel=0.05)


def test_deviations_stay_within_bounds_and_the_deterministic_action_is_the_squashed_mean():
    actor = GaussianActor(networks(2, 3, continuous=True, seed=1), (4,))
    observations = 100.0 * random(50, 2)
    with torch.no_grad():
        means, log_stds = actor(observations)
        assert float(log_stds.min()) >= -5.0
        assert float(log_stds.max()) <= 2.0
        assert torch.equal(actor.act(observations, None, None), means.tanh())


# --- Soft values and losses -----------------------------------------------------------------------------------------


class Constant(torch.nn.Module):
    """The same output whatever the input."""

    def __init__(self, output: Tensor) -> None:
        super().__init__()
        self.output = output

    def forward(self, observations: Tensor) -> Tensor:
        return self.output


class Logits(CategoricalActor):
    """Preferences as given, whatever is observed."""

    def __init__(self, logits: list[list[float]]) -> None:
        super().__init__(networks(1, len(logits[0])), ())
        self.logits = torch.tensor(logits, requires_grad=True)
        self.network = Constant(self.logits)  # type: ignore[assignment]


class Values(TwinActionCritics):
    """Two values of every action as given, whatever is observed."""

    def __init__(self, values: list[list[list[float]]]) -> None:
        super().__init__(networks(1, 3), ())
        self.values = torch.tensor(values, requires_grad=True)

    def forward(self, observations: Tensor) -> Tensor:
        return self.values


LOGITS = [[0.0, math.log(2.0), math.log(3.0)], [0.0, 0.0, 0.0]]
MASKS = torch.tensor([[True, False, True], [True, True, False]])
SLOW = [[[1.0, 2.0, 3.0], [4.0, 4.0, 0.0]], [[2.0, 1.0, 0.0], [5.0, 3.0, 9.0]]]


def batch(size: int = 2, **changes: Any) -> Batch:
    return Batch(
        observations=torch.zeros(size, 1),
        masks=None,
        actions=torch.tensor([0, 2]),
        rewards=torch.zeros(size),
        discounts=torch.zeros(size),
        next_observations=torch.zeros(size, 1),
        next_masks=None,
    )._replace(**changes)


def soft_value(probabilities: list[float], values: list[float], alpha: float) -> float:
    pairs = zip(probabilities, values, strict=True)
    return sum(p * (v - alpha * math.log(p)) for p, v in pairs)


@pytest.mark.parametrize("alpha", [0.0, 0.5])
def test_soft_values_of_discrete_actions_by_hand(alpha: float):
    objective = DiscreteObjective(Logits(LOGITS), Values(SLOW), Values(SLOW))
    mine = objective.next_values(batch(), torch.tensor(alpha), torch.empty(0))
    # The smaller of the two values: 1, 1, 0 and 4, 3, 0.
    expected = [soft_value([1 / 6, 1 / 3, 1 / 2], [1, 1, 0], alpha), soft_value([1 / 3] * 3, [4, 3, 0], alpha)]
    assert mine.tolist() == pytest.approx(expected)
    masked = objective.next_values(batch(next_masks=MASKS), torch.tensor(alpha), torch.empty(0))
    expected = [soft_value([1 / 4, 3 / 4], [1, 0], alpha), soft_value([1 / 2, 1 / 2], [4, 3], alpha)]
    assert masked.tolist() == pytest.approx(expected)


def test_the_policys_loss_of_discrete_actions_by_hand():
    actor, critics = Logits(LOGITS), Values(SLOW)
    result = DiscreteObjective(actor, critics, Values(SLOW)).policy_loss(
        batch(masks=MASKS), torch.tensor(0.5), torch.empty(0)
    )
    first, second = soft_value([1 / 4, 3 / 4], [1, 0], 0.5), soft_value([1 / 2, 1 / 2], [4, 3], 0.5)
    assert float(result.loss.detach()) == pytest.approx(-(first + second) / 2)
    entropies = [0.25 * math.log(4) + 0.75 * math.log(4 / 3), math.log(2)]
    assert result.entropies.tolist() == pytest.approx(entropies)
    result.loss.backward()
    assert critics.values.grad is None
    gradient = actor.logits.grad
    assert gradient is not None
    assert torch.isfinite(gradient).all()
    assert gradient[0, 1] == gradient[1, 2] == 0.0  # illegal
    # d/dlogit_a of sum p (alpha log p - v) = p_a (alpha log p_a - v_a - the sum), halved by the mean.
    assert float(gradient[0, 0]) == pytest.approx(0.5 * 0.25 * (0.5 * math.log(0.25) - 1.0 + first), rel=1e-5)


def test_values_of_the_actions_played():
    objective = DiscreteObjective(Logits(LOGITS), Values(SLOW), Values(SLOW))
    assert objective.values(batch()).tolist() == [[1.0, 0.0], [2.0, 9.0]]
    assert (
        float(critic_loss(objective.values(batch()), torch.tensor([1.0, 1.0])).detach()) == (0 + 1) / 2 + (1 + 64) / 2
    )


def test_soft_values_of_continuous_actions_are_those_of_the_sample():
    made = networks(1, 2, continuous=True)
    actor, critics, slow = GaussianActor(made, (4,)), *(TwinCritics(made, (4,)) for _ in range(2))
    objective = ContinuousObjective(actor, critics, slow)
    noise, alpha = random(5, 2), torch.tensor(0.3)
    states = random(5, 1, seed=4)
    transitions = batch(5, observations=states, next_observations=states)
    with torch.no_grad():
        means, log_stds = actor(states)
        actions = (means + log_stds.exp() * noise).tanh()
        log_densities = (
            TransformedDistribution(Normal(means, log_stds.exp()), [TanhTransform()]).log_prob(actions).sum(-1)
        )
        both = slow(states, actions)
        expected = torch.minimum(both[0], both[1]) - 0.3 * log_densities
        torch.testing.assert_close(objective.next_values(transitions, alpha, noise), expected, rtol=1e-4, atol=1e-4)
        both = critics(states, actions)
        result = objective.policy_loss(transitions, alpha, noise)
        expected = (0.3 * log_densities - torch.minimum(both[0], both[1])).mean()
        torch.testing.assert_close(result.loss, expected, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(result.entropies, -log_densities, rtol=1e-4, atol=1e-4)


@BOTH
def test_targets_are_rewards_and_discounted_soft_values(continuous: bool):
    sac = trainer(continuous, tune_temperature=False, batch_size=64)
    for _ in range(3):
        sac.iterate()
    transitions = sac.minibatch()
    assert (transitions.discounts == 0.0).any()
    generator = sac.generator.get_state()
    noise = sac._noise(transitions)
    with torch.no_grad():
        following = sac.objective.next_values(transitions, sac.temperature.alpha, noise)
        aims = transitions.rewards + transitions.discounts * following
        expected = critic_loss(sac.objective.values(transitions), aims)
    sac.generator.set_state(generator)
    assert float(sac.learn(transitions)["losses/qf_loss"].detach()) == pytest.approx(float(expected), rel=1e-5)


# --- Temperature ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("entropy", "change"), [(0.2, 1.0), (0.9, -1.0)])
def test_the_temperature_rises_below_the_target_entropy_and_falls_above(entropy: float, change: float):
    log_alpha = torch.tensor(math.log(0.3), requires_grad=True)
    loss = temperature_loss(log_alpha, torch.tensor([entropy]), torch.tensor([0.5]))
    assert float(loss.detach()) == pytest.approx(0.3 * (entropy - 0.5))
    loss.backward()
    assert log_alpha.grad is not None
    assert float(log_alpha.grad) == pytest.approx(0.3 * (entropy - 0.5))
    assert -float(log_alpha.grad) * change > 0.0


def test_target_entropies_of_discrete_actions_are_a_share_of_the_largest_possible():
    sac = trainer(False, first_entropy_share=0.8, last_entropy_share=0.2)
    masks = torch.tensor([[True, True, True], [True, False, True], [True, False, False]])
    for decisions, share in ((0, 0.8), (500, 0.5), (1000, 0.2)):
        sac.decisions = decisions
        assert sac.schedule() == {"charts/entropy_share": pytest.approx(share)}
        mine = sac.target_entropies(batch(3, masks=masks)).tolist()
        assert mine == pytest.approx([share * math.log(3), share * math.log(2), 0.0])
        assert sac.target_entropies(batch(1)).tolist() == pytest.approx([share * math.log(3)])


def test_target_entropies_of_continuous_actions_are_per_dimension():
    assert trainer(True).target_entropies(batch(2)).tolist() == [-2.0, -2.0]
    assert trainer(True, entropy_per_dimension=0.25).target_entropies(batch(1)).tolist() == [0.5]


@BOTH
def test_a_fixed_temperature_stays(continuous: bool):
    sac = trainer(continuous, tune_temperature=False, initial_temperature=0.2)
    for _ in range(4):
        metrics = sac.iterate()
    assert metrics["losses/alpha"] == pytest.approx(0.2)
    assert "losses/alpha_loss" not in metrics


@pytest.mark.parametrize(("frequency", "moved"), [(1, [1, 2, 3, 4, 5, 6]), (2, [2, 4, 6]), (3, [3, 6])])
def test_the_policy_is_updated_with_delay(frequency: int, moved: list[int]):
    sac = trainer(False, policy_frequency=frequency, learning_starts=10**6)
    sac.iterate()
    seen = []
    for k in range(1, 7):
        sac.updates = k
        before = [parameter.clone() for parameter in sac.actor.parameters()]
        sac.learn(sac.minibatch())
        if any(not torch.equal(a, b) for a, b in zip(before, sac.actor.parameters(), strict=True)):
            seen.append(k)
    assert seen == moved


# --- Exploration ----------------------------------------------------------------------------------------------------


def test_untrained_policy_does_nothing_as_often_as_asked_and_plays_at_once():
    sac = trainer(False, initial_do_nothing=0.6, random_start=False)
    shares = sac.explore(random(20_000, 4), None).bincount(minlength=3) / 20_000
    assert float(shares[0]) == pytest.approx(0.6, abs=0.12)  # the untrained network's own preferences remain
    uniform = trainer(False, initial_do_nothing=0.6).explore(random(20_000, 4), None).bincount(minlength=3) / 20_000
    np.testing.assert_allclose(uniform, np.full(3, 1 / 3), atol=0.015)


def test_illegal_actions_are_never_sampled_nor_preferred():
    sac = trainer(False, random_start=False)
    with torch.no_grad():
        sac.actor.network[-1].bias[1] = 50.0  # type: ignore[index, operator, union-attr]
    masks = torch.tensor([[True, False, True]]).expand(2000, 3)
    assert sorted(sac.explore(random(2000, 4), masks).unique().tolist()) == [0, 2]
    assert 1 not in sac.actor.act(random(2000, 4), masks, None)


# --- Presets --------------------------------------------------------------------------------------------------------


@BOTH
def test_the_preset_paper_is_the_papers_table(continuous: bool):
    args = preset("paper", continuous=continuous)
    assert args.train_frequency == 50
    assert args.policy_frequency == 2
    assert args.buffer_size == 500_000
    assert args.actor_learning_rate == args.critic_learning_rate == (3e-5 if continuous else 3e-4)
    assert (args.initial_temperature, args.tune_temperature) == (0.2, False)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"initial_temperature": 0.0}, "positive initial_temperature"),
        ({"temperature_learning_rate": -1.0}, "positive temperature_learning_rate"),
        ({"first_entropy_share": 1.5}, "first_entropy_share between 0 and 1"),
        ({"initial_do_nothing": 0.0}, "initial_do_nothing above 0 and below 1"),
        ({"initial_do_nothing": 1.0}, "initial_do_nothing above 0 and below 1"),
        ({"actor_layers": (-3,)}, "actor_layers of widths of at least 1"),
        ({"critic_layers": (8, 0)}, "critic_layers of widths of at least 1"),
        ({"policy_frequency": 0}, "policy_frequency of at least 1"),
    ],
)
def test_values_that_cannot_work_are_refused(changes: dict[str, Any], sentence: str):
    with pytest.raises(UsageError, match=f"SAC needs .*{sentence}"):
        replace(SMALL, **changes)


# --- It learns ------------------------------------------------------------------------------------------------------

LEARNING = Args(
    seed=1,
    total_timesteps=3_200,
    num_envs=8,
    num_steps=50,
    learning_starts=200,
    train_frequency=2,
    batch_size=64,
    reward_scale=1.0,
    actor_learning_rate=2e-3,
    critic_learning_rate=2e-3,
    temperature_learning_rate=3e-3,
    tau=0.05,
    mask_actions=False,
    normalize_observations=False,
    actor_layers=(32,),
    critic_layers=(32, 32),
)


def run(args: Args, envs: Any) -> tuple[SAC, list[dict[str, float]]]:
    sac = SAC(args, envs)
    metrics = []
    while not sac.finished:
        metrics.append(sac.iterate())
    return sac, metrics


def test_the_soft_optimum_of_discrete_actions_is_found():
    """With rewards r and temperature alpha in one step, the best policy is softmax(r / alpha)."""
    args = replace(LEARNING, tune_temperature=False, initial_temperature=0.5, total_timesteps=3_200)
    sac, _ = run(args, vector(Arms, 8))
    with torch.no_grad():
        probabilities = sac.actor(torch.ones(1, 1), None).exp()[0]
    np.testing.assert_allclose(probabilities, torch.softmax(torch.tensor([0.0, 1.0, 2.0]), 0), atol=0.03)


@pytest.mark.slow
def test_the_temperature_brings_the_entropy_to_its_target():
    args = replace(LEARNING, first_entropy_share=0.7, last_entropy_share=0.7)
    _, metrics = run(replace(args, temperature_learning_rate=1e-2), vector(Arms, 8))
    assert np.mean([m["losses/entropy"] for m in metrics[-4:]]) == pytest.approx(0.7 * math.log(3), abs=0.06)


@pytest.mark.slow
def test_the_best_continuous_action_is_found():
    sac, metrics = run(LEARNING, vector(Follow, 8))
    shown = torch.linspace(-0.7, 0.7, 15).unsqueeze(-1)
    with torch.no_grad():
        actions = sac.actor.act(shown, None, None)
    np.testing.assert_allclose(actions, shown, atol=0.15)
    assert metrics[-1]["losses/alpha"] != pytest.approx(0.1)


@pytest.mark.slow
@BOTH
def test_the_toy_grid_is_kept_alive(continuous: bool):
    args = replace(SMALL_CONTINUOUS if continuous else SMALL, total_timesteps=16_000, num_envs=8, num_steps=64)
    args = replace(args, learning_starts=512, batch_size=64, actor_layers=(32,), critic_layers=(32,))
    _, metrics = run(args, ToyGrid(8, continuous=continuous))
    survival = [m["charts/survival"] for m in metrics]
    assert np.mean(survival[:2]) < 0.75
    assert np.mean(survival[-5:]) > 0.82
