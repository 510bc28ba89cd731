"""One environment of a task."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.engines.base import Engine
from rl2grid.engines.transition import Listener
from rl2grid.engines.worlds import World
from rl2grid.envs.closed import closed
from rl2grid.envs.description import single_spaces
from rl2grid.envs.options import keyword_names, options_of, shows_options
from rl2grid.envs.row_view import RowMethods
from rl2grid.envs.task_environments import TaskEnvironments
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError, one_of
from rl2grid.mdp.state import GridState

if TYPE_CHECKING:
    from rl2grid.drawing.grid_drawing import FrameRenderer


class PowerGridEnv(RowMethods, gymnasium.Env[NDArray[np.float32], Any]):
    """Keep a transmission grid alive for a month of 5-minute steps.

    ## Description
    A grid has substations, lines with a thermal limit, generators that follow a planned schedule, loads
    and, on some grids, storage. A line above its limit for some steps is tripped by its protection; the
    flow moves to other lines, which may trip in turn. The episode is lost when a load or generator is cut
    off, the grid falls apart or no power flow exists. The agent changes the topology (tasks `T`),
    redispatches, curtails and uses storage (tasks `R`), or does both in one decision (tasks `H`).

    ## Action space
    | task | space | meaning |
    |---|---|---|
    | `T<level>` | `Discrete(n)` | 0 does nothing; others move a set of a substation's elements to the other busbar or switch a line. `describe_action(a)` says it in words, `action_masks()` which are legal now |
    | `R` | `Box(-1, 1, (n,), float32)` | redispatch (share of the ramp of a step), curtailment (limit = 1 + min(a, 0)), storage (share of the maximum power); zero does nothing |
    | `H<level>` | `Dict({"topology": Discrete(n), "injection": Box(-1, 1, (m,), float32)})` | both at once, as in `T<level>` and in `R`; `action_masks()` is of the topology. Nothing of an illegal or ambiguous action is kept, neither part |

    :mod:`rl2grid.envs.joint` makes a `Box` or a `Discrete` of the `Dict`, for libraries that know only these.

    ## Observation space
    `Box(-inf, inf, (n,), float32)`. `observation_slices` maps each name to its place; `observe()` gives the present
    values by name, in these units.

    | feature | size | unit | in |
    |---|---|---|---|
    | `t` | 1 | share of the episode | T, R, H |
    | `gen_p`, `gen_theta` | generators | MW, degrees | T, R, H |
    | `load_p`, `load_theta` | loads | MW, degrees | T, R, H |
    | `rho` | lines | share of the thermal limit | T, R, H |
    | `time_before_cooldown_line` | lines | steps | T, R, H |
    | `topo_vect` | elements | busbar, -1 when off | T, H |
    | `line_status`, `timestep_overflow` | lines | 0/1, steps | T, H |
    | `time_before_cooldown_sub` | substations | steps | T, H |
    | `target_dispatch`, `actual_dispatch` | generators | MW | R, H |
    | `gen_margin_up`, `gen_margin_down` | generators | MW | R, H |
    | `gen_p_before_curtail`, `curtailment`, `curtailment_limit` | generators | MW, share of pmax | R, H |
    | `time_next_maintenance`, `duration_next_maintenance` | lines | steps | T, R, H |
    | `storage_charge`, `storage_power_target`, `storage_power`, `storage_theta` | storages | MWh, MW, MW, degrees | where the grid has storage |

    With `normalize="physical"` (the default) every entry is divided by a constant of the grid. `operator_features` adds
    the calendar, steps to trips, attacks, and what losses would do. See :mod:`rl2grid.mdp.features`.

    ## Rewards
    `reward="default"`: 1 for surviving, minus half the mean overload, minus half the normalised cost, per
    grid step; see :mod:`rl2grid.mdp.rewards`. A transition adds up the rewards of its grid steps.

    ## Starting state
    The reference topology at a row of a scenario: a random row of a training scenario, row 0 elsewhere.
    `reset(seed=s)` begins the stream of episodes of seed `s`; `reset()` takes its next episode;
    `reset(options={"scenario": id, "start": row})` chooses.

    ## Episode end
    `terminated` at a game over, `truncated` when the episode was completed. With a heuristic an episode may
    end inside `reset`: then `info["over"]` is True and the first `step` ignores its action and returns the
    ending.

    ## Arguments
    See :class:`rl2grid.envs.options.TaskOptions`; `render_mode="rgb_array"` makes `render` draw the grid.

    ## Information
    See :data:`rl2grid.envs.info.INFO_KEYS`.
    """  # noqa: E501

    metadata = {"render_modes": ["rgb_array"], "render_fps": 12}  # noqa: RUF012 - Gymnasium's convention

    @shows_options
    def __init__(
        self,
        task: Task | str,
        *,
        render_mode: str | None = None,
        **keywords: Any,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise one_of("render_mode", render_mode, ("None", "rgb_array"))
        self.render_mode = render_mode
        self._renderer: FrameRenderer | None = None
        self._last_action: Any = None
        self.task = find_task(task)
        self.options = options_of(self.task, keywords, keyword_names(type(self)))
        self._environments = TaskEnvironments(self.task, self.options, 1)
        observations, self.action_space = single_spaces(self.task, self.options.operator_features)
        self.observation_space = cast("gymnasium.Space[NDArray[np.float32]]", observations)

    @property
    def step_listeners(self) -> list[Listener]:
        """Functions called after every grid step with the state and row 0: append your own."""
        return self._environments.transitions.listeners

    @property
    def state(self) -> GridState:
        """The grid after the last step, in physical units: row 0 of each array. To be looked at, not written to."""
        return self._environments.state

    @property
    def engine(self) -> Engine:
        """What simulates the grid, in row 0. To be looked at, not written to."""
        return self._environments.engine

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode and play to its first decision.

        Raises:
            UsageError: an option is unknown, or names a scenario or start that does not exist.
        """
        super().reset(seed=seed)
        self._last_action = None
        self._environments.begin(0, seed, options)
        return self._observation(), self._environments.info(0)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Play the agent's action and the heuristic steps to the next decision.

        Raises:
            UsageError: the action has the wrong shape or value, or the episode is over.
        """
        played = self._environments
        played.play(0, action)
        if self.render_mode is not None:
            self._last_action = copy.deepcopy(action)
        ended = bool(played.state.terminated[0]), bool(played.state.truncated[0])
        return self._observation(), played.reward(0), *ended, played.info(0)

    def restore(self, world: World) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Go on from where ``world`` was saved: what follows is what followed there, bit for bit.

        Returns:
            The observation, float32 [feature], and the info of that moment.

        Raises:
            UsageError: the world is of another task, of other keywords or of an engine alone, or its series is not to
                be had.
        """
        self._environments.restore(0, world)
        self._last_action = None
        return self._observation(), self._environments.info(0)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_renderer": None}  # made again when it is needed

    def render(self) -> NDArray[np.uint8]:  # type: ignore[override]
        """The grid and what the agent did last as a picture, uint8 [720, 1280, 3].

        Raises:
            UsageError: the environment was not made with ``render_mode="rgb_array"`` or not reset yet, or Matplotlib
                is not installed.
        """
        if self.render_mode is None:
            raise UsageError('There is nothing to render to: make the environment with render_mode="rgb_array".')
        # Imported here: playing needs no Matplotlib.
        try:
            from rl2grid.drawing import episode_frames, grid_drawing
        except ImportError as error:
            raise UsageError(
                f"Rendering needs {error.name}: install it with `pip install rl2grid[analysis]`."
            ) from None
        if self._renderer is None:
            self._renderer = grid_drawing.FrameRenderer(self.grid)
        action = "" if self._last_action is None else self.describe_action(self._last_action)
        clock = self.clock_at(int(self.state.step[0]))
        caption = episode_frames.caption_of(self.grid, self.state, 0, clock, action)
        return self._renderer.frame(episode_frames.scene_of(self.grid, self.state, 0), caption)

    def close(self) -> None:
        """Free the simulator; nothing can be asked of the environment any more."""
        self._environments.close()
        self._environments = closed()

    def _observation(self) -> NDArray[np.float32]:
        observation = np.zeros(self.observation_space.shape or (), np.float32)
        self._environments.write_observation(0, observation)
        return observation
