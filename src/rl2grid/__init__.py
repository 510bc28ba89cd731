"""rl2grid: a benchmark for reinforcement learning in power-grid operation.

Importing the package registers the tasks with Gymnasium::

    import gymnasium, rl2grid
    env = gymnasium.make("rl2grid/bus14-T0-v0", heuristic="idle")
"""

from rl2grid.envs.registration import register_all

__version__ = "0.1.0"

register_all()
