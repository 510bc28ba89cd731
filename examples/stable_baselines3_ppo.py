"""PPO of Stable-Baselines3 learns to switch on bus14-T0.

pip install -e ".[examples]"
python examples/stable_baselines3_ppo.py --steps 20000
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import rl2grid  # noqa: F401 - registers the tasks

TASK = "rl2grid/bus14-T0-v0"

# With a heuristic, one step of the environment is n = info["n_steps"] grid steps, most of them without a decision.
# Stable-Baselines3 discounts it by gamma, where the grid would ask for gamma**n: it looks some decisions ahead, not
# some hours. What lies within a transition can be discounted right: gymnasium.make(..., gamma=0.99) adds
# info["discounted_reward"], the sum of gamma**k * reward k over its grid steps, to be returned as the reward.


def survival(model: PPO, months: int = 3) -> float:
    """Mean share of some validation months that the policy's most likely actions survive."""
    env = gymnasium.make(TASK, heuristic="idle", split="validation")
    shares = []
    for month in range(months):
        observation, info = env.reset(seed=0 if month == 0 else None)
        over = False
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        shares.append(info["survival"])
    env.close()
    return float(np.mean(shares))


def main() -> None:
    """Train, then play."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20_000, help="decisions to train on")
    steps = parser.parse_args().steps
    envs = make_vec_env(gymnasium.make, n_envs=4, seed=1, env_kwargs={"id": TASK, "heuristic": "idle"})
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=128, gamma=0.9, seed=1, device="cpu")
    model.learn(steps)
    print(f"survival on validation months: {survival(model):.3f}")


if __name__ == "__main__":
    main()
