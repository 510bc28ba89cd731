"""Episodes as one HTML page with a time slider, which needs no other file and no network.

Several agents that play one month share a page. What is embedded of each: loadings as whole percent and powers as the
square root of their share of the grid's largest, one byte per line or symbol and step; directions of flows; totals of
production, demand and weather; changes of the topology as differences; attacks and maintenance as intervals; what was
decided and why; the rounds of cascades. Series are stored as differences from step to step, compressed.
"""

from __future__ import annotations

import base64
import html
import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from rl2grid.analysis.page import embedded, filled, resource_text, write_page
from rl2grid.drawing.grid_drawing import geometry_of, largest_power, loading_colours
from rl2grid.drawing.theme import DARK, FULL_SCALE, LIGHT, Theme
from rl2grid.grids import Grid
from rl2grid.records.files import printable
from rl2grid.records.recordings import Cascade, Reason, Recording, Round

MAX_LOADING = 255
"""Percent: higher loadings are shown as this."""
LEGEND_LOADINGS = (0.5, 0.8, 0.95, 1.05, 1.2)
_SCRIPTS = ("watch_episode.js", "watch_map.js", "watch_charts.js", "watch_page.js")
_KINDS = ("nuclear", "thermal", "hydro", "wind", "solar")
"""Kinds of generators from below to above in the chart; others follow."""
_WEATHER = ("wind", "solar")


def write_watch_page(path: Path, grid: Grid, recordings: Sequence[Recording]) -> None:
    """Write the page of episodes of one month, one per agent, whole or not at all.

    Raises:
        UsageError: the grid has no layout.
    """
    first, labels = recordings[0], labels_of(recordings)
    task = first.task.removeprefix("rl2grid/")
    heading = f"{task}, {first.scenario}, seed {first.seed}"
    title = f"{heading}: {' against '.join(labels)}"
    script = "\n".join(resource_text(name) for name in _SCRIPTS)
    body = filled(
        resource_text("watch_page.html"),
        title=html.escape(printable(title)),
        heading=html.escape(printable(heading)),
        legend=_legend(grid),
        data=embedded(page_data(grid, recordings)),
        script=script,
    )
    write_page(path, title, [body])


def labels_of(recordings: Sequence[Recording]) -> list[str]:
    """What to call each agent: its name and heuristic, with a number where several are called alike."""
    names = [each.agent if each.heuristic == "none" else f"{each.agent} + {each.heuristic}" for each in recordings]
    count, seen = Counter(names), Counter[str]()
    labels = []
    for name in names:
        seen[name] += 1
        labels.append(f"{name} ({seen[name]})" if count[name] > 1 else name)
    return labels


def page_data(grid: Grid, recordings: Sequence[Recording]) -> dict[str, Any]:
    """What the page embeds, ready for JSON."""
    words = _Words()
    episodes = [
        _episode_data(grid, recording, label, words)
        for recording, label in zip(recordings, labels_of(recordings), strict=True)
    ]
    return {
        "began": recordings[0].began,
        "length": recordings[0].episode_length,
        "grid": _grid_data(grid),
        "largest": largest_power(grid),
        "episodes": episodes,
        "words": words.all,
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
    changed = np.flatnonzero((topo_vect != before).any(axis=1)).tolist()
    return [(step, _moved(before[step], topo_vect[step])) for step in changed]


def intervals(flags: NDArray[np.bool_]) -> list[list[int]]:
    """When each column of ``flags``, bool [step, line], is set: lists of line, first step, step after the last."""
    edge = np.zeros((1, flags.shape[1]), np.int8)
    turns = np.diff(np.concatenate((edge, flags.astype(np.int8), edge)), axis=0)
    begin_line, begin = np.nonzero((turns == 1).T)
    _, end = np.nonzero((turns == -1).T)
    rows: list[list[int]] = np.stack((begin_line, begin, end), axis=1).tolist()
    return rows


def packed(array: NDArray[np.uint8]) -> str:
    """Bytes [step, column] as text: differences from step to step, column after column, compressed."""
    first = np.zeros_like(array[:1])
    differences = np.diff(array, axis=0, prepend=first)
    return base64.b64encode(zlib.compress(np.ascontiguousarray(differences.T).tobytes(), 9)).decode()


class _Words:
    """Distinct texts, by number."""

    def __init__(self) -> None:
        self.all: list[str] = []
        self._number: dict[str, int] = {}

    def number(self, text: str) -> int:
        if text not in self._number:
            self._number[text] = len(self.all)
            self.all.append(text)
        return self._number[text]


def _episode_data(grid: Grid, recording: Recording, label: str, words: _Words) -> dict[str, Any]:
    loading = np.where(recording.line_status, np.nan_to_num(recording.rho), 0)
    powers = np.concatenate((recording.gen_p, recording.load_p, recording.storage_power), axis=1)
    share = np.sqrt(np.clip(np.abs(powers) / largest_power(grid), 0, 1))
    acted = zip(recording.decision_steps, recording.actions, strict=True)
    return {
        "label": label,
        "steps": len(recording.rho),
        "ending": _ending_in_words(grid, recording),
        "rho": packed(_percent(loading)),
        "power": packed(np.rint(255 * share).astype(np.uint8)),
        "forward": packed((recording.p_or >= 0).astype(np.uint8)),
        "totals": _totals(grid, recording),
        "changes": topology_changes(recording.topo_vect),
        "attacked": intervals(recording.attacked),
        "maintained": intervals(recording.maintained),
        "decisions": [(step, words.number(text)) for step, text in acted if text],
        "reasons": [_reason_data(reason, words) for reason in recording.reasons],
        "heuristic": [(step, words.number(text)) for step, text in recording.heuristic_acts],
        "cascades": [_cascade_data(recording, cascade) for cascade in _told_cascades(recording)],
        "lost": [] if recording.ending is None else np.flatnonzero(recording.ending.lost).tolist(),
        "lostAttacked": [] if recording.ending is None else np.flatnonzero(recording.ending.attacked).tolist(),
    }


def _percent(loading: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.clip(np.rint(100 * loading), 0, MAX_LOADING).astype(np.uint8)


def _totals(grid: Grid, recording: Recording) -> dict[str, Any]:
    """MW in two bytes each: production by kind, what weather allows, and demand."""
    kinds = [kind for kind in (*_KINDS, *sorted(set(grid.gen_type) - set(_KINDS))) if kind in grid.gen_type]
    of_kind = {kind: np.array([each == kind for each in grid.gen_type]) for kind in kinds}
    produced = {kind: recording.gen_p[:, of_kind[kind]].sum(axis=1) for kind in kinds}
    weather = [kind for kind in _WEATHER if kind in kinds]
    available = {f"{kind} available": recording.gen_p_before_curtail[:, of_kind[kind]].sum(axis=1) for kind in weather}
    columns = produced | available | {"demand": recording.load_p.sum(axis=1)}
    megawatts = np.stack(list(columns.values()), axis=1).clip(0)
    unit = max(float(megawatts.max()), 1.0) / 65535
    numbers = np.rint(megawatts / unit).astype(np.uint16)
    return {
        "kinds": kinds,
        "weather": weather,
        "capacity": [float(grid.gen_pmax[of_kind[kind]].sum()) for kind in weather],
        "unit": unit,
        "high": packed((numbers >> 8).astype(np.uint8)),
        "low": packed((numbers & 255).astype(np.uint8)),
    }


def _reason_data(reason: Reason, words: _Words) -> dict[str, Any]:
    return {
        "step": reason.step,
        "preference": reason.preference,
        "why": words.number(reason.why),
        "tried": reason.tried,
        "alternatives": [
            [words.number(each.action), _rounded(100 * each.promised), _rounded(each.preference), int(each.chosen)]
            for each in reason.alternatives
        ],
    }


def _rounded(value: float) -> float | str | None:
    """A number with three digits that count; None: not known; "lost": infinite."""
    if np.isnan(value):
        return None
    return "lost" if np.isinf(value) else float(f"{value:.3g}")


def _told_cascades(recording: Recording) -> list[Cascade]:
    """Those recorded; and of a game over whose rounds are not known what it left."""
    told = list(recording.cascades)
    lost_step = len(recording.rho)
    if recording.ending is not None and lost_step not in [cascade.step for cascade in told]:
        unknown = np.full(recording.rho.shape[1], np.nan, np.float32)
        told.append(Cascade(lost_step, (Round(recording.ending.topo_vect, unknown, unknown, ()),)))
    return told


def _cascade_data(recording: Recording, cascade: Cascade) -> dict[str, Any]:
    before = recording.topo_vect[cascade.step - 1]
    return {
        "step": cascade.step,
        "rounds": [
            {
                "moved": _moved(before, each.topo_vect),
                "rho": None if np.isnan(each.rho).all() else np.rint(100 * each.rho).astype(int).tolist(),
                "forward": (each.p_or >= 0).astype(int).tolist(),
                "trips": [[line, round(100 * loading, 1), overloaded] for line, loading, overloaded in each.trips],
            }
            for each in cascade.rounds
        ],
    }


def _moved(before: NDArray[np.int8], after: NDArray[np.int8]) -> list[int]:
    """A flat list of element, busbar, element, busbar ... of what differs."""
    elements = np.flatnonzero(before != after)
    flat: list[int] = np.stack((elements, after[elements]), axis=1).ravel().tolist()
    return flat


def _ending_in_words(grid: Grid, recording: Recording) -> str:
    survived = f"{recording.n_steps:,} of {recording.episode_length:,} steps"
    if recording.game_over:
        return f"Game over after {survived}: {recording.game_over}.{_lost_in_words(grid, recording)}"
    if recording.n_steps == recording.episode_length:
        return "The episode was completed."
    return f"The recording ends after {survived}."


def _lost_in_words(grid: Grid, recording: Recording) -> str:
    """Which loads and generators are off or apart from the rest."""
    if recording.ending is None:
        return ""
    parts = []
    kinds = (("load", grid.load_pos_topo_vect, grid.name_load), ("generator", grid.gen_pos_topo_vect, grid.name_gen))
    for kind, positions, names in kinds:
        lost = np.flatnonzero(recording.ending.lost[positions]).tolist()
        parts += [f"{kind} {k} ({names[k]})" for k in lost]
    if not parts:
        return ""
    shown = ", ".join(parts[:6]) + (f" and {len(parts) - 6} more" if len(parts) > 6 else "")
    return f" Cut off: {shown}."


def _grid_data(grid: Grid) -> dict[str, Any]:
    geometry = geometry_of(grid)
    ends = (grid.line_or_to_subid, grid.line_ex_to_subid, grid.line_or_pos_topo_vect, grid.line_ex_pos_topo_vect)
    kinds = ["generator"] * grid.n_gen + ["load"] * grid.n_load + ["storage"] * grid.n_storage
    numbers = [*range(grid.n_gen), *range(grid.n_load), *range(grid.n_storage)]
    names = (*grid.name_gen, *grid.name_load, *grid.name_storage)
    details = (*grid.gen_type, *[""] * (grid.n_load + grid.n_storage))
    places = np.round(geometry.symbol / geometry.unit, 3).tolist()
    symbols = zip(geometry.symbol_element.tolist(), kinds, places, names, numbers, details, strict=True)
    return {
        "centres": np.round(geometry.centre / geometry.unit, 3).tolist(),
        "subNames": grid.name_sub,
        "lines": np.stack(ends, axis=1).tolist(),
        "lineNames": grid.name_line,
        "middles": np.round(geometry.line_middle / geometry.unit, 3).tolist(),
        "towards": np.round(geometry.towards, 3).tolist(),
        "elementSub": grid.element_to_subid.tolist(),
        "symbols": [
            {"element": element, "kind": kind, "x": x, "y": y, "name": name, "number": number, "detail": detail}
            for element, kind, (x, y), name, number, detail in symbols
        ],
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
        "split": "<path class=bar d='M6 3h16M6 9h16' />",
    }
    if not grid.n_storage:
        del shapes["storage"]
    for rho in LEGEND_LOADINGS:
        light, dark = (to_hex(loading_colours(theme)(rho / FULL_SCALE)) for theme in (LIGHT, DARK))
        style = f"--light:{light};--dark:{dark}"
        shapes[f"{rho:.0%} loaded"] = f"<path class='line loaded' d='M0 6h28' style='{style}' />"
    for name in ("attacked", "maintenance", "out"):
        shapes[name] = f"<path class='line off {name}' d='M0 6h28' />"
    entries = [f"<span><svg viewBox='0 0 28 12'>{shape}</svg> {name}</span>" for name, shape in shapes.items()]
    return "".join((*entries, "<span>symbol size: MW</span>"))
