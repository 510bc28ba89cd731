"""The shipped list of the tasks says what the grids say."""

from __future__ import annotations

from own_grid import own_system, registered

from rl2grid.cli.task_records import records_of, shipped_records, task_records
from rl2grid.envs.tasks import all_tasks


def test_the_shipped_records_are_those_of_the_grids():
    assert shipped_records() == records_of(all_tasks().values()), "write them: python -m rl2grid.cli.task_records"


def test_systems_of_a_user_come_last():
    with registered(own_system()):
        shipped, own = task_records()[: len(shipped_records())], task_records()[len(shipped_records()) :]
    assert shipped == shipped_records()
    assert {record["grid"] for record in own} == {"mine"}
    assert own[0]["topology_actions"] == 209
