"""rl2grid: a benchmark for reinforcement learning in power-grid operation.

Importing the package registers the tasks with Gymnasium::

    import gymnasium, rl2grid
    env = gymnasium.make("rl2grid/bus14-T0-v0", heuristic="idle")

A trained policy comes back with :func:`load`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rl2grid.envs.registration import register_all

if TYPE_CHECKING:
    from rl2grid.algorithms.policy_agent import PolicyAgent

__version__ = "0.1.0"

register_all()


def load(run: str | Path, *, deterministic: bool = True) -> PolicyAgent:
    """The policy of a training run, or of one checkpoint file, as an agent; nothing in the file is executed.

    Args:
        run: A run folder (its best policy by validation, else its latest), or a checkpoint file.
        deterministic: Whether to play the most probable action instead of a sample.

    Raises:
        UsageError: there is no checkpoint, or it cannot be read.
        ImportError: PyTorch is not installed.
    """
    # Imported here: environments and agents without training do without PyTorch.
    from rl2grid.algorithms.policy_agent import load_agent

    return load_agent(Path(run), deterministic=deterministic)
