"""Folders of labels that nobody decided."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rl2grid.envs.options import TaskOptions
from rl2grid.envs.tasks import Task, find_task
from rl2grid.records.label_folder import open_labels
from rl2grid.records.labels import Labels, MonthRow, label_shape, task_identity

NO_PUPIL = {"months": 2, "pupil": None, "pupil_share": 0.0, "command": "rl2grid teach greedy bus14-T0"}
A_PUPIL = {**NO_PUPIL, "pupil": {"policy_hash": "a1"}, "pupil_share": 1.0}


def made_up_labels(task: Task | str, n: int, *, seed: int = 0, candidates: int = 3) -> Labels:
    """``n`` labels of a task: any numbers that labels may have, in episodes of five decisions."""
    task = find_task(task)
    shape, generator = label_shape(task, candidates), np.random.default_rng(seed)
    actions, continuous = shape.n_topology_actions, shape.n_injections
    masks = generator.random((n, actions)) < 0.5
    masks[:, :1] = True
    legal = np.array([generator.choice(np.flatnonzero(row)) for row in masks if actions], np.int64)
    return Labels(
        observations=generator.normal(size=(n, shape.observation_size)).astype(np.float32),
        masks=masks if actions else None,
        topology=legal if actions else None,
        injection=generator.uniform(-1, 1, (n, continuous)).astype(np.float32) if continuous else None,
        aim=generator.uniform(-5, 5, (n, continuous)).astype(np.float32) if continuous else None,
        candidates=np.tile(legal[:, None], (1, candidates)) if actions else np.full((n, candidates), -1, np.int64),
        values=generator.normal(size=(n, candidates)).astype(np.float32),
        weights=np.ones(n, np.float32),
        rewards=generator.random(n),
        n_steps=np.ones(n, np.int64),
        ending=np.where(np.arange(n) % 5 == 4, 1, 0).astype(np.int8),
        pupil=np.zeros(n, np.bool_),
        returns=generator.random(n),
    )


def request_of(task: Task | str, **changes: Any) -> dict[str, Any]:
    """What a folder of labels of a task is asked for."""
    task = find_task(task)
    keywords = {name: value for name, value in vars(TaskOptions()).items() if name not in ("scenario", "gamma")}
    return {
        "task": task.id,
        "teacher": "greedy",
        "teacher_identity": None,
        "env_keywords": keywords,
        "gamma": 0.99,
        "thin": 10.0,
        "seed": 0,
        "candidates": 3,
        "identity": {**task_identity(task), "versions": {}},
        **changes,
    }


def write_made_up_labels(
    folder: Path, task: Task | str, n: int = 20, of_round: dict[str, Any] = NO_PUPIL, **changes: Any
) -> list[Labels]:
    """Write a round of labels, and return those of each month."""
    request, written = request_of(task, **changes), []
    with open_labels(folder, request, of_round) as labels:
        for month in range(labels.n_months):
            made = made_up_labels(task, n, seed=7 * labels.number + month, candidates=request["candidates"])
            written.append(replace(made, pupil=np.full(n, of_round["pupil"] is not None)))
            row = MonthRow(labels.request, labels.number, month, "generated/1000000-00", month, 0, 100, 1.0, n, 0, n)
            labels.add(row, written[-1])
    return written
