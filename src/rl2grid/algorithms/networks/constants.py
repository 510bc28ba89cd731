"""What networks that know the grid do not learn: tensors that are made with them, numbers that read an observation."""

from __future__ import annotations

import torch
from torch import Tensor, nn

URGENT_STEPS = 72.0
"""Steps after which planned maintenance counts e times less: six hours."""


def keep(module: nn.Module, **tensors: Tensor | None) -> None:
    """Give a module tensors that follow it to its device, that it does not learn, and that no checkpoint holds."""
    for name, tensor in tensors.items():
        module.register_buffer(name, tensor, persistent=False)


def urgency(steps: Tensor) -> Tensor:
    """How much maintenance counts that begins in so many times :data:`URGENT_STEPS`; not at all below 0: none is
    planned.
    """
    return torch.exp(-steps.clamp(min=0.0)) * (steps >= 0.0).to(steps.dtype)
