"""Training episodes begun in compiled code: months of the library, a row to start in, planned outages, attacks.

What an episode is, is what :func:`rl2grid.scenarios.episodes.plan_episode` plans of the same seed and number, the
engine's ``prepare`` hands over and its reset shows; there each step takes longer than the power flow.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import I32, I64
from rl2grid.compile import jit, owning_jit
from rl2grid.engines.native.environments import Environments, open_environments, separate
from rl2grid.engines.native.hidden_state import LOAD_P, LOAD_Q, PROD_P, PROD_V
from rl2grid.engines.native.series import read_row
from rl2grid.engines.native.side_by_side import reset_side_by_side
from rl2grid.engines.native.step import reset_row
from rl2grid.handles import opener
from rl2grid.mdp.opponents import draw_attacks
from rl2grid.mdp.termination import GameOver
from rl2grid.philox import fill_uniforms, stream_key
from rl2grid.powerflow.ac import CONVERGED, forget_flow, run_flow, write_currents
from rl2grid.scenarios.episodes import MAX_REDRAWS, MAX_STEPS
from rl2grid.scenarios.generator.calendar import MONTH_STEPS
from rl2grid.scenarios.month_names import MONTHS
from rl2grid.scenarios.outage_draws import OutageModel, draw_outages
from rl2grid.scenarios.splits import FIRST_TRAINING_SEED, TRAINING_YEARS
from rl2grid.streams import Purpose
from rl2grid.structures import constant

_MONTHS_IN_A_ROW = 2
_ENDLESS = 2**31 - 1
_FIRST_SEED = FIRST_TRAINING_SEED
_NOT_OVER = int(GameOver.NONE)
_SCENARIO, _START = int(Purpose.SCENARIO), int(Purpose.START)
_MAINTENANCE, _OPPONENT = int(Purpose.MAINTENANCE), int(Purpose.OPPONENT)


class Library(NamedTuple):
    """Where the years lie of which training plays the months, and how their outages are sampled."""

    address: Annotated[I64, constant("year 3", "of the first row (LOAD_P, LOAD_Q, PROD_P); 0: not opened yet")]
    voltage: Annotated[I64, constant("1", "address of the set-points of all rows; 0: those of the grid file hold")]
    forecast: Annotated[I64, constant("1", "address of the handle to the ForecastModel")]
    horizon: Annotated[I32, constant("1", "that each row forecasts", "steps")]
    outages: OutageModel


_open_library = opener(Library)


class Draws(NamedTuple):
    """What is drawn of episodes that begin, one entry each; int64 [k]."""

    seed: I64
    number: I64
    """Episodes of the seed before."""
    year: I64
    """Of the library, 0 for the first."""
    month: I64
    """The first of two, 0 .. 10."""
    start: I64
    """Row of the months in which the episode starts."""
    redraws: I64
    """Rows that were drawn as the start before, and overload a line with nothing done."""


@jit
def draw_months(few: I64, draws: Draws) -> None:
    """Draw the year and the month of each episode: :func:`rl2grid.scenarios.splits.draw_training_months`.

    Args:
        few: from how many years each of the first episodes of a seed is drawn.
        draws: seeds and numbers; years and months are written.
    """
    numbers = np.empty(2)
    for k in range(draws.seed.size):
        number = draws.number[k]
        fill_uniforms(draws.seed[k], stream_key(number, _SCENARIO), 0, numbers)
        draws.year[k] = int(numbers[0] * (few[number] if number < few.size else TRAINING_YEARS))
        draws.month[k] = int(numbers[1] * (MONTHS - 1))


@jit
def begin_episodes(
    address: int, library: int, rows: I64, draws: Draws, maintained: bool, attacked: bool, n_steps: int
) -> None:
    """Show the first row of a training episode in each of ``rows``.

    Args:
        address: of the handle to the environments, with room for the outages of any sample.
        library: of the handle to the :class:`Library`, whose years are open.
        rows: environments, int64 [k].
        draws: what begins there.
        maintained: whether planned outages happen.
        attacked: whether the grid's opponent attacks.
        n_steps: of a completed episode, at most :data:`~rl2grid.scenarios.episodes.MAX_STEPS`.
    """
    environments, years = open_environments(address), _open_library(library)
    for k in range(rows.shape[0]):
        _hand_out(environments, rows[k], n_steps)
        if attacked:
            key = stream_key(draws.number[k], _OPPONENT)
            draw_attacks(environments.opponent, rows[k], draws.seed[k], key, n_steps)
    _find_starts(environments, years, rows, draws, maintained)


@jit
def _hand_out(environments: Environments, i: int, n_steps: int) -> None:
    """An episode in row ``i`` of which nothing was played."""
    state = environments.state
    state.step[i] = 0
    state.episode_length[i] = n_steps
    state.decisions[i] = 0
    state.truncated[i] = False
    state.illegal[i] = False
    state.ambiguous[i] = False
    state.attacked[i] = False
    state.excused[i] = False


@jit
def _find_starts(environments: Environments, years: Library, rows: I64, draws: Draws, maintained: bool) -> None:
    """Draw a start for each of ``rows`` until nothing done overloads no line, and show it."""
    waiting, shown, status = np.arange(rows.shape[0]), np.empty_like(rows), np.empty_like(rows)
    draws.redraws[:] = 0
    n = rows.shape[0]
    while n > 0:
        for place in range(n):
            k = waiting[place]
            shown[place], draws.start[k] = rows[k], _draw_start(draws, k)
            _point_at(environments, years, rows[k], k, draws, maintained)
        reset_side_by_side(environments, shown, n, status)
        n_shown, n = n, 0
        for place in range(n_shown):
            k = waiting[place]
            if draws.redraws[k] < MAX_REDRAWS and not _is_secure(environments, rows[k]):
                draws.redraws[k] += 1
                waiting[n] = k
                n += 1


@jit
def _draw_start(draws: Draws, k: int) -> int:
    """The next row in which episode ``k`` may start: the first one of all where too many were in vain."""
    if draws.redraws[k] == MAX_REDRAWS:
        return 0
    numbers = np.empty(1)
    fill_uniforms(draws.seed[k], stream_key(draws.number[k], _START), draws.redraws[k], numbers)
    return int(numbers[0] * MAX_STEPS)


@jit
def _point_at(environments: Environments, years: Library, i: int, k: int, draws: Draws, maintained: bool) -> None:
    """Point row ``i`` at the start of the months drawn, to be reset."""
    state, hidden = environments.state, environments.hidden
    year, month, start = draws.year[k], draws.month[k], draws.start[k]
    place = month * MONTH_STEPS + start
    for column in (LOAD_P, LOAD_Q, PROD_P):
        width = hidden.new_p.shape[1] if column == PROD_P else hidden.load_p.shape[1]
        hidden.series[i, column] = years.address[year, column] + 2 * place * width
    hidden.series[i, PROD_V] = years.voltage[0]
    hidden.forecast[i] = 0
    hidden.forecast[i, LOAD_P] = years.forecast[0]
    hidden.horizons[i] = years.horizon[0]
    hidden.last_row[i] = _ENDLESS
    hidden.year[i] = _FIRST_SEED + year
    hidden.month[i] = month
    hidden.n_months[i] = _MONTHS_IN_A_ROW
    hidden.month_row[i] = start
    hidden.outage_count[i] = 0
    if maintained:
        hidden.outage_count[i] = draw_outages(
            years.outages,
            month,
            draws.seed[k],
            stream_key(draws.number[k], _MAINTENANCE),
            start,
            hidden.outage_line[i],
            hidden.outage_begin[i],
            hidden.outage_end[i],
        )
    state.terminated[i] = False
    state.game_over[i] = _NOT_OVER


@jit
def _is_secure(environments: Environments, i: int) -> bool:
    """Whether no line is overloaded in the row shown, in the reference topology with everything in service."""
    state, hidden = environments.state, environments.hidden
    for k in range(hidden.outage_count[i]):
        if hidden.outage_begin[i, k] <= 0:
            return bool(_is_secure_in_service(environments, i))
    if state.terminated[i]:
        return False
    overloaded = 0
    for line in range(state.rho.shape[1]):
        overloaded += hidden.tripped[i, line] or state.rho[i, line] > 1
    return overloaded == 0


@separate
def _is_secure_in_service(environments: Environments, i: int) -> int:
    """:func:`_is_secure` where an outage is under way: by a flow of its own, after which the row is shown again."""
    network, hidden, flow = environments.network, environments.hidden, environments.flow
    read_row(environments, i, 0)
    forget_flow(flow, i)
    topology = np.ones(environments.state.topo_vect.shape[1], np.int32)
    storage = np.zeros(environments.state.storage_power.shape[1], np.float32)
    status = run_flow(
        network, flow, i, topology, hidden.new_p[i], hidden.gen_v[i], hidden.load_p[i], hidden.load_q[i], storage
    )
    secure = status == CONVERGED and _largest_loading(environments, i) <= 1
    environments.state.terminated[i] = False
    environments.state.game_over[i] = _NOT_OVER
    reset_row(environments, i)
    return secure


@owning_jit
def _largest_loading(environments: Environments, i: int) -> float:
    limit = environments.state.thermal_limit
    current = np.empty(limit.size, np.float32)
    write_currents(environments.network, environments.flow, i, current)
    largest = np.float32(0.0)
    for line in range(limit.size):
        largest = max(largest, current[line] / limit[line])
    return float(largest)
