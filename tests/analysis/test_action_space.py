"""Lists and explanations of actions, against definitions spelled out."""

import numpy as np
import pytest
from made_up_ranking import made_up_arrays, use_ranking

from rl2grid.analysis.action_space import (
    cut_off_elements,
    element_names,
    explain_action,
    list_actions,
    select_actions,
    substation_shares,
    switches_held,
    topology_after,
)
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.mdp.actions import ActionKind, describe, full_catalogue, level_catalogue, move, moved_elements, switch
from rl2grid.mdp.state import new_state
from rl2grid.mdp.termination import GameOver, game_over_reason

BUS14 = load_grid("bus14")
ALL = 1


@pytest.fixture
def arrays(tmp_path, monkeypatch):
    """What the ranking of bus14 holds."""
    made_up = made_up_arrays("bus14")
    made_up["trials"][9] = made_up["survived"][9] = 0
    use_ranking(monkeypatch, tmp_path, "bus14", made_up)
    return made_up


@pytest.mark.parametrize("level", [0, ALL])
def test_actions_are_selected_by_substation_and_line(level):
    catalogue = level_catalogue(BUS14, level)
    for sub in range(BUS14.n_sub):
        named = [k for k in range(len(catalogue)) if describe(BUS14, catalogue[k]).startswith(f"substation {sub}: ")]
        assert select_actions(BUS14, level, substation=sub).tolist() == named
    for line in (0, 6, 17):
        ends = {int(BUS14.line_or_pos_topo_vect[line]), int(BUS14.line_ex_pos_topo_vect[line])}
        concerned = [
            k
            for k in range(len(catalogue))
            for kind, target, mask in catalogue[k].changes
            if (kind == ActionKind.SWITCH and target == line)
            or (kind == ActionKind.MOVE and ends & set(moved_elements(BUS14, target, mask).tolist()))
        ]
        assert select_actions(BUS14, level, line=line).tolist() == concerned
        both = select_actions(BUS14, level, line=line, substation=5)
        assert set(both.tolist()) == set(concerned) & set(select_actions(BUS14, level, substation=5).tolist())
    assert len(select_actions(BUS14, level)) == len(catalogue)


@pytest.mark.parametrize(("condition", "allowed"), [({"substation": 14}, "0 to 13"), ({"line": -1}, "0 to 19")])
def test_what_the_grid_does_not_have_is_refused(condition, allowed):
    with pytest.raises(UsageError, match=f"of bus14 does not exist: choose from {allowed}"):
        select_actions(BUS14, 0, **condition)


def test_rows_say_what_the_ranking_holds(arrays):
    rows = list_actions(BUS14, 0, range(50))
    assert [row.catalogue for row in rows] == [0, *arrays["ids"][:49]]
    assert [row.rank for row in rows] == [None, *range(1, 50)]
    for row in rows:
        assert row.trials == arrays["trials"][row.catalogue]
        assert row.survival == pytest.approx(arrays["survived"][row.catalogue] / row.trials)
        assert row.survival_low < row.survival < row.survival_high
        assert row.margin == pytest.approx(arrays["margin"][row.catalogue])
        assert row.words == describe(BUS14, full_catalogue(BUS14)[row.catalogue])
    assert [row.survival for row in rows[1:]] == sorted((row.survival for row in rows[1:]), reverse=True)


def test_rows_of_an_action_without_trials_know_nothing(arrays):
    (row,) = list_actions(BUS14, ALL, [9])
    assert (row.catalogue, row.trials, row.survival_low, row.survival_high) == (9, 0, 0.0, 1.0)
    assert np.isnan([row.survival, row.margin]).all()


def test_actions_beyond_a_level_are_refused(arrays):
    with pytest.raises(UsageError, match="Action 50 of level 0 of bus14 does not exist: choose from 0 to 49"):
        list_actions(BUS14, 0, [50])


@pytest.mark.parametrize("grid_id", ["bus14", "bus118-MOB-v0"])
def test_what_is_cut_off_is_what_ends_an_episode(grid_id):
    """Against the reason of a game over, for some 200 or 800 actions of every kind."""
    grid = load_grid(grid_id)
    catalogue = full_catalogue(grid)
    state = new_state(grid, 1)
    state.storage_power[:] = 1.0
    step = max(1, len(catalogue) // 600)
    found = {True: 0, False: 0}
    for k in [*range(0, len(catalogue), step), *range(len(catalogue) - grid.n_line, len(catalogue))]:
        topology = topology_after(grid, catalogue[k])
        state.final_topo_vect[0] = topology
        # The reason that is left when the grid is in one piece.
        whole = game_over_reason(state, 0) == GameOver.DIVERGENCE
        assert (len(cut_off_elements(grid, topology)) == 0) == whole, describe(grid, catalogue[k])
        found[whole] += 1
    assert min(found.values()) > 0


def test_a_move_is_explained_element_by_element():
    action = move(5, 0b1010)
    explanation = explain_action(BUS14, action)
    first = int(BUS14.sub_first_element[5])
    assert [change.name for change in explanation.changes] == element_names(BUS14)[first : first + 7]
    assert [change.before for change in explanation.changes] == [1] * 7
    assert [change.after for change in explanation.changes] == [1, 2, 1, 2, 1, 1, 1]
    assert explanation.consequence == "The grid stays in one piece."
    assert explanation.cooldown == "None: substation 5 may be changed again in the next step."


def test_a_switch_is_explained_with_both_ends_and_what_it_cuts_off():
    line = int(np.flatnonzero((BUS14.line_or_to_subid == 7) | (BUS14.line_ex_to_subid == 7))[0])
    explanation = explain_action(BUS14, switch(line))
    assert [(change.before, change.after) for change in explanation.changes] == [(1, None), (1, None)]
    (generator,) = np.flatnonzero(BUS14.gen_to_subid == 7)
    assert explanation.cut_off == (f"generator {generator}",)
    assert explanation.consequence == f"Cut off: generator {generator}. This ends the episode."


def test_an_idle_storage_unit_may_be_cut_off():
    grid = load_grid("bus118-MOB-v0")
    sub = int(grid.storage_to_subid[0])
    bit = int(grid.storage_pos_topo_vect[0] - grid.sub_first_element[sub])
    explanation = explain_action(grid, move(sub, 1 << bit))
    assert explanation.consequence == "Cut off: storage 0. This ends the episode unless the storage is idle."


def test_cooldowns_are_those_of_the_grid():
    grid = load_grid("bus36-M")
    cooldown = explain_action(grid, move(4, 2)).cooldown
    assert cooldown == "Substation 4 may not be changed for 3 steps (15 minutes) afterwards."
    reversal = explain_action(grid, switch(4)).reversal
    assert reversal == "The same action closes the line again, once the cooldown is over."


@pytest.mark.parametrize("grid_id", ["bus14", "bus36-MO-v0", "bus118-M"])
def test_shares_and_switches_make_up_the_levels(grid_id):
    grid = load_grid(grid_id)
    shares = substation_shares(grid)
    assert [share.moves for share in shares] == sorted((share.moves for share in shares), reverse=True)
    for share in shares:
        assert share.moves == 2 ** (share.elements - 1) - 1 == share.held[-1]
    for level, size in enumerate(grid.level_sizes):
        assert 1 + sum(share.held[level] for share in shares) + switches_held(grid, level) == size
    assert switches_held(grid, len(grid.level_sizes) - 1) == grid.n_line
