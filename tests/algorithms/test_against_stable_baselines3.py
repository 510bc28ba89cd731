"""What the algorithms compute against what stable-baselines3 computes from the same weights and the same numbers.

Its own code is run, no copy of its formulas: its networks are given our weights, both learn from the same transitions
by plain gradient descent, and must end with the same weights. Where both scale a loss differently, the step sizes make
up for it; the factor is written down where it is used. Both compute in float32.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
import stable_baselines3
import torch
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from specs import networks
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples, RolloutBufferSamples
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import Tensor, nn

from rl2grid.algorithms import dqn, lagrangian_ppo, ppo, sac, td3
from rl2grid.algorithms.off_policy import Batch, OffPolicyTrainer, follow

TOLERANCE = 1e-5
"""Absolute and relative; both compute in float32, in another order of operations."""
SEEDS = pytest.mark.parametrize("seed", [0, 1, 2])
BOTH = pytest.mark.parametrize("continuous", [False, True], ids=["categorical", "gaussian"])
GRID_STEPS = pytest.mark.parametrize("grid_steps", [1, 6], ids=["one_step", "up_to_six_steps"])

OBSERVATION_SIZE, ACTION_SIZE, BATCH_SIZE = 5, 3, 64
GAMMA, RATE = 0.95, 0.1
NO_CLIPPING = 1e9


def agree(ours: Any, theirs: Any) -> None:
    """Fail unless both are the same within the tolerance."""
    np.testing.assert_allclose(
        np.asarray(torch.as_tensor(ours).detach()),
        np.asarray(torch.as_tensor(theirs).detach()),
        rtol=TOLERANCE,
        atol=TOLERANCE,
    )


def linear_layers(*modules: nn.Module) -> list[nn.Linear]:
    """The layers with weights, from input to output."""
    return [layer for module in modules for layer in module.modules() if isinstance(layer, nn.Linear)]


def copy_weights(theirs: Sequence[nn.Linear], ours: Sequence[nn.Linear]) -> None:
    """Give their layers our weights."""
    for their_layer, our_layer in zip(theirs, ours, strict=True):
        their_layer.load_state_dict(our_layer.state_dict())


def weights(layers: Iterable[nn.Linear]) -> Tensor:
    """All weights and biases in a row, a copy."""
    return torch.cat([parameter.detach().flatten() for layer in layers for parameter in layer.parameters()])


class Script(gymnasium.Env[Any, Any]):
    """Random observations, rewards and endings of all kinds, whatever is done: a function of the script's number."""

    def __init__(self, number: int, *, continuous: bool) -> None:
        self.observation_space = Box(-np.inf, np.inf, (OBSERVATION_SIZE,), np.float32)
        self.action_space = Box(-1.0, 1.0, (ACTION_SIZE,), np.float32) if continuous else Discrete(ACTION_SIZE)
        self._random = np.random.default_rng(number)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        kind = self._random.random()
        terminated, truncated = kind < 0.1, kind < 0.03 or kind > 0.85
        return self._observation(), float(self._random.normal()), terminated, truncated, {}

    def _observation(self) -> Any:
        return self._random.normal(size=OBSERVATION_SIZE).astype(np.float32)


def scripts(seed: int, count: int, *, continuous: bool) -> list[Any]:
    """Makers of scripts."""
    return [lambda i=i: Script(seed * count + i, continuous=continuous) for i in range(count)]


def our_scripts(seed: int, count: int, *, continuous: bool) -> Any:
    """They as our algorithms need them."""
    return SyncVectorEnv(scripts(seed, count, continuous=continuous), autoreset_mode=AutoresetMode.SAME_STEP)


def their_scripts(seed: int, count: int, *, continuous: bool) -> DummyVecEnv:
    """They as theirs need them."""
    return DummyVecEnv(scripts(seed, count, continuous=continuous))


# --- PPO ------------------------------------------------------------------------------------------------------------

NUM_ENVS, NUM_STEPS = 4, 32


class Pair(NamedTuple):
    """Our PPO and theirs, of equal weights, in the same scripts."""

    ours: ppo.PPO
    theirs: stable_baselines3.PPO


def ppo_args(seed: int, *, continuous: bool, **changes: Any) -> ppo.Args:
    """One descent per rollout."""
    fixed: dict[str, Any] = {
        "seed": seed,
        "total_timesteps": 10 * NUM_ENVS * NUM_STEPS,
        "num_envs": NUM_ENVS,
        "num_steps": NUM_STEPS,
        "gamma": GAMMA,
        "gae_lambda": 0.9,
        "reward_scale": 1.0,
        "actor_learning_rate": RATE,
        "critic_learning_rate": RATE,
        "anneal_learning_rate": False,
        "num_minibatches": 1,
        "update_epochs": 1,
        "normalize_advantages": False,
        "entropy_coefficient": 0.02,
        "value_coefficient": 0.5,
        "max_grad_norm": NO_CLIPPING,
        "target_kl": None,
        "mask_actions": False,
        "normalize_observations": False,
        "actor_layers": (8, 8),
        "critic_layers": (8,),
    }
    return ppo.Args(**{**fixed, **changes})


def ppo_pair(seed: int, *, continuous: bool, **theirs: Any) -> Pair:
    """Both have random actors far from indifferent; ``theirs`` changes the arguments of the other library."""
    args = ppo_args(seed, continuous=continuous)
    ours = ppo.PPO(args, our_scripts(seed, NUM_ENVS, continuous=continuous))
    with torch.no_grad():
        ours.network.actor[-1].weight.mul_(100.0)  # type: ignore[union-attr, operator]
        if continuous:
            ours.network.log_std.copy_(torch.linspace(-1.0, 0.5, ACTION_SIZE))
    ours.actor_optimizer, ours.critic_optimizer = (  # type: ignore[assignment]
        torch.optim.SGD(optimizer.param_groups, lr=RATE) for optimizer in (ours.actor_optimizer, ours.critic_optimizer)
    )
    model = stable_baselines3.PPO(
        "MlpPolicy",
        their_scripts(seed, NUM_ENVS, continuous=continuous),
        **{
            "learning_rate": RATE,
            "n_steps": NUM_STEPS,
            "batch_size": NUM_ENVS * NUM_STEPS,
            "n_epochs": 1,
            "gamma": args.gamma,
            "gae_lambda": args.gae_lambda,
            "clip_range": args.clip_coefficient,
            "normalize_advantage": False,
            "ent_coef": args.entropy_coefficient,
            # Ours is half the squared error.
            "vf_coef": 0.5 * args.value_coefficient,
            "max_grad_norm": NO_CLIPPING,
            "device": "cpu",
            "policy_kwargs": {
                "net_arch": {"pi": [8, 8], "vf": [8]},
                "activation_fn": nn.Tanh,
                "optimizer_class": torch.optim.SGD,
            },
            **theirs,
        },
    )
    copy_weights(their_ppo_layers(model), our_ppo_layers(ours))
    if continuous:
        model.policy.log_std.data.copy_(ours.network.log_std.detach())
    model.set_logger(Logger(None, []))
    return Pair(ours, model)


def our_ppo_layers(ours: ppo.PPO) -> list[nn.Linear]:
    return linear_layers(ours.network.actor, ours.network.critic)


def their_ppo_layers(model: stable_baselines3.PPO) -> list[nn.Linear]:
    policy = model.policy
    return linear_layers(
        policy.mlp_extractor.policy_net, policy.action_net, policy.mlp_extractor.value_net, policy.value_net
    )


def random_choices(seed: int, *, continuous: bool) -> tuple[Tensor, Tensor]:
    """Observations and actions, the continuous ones before clipping."""
    generator = torch.Generator().manual_seed(seed)
    observations = torch.randn(BATCH_SIZE, OBSERVATION_SIZE, generator=generator)
    if continuous:
        return observations, torch.randn(BATCH_SIZE, ACTION_SIZE, generator=generator)
    return observations, torch.randint(ACTION_SIZE, (BATCH_SIZE,), generator=generator)


@BOTH
@SEEDS
def test_ppo_probabilities_entropies_and_values(seed: int, continuous: bool):
    ours, theirs = ppo_pair(seed, continuous=continuous)
    observations, actions = random_choices(seed, continuous=continuous)
    values, log_probabilities, entropies = theirs.policy.evaluate_actions(observations, actions)
    our_log_probabilities, our_entropies = ours.network.log_probability_and_entropy(observations, actions, None)
    agree(our_log_probabilities, log_probabilities)
    agree(our_entropies, entropies)
    agree(ours.network.value(observations), values.squeeze(-1))
    agree(ours.network.act(observations, None, None), theirs.policy._predict(observations, deterministic=True))


@BOTH
@SEEDS
def test_ppo_advantages_whatever_ends_the_episodes(seed: int, continuous: bool):
    """The scripts do not depend on actions: both see the same terminations and truncations, and bootstrap alike."""
    ours, theirs = ppo_pair(seed, continuous=continuous)
    ours.observations, _ = ours.envs.reset()
    rollout, _ = ours.collect()
    assert 5 < int(rollout.ended.sum()) < NUM_ENVS * NUM_STEPS / 2
    assert 1 < int((rollout.ended & (rollout.next_values == 0.0)).sum()) < int(rollout.ended.sum())
    theirs.learn(NUM_ENVS * NUM_STEPS)
    # By now their buffer is flattened, environment by environment.
    advantages, returns = (
        torch.as_tensor(column).reshape(NUM_ENVS, NUM_STEPS).T
        for column in (theirs.rollout_buffer.advantages, theirs.rollout_buffer.returns)
    )
    our_advantages = ppo.advantages_of_rewards(rollout, ours.args.gae_lambda)
    agree(our_advantages, advantages)
    agree(our_advantages + rollout.values, returns)


def random_rollout(ours: ppo.PPO, seed: int) -> ppo.Rollout:
    """Of actions that were more or less probable when they were chosen, and of values that were others."""
    generator = torch.Generator().manual_seed(seed)
    shape = (NUM_STEPS, NUM_ENVS)
    observations = torch.randn(*shape, OBSERVATION_SIZE, generator=generator)
    with torch.no_grad():
        actions = ours.network.act(observations.flatten(0, 1), None, generator)
        log_probabilities, _ = ours.network.log_probability_and_entropy(observations.flatten(0, 1), actions, None)
        values = ours.network.value(observations)
    return ppo.Rollout(
        observations,
        None,
        actions.unflatten(0, shape),
        log_probabilities.unflatten(0, shape) + 0.3 * torch.randn(shape, generator=generator),
        rewards=torch.randn(shape, generator=generator),
        discounts=torch.full(shape, GAMMA),
        values=values + 0.3 * torch.randn(shape, generator=generator),
        next_values=torch.randn(shape, generator=generator),
        ended=torch.rand(shape, generator=generator) < 0.1,
        decided=torch.ones(shape, dtype=torch.bool),
    )


def minibatch_of(rollout: ppo.Rollout) -> ppo.Minibatch:
    """All of it."""
    advantages = ppo.advantages_of_rewards(rollout, 0.9)
    return ppo.Minibatch(
        rollout.observations.flatten(0, 1),
        None,
        rollout.actions.flatten(0, 1),
        rollout.log_probabilities.flatten(),
        rollout.values.flatten(),
        advantages.flatten(),
        (advantages + rollout.values).flatten(),
    )


def train_theirs(theirs: stable_baselines3.PPO, batch: ppo.Minibatch) -> dict[str, Any]:
    """Let them descend on a minibatch, and return what they log of it."""
    samples = RolloutBufferSamples(
        batch.observations,
        batch.actions.reshape(len(batch.actions), -1).to(torch.float32),
        batch.values,
        batch.log_probabilities,
        batch.advantages,
        batch.returns,
    )
    theirs.rollout_buffer.get = lambda batch_size: iter([samples])  # type: ignore[method-assign, assignment]
    theirs.train()
    return dict(theirs.logger.name_to_value)


@BOTH
@SEEDS
def test_ppo_descends_to_the_same_weights(seed: int, continuous: bool):
    ours, theirs = ppo_pair(seed, continuous=continuous)
    before = weights(our_ppo_layers(ours))
    rollout = random_rollout(ours, seed)
    record = train_theirs(theirs, minibatch_of(rollout))
    metrics = ours.update(rollout)
    agree(metrics["losses/policy_loss"], record["train/policy_gradient_loss"])
    agree(metrics["losses/value_loss"], 0.5 * record["train/value_loss"])
    agree(metrics["losses/entropy"], -record["train/entropy_loss"])
    agree(metrics["losses/approx_kl"], record["train/approx_kl"])
    agree(metrics["losses/clipfrac"], record["train/clip_fraction"])
    assert 0.2 < metrics["losses/clipfrac"] < 0.8
    agree(weights(our_ppo_layers(ours)), weights(their_ppo_layers(theirs)))
    assert (weights(our_ppo_layers(ours)) - before).abs().max() > 1e-2
    if continuous:
        agree(ours.network.log_std, theirs.policy.log_std)


@BOTH
def test_ppo_normalises_advantages_by_their_own_deviation(continuous: bool):
    """That of the minibatch itself; theirs is the estimate with n - 1."""
    ours, theirs = ppo_pair(0, continuous=continuous, normalize_advantage=True)
    batch = minibatch_of(random_rollout(ours, 0))
    loss = ppo.policy_losses(ours.network, batch, ppo_args(0, continuous=continuous, normalize_advantages=True))
    n = len(batch.actions)
    agree(loss.policy, train_theirs(theirs, batch)["train/policy_gradient_loss"] * np.sqrt(n / (n - 1)))


def test_ppo_clips_the_value_loss_to_the_larger_of_their_two():
    """They have the loss with and without clipping, here of one transition at a time; ours takes the larger one."""
    ours, theirs = ppo_pair(1, continuous=False, learning_rate=0.0)
    batch = minibatch_of(random_rollout(ours, 1)).rows(torch.arange(24))
    single = [batch.rows(torch.tensor([k])) for k in range(24)]
    plain = [train_theirs(theirs, one)["train/value_loss"] for one in single]
    theirs.clip_range_vf = lambda _: 0.2
    clipped = [train_theirs(theirs, one)["train/value_loss"] for one in single]
    assert (np.greater(clipped, plain).any(), np.less(clipped, plain).any()) == (True, True)
    loss = ppo.critic_losses(ours.network, batch, ppo_args(1, continuous=False, clip_value_loss=True))
    agree(loss.value, 0.5 * np.maximum(plain, clipped).mean())


@BOTH
@SEEDS
def test_lagrangian_ppo_without_a_price_has_the_losses_of_ppo(seed: int, continuous: bool):
    ours, theirs = ppo_pair(seed, continuous=continuous)
    batch = minibatch_of(random_rollout(ours, seed))
    costs = torch.randn(len(batch.actions), 2, generator=torch.Generator().manual_seed(seed))
    lagrangian = lagrangian_ppo.ActorCritic(
        networks(OBSERVATION_SIZE, ACTION_SIZE, continuous=continuous),
        n_costs=2,
        actor_layers=(8, 8),
        critic_layers=(8,),
    )
    lagrangian.load_state_dict(ours.network.state_dict(), strict=False)
    args = lagrangian_ppo.Args(normalize_advantages=False, mask_actions=False, clip_coefficient=0.2)
    advantages = lagrangian_ppo.lagrangian_advantages(batch.advantages, costs, torch.zeros(2))
    columns = {**vars(batch), "advantages": advantages}
    priced = lagrangian_ppo.Minibatch(**columns, cost_values=costs, cost_returns=costs)
    loss, record = ppo.policy_losses(lagrangian, priced, args), train_theirs(theirs, batch)
    agree(loss.policy, record["train/policy_gradient_loss"])
    agree(lagrangian_ppo.critic_losses(lagrangian, priced, args).value, 0.5 * record["train/value_loss"])
    agree(loss.entropy, -record["train/entropy_loss"])


# --- Transitions for the others -------------------------------------------------------------------------------------


class Transitions(NamedTuple):
    """The same transitions for us and for them."""

    ours: Batch
    theirs: ReplayBufferSamples


def random_transitions(seed: int, grid_steps: int, *, continuous: bool) -> Transitions:
    """Of up to ``grid_steps`` grid steps each; one in five ends in a game over."""
    generator = torch.Generator().manual_seed(100 + seed)
    observations, actions = random_choices(seed, continuous=continuous)
    next_observations = torch.randn(BATCH_SIZE, OBSERVATION_SIZE, generator=generator)
    rewards = torch.randn(BATCH_SIZE, generator=generator)
    lost = torch.rand(BATCH_SIZE, generator=generator) < 0.2
    discounts = GAMMA ** torch.randint(1, grid_steps + 1, (BATCH_SIZE,), generator=generator)
    if continuous:
        actions = actions.tanh()
    columns = (rewards.unsqueeze(-1), None if grid_steps == 1 else discounts.unsqueeze(-1))
    shaped = actions if continuous else actions.unsqueeze(-1)
    return Transitions(
        Batch(observations, None, actions, rewards, torch.where(lost, 0.0, discounts), next_observations, None),
        ReplayBufferSamples(observations, shaped, next_observations, lost.float().unsqueeze(-1), *columns),
    )


def off_policy_args(seed: int, **changes: Any) -> dict[str, Any]:
    return {
        "seed": seed,
        "total_timesteps": 1_000,
        "num_envs": 2,
        "num_steps": 10,
        "gamma": GAMMA,
        "reward_scale": 1.0,
        "max_grad_norm": NO_CLIPPING,
        "mask_actions": False,
        "normalize_observations": False,
        **changes,
    }


def their_arguments(seed: int, *, continuous: bool) -> dict[str, Any]:
    return {
        "policy": "MlpPolicy",
        "env": their_scripts(seed, 1, continuous=continuous),
        "learning_rate": RATE,
        "buffer_size": 1,
        "gamma": GAMMA,
        "device": "cpu",
    }


def descend(ours: OffPolicyTrainer, theirs: Any, transitions: Transitions) -> tuple[dict[str, float], dict[str, Any]]:
    """One update of both; returns both sides' metrics."""
    theirs.set_logger(Logger(None, []))
    theirs.replay_buffer.sample = lambda *args, **keywords: transitions.theirs
    ours.updates += 1
    metrics = {name: float(value.detach()) for name, value in ours.learn(transitions.ours).items()}
    theirs.train(1, BATCH_SIZE)
    return metrics, dict(theirs.logger.name_to_value)


def plain_descent(parameters: Iterable[nn.Parameter], rate: float) -> torch.optim.SGD:
    return torch.optim.SGD(parameters, lr=rate)


def test_slow_copies_move_alike():
    made = networks(4, 2)
    online, slow = (dqn.QNetwork(made, (8,)) for _ in range(2))
    theirs = dqn.QNetwork(made, (8,))
    theirs.load_state_dict(slow.state_dict())
    follow(slow, online, 0.3)
    polyak_update(online.parameters(), theirs.parameters(), 0.3)
    agree(weights(linear_layers(slow)), weights(linear_layers(theirs)))


# --- DQN ------------------------------------------------------------------------------------------------------------


def dqn_pair(seed: int) -> tuple[dqn.DQN, stable_baselines3.DQN]:
    args = dqn.Args(**off_policy_args(seed, layers=(8, 8), huber_delta=1.0, target_frequency=10_000))
    ours = dqn.DQN(args, our_scripts(seed, 2, continuous=False))
    # So that the best action depends on the observation.
    scatter(ours.network, ours.generator)
    ours.target.load_state_dict(ours.network.state_dict())
    # Our Huber loss is e squared near 0, theirs half of it.
    ours.optimizer = plain_descent(ours.network.parameters(), RATE / 2.0)  # type: ignore[assignment]
    theirs = stable_baselines3.DQN(
        **their_arguments(seed, continuous=False),
        max_grad_norm=NO_CLIPPING,
        policy_kwargs={"net_arch": [8, 8], "optimizer_class": torch.optim.SGD},
    )
    copy_weights(linear_layers(theirs.q_net), linear_layers(ours.network))
    copy_weights(linear_layers(theirs.q_net_target), linear_layers(ours.target))
    return ours, theirs


def scatter(network: nn.Module, generator: torch.Generator) -> None:
    """Other weights, and no biases."""
    for layer in linear_layers(network):
        nn.init.normal_(layer.weight, generator=generator)
        nn.init.zeros_(layer.bias)


@GRID_STEPS
@SEEDS
def test_dqn_descends_to_the_same_weights(seed: int, grid_steps: int):
    """Theirs is not double, which makes no difference as long as the target network equals the other one."""
    ours, theirs = dqn_pair(seed)
    before = weights(linear_layers(ours.network))
    transitions = random_transitions(seed, grid_steps, continuous=False)
    metrics, record = descend(ours, theirs, transitions)
    agree(metrics["losses/qf_loss"], 2.0 * record["train/loss"])
    agree(weights(linear_layers(ours.network)), weights(linear_layers(theirs.q_net)))
    assert (weights(linear_layers(ours.network)) - before).abs().max() > 1e-3


@SEEDS
def test_dqn_takes_the_value_from_their_target_network_of_the_best_action_of_their_network(seed: int):
    ours, theirs = dqn_pair(seed)
    transitions = random_transitions(seed, 6, continuous=False)
    scatter(ours.target, ours.generator)
    copy_weights(linear_layers(theirs.q_net_target), linear_layers(ours.target))
    samples = transitions.theirs
    with torch.no_grad():
        best = theirs.q_net(samples.next_observations).argmax(dim=1, keepdim=True)
        values = theirs.q_net_target(samples.next_observations)
        aims = samples.rewards + (1.0 - samples.dones) * samples.discounts * values.gather(1, best)
    assert (values.argmax(dim=1, keepdim=True) != best).any()
    agree(dqn.targets(ours.network, ours.target, transitions.ours), aims.squeeze(-1))


# --- TD3 ------------------------------------------------------------------------------------------------------------


def td3_pair(seed: int) -> tuple[td3.TD3, stable_baselines3.TD3]:
    layers = {"actor_layers": (8, 8), "critic_layers": (8,)}
    noise = {"policy_noise": 0.3, "noise_clip": 0.4}
    ours = td3.TD3(
        td3.Args(**off_policy_args(seed, tau=0.2, policy_frequency=2, **noise, **layers)),
        our_scripts(seed, 2, continuous=True),
    )
    ours.actor_optimizer = plain_descent(ours.actor.parameters(), RATE)  # type: ignore[assignment]
    ours.critic_optimizer = plain_descent(ours.critics.parameters(), RATE)  # type: ignore[assignment]
    theirs = stable_baselines3.TD3(
        **their_arguments(seed, continuous=True),
        tau=0.2,
        policy_delay=2,
        target_policy_noise=noise["policy_noise"],
        target_noise_clip=noise["noise_clip"],
        policy_kwargs={"net_arch": {"pi": [8, 8], "qf": [8]}, "optimizer_class": torch.optim.SGD},
    )
    for their_part, our_part in td3_parts(ours, theirs):
        copy_weights(linear_layers(their_part), linear_layers(our_part))
    return ours, theirs


def td3_parts(ours: td3.TD3, theirs: stable_baselines3.TD3) -> list[tuple[nn.Module, nn.Module]]:
    """Their networks and ours."""
    return [
        (theirs.actor, ours.actor),
        (theirs.critic, ours.critics),
        (theirs.actor_target, ours.slow_actor),
        (theirs.critic_target, ours.slow_critics),
    ]


@GRID_STEPS
@SEEDS
def test_td3_descends_to_the_same_weights(seed: int, grid_steps: int):
    """Four updates, two of them of the policy; both draw the noise of the targets from generators of one seed."""
    ours, theirs = td3_pair(seed)
    before = [weights(linear_layers(our_part)) for _, our_part in td3_parts(ours, theirs)]
    for k in range(4):
        ours.generator.manual_seed(k)
        torch.manual_seed(k)
        metrics, record = descend(ours, theirs, random_transitions(10 * seed + k, grid_steps, continuous=True))
        agree(metrics["losses/qf_loss"], record["train/critic_loss"])
        assert ("losses/actor_loss" in metrics) == ("train/actor_loss" in record) == (k % 2 == 1)
        if k % 2 == 1:
            agree(metrics["losses/actor_loss"], record["train/actor_loss"])
        for their_part, our_part in td3_parts(ours, theirs):
            agree(weights(linear_layers(our_part)), weights(linear_layers(their_part)))
    for start, (_, our_part) in zip(before, td3_parts(ours, theirs), strict=True):
        assert (weights(linear_layers(our_part)) - start).abs().max() > 1e-3


# --- SAC, continuous ------------------------------------------------------------------------------------------------


class OurBounds(nn.Module):
    """Our log deviations from what the network gives, well within their bounds, which then do nothing."""

    def forward(self, outputs: Tensor) -> Tensor:
        low, high = sac._LOG_STD_RANGE
        return low + 0.5 * (high - low) * (outputs.tanh() + 1.0)


def sac_pair(seed: int) -> tuple[sac.SAC, stable_baselines3.SAC]:
    args = sac.Args(**off_policy_args(seed, tau=0.2, initial_temperature=0.3, actor_layers=(8, 8), critic_layers=(8,)))
    ours = sac.SAC(args, our_scripts(seed, 2, continuous=True))
    ours.actor_optimizer = plain_descent(ours.actor.parameters(), RATE)  # type: ignore[assignment]
    # Our critics' loss is the sum of their errors, theirs half of it.
    ours.critic_optimizer = plain_descent(ours.critics.parameters(), RATE / 2.0)  # type: ignore[assignment]
    # Our temperature's loss is alpha (H - target), theirs log alpha (H - target).
    ours.temperature_optimizer = plain_descent(ours.temperature.parameters(), RATE / 0.3)  # type: ignore[assignment]
    theirs = stable_baselines3.SAC(
        **their_arguments(seed, continuous=True),
        tau=0.2,
        ent_coef="auto_0.3",
        policy_kwargs={"net_arch": {"pi": [8, 8], "qf": [8]}, "optimizer_class": torch.optim.SGD},
    )
    assert theirs.target_entropy == args.entropy_per_dimension * ACTION_SIZE
    theirs.ent_coef_optimizer = plain_descent([theirs.log_ent_coef], RATE)  # type: ignore[assignment, list-item]
    # They add it to 1 - tanh(u)^2 against logarithms of zero, which ours does not need.
    theirs.actor.action_dist.epsilon = 0.0
    *hidden, last = linear_layers(ours.actor)
    copy_weights(linear_layers(theirs.actor.latent_pi), hidden)
    halves = zip((theirs.actor.mu, theirs.actor.log_std), last.weight.chunk(2), last.bias.chunk(2), strict=True)
    for layer, weight, bias in halves:
        layer.load_state_dict({"weight": weight, "bias": bias})
    theirs.actor.log_std = nn.Sequential(theirs.actor.log_std, OurBounds())
    for their_part, our_part in ((theirs.critic, ours.critics), (theirs.critic_target, ours.slow)):
        copy_weights(linear_layers(their_part), linear_layers(our_part))
    return ours, theirs


def their_actor_weights(theirs: stable_baselines3.SAC) -> Tensor:
    """In our order, in which one layer gives the means and the deviations."""
    actor = theirs.actor
    (mean,), (deviation,) = linear_layers(actor.mu), linear_layers(actor.log_std)
    last = [torch.cat(pair).flatten() for pair in ((mean.weight, deviation.weight), (mean.bias, deviation.bias))]
    return torch.cat([weights(linear_layers(actor.latent_pi)), *last]).detach()


@GRID_STEPS
@SEEDS
def test_sac_descends_to_the_same_weights(seed: int, grid_steps: int, monkeypatch: pytest.MonkeyPatch):
    """Both are given the same noise; they need it for s_k first, we for s_{k+1}."""
    ours, theirs = sac_pair(seed)
    before = weights(linear_layers(ours.actor, ours.critics, ours.slow))
    torch.manual_seed(seed)
    at_present, at_next = torch.randn(2, BATCH_SIZE, ACTION_SIZE)
    noise = iter([at_next, at_present])
    monkeypatch.setattr(ours, "_noise", lambda batch: next(noise))
    drawn = iter([at_present, at_next])
    monkeypatch.setattr("torch.distributions.normal._standard_normal", lambda *args, **keywords: next(drawn))

    metrics, record = descend(ours, theirs, random_transitions(seed, grid_steps, continuous=True))
    agree(metrics["losses/qf_loss"], 2.0 * record["train/critic_loss"])
    agree(metrics["losses/actor_loss"], record["train/actor_loss"])
    agree(metrics["losses/alpha_loss"] / 0.3, record["train/ent_coef_loss"] / np.log(0.3))
    agree(metrics["losses/alpha"], record["train/ent_coef"])
    agree(ours.temperature.logarithm, theirs.log_ent_coef.squeeze())
    agree(weights(linear_layers(ours.actor)), their_actor_weights(theirs))
    agree(weights(linear_layers(ours.critics)), weights(linear_layers(theirs.critic)))
    agree(weights(linear_layers(ours.slow)), weights(linear_layers(theirs.critic_target)))
    assert (weights(linear_layers(ours.actor, ours.critics, ours.slow)) - before).abs().max() > 1e-2


@SEEDS
def test_sac_densities_of_squashed_samples(seed: int):
    """Where 1 - tanh(u)^2 is large against the 1e-6 that they add to it."""
    generator = torch.Generator().manual_seed(seed)
    means, log_stds = torch.randn(BATCH_SIZE, ACTION_SIZE, generator=generator).tanh(), torch.tensor([-1.0, -0.3, 0.2])
    unsquashed = torch.rand(BATCH_SIZE, ACTION_SIZE, generator=generator) * 2.0 - 1.0
    theirs = SquashedDiagGaussianDistribution(ACTION_SIZE).proba_distribution(means, log_stds)
    log_densities = theirs.log_prob(unsquashed.tanh(), unsquashed)
    agree(sac.squashed_log_densities(unsquashed, means, log_stds.expand_as(means)), log_densities)
