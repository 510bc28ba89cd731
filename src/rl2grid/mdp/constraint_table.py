"""The safety constraints, declared once: ids, columns of the costs, thresholds, tables and figures follow from here.

What a grid step costs is computed in :mod:`rl2grid.mdp.constraints`, in the order of this table. This module loads no
compiled code: the ids of the tasks are made of it when the package is imported.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Constraint:
    """A cost per grid step, and what its sum over an episode may reach."""

    name: str
    """In the ids of tasks, ``info["costs"]`` and the keyword ``constraint``."""
    threshold: float
    """Largest cost of a safe episode. The paper's text; its table and figure swap the two."""
    text: str
    """What it counts, for captions."""

    @property
    def column(self) -> str:
        """Its name among the columns of episodes and the metrics of trainings."""
        return f"cost_{self.name.lower()}"


CONSTRAINTS: dict[str, Constraint] = {
    constraint.name: constraint
    for constraint in (
        Constraint("LSI", 0.0, "load shedding and islanding"),
        Constraint("TLO", 50.0, "overloaded and disconnected lines"),
    )
}
"""By name, in the order of the columns of ``GridState.transition_costs`` and ``episode_costs``."""

THRESHOLDS: dict[str, float] = {name: constraint.threshold for name, constraint in CONSTRAINTS.items()}
"""What the sum of a cost over an episode may reach, by name."""
