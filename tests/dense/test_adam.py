"""Adam in compiled code, against PyTorch."""

import numpy as np
import pytest
import torch

from rl2grid.dense import adam


def numbers(n, seed):
    return np.random.default_rng([seed, n]).normal(size=n).astype(np.float32)


@pytest.mark.parametrize("n", [1, 15, 16, 1000])
@pytest.mark.parametrize("max_norm", [1e-3, 1e3])
def test_gradients_are_shortened_as_by_pytorch(n, max_norm):
    mine, weight = numbers(n, 0), torch.zeros(n, requires_grad=True)
    weight.grad = torch.from_numpy(mine.copy())
    adam.shorten(mine, max_norm)
    torch.nn.utils.clip_grad_norm_([weight], max_norm)
    np.testing.assert_allclose(mine, weight.grad.numpy(), rtol=2e-6)


def test_steps_are_those_of_pytorch():
    weights, means, squares = numbers(1000, 1), np.zeros(1000, np.float32), np.zeros(1000, np.float32)
    weight = torch.from_numpy(weights.copy()).requires_grad_()
    theirs = torch.optim.Adam([weight], lr=3e-3, eps=1e-5)
    for k in range(1, 51):
        gradients = (10.0 ** (k % 5 - 3)) * numbers(1000, k)
        weight.grad = torch.from_numpy(gradients.copy())
        theirs.step()
        adam.step(weights, gradients, means, squares, k, 3e-3, 1e-5)
    np.testing.assert_allclose(weights, weight.detach().numpy(), atol=1e-6)


def test_what_is_not_a_number_is_not_hidden():
    gradients = np.array([1.0, np.nan], np.float32)
    adam.shorten(gradients, 0.5)
    assert np.isnan(gradients).any()
