"""The course of one episode, grid step by grid step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Alternative(NamedTuple):
    """An action that could have been played at a decision."""

    action: str
    """In words; empty for do nothing."""
    promised: float
    """Worst loading of the next step by its forecast, before protections act; infinite: no power flow is found, or the
    game would be lost; NaN: not known."""
    preference: float
    """What the agent says of it, see :attr:`Reason.preference`; NaN: nothing."""
    chosen: bool


@dataclass(frozen=True)
class Reason:
    """What there was to choose from at a decision."""

    step: int
    """After which the agent was asked."""
    preference: str
    """What the agent's numbers are, for example ``probability``; empty: it gives none."""
    why: str
    """By what rule the agent chose, in words; empty: it does not say."""
    tried: int
    """Actions whose promises were compared."""
    alternatives: tuple[Alternative, ...]
    """The best of them by promise and by preference, do nothing, and what was played."""


class Trip(NamedTuple):
    """A line that a protection opened."""

    line: int
    loading: float
    """With which it was opened."""
    overloaded: int
    """Steps in a row in which it was above its limit; 0: it was above the hard limit, which opens it at once."""


@dataclass(frozen=True, eq=False)
class Round:
    """One power flow of a step, and what the protections did about it."""

    topo_vect: NDArray[np.int8]
    """[topo] busbar of each element, -1 when disconnected."""
    rho: NDArray[np.float32]
    """[line] loading; NaN where no power flow was found."""
    p_or: NDArray[np.float32]
    """[line] MW at the origin; NaN where no power flow was found."""
    trips: tuple[Trip, ...]


class Cascade(NamedTuple):
    """The rounds of a step in which protections opened lines or the grid was lost."""

    step: int
    rounds: tuple[Round, ...]
    """The last one has no trips, or no power flow."""


@dataclass(frozen=True, eq=False)
class Ending:
    """The grid as a game over left it."""

    topo_vect: NDArray[np.int8]
    """[topo] busbar of each element, -1 when disconnected."""
    lost: NDArray[np.bool_]
    """[topo] generators and loads that are off, and whatever is not connected to the generator that balances."""
    attacked: NDArray[np.bool_]
    """[line] out by the opponent."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One episode of one environment. ``step`` counts the rows played, row 0 is what reset showed.

    The step of a game over has no flows and is not among the rows; :attr:`cascades` and :attr:`ending` tell of it.
    """

    task: str
    agent: str
    heuristic: str
    scenario: str
    seed: int
    start: int
    began: str
    """Time of row 0 in the scenario, ISO 8601."""
    episode_length: int
    """Steps of a completed episode."""
    game_over: str
    """Why the episode ended, in words; empty when it was completed."""
    line_names: tuple[str, ...]
    decision_steps: tuple[int, ...]
    """Steps after which the agent was asked."""
    actions: tuple[str, ...]
    """What it did at each of them, in words; empty for do nothing."""
    rho: NDArray[np.float32]
    """[step, line] loading: current over thermal limit."""
    line_status: NDArray[np.bool_]
    """[step, line]"""
    attacked: NDArray[np.bool_]
    """[step, line] out by the opponent."""
    maintained: NDArray[np.bool_]
    """[step, line] out for planned maintenance."""
    topo_vect: NDArray[np.int8]
    """[step, topo] busbar of each element, -1 when disconnected."""
    gen_p: NDArray[np.float32]
    """[step, gen] MW."""
    load_p: NDArray[np.float32]
    """[step, load] MW."""
    storage_power: NDArray[np.float32]
    """[step, storage] MW, positive charges."""
    p_or: NDArray[np.float32]
    """[step, line] MW at the origin, positive towards the extremity."""
    gen_p_before_curtail: NDArray[np.float32]
    """[step, gen] MW, what renewables would produce without curtailment; 0 for other generators."""
    reasons: tuple[Reason, ...] = ()
    """Of decisions in which the grid was not safe or the agent did something."""
    heuristic_acts: tuple[tuple[int, str], ...] = ()
    """Steps in which the heuristic changed something, and what, in words."""
    cascades: tuple[Cascade, ...] = ()
    """Of steps in which protections opened lines or the grid was lost, where their rounds are known."""
    ending: Ending | None = None
    """None: the grid is alive in the last row."""

    @property
    def n_steps(self) -> int:
        """Steps survived."""
        return len(self.rho) - 1

    @property
    def n_acts(self) -> int:
        """Decisions that changed something."""
        return sum(bool(words) for words in self.actions)
