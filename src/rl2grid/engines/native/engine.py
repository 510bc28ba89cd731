"""The native engine: Grid2Op's step, compiled; see :class:`rl2grid.engines.base.Engine`."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from rl2grid.arrays import I64
from rl2grid.engines import DISPATCHES
from rl2grid.engines.native.beginning import Draws, begin_episodes, draw_months
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
from rl2grid.engines.native.environments import SEPARATE, Environments, new_environments
from rl2grid.engines.native.hidden_state import new_hidden_state
from rl2grid.engines.native.imagination import imagined_rows, outlook_of
from rl2grid.engines.native.orders import write_order
from rl2grid.engines.native.playing import Playing, playing_months, playing_named, playing_series
from rl2grid.engines.native.training_library import TrainingLibrary
from rl2grid.engines.native.worlds import RowLayout, restore_row, save_row
from rl2grid.engines.worlds import Home, Outlook, SeriesName, World, grid_fingerprint
from rl2grid.errors import UsageError, one_of
from rl2grid.grids import Grid
from rl2grid.handles import Handle
from rl2grid.mdp.actions import DO_NOTHING, StepAction, check_changes
from rl2grid.mdp.opponents import OpponentDraws, draw_opponent, load_draws
from rl2grid.mdp.state import GridState
from rl2grid.mdp.termination import GameOver
from rl2grid.powerflow.model import Network, load_network
from rl2grid.scenarios.episodes import MAX_STEPS, EpisodePlan, PlannedStarts, planned_outages
from rl2grid.scenarios.library import open_series
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.splits import FIRST_TRAINING_SEED, YEARS_FOR_FIRST
from rl2grid.scenarios.training_years import TrainingMonths
from rl2grid.streams import Purpose, Stream
from rl2grid.structures import with_own_workspace


class NativeEngine:
    """``n`` environments of one grid, simulated without Grid2Op.

    Args:
        grid: the grid.
        n: number of environments.
        dispatch: ``"exact"``, or ``"grid2op"`` with Grid2Op's own problem, start and tolerance in SciPy.
        opponent: whether the grid's opponent attacks.
        network: electrical model; of a grid that no system is registered for; None: that of its system.

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
        self._given_network = network
        self.network = load_network(grid) if network is None else network
        self._opponent = opponent
        self.attacks = opponent and grid.opponent.kind != "none"
        # Of an episode that was begun in compiled code the library, until somebody asks for more.
        self._playing: list[Playing | TrainingLibrary | None] = [None] * n
        # Behind an imagined future: planners come back to it.
        self._true: list[Playing | TrainingLibrary | None] = [None] * n
        self._use(new_environments(grid, self.network, n, self.attacks))
        self._simulated = self._new_simulated()
        # Of threads that play transitions: a question from outside keeps its answer in the one above.
        self._trials: list[Handle[Environments]] = []

    def reset(self, i: int, plan: EpisodePlan) -> None:
        """Begin the episode ``plan`` in environment ``i``."""
        self.prepare(i, plan)
        reset_one(self.address, i)

    def prepare(self, i: int, plan: EpisodePlan) -> None:
        """Hand environment ``i`` the episode ``plan``; its first row is not shown yet."""
        series = open_series(self.grid.id, plan.scenario_id)
        outages = planned_outages(self.grid, series, plan)
        draws = None
        if self.attacks:
            stream = Stream(plan.seed, plan.number, Purpose.OPPONENT)
            draws = draw_opponent(self.grid, stream, plan.n_steps)
        self.begin(i, series, plan.start, plan.n_steps, outages, draws)

    def begin(
        self,
        i: int,
        series: Scenario | TrainingMonths,
        start: int,
        n_steps: int,
        outages: np.ndarray[Any, np.dtype[np.int32]],
        draws: OpponentDraws | None,
    ) -> None:
        """Hand environment ``i`` an episode; nothing is played yet.

        Args:
            i: the environment.
            series: the series.
            start: row of the series that the reset shows.
            n_steps: steps of a completed episode.
            outages: planned outages, int32 [outage, 3]: line, first row, row after the last; by line and row.
            draws: what the opponent does; None: nothing.
        """
        outages = outages - np.array([0, start, start], np.int32)
        outages = outages[outages[:, 2] > 0]
        self._make_room(len(outages))
        hidden, state = self.environments.hidden, self.state
        hidden.outage_line[i, : len(outages)] = outages[:, 0]
        hidden.outage_begin[i, : len(outages)] = outages[:, 1]
        hidden.outage_end[i, : len(outages)] = outages[:, 2]
        hidden.outage_count[i] = len(outages)
        self._playing[i] = self._true[i] = playing = playing_series(series, start)
        playing.begin(hidden, i)
        if draws is not None:
            load_draws(self.environments.opponent, i, draws)
        state.step[i] = 0
        state.episode_length[i] = n_steps
        state.decisions[i] = 0
        state.game_over[i] = int(GameOver.NONE)
        for flags in (state.terminated, state.truncated, state.illegal, state.ambiguous, state.attacked, state.excused):
            flags[i] = False

    def draw_training(self, library: TrainingLibrary, seeds: I64, numbers: I64) -> Draws:
        """Which months of ``library`` the training episodes ``numbers`` of ``seeds`` play; they are there then.

        Raises:
            UsageError: the data folder cannot be written, or has no room for the library.
        """
        draws = Draws(seeds, numbers, *(np.zeros_like(seeds) for _ in Draws._fields[2:]))
        draw_months(np.array(YEARS_FOR_FIRST), draws)
        library.open(draws.year)
        self._make_room(library.most_outages)
        return draws

    def show_training(
        self,
        library: TrainingLibrary,
        thread: int,
        rows: I64,
        draws: Draws,
        maintained: bool,
        n_steps: int = MAX_STEPS,
    ) -> None:
        """Show the first rows of the episodes that were drawn, in ``rows``; threads may show different ones."""
        begin_episodes(self.address_for(thread), library.address, rows, draws, maintained, self.attacks, n_steps)

    def take_training(self, library: TrainingLibrary, rows: I64, draws: Draws) -> PlannedStarts:
        """Note what was begun in ``rows``, and say it."""
        for i in rows.tolist():
            self._playing[i] = self._true[i] = library
        return PlannedStarts(library.scenario_ids[draws.year, draws.month], draws.start, draws.redraws)

    def step(self, i: int, action: StepAction) -> None:
        """Play one grid step of environment ``i``."""
        check_changes(self.grid, action.changes)
        write_order(self.environments.orders, i, action)
        if self.dispatch == "exact":
            step_one(self.address, i)
            return
        if begin_one(self.address, i, False) and not self._dispatch_like_grid2op(self.environments, i):
            lose_one(self.address, i)
            return
        finish_one(self.address, i)

    def simulate(self, i: int, action: StepAction, horizon: int) -> GridState:
        """One step on the forecast; what it does is described in ``docs/simulate.md``."""
        if self._begin_simulation(i, action, horizon):
            finish_simulation_one(self._simulated.address)
        return self._simulated.structure.state

    def foresee(self, i: int, horizon: int) -> Handle[Environments] | None:
        """What :meth:`simulate` hands to the power flow when nobody acts.

        Returns:
            The handle of environments whose row 0 holds topology, cooldowns and injections, until the next call or
            simulation; None if the generators cannot follow the forecast.

        Raises:
            UsageError: after a game over, or without such a forecast.
        """
        if not self._begin_simulation(i, DO_NOTHING, horizon):
            return None
        set_generators_one(self._simulated.address, 0)
        return self._simulated

    def close(self) -> None:
        """Let go of the series."""
        self._playing = [None] * len(self._playing)
        self._true = [None] * len(self._true)

    def save(self, i: int) -> World:
        """Everything of environment ``i`` at this moment.

        Raises:
            UsageError: it was not reset yet.
        """
        playing = self._series_of(i)
        layout, n_outages = self._layout, int(self.environments.hidden.outage_count[i])
        rows = layout.room(n_outages)
        save_row(layout.table, layout.outages, n_outages, i, rows)
        return World(self.home, rows, playing.name, nearby=playing.reference)

    def restore(self, i: int, world: World) -> None:
        """Bring environment ``i`` to where ``world`` was saved: what follows is what followed there, bit for bit.

        Raises:
            UsageError: the world is of another grid or of an engine made otherwise, or its series is not to be had.
        """
        if world.home is not self.home:
            world.check_home(self.home)
        playing = None if world.nearby is None else world.nearby()
        if playing is None:
            playing = playing_named(self.grid, world.series)
        n_outages = self._layout.n_outages(world.rows)
        self._make_room(n_outages)
        layout = self._layout
        restore_row(layout.table, layout.outages, n_outages, i, world.rows)
        playing.go_on(self.environments.hidden, i)
        self._playing[i] = playing
        if not world.imagined:
            self._true[i] = playing

    def imagine(self, i: int, seed: int) -> World:
        """A world that goes on from here as far as an operator may know; see ``docs/worlds.md``.

        Args:
            i: the environment, which stays where it is.
            seed: of the opponent's draws.

        Raises:
            UsageError: there is no episode in progress.
        """
        outlook = self.outlook(i)
        rows = imagined_rows(self.grid, self._layout, self.environments.opponent, self.save(i).rows, seed)
        return World(self.home, rows, outlook)

    def outlook(self, i: int) -> Outlook:
        """The forecasts of environment ``i``; in an imagined world those that it was imagined with.

        Raises:
            UsageError: there is no episode in progress.
        """
        playing, state = self._series_of(i), self.state
        if state.terminated[i] or state.truncated[i]:
            raise UsageError("Nothing can be imagined after the end of an episode: reset the environment first.")
        name, source = playing.name, playing.source
        if isinstance(source, Outlook):
            return source
        assert isinstance(name, SeriesName)
        gen_v = self.environments.hidden.gen_v[i]
        return outlook_of(source, name.start, int(state.step[i]), self.network, gen_v)

    def __deepcopy__(self, memo: dict[int, Any]) -> NativeEngine:
        """An engine of its own, whose environments are where these are; grid and series are shared."""
        rebuild, arguments = self.__reduce__()
        copied: NativeEngine = rebuild(*arguments)
        return copied

    def __reduce__(self) -> tuple[Any, ...]:
        made = self.grid, len(self._playing), self.dispatch, self._opponent, self._given_network
        return _rebuild, (*made, self._save_all())

    def _save_all(self) -> list[World | None]:
        """The worlds of all environments; None: it was not reset yet."""
        return [None if playing is None else self.save(i) for i, playing in enumerate(self._playing)]

    def _restore_all(self, worlds: list[World | None]) -> None:
        for i, world in enumerate(worlds):
            if world is not None:
                self.restore(i, world)

    def _series_of(self, i: int) -> Playing:
        playing = self._playing[i]
        if playing is None:
            raise UsageError("The environment was not reset yet: call reset first.")
        if isinstance(playing, Playing):
            return playing
        hidden = self.environments.hidden
        months = playing.months(int(hidden.year[i]) - FIRST_TRAINING_SEED, int(hidden.month[i]))
        opened = self._playing[i] = self._true[i] = playing_months(months, int(hidden.month_row[i]))
        return opened

    @property
    def address(self) -> int:
        """Where compiled code finds the environments, for one thread at a time; see :meth:`address_for`."""
        return self.address_for(0)

    def address_for(self, thread: int) -> int:
        """The same environments with a workspace for thread ``thread``: threads may then play different rows."""
        _make_ready()
        while len(self._handles) <= thread:
            flow = with_own_workspace(self.environments.flow)
            lanes = with_own_workspace(self.environments.lanes)
            union = with_own_workspace(self.environments.union)
            self._handles.append(Handle(self.environments._replace(flow=flow, lanes=lanes, union=union)))
        return self._handles[thread].address

    def trial_address_for(self, thread: int) -> int:
        """An environment in which the heuristic that thread ``thread`` plays may try what it thinks of."""
        while len(self._trials) <= thread:
            self._trials.append(self._new_simulated())
        return self._trials[thread].address

    def _new_simulated(self) -> Handle[Environments]:
        """One environment, which is brought to where another is and played on the forecast."""
        return Handle(new_environments(self.grid, self.network, 1, opponent=False))

    def _use(self, environments: Environments) -> None:
        self.environments = environments
        self.state = environments.state
        self._handles = [Handle(environments)]
        self._layout = RowLayout(environments)
        fingerprint = grid_fingerprint(self.grid)
        self.home = Home("native", self.grid.id, fingerprint, self.dispatch, self.attacks, self._layout.hash)

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

    def check_horizon(self, i: int, horizon: int) -> None:
        """Refuse a question about steps that are not forecast.

        Raises:
            UsageError: the series of environment ``i`` has no forecast so far ahead.
        """
        if horizon > self.environments.hidden.horizons[i]:
            name = self._series_of(i).name
            raise UsageError(f"Scenario {name.scenario_id!r} has no forecast {horizon} steps ahead.")

    def _begin_simulation(self, i: int, action: StepAction, horizon: int) -> bool:
        """Play a step on the forecast up to the setting of the generators; False if they cannot be dispatched."""
        playing = self._playing[i]
        if self.state.terminated[i] or playing is None:
            raise UsageError("Nothing can be simulated after a game over: reset the environment first.")
        self.check_horizon(i, horizon)
        check_changes(self.grid, action.changes)
        self._copy_row(i)
        write_order(self._simulated.structure.orders, 0, action)
        exact, simulated, real = self.dispatch == "exact", self._simulated.address, self.address
        needed = begin_simulation_one(simulated, real, i, horizon, exact)
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


@functools.cache
def _make_ready() -> None:
    """Compile, or load, what compiled code calls by address: before it does, in a call that can be interrupted."""
    for function in SEPARATE:
        function.ready()


def _rebuild(
    grid: Grid, n: int, dispatch: str, opponent: bool, network: Network | None, worlds: list[World | None]
) -> NativeEngine:
    """The engine that was pickled."""
    engine = NativeEngine(grid, n, dispatch, opponent, network)
    engine._restore_all(worlds)
    return engine
