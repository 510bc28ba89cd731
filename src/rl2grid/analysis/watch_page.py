"""An episode as one HTML page with a time slider, which needs no other file and no network.

What is embedded: loadings as whole percent, one byte per line and step; powers as one byte per symbol and step (the
square root of their share of the grid's largest); changes of the topology as differences; attacks and maintenance as
intervals. A month of a 118-substation grid is about 4 MB.
"""

from __future__ import annotations

import base64
import html
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from rl2grid.analysis.page import embedded, filled, write_page
from rl2grid.drawing.grid_drawing import geometry_of, largest_power, loading_colours
from rl2grid.drawing.theme import DARK, FULL_SCALE, LIGHT, Theme
from rl2grid.grids import Grid
from rl2grid.records.files import printable
from rl2grid.records.recordings import Recording

MAX_LOADING = 255
"""Percent: higher loadings are shown as this."""


def write_watch_page(path: Path, grid: Grid, recording: Recording) -> None:
    """Write the page of ``recording``, whole or not at all.

    Raises:
        UsageError: the grid has no layout.
    """
    task = recording.task.removeprefix("rl2grid/")
    with_heuristic = "" if recording.heuristic == "none" else f" + {recording.heuristic}"
    title = f"{recording.agent}{with_heuristic} on {task}, {recording.scenario}, seed {recording.seed}"
    data, script = embedded(page_data(grid, recording)), _resource("watch_page.js")
    shown = html.escape(printable(title))
    body = filled(_resource("watch_page.html"), title=shown, legend=_legend(grid), data=data, script=script)
    write_page(path, title, [body])


def page_data(grid: Grid, recording: Recording) -> dict[str, Any]:
    """What the page embeds, ready for JSON."""
    loading = np.where(recording.line_status, np.nan_to_num(recording.rho), 0)
    percent = np.clip(np.rint(100 * loading), 0, MAX_LOADING).astype(np.uint8)
    powers = np.concatenate((recording.gen_p, recording.load_p, recording.storage_power), axis=1)
    share = np.sqrt(np.clip(np.abs(powers) / largest_power(grid), 0, 1))
    survived = f"{recording.n_steps:,} of {recording.episode_length:,} steps"
    completed = recording.n_steps == recording.episode_length
    ending = "The episode was completed." if completed else f"The recording ends after {survived}."
    return {
        "began": recording.began,
        "steps": len(recording.rho),
        "length": recording.episode_length,
        "ending": f"Game over after {survived}: {recording.game_over}." if recording.game_over else ending,
        "grid": _grid_data(grid),
        "rho": _base64(percent),
        "power": _base64(np.rint(255 * share).astype(np.uint8)),
        "largest": largest_power(grid),
        "changes": topology_changes(recording.topo_vect),
        "attacked": intervals(recording.attacked),
        "maintained": intervals(recording.maintained),
        "decisions": list(zip(recording.decision_steps, recording.actions, strict=True)),
        "colours": {theme.name: _colours(theme) for theme in (LIGHT, DARK)},
    }


def topology_changes(topo_vect: NDArray[np.int8]) -> list[tuple[int, list[int]]]:
    """Differences of the topology, from everything on busbar 1.

    Args:
        topo_vect: int8 [step, topo].

    Returns:
        For each step with a change, the step and a flat list of element, busbar, element, busbar ...
    """
    before = np.concatenate((np.ones_like(topo_vect[:1]), topo_vect[:-1]))
    changes = []
    for step in np.flatnonzero((topo_vect != before).any(axis=1)).tolist():
        moved = np.flatnonzero(topo_vect[step] != before[step])
        changes.append((step, np.stack((moved, topo_vect[step, moved]), axis=1).ravel().tolist()))
    return changes


def intervals(flags: NDArray[np.bool_]) -> list[list[int]]:
    """When each column of ``flags``, bool [step, line], is set: lists of line, first step, step after the last."""
    edge = np.zeros((1, flags.shape[1]), np.int8)
    turns = np.diff(np.concatenate((edge, flags.astype(np.int8), edge)), axis=0)
    begin_line, begin = np.nonzero((turns == 1).T)
    _, end = np.nonzero((turns == -1).T)
    rows: list[list[int]] = np.stack((begin_line, begin, end), axis=1).tolist()
    return rows


def _grid_data(grid: Grid) -> dict[str, Any]:
    geometry = geometry_of(grid)
    ends = (grid.line_or_to_subid, grid.line_ex_to_subid, grid.line_or_pos_topo_vect, grid.line_ex_pos_topo_vect)
    kinds = ["generator"] * grid.n_gen + ["load"] * grid.n_load + ["storage"] * grid.n_storage
    names = (*grid.name_gen, *grid.name_load, *grid.name_storage)
    places = np.round(geometry.symbol / geometry.unit, 3).tolist()
    symbols = zip(geometry.symbol_element.tolist(), kinds, places, names, strict=True)
    return {
        "centres": np.round(geometry.centre / geometry.unit, 3).tolist(),
        "lines": np.stack(ends, axis=1).tolist(),
        "lineNames": grid.name_line,
        "middles": np.round(geometry.line_middle / geometry.unit, 3).tolist(),
        "towards": np.round(geometry.towards, 3).tolist(),
        "elementSub": grid.element_to_subid.tolist(),
        "symbols": [[element, kind, *place, name] for element, kind, place, name in symbols],
    }


def _colours(theme: Theme) -> list[str]:
    """Colours of loadings of 0, 1, 2 ... percent; the last one also of all above."""
    colours = loading_colours(theme)
    percent = np.arange(round(100 * FULL_SCALE) + 2) / 100
    return [to_hex(colour) for colour in colours(percent / FULL_SCALE)]


def _legend(grid: Grid) -> str:
    shapes = {
        "generator": "<circle class=generator cx=14 cy=6 r=5 />",
        "load": "<path class=load d='M9 2h10l-5 9Z' />",
        "storage": "<path class=storage d='M9 1h10v10h-10Z' />",
        "split substation": "<path class=bar d='M6 3h16M6 9h16' />",
    }
    if not grid.n_storage:
        del shapes["storage"]
    for rho in (0.1, 0.5, 0.95, 1.2):
        light, dark = (to_hex(loading_colours(theme)(rho / FULL_SCALE)) for theme in (LIGHT, DARK))
        style = f"--light:{light};--dark:{dark}"
        shapes[f"{rho:.0%} loaded"] = f"<path class='line loaded' d='M0 6h28' style='{style}' />"
    for name in ("attacked", "maintenance", "out"):
        shapes[name] = f"<path class='line off {name}' d='M0 6h28' />"
    entries = [f"<span><svg viewBox='0 0 28 12'>{shape}</svg> {name}</span>" for name, shape in shapes.items()]
    return "".join((*entries, "<span>symbol size: MW</span>"))


def _base64(array: NDArray[np.uint8]) -> str:
    return base64.b64encode(array.tobytes()).decode()


def _resource(name: str) -> str:
    return (resources.files("rl2grid.analysis") / name).read_text(encoding="utf-8")
