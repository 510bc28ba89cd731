"""PPO: what is optimised against values computed by hand, and what must never happen again."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from constrained_toys import Lever
from gymnasium.vector import AutoresetMode
from specs import networks
from torch import Tensor
from toy_grid import ToyGrid

from rl2grid.algorithms.checkpoint import load_checkpoint, save_checkpoint
from rl2grid.algorithms.pair import Pair
from rl2grid.algorithms.ppo import (
    PPO,
    SEARCH_SPACE,
    ActorCritic,
    Args,
    Minibatch,
    Rollout,
    advantages_of_rewards,
    critic_losses,
    load_policy,
    policy_losses,
    preset,
)
from rl2grid.errors import UsageError

SMALL = Args(
    seed=3,
    total_timesteps=4 * 16 * 6,
    num_envs=4,
    num_steps=16,
    gamma=0.9,
    num_minibatches=3,
    update_epochs=2,
    actor_layers=(8,),
    critic_layers=(8,),
    target_kl=None,
)
SMALL_CONTINUOUS = replace(SMALL, mask_actions=False, initial_log_std=0.5)
BOTH = pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])


def trainer(continuous: bool = False, *, gamma: float | None = 0.9, **changes: Any) -> PPO:
    args = replace(SMALL_CONTINUOUS if continuous else SMALL, **changes)
    return PPO(args, ToyGrid(args.num_envs, gamma=gamma, continuous=continuous))


def first_rollout(ppo: PPO) -> Rollout:
    """The rollout before any update."""
    ppo.observations, _ = ppo.envs.reset(seed=7)
    return ppo.collect()[0]


def weights(ppo: PPO) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in ppo.network.state_dict().items()}


def assert_same(mine: dict[str, Tensor], theirs: dict[str, Tensor]) -> None:
    assert mine.keys() == theirs.keys()
    for name in mine:
        assert torch.equal(mine[name], theirs[name]), name


def minibatch(rollout: Rollout, order: Tensor | None = None) -> Minibatch:
    zeros = torch.zeros(rollout.values.numel())
    data = Minibatch(
        rollout.observations.flatten(0, 1),
        None if rollout.masks is None else rollout.masks.flatten(0, 1),
        rollout.actions.flatten(0, 1),
        rollout.log_probabilities.flatten(),
        rollout.values.flatten(),
        zeros,
        zeros,
    )
    return data if order is None else data.rows(order)


class Recording(ToyGrid):
    """Keeps every step, as it was asked for and answered."""

    def __init__(self, num_envs: int, *, gamma: float | None = 0.9, continuous: bool = False) -> None:
        super().__init__(num_envs, gamma=gamma, continuous=continuous)
        self.actions: list[Any] = []
        self.answers: list[Any] = []

    def step(self, actions: Any) -> Any:
        self.actions.append(actions.copy())
        self.answers.append(super().step(actions))
        return self.answers[-1]


# --- Advantages -----------------------------------------------------------------------------------------------------


def random_rollout(steps: int = 13, envs: int = 3) -> Rollout:
    random = torch.Generator().manual_seed(0)
    shape = (steps, envs)
    ended = torch.rand(shape, generator=random) < 0.25
    terminated = ended & (torch.rand(shape, generator=random) < 0.5)
    next_values = torch.randn(shape, generator=random)
    return Rollout(
        observations=torch.zeros(*shape, 1),
        masks=None,
        actions=torch.zeros(shape, dtype=torch.int64),
        log_probabilities=torch.zeros(shape),
        rewards=torch.randn(shape, generator=random),
        discounts=0.9 ** torch.randint(1, 6, shape, generator=random),
        values=torch.randn(shape, generator=random),
        next_values=torch.where(terminated, 0.0, next_values),
        ended=ended,
        decided=torch.ones(shape, dtype=torch.bool),
    )


def advantage_by_definition(rollout: Rollout, k: int, i: int, gae_lambda: float) -> float:
    """The sum of all later errors of the critic in the same episode, each with its discount."""
    total, weight = 0.0, 1.0
    for m in range(k, len(rollout.rewards)):
        reward, discount = float(rollout.rewards[m, i]), float(rollout.discounts[m, i])
        total += weight * (reward + discount * float(rollout.next_values[m, i]) - float(rollout.values[m, i]))
        if rollout.ended[m, i]:
            break
        weight *= discount * gae_lambda
    return total


@pytest.mark.parametrize("gae_lambda", [0.0, 0.7, 1.0])
def test_advantages_are_the_discounted_errors_until_the_end_of_the_episode(gae_lambda: float):
    rollout = random_rollout()
    advantages = advantages_of_rewards(rollout, gae_lambda)
    for k in range(advantages.shape[0]):
        for i in range(advantages.shape[1]):
            expected = advantage_by_definition(rollout, k, i, gae_lambda)
            assert float(advantages[k, i]) == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_advantages_of_transitions_of_several_grid_steps_by_hand():
    # Two transitions of 3 and 2 grid steps, gamma 0.5, lambda 0.8, the second one completes the month.
    rollout = replace(
        random_rollout(2, 1),
        rewards=torch.tensor([[4.0], [2.0]]),
        discounts=torch.tensor([[0.125], [0.25]]),
        values=torch.tensor([[1.0], [3.0]]),
        next_values=torch.tensor([[3.0], [8.0]]),
        ended=torch.tensor([[False], [True]]),
    )
    advantages = advantages_of_rewards(rollout, 0.8)
    last = 2.0 + 0.25 * 8.0 - 3.0
    assert advantages.squeeze(1).tolist() == pytest.approx([4.0 + 0.125 * 3.0 - 1.0 + 0.125 * 0.8 * last, last])


def test_bootstrapping_follows_how_the_episode_ended():
    """Nothing follows a game over; a completed month is worth the value of its own last observation."""
    envs = Recording(4)
    ppo = PPO(replace(SMALL, num_steps=200, total_timesteps=800, normalize_observations=False), envs)
    rollout = first_rollout(ppo)
    counts = {"terminated": 0, "truncated": 0, "running": 0}
    for k, (observations, _, terminated, truncated, infos) in enumerate(envs.answers):
        for i in range(4):
            value = float(rollout.next_values[k, i])
            assert bool(rollout.ended[k, i]) == bool(terminated[i] or truncated[i])
            if terminated[i]:
                counts["terminated"] += 1
                assert value == 0.0
                continue
            seen = infos["final_obs"][i] if truncated[i] else observations[i]
            counts["truncated" if truncated[i] else "running"] += 1
            with torch.no_grad():
                assert value == pytest.approx(float(ppo.network.value(torch.as_tensor(seen))), rel=1e-5, abs=1e-6)
    assert min(counts.values()) > 5


def test_an_episode_both_completed_and_lost_is_lost():
    class Both(ToyGrid):
        def step(self, actions: Any) -> Any:
            observations, rewards, terminated, truncated, infos = super().step(actions)
            return observations, rewards, terminated, truncated | terminated, infos

    rollout = first_rollout(PPO(SMALL, Both(4)))
    assert rollout.ended.any()
    lost = rollout.ended & (rollout.next_values == 0.0)
    assert lost.any()


def test_values_at_truncation_are_of_normalised_observations():
    envs = Recording(4)
    ppo = PPO(replace(SMALL, num_steps=100, total_timesteps=400), envs)
    first_rollout(ppo)
    envs.answers.clear()
    ppo.normalizer.freeze()
    rollout = first_rollout(ppo)
    truncated = np.stack([answer[3] & ~answer[2] for answer in envs.answers])
    last = np.stack([envs.answers[k][4]["final_obs"][i] for k, i in np.argwhere(truncated)])
    assert len(last) > 3
    with torch.no_grad():
        expected = ppo.network.value(torch.as_tensor(ppo.normalizer.normalize(last)))
    torch.testing.assert_close(rollout.next_values[torch.as_tensor(truncated)], expected)


# --- Rewards and discounts of transitions ---------------------------------------------------------------------------


def test_rewards_of_all_grid_steps_count_each_with_its_discount():
    envs = Recording(4)
    ppo = PPO(replace(SMALL, num_steps=60, total_timesteps=240), envs)
    rollout = first_rollout(ppo)
    several = 0
    for k, (_, _, terminated, truncated, infos) in enumerate(envs.answers):
        for i in range(4):
            info = infos["final_info"] if terminated[i] or truncated[i] else infos
            assert float(rollout.rewards[k, i]) == pytest.approx(0.1 * float(info["discounted_reward"][i]), rel=1e-6)
            assert float(rollout.discounts[k, i]) == pytest.approx(0.9 ** int(info["n_steps"][i]), rel=1e-6)
            several += int(info["n_steps"][i]) > 1
    assert several > 100


def test_the_reward_scale_is_one_minus_gamma_or_what_is_asked_for():
    mine, other = first_rollout(trainer()), first_rollout(trainer(reward_scale=1.0))
    torch.testing.assert_close(mine.rewards, other.rewards * 0.1)


def test_steps_without_their_discounted_reward_are_refused():
    with pytest.raises(UsageError, match=r"make it with gamma=0\.9\."):
        trainer(gamma=None).iterate()


def test_an_environment_that_knows_nothing_of_grid_steps_has_one_per_decision():
    rollout = first_rollout(PPO(cartpole_args(1), cartpole(8)))
    assert torch.equal(rollout.discounts, torch.full_like(rollout.discounts, 0.98))
    torch.testing.assert_close(rollout.rewards, torch.full_like(rollout.rewards, 0.02))


def test_transitions_that_no_decision_began_teach_nothing():
    ppo = trainer()
    rollout = first_rollout(ppo)
    chosen = torch.zeros_like(rollout.decided)
    chosen[::2] = True
    nonsense = torch.full_like(rollout.log_probabilities, math.nan)
    ppo.update(
        replace(rollout, decided=chosen, log_probabilities=torch.where(chosen, rollout.log_probabilities, nonsense))
    )
    assert all(torch.isfinite(tensor).all() for tensor in weights(ppo).values())
    before = weights(ppo)
    metrics = ppo.update(replace(rollout, decided=torch.zeros_like(chosen)))
    assert_same(weights(ppo), before)
    assert math.isnan(metrics["losses/policy_loss"])


def test_episodes_that_end_inside_reset_are_recognised():
    envs = Recording(4)
    ppo = PPO(replace(SMALL, num_steps=100, total_timesteps=400), envs)
    rollout = first_rollout(ppo)
    over = np.stack([infos["over"] for *_, infos in envs.answers[:-1]])
    np.testing.assert_array_equal(rollout.decided[1:].numpy(), ~over)
    assert 0 < over.sum() < over.size / 2


# --- Policies -------------------------------------------------------------------------------------------------------


@BOTH
def test_the_ratio_before_any_update_is_one(continuous: bool):
    """Also when actions were clipped, and when they would not survive a cast to integers."""
    ppo = trainer(continuous)
    rollout = first_rollout(ppo)
    order = torch.randperm(rollout.values.numel())
    batch = minibatch(rollout, order)
    log_probabilities, _ = ppo.network.log_probability_and_entropy(batch.observations, batch.actions, batch.masks)
    torch.testing.assert_close(
        (log_probabilities - batch.log_probabilities).exp(), torch.ones(len(order)), rtol=0, atol=1e-5
    )
    loss = policy_losses(ppo.network, batch, ppo.args)
    assert float(loss.approximate_kl) == pytest.approx(0.0, abs=1e-6)
    assert float(loss.clip_fraction) == 0.0


@BOTH
def test_the_first_minibatch_of_an_update_has_ratios_of_one(continuous: bool):
    """The update reads the actions and probabilities that were played."""
    metrics = trainer(continuous, num_minibatches=1, update_epochs=1).iterate()
    assert metrics["losses/approx_kl"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["losses/clipfrac"] == 0.0


def test_continuous_actions_are_played_clipped_and_learned_unclipped():
    envs = Recording(4, continuous=True)
    rollout = first_rollout(PPO(SMALL_CONTINUOUS, envs))
    played = torch.as_tensor(np.stack(envs.actions))
    assert played.dtype == torch.float32
    assert (rollout.actions.abs() > 1.0).any()
    assert torch.equal(played, rollout.actions.clamp(-1.0, 1.0))
    assert len(played.unique()) > 50  # neither rounded nor ignored


def test_gaussian_log_probability_and_entropy_are_those_of_torch():
    network = policy(continuous=True)
    observations, actions = torch.randn(5, 4), torch.randn(5, 2)
    mine, entropy = network.log_probability_and_entropy(observations, actions, None)
    normal = torch.distributions.Normal(network.actor(observations), network.log_std.exp())
    torch.testing.assert_close(mine, normal.log_prob(actions).sum(-1))
    torch.testing.assert_close(entropy, normal.entropy().sum(-1))


def test_categorical_log_probability_and_entropy_are_those_of_torch():
    network = policy(continuous=False)
    observations, actions = torch.randn(5, 4), torch.tensor([0, 1, 2, 0, 1])
    mine, entropy = network.log_probability_and_entropy(observations, actions, None)
    categorical = torch.distributions.Categorical(logits=network.actor(observations))
    torch.testing.assert_close(mine, categorical.log_prob(actions))
    torch.testing.assert_close(entropy, categorical.entropy())


def test_masked_probabilities_are_those_of_the_legal_actions_alone():
    network = policy(continuous=False)
    observations = torch.randn(1, 4)
    mask = torch.tensor([[True, False, True]])
    logits = network.actor(observations)[0, [0, 2]]
    expected = torch.distributions.Categorical(logits=logits)
    for action, legal in ((0, 0), (2, 1)):
        mine, entropy = network.log_probability_and_entropy(observations, torch.tensor([action]), mask)
        torch.testing.assert_close(mine[0], expected.log_prob(torch.tensor(legal)))
        torch.testing.assert_close(entropy[0], expected.entropy())


def test_gradients_are_finite_under_masks_and_zero_for_illegal_actions():
    network = policy(continuous=False)
    mask = torch.tensor([[True, False, True], [True, False, False]])
    log_probabilities, entropies = network.log_probability_and_entropy(torch.randn(2, 4), torch.tensor([2, 0]), mask)
    assert float(entropies[1].detach()) == 0.0
    (log_probabilities.sum() + entropies.sum()).backward()
    bias = network.actor[-1].bias
    assert isinstance(bias, Tensor)
    assert bias.grad is not None
    assert torch.isfinite(bias.grad).all()
    assert float(bias.grad[1]) == 0.0


def test_illegal_actions_are_never_sampled_nor_preferred():
    network = policy(continuous=False)
    with torch.no_grad():
        network.actor[-1].bias[1] = 50.0  # type: ignore[index, union-attr, operator]
    observations, mask = torch.randn(2000, 4), torch.tensor([[True, False, True]]).expand(2000, 3)
    sampled = network.act(observations, mask, torch.Generator().manual_seed(0))
    assert sorted(sampled.unique().tolist()) == [0, 2]
    assert 1 not in network.act(observations, mask, None)


@BOTH
def test_samples_follow_the_distribution(continuous: bool):
    network = policy(continuous=continuous)
    observation = torch.randn(1, 4)
    samples = network.act(observation.expand(20000, 4), None, torch.Generator().manual_seed(0))
    output = network.actor(observation)[0].detach()
    if continuous:
        torch.testing.assert_close(samples.mean(0), output, rtol=0, atol=0.05)
        torch.testing.assert_close(samples.std(0), network.log_std.detach().exp(), rtol=0.03, atol=0)
    else:
        torch.testing.assert_close(samples.bincount() / 20000, output.softmax(0), rtol=0, atol=0.015)


@BOTH
def test_deterministic_actions_are_the_most_probable_ones(continuous: bool):
    network = policy(continuous=continuous)
    observations = torch.randn(6, 4)
    output = network.actor(observations)
    expected = output if continuous else output.argmax(-1)
    for _ in range(3):
        assert torch.equal(network.act(observations, None, None), expected)


def test_the_log_standard_deviations_are_trained_and_saved(tmp_path: Path):
    ppo = trainer(continuous=True, entropy_coefficient=0.1)
    start = ppo.network.log_std.detach().clone()
    ppo.iterate()
    trained = ppo.network.log_std.detach().clone()
    assert not torch.equal(trained, start)
    optimised = [id(parameter) for group in groups_of(ppo) for parameter in group["params"]]
    assert sorted(optimised) == sorted(id(parameter) for parameter in ppo.network.parameters())
    save_checkpoint(tmp_path / "c.pt", {"task": "t", "policy": ppo.policy_state()})
    assert torch.equal(load_policy(load_checkpoint(tmp_path / "c.pt")["policy"]).log_std.detach(), trained)


def policy(*, continuous: bool) -> ActorCritic:
    network = ActorCritic(
        networks(4, 2 if continuous else 3, continuous=continuous),
        actor_layers=(8,),
        critic_layers=(8,),
        initial_log_std=0.3,
    )
    with torch.no_grad():
        network.actor[-1].weight.mul_(50.0)  # type: ignore[union-attr, operator]
    return network


# --- Losses ---------------------------------------------------------------------------------------------------------


class Scripted(ActorCritic):
    """Log-probabilities, entropies and values as given, so that losses can be computed by hand."""

    def __init__(self, log_probabilities: list[float], values: list[float], entropies: list[float]) -> None:
        super().__init__(networks(1, 2), actor_layers=(), critic_layers=())
        self.log_probabilities = torch.tensor(log_probabilities, requires_grad=True)
        self.values = torch.tensor(values, requires_grad=True)
        self.entropies = torch.tensor(entropies)

    def log_probability_and_entropy(
        self, observations: Tensor, actions: Tensor, masks: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        return self.log_probabilities, self.entropies

    def value(self, observations: Tensor) -> Tensor:
        return self.values


RATIOS = [1.5, 0.5, 1.1, 1.5]
BATCH = Minibatch(
    observations=torch.zeros(4, 1),
    masks=None,
    actions=torch.zeros(4, dtype=torch.int64),
    log_probabilities=torch.tensor([-1.0, -1.0, -1.0, -1.0]),
    values=torch.tensor([0.0, 1.0, 2.0, 0.0]),
    advantages=torch.tensor([2.0, -1.0, 3.0, -1.0]),
    returns=torch.tensor([1.0, 1.0, 1.0, 0.1]),
)
PLAIN = replace(SMALL, normalize_advantages=False, entropy_coefficient=0.0, value_coefficient=0.5)


def scripted() -> Scripted:
    return Scripted([-1.0 + math.log(ratio) for ratio in RATIOS], [0.5, 0.4, 2.0, 0.1], [0.1, 0.2, 0.3, 0.4])


def test_the_policy_loss_by_hand():
    loss = policy_losses(scripted(), BATCH, PLAIN)
    # min(ratio A, clip(ratio, 0.8, 1.2) A): 2.4, -0.8, 3.3, -1.5
    assert float(loss.policy) == pytest.approx(-(2.4 - 0.8 + 3.3 - 1.5) / 4)
    assert float(loss.clip_fraction) == pytest.approx(3 / 4)
    assert float(loss.approximate_kl) == pytest.approx(np.mean([r - 1 - math.log(r) for r in RATIOS]), rel=1e-5)


def test_the_value_loss_by_hand():
    errors = [0.25, 0.36, 1.0, 0.0]
    assert float(critic_losses(scripted(), BATCH, PLAIN).value) == pytest.approx(0.5 * sum(errors) / 4)
    # Clipped to within 0.2 of the old values: 0.2, 0.8, 2.0, 0.1; the larger error counts.
    clipped = [0.64, 0.36, 1.0, 0.0]
    loss = critic_losses(scripted(), BATCH, replace(PLAIN, clip_value_loss=True))
    assert float(loss.value) == pytest.approx(0.5 * sum(clipped) / 4)


def test_the_total_losses_by_hand():
    args = replace(PLAIN, entropy_coefficient=0.1)
    loss, of_critic = policy_losses(scripted(), BATCH, args), critic_losses(scripted(), BATCH, args)
    assert float(loss.entropy) == pytest.approx(0.25)
    assert float(loss.total.detach()) == pytest.approx(float(loss.policy) - 0.1 * 0.25)
    assert float(of_critic.total.detach()) == pytest.approx(0.5 * float(of_critic.value))


def test_advantages_are_normalised_over_the_minibatch():
    advantages = BATCH.advantages.numpy()
    normalised = (advantages - advantages.mean()) / advantages.std()
    expected = np.minimum(np.array(RATIOS) * normalised, np.clip(RATIOS, 0.8, 1.2) * normalised).mean()
    loss = policy_losses(scripted(), BATCH, replace(PLAIN, normalize_advantages=True))
    assert float(loss.policy) == pytest.approx(-expected, rel=1e-5)


def test_good_actions_become_more_probable_and_clipped_ones_are_left_alone():
    network = scripted()
    policy_losses(network, BATCH, PLAIN).total.backward()  # type: ignore[no-untyped-call]
    gradient = network.log_probabilities.grad
    assert gradient is not None
    assert gradient.tolist() == pytest.approx([0.0, 0.0, -3.3 / 4, 1.5 / 4])


# --- Training -------------------------------------------------------------------------------------------------------


@BOTH
def test_the_same_seed_gives_the_same_weights_whatever_the_global_random_state(continuous: bool):
    results = []
    for noise in (0, 1):
        torch.manual_seed(noise)
        np.random.seed(noise)  # noqa: NPY002 - the global state is what must not matter
        ppo = trainer(continuous)
        metrics = [ppo.iterate() for _ in range(3)]
        results.append((weights(ppo), metrics[-1]))
    assert_same(results[0][0], results[1][0])
    for name in results[0][1].keys() - {"charts/environment_share"}:
        assert results[0][1][name] == pytest.approx(results[1][1][name], rel=0, abs=0, nan_ok=True), name


def test_training_leaves_the_global_random_state_alone():
    before = torch.get_rng_state()
    trainer().iterate()
    assert torch.equal(torch.get_rng_state(), before)


def test_another_seed_gives_other_weights_and_episodes():
    one, other = trainer(), trainer(seed=4)
    assert not torch.equal(weights(one)["actor.0.weight"], weights(other)["actor.0.weight"])
    one.iterate()
    other.iterate()
    seeds = [{row.seed for row in ppo.envs.unwrapped.rows} for ppo in (one, other)]  # type: ignore[attr-defined]
    assert not seeds[0] & seeds[1]


@BOTH
def test_a_resumed_run_ends_with_the_weights_of_one_that_was_not_interrupted(continuous: bool, tmp_path: Path):
    straight = trainer(continuous)
    straight_metrics = [straight.iterate() for _ in range(straight.num_iterations)]
    for stop in (1, 3, 5):
        begun = trainer(continuous)
        for _ in range(stop):
            begun.iterate()
        save_checkpoint(tmp_path / "c.pt", {"task": "t", "training": begun.state_dict()})
        resumed = trainer(continuous)
        resumed.load_state_dict(load_checkpoint(tmp_path / "c.pt")["training"])
        metrics = {}
        while not resumed.finished:
            metrics = resumed.iterate()
        assert_same(weights(resumed), weights(straight))
        assert resumed.grid_steps == straight.grid_steps
        assert resumed.normalizer.normaliser_hash == straight.normalizer.normaliser_hash
        for name in metrics.keys() - {"charts/environment_share"}:
            assert metrics[name] == straight_metrics[-1][name], name


def test_a_run_is_not_resumed_in_other_environments():
    begun = trainer()
    begun.iterate()
    state = begun.state_dict()
    state["envs"]["rows"][0]["seed"] += 1
    with pytest.raises(UsageError, match="do not come back"):
        trainer().load_state_dict(state)


@BOTH
def test_observations_are_counted_once(continuous: bool):
    ppo = trainer(continuous)
    ppo.iterate()
    ppo.iterate()
    assert ppo.normalizer.count == 4 * (2 * 16 + 1)


def test_the_budget_is_never_exceeded():
    ppo = trainer(total_timesteps=4 * 16 * 3 - 1)
    while not ppo.finished:
        ppo.iterate()
    assert ppo.decisions == 4 * 16 * 2


def test_learning_rates_fall_to_zero_over_the_run_or_stay():
    ppo = trainer(total_timesteps=4 * 16 * 4, actor_learning_rate=1e-3, critic_learning_rate=4e-3)
    rates = []
    while not ppo.finished:
        assert ppo.iterate()["charts/learning_rate"] == groups_of(ppo)[0]["lr"]
        rates.append([group["lr"] for group in groups_of(ppo)])
    np.testing.assert_allclose(rates, np.outer([1.0, 0.75, 0.5, 0.25], [1e-3, 4e-3]))
    ppo = trainer(anneal_learning_rate=False)
    ppo.iterate()
    ppo.iterate()
    assert groups_of(ppo)[1]["lr"] == 3e-4


def test_an_update_ends_early_when_the_policy_moved_too_far():
    assert trainer(target_kl=1e-12, update_epochs=9).iterate()["charts/update_epochs"] == 1.0
    assert trainer(target_kl=None, update_epochs=9).iterate()["charts/update_epochs"] == 9.0


def test_gradients_are_scaled_down_to_the_norm_asked_for():
    ppo = trainer(max_grad_norm=1e-3, num_minibatches=1, update_epochs=1)
    ppo.iterate()
    for group in groups_of(ppo):
        norm = torch.stack([p.grad.norm() for p in group["params"] if p.grad is not None]).norm()
        assert 0.0 < float(norm) <= 1e-3 * (1 + 1e-4)


def groups_of(ppo: PPO) -> list[dict[str, Any]]:
    """What optimisers move, the actor's weights first."""
    return [*ppo.actor_optimizer.param_groups, *ppo.critic_optimizer.param_groups]


@BOTH
def test_networks_that_learn_at_once_learn_the_same(continuous: bool):
    one, two = trainer(continuous), trainer(continuous)
    two._pair = Pair(at_once=True)
    for _ in range(3):
        mine, theirs = one.iterate(), two.iterate()
        assert all(mine[name] == theirs[name] for name in mine if name.startswith("losses/"))
    assert_same(one.network.state_dict(), two.network.state_dict())


def test_metrics_of_episodes_are_those_of_the_episodes():
    envs = Recording(4)
    ppo = PPO(replace(SMALL, num_steps=8), envs)
    returns, survival = np.zeros(4), []
    for _ in range(6):
        begin = len(envs.answers)
        metrics = ppo.iterate()
        finished = []
        survival.clear()
        n_steps = ineffective = 0
        for _, rewards, terminated, truncated, infos in envs.answers[begin:]:
            returns += rewards
            ended = terminated | truncated
            for i in range(4):
                info = infos["final_info"] if ended[i] else infos
                n_steps += int(info["n_steps"][i])
                ineffective += bool(info["ambiguous"][i])
            for i in np.flatnonzero(ended):
                finished.append(returns[i])
                survival.append(infos["final_info"]["survival"][i])
                returns[i] = 0.0
        assert metrics["charts/episodes"] == len(finished)
        assert metrics["charts/n_steps_per_decision"] == n_steps / 32
        assert metrics["charts/ineffective_actions"] == ineffective / 32 > 0
        if finished:
            assert metrics["charts/episodic_return"] == pytest.approx(np.mean(finished))
            assert metrics["charts/survival"] == pytest.approx(np.mean(survival))
    assert ppo.decisions == 6 * 32


# --- Requests -------------------------------------------------------------------------------------------------------


@BOTH
def test_the_preset_paper_is_the_papers_table(continuous: bool):
    args = preset("paper", continuous=continuous)
    assert args.num_envs == 50
    assert args.num_envs * args.num_steps == 20_000
    assert args.num_minibatches == 4
    assert args.update_epochs == 40
    assert args.actor_learning_rate == args.critic_learning_rate == (3e-5 if continuous else 3e-4)
    assert args.clip_coefficient == 0.2
    assert args.gamma == 0.9
    assert args.max_grad_norm == 10.0
    assert args.mask_actions is False
    for name in set(SEARCH_SPACE) - {"num_envs * num_steps"}:
        assert getattr(args, name) in SEARCH_SPACE[name], name
    assert args.num_envs * args.num_steps in SEARCH_SPACE["num_envs * num_steps"]


def test_presets_can_be_changed_and_unknown_ones_are_refused():
    assert preset("default", continuous=False, seed=9).seed == 9
    assert preset("default", continuous=False).mask_actions
    assert not preset("default", continuous=True).mask_actions
    with pytest.raises(UsageError, match="choose one of default, paper, tuned"):
        preset("papers", continuous=False)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"num_envs": 0}, "num_envs of at least 1"),
        ({"initial_do_nothing": 1.0}, "initial_do_nothing above 0 and below 1"),
        ({"actor_layers": (-3,)}, "actor_layers of widths of at least 1"),
        ({"critic_layers": (8, 0)}, "critic_layers of widths of at least 1"),
        ({"gamma": 1.5}, "gamma between 0 and 1"),
        ({"gamma": math.nan}, "gamma between 0 and 1"),
        ({"gamma": 1.0}, "reward_scale"),
        ({"actor_learning_rate": -1.0}, "positive actor_learning_rate"),
        ({"critic_learning_rate": math.nan}, "positive critic_learning_rate"),
        ({"seed": -1}, "seed of at least 0"),
        ({"device": "gpu"}, "choose one of auto, cpu, cuda"),
        ({"total_timesteps": 63}, "at least num_envs . num_steps = 64, not 63"),
    ],
)
def test_values_that_cannot_work_are_refused(changes: dict[str, Any], sentence: str):
    with pytest.raises(UsageError, match=sentence):
        replace(SMALL, **changes)


def test_environments_that_cannot_be_learned_are_refused():
    with pytest.raises(UsageError, match="was to play 4 environments, but was given 3"):
        PPO(SMALL, ToyGrid(3))
    with pytest.raises(UsageError, match="Only discrete actions can be masked"):
        PPO(SMALL, ToyGrid(4, continuous=True))
    wide = ToyGrid(4, continuous=True)
    wide.single_action_space = gymnasium.spaces.Box(-2.0, 2.0, (2,))
    with pytest.raises(UsageError, match=r"Box\(-1, 1\)"):
        PPO(SMALL_CONTINUOUS, wide)
    with pytest.raises(UsageError, match="offers no action_masks"):
        PPO(replace(cartpole_args(1), mask_actions=True), cartpole(8))
    with pytest.raises(UsageError, match="SAME_STEP"):
        PPO(cartpole_args(1), cartpole(8, AutoresetMode.NEXT_STEP))
    other = ToyGrid(4)
    other.single_action_space = gymnasium.spaces.MultiDiscrete([2, 2])
    with pytest.raises(UsageError, match="not MultiDiscrete"):
        PPO(SMALL, other)


# --- It learns ------------------------------------------------------------------------------------------------------


def cartpole(num_envs: int, autoreset: AutoresetMode = AutoresetMode.SAME_STEP) -> Any:
    return gymnasium.make_vec(
        "CartPole-v1",
        num_envs=num_envs,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": autoreset},
    )


def cartpole_args(seed: int) -> Args:
    return Args(
        seed=seed,
        total_timesteps=30_000,
        num_envs=8,
        num_steps=64,
        gamma=0.98,
        actor_learning_rate=2e-3,
        critic_learning_rate=2e-3,
        update_epochs=8,
        entropy_coefficient=0.0,
        target_kl=None,
        mask_actions=False,
        actor_layers=(32, 32),
        critic_layers=(32, 32),
    )


@pytest.mark.slow
def test_cartpole_is_learned():
    ppo = PPO(cartpole_args(2), cartpole(8))
    while not ppo.finished:
        ppo.iterate()
    normalizer = ppo.normalizer
    normalizer.freeze()
    envs = cartpole(10)
    observations, _ = envs.reset(seed=1000)
    lengths, alive = np.zeros(10), np.ones(10, np.bool_)
    for _ in range(500):
        with torch.no_grad():
            actions = ppo.network.act(torch.as_tensor(normalizer.normalize(observations)), None, None)
        observations, _, terminated, truncated, _ = envs.step(actions.numpy())
        lengths += alive
        alive &= ~(terminated | truncated)
    assert lengths.mean() > 400


@pytest.mark.parametrize("continuous", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_toy_grid_is_kept_alive(continuous: bool):
    """Survival rises to nearly always, masks, game overs, completions and long transitions included."""
    args = replace(
        SMALL_CONTINUOUS if continuous else SMALL,
        total_timesteps=16_000,
        num_envs=8,
        num_steps=64,
        num_minibatches=4,
        update_epochs=8,
        actor_learning_rate=2e-3,
        critic_learning_rate=2e-3,
        entropy_coefficient=0.0,
        initial_log_std=-0.5,
        actor_layers=(32,),
        critic_layers=(32,),
    )
    ppo = PPO(args, ToyGrid(8, continuous=continuous))
    survival = []
    while not ppo.finished:
        survival.append(ppo.iterate()["charts/survival"])
    # One episode in ten is lost inside reset, with survival 0.
    assert np.mean(survival[:2]) < 0.7
    assert np.mean(survival[-5:]) > 0.82


def test_untrained_policy_does_nothing_as_often_as_asked():
    args = replace(SMALL, initial_do_nothing=0.6)
    trainer = PPO(args, ToyGrid(args.num_envs))
    observations = torch.randn(50, trainer.network.observation_size, generator=torch.Generator().manual_seed(0))
    probabilities = trainer.network.actor(observations).softmax(-1)[:, 0]
    assert torch.allclose(probabilities, torch.full((50,), 0.6), atol=0.05)
    with pytest.raises(UsageError, match="initial_do_nothing above 0 and below 1"):
        replace(SMALL, initial_do_nothing=1.0)


def test_the_best_continuous_action_is_found_and_explored_less_and_less():
    """It pays minus the squared distance to 0.2 + 0.5 x: a spread policy pays less, so the deviation shrinks."""
    args = replace(
        SMALL_CONTINUOUS,
        total_timesteps=200 * 256,
        num_envs=16,
        num_minibatches=1,
        update_epochs=4,
        reward_scale=1.0,
        actor_learning_rate=3e-3,
        critic_learning_rate=1e-2,
        entropy_coefficient=0.0,
        normalize_observations=False,
        actor_layers=(32,),
        critic_layers=(32,),
        initial_log_std=-1.0,
    )
    learner = PPO(args, Lever(16))
    while not learner.finished:
        learner.iterate()
    observations = torch.linspace(-1.0, 1.0, 9).unsqueeze(1)
    with torch.no_grad():
        actions = learner.network.act(observations, None, None)
    torch.testing.assert_close(actions, Lever.best(observations), rtol=0, atol=0.08)
    assert float(learner.network.log_std.detach().exp()) < 0.2


# --- Devices --------------------------------------------------------------------------------------------------------


def test_auto_takes_cuda_where_there_is_one(monkeypatch: pytest.MonkeyPatch):
    assert trainer(device="auto").device.type == ("cuda" if torch.cuda.is_available() else "cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert trainer(device="auto").device.type == "cpu"
    with pytest.raises(UsageError, match="finds no CUDA device"):
        trainer(device="cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@BOTH
def test_a_run_begun_on_cuda_is_reproducible_and_goes_on_on_the_cpu(continuous: bool, tmp_path: Path):
    first, second = trainer(continuous, device="cuda"), trainer(continuous, device="cuda")
    for _ in range(3):
        first.iterate()
        second.iterate()
    assert_same(weights(first), weights(second))
    save_checkpoint(tmp_path / "c.pt", {"task": "t", "training": first.state_dict(), "policy": first.policy_state()})
    checkpoint = load_checkpoint(tmp_path / "c.pt")
    resumed = trainer(continuous)
    resumed.load_state_dict(checkpoint["training"])
    resumed.iterate()
    assert load_policy(checkpoint["policy"]).actor[0].weight.device.type == "cpu"


def test_a_checkpoint_of_an_earlier_version_is_refused_in_a_sentence():
    state = trainer().state_dict()
    state["optimizer"] = state.pop("actor_optimizer")
    with pytest.raises(UsageError, match="holds no actor_optimizer: an earlier version of PPO wrote it"):
        trainer().load_state_dict(state)
