from __future__ import annotations

import numpy as np
import pytest
import torch

from rl2grid.algorithms.sampling import drawn, legal_log_softmax


def test_actions_are_drawn_as_often_as_they_weigh_and_never_without_weight():
    weights = torch.tensor([0.0, 3.0, 0.0, 1.0, 4.0, 0.0]).expand(40_000, -1)
    actions = drawn(weights, torch.Generator().manual_seed(0))
    shares = np.bincount(actions.numpy(), minlength=6) / len(actions)
    np.testing.assert_allclose(shares, weights[0].numpy() / 8.0, atol=0.01)
    assert not shares[[0, 2, 5]].any()


@pytest.mark.parametrize("uniform", [0.0, 1.0 - 2.0**-24])
@pytest.mark.parametrize("first", [0.0, 0.1])
def test_the_ends_of_the_unit_interval_belong_to_actions_with_weight(
    uniform: float, first: float, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(torch, "rand", lambda *shape, generator: torch.full(shape, uniform))
    rows = torch.tensor([[first, 0.3, 0.3, 0.0], [first, 0.7, 1e-9, 0.0], [first, 1e-20, 0.0, 0.0]])
    actions = drawn(rows, torch.Generator())
    assert (rows[torch.arange(3), actions] > 0.0).all()


def test_one_number_per_row_is_drawn():
    generator, same = torch.Generator().manual_seed(3), torch.Generator().manual_seed(3)
    drawn(torch.rand(7, 50), generator)
    torch.rand(7, generator=same)
    assert torch.equal(generator.get_state(), same.get_state())


def test_log_probabilities_are_the_same_where_nothing_is_learned_from_them():
    logits = torch.randn(5, 7, generator=torch.Generator().manual_seed(0), requires_grad=True)
    masks = torch.rand(5, 7, generator=torch.Generator().manual_seed(1)) > 0.3
    for legal in (None, masks):
        learned_from = legal_log_softmax(logits, legal)
        with torch.no_grad():
            played = legal_log_softmax(logits, legal)
        assert learned_from.requires_grad
        assert not played.requires_grad
        assert torch.equal(played, learned_from)
