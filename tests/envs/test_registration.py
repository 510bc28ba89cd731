"""Grids of one's own as Gymnasium tasks, in this process and in others."""

import os
import subprocess
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from own_grid import ROWS, own_series, own_system, registered

from rl2grid.envs.registration import own_systems, register_system, unregister_system
from rl2grid.envs.tasks import all_tasks, find_task
from rl2grid.errors import UsageError
from rl2grid.grids import find_system
from rl2grid.scenarios.folder import FolderContent
from rl2grid.scenarios.recorded import RecordedScenarios

KINDS = ("T0", "T0-LSI", "T0-TLO", "R", "H0", "H0-LSI", "H0-TLO")
IDS = tuple(f"rl2grid/mine-{kind}-v0" for kind in KINDS)


@pytest.fixture
def mine():
    with registered(own_system()) as system:
        yield system


def test_a_grid_has_tasks_as_long_as_it_is_registered():
    before = all_tasks()
    with registered(own_system()) as system:
        assert own_systems() == (system,)
        assert tuple(all_tasks()) == (*before, *IDS)
        assert all(task_id in gymnasium.registry for task_id in IDS)
        assert find_task("mine-T0").n_actions == 209
        assert find_task("mine-R").n_actions == 6
        assert find_task("mine-H0").n_actions == 209 + 6
        with pytest.raises(UsageError, match=r"the tasks of mine are .* with level 0, and mine-R-v0"):
            find_task("mine-T1")
    assert all_tasks() == before
    assert not any(task_id in gymnasium.registry for task_id in IDS)
    assert own_systems() == ()


def test_a_ranked_grid_has_more_levels():
    system = own_system()
    with registered(system.ranked(find_system("bus14").ranking, 50)):
        assert [task for task in all_tasks() if "mine-T" in task and "-LSI" not in task and "-TLO" not in task] == [
            "rl2grid/mine-T0-v0",
            "rl2grid/mine-T1-v0",
        ]
        env, shipped = (gymnasium.make(f"rl2grid/{name}-T0-v0").unwrapped for name in ("mine", "bus14"))
        np.testing.assert_array_equal(env.action_catalogue_ids, shipped.action_catalogue_ids)


def test_it_plays_as_the_grid_that_it_is_a_copy_of(mine):
    keywords = {"maintenance": False, "split": "bundled"}
    ours, theirs = (gymnasium.make(f"rl2grid/{name}-R-v0", **keywords).unwrapped for name in ("mine", "bus14"))
    observations = [
        ours.reset(seed=0, options={"scenario": "recorded/first", "start": 3})[0],
        theirs.reset(seed=0, options={"scenario": "bundled/0000[0:289]", "start": 3})[0],
    ]
    np.testing.assert_array_equal(*observations)
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-0.2, 0.2, 6).astype(np.float32)
        one, other = ours.step(action), theirs.step(action)
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1:4] == other[1:4]


@pytest.mark.slow
def test_workers_of_a_vector_know_it(mine):
    vector = gymnasium.make_vec("rl2grid/mine-R-v0", num_envs=2, engine="reference", num_workers=1)
    observations, infos = vector.reset(seed=0)
    vector.close()
    assert observations.shape == vector.observation_space.shape
    assert infos["scenario"].tolist() == ["recorded/first"] * 2


def test_without_an_environment_there_is_no_reference_engine():
    message = 'names no Grid2Op environment: play it with engine="native"'
    with registered(replace(own_system(), environment=None)), pytest.raises(UsageError, match=message):
        gymnasium.make("rl2grid/mine-R-v0", engine="reference")


def test_the_seven_stay_what_they_are():
    with pytest.raises(UsageError, match="Grid 'bus14' is one of the benchmark: give yours an id of its own"):
        register_system(replace(find_system("bus14"), scenarios=own_system().scenarios))


def test_series_of_the_latest_registration_are_played(mine):
    assert gymnasium.make("rl2grid/mine-R-v0").reset(seed=0)[1]["episode_length"] <= ROWS - 1
    content = own_series()
    shorter = FolderContent(content.start_datetime, {name: array[:40] for name, array in content.arrays.items()})
    register_system(replace(mine, scenarios=RecordedScenarios({"first": shorter})))
    env = gymnasium.make("rl2grid/mine-R-v0", split="bundled")
    assert env.reset(seed=0)[1]["episode_length"] == 39


def test_a_grid_without_series_is_refused():
    with pytest.raises(UsageError, match="System mine has no time series: give it scenarios"):
        register_system(replace(own_system(), scenarios=RecordedScenarios({})))
    with pytest.raises(UsageError, match="Grid 'mine' does not exist"):
        unregister_system("mine")


OWN_GRIDS = """
from dataclasses import replace
import rl2grid
from rl2grid.grids import System, find_system
bus14 = find_system("bus14")
rl2grid.register_system(System(replace(bus14.grid, id="yours"), bus14.network, bus14.scenarios))
"""
SHOWN = """
import sys, rl2grid.envs.tasks
print([each for each in rl2grid.envs.tasks.all_tasks() if "yours" in each], "numba" in sys.modules)
"""


def run_with(systems, folder):
    environment = os.environ | {"RL2GRID_SYSTEMS": systems}
    return subprocess.run(
        [sys.executable, "-c", SHOWN], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("name", ["own_grids", "own_grids.py"])
def test_the_environment_variable_names_what_registers_systems(name, tmp_path):
    (tmp_path / "own_grids.py").write_text(OWN_GRIDS)
    done = run_with(name, tmp_path)
    topology = [f"{level}{constraint}" for constraint in ("", "-LSI", "-TLO") for level in (0, 1)]
    kinds = [*(f"T{rest}" for rest in topology), "R", *(f"H{rest}" for rest in topology)]
    ids = [f"rl2grid/yours-{kind}-v0" for kind in kinds]
    assert done.stdout.strip() == f"{ids} False", done.stderr


def test_an_environment_variable_that_names_nothing_is_refused(tmp_path):
    for name in ("no_such_module", "no_such_file.py"):
        done = run_with(name, tmp_path)
        assert done.returncode != 0
        assert f"RL2GRID_SYSTEMS names {name}" in done.stderr.replace("'", "")
