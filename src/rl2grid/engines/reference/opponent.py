"""The bridge that lets :mod:`rl2grid.mdp.opponents` attack inside Grid2Op.

Grid2Op asks its ``OpponentSpace`` for an attack in every step but the one of the reset. The bridge
takes that place and answers with our opponent's decision; Grid2Op then opens the lines, raises their
cooldowns and reports the attack in ``info`` as ever.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from grid2op.Opponent import OpponentSpace

from rl2grid.mdp.opponents import OpponentState, attack
from rl2grid.mdp.state import GridState
from rl2grid.structures import row_of


def install_opponent(env: Any, state: GridState, opponent: OpponentState | None, row: int) -> None:
    """Let ``opponent`` attack the Grid2Op environment ``env``; call it once, after ``make`` or ``copy``.

    Before each step, row ``row`` of ``state`` must hold the last observation (``rho`` and
    ``line_status``). :func:`rl2grid.mdp.opponents.load_draws` begins an episode of the opponent, before
    or after ``env.reset()``, which leaves the opponent alone. After a step, ``opponent.attacked[row]``
    tells what was attacked. A step that ends in Grid2Op's redispatching comes before the opponent's
    turn and leaves the arrays as they were.

    A copy of ``env`` (``env.copy()``) plays the remaining attacks on its own, without touching
    ``opponent``. ``simulate`` and forecast environments are never attacked.

    Args:
        env: A ``grid2op.Environment``.
        state: The engine's state.
        opponent: The engine's opponents; ``None`` silences Grid2Op's opponent.
        row: Row of ``env`` in ``state`` and ``opponent``.
    """
    replaced = env._oppSpace
    bridge = OpponentBridge(
        compute_budget=replaced.compute_budget,
        init_budget=replaced.init_budget,
        opponent=replaced.opponent,
        attack_duration=replaced.attack_max_duration,
        attack_cooldown=replaced.attack_cooldown,
        budget_per_timestep=replaced.budget_per_timestep,
    )
    if opponent is not None:
        bridge.follow(opponent, row, state)
    env._oppSpace = bridge
    # Copies and forecast environments are built from this type.
    env._opponent_space_type = OpponentBridge


class OpponentBridge(OpponentSpace):  # type: ignore[misc]
    """An ``OpponentSpace`` that plays the attacks of our opponent, or none before :meth:`follow`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._state: GridState | None = None
        self._followed: OpponentState | None = None
        self._row = 0

    def follow(self, opponent: OpponentState, row: int, state: GridState | None) -> None:
        """Play the attacks of ``opponent[row]``.

        Without a ``state``, the last observation is the one that Grid2Op shows its opponents.
        """
        self._followed, self._row, self._state = opponent, row, state

    def attack(self, observation: Any, agent_action: Any, env_action: Any) -> tuple[Any, int]:
        """The attack of this step as a Grid2Op action or ``None``, and the remaining duration in steps."""
        opponent, row = self._followed, self._row
        if observation is None or opponent is None:
            return None, 0
        if self._state is None:
            attack(opponent, row, observation.rho, observation.line_status)
        else:
            attack(opponent, row, self._state.rho[row], self._state.line_status[row])
        lines = np.flatnonzero(opponent.attacked[row])
        self.budget = opponent.budget[row]
        self.last_attack = None
        if not lines.size:
            return None, 0
        self.last_attack = self.action_space({"set_line_status": [(line, -1) for line in lines]})
        return self.last_attack, int(opponent.attack_duration[row])

    def reset(self) -> None:
        """Nothing: :func:`rl2grid.mdp.opponents.load_draws` begins an episode of the opponent."""
        self.last_attack = None

    def init_opponent(self, partial_env: Any, **kwargs: Any) -> None:
        """Nothing: Grid2Op's own opponent is not used."""

    def _get_state(self) -> tuple[OpponentState | None, None]:
        """A snapshot that a copy of the environment continues from."""
        if self._followed is None:
            return None, None
        return row_of(self._followed, self._row), None

    def _set_state(self, my_state: OpponentState | None, opp_state: object = None) -> None:
        if my_state is not None:
            self.follow(row_of(my_state, 0), 0, None)
