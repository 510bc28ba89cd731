"""MaskablePPO of SB3-Contrib chooses among the legal actions of bus14-T0 only.

pip install -e ".[examples]"
python examples/maskable_ppo.py --steps 20000
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3.common.env_util import make_vec_env

import rl2grid  # noqa: F401 - registers the tasks

TASK = "rl2grid/bus14-T0-v0"

# The masks are those of env.unwrapped.action_masks(), which MaskablePPO finds through all wrappers.
# One step of the environment is n = info["n_steps"] grid steps and is discounted by gamma, not gamma**n; gamma= of
# gymnasium.make adds info["discounted_reward"], the reward of a transition discounted at every grid step.


def survival(model: MaskablePPO, months: int = 3) -> float:
    """Mean share of some validation months that the policy's most likely legal actions survive."""
    env = gymnasium.make(TASK, heuristic="idle", split="validation")
    shares = []
    for month in range(months):
        observation, info = env.reset(seed=0 if month == 0 else None)
        over = False
        while not over:
            action, _ = model.predict(observation, action_masks=get_action_masks(env), deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            assert not info["illegal"]
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
    model = MaskablePPO("MlpPolicy", envs, n_steps=64, batch_size=128, gamma=0.9, seed=1, device="cpu")
    model.learn(steps)
    print(f"survival on validation months: {survival(model):.3f}")


if __name__ == "__main__":
    main()
