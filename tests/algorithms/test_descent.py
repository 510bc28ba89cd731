from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor, nn

from rl2grid.algorithms.descent import Adam, descend, shorten


def network(seed: int = 0) -> nn.Sequential:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(5, 4), nn.Tanh(), nn.Linear(4, 2))


def groups(made: nn.Sequential) -> list[dict[str, object]]:
    return [{"params": list(made[0].parameters()), "lr": 1e-2}, {"params": list(made[2].parameters())}]


def loss(made: nn.Module, step: int) -> Tensor:
    inputs = torch.randn(16, 5, generator=torch.Generator().manual_seed(step))
    return made(inputs).square().mean()  # type: ignore[no-any-return]


def weights(made: nn.Module) -> list[list[float]]:
    return [weight.flatten().tolist() for weight in made.parameters()]


def pytorchs_step(optimizer: torch.optim.Optimizer, value: Tensor, max_norm: float) -> None:
    optimizer.zero_grad()
    value.backward()  # type: ignore[no-untyped-call]
    for group in optimizer.param_groups:
        nn.utils.clip_grad_norm_(group["params"], max_norm)
    optimizer.step()


@pytest.mark.parametrize("max_norm", [1e-3, 10.0])
def test_the_same_weights_as_with_pytorchs_optimiser_whatever_is_resumed_or_skipped(max_norm: float):
    ours, theirs = network(), network()
    optimizer = Adam(groups(ours), lr=3e-3, eps=1e-5)
    reference = torch.optim.Adam(groups(theirs), lr=3e-3, eps=1e-5, fused=True)
    for step in range(12):
        if step == 4:  # as from a checkpoint
            state = copy.deepcopy(optimizer.state_dict())
            optimizer = Adam(groups(ours), lr=3e-3, eps=1e-5)
            optimizer.load_state_dict(state)
        optimizer.param_groups[1]["lr"] = reference.param_groups[1]["lr"] = 1e-3 * (12 - step)
        descend(optimizer, loss(ours, step), max_norm)
        pytorchs_step(reference, loss(theirs, step), max_norm)
        if step == 8:  # a step that one layer has no part in
            for one, made in ((optimizer, ours), (reference, theirs)):
                one.zero_grad()
                made[2].bias.sum().backward()
                one.step()
        assert weights(ours) == weights(theirs)


class Joined(nn.Module):
    """Two layers that are multiplied at once, a third by its columns, biases that are added.

    The gradients lie in memory as their weights do not, and those of the biases are one.
    """

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.left, self.right = nn.Parameter(torch.randn(4, 5)), nn.Parameter(torch.randn(4, 5))
        self.turned = nn.Parameter(torch.randn(8, 2))
        self.first, self.second = nn.Parameter(torch.randn(4)), nn.Parameter(torch.randn(4))

    def forward(self, inputs: Tensor) -> Tensor:
        joined = torch.cat([self.left, self.right], dim=1)
        outputs = torch.mm(torch.cat([inputs, inputs.cos()], dim=1), joined.t()) + (self.first + self.second)
        return outputs @ self.turned.t()[:, :4].t()


@pytest.mark.parametrize("fused", [False, True])
def test_gradients_that_lie_otherwise_than_their_weights_or_in_one_place(fused: bool):
    ours, theirs = Joined(), Joined()
    raw = torch.autograd.grad(loss(ours, 0), list(ours.parameters()))
    assert any(gradient.stride() != weight.stride() for gradient, weight in zip(raw, ours.parameters(), strict=True))
    assert raw[3].data_ptr() == raw[4].data_ptr()
    optimizer = Adam(ours.parameters(), lr=3e-3)
    reference = torch.optim.Adam(theirs.parameters(), lr=3e-3, fused=fused)
    for step in range(4):
        descend(optimizer, loss(ours, step), 0.1)
        pytorchs_step(reference, loss(theirs, step), 0.1)
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-6, atol=1e-6)


def test_only_the_weights_of_the_optimiser_get_gradients():
    moved, seen = network(), network(1)
    descend(Adam(moved.parameters(), lr=1e-3), loss(seen, 0) * loss(moved, 0), 1.0)
    assert all(weight.grad is not None for weight in moved.parameters())
    assert all(weight.grad is None for weight in seen.parameters())


def test_weights_that_the_loss_does_not_depend_on_stay():
    made = network()
    before = weights(made)
    for _ in range(2):
        descend(Adam(made.parameters(), lr=1e-3), made[0](torch.ones(3, 5)).sum(), 1.0)
    after = weights(made)
    assert after[2:] == before[2:]
    assert after[0] != before[0]


@pytest.mark.parametrize("max_norm", [0.1, 100.0])
def test_gradients_are_shortened_as_by_pytorch(max_norm: float):
    made = network()
    loss(made, 0).backward()  # type: ignore[no-untyped-call]
    mine = [weight.grad.clone() for weight in made.parameters() if weight.grad is not None]
    nn.utils.clip_grad_norm_(made.parameters(), max_norm)
    shorten(mine, max_norm)
    for gradient, weight in zip(mine, made.parameters(), strict=True):
        assert torch.equal(gradient, weight.grad)  # type: ignore[arg-type]
    shorten([], max_norm)
