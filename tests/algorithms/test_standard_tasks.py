"""Tasks of Gymnasium for the off-policy algorithms; PPO's, and tasks of known optima, are in each algorithm's tests."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import RescaleAction
from toy_tasks import vector

from rl2grid.algorithms import dqn, sac, td3
from rl2grid.algorithms.off_policy import OffPolicyTrainer

PENDULUM: dict[str, Any] = {
    "seed": 1,
    "num_steps": 50,
    "batch_size": 64,
    "mask_actions": False,
    "normalize_observations": False,
    "total_timesteps": 8_000,
    "num_envs": 4,
    "learning_starts": 800,
    "train_frequency": 1,
    "gamma": 0.95,
    "reward_scale": 0.1,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 2e-3,
    "tau": 0.01,
    "actor_layers": (64, 64),
    "critic_layers": (64, 64),
}


CARTPOLE: dict[str, Any] = {
    "seed": 1,
    "num_steps": 64,
    "mask_actions": False,
    "normalize_observations": False,
    "learning_starts": 1_000,
    "train_frequency": 2,
    "gamma": 0.99,
}


def cartpole(num_envs: int) -> SyncVectorEnv:
    """A pole on a cart, a reward of 1 per step; given up after 500 steps. At random it falls after some 20."""
    return vector(lambda: gymnasium.make("CartPole-v1"), num_envs)


def pendulum(num_envs: int) -> SyncVectorEnv:
    """With the torque as a share of the largest."""
    return vector(lambda: RescaleAction(gymnasium.make("Pendulum-v1"), np.float32(-1.0), np.float32(1.0)), num_envs)


def mean_return(trainer: OffPolicyTrainer, envs: SyncVectorEnv) -> float:
    """Of the deterministic policy after training, over one episode in each environment."""
    while not trainer.finished:
        trainer.iterate()
    network: Any = trainer.policy()[0]
    observations, _ = envs.reset(seed=1000)
    returns, alive = np.zeros(envs.num_envs), np.ones(envs.num_envs, np.bool_)
    while alive.any():
        with torch.no_grad():
            actions = network.act(torch.as_tensor(observations), None, None)
        observations, rewards, terminated, truncated, _ = envs.step(actions.numpy())
        returns += rewards * alive
        alive &= ~(terminated | truncated)
    return float(returns.mean())


@pytest.mark.slow
def test_sac_swings_the_pendulum_up():
    assert mean_return(sac.SAC(sac.Args(**PENDULUM), pendulum(4)), pendulum(10)) > -250.0  # at random -1200


@pytest.mark.slow
def test_td3_swings_the_pendulum_up():
    assert mean_return(td3.TD3(td3.Args(**PENDULUM), pendulum(4)), pendulum(10)) > -250.0


@pytest.mark.slow
def test_discrete_sac_solves_cartpole():
    args = sac.Args(
        **CARTPOLE,
        total_timesteps=40_000,
        num_envs=4,
        batch_size=128,
        reward_scale=0.02,
        actor_learning_rate=5e-4,
        critic_learning_rate=1e-3,
        tau=0.01,
        initial_temperature=0.1,
        first_entropy_share=0.5,
        last_entropy_share=0.05,
        actor_layers=(64, 64),
        critic_layers=(64, 64),
    )
    assert mean_return(sac.SAC(args, cartpole(4)), cartpole(10)) >= 475.0  # solved; seeds 1, 2, 3: 500


@pytest.mark.slow
def test_dqn_balances_the_pole():
    args = dqn.Args(
        **CARTPOLE,
        total_timesteps=50_000,
        num_envs=8,
        batch_size=64,
        reward_scale=1.0,
        learning_rate=1e-3,
        target_frequency=250,
        first_epsilon=1.0,
        last_epsilon=0.04,
        epsilon_decay_fraction=0.16,
    )
    # The last policy, not the best: DQN's rises and falls. Seeds 1, 2, 3, 4: 500, 500, 251, 500.
    assert mean_return(dqn.DQN(args, cartpole(8)), cartpole(10)) > 150.0
