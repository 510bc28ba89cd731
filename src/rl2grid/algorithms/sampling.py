"""Draws and log-probabilities of discrete actions.

On a processor, log-probabilities are compiled code's (:mod:`rl2grid.dense.choices`): the same bits on each.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rl2grid.arrays import F32, Flags
from rl2grid.dense.choices import (
    NEVER,
    write_choice_gradients,
    write_choices,
    write_log_softmax,
    write_log_softmax_gradients,
)


def legal_log_softmax(logits: Tensor, masks: Tensor | None) -> Tensor:
    """Log-probabilities [batch, actions] of logits and legal actions of the same shape; illegal: large and negative."""
    if _is_compiled(logits):
        legal = _legal(logits, masks)
        if not torch.is_grad_enabled():
            return _log_softmax(logits, legal)
        return _LogSoftmax.apply(logits, legal)  # type: ignore[no-untyped-call, no-any-return]
    if masks is not None:
        logits = logits.masked_fill(~masks, NEVER)
    return logits.log_softmax(dim=-1)


def log_probabilities_of(logits: F32, legal: Flags) -> F32:
    """What :func:`legal_log_softmax` says, to the bit, without tensors; all [batch, actions]."""
    log_probabilities = np.empty_like(logits)
    write_log_softmax(logits, legal, log_probabilities)
    return log_probabilities


def log_probabilities_and_entropies(logits: Tensor, masks: Tensor | None, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Of actions, int64 [batch], and of the policy, each [batch]; other arguments as of :func:`legal_log_softmax`."""
    if _is_compiled(logits):
        return _Choices.apply(logits, _legal(logits, masks), actions)  # type: ignore[no-untyped-call, no-any-return]
    log_probabilities = legal_log_softmax(logits, masks)
    entropies = -(log_probabilities.exp() * log_probabilities).sum(dim=-1)
    return log_probabilities.gather(-1, actions.unsqueeze(-1)).squeeze(-1), entropies


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


def _is_compiled(logits: Tensor) -> bool:
    """Whether there is compiled code for such logits."""
    return logits.device.type == "cpu" and logits.dtype == torch.float32 and logits.dim() == 2


def _legal(logits: Tensor, masks: Tensor | None) -> Tensor:
    return torch.ones_like(logits, dtype=torch.bool) if masks is None else masks.expand_as(logits).contiguous()


def _log_softmax(logits: Tensor, legal: Tensor) -> Tensor:
    return torch.from_numpy(log_probabilities_of(logits.detach().contiguous().numpy(), legal.numpy()))


class _LogSoftmax(torch.autograd.Function):
    """Log-probabilities of legal actions."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor, legal: Tensor) -> Tensor:
        log_probabilities = _log_softmax(logits, legal)
        ctx.save_for_backward(legal, log_probabilities)
        return log_probabilities

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        legal, log_probabilities = ctx.saved_tensors
        of_logits = torch.empty_like(log_probabilities)
        given = gradients[0].contiguous().numpy()
        write_log_softmax_gradients(given, legal.numpy(), log_probabilities.detach().numpy(), of_logits.numpy())
        return of_logits, None


class _Choices(torch.autograd.Function):
    """Log-probabilities of actions that were chosen, and entropies."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor, legal: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        rows, actions = logits.detach().contiguous(), actions.contiguous()
        log_probabilities = torch.empty_like(rows)
        chosen, entropies = rows.new_empty(len(rows)), rows.new_empty(len(rows))
        write_choices(
            rows.numpy(), legal.numpy(), actions.numpy(), log_probabilities.numpy(), chosen.numpy(), entropies.numpy()
        )
        ctx.save_for_backward(legal, actions, log_probabilities, entropies)
        return chosen, entropies

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        legal, actions, log_probabilities, entropies = ctx.saved_tensors
        of_logits = torch.empty_like(log_probabilities)
        of_chosen, of_entropies = (gradient.contiguous().numpy() for gradient in gradients)
        write_choice_gradients(
            of_chosen,
            of_entropies,
            legal.numpy(),
            actions.numpy(),
            log_probabilities.numpy(),
            entropies.detach().numpy(),
            of_logits.numpy(),
        )
        return of_logits, None, None
