"""Rows on the reference engine, shared by several processes."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.engines.worlds import World
from rl2grid.envs.description import check_number, one_by_one, step_action, task_catalogue
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.rows import Batch
from rl2grid.envs.tasks import Task
from rl2grid.envs.worker import Worker


class RemoteRows:
    """:class:`~rl2grid.envs.rows.Rows` of which every process plays a part, all processes at once."""

    num_threads = 1

    def __init__(self, task: Task, options: TaskOptions, n: int, num_workers: int) -> None:
        self._task, self._options, self._n = task, options, n
        self._catalogue = task_catalogue(task, task.grid)
        bounds = np.linspace(0, n, num_workers + 1).astype(int).tolist()
        self._parts = [slice(first, last) for first, last in itertools.pairwise(bounds)]
        self._workers = [Worker(task, options, part.stop - part.start) for part in self._parts]
        try:
            for worker in self._workers:
                worker.receive()
        except BaseException:
            self.close()
            raise

    def reset(self, seeds: list[int | None], options: dict[str, Any] | None) -> Batch:
        """See :meth:`rl2grid.envs.rows.Rows.reset`."""
        return self._together(self._ask("reset", [(seeds[part], options) for part in self._parts]))

    def step(self, actions: Any) -> Batch:
        """See :meth:`rl2grid.envs.rows.Rows.step`."""
        check_number(self._task, actions, self._n)
        for action in one_by_one(self._task, actions):  # all or none: no worker may step when another's is refused
            step_action(self._task, self._task.grid, self._catalogue, action)
        return self._together(self._ask("step", [(self._of_part(actions, part),) for part in self._parts]))

    def action_masks(self) -> NDArray[np.bool_]:
        """See :meth:`rl2grid.envs.rows.Rows.action_masks`."""
        return np.concatenate(self._ask("action_masks", [() for _ in self._parts]))

    def save(self, i: int) -> World:
        """See :meth:`rl2grid.envs.rows.Rows.save`."""
        world: World = self._ask_one(i, "save")
        return world

    def restore_row(self, i: int, world: World) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """See :meth:`rl2grid.envs.rows.Rows.restore_row`."""
        observation, info = self._ask_one(i, "restore_row", world)
        return observation, info

    def imagine(self, i: int, seed: int) -> World:
        """See :meth:`rl2grid.envs.rows.Rows.imagine`."""
        world: World = self._ask_one(i, "imagine", seed)
        return world

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (self._task, self._options, self._n, len(self._workers), self.state_dict())

    def state_dict(self) -> list[dict[str, Any]]:
        """See :meth:`rl2grid.envs.rows.Rows.state_dict`."""
        return [row for part in self._ask("state_dict", [() for _ in self._parts]) for row in part]

    def load_state_dict(self, rows: list[dict[str, Any]]) -> Batch:
        """See :meth:`rl2grid.envs.rows.Rows.load_state_dict`."""
        return self._together(self._ask("load_state_dict", [(rows[part],) for part in self._parts]))

    def ask(self, name: str, arguments: tuple[Any, ...], keywords: dict[str, Any]) -> list[Any]:
        """See :meth:`rl2grid.envs.rows.Rows.ask`."""
        return [row for part in self._ask("ask", [(name, arguments, keywords)] * len(self._parts)) for row in part]

    def close(self) -> None:
        """End the processes."""
        for worker in self._workers:
            worker.close()

    def _of_part(self, actions: Any, part: slice) -> Any:
        """The actions of the rows of one worker."""
        if self._task.kind == "H":
            return {name: values[part] for name, values in actions.items()}
        return list(actions)[part]

    def _ask(self, method: str, arguments: list[tuple[Any, ...]]) -> list[Any]:
        """Call ``method`` of every worker, all at once."""
        for worker, part in zip(self._workers, arguments, strict=True):
            worker.send(method, *part)
        answers, failure = [], None
        for worker in self._workers:
            try:
                answers.append(worker.receive())
            except Exception as error:  # the other workers' answers must be collected all the same
                failure = error
        if failure is not None:
            raise failure
        return answers

    def _ask_one(self, i: int, method: str, *arguments: Any) -> Any:
        """Call ``method`` of the worker that plays row ``i``."""
        place = next(k for k, part in enumerate(self._parts) if part.start <= i < part.stop)
        worker = self._workers[place]
        worker.send(method, i - self._parts[place].start, *arguments)
        return worker.receive()

    def _together(self, batches: list[Batch]) -> Batch:
        """The batches of all workers as that of all rows."""
        # Only those in which an episode ended tell of endings.
        form: dict[str, Any] = max((batch.infos for batch in batches), key=len)
        infos = [
            {key: batch.infos.get(key, _blank(value, len(batch.rewards))) for key, value in form.items()}
            for batch in batches
        ]
        return Batch(
            np.concatenate([batch.observations for batch in batches]),
            np.concatenate([batch.rewards for batch in batches]),
            np.concatenate([batch.terminated for batch in batches]),
            np.concatenate([batch.truncated for batch in batches]),
            _joined(infos),
        )


def _rebuild(task: Task, options: TaskOptions, n: int, num_workers: int, rows: list[dict[str, Any]]) -> RemoteRows:
    """The rows that were copied or pickled, in processes of their own."""
    remote = RemoteRows(task, options, n, num_workers)
    if rows:
        remote.load_state_dict(rows)
    return remote


def _joined(infos: list[dict[str, Any]]) -> dict[str, Any]:
    """Infos of parts of the rows as those of all."""
    return {
        key: _joined([info[key] for info in infos])
        if isinstance(value, dict)
        else np.concatenate([info[key] for info in infos])
        for key, value in infos[0].items()
    }


def _blank(form: Any, n: int) -> Any:
    """The infos of ``n`` rows that have none, of the form of those of other rows."""
    if isinstance(form, dict):
        return {key: _blank(value, n) for key, value in form.items()}
    return np.full((n, *form.shape[1:]), None if form.dtype == object else 0, form.dtype)
