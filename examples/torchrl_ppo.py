"""PPO of TorchRL on bus14-T0: a GymEnv, a collector, generalised advantages and the clipped loss.

pip install -e ".[examples]"
python examples/torchrl_ppo.py --steps 20000
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.envs import GymEnv
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import rl2grid  # noqa: F401 - registers the tasks

TASK, BATCH, EPOCHS = "rl2grid/bus14-T0-v0", 256, 4

# One step of the environment is n = info["n_steps"] grid steps and is discounted by gamma, not gamma**n; gamma= of
# GymEnv adds info["discounted_reward"], the reward of a transition discounted at every grid step.


def network(n_out: int) -> nn.Sequential:
    """Two hidden layers; the first call finds the size of the observation."""
    return nn.Sequential(nn.LazyLinear(128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, n_out))


def survival(policy: nn.Module, months: int = 3) -> float:
    """Mean share of some validation months that the policy's most likely actions survive."""
    env = gymnasium.make(TASK, heuristic="idle", split="validation")
    shares = []
    for month in range(months):
        observation, info = env.reset(seed=0 if month == 0 else None)
        terminated = truncated = False
        while not (terminated or truncated):
            action = int(policy(torch.from_numpy(observation)).argmax())
            observation, _, terminated, truncated, info = env.step(action)
        shares.append(info["survival"])
    return sum(shares) / months


def main() -> None:
    """Train, then play."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20_000, help="decisions to train on")
    steps = parser.parse_args().steps
    torch.manual_seed(1)
    env = GymEnv(TASK, heuristic="idle", categorical_action_encoding=True, device="cpu")
    env.set_seed(1)
    policy = network(env.action_spec.space.n)
    logits = TensorDictModule(policy, in_keys=["observation"], out_keys=["logits"])
    drawn = {"distribution_class": Categorical, "return_log_prob": True}
    actor = ProbabilisticActor(logits, ["logits"], spec=env.action_spec, **drawn)
    critic = ValueOperator(network(1), in_keys=["observation"])
    actor(critic(env.reset()))
    advantages = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.01)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4)
    sizes = {"frames_per_batch": BATCH, "total_frames": steps + -steps % BATCH}
    for batch in Collector(env, actor, **sizes, auto_register_policy_transforms=True):
        for _ in range(EPOCHS):
            advantages(batch)
            losses = loss(batch)
            optimiser.zero_grad()
            sum(losses[f"loss_{part}"] for part in ("objective", "critic", "entropy")).backward()
            optimiser.step()
    print(f"survival on validation months: {survival(policy):.3f}")


if __name__ == "__main__":
    main()
