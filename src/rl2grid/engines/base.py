"""What every engine offers: environments of one grid, advanced one grid step at a time."""

from __future__ import annotations

from typing import Protocol

from rl2grid.engines.worlds import World
from rl2grid.grids import Grid
from rl2grid.mdp.actions import StepAction
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.model import Network
from rl2grid.scenarios.episodes import EpisodePlan


class Engine(Protocol):
    """Simulator of several independent environments of one grid.

    An engine fills the observed attributes and the flags of its :class:`~rl2grid.mdp.state.GridState`.
    It knows nothing of rewards, costs and heuristics: :mod:`rl2grid.engines.transition` adds them.
    """

    grid: Grid
    network: Network
    state: GridState
    attacks: bool
    """Whether the grid's opponent attacks."""

    def reset(self, i: int, plan: EpisodePlan) -> None:
        """Begin the episode ``plan`` in environment ``i``; its first row may already be a game over."""

    def step(self, i: int, action: StepAction) -> None:
        """Play one grid step of environment ``i``."""

    def simulate(self, i: int, action: StepAction, horizon: int) -> GridState:
        """Play ``action`` on the forecast ``horizon`` steps ahead, leaving environment ``i`` untouched.

        Returns:
            A state of one environment (row 0), valid until the next call.

        Raises:
            UsageError: the scenario has no forecast for that horizon.
        """

    def save(self, i: int) -> World:
        """Everything of environment ``i`` at this moment.

        Raises:
            UsageError: it was not reset yet.
        """

    def restore(self, i: int, world: World) -> None:
        """Bring environment ``i`` to where ``world`` was saved: what follows is what followed there, bit for bit.

        Raises:
            UsageError: the world is of another grid or of an engine made otherwise, or its series is not to be had.
        """

    def imagine(self, i: int, seed: int) -> World:
        """A world that goes on from here as far as an operator may know; ``seed``: of the opponent's draws.

        Raises:
            UsageError: there is no episode in progress, or the engine cannot imagine.
        """

    def close(self) -> None:
        """Free what the engine holds."""
