"""PPO of RLlib (its new API stack) on bus14-T0.

pip install -e ".[examples]"
python examples/rllib_ppo.py --steps 20000
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module import RLModule

import rl2grid  # noqa: F401 - registers the tasks

TASK = "rl2grid/bus14-T0-v0"
BATCH = 512

# One step of the environment is n = info["n_steps"] grid steps and is discounted by gamma, not gamma**n; gamma= in
# env_config adds info["discounted_reward"], the reward of a transition discounted at every grid step.


def survival(module: RLModule, months: int = 3) -> float:
    """Mean share of some validation months that the policy's most likely actions survive."""
    env = gymnasium.make(TASK, heuristic="idle", split="validation")
    shares = []
    for month in range(months):
        observation, info = env.reset(seed=0 if month == 0 else None)
        over = False
        while not over:
            with torch.no_grad():
                logits = module.forward_inference({"obs": torch.from_numpy(observation[np.newaxis])})
            action = int(logits["action_dist_inputs"].argmax())
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        shares.append(info["survival"])
    env.close()
    return float(np.mean(shares))


def main() -> None:
    """Train, then play."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20_000, help="decisions to train on, at least")
    steps = parser.parse_args().steps
    ray.init(num_cpus=1, include_dashboard=False, logging_level="ERROR")
    config = (
        PPOConfig()
        .api_stack(enable_rl_module_and_learner=True, enable_env_runner_and_connector_v2=True)
        # "rl2grid:" has processes of other env runners import the package, which registers the tasks.
        .environment(f"rl2grid:{TASK}", env_config={"heuristic": "idle", "split": "train"})
        .env_runners(num_env_runners=0, num_envs_per_env_runner=4)
        .training(train_batch_size_per_learner=BATCH, minibatch_size=128, num_epochs=4, gamma=0.9)
        .debugging(seed=1)
    )
    algorithm = config.build_algo()
    for _ in range(-(-steps // BATCH)):
        algorithm.train()
    print(f"survival on validation months: {survival(algorithm.get_module()):.3f}")
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    main()
