"""The reference engine: Grid2Op with the LightSim2Grid power flow, slow and trusted.

Grid2Op plays the steps. We replace its file reading (:mod:`.chronics`), its opponent's random draws
(:mod:`.opponent`) and, with ``dispatch="exact"``, its redispatch solver (:mod:`.dispatch`).
"""

from __future__ import annotations

import os
import warnings
import weakref
from collections.abc import Iterable
from typing import Any

import numpy as np

from rl2grid.engines import DISPATCHES
from rl2grid.engines.worlds import History, Home, SeriesName, World, grid_fingerprint, other_values
from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid, find_system
from rl2grid.mdp.actions import ActionKind, Change, StepAction, check_changes, decode_continuous, moved_elements
from rl2grid.mdp.opponents import draw_opponent, load_draws, new_opponent_state
from rl2grid.mdp.state import OBSERVED, OBSERVED_STORAGE, GridState, new_state
from rl2grid.mdp.termination import GameOver, game_over_reason
from rl2grid.powerflow.model import load_network
from rl2grid.scenarios.episodes import EpisodePlan, maintenance_matrix
from rl2grid.scenarios.library import list_scenarios, load_scenario
from rl2grid.streams import Purpose, Stream

# Grid2Op's redispatch solver slows down sixfold on contended BLAS threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import grid2op
from grid2op.Action import PlayableAction
from grid2op.Exceptions import Grid2OpException, ImpossibleRedispatching, NoForecastAvailable
from grid2op.Observation import CompleteObservation
from grid2op.Reward import ConstantReward
from lightsim2grid import LightSimBackend

from rl2grid.engines.reference.chronics import ScenarioChronics
from rl2grid.engines.reference.dispatch import ExactRedispatchSolver, redispatch_is_impossible
from rl2grid.engines.reference.opponent import install_opponent

_LAYOUT = ",".join(GridState._fields)
"""What is saved of an environment beside its history."""


class ReferenceEngine:
    """``n`` Grid2Op environments of one grid; see :class:`rl2grid.engines.base.Engine`."""

    def __init__(self, grid: Grid, n: int, dispatch: str = "exact", opponent: bool = True) -> None:
        if dispatch not in DISPATCHES:
            raise one_of("Dispatch", dispatch, DISPATCHES)
        self.grid = grid
        self.state = new_state(grid, n)
        self._simulated = new_state(grid, 1)
        self._dispatch = dispatch
        self.network = load_network(grid)
        self.attacks = opponent and grid.opponent.kind != "none"
        self._plans: list[EpisodePlan | None] = [None] * n
        self._actions: list[list[StepAction]] = [[] for _ in range(n)]
        self._home = Home("reference", grid.id, grid_fingerprint(grid), dispatch, self.attacks, _LAYOUT)
        self._opponent = new_opponent_state(grid, n) if self.attacks else None
        self._environments = self._make_environments(n)
        # Closed before the garbage collector comes to them: Grid2Op's finalizers fail where it comes to a part first.
        self._closing = weakref.finalize(self, _close, self._environments)
        self._closing.atexit = False
        self._do_nothing = [environment.action_space() for environment in self._environments]
        self._observations: list[Any] = [None] * n
        self._observed = (*OBSERVED, *OBSERVED_STORAGE) if grid.n_storage else OBSERVED

    def reset(self, i: int, plan: EpisodePlan) -> None:
        """Begin the episode ``plan`` in environment ``i``."""
        self._plans[i], self._actions[i] = plan, []
        environment = self._environments[i]
        scenario = load_scenario(self.grid.id, plan.scenario_id)
        maintenance = maintenance_matrix(self.grid, scenario, plan)
        environment.chronics_handler.real_data.play(scenario, plan.start, plan.n_steps, maintenance)
        if self._opponent is not None:
            stream = Stream(plan.seed, plan.number, Purpose.OPPONENT)
            load_draws(self._opponent, i, draw_opponent(self.grid, stream, plan.n_steps))
        self._clear_flags(i, plan)
        try:
            self._observations[i] = environment.reset()
        except Grid2OpException as error:
            # Row 0 collapses; the exception holds what Grid2Op's step knew.
            self._read_game_over(self.state, i, environment, [error])
            return
        self._read(self.state, i, self._observations[i])

    def step(self, i: int, action: StepAction) -> None:
        """Play one Grid2Op step of environment ``i``."""
        # A copy: the caller may write other values to the array.
        values = None if action.values is None else action.values.copy()
        self._actions[i].append(StepAction(action.changes, values))
        check_changes(self.grid, action.changes)
        state, environment = self.state, self._environments[i]
        impossible = self._is_impossible(i, action)
        observation, _, done, info = environment.step(self._played(i, action, impossible))
        state.step[i] += 1
        state.illegal[i] = info["is_illegal"] or impossible
        state.ambiguous[i] = info["is_ambiguous"]
        self._observations[i] = observation
        if self._opponent is not None:
            state.attacked[i] = self._opponent.attacked[i]
        if done and observation.topo_vect.max() < 0:
            self._read_game_over(state, i, environment, info["exception"])
            return
        self._read(state, i, observation)
        state.truncated[i] = done

    def simulate(self, i: int, action: StepAction, horizon: int) -> GridState:
        """``obs.simulate`` of Grid2Op; what it does is described in ``docs/simulate.md``."""
        check_changes(self.grid, action.changes)
        observation, result = self._observations[i], self._simulated
        if self.state.terminated[i] or observation is None:
            raise UsageError("Nothing can be simulated after a game over: reset the environment first.")
        impossible = self._is_impossible(i, action)
        played = self._played(i, action, impossible)
        try:
            simulated, _, _, info = observation.simulate(played, time_step=horizon)
        except NoForecastAvailable:
            raise UsageError(
                f"Scenario {observation._obs_env.chronics_handler.get_id()!r} has no forecast {horizon} steps ahead."
            ) from None
        _copy_episode(self.state, i, result, horizon)
        result.illegal[0] = info["is_illegal"] or impossible
        result.ambiguous[0] = info["is_ambiguous"]
        if simulated.topo_vect.max() < 0:
            self._read_game_over(result, 0, observation._obs_env, info["exception"])
        else:
            self._read(result, 0, simulated)
        return result

    def grid2op_environment(self, i: int) -> Any:
        """The ``grid2op.Environment`` behind environment ``i``, which is closed with this engine: keep that as well."""
        return self._environments[i]

    def save(self, i: int) -> World:
        """Environment ``i`` at this moment: what was observed and summed up, and how it came there.

        Grid2Op has no way to bring an environment to a given state, so :meth:`restore` plays the episode again.
        """
        plan = self._plans[i]
        if plan is None:
            raise UsageError("The environment was not reset yet: call reset first.")
        scenario = load_scenario(self.grid.id, plan.scenario_id)
        rows = b"".join(array[i].tobytes() for array in self._saved())
        return World(
            self._home,
            np.frombuffer(rows, np.uint8),
            SeriesName(scenario.id, scenario.content_hash, plan.start),
            History(plan, tuple(self._actions[i])),
        )

    def restore(self, i: int, world: World) -> None:
        """Bring environment ``i`` to where ``world`` was saved, by playing its episode again: about 1 ms per grid step.

        Raises:
            UsageError: the world is of another grid or of an engine made otherwise, or its series is not to be had.
        """
        world.check_home(self._home)
        history, series = world.history, world.series
        assert history is not None
        assert isinstance(series, SeriesName)
        if load_scenario(self.grid.id, series.scenario_id).content_hash != series.content_hash:
            raise other_values(self.grid.id, series)
        self.reset(i, history.plan)
        for action in history.actions:
            self.step(i, action)
        # Sums over grid steps and what a heuristic leaves are not the engine's.
        place = 0
        for array in self._saved():
            row = np.frombuffer(world.rows, array.dtype, array[i].size, place)
            array[i] = row.reshape(array.shape[1:])
            place += row.nbytes

    def imagine(self, i: int, seed: int) -> World:
        """Not on this engine.

        Raises:
            UsageError: always.
        """
        raise UsageError('The reference engine cannot imagine: choose engine="native".')

    def __deepcopy__(self, memo: dict[int, Any]) -> ReferenceEngine:
        """An engine of its own, whose environments are where these are."""
        rebuild, arguments = self.__reduce__()
        copied: ReferenceEngine = rebuild(*arguments)
        return copied

    def __reduce__(self) -> tuple[Any, ...]:
        worlds = [None if plan is None else self.save(i) for i, plan in enumerate(self._plans)]
        return _rebuild, (self.grid, self._dispatch, self.attacks, worlds)

    def _saved(self) -> list[np.ndarray[Any, Any]]:
        """The arrays of the state that have an axis of environments."""
        return list(self.state[GridState._fields.index("gen_p") :])

    def close(self) -> None:
        """Close the Grid2Op environments, which happens by itself to an engine that nobody refers to any more."""
        self._closing()

    def _make_environments(self, n: int) -> list[Any]:
        scenario = load_scenario(self.grid.id, list_scenarios(self.grid.id, "bundled")[0])
        first = _make_grid2op(self.grid, scenario, self._dispatch)
        environments = [first, *(first.copy() for _ in range(n - 1))]
        for i, environment in enumerate(environments):
            install_opponent(environment, self.state, self._opponent, i)
        return environments

    def _clear_flags(self, i: int, plan: EpisodePlan) -> None:
        state = self.state
        state.step[i] = 0
        state.episode_length[i] = plan.n_steps
        state.decisions[i] = 0
        state.game_over[i] = int(GameOver.NONE)
        for flags in (state.terminated, state.truncated, state.illegal, state.ambiguous, state.attacked, state.excused):
            flags[i] = False

    def _read(self, state: GridState, i: int, observation: Any) -> None:
        for name in self._observed:
            getattr(state, name)[i] = getattr(observation, name)

    def _read_game_over(self, state: GridState, i: int, environment: Any, errors: list[Exception]) -> None:
        """Note why the episode ended, then blank the row as Grid2Op blanks its last observation."""
        state.terminated[i] = True
        state.final_topo_vect[i] = environment.backend.topo_vect
        if self.grid.n_storage:
            state.storage_power[i] = environment._storage_power
        if any(isinstance(error, ImpossibleRedispatching) for error in errors):
            state.game_over[i] = int(GameOver.DISPATCH)
            state.attacked[i] = False  # the opponent's turn never came
        else:
            state.game_over[i] = game_over_reason(state, i)
        for name in (*OBSERVED, *OBSERVED_STORAGE):
            getattr(state, name)[i] = 0
        state.topo_vect[i] = -1
        state.time_next_maintenance[i] = -1
        state.curtailment_limit[i] = 1

    def _is_impossible(self, i: int, action: StepAction) -> bool:
        """Whether the redispatch of an action can never be carried out, which makes it illegal."""
        if action.values is not None and not self._is_ambiguous(i, action):
            request = decode_continuous(self.grid, action.values).redispatch
        else:
            # A refused request may leave a target out of reach by a rounding error: Grid2Op then refuses "nothing" too.
            request = np.zeros(self.grid.n_gen, np.float32)
        environment = self._environments[i]
        return redispatch_is_impossible(
            request,
            environment._target_dispatch,
            environment._actual_dispatch,
            environment._already_modified_gen,
            self.grid.gen_pmin,
            self.grid.gen_pmax,
        )

    def _is_ambiguous(self, i: int, action: StepAction) -> bool:
        """Whether Grid2Op drops the whole action, its redispatch included, before it looks at the rules."""
        return len(action.changes) > 1 and bool(self._grid2op_action(i, action).is_ambiguous()[0])

    def _played(self, i: int, action: StepAction, impossible: bool) -> Any:
        """The Grid2Op action: under ``dispatch="exact"`` nothing is kept of an impossible one, Grid2Op keeps parts."""
        if impossible and self._dispatch == "exact":
            return self._do_nothing[i]
        return self._grid2op_action(i, action)

    def _grid2op_action(self, i: int, action: StepAction) -> Any:
        """A fresh Grid2Op action of all parts: Grid2Op caches its verdict of ambiguity on the object."""
        if not action.changes and action.values is None:
            return self._do_nothing[i]
        result = self._environments[i].action_space()
        self._add_moves(result, [change for change in action.changes if change.kind == ActionKind.MOVE])
        switched = [change.target for change in action.changes if change.kind == ActionKind.SWITCH]
        if switched:
            result.line_change_status = switched
        closed = [(change.target, 1) for change in action.changes if change.kind == ActionKind.RECONNECT]
        if closed:
            result.line_set_status = closed
        self._add_restorations(
            result, i, [change.target for change in action.changes if change.kind == ActionKind.RESTORE]
        )
        if action.values is not None:
            injection = decode_continuous(self.grid, action.values)
            if injection.redispatch.any():
                result.redispatch = injection.redispatch
            if injection.storage.any():
                result.storage_p = injection.storage
            result.curtail = injection.curtailment_limit
        return result

    def _add_moves(self, result: Any, moves: list[Change]) -> None:
        if not moves:
            return
        moved = np.zeros(self.grid.dim_topo, np.bool_)
        for change in moves:
            moved[moved_elements(self.grid, change.target, change.mask)] = True
        result.change_bus = moved

    def _add_restorations(self, result: Any, i: int, subs: list[int]) -> None:
        if not subs:
            return
        buses = np.zeros(self.grid.dim_topo, np.int32)
        for sub in subs:
            first = int(self.grid.sub_first_element[sub])
            here = slice(first, first + int(self.grid.sub_info[sub]))
            buses[here] = np.where(self.state.topo_vect[i, here] == 2, 1, 0)
        result.set_bus = buses


def _rebuild(grid: Grid, dispatch: str, opponent: bool, worlds: list[World | None]) -> ReferenceEngine:
    """The engine that was pickled."""
    engine = ReferenceEngine(grid, len(worlds), dispatch, opponent)
    for i, world in enumerate(worlds):
        if world is not None:
            engine.restore(i, world)
    return engine


def _close(environments: Iterable[Any]) -> None:
    for environment in environments:
        environment.close()


def _make_grid2op(grid: Grid, scenario: Any, dispatch: str) -> Any:
    folder = find_system(grid.id).environment
    if folder is None:
        raise UsageError(f'The system {grid.id} names no Grid2Op environment: play it with engine="native".')
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return grid2op.make(
            str(folder),
            backend=LightSimBackend(),
            action_class=PlayableAction,
            observation_class=CompleteObservation,
            reward_class=ConstantReward,
            other_rewards={},
            chronics_class=ScenarioChronics,
            data_feeding_kwargs={"scenario": scenario, "n_line": grid.n_line},
            redispatch_solver=ExactRedispatchSolver if dispatch == "exact" else None,
        )


def _copy_episode(state: GridState, i: int, result: GridState, horizon: int) -> None:
    """What a simulated step takes over from the real episode."""
    result.step[0] = state.step[i] + horizon
    result.episode_length[0] = state.episode_length[i]
    result.game_over[0] = int(GameOver.NONE)
    result.terminated[0] = False
    result.truncated[0] = False
    result.attacked[0] = state.attacked[i]
    result.attacked_at[0] = state.attacked_at[i]
    result.excused[0] = state.excused[i]
