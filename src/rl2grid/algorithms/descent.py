"""Steps down a gradient, with little beside the arithmetic: networks are small, and calls take longer than it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rl2grid.dense import adam


@dataclass(frozen=True)
class FlatGroup:
    """The weights of a parameter group and their moments, each in one array, one weight after the other."""

    weights: Tensor
    gradients: Tensor
    means: Tensor
    squares: Tensor
    _steps: list[Tensor]

    def descend(self, options: dict[str, Any], max_norm: float) -> None:
        """One step down ``gradients``, which are scaled down to ``max_norm`` when longer, in compiled code."""
        gradients = self.gradients.numpy()
        adam.shorten(gradients, max_norm)
        torch._foreach_add_(self._steps, 1)
        weights, means, squares = (array.numpy() for array in (self.weights, self.means, self.squares))
        adam.step(weights, gradients, means, squares, int(self._steps[0]), options["lr"], options["eps"])


class _Group(NamedTuple):
    """The weights of a parameter group that have a state, and that state, in one order."""

    options: dict[str, Any]
    weights: list[Tensor]
    means: list[Tensor]
    squares: list[Tensor]
    steps: list[Tensor]


class Adam(torch.optim.Adam):
    """PyTorch's fused Adam, its weights and their moments looked up once instead of at every step."""

    def __init__(self, parameters: Iterable[Any], *, lr: float, eps: float = 1e-8) -> None:
        """See :class:`torch.optim.Adam`."""
        super().__init__(parameters, lr=lr, eps=eps, fused=True)
        self._groups: list[_Group] = []
        self._flat: dict[int, FlatGroup] = {}

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One step for all weights; with PyTorch's own code the first time, which makes the moments."""
        if closure is not None or not self._groups or not self._complete():
            result = super().step(closure)
            self._groups = self._looked_up()
            return result
        for group in self._groups:
            options = group.options
            first, second = options["betas"]
            torch._foreach_add_(group.steps, 1)
            torch._fused_adam_(
                group.weights,
                [weight.grad for weight in group.weights if weight.grad is not None],
                group.means,
                group.squares,
                [],
                group.steps,
                lr=options["lr"],
                beta1=first,
                beta2=second,
                weight_decay=options["weight_decay"],
                eps=options["eps"],
                amsgrad=False,
                maximize=False,
            )
        return None

    def load_state_dict(self, state_dict: Any) -> None:
        """See :class:`torch.optim.Adam`; the moments are other tensors then."""
        super().load_state_dict(state_dict)
        self._groups = []
        self._flat = {}

    @torch.no_grad()
    def flat(self, index: int) -> FlatGroup:
        """The weights of group ``index``, float32 on a processor, and their moments, laid out one after the other.

        The first call moves them there; those that see the weights go on to see them.
        """
        if index not in self._flat:
            self._flat[index] = self._laid_out(self.param_groups[index]["params"])
            self._groups = []
        return self._flat[index]

    def _laid_out(self, weights: list[Tensor]) -> FlatGroup:
        for weight in weights:
            if not self.state[weight]:
                zeros = {name: torch.zeros_like(weight) for name in ("exp_avg", "exp_avg_sq")}
                self.state[weight] = {"step": torch.zeros((), dtype=torch.float32), **zeros}
        states = [self.state[weight] for weight in weights]
        numbers = torch.cat([weight.detach().flatten() for weight in weights])
        means, squares = (torch.cat([state[name].flatten() for state in states]) for name in ("exp_avg", "exp_avg_sq"))
        gradients = torch.zeros_like(numbers)
        first = 0
        for weight, state in zip(weights, states, strict=True):
            end = first + weight.numel()
            weight.data = numbers[first:end].view_as(weight)
            weight.grad = gradients[first:end].view_as(weight)
            state["exp_avg"], state["exp_avg_sq"] = (array[first:end].view_as(weight) for array in (means, squares))
            first = end
        return FlatGroup(numbers, gradients, means, squares, [state["step"] for state in states])

    def _complete(self) -> bool:
        """Whether all weights have a gradient, as is usual."""
        return all(weight.grad is not None for group in self._groups for weight in group.weights)

    def _looked_up(self) -> list[_Group]:
        """The groups, once every weight has moments; none before that, or on a device without the fused kernel."""
        groups = []
        for options in self.param_groups:
            states = [self.state[weight] for weight in options["params"]]
            if not options["fused"] or not all(states):
                return []
            names = ("exp_avg", "exp_avg_sq", "step")
            groups.append(_Group(options, options["params"], *([state[name] for state in states] for name in names)))
        return groups


def descend(optimizer: torch.optim.Optimizer, loss: Tensor, max_norm: float) -> None:
    """One step down the gradient of ``loss`` for the weights of an optimiser, and no gradient for any others.

    Args:
        optimizer: Its parameter groups are what moves.
        loss: A scalar.
        max_norm: The gradient of each group is scaled down to this norm when longer.
    """
    groups: list[list[Tensor]] = [group["params"] for group in optimizer.param_groups]
    weights = [weight for group in groups for weight in group]
    for weight in weights:
        weight.grad = None
    # Not ``autograd.grad``: its gradients may lie in memory otherwise than their weights, or be one for several,
    # which neither the fused step nor what scales them in place can take.
    torch.autograd.backward(loss, inputs=weights)
    for group in groups:
        shorten([weight.grad for weight in group if weight.grad is not None], max_norm)
    optimizer.step()


def shorten(gradients: list[Tensor], max_norm: float) -> None:
    """Scale tensors down, in place, to ``max_norm`` in the Euclidean norm of them all when that is longer.

    The same numbers as those of :func:`torch.nn.utils.clip_grad_norm_`.
    """
    if not gradients:
        return
    norm = torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))
    torch._foreach_mul_(gradients, (max_norm / (norm + 1e-6)).clamp(max=1.0))
