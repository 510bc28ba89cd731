"""Joint tasks for libraries that know only one kind of action.

An action of a joint task (``-H0-``, ...) is a dict: ``topology``, an id, and ``injection``, the continuous action of
the redispatching task. Flattened in one of two ways, it is one that every library knows:

======================== ======================== ===================================================================
wrapper                  action space             an action means
======================== ======================== ===================================================================
:class:`JointAsBox`      ``Box(-1, 1, (n + m,))`` the topology action with the largest of the first ``n`` entries (of
                                                  several, the lowest id) and the injection of the other ``m``: every
                                                  joint action can be played
:class:`JointAsDiscrete` ``Discrete(n + k)``      below ``n``: that topology action, without an injection; from ``n``
                                                  on: do nothing, and one control moved fully up or down
======================== ======================== ===================================================================

The ``k`` moves are those of each control in the order of a continuous action, up before down. Renewables have only
down: an entry above zero limits them no more than zero does. What is redispatched stays until it is moved back; a
curtailment ends, and storage rests, with the next action that does not ask for it again.

:class:`VectorJointAsBox` and :class:`VectorJointAsDiscrete` are the same for vectors.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import gymnasium.utils
import numpy as np
from gymnasium.vector import VectorActionWrapper, VectorEnv
from gymnasium.vector.utils import batch_space

from rl2grid.arrays import F32, Flags
from rl2grid.envs.description import action_number
from rl2grid.envs.tasks import Task
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.mdp.actions import INJECTION, TOPOLOGY, continuous_layout

JointAction = dict[str, Any]
"""``topology``: int or int64 [n]; ``injection``: float32 [m] or [n, m]."""


class _Joint(gymnasium.ActionWrapper[Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """What both wrappers of one environment have in common."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        gymnasium.ActionWrapper.__init__(self, env)
        self._task = _joint_task(env, env.action_space)

    def describe_action(self, action: Any) -> str:
        """The action in words."""
        base: Any = self.env.unwrapped
        return str(base.describe_action(self.action(action)))


class JointAsBox(_Joint):
    """A joint task with continuous actions; see the table of :mod:`rl2grid.envs.joint`.

    Raises:
        UsageError: the environment is no joint task, or a wrapper has changed its actions before.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.action_space = box_of(self._task)

    def action(self, action: Any) -> JointAction:
        """The joint action that entries float32 [n + m] mean.

        Raises:
            UsageError: they have another shape, are no numbers or lie outside [-1, 1].
        """
        values = _checked_values(action, (self._task.n_actions,))
        n = self._task.n_topology_actions
        return {TOPOLOGY: int(values[:n].argmax()), INJECTION: values[n:]}


class JointAsDiscrete(_Joint):
    """A joint task with discrete actions; see the table of :mod:`rl2grid.envs.joint`.

    Raises:
        UsageError: the environment is no joint task, or a wrapper has changed its actions before.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self._moves = control_moves(self._task.grid)
        self.action_space = discrete_of(self._task)

    def action(self, action: Any) -> JointAction:
        """The joint action of an id.

        Raises:
            UsageError: there is no such id.
        """
        n = self._task.n_topology_actions
        chosen = action_number(action, n + len(self._moves))
        if chosen < n:
            return {TOPOLOGY: chosen, INJECTION: np.zeros(self._task.n_injections, np.float32)}
        return {TOPOLOGY: 0, INJECTION: self._moves[chosen - n].copy()}

    def action_masks(self) -> Flags:
        """Which actions are legal now, bool [action]; controls may always be moved."""
        base: Any = self.env.unwrapped
        return self.extended(base.action_masks())

    def extended(self, masks: Flags) -> Flags:
        """Masks of topology actions, bool [..., topology action], as those of all actions, bool [..., action]."""
        return np.concatenate((masks, np.ones((*masks.shape[:-1], len(self._moves)), np.bool_)), axis=-1)


class _VectorJoint(VectorActionWrapper):
    """What both vectors have in common: they are saved and brought back as what they wrap."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._task = _joint_task(env, env.single_action_space)

    def state_dict(self) -> dict[str, Any]:
        """Where every environment is; see :meth:`rl2grid.envs.vector.PowerGridVectorEnv.state_dict`."""
        state: dict[str, Any] = self.env.state_dict()  # type: ignore[attr-defined]
        return state

    def load_state_dict(self, state: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Bring every environment to where :meth:`state_dict` found it.

        Raises:
            UsageError: it is of other environments than these.
        """
        observations, infos = self.env.load_state_dict(state)  # type: ignore[attr-defined]
        return observations, infos


class VectorJointAsBox(_VectorJoint):
    """Many environments of a joint task with continuous actions, float32 [environment, n + m].

    Raises:
        UsageError: as :class:`JointAsBox`.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self.single_action_space = box_of(self._task)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def actions(self, actions: Any) -> JointAction:
        """The joint actions that entries float32 [environment, n + m] mean.

        Raises:
            UsageError: they have another shape, are no numbers or lie outside [-1, 1].
        """
        values = _checked_values(actions, (self.num_envs, self._task.n_actions))
        n = self._task.n_topology_actions
        return {TOPOLOGY: values[:, :n].argmax(axis=1), INJECTION: values[:, n:]}


class VectorJointAsDiscrete(_VectorJoint):
    """Many environments of a joint task with discrete actions, integers [environment].

    Raises:
        UsageError: as :class:`JointAsDiscrete`.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        moves = control_moves(self._task.grid)
        self._injections = np.concatenate((np.zeros((1, self._task.n_injections), np.float32), moves))
        self.single_action_space = discrete_of(self._task)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def actions(self, actions: Any) -> JointAction:
        """The joint actions of ids.

        Raises:
            UsageError: there is no such id, or not one for each environment.
        """
        n, size = self._task.n_topology_actions, int(self.single_action_space.n)  # type: ignore[attr-defined]
        chosen = np.asarray(actions)
        if chosen.shape != (self.num_envs,):
            raise UsageError(
                f"Actions of shape {chosen.shape} were given for {self.num_envs} environments: give one each."
            )
        if chosen.dtype.kind not in "iu" or not ((chosen >= 0) & (chosen < size)).all():
            for action in chosen:
                action_number(action, size)
        moved = np.maximum(chosen.astype(np.int64) - (n - 1), 0)
        return {TOPOLOGY: np.where(chosen < n, chosen, 0).astype(np.int64), INJECTION: self._injections[moved]}

    def action_masks(self) -> Flags:
        """Which actions are legal now, bool [environment, action]; controls may always be moved."""
        masks = self.env.action_masks()  # type: ignore[attr-defined]
        moves = np.ones((self.num_envs, len(self._injections) - 1), np.bool_)
        return np.concatenate((masks, moves), axis=1)


def box_of(task: Task) -> gymnasium.spaces.Box:
    """The space of the actions of a joint task as :class:`JointAsBox`."""
    return gymnasium.spaces.Box(-1.0, 1.0, (task.n_actions,), np.float32)


def discrete_of(task: Task) -> gymnasium.spaces.Discrete:
    """The space of the actions of a joint task as :class:`JointAsDiscrete`."""
    return gymnasium.spaces.Discrete(task.n_topology_actions + len(control_moves(task.grid)))


def control_moves(grid: Grid) -> F32:
    """Each control moved fully up and fully down, as injections float32 [move, continuous]."""
    layout = continuous_layout(grid)
    first = len(layout.redispatch)
    moves = []
    for entry in range(layout.size):
        curtails = first <= entry < first + len(layout.curtail)
        for direction in (-1.0,) if curtails else (1.0, -1.0):
            moves.append(np.zeros(layout.size, np.float32))
            moves[-1][entry] = direction
    return np.array(moves, np.float32).reshape(len(moves), layout.size)


def _joint_task(env: Any, space: gymnasium.Space[Any]) -> Task:
    task = getattr(env.unwrapped, "task", None)
    if isinstance(env, VectorEnv) and not isinstance(task, Task):
        raise UsageError(
            f"{type(env.unwrapped).__name__} is no vector of rl2grid: flatten each of its environments, or make the "
            "vector without a vectorization_mode."
        )
    if not isinstance(task, Task) or task.kind != "H":
        what = task.id if isinstance(task, Task) else type(env.unwrapped).__name__
        raise UsageError(f"{what} is no joint task (-H0-, -H1-, ...): only their actions can be flattened.")
    if not isinstance(space, gymnasium.spaces.Dict):
        raise UsageError(f"The actions of this {task.id} are {space}: flatten them before other wrappers change them.")
    return task


def _checked_values(action: Any, shape: tuple[int, ...]) -> F32:
    try:
        values = np.asarray(action, np.float32)
    except (TypeError, ValueError):
        raise UsageError(f"Action {action!r:.80} is none: give numbers of shape {shape} in [-1, 1].") from None
    if values.shape != shape:
        raise UsageError(f"An action has shape {values.shape}: give numbers of shape {shape} in [-1, 1].")
    if not (np.abs(values) <= 1).all():  # NaN compares as false
        raise UsageError("An entry of the action is NaN or outside: every entry must lie in [-1, 1].")
    return values
