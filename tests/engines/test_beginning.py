"""Training episodes begun in compiled code are those that are planned and handed over one by one."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.engines.native.engine import NativeEngine
from rl2grid.engines.native.training_library import training_library
from rl2grid.grids import GRID_IDS, Grid, load_grid
from rl2grid.scenarios.episodes import MAX_STEPS, EpisodePlan, plan_episode
from rl2grid.structures import Role, fields_of

N = 12
_DRAWN = ("waits", "durations", "choices")


def begun(
    grid: Grid, seeds: np.ndarray, numbers: np.ndarray, maintained: bool, n_steps: int = MAX_STEPS
) -> tuple[NativeEngine, list[EpisodePlan]]:
    engine, rows = NativeEngine(grid, len(seeds)), np.arange(len(seeds))
    library = training_library(grid)
    draws = engine.draw_training(library, seeds, numbers)
    engine.show_training(library, 0, rows, draws, maintained, n_steps)
    starts = engine.take_training(library, rows, draws)
    drawn = zip(seeds.tolist(), numbers.tolist(), *map(np.ndarray.tolist, starts), strict=True)
    plans = [
        EpisodePlan(seed, number, scenario_id, row, n_steps, maintained, redraws)
        for seed, number, scenario_id, row, redraws in drawn
    ]
    return engine, plans


def assert_same(first: NativeEngine, second: NativeEngine) -> None:
    for part in ("state", "hidden", "opponent"):
        one, other = (getattr(engine.environments, part) for engine in (first, second))
        for name in fields_of(type(one), Role.EPISODE, Role.KEPT):
            values, expected = getattr(one, name), getattr(other, name)
            if name.startswith("outage_") and values.ndim == 2:
                width = int(second.environments.hidden.outage_count.max(initial=0))
                values, expected = values[:, :width], expected[:, :width]
                there = np.arange(width) < second.environments.hidden.outage_count[:, np.newaxis]
                values, expected = values[there], expected[there]
            if name in _DRAWN:
                there = np.arange(values.shape[2]) < second.environments.opponent.n_attacks[:, :, np.newaxis]
                values, expected = values[there], expected[there]
            np.testing.assert_array_equal(values, expected, err_msg=f"{part}.{name}")


@pytest.mark.parametrize("grid_id", GRID_IDS)
@pytest.mark.parametrize("maintained", [True, False])
def test_an_episode_is_what_is_planned_of_it(grid_id: str, maintained: bool) -> None:
    grid = load_grid(grid_id)
    seeds, numbers = np.arange(N) * 7919, np.zeros(N, np.int64)
    engine, plans = begun(grid, seeds, numbers, maintained)
    other = NativeEngine(grid, N)
    expected = [plan_episode(grid, "train", seed, 0, maintenance=maintained) for seed in seeds.tolist()]
    assert plans == expected
    for i, plan in enumerate(expected):
        other.reset(i, plan)
    assert_same(engine, other)
    assert not maintained or (engine.environments.hidden.outage_count > 0).any() or "bus36" in grid_id
    assert [engine.save(i).series for i in range(N)] == [other.save(i).series for i in range(N)]


def test_a_week_is_begun_as_it_is_planned() -> None:
    """On the grid whose opponent draws until the end of the episode."""
    grid, seeds = load_grid("bus36-MO-v1"), np.arange(N)
    engine, plans = begun(grid, seeds, np.zeros(N, np.int64), True, 2016)
    other = NativeEngine(grid, N)
    assert plans == [plan_episode(grid, "train", seed, 0, episode_length=2016) for seed in range(N)]
    for i, plan in enumerate(plans):
        other.reset(i, plan)
    assert_same(engine, other)
    assert (engine.state.episode_length == 2016).all()


def test_rows_that_are_overloaded_or_under_maintenance_are_judged_alike() -> None:
    """Many starts of the grid that has most of either."""
    grid = load_grid("bus118-MOB-v1")
    seeds, numbers = np.arange(300), np.zeros(300, np.int64)
    engine, plans = begun(grid, seeds, numbers, True)
    hidden = engine.environments.hidden
    under_way = [(hidden.outage_begin[i, : hidden.outage_count[i]] <= 0).any() for i in range(len(plans))]
    assert sum(under_way) >= 3
    chosen = [i for i, plan in enumerate(plans) if plan.redraws or under_way[i]]
    assert sum(plans[i].redraws > 0 for i in chosen) >= 3
    for i in chosen:
        assert plan_episode(grid, "train", i, 0) == plans[i]


def test_environments_of_a_vector_play_what_one_alone_plays() -> None:
    options: dict[str, Any] = {"heuristic": "idle", "split": "train"}
    many = gymnasium.make_vec("rl2grid/bus14-T0-v0", num_envs=3, num_threads=1, **options)
    alone = gymnasium.make("rl2grid/bus14-T0-v0", **options)
    observations, infos = many.reset(seed=40)
    observation, info = alone.reset(seed=41)
    plans: list[EpisodePlan] = []
    for _ in range(40):
        np.testing.assert_array_equal(observations[1], observation)
        assert (infos["scenario"][1], infos["start"][1]) == (info["scenario"], info["start"])
        observations, _, terminated, truncated, infos = many.step(np.array([0, 5, 9]))
        observation, _, lost, completed, info = alone.step(5)
        assert (terminated[1], truncated[1]) == (lost, completed)
        if lost or completed:
            observation, info = alone.reset()
            plans.append(info["scenario"])
    assert plans, "no episode ended: nothing was compared of a second one"
    many.close()
    alone.close()
