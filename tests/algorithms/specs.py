"""Networks for tests that need no environment."""

from __future__ import annotations

import torch

from rl2grid.algorithms.networks import NetworkFactory
from rl2grid.envs.spec import Spec


def networks(observation_size: int, action_size: int, *, continuous: bool = False, seed: int = 0) -> NetworkFactory:
    """What makes ``mlp``s of these sizes, with weights of their own."""
    return NetworkFactory(
        Spec(observation_size, action_size, continuous), generator=torch.Generator().manual_seed(seed)
    )
