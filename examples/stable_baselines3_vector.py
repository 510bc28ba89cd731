"""PPO of Stable-Baselines3 on the compiled vector environment: one call steps all environments, on all cores.

pip install -e ".[examples]"
python examples/stable_baselines3_vector.py --steps 200000
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

import rl2grid  # noqa: F401 - registers the tasks

# One step of the environment is n = info["n_steps"] grid steps and is discounted by gamma, not gamma**n; gamma= of
# make_vec adds infos["discounted_reward"], the reward of a transition discounted at every grid step.


class CompiledVecEnv(VecEnv):
    """rl2grid's vector environment in the form of Stable-Baselines3; infos are passed on where an episode ended."""

    def __init__(self, task: str, num_envs: int, seed: int = 0, **keywords: Any) -> None:
        self.envs = gymnasium.make_vec(task, num_envs=num_envs, **keywords)
        super().__init__(num_envs, self.envs.single_observation_space, self.envs.single_action_space)
        self.seed(seed)

    def reset(self) -> np.ndarray:
        observations, _ = self.envs.reset(seed=list(self._seeds))
        self._reset_seeds()
        return observations.copy()  # the environments write into two buffers that take turns

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        over = terminated | truncated
        single: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(over):
            single[i]["terminal_observation"] = infos["final_obs"][i]
            single[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            single[i]["survival"] = float(infos["final_info"]["survival"][i])
        return observations.copy(), rewards.astype(np.float32), over, single

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("The environments share their attributes: give keywords to make_vec.")

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **keywords: Any) -> list[Any]:
        answers = getattr(self.envs, method_name)(*arguments, **keywords)  # such as action_masks: one row each
        return [answers[i] for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


def main() -> None:
    """Train, then say how long the last episodes lasted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=200_000, help="decisions to train on")
    steps = parser.parse_args().steps
    envs = VecMonitor(CompiledVecEnv("rl2grid/bus14-T0-v0", 32, seed=1, heuristic="idle"), info_keywords=("survival",))
    model = PPO("MlpPolicy", envs, n_steps=32, batch_size=256, gamma=0.9, seed=1, device="cpu")
    model.learn(steps)
    shares = [episode["survival"] for episode in model.ep_info_buffer]
    print(f"survival in the last {len(shares)} training episodes: {np.mean(shares) if shares else np.nan:.3f}")


if __name__ == "__main__":
    main()
