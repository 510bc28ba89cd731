"""The rows of a vector environment: one protocol, whoever plays them.

:class:`~rl2grid.envs.native_rows.NativeRows` plays them in compiled code, all in one call,
:class:`~rl2grid.envs.local_rows.LocalRows` one after the other on the reference engine in this process, and
:class:`~rl2grid.envs.remote_rows.RemoteRows` on the reference engine in other processes.
:func:`~rl2grid.envs.making_rows.make_rows` chooses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rl2grid.engines.worlds import World


@dataclass
class Batch:
    """What a step or reset of ``n`` rows returns."""

    observations: NDArray[np.float32]
    """float32 [n, feature]. Those of the native engine lie in one of two buffers that take turns: they are valid until
    the step after the next."""
    rewards: NDArray[np.float64]
    """float64 [n]; zero after a reset."""
    terminated: NDArray[np.bool_]
    """bool [n]; False after a reset."""
    truncated: NDArray[np.bool_]
    """bool [n]; False after a reset."""
    infos: dict[str, Any]
    """By key of :data:`~rl2grid.envs.info.INFO_KEYS`, in Gymnasium's form: arrays [n] or dicts of such, each beside its
    mask, ``"_" + key``, of the rows that have it. All rows have all keys; where episodes ended in this step there are
    ``final_obs``, object [n], and ``final_info``, infos again, which their rows have and which are blank in others."""


class Rows(Protocol):
    """``n`` environments of one task, played together.

    An ended episode makes way for the next one in the same step (``AutoresetMode.SAME_STEP``).
    """

    num_threads: int
    """Threads that share them."""

    def reset(self, seeds: list[int | None], options: dict[str, Any] | None) -> Batch:
        """Begin an episode in every row: the first of its seed's stream; None: the next of its running stream.

        Raises:
            UsageError: an option is unknown, or names a scenario or start that does not exist.
        """

    def step(self, actions: Any) -> Batch:
        """Step every row.

        Args:
            actions: one per row: integers [n] of a topology task, floats [n, entry] of a continuous one, a dict of both
                of a joint one.

        Raises:
            UsageError: an action has the wrong shape or value, or nothing was reset yet; then no row has stepped.
        """

    def action_masks(self) -> NDArray[np.bool_]:
        """Legal topology actions, bool [n, action].

        Raises:
            UsageError: the task has continuous actions.
        """

    def save(self, i: int) -> World:
        """Everything of row ``i`` at this moment.

        Raises:
            UsageError: it was not reset yet.
        """

    def restore_row(self, i: int, world: World) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Bring row ``i`` to where ``world`` was saved; the observation [feature] and the info are those of then.

        Raises:
            UsageError: the world is of another task, of other keywords or of an engine alone, or its series is not to
                be had.
        """

    def imagine(self, i: int, seed: int) -> World:
        """A world that goes on from row ``i`` as far as an operator may know.

        Raises:
            UsageError: the seed is negative, there is no episode in progress, or the engine cannot imagine.
        """

    def state_dict(self) -> list[dict[str, Any]]:
        """The worlds of all rows, as plain values."""

    def load_state_dict(self, rows: list[dict[str, Any]]) -> Batch:
        """Bring every row to where it was saved; the observations and infos are those of then."""

    def ask(self, name: str, arguments: tuple[Any, ...], keywords: dict[str, Any]) -> list[Any]:
        """What is called ``name`` of the :class:`~rl2grid.envs.row_view.RowView` of every row, called if it can be.

        Raises:
            UsageError: there is no such thing, or it refuses.
        """

    def close(self) -> None:
        """Free the simulators and end the processes."""
