"""A ranking of the topology actions of one grid, and the trials that it rests on, as values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Ranking:
    """The ranked actions of one grid, best first, and what came of trying them."""

    ids: NDArray[np.int32]
    """Catalogue ids, without do nothing; read-only."""
    metadata: dict[str, Any]
    """How the ranking was made: version, command, seed, number of states, method."""
    hash: str
    """Short hash of the grid and of the ids in order."""
    trials: Trials | None
    """None: the ranking does not tell how often each action was tried."""


@dataclass(frozen=True, eq=False)
class Trials:
    """What came of trying the actions of one grid, by catalogue id; read-only."""

    trials: NDArray[np.uint32]
    """[action] how often the action was tried."""
    survived: NDArray[np.uint32]
    """[action] trials without a collapse of the grid, or a line above the hard limit of its protection."""
    margin: NDArray[np.float32]
    """[action] mean over the trials that survived of 1 - the worst loading that resulted, in [-1, 1]."""

    @property
    def survival(self) -> NDArray[np.float64]:
        """[action] share of the trials that survived; NaN for an action that was never tried."""
        tried = self.trials > 0
        return np.where(tried, self.survived / np.maximum(self.trials, 1), np.nan)
