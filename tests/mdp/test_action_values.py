"""Actions of several changes as values; masks of any size; catalogues of grids that cannot be enumerated."""

import math

import numpy as np
import pytest
from star_grid import star_grid

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp.actions import (
    DO_NOTHING,
    LARGEST_CATALOGUE,
    ActionKind,
    Change,
    StepAction,
    action_set_hash,
    check_changes,
    describe,
    full_catalogue,
    full_size,
    inject,
    joint,
    limited_catalogue,
    mask_integer,
    mask_words,
    move,
    moved_elements,
    one_change,
    reconnect,
    restore,
    switch,
    write_mask,
)

BUS14 = load_grid("bus14")
HASHES = {
    "bus14": ("b43d481bc44c2cf7", "640acf1573ebb705"),
    "bus36-M": ("e6672261fb543cab", "36f704894eb2efd2"),
    "bus36-MO-v0": ("ab4cd913953da8df", "26b3b1ad1c95faae"),
    "bus36-MO-v1": ("e1a18c7b1a8f3c2c", "c5ba6a347008ece6"),
    "bus118-M": ("be081cd75f509d30", "ef59c69aaa872d5a"),
    "bus118-MOB-v0": ("f6d877cd1e7a9fba", "107c48e82f28113c"),
    "bus118-MOB-v1": ("1a1b921feb11c0e6", "94d7f661f1a9f432"),
}
"""Of the lowest and the highest level."""


def test_an_action_is_its_changes_and_its_injection():
    values = np.zeros(6, np.float32)
    action = joint(move(3, 0b10), switch(4), inject(values), restore(8))
    assert action.changes == (Change(1, 3, 0b10), Change(2, 4), Change(4, 8))
    assert action.values is values
    assert joint() == joint(DO_NOTHING, DO_NOTHING) == StepAction() == one_change(ActionKind.NOTHING, 7)
    assert one_change(ActionKind.RECONNECT, 7) == reconnect(7)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ((move(3, 2), restore(3)), "Two changes of one action are of substation 3"),
        ((switch(3), move(3, 2), reconnect(3)), "Two changes of one action are of line 3"),
        ((inject(np.zeros(6)), inject(np.zeros(6))), "2 of the actions inject"),
    ],
)
def test_the_same_thing_twice_is_refused(actions, message):
    with pytest.raises(UsageError, match=message):
        joint(*actions)


@pytest.mark.parametrize("kind", [0, 5, -1])
def test_a_change_that_is_none_is_refused(kind):
    with pytest.raises(UsageError, match="no kind of change: give MOVE, SWITCH, RECONNECT or RESTORE"):
        StepAction((Change(kind, 0),))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (switch(20), "Line 20 of bus14 does not exist: choose from 0 to 19"),
        (reconnect(-1), "Line -1 of bus14 does not exist"),
        (restore(14), "Substation 14 of bus14 does not exist: choose from 0 to 13"),
        (move(0, 0b1000), "Mask 0x8 names elements that substation 0 of bus14 does not have: of its 3 elements"),
        (move(0, -1), "does not have"),
    ],
)
def test_what_the_grid_does_not_have_is_refused(action, message):
    with pytest.raises(UsageError, match=message):
        check_changes(BUS14, action.changes)
    check_changes(BUS14, (*switch(19).changes, *restore(13).changes, *move(0, 0b111).changes))


def test_joint_actions_in_words():
    action = joint(switch(1), move(3, 0b110), inject(np.array([0.5, 0, 0, 0, 0, 0], np.float32)))
    alone = [describe(BUS14, each) for each in (switch(1), move(3, 0b110))]
    assert describe(BUS14, action) == "; ".join([*alone, "redispatch gen_1_0 by +2.5 MW"])


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_the_action_sets_are_those_that_were_always_there(grid_id):
    grid = load_grid(grid_id)
    last = len(grid.level_sizes) - 1
    assert (action_set_hash(grid, 0), action_set_hash(grid, last)) == HASHES[grid_id]
    assert full_catalogue(grid).mask.shape[1] == mask_words(grid) == 1


@pytest.mark.parametrize(("n_elements", "words"), [(40, 1), (64, 1), (70, 2)])
def test_masks_of_any_size_go_to_words_and_back(n_elements, words):
    grid = star_grid(n_elements)
    assert mask_words(grid) == words
    out = np.zeros(words, np.uint64)
    for mask in (0, 1, 1 << n_elements - 1, (1 << n_elements) - 1, 0x5555555555 << n_elements - 40):
        write_mask(mask, out)
        assert mask_integer(out) == mask
        assert moved_elements(grid, 0, mask).tolist() == [k for k in range(n_elements) if mask >> k & 1]


@pytest.mark.parametrize("n_elements", [40, 70])
def test_a_catalogue_that_cannot_be_enumerated_is_refused(n_elements):
    grid = star_grid(n_elements)
    assert grid.level_sizes[0] > LARGEST_CATALOGUE
    with pytest.raises(UsageError, match=rf"substation 0 has {n_elements} elements\): take a limited_catalogue"):
        full_catalogue(grid)
    with pytest.raises(UsageError, match="limited_catalogue"):
        action_set_hash(grid, 0)


@pytest.mark.parametrize("n_elements", [40, 70])
def test_a_limited_catalogue_holds_the_smallest_moves(n_elements):
    grid = star_grid(n_elements)
    catalogue = limited_catalogue(grid, max_elements=2, most=100_000)
    outer = grid.n_sub - 1
    moves = [catalogue[k].changes[0] for k in range(len(catalogue)) if catalogue.kind[k] == ActionKind.MOVE]
    # Substations of 3 elements have 3 moves: of the smaller set, which has one element, or of all others.
    assert len(moves) == math.comb(n_elements, 1) + math.comb(n_elements, 2) + 3 * outer
    assert len(catalogue) == 1 + len(moves) + grid.n_line
    assert catalogue[0] == DO_NOTHING
    assert catalogue[len(catalogue) - 1] == switch(grid.n_line - 1)
    assert len({(each.target, each.mask) for each in moves}) == len(moves)
    assert not any(each.mask & 1 for each in moves)
    check_changes(grid, moves)
    sizes = [each.mask.bit_count() for each in moves if each.target == 0]
    assert set(sizes) == {1, 2, n_elements - 1, n_elements - 2}
    assert move(0, 1 << n_elements - 1 | 1 << 33).changes[0] in moves
    few = limited_catalogue(grid, max_elements=2, most=300)
    assert len(few) == 300
    n_moves = 299 - grid.n_line
    assert [few[1 + k].changes[0] for k in range(n_moves)] == moves[:n_moves]
    assert catalogue.find(ActionKind.MOVE, 0, moves[-1].mask) == len(moves)
    assert catalogue.find(ActionKind.MOVE, 0, 0b1110) == -1


def test_a_limited_catalogue_without_limits_is_the_full_one():
    small, full = limited_catalogue(BUS14, max_elements=9, most=10**6), full_catalogue(BUS14)
    assert len(small) == len(full) == full_size(BUS14.sub_info.tolist(), BUS14.n_line)
    assert {small[k] for k in range(len(small))} == {full[k] for k in range(len(full))}


def test_limits_that_leave_nothing_are_refused():
    with pytest.raises(UsageError, match="max_elements=0 is not allowed"):
        limited_catalogue(BUS14, max_elements=0)
    with pytest.raises(UsageError, match="most=20 is not allowed: bus14 has 21 actions without moves"):
        limited_catalogue(BUS14, most=20)
    assert len(limited_catalogue(BUS14, most=21)) == 21
