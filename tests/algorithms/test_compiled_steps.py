"""PPO's compiled steps, against the losses that PyTorch differentiates."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from constrained_toys import CostlyToyGrid
from toy_grid import ToyGrid

from rl2grid.algorithms import lagrangian_ppo
from rl2grid.algorithms.lagrangian_ppo import LagrangianPPO
from rl2grid.algorithms.on_policy import Minibatch, PolicyLosses
from rl2grid.algorithms.ppo import PPO, Args

SMALL = Args(
    total_timesteps=4096,
    num_envs=16,
    num_steps=64,
    gamma=0.9,
    num_minibatches=3,
    update_epochs=4,
    actor_layers=(8, 7),
    critic_layers=(9,),
    target_kl=None,
    max_grad_norm=0.1,
)
CHANGES: list[dict[str, Any]] = [
    {},
    {"clip_value_loss": True, "clip_coefficient": 0.02},
    {"normalize_advantages": False},
    {"actor_learning_rate": 0.03},
    {"actor_layers": (), "num_minibatches": 1},
]


def learner(**changes: Any) -> PPO:
    args = replace(SMALL, **changes)
    return PPO(args, ToyGrid(args.num_envs, gamma=0.9))


def constrained() -> LagrangianPPO:
    args = lagrangian_ppo.Args(**vars(SMALL), constraints=("LSI", "TLO"), initial_multiplier=0.5)
    return LagrangianPPO(args, CostlyToyGrid(args.num_envs))


def by_pytorch(ppo: PPO) -> PPO:
    ppo._policy_steps = ppo._value_steps = None
    return ppo


def assert_alike(mine: PPO, theirs: PPO) -> None:
    for name, weight in mine.network.state_dict().items():
        torch.testing.assert_close(weight, theirs.network.state_dict()[name], rtol=0, atol=3e-5)


@pytest.mark.parametrize("changes", CHANGES, ids=str)
def test_trainings_are_those_of_pytorch_up_to_rounding(changes: dict[str, Any]):
    mine, theirs = learner(**changes), by_pytorch(learner(**changes))
    assert mine._policy_steps is not None
    assert mine._value_steps is not None
    for _ in range(2):
        metrics, expected = mine.iterate(), theirs.iterate()
        losses = [name for name in metrics if name.startswith("losses/")]
        assert len(losses) == 6
        for name in losses:
            # one transition more or less on the other side of the clipping
            assert metrics[name] == pytest.approx(expected[name], abs=1e-3 if name.endswith("clipfrac") else 2e-5)
    assert_alike(mine, theirs)


def test_critics_of_costs_learn_as_with_pytorch():
    mine, theirs = constrained(), by_pytorch(constrained())
    metrics, expected = mine.iterate(), theirs.iterate()
    names = [name for name in metrics if "value_loss" in name]
    assert len(names) == 3
    for name in names:
        assert metrics[name] == pytest.approx(expected[name], abs=1e-6)
    assert_alike(mine, theirs)


def test_compiled_steps_and_pytorchs_go_on_with_each_others_moments():
    mine, theirs = learner(), by_pytorch(learner())
    compiled = mine._policy_steps, mine._value_steps
    for k in range(4):
        mine._policy_steps, mine._value_steps = compiled if k % 2 else (None, None)
        mine.iterate()
        theirs.iterate()
    assert_alike(mine, theirs)
    for one, other in (
        (mine.actor_optimizer, theirs.actor_optimizer),
        (mine.critic_optimizer, theirs.critic_optimizer),
    ):
        steps = [[int(state["step"]) for state in each.state.values()] for each in (one, other)]
        assert steps[0] == steps[1]


def test_without_masks_all_actions_are_legal():
    mine, theirs = learner(), by_pytorch(learner())
    mine.observations, theirs.observations = (each.envs.reset(seed=1)[0] for each in (mine, theirs))
    data, other = (replace(each.transitions(each.collect()[0]), masks=None) for each in (mine, theirs))
    rows = torch.arange(100)
    loss, expected = mine.improve_policy(data, rows), theirs.improve_policy(other, rows)
    torch.testing.assert_close(vars(loss), vars(expected), rtol=0, atol=1e-6)
    assert_alike(mine, theirs)


def test_what_a_subclass_minimises_counts():
    class Careless(PPO):
        def policy_losses(self, batch: Minibatch) -> PolicyLosses:
            losses = super().policy_losses(batch)
            return replace(losses, total=0.0 * losses.total)

    args = replace(SMALL, anneal_learning_rate=False)
    careless = Careless(args, ToyGrid(args.num_envs, gamma=0.9))
    before = [weight.clone() for weight in careless.network.actor_parameters()]
    careless.iterate()
    assert all(map(torch.equal, before, careless.network.actor_parameters()))
    assert careless._value_steps is not None


def test_other_networks_are_left_to_pytorch():
    ppo = PPO(replace(SMALL, mask_actions=False), ToyGrid(SMALL.num_envs, gamma=0.9, continuous=True))
    assert ppo._policy_steps is None
    assert np.isfinite(ppo.iterate()["losses/policy_loss"])
