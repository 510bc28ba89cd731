"""An agent of one's own in a file, to be played by the command line.

    rl2grid evaluate examples/lowest_loading.py greedy bus14-T0 --months 4 --heuristic idle
    rl2grid watch examples/lowest_loading.py bus14-T0

It needs rl2grid alone; `pip install -e ".[examples]"` installs what the other examples need.
"""

import numpy as np


class LowestLoading:
    """In an emergency, plays the legal action that lowers the worst loading most; the forecast tells."""

    name = "lowest-loading"

    def bind(self, env):
        """Look at the environment to be played; called once, before anything else."""
        self._env = env.unwrapped

    def reset(self, i):
        """A new episode begins: forget everything about environment i."""

    def act(self, observation, info):
        """The action for an observation and the info that came with it."""
        outcomes = self._env.what_if()
        worst = np.where(outcomes.legal & (outcomes.verdict == 0), outcomes.worst_loading, np.inf)
        return int(worst.argmin())
