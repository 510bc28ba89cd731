"""What every algorithm learns from a decision is the discounted return that was really earned after it.

Policies that were never trained play bus14 with a heuristic that is at work before the first decision; every reward and
cost of a grid step is written down while it is played.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

from rl2grid.algorithms import dqn, lagrangian_ppo, ppo, sac, td3
from rl2grid.algorithms.on_policy import advantages_of_rewards
from rl2grid.algorithms.playing import check_discount
from rl2grid.algorithms.registry import algorithm_names, find_algorithm
from rl2grid.envs.joint import VectorJointAsBox, VectorJointAsDiscrete
from rl2grid.errors import UsageError

GAMMA, NUM_ENVS, NUM_STEPS = 0.97, 4, 30
TRAINERS: dict[str, tuple[Callable[..., Any], Any, str]] = {
    "ppo": (ppo.PPO, ppo.Args, "T0"),
    "ppo-continuous": (ppo.PPO, ppo.Args, "R"),
    "lagrangian-ppo": (lagrangian_ppo.LagrangianPPO, partial(lagrangian_ppo.Args, constraints=("TLO",)), "T0"),
    "dqn": (dqn.DQN, dqn.Args, "T0"),
    "sac": (sac.SAC, sac.Args, "T0"),
    "sac-continuous": (sac.SAC, sac.Args, "R"),
    "td3": (td3.TD3, td3.Args, "R"),
    "ppo-joint": (ppo.PPO, ppo.Args, "H0"),
    "dqn-joint": (dqn.DQN, dqn.Args, "H0"),
    "td3-joint": (td3.TD3, td3.Args, "H0"),
}
"""Every algorithm that learns from what it plays, on each kind of action that it has code for: imitation learns from
the returns of labels."""
ON_POLICY = [name for name in TRAINERS if "ppo" in name]
OFF_POLICY = [name for name in TRAINERS if "ppo" not in name]


@dataclass
class Diary:
    """Rewards and TLO costs of all grid steps, by environment, episode and decision; decision 0 is the reset's."""

    rewards: dict[tuple[int, int], list[list[float]]] = field(default_factory=lambda: defaultdict(list))
    costs: dict[tuple[int, int], list[list[float]]] = field(default_factory=lambda: defaultdict(list))
    episode: dict[int, int] = field(default_factory=lambda: defaultdict(lambda: -1))
    sums: dict[int, tuple[float, float]] = field(default_factory=dict)

    def hear(self, state: Any, i: int) -> None:
        """Listen to a grid step, or to the first row of an episode."""
        if state.step[i] == 0:
            self.episode[i] += 1
            self.sums[i] = 0.0, 0.0
            return
        key, decision = (i, self.episode[i]), int(state.decisions[i])
        now = float(state.episode_return[i]), float(state.episode_costs[i, 1])
        for sums, before, after in zip((self.rewards, self.costs), self.sums[i], now, strict=True):
            while len(sums[key]) <= decision:
                sums[key].append([])
            sums[key][decision].append(after - before)
        self.sums[i] = now

    @property
    def long_resets(self) -> int:
        """Episodes whose reset played more than ten grid steps before the first decision."""
        return sum(len(steps[0]) > 10 for steps in self.rewards.values())

    def discounted_rewards(self, key: tuple[int, int], gamma: float) -> list[float]:
        """Discounted sums of rewards from every decision to the end of an episode, by decision."""
        returns, following = [], 0.0
        for rewards in reversed(self.rewards[key][1:]):
            for reward in reversed(rewards):
                following = reward + gamma * following
            returns.insert(0, following)
        return returns

    def discounted_costs(self, key: tuple[int, int], gamma: float) -> list[float]:
        """As rewards, but the costs of a transition count fully, as the constraint counts them."""
        returns, following = [], 0.0
        for costs in reversed(self.costs[key][1:]):
            following = sum(costs) + gamma ** len(costs) * following
            returns.insert(0, following)
        return returns


def made(name: str, gamma: float = GAMMA, **keywords: Any) -> Any:
    trainer, args, kind = TRAINERS[name]
    keywords = {"heuristic": "idle", "gamma": gamma, **keywords}
    envs: Any = gymnasium.make_vec(f"rl2grid/bus14-{kind}-v0", num_envs=NUM_ENVS, **keywords)
    if kind == "H0":
        envs = VectorJointAsBox(envs) if trainer is td3.TD3 else VectorJointAsDiscrete(envs)
    shared = {"seed": 2, "total_timesteps": NUM_ENVS * NUM_STEPS, "num_envs": NUM_ENVS, "num_steps": NUM_STEPS}
    masked = {"mask_actions": hasattr(envs.single_action_space, "n")}
    return trainer(args(gamma=GAMMA, **shared, **masked), envs)


def listened_to(trainer: Any) -> Diary:
    diary = Diary()
    trainer.envs.unwrapped._rows.transitions.listeners.append(diary.hear)
    return diary


def compare(
    earned: Callable[[tuple[int, int], float], list[float]],
    gamma: float,
    ended: NDArray[np.bool_],
    decided: NDArray[np.bool_],
    target: NDArray[Any],
) -> int:
    """Compare ``target`` [num_steps, num_envs] of the decisions of all episodes that ended; how many there were."""
    compared = 0
    for i in range(NUM_ENVS):
        episode, first = 0, 0
        for k in np.flatnonzero(ended[:, i]):
            rows = [j for j in range(first, k + 1) if decided[j, i]]
            expected = earned((i, episode), gamma)
            assert len(rows) == len(expected)
            np.testing.assert_allclose(target[rows, i], expected, rtol=1e-4, atol=1e-4)
            compared += len(rows)
            episode, first = episode + 1, k + 1
    return compared


def test_no_algorithm_is_left_out():
    packaged = {find_algorithm(name).trainer for name in algorithm_names() if name != "imitation"}
    assert packaged <= {trainer for trainer, _, _ in TRAINERS.values()}


@pytest.mark.parametrize("name", ON_POLICY)
def test_returns_of_a_rollout_are_those_that_were_earned(name):
    trainer = made(name)
    diary = listened_to(trainer)
    trainer.observations = trainer.reset()
    rollout, _ = trainer.collect()
    ended, decided = rollout.ended.numpy(), rollout.decided.numpy()
    # What follows a completed month, or the rollout, is estimated: here by nothing.
    rollout.next_values[-1] = 0.0
    rollout.next_values[rollout.ended] = 0.0
    target = (advantages_of_rewards(rollout, 1.0) + rollout.values).numpy() / trainer.reward_scale
    assert compare(diary.discounted_rewards, GAMMA, ended, decided, target) > 20
    assert diary.long_resets > 3
    if name == "lagrangian-ppo":
        rollout.next_cost_values[-1] = 0.0
        rollout.next_cost_values[rollout.ended] = 0.0
        values = lagrangian_ppo.advantages_of_costs(rollout, 1.0) + rollout.cost_values
        target = values[..., 0].numpy() / trainer.cost_scale
        assert compare(diary.discounted_costs, trainer.cost_gamma, ended, decided, target) > 20
        of_episodes = {key: sum(map(sum, steps)) for key, steps in diary.costs.items()}
        counted = trainer.account.costs[:, 0].tolist()
        assert len(counted) == ended.sum()
        assert sum(counted) == pytest.approx(
            sum(of_episodes[i, e] for i in range(NUM_ENVS) for e in range(int(ended[:, i].sum())))
        )


@pytest.mark.parametrize("name", OFF_POLICY)
def test_targets_of_a_memory_are_the_returns_that_were_earned(name, monkeypatch):
    trainer = made(name)
    diary, steps = listened_to(trainer), []
    monkeypatch.setattr(trainer.memory, "add", steps.append)
    trainer.iterate()
    ended, decided = (np.array([getattr(step, part) for step in steps]) for part in ("ended", "decided"))
    target, following = np.zeros((NUM_STEPS, NUM_ENVS)), np.zeros(NUM_ENVS)
    for k in reversed(range(NUM_STEPS)):
        # The loop of all algorithms: rewards, and what follows as the discount says, which is nothing at a game over.
        following = steps[k].rewards / trainer.reward_scale + np.where(ended[k], 0.0, steps[k].discounts * following)
        target[k] = following
    assert compare(diary.discounted_rewards, GAMMA, ended, decided, target) > 20
    assert diary.long_resets > 3


@pytest.mark.parametrize("name", TRAINERS)
def test_grid_steps_and_returns_of_episodes_count_resets_too(name):
    trainer = made(name)
    diary = listened_to(trainer)
    metrics = trainer.iterate()
    played = [sum(len(part) for part in steps) for steps in diary.rewards.values()]
    assert trainer.grid_steps == sum(played)
    running = {(i, diary.episode[i]) for i in range(NUM_ENVS)}
    returns = [sum(map(sum, steps)) for key, steps in diary.rewards.items() if key not in running]
    assert metrics["charts/episodic_return"] == pytest.approx(np.mean(returns), rel=1e-6)


@pytest.mark.parametrize("vector", [SyncVectorEnv, partial(AsyncVectorEnv, context="spawn")], ids=["sync", "async"])
def test_another_discount_than_that_of_gymnasiums_vectors_is_refused(vector):
    make = partial(gymnasium.make, "rl2grid:rl2grid/bus14-T0-v0", gamma=0.9)
    envs = vector([make], autoreset_mode=AutoresetMode.SAME_STEP)
    args = dqn.Args(gamma=GAMMA, seed=1, total_timesteps=10, num_envs=1, num_steps=10, mask_actions=False)
    with pytest.raises(UsageError, match=r"by gamma=0.9, DQN learns with gamma=0.97"):
        dqn.DQN(args, envs)
    envs.close()


def test_environments_of_others_in_processes_are_not_asked_for_their_discount():
    envs = AsyncVectorEnv([partial(gymnasium.make, "CartPole-v1")], context="spawn")
    check_discount("DQN", envs, GAMMA)
    envs.close()


def test_another_discount_than_that_of_the_environments_is_refused():
    with pytest.raises(UsageError, match=r"by gamma=0.9, PPO learns with gamma=0.97: give both the same"):
        made("ppo", gamma=0.9)
    # Without a heuristic rewards are of one grid step each, and none needs to be discounted.
    assert torch.is_tensor(next(made("ppo", gamma=None, heuristic=None).network.parameters()))
