"""Probabilities of actions in compiled code, against PyTorch in float64."""

import math

import numpy as np
import pytest
import torch

from rl2grid.algorithms.sampling import legal_log_softmax, log_probabilities_and_entropies
from rl2grid.dense.choices import find_best

SHAPES = [(1, 1), (3, 2), (256, 50), (5, 1000)]


def logits_of(shape, spread=3.0):
    """Logits, legal actions (the first always), and legal actions that were chosen."""
    random = np.random.default_rng(shape)
    logits = torch.from_numpy((spread * random.normal(size=shape)).astype(np.float32)).requires_grad_()
    legal = random.random(shape) < 0.7
    legal[:, 0] = True
    chosen = [random.choice(np.flatnonzero(row)) for row in legal]
    return logits, torch.from_numpy(legal), torch.tensor(chosen)


def exactly(logits, legal):
    return logits.double().masked_fill(~legal, -1e8).log_softmax(dim=-1)


@pytest.mark.parametrize("spread", [0.0, 3.0, 60.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_log_probabilities_and_their_gradients(shape, spread):
    logits, legal, _ = logits_of(shape, spread)
    weights = torch.from_numpy(np.random.default_rng(1).normal(size=shape))
    mine, exact = legal_log_softmax(logits, legal), exactly(logits, legal)
    torch.testing.assert_close(mine[legal].double(), exact[legal], rtol=2e-7, atol=1e-6)
    assert (mine[~legal] < -9e7).all()
    assert (mine.exp()[~legal] == 0).all()
    gradients = [torch.autograd.grad((each * weights)[legal].sum(), logits)[0] for each in (mine, exact)]
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("spread", [0.0, 3.0, 60.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_what_was_chosen_entropies_and_their_gradients(shape, spread):
    logits, legal, actions = logits_of(shape, spread)
    exact = exactly(logits, legal)
    entropy = -(exact.exp() * exact).sum(dim=-1)
    theirs = exact.gather(-1, actions.unsqueeze(-1)).squeeze(-1), entropy
    mine = log_probabilities_and_entropies(logits, legal, actions)
    weights = torch.from_numpy(np.random.default_rng(1).normal(size=(2, shape[0])))
    for one, other in zip(mine, theirs, strict=True):
        torch.testing.assert_close(one.double(), other, rtol=2e-7, atol=2e-6)
    gradients = [
        torch.autograd.grad(sum((w * each).sum() for w, each in zip(weights, pair, strict=True)), logits)[0]
        for pair in (mine, theirs)
    ]
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-5)


def test_both_give_the_same_log_probabilities_with_and_without_masks():
    logits, legal, actions = logits_of((40, 30))
    for masks in (legal, None):
        chosen, entropies = log_probabilities_and_entropies(logits, masks, actions)
        every = legal_log_softmax(logits, masks)
        assert torch.equal(chosen, every.gather(-1, actions.unsqueeze(-1)).squeeze(-1))
        torch.testing.assert_close(entropies, -(every.exp() * every).sum(dim=-1))


def test_a_row_is_the_same_in_any_batch():
    logits, legal, _ = logits_of((40, 37))
    together = legal_log_softmax(logits, legal)
    assert all(torch.equal(legal_log_softmax(logits[k : k + 1], legal[k : k + 1])[0], together[k]) for k in range(40))


def test_only_what_is_not_a_number_spoils_its_row():
    logits = torch.zeros(3, 4)
    logits[1, 2] = math.nan
    spoiled = legal_log_softmax(logits, None).isnan()
    assert spoiled.tolist() == [[False] * 4, [True] * 4, [False] * 4]


@pytest.mark.parametrize("n_best", [1, 10, 300, 999, 1000, 2500])
@pytest.mark.parametrize("n_values", [3, 1_000_000])
def test_the_best_are_those_of_a_stable_sort(n_values, n_best):
    """Of few different values most are equal."""
    random = np.random.default_rng(n_best)
    for n_actions in (n_best, n_best + 1, 4000):
        values = random.integers(n_values, size=n_actions).astype(np.float32)
        for share in (0.0, 0.05, 1.0):
            allowed = random.random(n_actions) < share
            best = np.full(n_best, -1, np.int32)
            found = find_best(values, allowed, best)
            order = np.argsort(-values, kind="stable")
            expected = order[allowed[order]][:n_best]
            assert best[:found].tolist() == expected.tolist()
            assert (best[found:] == -1).all()
