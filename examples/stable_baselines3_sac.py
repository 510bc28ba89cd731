"""SAC of Stable-Baselines3 learns to redispatch on bus14-R.

pip install -e ".[examples]"
python examples/stable_baselines3_sac.py --steps 20000
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

import rl2grid  # noqa: F401 - registers the tasks

TASK = "rl2grid/bus14-R-v0"

# With a heuristic, one step of the environment is n = info["n_steps"] grid steps. SAC stores their summed reward and
# discounts what follows by gamma, not gamma**n. gymnasium.make(..., gamma=0.99) adds info["discounted_reward"], the sum
# of gamma**k * reward k, which puts the inside of a transition right; gamma**n takes a replay buffer that stores n.


def survival(model: SAC, months: int = 3) -> float:
    """Mean share of some validation months that the policy's mean actions survive."""
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
    envs = make_vec_env(gymnasium.make, n_envs=2, seed=1, env_kwargs={"id": TASK, "heuristic": "idle"})
    model = SAC("MlpPolicy", envs, learning_starts=100, train_freq=8, gamma=0.9, seed=1, device="cpu")
    model.learn(steps)
    print(f"survival on validation months: {survival(model):.3f}")


if __name__ == "__main__":
    main()
