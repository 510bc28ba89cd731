"""The planner where an open line keeps the opponent from attacking (``docs/algorithms/planner.md``, *planner-open*)."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.contingencies import Contingencies, areas_to_attack, expected
from rl2grid.agents.planner import Planner
from rl2grid.errors import UsageError
from rl2grid.mdp.state import GridState


class PlannerOpen(Planner):
    """Plays as the planner, but while the grid is safe it leaves a line open where that disarms the opponent.

    Some opponents attack nothing in an area while one of its lines is open, by their published rules (``docs/mdp.md``,
    *Opponents that an open line disarms*). The last open line of such an area is not closed while the grid is safe, and
    no attack is expected there. Where the grid is not safe, any line may be closed. Against other opponents, and
    where nobody attacks, it plays what the planner plays.

    Args and errors are those of the planner.
    """

    kinds: ClassVar[tuple[str, ...]] = ("T", "H")
    called: ClassVar[str] = "planner-open"

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """As the planner.

        Raises:
            UsageError: as the planner, or a redispatching task, where nobody closes lines.
        """
        base: Any = env.unwrapped
        if not base.task.changes_topology:
            raise UsageError(
                f"Agent {self.called!r} cannot play {base.task.id}, where no line can be closed: choose planner, or a "
                "task with topology."
            )
        super().bind(env)

    def _expected(self, state: GridState) -> Contingencies:
        return expected(self._grid, state, areas_to_attack(self._grid, state))

    def _worth_closing(self, state: GridState, entries: NDArray[np.int64]) -> NDArray[np.int64]:
        """All but those that close the last open line of an area whose opponent it disarms."""
        closed, armed = state.line_status[0], areas_to_attack(self._grid, state)
        open_lines = [
            [line for line in area if not closed[line]] for area in self._grid.opponent.areas if area not in armed
        ]
        last = [lines[0] for lines in open_lines if len(lines) == 1]
        return entries[~np.isin(self._catalogue.target[entries], last)]
