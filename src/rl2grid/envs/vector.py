"""Many environments of a task as one Gymnasium ``VectorEnv``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rl2grid.engines.worlds import World
from rl2grid.envs.closed import closed
from rl2grid.envs.description import TaskDescription, single_spaces
from rl2grid.envs.making_rows import make_rows
from rl2grid.envs.options import keyword_names, options_of, shows_options
from rl2grid.envs.row_view import public_names
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError


class PowerGridVectorEnv(gymnasium.vector.VectorEnv[NDArray[np.float32], Any, NDArray[Any]], TaskDescription):
    """``num_envs`` environments of one task, stepped together.

    Made by ``gymnasium.make_vec(id, num_envs=n, ...)`` with the keywords of
    :class:`~rl2grid.envs.grid_env.PowerGridEnv`, ``num_threads`` (native engine) and ``num_workers`` (reference
    engine). An ended episode makes way for the next one in the same step (``AutoresetMode.SAME_STEP``): its last
    observation and info are ``infos["final_obs"][i]`` and ``infos["final_info"]``. ``reset(seed=s)`` gives
    environment ``i`` the seed ``s + i``; what an environment plays does not depend on the number of
    environments, threads or workers.

    On the native engine, observations are written into two buffers that take turns: those of a step are
    valid until the step after the next. ``action_effect``, in ``infos`` and in ``infos["final_info"]``, holds objects
    that are put into words by ``str``.

    Args:
        task: the task, or its id.
        num_envs: number of environments.
        num_threads: native engine: threads that share the environments; None takes one per processor core.
        num_workers: reference engine: number of processes; 0 plays in this one; None takes one per core.
        keywords: see :class:`~rl2grid.envs.options.TaskOptions`.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    @shows_options
    def __init__(
        self,
        task: Task | str,
        num_envs: int = 1,
        *,
        num_threads: int | None = None,
        num_workers: int | None = None,
        **keywords: Any,
    ) -> None:
        if not isinstance(num_envs, int) or num_envs < 1:
            raise UsageError(f"num_envs={num_envs!r} is not allowed: give a number of environments, at least 1.")
        if num_workers is not None and (not isinstance(num_workers, int) or num_workers < 0):
            raise UsageError(f"num_workers={num_workers!r} is not allowed: give a number of processes, 0 or more.")
        if num_threads is not None and (not isinstance(num_threads, int) or num_threads < 1):
            raise UsageError(f"num_threads={num_threads!r} is not allowed: give a number of threads, 1 or more.")
        self.task = find_task(task)
        self.options = options_of(self.task, keywords, keyword_names(type(self)))
        self.num_envs = num_envs
        observations, actions = single_spaces(self.task, self.options.operator_features)
        self.single_observation_space, self.single_action_space = observations, actions
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._attributes: dict[str, tuple[Any, ...]] = {}
        self._rows = make_rows(self.task, self.options, num_envs, num_threads=num_threads, num_workers=num_workers)
        self.num_threads = self._rows.num_threads
        """Threads that share the environments, as may what learns from them."""

    def reset(  # type: ignore[override]
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode in every environment.

        Args:
            seed: of the first environment, the others have those that follow; or one each. None: go on in the streams
                that are there.
            options: see :class:`~rl2grid.envs.grid_env.PowerGridEnv`.

        Raises:
            UsageError: a seed is no integer or negative, there is not one for each, or an option does not exist.
        """
        batch = self._rows.reset(_seeds_of(seed, self.num_envs), options)
        return batch.observations, batch.infos

    def step(
        self, actions: Any
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step every environment.

        Args:
            actions: integers [environment] of topology tasks, floats [environment, entry] of redispatching tasks, a
                dict of both, ``topology`` and ``injection``, of joint ones.

        Raises:
            UsageError: an action has the wrong shape or value.
        """
        batch = self._rows.step(actions)
        return batch.observations, batch.rewards, batch.terminated, batch.truncated, batch.infos

    def action_masks(self) -> NDArray[np.bool_]:
        """Which topology actions are legal now, bool [environment, action]; of joint tasks those of that part."""
        return self._rows.action_masks()

    def save(self, i: int) -> World:
        """Everything of environment ``i`` at this moment; see ``docs/worlds.md``.

        Raises:
            UsageError: there is no such environment, or it was not reset yet.
        """
        return self._rows.save(self._row(i))

    def restore(self, i: int, world: World) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Bring environment ``i`` to where ``world`` was saved: what follows is what followed there, bit for bit.

        Returns:
            Its observation, float32 [feature], and its info at that moment.

        Raises:
            UsageError: there is no such environment, the world is of another task, of other keywords or of an engine
                alone, or its series is not to be had.
        """
        return self._rows.restore_row(self._row(i), world)

    def imagine(self, i: int, seed: int) -> World:
        """A world that goes on from environment ``i`` as far as an operator may know; see ``docs/worlds.md``.

        Args:
            i: the environment, which stays where it is.
            seed: of the opponent's draws.

        Raises:
            UsageError: there is no such environment or no episode in progress, or the seed is negative; or the
                reference engine plays.
        """
        return self._rows.imagine(self._row(i), seed)

    def observe(self, scaled: bool = False) -> dict[str, NDArray[np.float32]]:
        """The observations of this moment by name, float32 [environment, entry].

        See :meth:`rl2grid.envs.row_view.RowMethods.observe`.
        """
        rows = self._rows.ask("observe", (scaled,), {})
        return {name: np.stack([row[name] for row in rows]) for name in rows[0]}

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """A method of every environment, called, or an attribute; those of :class:`~rl2grid.envs.row_view.RowView`.

        Raises:
            UsageError: there is none of that name, or it refuses what it is asked.
        """
        if name in self._attributes:
            return self._attributes[name]
        return tuple(self._rows.ask(name, args, kwargs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of every environment: one of ``call``, or one that ``set_attr`` has set."""
        return self.call(name)

    def set_attr(self, name: str, values: list[Any] | tuple[Any, ...] | Any) -> None:
        """Keep an attribute of every environment, for who reads it with ``get_attr``.

        Args:
            name: not one that environments have: they are as they were made.
            values: a list or tuple with one for each, or one for all.

        Raises:
            UsageError: environments have that attribute, or there are not as many values as environments.
        """
        if name in public_names() or hasattr(type(self), name):
            raise UsageError(f"Attribute {name!r} cannot be set: make the vector with the keywords that it is to have.")
        each = tuple(values) if isinstance(values, list | tuple) else (values,) * self.num_envs
        if len(each) != self.num_envs:
            raise UsageError(f"{len(each)} values were given for {self.num_envs} environments: give one each.")
        self._attributes[name] = each

    def state_dict(self) -> dict[str, Any]:
        """Where every environment is: the plain forms of their worlds."""
        return {"rows": self._rows.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Bring every environment to where :meth:`state_dict` found it; observations and infos are those of then.

        Raises:
            UsageError: it is of other environments than these.
        """
        rows = state["rows"]
        if len(rows) != self.num_envs:
            raise UsageError(f"The saved state has {len(rows)} environments, this vector has {self.num_envs}.")
        batch = self._rows.load_state_dict(rows)
        return batch.observations, batch.infos

    def close_extras(self, **kwargs: Any) -> None:
        """Free the simulators and end the workers; nothing can be asked of the environments any more."""
        self._rows.close()
        self._rows = closed()

    def _row(self, i: int) -> int:
        if not isinstance(i, int | np.integer) or not 0 <= i < self.num_envs:
            raise UsageError(f"Environment {i!r} does not exist: give a number from 0 to {self.num_envs - 1}.")
        return int(i)


def _seeds_of(seed: object, num_envs: int) -> list[int | None]:
    """The seed of each environment; None: its stream goes on.

    Raises:
        UsageError: one is no integer or negative, or there is not one for each.
    """
    if isinstance(seed, list):
        if len(seed) != num_envs:
            raise UsageError(f"{len(seed)} seeds were given for {num_envs} environments: give one each.")
        return [None if each is None else _checked_seed(each) for each in seed]
    if seed is None:
        return [None] * num_envs
    first = _checked_seed(seed)
    return [first + i for i in range(num_envs)]


def _checked_seed(seed: object) -> int:
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise UsageError(f"seed={seed!r} is not allowed: give an integer that is not negative, or a list of one each.")
    return int(seed)
