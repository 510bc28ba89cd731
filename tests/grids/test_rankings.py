"""The committed rankings."""

from pathlib import Path

import numpy as np
import pytest
from made_up_ranking import made_up_arrays, use_ranking

from rl2grid.errors import UsageError
from rl2grid.evaluation import ranking as ranking_method
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.grids.rankings import ranking, ranking_hash, trials
from rl2grid.mdp.actions import ActionKind, full_catalogue, level_ids


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_a_ranking_serves_every_level_below_the_highest(grid_id):
    grid, ranked = load_grid(grid_id), ranking(grid_id)
    assert ranked.ids.dtype == np.int32
    assert len(ranked.ids) >= grid.level_sizes[-2] - 1
    assert len(ranked.ids) < grid.level_sizes[-1]
    assert len(np.unique(ranked.ids)) == len(ranked.ids)
    assert ranked.ids.min() >= 1
    assert ranked.ids.max() < grid.level_sizes[-1]


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_a_ranking_tells_how_it_was_made(grid_id):
    metadata = ranking(grid_id).metadata
    assert metadata["version"] == ranking_method.VERSION
    assert metadata["command"].startswith(f"rl2grid rank {grid_id} --states ")
    assert metadata["grid"] == grid_id
    assert metadata["split"] == "train"
    assert sum(metadata["states"].values()) >= 200


def switched(grid_id: str, level: int) -> set[int]:
    """Lines that an action of a level switches."""
    grid = load_grid(grid_id)
    actions = full_catalogue(grid).take(level_ids(grid, level))
    return set(actions.target[actions.kind == ActionKind.SWITCH].tolist())


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_lines_that_others_open_can_be_closed_in_level_0_or_the_documentation_names_them(grid_id):
    grid, closed = load_grid(grid_id), switched(grid_id, 0)
    known, _ = ranking_method._lines_to_close(grid, np.zeros(grid.n_line, np.int32))
    assert set(known) <= closed
    left_out = ranking(grid_id).metadata["tripped_and_not_closed_in_level_0"]
    assert not set(map(int, left_out)) & closed
    named = ", ".join(f"{line} ({times})" for line, times in left_out.items()) or "none"
    counts = len(known), len(closed) - len(known), grid.n_line - len(closed)
    row = f"| {grid_id} | {' | '.join(map(str, counts))} | {named} |"
    assert row in (Path(__file__).parents[2] / "docs" / "actions.md").read_text()


def test_what_level_1_closes_beside_level_0_is_documented():
    more = {}
    for grid_id in GRID_IDS:
        left_out = map(int, ranking(grid_id).metadata["tripped_and_not_closed_in_level_0"])
        more[grid_id] = set(left_out) & switched(grid_id, 1)
    assert {grid_id: lines for grid_id, lines in more.items() if lines} == {
        "bus118-M": {105},
        "bus118-MOB-v1": {41, 60, 127},
    }


def test_hashes_differ_between_grids_and_follow_the_ids():
    assert len({ranking_hash(grid_id) for grid_id in GRID_IDS}) == len(GRID_IDS)
    assert all(len(ranking_hash(grid_id)) == 16 for grid_id in GRID_IDS)


def test_a_ranking_can_not_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        ranking("bus14").ids[0] = 1


def test_an_unknown_grid_is_refused():
    with pytest.raises(UsageError, match="'bus15' does not exist: choose one of bus14"):
        ranking("bus15")


def test_trials_are_read_as_they_were_written(tmp_path, monkeypatch):
    arrays = made_up_arrays("bus14")
    use_ranking(monkeypatch, tmp_path, "bus14", arrays)
    tried = trials("bus14")
    assert (tried.trials.dtype, tried.survived.dtype, tried.margin.dtype) == (np.uint32, np.uint32, np.float32)
    for name in ("trials", "survived", "margin"):
        assert (getattr(tried, name) == arrays[name]).all()
        with pytest.raises(ValueError, match="read-only"):
            getattr(tried, name)[0] = 1
    assert (ranking("bus14").ids == arrays["ids"]).all()


def test_survival_is_the_share_of_trials_and_unknown_without_any(tmp_path, monkeypatch):
    arrays = made_up_arrays("bus14")
    arrays["trials"][:3], arrays["survived"][:3] = (0, 4, 5), (0, 1, 5)
    use_ranking(monkeypatch, tmp_path, "bus14", arrays)
    survival = trials("bus14").survival
    assert np.isnan(survival[0])
    assert survival[1:3].tolist() == [0.25, 1.0]
    assert not np.isnan(survival[1:]).any()


def test_a_ranking_without_trials_serves_levels_but_not_people(tmp_path, monkeypatch):
    use_ranking(monkeypatch, tmp_path, "bus14", {"ids": np.array([5, 3], np.int32)})
    assert ranking("bus14").ids.tolist() == [5, 3]
    with pytest.raises(UsageError, match=r"bus14 does not tell how often .* make it anew with `rl2grid rank bus14`"):
        trials("bus14")


def test_trials_of_another_number_of_actions_are_refused(tmp_path, monkeypatch):
    arrays = made_up_arrays("bus14")
    arrays["margin"] = arrays["margin"][:-1]
    use_ranking(monkeypatch, tmp_path, "bus14", arrays)
    with pytest.raises(UsageError, match="tells of 208 actions where the grid has 209"):
        trials("bus14")


def test_trials_of_an_unknown_grid_are_refused():
    with pytest.raises(UsageError, match="'bus15' does not exist: choose one of bus14"):
        trials("bus15")
