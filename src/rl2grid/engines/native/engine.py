"""The native engine: Grid2Op's step, compiled; see :class:`rl2grid.engines.base.Engine`."""

from __future__ import annotations

from typing import Any

import numpy as np

from rl2grid.arrays import F32
from rl2grid.engines import DISPATCHES
from rl2grid.engines.native.entry import (
    begin_one,
    begin_simulation_one,
    copy_one,
    dispatch_one,
    finish_one,
    finish_simulation_one,
    lose_one,
    reset_one,
    set_generators_one,
    step_one,
)
from rl2grid.engines.native.environments import Environments, new_environments
from rl2grid.engines.native.hidden_state import LOAD_P, LOAD_Q, PROD_P, PROD_V, HiddenState, new_hidden_state
from rl2grid.engines.native.series import outages_of
from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid
from rl2grid.handles import Handle
from rl2grid.mdp.actions import DO_NOTHING, ActionKind, StepAction
from rl2grid.mdp.opponents import OpponentDraws, draw_opponent, load_draws
from rl2grid.mdp.state import GridState
from rl2grid.mdp.termination import GameOver
from rl2grid.powerflow.model import Network, load_network
from rl2grid.scenarios.episodes import EpisodePlan, maintenance_matrix
from rl2grid.scenarios.library import load_scenario
from rl2grid.scenarios.scenario import Scenario
from rl2grid.streams import Purpose, Stream
from rl2grid.structures import with_own_workspace

_NO_VALUES = np.zeros(0, np.float32)


class NativeEngine:
    """``n`` environments of one grid, simulated without Grid2Op.

    Args:
        grid: the grid.
        n: number of environments.
        dispatch: ``"exact"``, or ``"grid2op"`` with Grid2Op's own problem, start and tolerance in SciPy.
        opponent: whether the grid's opponent attacks.
        network: electrical model; that of ``grid`` if left out, which must then be one of the seven.

    Raises:
        UsageError: there is no such dispatch.
    """

    def __init__(
        self,
        grid: Grid,
        n: int,
        dispatch: str = "exact",
        opponent: bool = True,
        network: Network | None = None,
    ) -> None:
        if dispatch not in DISPATCHES:
            raise one_of("Dispatch", dispatch, DISPATCHES)
        self.grid = grid
        self.dispatch = dispatch
        self._network = load_network(grid) if network is None else network
        self._attacks = opponent and grid.opponent.kind != "none"
        self._scenarios: list[Scenario | None] = [None] * n
        self._use(new_environments(grid, self._network, n, self._attacks))
        self._simulated = Handle(new_environments(grid, self._network, 1, opponent=False))

    def reset(self, i: int, plan: EpisodePlan) -> None:
        """Begin the episode ``plan`` in environment ``i``."""
        self.prepare(i, plan)
        reset_one(self.address, i)

    def prepare(self, i: int, plan: EpisodePlan) -> None:
        """Hand environment ``i`` the episode ``plan``; its first row is not shown yet."""
        scenario = load_scenario(self.grid.id, plan.scenario_id)
        outages = outages_of(maintenance_matrix(self.grid, scenario, plan))
        draws = None
        if self._attacks:
            stream = Stream(plan.seed, plan.number, Purpose.OPPONENT)
            draws = draw_opponent(self.grid, stream, plan.n_steps)
        self.begin(i, scenario, plan.start, plan.n_steps, outages, draws)

    def begin(
        self,
        i: int,
        scenario: Scenario,
        start: int,
        n_steps: int,
        outages: np.ndarray[Any, np.dtype[np.int32]],
        draws: OpponentDraws | None,
    ) -> None:
        """Hand environment ``i`` an episode; nothing is played yet.

        Args:
            i: the environment.
            scenario: the series.
            start: row of the series that the reset shows.
            n_steps: steps of a completed episode.
            outages: planned outages, int32 [outage, 3]: line, first row, row after the last; by line and row.
            draws: what the opponent does; None: nothing.
        """
        self._scenarios[i] = scenario  # keeps the series alive, of which compiled code knows the address only
        outages = outages - np.array([0, start, start], np.int32)
        outages = outages[outages[:, 2] > 0]
        self._make_room(len(outages))
        hidden, state = self.environments.hidden, self.state
        hidden.outage_line[i, : len(outages)] = outages[:, 0]
        hidden.outage_begin[i, : len(outages)] = outages[:, 1]
        hidden.outage_end[i, : len(outages)] = outages[:, 2]
        hidden.outage_count[i] = len(outages)
        _point_at_series(hidden, i, scenario, start)
        if draws is not None:
            load_draws(self.environments.opponent, i, draws)
        state.step[i] = 0
        state.episode_length[i] = n_steps
        state.decisions[i] = 0
        state.game_over[i] = int(GameOver.NONE)
        for flags in (state.terminated, state.truncated, state.illegal, state.ambiguous, state.attacked, state.excused):
            flags[i] = False

    def step(self, i: int, action: StepAction) -> None:
        """Play one grid step of environment ``i``."""
        command = _command(action)
        if self.dispatch == "exact":
            step_one(self.address, i, *command)
            return
        if begin_one(self.address, i, *command, False) and not self._dispatch_like_grid2op(self.environments, i):
            lose_one(self.address, i)
            return
        finish_one(self.address, i)

    def simulate(self, i: int, action: StepAction, horizon: int) -> GridState:
        """One step on the forecast; what it does is described in ``docs/simulate.md``."""
        if self._begin_simulation(i, action, horizon):
            finish_simulation_one(self._simulated.address)
        return self._simulated.structure.state

    def foresee(self, i: int, horizon: int) -> Environments | None:
        """What :meth:`simulate` hands to the power flow when nobody acts.

        Returns:
            Environments whose row 0 holds topology, cooldowns and injections, until the next call or simulation; None
            if the generators cannot follow the forecast.

        Raises:
            UsageError: after a game over, or without such a forecast.
        """
        if not self._begin_simulation(i, DO_NOTHING, horizon):
            return None
        set_generators_one(self._simulated.address, 0)
        return self._simulated.structure

    def close(self) -> None:
        """Let go of the series."""
        self._scenarios = [None] * len(self._scenarios)

    @property
    def address(self) -> int:
        """Where compiled code finds the environments, for one thread at a time; see :meth:`address_for`."""
        return self._handles[0].address

    def address_for(self, thread: int) -> int:
        """The same environments with a workspace for thread ``thread``: threads may then play different rows."""
        while len(self._handles) <= thread:
            flow = with_own_workspace(self.environments.flow)
            self._handles.append(Handle(self.environments._replace(flow=flow)))
        return self._handles[thread].address

    def _use(self, environments: Environments) -> None:
        self.environments = environments
        self.state = environments.state
        self._handles = [Handle(environments)]

    def _make_room(self, outages: int) -> None:
        """Grow the arrays to hold that many planned outages per environment."""
        hidden = self.environments.hidden
        n, room = hidden.outage_line.shape
        if outages <= room:
            return
        larger = new_hidden_state(self.grid, n, max(outages, 2 * room))
        for name in ("outage_line", "outage_begin", "outage_end"):
            getattr(larger, name)[:, :room] = getattr(hidden, name)
        grown = {name: getattr(larger, name) for name in ("outage_line", "outage_begin", "outage_end")}
        self._use(self.environments._replace(hidden=hidden._replace(**grown)))

    def _begin_simulation(self, i: int, action: StepAction, horizon: int) -> bool:
        """Play a step on the forecast up to the setting of the generators; False if they cannot be dispatched."""
        scenario = self._scenarios[i]
        if self.state.terminated[i] or scenario is None:
            raise UsageError("Nothing can be simulated after a game over: reset the environment first.")
        if scenario.load_p_forecast is None or horizon > scenario.load_p_forecast.shape[1]:
            raise UsageError(f"Scenario {scenario.id!r} has no forecast {horizon} steps ahead.")
        self._copy_row(i)
        exact, simulated, real = self.dispatch == "exact", self._simulated.address, self.address
        needed = begin_simulation_one(simulated, real, i, *_command(action), horizon, exact)
        return not needed or self._find_simulated_dispatch()

    def _copy_row(self, i: int) -> None:
        """Bring the simulated environment to where environment ``i`` is."""
        copy_one(self.address, i, self._simulated.address, 0)
        self._simulated.structure.state.truncated[0] = False

    def _find_simulated_dispatch(self) -> bool:
        """Dispatch the simulated environment, or end its episode."""
        if self.dispatch == "exact":
            return dispatch_one(self._simulated.address, 0)
        if self._dispatch_like_grid2op(self._simulated.structure, 0):
            return True
        lose_one(self._simulated.address, 0)
        return False

    def _dispatch_like_grid2op(self, environments: Environments, i: int) -> bool:
        from rl2grid.engines.grid2op_dispatch import find_dispatch_grid2op

        state, hidden, grid = environments.state, environments.hidden, self.grid
        return find_dispatch_grid2op(
            hidden.new_p[i],
            hidden.setpoint[i],
            state.target_dispatch[i],
            state.actual_dispatch[i],
            hidden.modified[i],
            grid.gen_pmin,
            grid.gen_pmax,
            grid.gen_max_ramp_up,
            grid.gen_max_ramp_down,
            grid.gen_redispatchable,
            float(hidden.storage_change[i]) - float(hidden.curtailment_change[i]),
            state.actual_dispatch[i],
        )


def _command(action: StepAction) -> tuple[int, int, int, F32]:
    values = action.values
    if values is None:
        # INJECTION without values asks for nothing.
        kind = int(ActionKind.NOTHING) if action.kind == ActionKind.INJECTION else action.kind
        return kind, action.target, action.mask, _NO_VALUES
    return action.kind, action.target, action.mask, values


def _point_at_series(hidden: HiddenState, i: int, scenario: Scenario, start: int) -> None:
    series = ((LOAD_P, "load_p"), (LOAD_Q, "load_q"), (PROD_P, "prod_p"), (PROD_V, "prod_v"))
    for column, name in series:
        hidden.series[i, column] = _address(getattr(scenario, name), start)
        hidden.forecast[i, column] = _address(getattr(scenario, f"{name}_forecast"), start)
    hidden.horizons[i] = 0 if scenario.load_p_forecast is None else scenario.load_p_forecast.shape[1]


def _address(array: F32 | None, row: int) -> int:
    """Address of a row of a series, 0 if there is none."""
    if array is None:
        return 0
    assert array.dtype == np.float32
    assert array.flags.c_contiguous
    return int(array.ctypes.data) + row * array.strides[0]
