"""Notes of actions: compiled code finds which are worth a word, as those do who put them into words."""

from __future__ import annotations

import numpy as np

from rl2grid.engines.action_effects import TOLERANCE, clipping
from rl2grid.engines.native.action_notes import _is_clipped, new_action_notes, notes_of
from rl2grid.engines.native.constants import new_constants
from rl2grid.engines.native.orders import new_orders
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import StepAction, continuous_layout, decode_continuous
from rl2grid.mdp.state import new_state

GRID = load_grid("bus118-MOB-v1")  # with storage
N = 400


def test_injections_are_worth_a_word_that_have_one():
    random = np.random.default_rng(0)
    orders, state = new_orders(GRID, N), new_state(GRID, N)
    constants, layout = new_constants(GRID), continuous_layout(GRID)
    texts, found = [], []
    for i in range(N):
        orders.injection[i] = (random.random(layout.size) < 0.03) * random.uniform(-1, 1, layout.size)
        orders.injects[i] = random.random() < 0.9
        for flags in (state.terminated, state.illegal, state.ambiguous):
            flags[i] = random.random() < 0.1
        asked = decode_continuous(GRID, orders.injection[i])
        state.target_dispatch[i] = random.normal(size=GRID.n_gen)
        state.actual_dispatch[i] = state.target_dispatch[i] - random.choice([0.0, 0.9, 1.1]) * TOLERANCE
        state.storage_power[i] = asked.storage - random.choice([0.0, 0.9, 1.1]) * TOLERANCE * (asked.storage != 0)
        action = StepAction((), orders.injection[i] if orders.injects[i] else None)
        texts.append(clipping(GRID, state, i, action))
        # Not compiled: for arrays that are handed over as such, that takes longer than all rows here.
        found.append(_is_clipped.py_func(constants, orders, state, i))
    np.testing.assert_array_equal(found, [text != "" for text in texts])
    kinds = {text.partition(" ")[0] for text in texts} | {"storage" for text in texts if "works at" in text}
    assert kinds == {"", "refused:", "clipped:", "storage"}, "the test did not see one of them"


def test_notes_of_some_rows_are_a_copy():
    notes = new_action_notes(GRID, 4)
    notes.verdict_target[:] = range(4)
    kept = notes_of(notes, np.array([3, 1]))
    notes.verdict_target[:] = -1
    np.testing.assert_array_equal(kept.verdict_target, [3, 1])
    assert kept.actual_dispatch.shape == (2, GRID.n_gen)
