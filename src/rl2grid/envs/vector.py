"""Many environments of a task as one Gymnasium ``VectorEnv``."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rl2grid.envs.player import TaskDescription, check_action, single_spaces
from rl2grid.envs.rows import Batch, Rows
from rl2grid.envs.tasks import TaskOptions, find_task
from rl2grid.envs.worker import RemoteRows
from rl2grid.errors import UsageError

if TYPE_CHECKING:
    from rl2grid.envs.native_player import NativeBatch, NativePlayer


class PowerGridVectorEnv(gymnasium.vector.VectorEnv[NDArray[np.float32], Any, NDArray[Any]], TaskDescription):
    """``num_envs`` environments of one task, stepped together.

    Made by ``gymnasium.make_vec(id, num_envs=n, ...)`` with the keywords of
    :class:`~rl2grid.envs.grid_env.PowerGridEnv`, ``num_threads`` (native engine) and ``num_workers`` (reference
    engine). An ended episode makes way for the next one in the same step (``AutoresetMode.SAME_STEP``): its last
    observation and info are ``infos["final_obs"][i]`` and ``infos["final_info"]``. ``reset(seed=s)`` gives
    environment ``i`` the seed ``s + i``; what an environment plays does not depend on the number of
    environments, threads or workers.

    On the native engine, observations are written into two buffers that take turns: those of a step are
    valid until the step after the next. ``infos["action_effect"]`` holds objects that are put into words by ``str``.

    Args:
        task_id: the task.
        num_envs: number of environments.
        num_threads: native engine: threads that share the environments; None takes one per processor core.
        num_workers: reference engine: number of processes; 0 plays in this one; None takes one per core.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        task_id: str,
        num_envs: int = 1,
        *,
        num_threads: int | None = None,
        num_workers: int | None = None,
        engine: str = "native",
        heuristic: str | None = None,
        reward: str | tuple[float, float, float] | Callable[..., Any] = "default",
        split: str = "train",
        scenario: str | None = None,
        normalize: str | None = "physical",
        dispatch: str = "exact",
        constraint: str | None = None,
        gamma: float | None = None,
        maintenance: bool = True,
        opponent: bool = True,
    ) -> None:
        if not isinstance(num_envs, int) or num_envs < 1:
            raise UsageError(f"num_envs={num_envs!r} is not allowed: give a number of environments, at least 1.")
        if num_workers is not None and (not isinstance(num_workers, int) or num_workers < 0):
            raise UsageError(f"num_workers={num_workers!r} is not allowed: give a number of processes, 0 or more.")
        if num_threads is not None and (not isinstance(num_threads, int) or num_threads < 1):
            raise UsageError(f"num_threads={num_threads!r} is not allowed: give a number of threads, 1 or more.")
        self.task = find_task(task_id)
        self.options = TaskOptions(
            engine,
            heuristic,
            reward,
            split,
            scenario,
            normalize,
            dispatch,
            self.task.constraint or constraint,
            gamma,
            maintenance,
            opponent,
        )
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = single_spaces(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._native: NativePlayer | None = None
        self._local: Rows | None = None
        self._remotes: list[RemoteRows] = []
        self._slices = [slice(0, num_envs)]
        if engine == "native":
            from rl2grid.envs.native_player import NativePlayer

            _refuse("num_workers", num_workers, "num_threads", "native")
            self._native = NativePlayer(self.task, self.options, num_envs, num_threads)
            return
        _refuse("num_threads", num_threads, "num_workers", "reference")
        self._start_workers(min(num_envs, os.cpu_count() or 1) if num_workers is None else min(num_envs, num_workers))

    def _start_workers(self, workers: int) -> None:
        if workers == 0:
            self._local = Rows(self.task.id, self.options, self.num_envs)
            return
        bounds = np.linspace(0, self.num_envs, workers + 1).astype(int).tolist()
        self._slices = [slice(first, last) for first, last in itertools.pairwise(bounds)]
        self._remotes = [RemoteRows(self.task.id, self.options, part.stop - part.start) for part in self._slices]
        try:
            for remote in self._remotes:
                remote.receive()
        except BaseException:
            self.close_extras()
            raise

    def reset(  # type: ignore[override]
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode in every environment."""
        seeds = (
            [None if seed is None else seed + i for i in range(self.num_envs)] if not isinstance(seed, list) else seed
        )
        if len(seeds) != self.num_envs:
            raise UsageError(f"{len(seeds)} seeds were given for {self.num_envs} environments: give one each.")
        if self._native is not None:
            return self._present(self._native.reset_all(seeds, options))
        batch = self._call("reset", [(seeds[s], options) for s in self._slices])
        return batch.observations, self._infos(batch)

    def step(
        self, actions: Any
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step every environment.

        Raises:
            UsageError: an action has the wrong shape or value.
        """
        if self._native is not None:
            played = self._native.step_all(actions)
            observations, infos = self._present(played)
            return observations, played.rewards, played.terminated, played.truncated, infos
        rows = list(actions)
        if len(rows) != self.num_envs:
            raise UsageError(f"{len(rows)} actions were given for {self.num_envs} environments: give one each.")
        for action in rows:  # all or none: no environment may have stepped when another's action is refused
            check_action(self.task, action)
        batch = self._call("step", [(rows[s],) for s in self._slices])
        return batch.observations, batch.rewards, batch.terminated, batch.truncated, self._infos(batch)

    def action_masks(self) -> NDArray[np.bool_]:
        """Which discrete actions are legal now, bool [environment, action]."""
        if self._native is not None:
            return self._native.action_masks()
        return np.concatenate(self._ask("action_masks", [() for _ in self._slices]))

    def state_dict(self) -> dict[str, Any]:
        """Where every environment is, as plain values: seed, episode number, actions of the episode so far."""
        if self._native is not None:
            return {"rows": self._native.state_dict()}
        rows = self._ask("state_dict", [() for _ in self._slices])
        return {"rows": [row for part in rows for row in part]}

    def load_state_dict(self, state: dict[str, Any]) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Bring every environment to where :meth:`state_dict` found it, by playing its episode again.

        An episode is a pure function of its seed, number and actions; the observations returned are
        therefore the very ones of then.
        """
        rows = state["rows"]
        if len(rows) != self.num_envs:
            raise UsageError(f"The saved state has {len(rows)} environments, this vector has {self.num_envs}.")
        if self._native is not None:
            return self._present(self._native.restore_all(rows))
        batch = self._call("load_state_dict", [(rows[s],) for s in self._slices])
        return batch.observations, self._infos(batch)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulators and end the workers."""
        if self._native is not None:
            self._native.close()
        if self._local is not None:
            self._local.close()
        for remote in self._remotes:
            remote.close()

    def _ask(self, method: str, arguments: list[tuple[Any, ...]]) -> list[Any]:
        """Call ``method`` on every part of the rows, all workers at once."""
        if self._local is not None:
            return [getattr(self._local, method)(*arguments[0])]
        for remote, part in zip(self._remotes, arguments, strict=True):
            remote.send(method, *part)
        answers, failure = [], None
        for remote in self._remotes:
            try:
                answers.append(remote.receive())
            except Exception as error:  # the other workers' answers must be collected all the same
                failure = error
        if failure is not None:
            raise failure
        return answers

    def _call(self, method: str, arguments: list[tuple[Any, ...]]) -> Batch:
        parts = self._ask(method, arguments)
        return Batch(
            np.concatenate([part.observations for part in parts]),
            [info for part in parts for info in part.infos],
            np.concatenate([part.rewards for part in parts]),
            np.concatenate([part.terminated for part in parts]),
            np.concatenate([part.truncated for part in parts]),
        )

    def _present(self, batch: NativeBatch) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Observations and infos of the native engine as Gymnasium wants them."""
        infos = _with_masks(batch.info, np.ones(self.num_envs, np.bool_))
        for i, ending in batch.endings.items():
            self._add_info(infos, ending, i)
        return batch.observations, infos

    def _infos(self, batch: Batch) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        for i, info in enumerate(batch.infos):
            self._add_info(infos, info, i)
        return infos


def _with_masks(info: dict[str, Any], everywhere: NDArray[np.bool_]) -> dict[str, Any]:
    """Gymnasium's form of infos that every environment has: each key beside a mask, ``everywhere``."""
    masked: dict[str, Any] = {}
    for key, value in info.items():
        masked[key] = _with_masks(value, everywhere) if isinstance(value, dict) else value
        masked[f"_{key}"] = everywhere
    return masked


def _refuse(keyword: str, value: int | None, instead: str, engine: str) -> None:
    if value is not None:
        raise UsageError(f"{keyword}={value!r} is not for engine={engine!r}: give {instead}.")
