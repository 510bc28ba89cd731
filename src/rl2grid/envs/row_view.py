"""What can be asked of one environment, played alone or as a row of a vector."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.engines.worlds import World
from rl2grid.envs.description import TaskDescription, single_spaces
from rl2grid.envs.operation import Operation
from rl2grid.envs.task_environments import SimulationResult, TaskEnvironments
from rl2grid.mdp.state import GridState
from rl2grid.structures import row_of

if TYPE_CHECKING:
    from rl2grid.engines.native.what_if import ActionOutcomes, FirstSafe, OutageOutcomes


class RowMethods(TaskDescription):
    """Questions about one row of task environments, whose answers leave what is played as it is."""

    _environments: TaskEnvironments
    _i: int = 0
    """The row."""

    def observe(self, scaled: bool = False) -> dict[str, NDArray[np.float32]]:
        """The observation of this moment by name.

        Names, their order, units and sizes are those of the table of :mod:`rl2grid.mdp.features`; which of them there
        are depends on the task. ``grid.name_line``, ``grid.name_gen``, ``grid.name_load`` and ``grid.name_sub`` name
        the elements.

        Args:
            scaled: the numbers of the flat observation, as the keyword ``normalize`` has them; else in physical units.

        Returns:
            For each name float32 [entry]; ``t`` has one entry.

        Raises:
            UsageError: the environment was not reset yet.
        """
        return self._environments.observe(self._i, scaled)

    def simulate(self, action: Any, horizon: int = 1) -> SimulationResult:
        """What ``action`` would bring on the forecast ``horizon`` steps ahead; the state stays untouched.

        One grid step is played, without opponent and heuristic; ``docs/simulate.md`` says what happens to
        maintenance, cooldowns, counters, storage and dispatch.

        Raises:
            UsageError: a wrong action or horizon, no forecast for it, or no episode in progress.
        """
        return self._environments.simulate(self._i, action, horizon)

    def what_if(self, actions: Sequence[int] | None = None) -> ActionOutcomes:
        """What each topology action would do to the loadings of the next step, by its forecast, in one call.

        The power flow is that of ``simulate`` before protections trip lines; see ``docs/what_if.md``.

        Args:
            actions: ids of those to try; all of the task if left out.

        Returns:
            Arrays of one entry per action: ``worst_loading`` (infinite where no flow is found), ``verdict``,
            ``overloads`` and ``legal``.

        Raises:
            UsageError: continuous actions, an action that does not exist, no episode in progress, or the reference
                engine.
        """
        return self._environments.what_if(self._i, actions)

    def first_safe(self, actions: Sequence[int]) -> FirstSafe:
        """The first of some topology actions that is safe in the next step, by its forecast, else the least bad.

        Safe is what leaves every line below 95%. It is what :meth:`what_if` says of them, but nothing is solved behind
        the one that is found. Cooldowns do not count: give actions that the mask allows.

        Args:
            actions: ids of those to choose from, at least one, the one to play if it is safe first.

        Returns:
            ``place`` of the action among those given (where none is safe, the first with the least worst loading), its
            ``worst_loading`` and ``is_safe``.

        Raises:
            UsageError: no action, or one that does not exist; continuous actions, no episode in progress, or the
                reference engine.
        """
        return self._environments.first_safe(self._i, actions)

    def security(self, action: int | None = None) -> OutageOutcomes:
        """What the loss of each line would do (N-1), in one call; see ``docs/what_if.md``.

        Args:
            action: the topology action after which lines are lost, in the next step, by its forecast; None: they are
                lost now, with the present injections.

        Returns:
            Arrays of one entry per line: ``worst_loading``, ``verdict``, ``overloads`` and ``was_open``. Cooldowns do
            not count.

        Raises:
            UsageError: continuous actions, an action that does not exist, no episode in progress, or the reference
                engine.
        """
        if action is None:
            return self._environments.security(self._i)
        return self._environments.security_after(self._i, action)

    def n_minus_1_score(self) -> float:
        """Share of the lines in service whose loss would leave neither an overload nor a collapse.

        Raises:
            UsageError: no episode in progress, or the reference engine.
        """
        return self._environments.n_minus_1_score(self._i)

    def operation(self) -> Operation:
        """What the episode has cost so far, as the L2RPN competitions count it.

        Raises:
            UsageError: the environment was not reset yet.
        """
        return self._environments.operation(self._i)

    @property
    def imagined(self) -> bool:
        """Whether an imagined world is played."""
        return bool(self._environments.imagined[self._i])

    @property
    def foresight(self) -> int:
        """Decisions of the running episode taken where its truth had been seen before; see ``docs/worlds.md``."""
        return int(self._environments.foresight[self._i])

    def save(self) -> World:
        """Everything of the environment at this moment; see ``docs/worlds.md``.

        Raises:
            UsageError: the environment was not reset yet.
        """
        return self._environments.save(self._i)

    def imagine(self, seed: int) -> World:
        """A world that goes on from here as far as an operator may know; see ``docs/worlds.md``.

        The environment stays where it is; ``restore`` the world to play it, in this environment or in another one.

        Args:
            seed: of the opponent's draws.

        Raises:
            UsageError: there is no episode in progress, or the seed is negative; or the reference engine plays.
        """
        return self._environments.imagine(self._i, seed)

    def action_masks(self) -> NDArray[np.bool_]:
        """Which topology actions are legal now, bool [action]; of a joint task those of that part.

        Raises:
            UsageError: the task has continuous actions.
        """
        mask = np.zeros(self.task.n_topology_actions, np.bool_)
        self._environments.write_action_mask(self._i, mask)
        return mask

    def clock_at(self, step: int) -> datetime:
        """The time in the scenario after ``step`` steps of the episode.

        Raises:
            UsageError: the environment was not reset yet.
        """
        return self._environments.clock(self._i, step)


class RowView(RowMethods):
    """One row of a vector environment, as :meth:`rl2grid.envs.vector.PowerGridVectorEnv.call` shows it."""

    def __init__(self, environments: TaskEnvironments, i: int) -> None:
        self._environments, self._i = environments, i
        self.task, self.options = environments.task, environments.options
        self.observation_space, self.action_space = single_spaces(self.task, self.options.operator_features)

    @property
    def state(self) -> GridState:
        """The grid after the last step, in physical units: a copy, row 0 of each array."""
        return row_of(self._environments.state, self._i)


def public_names() -> tuple[str, ...]:
    """What can be asked of a row."""
    given = ("task", "options", "observation_space", "action_space")
    return (*given, *(name for name in dir(RowView) if not name.startswith("_")))
