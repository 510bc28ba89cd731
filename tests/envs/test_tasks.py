"""Ids and keywords of the tasks."""

import subprocess
import sys

import gymnasium
import pytest

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.tasks import all_tasks, find_task
from rl2grid.errors import UsageError


def test_there_are_103_tasks_of_the_paper_and_96_joint_ones():
    tasks = all_tasks().values()
    topology = [task for task in tasks if task.kind == "T"]
    assert len([task for task in topology if task.constraint is None]) == 32
    assert len([task for task in topology if task.constraint is not None]) == 64
    assert len([task for task in tasks if task.kind == "R"]) == 7
    joint = [task for task in tasks if task.kind == "H"]
    assert len(all_tasks()) - len(joint) == 103
    assert len([task for task in joint if task.constraint is None]) == 32
    assert len(joint) == 96


def test_every_id_is_registered():
    assert all(task_id in gymnasium.registry for task_id in all_tasks())


@pytest.mark.parametrize(
    ("task_id", "n_actions"),
    [
        ("rl2grid/bus14-T0-v0", 50),
        ("rl2grid/bus14-T1-LSI-v0", 209),
        ("rl2grid/bus36-MO-v0-T4-v0", 66_978),
        ("rl2grid/bus118-MOB-v1-T4-TLO-v0", 73_357),
        ("rl2grid/bus14-R-v0", 6),
        ("rl2grid/bus36-M-R-v0", 22),
        ("rl2grid/bus118-M-R-v0", 62),
        ("rl2grid/bus118-MOB-v0-R-v0", 69),
        ("rl2grid/bus14-H0-v0", 50 + 6),
        ("rl2grid/bus118-MOB-v1-H4-TLO-v0", 73_357 + 69),
    ],
)
def test_number_of_actions(task_id, n_actions):
    assert find_task(task_id).n_actions == n_actions
    assert find_task(task_id).id == task_id


def test_a_joint_task_has_the_actions_of_both_others():
    joint, topology, redispatch = (find_task(f"bus36-MO-v0-{kind}") for kind in ("H1", "T1", "R"))
    assert (joint.n_topology_actions, joint.n_injections) == (topology.n_actions, redispatch.n_actions) == (302, 22)
    assert (topology.n_injections, redispatch.n_topology_actions) == (0, 0)
    assert joint.actions_in_words == "302 discrete and 22 continuous"


def test_namespace_and_version_may_be_left_out():
    assert find_task("bus14-T0").id == "rl2grid/bus14-T0-v0"
    assert find_task("bus36-MO-v0-T1-TLO").id == "rl2grid/bus36-MO-v0-T1-TLO-v0"


@pytest.mark.parametrize(
    ("task_id", "message"),
    [
        ("bus15-T0", r"does not exist: an id is .* with a grid of bus14, bus36-M, "),
        ("bus14-T2", r"the tasks of bus14 are .* with level 0, 1, and bus14-R-v0"),
        ("bus14-H2", r"the tasks of bus14 are .* bus14-H<level>\[-LSI\|-TLO\]-v0 with level 0, 1, and bus14-R-v0"),
        ("bus14-H", r"the tasks of bus14 are"),
        ("bus36-MO-v0-T9", r"the tasks of bus36-MO-v0 are .* with level 0, 1, 2, 3, 4,"),
        ("bus14-T0-XYZ", r"the tasks of bus14 are"),
    ],
)
def test_unknown_id_is_refused_with_what_is_allowed(task_id, message):
    with pytest.raises(UsageError, match=message):
        find_task(task_id)


@pytest.mark.parametrize(
    ("keyword", "value", "allowed"),
    [
        ("engine", "fast", "native, reference"),
        ("heuristic", "lazy", "None, idle, recovery"),
        ("split", "dev", "train, validation, test, bundled"),
        ("normalize", "zscore", "physical, None"),
        ("dispatch", "fast", "exact, grid2op"),
        ("constraint", "ABC", "None, LSI, TLO"),
        ("gamma", 1.5, "between 0 and 1"),
        ("opponent", "yes", "True or False"),
    ],
)
def test_wrong_keyword_value_is_refused_with_the_right_ones(keyword, value, allowed):
    with pytest.raises(UsageError, match=allowed):
        TaskOptions(**{keyword: value})


def test_import_is_light():
    code = (
        "import sys, rl2grid;"
        "heavy = [m for m in ('grid2op', 'torch', 'numba', 'lightsim2grid', 'pandas') if m in sys.modules];"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
