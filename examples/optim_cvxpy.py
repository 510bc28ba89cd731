"""A published agent beside ours: OptimCVXPY of l2rpn-baselines 0.8, on the reference engine and the same months.

It minimises overloads by redispatch, curtailment and storage on a DC model, and takes back what it asked for where the
grid is safe. It needs an environment of its own, in which later versions of CVXPY do not play it:

    python -m venv published
    published/bin/pip install -e . l2rpn-baselines==0.8.0 cvxpy==1.6.7
    published/bin/rl2grid evaluate examples/optim_cvxpy.py bus14-R --engine reference --months 4 --l2rpn

`pip install -e ".[examples]"` installs what the other examples need, and not these. The lines that it reconnects are no
actions of a redispatching task; `--heuristic recovery` reconnects lines there, and asks the agent only in an emergency.
"""

import warnings

import numpy as np

from rl2grid.errors import UsageError
from rl2grid.mdp.actions import continuous_layout


class OptimCVXPY:
    """Asks the agent for a Grid2Op action, and plays what the task has of it."""

    name = "OptimCVXPY"

    def bind(self, env):
        """Make the agent for the Grid2Op environment that is played."""
        self._env = env.unwrapped
        if self._env.options.engine != "reference" or self._env.task.kind != "R":
            raise UsageError("OptimCVXPY needs Grid2Op's observations and a task R: add --engine reference.")
        self._published = published_agent()(self._there.action_space, self._there)
        self._layout = continuous_layout(self._env.grid)

    @property
    def _there(self):
        return self._env.engine.grid2op_environment(0)

    def reset(self, i):
        """A new episode begins."""
        self._published.reset(self._there.get_obs())

    def act(self, observation, info):
        """The action for the observation that Grid2Op has of this moment."""
        seen = self._there.get_obs()
        return self._injection(seen, self._published.act(seen, 0.0, False))

    def _injection(self, seen, action):
        grid, layout = self._env.grid, self._layout
        # A limit that is not named stays what it is; the continuous action names them all.
        limits = np.where(action.curtail < 0, seen.curtailment_limit, action.curtail)
        largest = np.where(action.storage_p < 0, grid.storage_max_p_prod, grid.storage_max_p_absorb)
        parts = (
            action.redispatch[layout.redispatch] / grid.gen_max_ramp_up[layout.redispatch],
            limits[layout.curtail] - 1,
            action.storage_p / largest,
        )
        return np.clip(np.concatenate(parts), -1, 1).astype(np.float32)


def published_agent():
    """The class, which knows names that NumPy and LightSim2Grid had before."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        import lightsim2grid.gridmodel as gridmodel

    vars(np).setdefault("NaN", np.nan)
    vars(gridmodel).setdefault("init", gridmodel.init_from_pandapower)  # called for other backends alone
    try:
        from l2rpn_baselines.OptimCVXPY import OptimCVXPY as Published
    except ImportError as error:
        words = f"OptimCVXPY needs l2rpn-baselines, in an environment of its own ({error}): see docs/l2rpn.md."
        raise UsageError(words) from None

    return Published
