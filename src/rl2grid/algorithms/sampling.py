"""Draws and log-probabilities of discrete actions."""

from __future__ import annotations

import torch
from torch import Tensor

NEVER = -1e8
"""Logit or value of an action that may not be played: never the largest, probability exactly zero in float32, and yet
finite, so that zero times its logarithm is zero."""


def legal_log_softmax(logits: Tensor, masks: Tensor | None) -> Tensor:
    """Log-probabilities [batch, actions] of logits and legal actions of the same shape; illegal: large and negative."""
    if masks is not None:
        logits = logits.masked_fill(~masks, NEVER)
    return logits.log_softmax(dim=-1)


def drawn(weights: Tensor, generator: torch.Generator) -> Tensor:
    """One action per row with probabilities in proportion to ``weights`` [batch, actions], int64 [batch].

    An action of weight 0 is never drawn. One uniform number per row goes into it, where ``torch.multinomial`` draws one
    per action.

    Args:
        weights: On any device, at least one of each row above 0.
        generator: Source of the draw, on the processor.
    """
    sums = weights.cumsum(dim=-1).cpu()
    # 24 random bits: their product with a float32 is exact in float64, and therefore less than it.
    uniform = torch.rand(len(sums), 1, generator=generator).to(torch.float64)
    return (sums <= uniform * sums[:, -1:]).sum(dim=-1)
