"""Which episode of which stream of episodes each environment plays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import I32, I64
from rl2grid.mdp import reports
from rl2grid.scenarios.episodes import EpisodePlan, PlannedStarts


class StreamPositions(NamedTuple):
    """Where environments are in their streams of episodes, one entry each."""

    seeds: NDArray[np.object_]
    """object [k], integers of any size."""
    numbers: I64
    """int64 [k], episodes of the seed before."""
    grid_steps: I64
    """int64 [k], grid steps played in these."""
    options: Mapping[str, Any]
    """Those of the reset, of all of them."""


class EpisodeTable:
    """The episode of each of ``n`` environments, in columns.

    Where episodes are short, as of agents that know nothing yet, an object for each would take longer to make, and to
    be looked at by the collector of garbage, than the rest of what Python does for an episode.
    """

    def __init__(self, n: int, maintenance: bool) -> None:
        self.begun = np.zeros(n, np.bool_)
        """bool [n], who was reset or restored."""
        self.scenarios = np.full(n, "", object)
        """Ids, object [n]."""
        self.counts = np.zeros((reports.EARLIER_STEPS + 1, n), np.int64)
        """int64 [line, n]: start, redraws, grid steps of earlier episodes; see :mod:`rl2grid.mdp.reports`."""
        self._seeds = np.zeros(n, object)
        self._numbers = np.zeros(n, np.int64)
        self._options: dict[int, Mapping[str, Any]] = {}  # of rows that were reset with some
        self._maintenance = maintenance

    def following(
        self, rows: I64, seeds: list[int | None] | None, options: Mapping[str, Any], steps: I32
    ) -> StreamPositions:
        """The episodes that ``rows`` play next.

        Args:
            rows: int64 [k].
            seeds: the streams that begin there, one each; None: the next episode of the running stream, which must be
                there if nobody begins one; else of a stream that nobody can name.
            options: of the reset.
            steps: int32 [n], grid steps of the running episodes.
        """
        played = self.counts[reports.EARLIER_STEPS, rows] + steps[rows]
        positions = StreamPositions(self._seeds[rows], self._numbers[rows] + 1, played, options)
        if seeds is None:
            return positions
        for k, (row, seed) in enumerate(zip(rows.tolist(), seeds, strict=True)):
            if seed is None and self.begun[row]:
                continue
            positions.seeds[k] = _unnamed_seed() if seed is None else int(seed)
            positions.numbers[k] = positions.grid_steps[k] = 0
        return positions

    def take(self, rows: I64, positions: StreamPositions, starts: PlannedStarts) -> None:
        """Note what ``rows`` play now, an entry each."""
        self.begun[rows] = True
        self.scenarios[rows] = starts.scenario_ids
        self.counts[reports.START, rows] = starts.rows
        self.counts[reports.START_REDRAWS, rows] = starts.redraws
        self.counts[reports.EARLIER_STEPS, rows] = positions.grid_steps
        self._seeds[rows] = positions.seeds
        self._numbers[rows] = positions.numbers
        if positions.options or self._options:
            for i in rows.tolist():
                self._note_options(i, positions.options)

    def take_one(self, i: int, plan: EpisodePlan, grid_steps: int, options: Mapping[str, Any]) -> None:
        """Note what row ``i`` plays now; see :class:`StreamPositions`."""
        self.begun[i] = True
        self.scenarios[i] = plan.scenario_id
        self.counts[:, i] = plan.start, plan.redraws, grid_steps
        self._seeds[i], self._numbers[i] = plan.seed, plan.number
        self._note_options(i, options)

    def plan(self, i: int, n_steps: int) -> EpisodePlan:
        """What was decided of the episode of row ``i``, which is completed after ``n_steps`` steps."""
        return EpisodePlan(
            seed=self._seeds[i],
            number=int(self._numbers[i]),
            scenario_id=self.scenarios[i],
            start=int(self.counts[reports.START, i]),
            n_steps=n_steps,
            maintenance=self._maintenance,
            redraws=int(self.counts[reports.START_REDRAWS, i]),
        )

    def earlier_steps(self, i: int) -> int:
        """Grid steps of earlier episodes of the stream of row ``i``."""
        return int(self.counts[reports.EARLIER_STEPS, i])

    def options(self, i: int) -> Mapping[str, Any]:
        """With which the episode of row ``i`` was asked for."""
        return self._options.get(i, {})

    def _note_options(self, i: int, options: Mapping[str, Any]) -> None:
        if options:
            self._options[i] = options
        else:
            self._options.pop(i, None)


def _unnamed_seed() -> int:
    return int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> np.uint64(1))
