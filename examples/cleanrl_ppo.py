"""PPO in a single file in the manner of CleanRL, with PyTorch and the plain interface of Gymnasium.

pip install -e ".[examples]"
python examples/cleanrl_ppo.py --steps 200000
python examples/cleanrl_ppo.py --task rl2grid/bus36-M-T1-v0
"""

import argparse

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.distributions import Categorical

import rl2grid  # noqa: F401 - registers the tasks

ENVS, LENGTH, EPOCHS, MINIBATCHES = 16, 32, 4, 4
# One step of the environment is many grid steps while the heuristic plays: gamma is per decision, and short.
GAMMA, LAMBDA, CLIP, ENTROPY, LEARNING_RATE = 0.9, 0.95, 0.2, 0.01, 1e-3


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers."""
    return nn.Sequential(nn.Linear(inputs, 128), nn.Tanh(), nn.Linear(128, 128), nn.Tanh(), nn.Linear(128, outputs))


def main() -> None:
    """Train, then say how long the last episodes lasted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="rl2grid/bus14-T0-v0", help="an id with discrete actions")
    parser.add_argument("--steps", type=int, default=200_000, help="decisions to train on")
    options = parser.parse_args()
    torch.manual_seed(1)
    envs = gymnasium.make_vec(options.task, num_envs=ENVS, heuristic="idle")
    envs = gymnasium.wrappers.vector.NormalizeReward(envs, gamma=GAMMA)
    size, actions = envs.single_observation_space.shape[0], envs.single_action_space.n
    actor, critic = network(size, actions), network(size, 1)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=LEARNING_RATE, eps=1e-5)
    observed, chosen = torch.zeros(LENGTH, ENVS, size), torch.zeros(LENGTH, ENVS, dtype=torch.long)
    likely, rewards, ends, values = (torch.zeros(LENGTH, ENVS) for _ in range(4))
    survivals: list[float] = []
    observation = torch.tensor(envs.reset(seed=1)[0])
    for _ in range(-(-options.steps // (ENVS * LENGTH))):
        for t in range(LENGTH):
            with torch.no_grad():
                policy = Categorical(logits=actor(observation))
                observed[t], chosen[t], values[t] = observation, policy.sample(), critic(observation)[:, 0]
                likely[t] = policy.log_prob(chosen[t])
            observation, reward, terminated, truncated, info = envs.step(chosen[t].numpy())
            observation, rewards[t] = torch.tensor(observation), torch.tensor(reward, dtype=torch.float32)
            ends[t] = torch.tensor(terminated | truncated)
            survivals += [float(info["final_info"]["survival"][i]) for i in np.flatnonzero(ends[t])]
        with torch.no_grad():
            following, advantage, advantages = critic(observation)[:, 0], torch.zeros(ENVS), torch.zeros(LENGTH, ENVS)
        for t in reversed(range(LENGTH)):
            error = rewards[t] + GAMMA * following * (1 - ends[t]) - values[t]
            advantages[t] = advantage = error + GAMMA * LAMBDA * (1 - ends[t]) * advantage
            following = values[t]
        returns = (advantages + values).flatten()
        for part in (k for _ in range(EPOCHS) for k in torch.randperm(ENVS * LENGTH).chunk(MINIBATCHES)):
            seen, scaled = observed.flatten(0, 1)[part], advantages.flatten()[part]
            scaled = (scaled - scaled.mean()) / (scaled.std() + 1e-8)
            policy = Categorical(logits=actor(seen))
            ratio = (policy.log_prob(chosen.flatten()[part]) - likely.flatten()[part]).exp()
            gain = torch.min(ratio * scaled, ratio.clamp(1 - CLIP, 1 + CLIP) * scaled).mean()
            loss = 0.5 * (critic(seen)[:, 0] - returns[part]).square().mean() - gain - ENTROPY * policy.entropy().mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_([*actor.parameters(), *critic.parameters()], 0.5)
            optimiser.step()
    shares = survivals[-100:]
    print(f"survival in the last {len(shares)} training episodes: {np.mean(shares) if shares else np.nan:.3f}")


if __name__ == "__main__":
    main()
