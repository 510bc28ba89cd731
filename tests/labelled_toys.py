"""Labels in months of their own, and environments that are only learned about: what tests of imitation share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from sample_labels import made_up_labels, request_of

from rl2grid.envs.joint import box_of
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.tasks import Task, find_task
from rl2grid.mdp.features import observation_size
from rl2grid.records.label_folder import open_labels
from rl2grid.records.labels import Labels, MonthRow


class NothingToPlay(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """An environment of a task, which must not be played."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012
    num_envs = 1

    def __init__(self, task: Task | str, **keywords: Any) -> None:
        self.task, self.options = find_task(task), TaskOptions(**keywords)
        size = observation_size(self.task.grid, self.task.kind, self.options.operator_features)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space: Any = gymnasium.spaces.Discrete(self.task.n_actions)
        if self.task.injects:
            self.single_action_space = box_of(self.task)

    def action_masks(self) -> Any:
        raise AssertionError("it was to be left alone")

    def reset(self, **options: Any) -> Any:
        raise AssertionError("it was to be left alone")


Change = Callable[[Labels], Labels]


def write(folder: Path, task: str, change: Change = lambda labels: labels, months: int = 10, n: int = 40) -> str:
    """Labels in months of their own, those of :func:`made_up_labels` after a change; their folder."""
    round_ = {"months": months, "pupil": None, "pupil_share": 0.0, "command": "rl2grid teach"}
    with open_labels(folder, request_of(task), round_) as stored:
        for month in range(months):
            labels = made_up_labels(task, n, seed=month)
            labels.observations[:, 3:] = 0.0  # so that little suffices to learn what does not matter
            labels = change(labels)
            row = MonthRow(stored.request, 0, month, f"generated/{month:02d}", month, 0, 100, 1.0, n, 0, n)
            stored.add(row, labels)
    return str(folder)
