"""Lagrangian PPO: what is optimised against values computed by hand, and constraints whose best policy is known."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from constrained_toys import PAYS, Chain, CostlyToyGrid, Lever
from numpy.typing import NDArray
from specs import networks
from torch import Tensor
from toy_grid import SingleToyGrid, ToyGrid

from rl2grid.algorithms import ppo
from rl2grid.algorithms.checkpoint import load_checkpoint, save_checkpoint
from rl2grid.algorithms.lagrangian_ppo import (
    SEARCH_SPACE,
    ActorCritic,
    Args,
    LagrangianPPO,
    Minibatch,
    Multipliers,
    Rollout,
    advantages_of_costs,
    critic_losses,
    lagrangian_advantages,
    load_policy,
    preset,
)
from rl2grid.algorithms.on_policy import advantages_of_rewards
from rl2grid.algorithms.policy_agent import PolicyAgent
from rl2grid.envs.registration import register_all
from rl2grid.errors import UsageError
from rl2grid.training.request import RunArgs, hyperparameters, read_config
from rl2grid.training.runs import is_finished, resume, train

SMALL = Args(
    seed=3,
    total_timesteps=4 * 16 * 6,
    num_envs=4,
    num_steps=16,
    gamma=0.9,
    constraints=("LSI", "TLO"),
    thresholds=(0.5, 2.0),
    initial_multiplier=0.5,
    cost_gamma=0.8,
    num_minibatches=3,
    update_epochs=2,
    actor_layers=(8,),
    critic_layers=(8,),
    target_kl=None,
)
SMALL_CONTINUOUS = replace(SMALL, mask_actions=False, initial_log_std=0.5)
BOTH = pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])


def trainer(continuous: bool = False, **changes: Any) -> LagrangianPPO:
    args = replace(SMALL_CONTINUOUS if continuous else SMALL, **changes)
    return LagrangianPPO(args, CostlyToyGrid(args.num_envs, continuous=continuous))


def first_rollout(learner: LagrangianPPO) -> Rollout:
    """The rollout before any update."""
    learner.observations, _ = learner.envs.reset(seed=7)
    return learner.collect()[0]


def weights(learner: LagrangianPPO) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in learner.network.state_dict().items()}


def assert_same(mine: dict[str, Tensor], theirs: dict[str, Tensor]) -> None:
    assert mine.keys() == theirs.keys()
    for name in mine:
        assert torch.equal(mine[name], theirs[name]), name


class Recording(CostlyToyGrid):
    """Keeps every step, as it was asked for and answered."""

    def __init__(self, num_envs: int, *, continuous: bool = False) -> None:
        super().__init__(num_envs, continuous=continuous)
        self.actions: list[Any] = []
        self.answers: list[Any] = []

    def step(self, actions: Any) -> Any:
        self.actions.append(actions.copy())
        self.answers.append(super().step(actions))
        return self.answers[-1]


# --- Multipliers ----------------------------------------------------------------------------------------------------


def multipliers(*values: float) -> Multipliers:
    return Multipliers(np.array(values), np.array(values))


def test_multipliers_rise_with_the_excess_of_the_mean_cost_of_an_episode_over_the_threshold():
    plain = replace(SMALL, multiplier_learning_rate=0.1, multiplier_damping=0.0, max_multiplier=None)
    stepped = multipliers(1.0, 1.0).step(np.array([0.5, 80.0]), np.array([0.0, 50.0]), plain)
    # Excess in units of the threshold, of 1 where it is smaller: 0.5 / 1 and 30 / 50.
    assert stepped.current.tolist() == pytest.approx([1.05, 1.06])
    assert stepped.integral.tolist() == pytest.approx([1.05, 1.06])


def test_multipliers_fall_below_the_threshold_and_never_below_zero():
    plain = replace(SMALL, multiplier_learning_rate=0.1, multiplier_damping=0.0)
    stepped = multipliers(0.3, 0.05).step(np.array([25.0, 0.0]), np.array([50.0, 50.0]), plain)
    assert stepped.current.tolist() == pytest.approx([0.25, 0.0])
    assert stepped.step(np.array([50.0, 60.0]), np.array([50.0, 50.0]), plain).current[1] == pytest.approx(0.02)


def test_multipliers_do_not_exceed_the_maximum_and_fall_from_it_at_once():
    args = replace(SMALL, multiplier_learning_rate=0.1, multiplier_damping=0.0, max_multiplier=2.0)
    high = multipliers(1.9).step(np.array([500.0]), np.array([50.0]), args)
    assert high.current.tolist() == [2.0]
    assert high.step(np.array([0.0]), np.array([50.0]), args).current.tolist() == pytest.approx([1.9])
    unbounded = replace(args, max_multiplier=None)
    assert multipliers(1.9).step(np.array([500.0]), np.array([50.0]), unbounded).current.tolist() == pytest.approx(
        [2.8]
    )


def test_damping_adds_to_the_excess_of_the_moment_alone():
    args = replace(SMALL, multiplier_learning_rate=0.1, multiplier_damping=2.0)
    stepped = multipliers(1.0).step(np.array([75.0]), np.array([50.0]), args)
    assert stepped.integral.tolist() == pytest.approx([1.05])
    assert stepped.current.tolist() == pytest.approx([2.05])
    again = stepped.step(np.array([50.0]), np.array([50.0]), args)  # at the threshold nothing of it is left
    assert again.current.tolist() == again.integral.tolist() == pytest.approx([1.05])


def test_costs_count_per_episode_not_per_step_nor_per_rollout():
    envs = Recording(4)
    learner = LagrangianPPO(replace(SMALL, multiplier_damping=0.0, multiplier_learning_rate=0.01), envs)
    running, expected = np.zeros((4, 2)), np.array([0.5, 0.5])
    for _ in range(learner.num_iterations):
        begin = len(envs.answers)
        metrics = learner.iterate()
        finished, safe = [], []
        for _, _, terminated, truncated, infos in envs.answers[begin:]:
            ended = terminated | truncated
            for i in range(4):
                costs = (infos["final_info"] if ended[i] else infos)["costs"]
                running[i] += [costs["LSI"][i], costs["TLO"][i]]
            for i in np.flatnonzero(ended):
                finished.append(running[i].copy())
                safe.append(bool(truncated[i] and running[i][0] <= 0.5 and running[i][1] <= 2.0))
                running[i] = 0.0
        assert len(finished) > 2
        mean = np.mean(finished, axis=0)
        expected = np.maximum(expected + 0.01 * (mean - [0.5, 2.0]) / [1.0, 2.0], 0.0)
        np.testing.assert_allclose(learner.multipliers.current, expected, rtol=1e-12)
        assert metrics["charts/episodic_cost_LSI"] == pytest.approx(mean[0])
        assert metrics["charts/episodic_cost_TLO"] == pytest.approx(mean[1])
        assert metrics["lagrangian/violation_TLO"] == pytest.approx(mean[1] - 2.0)
        assert metrics["lagrangian/multiplier_TLO"] == pytest.approx(expected[1])
        assert metrics["charts/safe_episodes"] == pytest.approx(np.mean(safe))
    assert learner.multipliers.current[0] != 0.5


def test_without_an_ended_episode_the_multipliers_stay():
    learner = trainer()
    metrics = learner.update_multipliers(np.zeros((0, 2)))
    assert metrics == {"lagrangian/multiplier_LSI": 0.5, "lagrangian/multiplier_TLO": 0.5}
    assert learner.multipliers.current.tolist() == [0.5, 0.5]


def test_the_policy_learns_from_the_multipliers_after_their_step(monkeypatch: pytest.MonkeyPatch):
    learner = trainer()
    seen = []
    update = learner.update
    monkeypatch.setattr(learner, "update", lambda rollout: (seen.append(learner.multipliers), update(rollout))[1])
    metrics = learner.iterate()
    assert seen[0].current[0] == metrics["lagrangian/multiplier_LSI"] != 0.5


# --- Advantages -----------------------------------------------------------------------------------------------------


def random_rollout(steps: int = 13, envs: int = 3) -> Rollout:
    random = torch.Generator().manual_seed(0)
    shape = (steps, envs)
    ended = torch.rand(shape, generator=random) < 0.25
    lost = ended & (torch.rand(shape, generator=random) < 0.5)
    n_steps = torch.randint(1, 6, shape, generator=random)
    return Rollout(
        observations=torch.zeros(*shape, 1),
        masks=None,
        actions=torch.zeros(shape, dtype=torch.int64),
        log_probabilities=torch.zeros(shape),
        rewards=torch.randn(shape, generator=random),
        discounts=0.9**n_steps,
        values=torch.randn(shape, generator=random),
        next_values=torch.where(lost, 0.0, torch.randn(shape, generator=random)),
        costs=torch.rand(*shape, 2, generator=random),
        cost_discounts=0.8**n_steps,
        cost_values=torch.randn(*shape, 2, generator=random),
        next_cost_values=torch.where(lost.unsqueeze(-1), 0.0, torch.randn(*shape, 2, generator=random)),
        ended=ended,
        decided=torch.ones(shape, dtype=torch.bool),
    )


def advantage_by_definition(
    amounts: Tensor, discounts: Tensor, values: Tensor, next_values: Tensor, ended: Tensor, k: int, gae_lambda: float
) -> float:
    """The sum of all later errors of a critic in the same episode, each with its discount; arrays are [num_steps]."""
    total, weight = 0.0, 1.0
    for m in range(k, len(amounts)):
        total += weight * float(amounts[m] + discounts[m] * next_values[m] - values[m])
        if ended[m]:
            break
        weight *= float(discounts[m]) * gae_lambda
    return total


@pytest.mark.parametrize("gae_lambda", [0.0, 0.7, 1.0])
def test_advantages_are_the_discounted_errors_until_the_end_of_the_episode(gae_lambda: float):
    r = random_rollout()
    mine, costs = advantages_of_rewards(r, gae_lambda), advantages_of_costs(r, gae_lambda)
    assert costs.shape == (13, 3, 2)
    for k in range(13):
        for i in range(3):
            columns = (r.rewards[:, i], r.discounts[:, i], r.values[:, i], r.next_values[:, i], r.ended[:, i])
            assert float(mine[k, i]) == pytest.approx(advantage_by_definition(*columns, k, gae_lambda), abs=1e-5)
            for c in range(2):
                columns = (
                    r.costs[:, i, c],
                    r.cost_discounts[:, i],
                    r.cost_values[:, i, c],
                    r.next_cost_values[:, i, c],
                    r.ended[:, i],
                )
                expected = advantage_by_definition(*columns, k, gae_lambda)
                assert float(costs[k, i, c]) == pytest.approx(expected, abs=1e-5)


def test_advantages_of_costs_of_several_grid_steps_by_hand():
    # Transitions of 3 and 2 grid steps, cost_gamma 0.5, lambda 0.8, the second one completes the month.
    rollout = replace(
        random_rollout(2, 1),
        costs=torch.tensor([[[4.0]], [[2.0]]]),
        cost_discounts=torch.tensor([[0.125], [0.25]]),
        cost_values=torch.tensor([[[1.0]], [[3.0]]]),
        next_cost_values=torch.tensor([[[3.0]], [[8.0]]]),
        ended=torch.tensor([[False], [True]]),
    )
    last = 2.0 + 0.25 * 8.0 - 3.0
    expected = [4.0 + 0.125 * 3.0 - 1.0 + 0.125 * 0.8 * last, last]
    assert advantages_of_costs(rollout, 0.8).flatten().tolist() == pytest.approx(expected)


def test_the_combined_advantage_by_hand():
    combined = lagrangian_advantages(
        torch.tensor([1.0, -2.0]), torch.tensor([[3.0, 0.0], [-1.0, 4.0]]), torch.tensor([0.5, 2.0])
    )
    # (1 - 1.5) / 3.5 and (-2 + 0.5 - 8) / 3.5
    assert combined.tolist() == pytest.approx([-0.5 / 3.5, -9.5 / 3.5])


def test_without_multipliers_the_advantage_is_that_of_ppo():
    advantages = torch.randn(5)
    assert torch.equal(lagrangian_advantages(advantages, torch.randn(5, 2), torch.zeros(2)), advantages)


def test_costs_bootstrap_by_how_the_episode_ended():
    """Nothing follows a game over; a completed month is worth the cost value of its own last observation."""
    envs = Recording(4)
    args = replace(SMALL, num_steps=200, total_timesteps=800, normalize_observations=False)
    learner = LagrangianPPO(args, envs)
    rollout = first_rollout(learner)
    counts = {"terminated": 0, "truncated": 0, "running": 0}
    for k, (observations, _, terminated, truncated, infos) in enumerate(envs.answers):
        for i in range(4):
            value, cost_values = rollout.next_values[k, i], rollout.next_cost_values[k, i]
            if terminated[i]:
                counts["terminated"] += 1
                assert float(value) == 0.0
                assert cost_values.tolist() == [0.0, 0.0]
                continue
            seen = torch.as_tensor(infos["final_obs"][i] if truncated[i] else observations[i]).unsqueeze(0)
            counts["truncated" if truncated[i] else "running"] += 1
            with torch.no_grad():
                torch.testing.assert_close(cost_values, learner.network.cost_values(seen)[0], rtol=1e-5, atol=1e-6)
                torch.testing.assert_close(value, learner.network.value(seen)[0], rtol=1e-5, atol=1e-6)
    assert min(counts.values()) > 5


def test_costs_of_all_grid_steps_of_a_transition_count():
    """Those of heuristic steps and of the last step of an episode, too."""
    envs = Recording(4)
    learner = LagrangianPPO(replace(SMALL, num_steps=60, total_timesteps=240), envs)
    rollout = first_rollout(learner)
    charged = {"LSI": 0, "TLO": 0}
    for k, (_, _, terminated, truncated, infos) in enumerate(envs.answers):
        for i in range(4):
            info = infos["final_info"] if terminated[i] or truncated[i] else infos
            for c, name in enumerate(("LSI", "TLO")):
                cost = float(info["costs"][name][i])
                assert float(rollout.costs[k, i, c]) == pytest.approx(0.2 * cost)  # 1 - cost_gamma
                charged[name] += cost > 1.0
            assert float(rollout.cost_discounts[k, i]) == pytest.approx(0.8 ** int(info["n_steps"][i]))
            assert float(rollout.rewards[k, i]) == pytest.approx(0.1 * float(info["discounted_reward"][i]), rel=1e-6)
            assert float(rollout.discounts[k, i]) == pytest.approx(0.9 ** int(info["n_steps"][i]))
    assert min(charged.values()) > 5


def test_the_cost_scale_touches_critics_only():
    plain, scaled = trainer(cost_scale=1.0), trainer(cost_scale=3.0)
    one, other = first_rollout(plain), first_rollout(scaled)
    torch.testing.assert_close(other.costs, 3.0 * one.costs)
    assert len(plain.account.costs) > 2
    np.testing.assert_array_equal(plain.account.costs, scaled.account.costs)


# --- Policies and losses --------------------------------------------------------------------------------------------


def policy(*, continuous: bool, n_constraints: int = 2) -> ActorCritic:
    network = ActorCritic(
        networks(4, 2 if continuous else 3, continuous=continuous),
        n_costs=n_constraints,
        actor_layers=(8,),
        critic_layers=(8,),
        initial_log_std=0.3,
    )
    with torch.no_grad():
        network.actor[-1].weight.mul_(50.0)  # type: ignore[union-attr, operator]
    return network


@BOTH
def test_log_probabilities_and_entropies_are_those_of_torch(continuous: bool):
    network = policy(continuous=continuous)
    observations = torch.randn(5, 4)
    output = network.actor(observations)
    if continuous:
        actions = torch.randn(5, 2)
        reference: Any = torch.distributions.Independent(torch.distributions.Normal(output, network.log_std.exp()), 1)
    else:
        actions = torch.tensor([0, 1, 2, 0, 1])
        reference = torch.distributions.Categorical(logits=output)
    mine, entropy = network.log_probability_and_entropy(observations, actions, None)
    torch.testing.assert_close(mine, reference.log_prob(actions))
    torch.testing.assert_close(entropy, reference.entropy())


def test_illegal_actions_have_no_probability():
    network = policy(continuous=False)
    observations, mask = torch.randn(500, 4), torch.tensor([[True, False, True]]).expand(500, 3)
    sampled = network.act(observations, mask, torch.Generator().manual_seed(0))
    assert sorted(sampled.unique().tolist()) == [0, 2]
    legal = torch.distributions.Categorical(logits=network.actor(observations)[:, [0, 2]])
    mine, entropy = network.log_probability_and_entropy(observations, sampled, mask)
    torch.testing.assert_close(mine, legal.log_prob(sampled // 2))
    torch.testing.assert_close(entropy, legal.entropy())


def test_every_cost_has_a_critic_of_its_own():
    network = policy(continuous=False, n_constraints=3)
    values = network.cost_values(torch.randn(5, 4))
    assert values.shape == (5, 3)
    values[:, 1].sum().backward()  # type: ignore[no-untyped-call]
    trained = {name for name, p in network.named_parameters() if p.grad is not None and p.grad.any()}
    assert trained
    assert all(name.startswith("cost_critics.1.") for name in trained)


class Scripted(ActorCritic):
    """Log-probabilities, entropies and values as given, so that losses can be computed by hand."""

    def __init__(self) -> None:
        super().__init__(networks(1, 2), n_costs=1, actor_layers=(), critic_layers=())
        self.log_probabilities = torch.tensor([-1.0 + math.log(ratio) for ratio in RATIOS], requires_grad=True)
        self.values = torch.tensor([0.5, 0.4, 2.0, 0.1], requires_grad=True)
        self.values_of_costs = torch.tensor([[1.0, 5.0], [0.0, 5.0], [3.0, 5.0], [2.0, 5.0]], requires_grad=True)
        self.entropies = torch.tensor([0.1, 0.2, 0.3, 0.4])

    def log_probability_and_entropy(
        self, observations: Tensor, actions: Tensor, masks: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        return self.log_probabilities, self.entropies

    def value(self, observations: Tensor) -> Tensor:
        return self.values

    def cost_values(self, observations: Tensor) -> Tensor:
        return self.values_of_costs


RATIOS = [1.5, 0.5, 1.1, 1.5]
BATCH = Minibatch(
    observations=torch.zeros(4, 1),
    masks=None,
    actions=torch.zeros(4, dtype=torch.int64),
    log_probabilities=torch.tensor([-1.0, -1.0, -1.0, -1.0]),
    values=torch.tensor([0.0, 1.0, 2.0, 0.0]),
    advantages=torch.tensor([2.0, -1.0, 3.0, -1.0]),
    returns=torch.tensor([1.0, 1.0, 1.0, 0.1]),
    cost_values=torch.tensor([[0.5, 4.0], [0.0, 4.0], [3.0, 4.0], [1.0, 4.0]]),
    cost_returns=torch.tensor([[2.0, 4.0], [1.0, 4.0], [3.0, 4.0], [0.0, 4.0]]),
)
PLAIN = replace(SMALL, normalize_advantages=False, entropy_coefficient=0.0, value_coefficient=0.5)


def test_losses_by_hand():
    args = replace(PLAIN, entropy_coefficient=0.1)
    loss, of_critics = ppo.policy_losses(Scripted(), BATCH, args), critic_losses(Scripted(), BATCH, args)
    # min(ratio A, clip(ratio, 0.8, 1.2) A): 2.4, -0.8, 3.3, -1.5
    assert float(loss.policy) == pytest.approx(-(2.4 - 0.8 + 3.3 - 1.5) / 4)
    assert float(of_critics.value) == pytest.approx(0.5 * (0.25 + 0.36 + 1.0 + 0.0) / 4)
    assert of_critics.cost_values.tolist() == pytest.approx([0.5 * (1.0 + 1.0 + 0.0 + 4.0) / 4, 0.5 * 1.0])
    assert float(loss.entropy) == pytest.approx(0.25)
    assert float(loss.total.detach()) == pytest.approx(float(loss.policy) - 0.1 * 0.25)
    assert float(of_critics.total.detach()) == pytest.approx(0.5 * (float(of_critics.value) + 0.75 + 0.5))
    assert float(loss.clip_fraction) == pytest.approx(3 / 4)
    assert float(loss.approximate_kl) == pytest.approx(np.mean([r - 1 - math.log(r) for r in RATIOS]), rel=1e-5)


def test_clipped_value_losses_by_hand():
    loss = critic_losses(Scripted(), BATCH, replace(PLAIN, clip_value_loss=True))
    # Clipped to within 0.2 of the old values: 0.2, 0.8, 2.0, 0.1; the larger error counts.
    assert float(loss.value) == pytest.approx(0.5 * (0.64 + 0.36 + 1.0 + 0.0) / 4)
    # 0.7, 0.0, 3.0, 1.2 and 4.2: errors 1.69, 1.0, 0.0, 4.0 (unclipped) and 1.0 (unclipped)
    assert loss.cost_values.tolist() == pytest.approx([0.5 * (1.69 + 1.0 + 0.0 + 4.0) / 4, 0.5 * 1.0])


@BOTH
def test_the_ratio_before_any_update_is_one(continuous: bool):
    learner = trainer(continuous)
    rollout = first_rollout(learner)
    masks = None if rollout.masks is None else rollout.masks.flatten(0, 1)
    now, _ = learner.network.log_probability_and_entropy(
        rollout.observations.flatten(0, 1), rollout.actions.flatten(0, 1), masks
    )
    ratios = (now - rollout.log_probabilities.flatten()).exp()
    torch.testing.assert_close(ratios, torch.ones_like(ratios), rtol=0, atol=1e-5)
    if continuous:
        assert (rollout.actions.abs() > 1.0).any()


@BOTH
def test_the_first_minibatch_of_an_update_has_ratios_of_one(continuous: bool):
    """The update reads the actions and probabilities that were played."""
    metrics = trainer(continuous, num_minibatches=1, update_epochs=1).iterate()
    assert metrics["losses/approx_kl"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["losses/clipfrac"] == 0.0


# --- Training -------------------------------------------------------------------------------------------------------


def chain_args(**changes: Any) -> Args:
    return replace(
        Args(
            seed=1,
            total_timesteps=250 * 16 * 16,
            num_envs=16,
            num_steps=16,
            gamma=1.0,
            reward_scale=1.0,
            cost_scale=1.0,
            constraints=("both",),
            thresholds=(1.5,),
            multiplier_learning_rate=0.05,
            multiplier_damping=1.0,
            actor_learning_rate=1e-2,
            critic_learning_rate=1e-2,
            num_minibatches=1,
            update_epochs=4,
            entropy_coefficient=0.02,
            target_kl=None,
            mask_actions=False,
            normalize_observations=False,
            actor_layers=(),
            critic_layers=(),
        ),
        **changes,
    )


def risks(learner: LagrangianPPO) -> NDArray[np.float64]:
    """Probability of the risky action in the two states of a chain."""
    with torch.no_grad():
        return learner.network.actor(torch.eye(2)).softmax(-1)[:, 1].double().numpy()


def trained_on_chain(**changes: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Probabilities [2] and multipliers, means over the last third of a run."""
    args = chain_args(**changes)
    learner = LagrangianPPO(args, Chain(args.num_envs))
    history, prices = [], []
    while not learner.finished:
        learner.iterate()
        history.append(risks(learner))
        prices.append(learner.multipliers.current)
    last = -len(history) // 3
    return np.mean(history[last:], axis=0), np.mean(prices[last:], axis=0)


def test_the_costly_action_becomes_rarer_when_rewards_do_not_care():
    """With the sign of the costs wrong it becomes the only one."""
    learner = LagrangianPPO(chain_args(), Chain(16))
    before = risks(learner)
    for _ in range(20):
        rollout = first_rollout(learner)
        silent = replace(rollout, rewards=torch.zeros_like(rollout.rewards))
        learner.multipliers = multipliers(1.0)
        learner.update(silent)
    np.testing.assert_allclose(before, 0.5, atol=0.02)
    assert (risks(learner) < 0.2).all()


def test_the_best_policy_of_a_constrained_chain_is_found():
    """Always risky in the first state, at random in the second: cost 1.5, return 1.25, and the price is 0.5."""
    risk, price = trained_on_chain()
    assert risk.sum() == pytest.approx(1.5, abs=0.03)
    assert PAYS @ risk == pytest.approx(1.25, abs=0.02)
    assert risk[0] > 0.98
    assert price[0] == pytest.approx(0.5, abs=0.03)


@pytest.mark.slow
def test_several_constraints_are_met_each_at_its_own_price():
    """Thresholds 0.3 and 0.6 for the risks of the two states one by one, which pay 1 and 0.5."""
    risk, price = trained_on_chain(constraints=("first", "second"), thresholds=(0.3, 0.6))
    assert risk.tolist() == pytest.approx([0.3, 0.6], abs=0.03)
    assert price.tolist() == pytest.approx([1.0, 0.5], abs=0.1)


@pytest.mark.slow
def test_a_threshold_that_is_never_reached_changes_nothing_in_the_end():
    risk, price = trained_on_chain(thresholds=(5.0,), initial_multiplier=2.0)
    assert price[0] == 0.0
    assert (risk > 0.97).all()


@pytest.mark.slow
def test_a_threshold_of_zero_leaves_nearly_no_cost():
    risk, _ = trained_on_chain(thresholds=(0.0,))
    assert risk.sum() < 0.05


def pulled(threshold: float) -> tuple[float, float, float]:
    """Cost over the last fifth of a run with a lever; cost and return of its most probable actions."""
    args = chain_args(
        constraints=("effort",),
        thresholds=(threshold,),
        total_timesteps=200 * 16 * 16,
        initial_log_std=-1.5,
        entropy_coefficient=0.0,
        multiplier_learning_rate=0.1,
        actor_learning_rate=3e-3,
        actor_layers=(32,),
        critic_layers=(32,),
    )
    learner = LagrangianPPO(args, Lever(16))
    costs = []
    while not learner.finished:
        costs.append(learner.iterate()["charts/episodic_cost"])
    observations = torch.linspace(-1.0, 1.0, 401).unsqueeze(1)
    with torch.no_grad():
        actions = learner.network.act(observations, None, None).clamp(-1.0, 1.0)
    regret = (actions - Lever.best(observations)).square().mean()
    return float(np.mean(costs[-40:])), float(actions.clamp(min=0.0).mean()), -float(regret)


@pytest.mark.slow
def test_continuous_actions_meet_a_constraint():
    """On average over observations x in [-1, 1], the best action, 0.2 + 0.5 x, costs 0.245 of effort.

    With less allowed, the best policy takes s + 0.5 x instead wherever that is positive, with one s < 0.2. It costs
    the mean of max(s + 0.5 x, 0), which is (s + 0.5)^2 / 2: at a threshold of 0.1, s = sqrt(0.2) - 0.5, and with
    r = 0.2 - s it returns -(r^3 / 3 + r^2 (s + 0.5)) = -0.034.
    """
    cost, deterministic_cost, value = pulled(0.1)
    assert cost == pytest.approx(0.1, abs=0.02)
    assert deterministic_cost == pytest.approx(0.1, abs=0.03)
    assert value > -0.045


@pytest.mark.slow
def test_continuous_actions_are_free_below_a_threshold():
    """The best action of the test above, 0.2 + 0.5 x, costs less than is allowed."""
    cost, deterministic_cost, value = pulled(1.0)
    assert cost == pytest.approx(0.245, abs=0.03)
    assert deterministic_cost == pytest.approx(0.245, abs=0.03)
    assert value > -0.005


@BOTH
def test_a_resumed_run_ends_with_the_weights_of_one_that_was_not_interrupted(continuous: bool, tmp_path: Path):
    straight = trainer(continuous)
    straight_metrics = [straight.iterate() for _ in range(straight.num_iterations)]
    assert straight.multipliers.current.min() >= 0.0
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
        for mine, theirs in zip(resumed.multipliers, straight.multipliers, strict=True):
            np.testing.assert_array_equal(mine, theirs)
        np.testing.assert_array_equal(resumed.account.running, straight.account.running)
        assert resumed.normalizer.normaliser_hash == straight.normalizer.normaliser_hash
        for name in metrics.keys() - {"charts/environment_share"}:
            assert metrics[name] == straight_metrics[-1][name], name


def test_the_same_seed_gives_the_same_weights_whatever_the_global_random_state():
    results = []
    for noise in (0, 1):
        torch.manual_seed(noise)
        np.random.seed(noise)  # noqa: NPY002 - the global state is what must not matter
        learner = trainer()
        learner.iterate()
        learner.iterate()
        results.append(weights(learner))
    assert_same(*results)
    other = trainer(seed=4)
    assert not torch.equal(weights(other)["actor.0.weight"], weights(trainer())["actor.0.weight"])


def test_everything_is_optimised_and_saved(tmp_path: Path):
    learner = trainer(continuous=True, entropy_coefficient=0.1)
    before = weights(learner)
    learner.iterate()
    trained = weights(learner)
    assert [name for name in trained if torch.equal(trained[name], before[name])] == []
    save_checkpoint(tmp_path / "c.pt", {"task": "t", "policy": learner.policy_state()})
    loaded = load_policy(load_checkpoint(tmp_path / "c.pt")["policy"])
    assert_same(loaded.state_dict(), trained)


def test_transitions_that_no_decision_began_teach_nothing():
    learner = trainer()
    rollout = first_rollout(learner)
    before = weights(learner)
    metrics = learner.update(replace(rollout, decided=torch.zeros_like(rollout.decided)))
    assert_same(weights(learner), before)
    assert math.isnan(metrics["losses/cost_value_loss_TLO"])


def test_learning_rates_of_all_critics_fall_to_zero():
    learner = trainer(total_timesteps=4 * 16 * 4, actor_learning_rate=1e-3, critic_learning_rate=4e-3)
    rates = []
    while not learner.finished:
        learner.iterate()
        rates.append([group["lr"] for group in groups_of(learner)])
    np.testing.assert_allclose(rates, np.outer([1.0, 0.75, 0.5, 0.25], [1e-3, 4e-3, 4e-3, 4e-3]))


def test_gradients_of_every_critic_are_scaled_down_one_by_one():
    learner = trainer(max_grad_norm=1e-3, num_minibatches=1, update_epochs=1)
    learner.iterate()
    assert len(groups_of(learner)) == 4
    for group in groups_of(learner):
        norm = torch.stack([p.grad.norm() for p in group["params"] if p.grad is not None]).norm()
        assert 0.0 < float(norm) <= 1e-3 * (1 + 1e-4)


def groups_of(learner: LagrangianPPO) -> list[dict[str, Any]]:
    """What optimisers move, the actor's weights first."""
    return [*learner.actor_optimizer.param_groups, *learner.critic_optimizer.param_groups]


def test_a_single_constraint_has_metrics_without_its_name():
    metrics = trainer(constraints=("TLO",), thresholds=()).iterate()
    assert {
        "charts/episodic_cost",
        "charts/safe_episodes",
        "lagrangian/multiplier",
        "lagrangian/violation",
        "losses/cost_value_loss",
        "losses/cost_explained_variance",
        "losses/policy_loss",
    } <= metrics.keys()
    assert metrics["lagrangian/violation"] == pytest.approx(metrics["charts/episodic_cost"] - 50.0)


def test_as_an_agent_it_plays_its_most_probable_action():
    learner = trainer()
    learner.iterate()
    contents = {
        "algorithm": "lagrangian-ppo",
        "task": "rl2grid/bus14-T0-TLO-v0",
        "env_keywords": {},
        "identity": {},
        "decisions": learner.decisions,
        "policy": learner.policy_state(),
    }
    agent, env = PolicyAgent(contents), SingleToyGrid("rl2grid/bus14-T0-TLO-v0")
    assert agent.name == "lagrangian-ppo"
    agent.bind(env)
    observation, info = env.reset()
    normalised = torch.as_tensor(learner.normalizer.normalize(observation[None]))
    with torch.no_grad():
        logits = learner.network.actor(normalised)[0].masked_fill(~torch.as_tensor(env.action_masks()), -np.inf)
    assert agent.act(observation, info) == int(logits.argmax())


def test_a_run_stores_its_request_and_goes_on_after_an_interruption(tmp_path: Path):
    """What a run is broken off by here is its validation, after the first half."""

    class BrokenOffError(Exception):
        pass

    def break_off(agent: PolicyAgent) -> dict[str, float]:
        if agent.identity["decisions"] == 4 * 16 * 4:
            raise BrokenOffError
        return {"survival": 0.0, "safe_completed": 0.0}

    def finish(agent: PolicyAgent) -> dict[str, float]:
        return {"survival": 0.0, "safe_completed": 0.0}

    def make_envs(args: RunArgs) -> Any:
        return CostlyToyGrid(4)

    request = RunArgs(
        task="bus14-T0-TLO",
        hyperparameters=SMALL,
        algorithm="lagrangian-ppo",
        folder=tmp_path / "run",
        evaluate_every=64,
        tensorboard=False,
        progress=False,
    )
    with pytest.raises(BrokenOffError):
        train(request, evaluate=break_off, make_envs=make_envs)
    assert read_config(tmp_path / "run")[0].hyperparameters == SMALL
    resume(tmp_path / "run", evaluate=finish, make_envs=make_envs)
    assert is_finished(tmp_path / "run")
    train(replace(request, folder=tmp_path / "straight"), evaluate=finish, make_envs=make_envs)
    mine, theirs = (load_checkpoint(tmp_path / name / "checkpoint.pt")["training"] for name in ("run", "straight"))
    assert_same(mine["network"], theirs["network"])
    np.testing.assert_array_equal(mine["multipliers"]["current"], theirs["multipliers"]["current"])


# --- On the grid ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("constraint", ["LSI", "TLO"])
def test_costs_of_the_grid_are_those_of_its_episodes(constraint: str):
    """The task's id names the constraint, and the costs of heuristic steps count."""
    register_all()
    task = f"rl2grid/bus14-T0-{constraint}-v0"
    args = preset("default", continuous=False, num_envs=16, num_steps=32, total_timesteps=512, initial_do_nothing=0.9)
    envs = gymnasium.make_vec(task, num_envs=16, heuristic="idle", gamma=args.gamma, num_threads=1)
    answers = []
    step = envs.step
    envs.step = lambda actions: answers.append(step(actions)) or answers[-1]  # type: ignore[method-assign, func-returns-value]
    learner = LagrangianPPO(args, envs)
    assert learner.constraints == (constraint,)
    assert learner.thresholds.tolist() == [{"LSI": 0.0, "TLO": 50.0}[constraint]]
    learner.observations = learner.reset()
    _, metrics = learner.collect()
    reported = [
        infos["final_info"]["episode_costs"][constraint][i]
        for *_, terminated, truncated, infos in answers
        for i in np.flatnonzero(terminated | truncated)
    ]
    assert len(reported) > 5
    np.testing.assert_allclose(learner.account.costs[:, 0], reported)
    assert metrics["charts/episodic_cost"] == pytest.approx(np.mean(reported))
    envs.close()


# --- Requests -------------------------------------------------------------------------------------------------------


@BOTH
def test_the_preset_paper_is_the_papers_table(continuous: bool):
    args = preset("paper", continuous=continuous)
    shared = {field.name for field in fields(ppo.Args)}
    theirs = ppo.preset("paper", continuous=continuous)
    assert {name: getattr(args, name) for name in shared} == {name: getattr(theirs, name) for name in shared}
    assert args.multiplier_damping == 0.0
    assert args.max_multiplier is None
    assert args.thresholds == ()  # those of the task
    for name in set(SEARCH_SPACE) & shared - {"actor_learning_rate", "critic_learning_rate"}:
        assert getattr(args, name) in SEARCH_SPACE[name], name
    assert ppo.SEARCH_SPACE == SEARCH_SPACE


def test_the_default_is_that_of_ppo():
    for continuous in (False, True):
        args, theirs = preset("default", continuous=continuous), ppo.preset("default", continuous=continuous)
        for field in fields(ppo.Args):
            assert getattr(args, field.name) == getattr(theirs, field.name), field.name


def test_it_is_offered_for_all_tasks():
    assert isinstance(hyperparameters("lagrangian-ppo", "bus14-T0-TLO", constraints=("TLO",)), Args)
    assert not hyperparameters("lagrangian-ppo", "bus14-R", "paper").mask_actions
    with pytest.raises(UsageError, match="choose one of default, paper"):
        preset("papers", continuous=False)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"num_envs": 0}, "num_envs of at least 1"),
        ({"initial_do_nothing": 1.0}, "initial_do_nothing above 0 and below 1"),
        ({"actor_layers": (-3,)}, "actor_layers of widths of at least 1"),
        ({"critic_layers": (8, 0)}, "critic_layers of widths of at least 1"),
        ({"cost_gamma": 1.5}, "cost_gamma between 0 and 1"),
        ({"cost_gamma": 1.0}, "needs a cost_scale"),
        ({"cost_scale": 0.0}, "positive cost_scale"),
        ({"multiplier_learning_rate": -0.1}, "multiplier_learning_rate of at least 0"),
        ({"multiplier_damping": math.nan}, "multiplier_damping of at least 0"),
        ({"initial_multiplier": 11.0}, "initial_multiplier from 0 to max_multiplier"),
        ({"constraints": ("TLO", "TLO")}, "different constraints"),
        ({"thresholds": (-1.0, 0.0)}, "thresholds of at least 0"),
        ({"device": "gpu"}, "choose one of auto, cpu, cuda"),
    ],
)
def test_values_that_cannot_work_are_refused(changes: dict[str, Any], sentence: str):
    with pytest.raises(UsageError, match=sentence):
        replace(SMALL, **changes)


def test_environments_without_their_constraint_are_refused():
    with pytest.raises(UsageError, match="needs a constraint: choose a task whose id names LSI or TLO"):
        trainer(constraints=(), thresholds=())
    with pytest.raises(UsageError, match="'risk' does not exist: choose one of LSI, TLO"):
        trainer(constraints=("risk",), thresholds=())
    with pytest.raises(UsageError, match="one threshold for each of LSI, TLO, not 1"):
        trainer(thresholds=(1.0,))
    with pytest.raises(UsageError, match=r"does not report info\['costs'\] of LSI, TLO"):
        LagrangianPPO(SMALL, ToyGrid(4)).iterate()
