"""Rows that an engine in this process plays: what does not depend on how it plays them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import I64
from rl2grid.engines.worlds import World, world_of_plain
from rl2grid.envs.description import check_number, one_by_one
from rl2grid.envs.episode_table import StreamPositions
from rl2grid.envs.info import COSTS, GAME_OVER_WORDS
from rl2grid.envs.info_arrays import InfoForm
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.row_view import RowView, public_names
from rl2grid.envs.rows import Batch
from rl2grid.envs.task_environments import OF_MASKS, TaskEnvironments
from rl2grid.envs.tasks import Task
from rl2grid.errors import one_of
from rl2grid.handles import Handle
from rl2grid.mdp import reports
from rl2grid.mdp.action_masks import write_action_masks
from rl2grid.mdp.reports import Report, blank_report, write_outcomes, write_report
from rl2grid.scenarios.episodes import EpisodePlan, PlannedStarts, starts_of

Decisions = TypeVar("Decisions")
"""Checked actions of all rows, in the form in which the engine takes them."""

_WORDS = ("scenario", "game_over_text", "action_effect")


class EngineRows(TaskEnvironments, ABC, Generic[Decisions]):
    """Task environments that are played together: :class:`~rl2grid.envs.rows.Rows`.

    How rows are begun, stepped and observed is left to those who derive from it.
    """

    num_threads = 1

    def __init__(self, task: Task, options: TaskOptions, n: int) -> None:
        super().__init__(task, options, n)
        self._n = n
        self._rows = np.arange(n)
        self._state_handle = Handle(self.state)
        self._hashes = [] if self._hash is None else [np.full(n, self._hash, object)]
        self._shown_effects = np.full(n, "", object)
        self._nothing = np.full(n, None, object)
        self._cost = -1 if self.constraint is None else COSTS.index(self.constraint)
        self._form = InfoForm([*_WORDS, *(["action_set_hash"] if self._hashes else [])], options.gamma is not None, n)
        self._all_begun = False  # every row was reset or restored once

    def reset(self, seeds: list[int | None], options: dict[str, Any] | None) -> Batch:
        """See :meth:`rl2grid.envs.rows.Rows.reset`."""
        self._begin(self._rows, seeds, options)
        return self._standing_batch(np.full(self._n, "", object))

    def step(self, actions: Any) -> Batch:
        """See :meth:`rl2grid.envs.rows.Rows.step`."""
        decisions = self._decided(actions)
        (waiting,) = self._pending.nonzero()  # these rows return the ending that their reset has already played
        rows = np.delete(self._rows, waiting) if len(waiting) else self._rows
        self._pending[:] = False
        self._go_on(rows, decisions)
        effects = self._effects(decisions)
        if len(waiting):
            effects[waiting] = ""
        rewards, terminated, truncated = np.empty(self._n), np.empty(self._n, np.bool_), np.empty(self._n, np.bool_)
        if not write_outcomes(self._state_address, rewards, terminated, truncated):
            return self._batch(effects, rewards, terminated, truncated)
        (ended,) = (terminated | truncated).nonzero()
        endings = self._endings(ended, effects)
        self._begin(ended, None, None)
        effects[ended] = ""
        batch = self._batch(effects, rewards, terminated, truncated)
        batch.infos |= endings
        return batch

    def advance(self, rows: I64, actions: Any) -> None:
        """Play one transition in each of ``rows``, whose episodes are not over; what ends is not begun anew.

        Args:
            rows: int64 [k], ascending.
            actions: of all rows, as :meth:`step` takes them.

        Raises:
            UsageError: an action has the wrong shape or value, or a row was not reset yet; then no row has stepped.
        """
        for i in rows[~self._episodes.begun[rows]].tolist():
            self._check_begun(i)
        check_number(self.task, actions, self._n)
        self._go_on(rows, self._decide(actions))

    def action_masks(self) -> NDArray[np.bool_]:
        """See :meth:`rl2grid.envs.rows.Rows.action_masks`."""
        catalogue = self._topology_catalogue(OF_MASKS)
        masks = np.empty((self._n, len(catalogue)), np.bool_)
        write_action_masks(self._state_address, catalogue.runs, catalogue.kind, catalogue.target, masks)
        return masks

    def state_dict(self) -> list[dict[str, Any]]:
        """See :meth:`rl2grid.envs.rows.Rows.state_dict`."""
        return [self._world(i).to_plain() for i in self._episodes.begun.nonzero()[0].tolist()]

    def load_state_dict(self, rows: list[dict[str, Any]]) -> Batch:
        """See :meth:`rl2grid.envs.rows.Rows.load_state_dict`."""
        worlds = [world_of_plain(row) for row in rows]
        for world in worlds:  # all or none
            self._checked_standing(world)
        for i, world in enumerate(worlds):
            self.restore(i, world)
        return self._standing_batch(self._shown_effects)

    def restore_row(self, i: int, world: World) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """See :meth:`rl2grid.envs.rows.Rows.restore_row`."""
        self.restore(i, world)
        observation = np.zeros(self._size, np.float32)
        self.write_observation(i, observation)
        return observation, self.info(i)

    def restore(self, i: int, world: World) -> None:
        """Bring row ``i`` to where ``world`` was saved; see :meth:`TaskEnvironments.restore`."""
        super().restore(i, world)
        # A copy: the array was handed out with the infos of the last step.
        self._shown_effects = self._shown_effects.copy()
        self._shown_effects[i] = self.transitions.action_effects[i]

    def ask(self, name: str, arguments: tuple[Any, ...], keywords: dict[str, Any]) -> list[Any]:
        """See :meth:`rl2grid.envs.rows.Rows.ask`."""
        if name not in public_names():
            raise one_of("Method or attribute of a row", name, public_names())
        answers = []
        for i in range(self._n):
            found = getattr(RowView(self, i), name)
            answers.append(found(*arguments, **keywords) if callable(found) else found)
        return answers

    def _effect(self, i: int) -> str:
        return str(self._shown_effects[i])

    @abstractmethod
    def _decide(self, actions: Any) -> Decisions:
        """``actions`` of all rows, one each, checked.

        Raises:
            UsageError: one has the wrong shape or value.
        """

    @abstractmethod
    def _play(self, rows: I64, decisions: Decisions) -> None:
        """Play one transition in each of ``rows``."""

    @abstractmethod
    def _effects(self, decisions: Decisions) -> NDArray[np.object_]:
        """What became of the actions that were played last, object [n]."""

    @abstractmethod
    def _start(self, rows: I64, plans: list[EpisodePlan]) -> None:
        """Begin episodes in ``rows`` and play to their first decisions."""

    @abstractmethod
    def _observations(self) -> NDArray[np.float32]:
        """The observations of all rows, float32 [n, feature]."""

    @abstractmethod
    def observations_of(self, rows: I64) -> NDArray[np.float32]:
        """The observations of ``rows``, which stay what they are, float32 [row, feature]."""

    def _go_on(self, rows: I64, decisions: Decisions) -> None:
        """Play one transition in each of ``rows``."""
        self._note_decisions()
        self._play(rows, decisions)
        self._note_reached()

    def _begin(self, rows: I64, seeds: list[int | None] | None, options: dict[str, Any] | None) -> None:
        # All or none: no row may have begun when another's options are refused.
        positions = self._following(rows, seeds, options)
        self._take(rows, positions, self._begin_episodes(rows, positions))
        self._pending[rows] = self.state.terminated[rows] | self.state.truncated[rows]

    def _begin_episodes(self, rows: I64, positions: StreamPositions) -> PlannedStarts:
        """Plan the episodes of ``positions``, begin them in ``rows`` and play to their first decisions."""
        plans = self._plans(positions)
        self._start(rows, plans)
        return starts_of(plans)

    def _decided(self, actions: Any) -> Decisions:
        """The actions of all rows, checked."""
        if not self._all_begun:
            for i in range(self._n):
                self._check_begun(i)
            self._all_begun = True
        check_number(self.task, actions, self._n)
        return self._decide(actions)

    def _check(self, actions: Any) -> None:
        """Say what is wrong with the first wrong action."""
        for action in one_by_one(self.task, actions):
            self._step_action(action)

    @property
    def _state_address(self) -> int:
        """Where compiled code finds the state."""
        if self._state_handle.structure is not self.state:
            self._state_handle = Handle(self.state)
        return self._state_handle.address

    def _endings(self, rows: I64, effects: NDArray[np.object_]) -> dict[str, Any]:
        """Infos of ``rows``, whose episodes have ended: their last observations and infos, masked."""
        told = np.zeros(self._n, np.bool_)
        told[rows] = True
        observations = self._nothing.copy()
        for i, observation in zip(rows.tolist(), self.observations_of(rows), strict=True):
            observations[i] = observation
        report = self._report(rows)
        reasons = GAME_OVER_WORDS.take(report.counts[reports.GAME_OVER])
        words = []
        for given in (self._episodes.scenarios, reasons, effects, *self._hashes):
            words.append(self._nothing.copy())
            words[-1][rows] = given[rows]
        last = self._form.named(words, report, told)
        return {"final_obs": observations, "_final_obs": told, "final_info": last, "_final_info": told}

    def _report(self, rows: I64) -> Report:
        """Report of ``rows``; the columns of others are blank."""
        report = blank_report(self._n, self.grid.n_line)
        write_report(self._state_address, rows, self._cost, self._episodes.counts, self._pending, *report)
        return report

    def _standing_batch(self, effects: NDArray[np.object_]) -> Batch:
        """Where all rows stand, no step having been played."""
        return self._batch(effects, np.zeros(self._n), *np.zeros((2, self._n), np.bool_))

    def _batch(
        self,
        effects: NDArray[np.object_],
        rewards: NDArray[np.float64],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
    ) -> Batch:
        self._shown_effects = effects
        report = self._report(self._rows)
        reasons = GAME_OVER_WORDS.take(report.counts[reports.GAME_OVER])
        words = (self._episodes.scenarios.copy(), reasons, effects, *(each.copy() for each in self._hashes))
        infos = self._form.named(words, report)
        return Batch(self._observations(), rewards, terminated, truncated, infos)
