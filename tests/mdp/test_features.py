"""Observations: the published order, every entry at its place, and constants that never divide by zero."""

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.mdp.features import feature_slices, observation_size, physical_scale
from rl2grid.mdp.observations import observation_writer

SHARED = ["t", "gen_p", "gen_theta", "load_p", "load_theta", "rho", "time_before_cooldown_line"]
SPECIFIC = {
    "T": ["topo_vect", "line_status", "timestep_overflow", "time_before_cooldown_sub"],
    "R": [
        "target_dispatch",
        "actual_dispatch",
        "gen_margin_up",
        "gen_margin_down",
        "gen_p_before_curtail",
        "curtailment",
        "curtailment_limit",
    ],
}
SPECIFIC["H"] = SPECIFIC["T"] + SPECIFIC["R"]
MAINTENANCE = ["time_next_maintenance", "duration_next_maintenance"]
STORAGE = ["storage_charge", "storage_power_target", "storage_power", "storage_theta"]


def written(grid, kind, state, i):
    out = np.full(observation_size(grid, kind), np.nan, np.float32)
    observation_writer(kind)(state, i, out)
    return out


def scale_of(grid_id, kind, feature):
    grid = load_grid(grid_id)
    shift, scale = physical_scale(grid, kind)
    where = feature_slices(grid, kind)[feature]
    return shift[where], scale[where]


@pytest.mark.parametrize("kind", ["T", "R", "H"])
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_features_follow_the_published_order_without_gaps(grid_id, kind):
    grid = load_grid(grid_id)
    slices = feature_slices(grid, kind)
    assert list(slices) == SHARED + SPECIFIC[kind] + MAINTENANCE + (STORAGE if grid.n_storage else [])
    ends = [0, *(place.stop for place in slices.values())]
    assert [place.start for place in slices.values()] == ends[:-1]
    assert ends[-1] == observation_size(grid, kind)


@pytest.mark.parametrize(("grid_id", "kind", "size"), [("bus14", "T", 226), ("bus14", "R", 157), ("bus14", "H", 268)])
def test_sizes_counted_by_hand(grid_id, kind, size):
    # 1 + 2*6 gens + 2*11 loads + 2*20 lines + (57 elements + 2*20 + 14 subs | 7*6 gens) + 2*20 lines
    assert observation_size(load_grid(grid_id), kind) == size


@pytest.mark.parametrize("kind", ["T", "R", "H"])
def test_every_entry_is_the_attribute_of_its_name(grid, random_rows, kind):
    for i in range(len(random_rows.step)):
        observation = written(grid, kind, random_rows, i)
        assert observation.dtype == np.float32
        for name, place in feature_slices(grid, kind).items():
            if name == "t":
                expected = np.float32(random_rows.step[i] / random_rows.episode_length[i])
            else:
                expected = getattr(random_rows, name)[i].astype(np.float32)
            np.testing.assert_array_equal(observation[place], expected, err_msg=name)


@pytest.mark.parametrize("kind", ["T", "R", "H"])
@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_physical_constants_are_positive_and_finite(grid_id, kind):
    grid = load_grid(grid_id)
    shift, scale = physical_scale(grid, kind)
    assert shift.shape == scale.shape == (observation_size(grid, kind),)
    assert shift.dtype == scale.dtype == np.float32
    assert np.isfinite(shift).all()
    assert np.isfinite(scale).all()
    assert (scale > 0).all()


@pytest.mark.parametrize("kind", ["T", "R", "H"])
def test_scaled_observations_are_of_order_one(grid, random_rows, kind):
    shift, scale = physical_scale(grid, kind)
    for i in np.flatnonzero(~random_rows.terminated):
        scaled = (written(grid, kind, random_rows, i) - shift) / scale
        # Loads of a random state share its total at random, so one may exceed its usual maximum by far.
        scaled[feature_slices(grid, kind)["load_p"]] = 0
        assert np.abs(scaled).max() <= 10


def test_constants_by_feature():
    grid = load_grid("bus118-MOB-v1")
    np.testing.assert_array_equal(scale_of(grid.id, "T", "gen_p")[1], grid.gen_pmax)
    np.testing.assert_array_equal(scale_of(grid.id, "T", "load_p")[1], grid.load_p_max)
    np.testing.assert_array_equal(scale_of(grid.id, "T", "storage_charge")[1], grid.storage_emax)
    for name, expected in {
        "t": 1,
        "gen_theta": 180,
        "rho": 1,
        "time_before_cooldown_line": 96,  # an attack or a day's maintenance of 8 hours
        "timestep_overflow": 3,
        "time_before_cooldown_sub": 3,
        "time_next_maintenance": 2016,
        "duration_next_maintenance": 96,
        "storage_theta": 180,
    }.items():
        assert set(scale_of(grid.id, "T", name)[1].tolist()) == {expected}, name
        assert not scale_of(grid.id, "T", name)[0].any(), name


def test_the_reference_topology_scales_to_zero():
    shift, scale = scale_of("bus14", "T", "topo_vect")
    np.testing.assert_array_equal((np.float32([-1, 1, 2]) - shift[0]) / scale[0], [-2, 0, 1])


def test_a_constant_that_is_zero_leaves_the_entry_in_its_unit():
    grid = load_grid("bus14")
    _, ramp = scale_of("bus14", "R", "gen_margin_up")
    assert (grid.gen_max_ramp_up == 0).any()
    np.testing.assert_array_equal(ramp, np.where(grid.gen_max_ramp_up > 0, grid.gen_max_ramp_up, 1))
    assert grid.rules.cooldown_sub == 0
    assert set(scale_of("bus14", "T", "time_before_cooldown_sub")[1].tolist()) == {1}


@pytest.mark.parametrize(
    "ask",
    [
        lambda grid: feature_slices(grid, "t"),
        lambda grid: observation_size(grid, "X"),
        lambda grid: physical_scale(grid, ""),
        lambda grid: observation_writer("topology"),
    ],
)
def test_an_unknown_kind_is_refused(ask):
    with pytest.raises(UsageError, match=r"Kind of task .* does not exist: choose one of T, R, H\."):
        ask(load_grid("bus14"))
