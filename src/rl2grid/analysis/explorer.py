"""A table of episodes for HTML pages, to be sorted and filtered in the browser."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rl2grid.analysis.page import embedded, filled, resource_text
from rl2grid.envs.tasks import short_id
from rl2grid.mdp.termination import GAME_OVER_TEXT, GameOver
from rl2grid.records.episodes import Episode
from rl2grid.records.evaluations import Evaluation
from rl2grid.records.methods import method_label

DIGITS = 6
"""Significant digits of the numbers that are shown."""


@dataclass(frozen=True)
class _Column:
    """A column of the table."""

    name: str
    """What it is called in a search, such as ``survival<0.5``."""
    heading: str
    value: Callable[[Episode], str | float]


def _ended_by(episode: Episode) -> str:
    return "completed" if episode.completed else GAME_OVER_TEXT[GameOver[episode.game_over]]


_COLUMNS = (
    _Column("method", "Method", lambda episode: method_label(episode)),
    _Column("task", "Task", lambda episode: short_id(episode.task)),
    _Column("scenario", "Scenario", lambda episode: episode.scenario),
    _Column("seed", "Seed", lambda episode: episode.seed),
    _Column("survival", "Survival", lambda episode: episode.survival),
    _Column("ended", "Ended by", _ended_by),
    _Column("overloads", "Last overloads", lambda episode: episode.last_overloads),
    _Column("outages", "Last outages", lambda episode: episode.last_outages),
    _Column("cut_off", "Last cut off", lambda episode: episode.last_cut_off),
    _Column("steps", "Grid steps", lambda episode: episode.grid_steps),
    _Column("decisions", "Decisions", lambda episode: episode.decisions),
    _Column("return", "Return", lambda episode: episode.episode_return),
    _Column("lsi", "LSI cost", lambda episode: episode.cost_lsi),
    _Column("tlo", "TLO cost", lambda episode: episode.cost_tlo),
    _Column("margin", "Margin", lambda episode: episode.score_margin),
    _Column("overload", "Overload", lambda episode: episode.score_overload),
    _Column("topology", "Topology", lambda episode: episode.score_topology),
    _Column("illegal", "Illegal", lambda episode: episode.illegal),
    _Column("start", "Start", lambda episode: episode.start),
    _Column("split", "Split", lambda episode: episode.split),
    _Column("engine", "Engine", lambda episode: episode.engine),
)
_OFTEN_EQUAL = ("start", "split", "engine")
"""Columns that are left out when all episodes have the same in them."""
_BEFORE_TRAINING = [column.name for column in _COLUMNS].index("seed") + 1
_TRAINING = {"name": "training", "heading": "Training seed"}
_MADE_BY = {"name": "made", "heading": "Made by"}


def explorer_html(results: Sequence[Evaluation], made_by: Sequence[str]) -> str:
    """A section with all episodes.

    Args:
        results: evaluations.
        made_by: of each of them, the id of the element of the page that has its command.
    """
    data = embedded(explorer_data(results, made_by))
    return filled(resource_text("explorer.html"), script=resource_text("explorer.js"), data=data)


def explorer_data(results: Sequence[Evaluation], made_by: Sequence[str]) -> dict[str, Any]:
    """What the page embeds, ready for JSON: columns of numbers, and columns of words as places in a list of them."""
    episodes = [episode for result in results for episode in result.episodes]
    values = {column: [column.value(episode) for episode in episodes] for column in _COLUMNS}
    shown = [column for column in _COLUMNS if column.name not in _OFTEN_EQUAL or len(set(values[column])) > 1]
    columns = [_column_data(column, values[column]) for column in shown]
    trained = [_training_seed(result) for result in results for _ in result.episodes]
    if len(set(trained)) > 1:
        columns.insert(_BEFORE_TRAINING, {**_TRAINING, **_words(trained)})
    places = [place for place, result in zip(made_by, results, strict=True) for _ in result.episodes]
    return {"rows": len(episodes), "columns": [*columns, {**_MADE_BY, **_words(places)}]}


def _training_seed(result: Evaluation) -> str:
    """Empty for agents without training."""
    agent = result.identity.get("agent_identity") or {}
    return str(agent.get("trained_with", {}).get("seed", ""))


def _column_data(column: _Column, values: Sequence[str | float]) -> dict[str, Any]:
    names = {"name": column.name, "heading": column.heading}
    if values and isinstance(values[0], str):
        return {**names, **_words([str(value) for value in values])}
    return {**names, "numbers": [_short(float(value)) for value in values]}


def _words(values: Sequence[str]) -> dict[str, Any]:
    distinct = {word: place for place, word in enumerate(dict.fromkeys(values))}
    return {"words": list(distinct), "places": [distinct[value] for value in values]}


def _short(value: float) -> float | int:
    rounded = float(f"{value:.{DIGITS}g}")
    return int(rounded) if rounded.is_integer() else rounded
