"""Diagnostics of an update, by hand."""

from __future__ import annotations

import math

import pytest
import torch

from rl2grid.algorithms.diagnostics import explained_variance, mean


def test_explained_variance():
    returns = torch.tensor([1.0, 2.0, 3.0, 4.0])
    assert explained_variance(returns, returns) == 1.0
    assert explained_variance(torch.full((4,), 2.5), returns) == 0.0
    assert explained_variance(-returns, returns) == pytest.approx(-3.0)
    assert math.isnan(explained_variance(returns, torch.ones(4)))


def test_the_mean_of_nothing_is_not_a_number():
    assert mean([torch.tensor(1.0), torch.tensor(4.0)]) == 2.5
    assert math.isnan(mean([]))
