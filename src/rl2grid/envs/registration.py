"""The flat list of ids that Gymnasium knows."""

from __future__ import annotations

import gymnasium

from rl2grid.envs.tasks import all_tasks


def register_all() -> None:
    """Register every task with Gymnasium; ids that are registered already stay as they are."""
    for task_id in all_tasks():
        if task_id in gymnasium.registry:
            continue
        gymnasium.register(
            id=task_id,
            entry_point="rl2grid.envs.grid_env:PowerGridEnv",
            vector_entry_point="rl2grid.envs.vector:PowerGridVectorEnv",
            kwargs={"task": task_id},
        )
