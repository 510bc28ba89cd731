"""Imagined worlds: what follows, as far as an operator may know it (``docs/worlds.md``).

Everything that was observed stays. The series are the forecasts made in the present row, then the last of them again
and again; planned outages are those announced in the observation; what nobody can know of the opponent is drawn anew.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.engines.native.worlds import RowLayout
from rl2grid.engines.worlds import Bytes, Outlook
from rl2grid.grids import Grid
from rl2grid.mdp.opponents import OpponentState, imagine_opponent
from rl2grid.powerflow.model import Network
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.training_years import TrainingMonths, forecasts_of
from rl2grid.streams import Purpose, Stream

F32 = NDArray[np.float32]
Views = dict[str, NDArray[Any]]
_WITH_VOLTAGES = ("load_p", "load_q", "prod_p", "prod_v")


def imagined_rows(grid: Grid, layout: RowLayout, opponent: OpponentState, rows: Bytes, seed: int) -> Bytes:
    """The bytes of a world with everything replaced that an operator cannot know.

    Args:
        grid: the grid.
        layout: of the bytes.
        opponent: for its constants.
        rows: of the true world.
        seed: of the opponent's draws.
    """
    lines = np.flatnonzero(layout.view(rows)["state.time_next_maintenance"] >= 0)
    imagined = layout.room(len(lines))
    imagined[: layout.size] = rows[: layout.size]
    views = layout.view(imagined)
    _announce_outages(views, lines)
    _imagine_opponent(grid, opponent, views, seed)
    _follow_outlook(views)
    return imagined


def outlook_of(
    series: Scenario | TrainingMonths, start: int, step: int, network: Network, gen_v: NDArray[np.float64]
) -> Outlook:
    """The forecasts made at ``step``; without any, the present row.

    Args:
        series: what is played.
        start: row of step 0.
        step: the present one.
        network: the electrical model.
        gen_v: present voltage set-points, per unit, float64 [gen]: they hold where none are forecast.
    """
    forecasts = _forecasts_of(series, start + step)
    if len(forecasts) == len(_WITH_VOLTAGES):
        rows, voltages = forecasts[:-1], forecasts[-1]
    else:
        measured = (gen_v * network.nominal_voltage[network.gen_sub]).astype(np.float32)
        rows, voltages = forecasts, np.tile(measured, (len(forecasts[0]), 1))
    # Copies: views would keep the whole series open, and make a pickle of the world carry it.
    return Outlook(series.id, step + 1, *(np.array(array, np.float32) for array in (*rows, voltages)))


def _forecasts_of(series: Scenario | TrainingMonths, row: int) -> tuple[F32, ...]:
    """Demand, reactive demand, production, and voltages where they are forecast, float32 [step, element]."""
    if isinstance(series, TrainingMonths):
        voltage = forecasts_of(series.grid).voltage
        made = series.forecasts(row)
        return made if voltage is None else (*made, np.tile(voltage, (len(made[0]), 1)))
    if series.load_p_forecast is None:
        return tuple(array[row : row + 1] for array in (series.load_p, series.load_q, series.prod_p))
    arrays = (getattr(series, f"{name}_forecast") for name in _WITH_VOLTAGES)
    return tuple(array[row] for array in arrays if array is not None)


def _announce_outages(views: Views, lines: NDArray[np.int64]) -> None:
    """Only the next outage of each line, as the observation announces it."""
    step = int(views["state.step"])
    begin = step + views["state.time_next_maintenance"][lines]
    views["hidden.outage_line"][:] = lines
    views["hidden.outage_begin"][:] = begin
    views["hidden.outage_end"][:] = begin + views["state.duration_next_maintenance"][lines]
    views["hidden.outage_count"][...] = len(lines)
    views["hidden.next_outage"][:] = -1
    views["hidden.next_outage"][lines] = np.arange(len(lines))


def _imagine_opponent(grid: Grid, constants: OpponentState, views: Views, seed: int) -> None:
    if constants.lines.shape[0] == 0:
        return
    own = {name: views[f"opponent.{name}"][np.newaxis] for name in constants._fields if f"opponent.{name}" in views}
    step = int(views["state.step"])
    imagine_opponent(
        constants._replace(**own),
        0,
        grid,
        Stream(seed, step, Purpose.IMAGINATION),
        int(views["state.episode_length"]) - step,
        views["state.attacked"],
        views["state.time_before_cooldown_line"],
    )


def _follow_outlook(views: Views) -> None:
    """Rows of the series after the present one are those of the outlook."""
    views["hidden.year"][...] = 0
    horizons = max(int(views["hidden.horizons"]), 1)
    views["hidden.horizons"][...] = horizons
    views["hidden.last_row"][...] = int(views["state.step"]) + horizons
