"""Tidy episode files: one row per episode, the raw material of every table and figure."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints

from rl2grid.errors import UsageError

EPISODES_FILE = "episodes.csv"


@dataclass(frozen=True)
class Episode:
    """One evaluated episode. Powers are in MW, durations in grid steps of five minutes unless said otherwise."""

    task: str
    agent: str
    heuristic: str
    """``none``, ``idle`` or ``recovery``."""
    split: str
    scenario: str
    seed: int
    start: int
    """Row of the scenario at which the episode begins."""
    episode_length: int
    """Steps of a completed episode, T."""
    grid_steps: int
    """Steps played, heuristic steps and the step of a game over included."""
    decisions: int
    """Actions asked of the agent; 0 when the episode ended before its first decision."""
    survival: float
    """Share of the episode survived, 0 to 1."""
    completed: bool
    """Whether the last step was reached without a game over."""
    game_over: str
    """Name of the :class:`~rl2grid.mdp.termination.GameOver` reason; ``NONE`` when completed."""
    last_overloads: str
    """Lines above their limit in the state before the game over: ids in order, separated by spaces. Empty where
    there were none, as when a sound grid is attacked, and when the episode was completed; so are the next two."""
    last_outages: str
    """Lines out of service when the grid collapsed, by protection, attack, maintenance or choice."""
    last_cut_off: str
    """Substations where a load or generator was off, or something was not connected to the balancing generator."""
    episode_return: float
    """Sum of the rewards of all grid steps."""
    return_survive: float
    """Sum of the first reward component, without its weight."""
    return_overload: float
    return_cost: float
    cost_lsi: float
    """Sum of the costs of load shedding and islanding."""
    cost_tlo: float
    """Sum of the costs of transmission line overloads."""
    score_margin: float
    """Mean per step of the paper's margin score (Section 5)."""
    score_overload: float
    score_topology: float
    illegal: int
    """Actions of the agent that broke a rule."""
    ambiguous: int
    wall_time_s: float
    """Seconds that the episode took; the only column that a repetition does not reproduce."""
    engine: str
    scenario_pack_hash: str
    action_set_hash: str
    agent_hash: str
    """Of the checkpoint; empty for agents without parameters."""
    identity: str
    """Hash of the evaluation's full identity, which is stored beside the rows."""


COLUMNS: tuple[str, ...] = tuple(field.name for field in fields(Episode))


def write_episodes(path: Path, episodes: Iterable[Episode]) -> None:
    """Write a file of episodes, whole or not at all."""
    text = ",".join(COLUMNS) + "\n" + "".join(map(format_row, episodes))
    temporary = path.with_name(f"{path.name}.tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def read_episodes(path: Path) -> tuple[Episode, ...]:
    """The episodes of a file. A last line without its end, as a killed writer leaves it, is ignored.

    Raises:
        UsageError: the file is missing or no file of episodes.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path} cannot be read as a file of episodes: {error}.") from None
    rows = list(csv.reader(io.StringIO(text[: text.rfind("\n") + 1])))
    if not rows or tuple(rows[0]) != COLUMNS:
        raise UsageError(f"{path} is no file of episodes: its first line must be {','.join(COLUMNS)}.")
    return tuple(_parse_row(path, number, row) for number, row in enumerate(rows[1:], start=2))


def format_row(episode: Episode) -> str:
    """One line of a file of episodes; numbers keep all their digits."""
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(_format(value) for value in asdict(episode).values())
    return line.getvalue()


def _format(value: Any) -> Any:
    return str(value).lower() if isinstance(value, bool) else value


_TYPES: dict[str, type] = get_type_hints(Episode)


def _parse_row(path: Path, number: int, row: list[str]) -> Episode:
    try:
        values = {name: _parse(_TYPES[name], text) for name, text in zip(COLUMNS, row, strict=True)}
    except ValueError as error:
        raise UsageError(f"Line {number} of {path} is no episode: {error}.") from None
    return Episode(**values)


def _parse(kind: type, text: str) -> Any:
    if kind is bool:
        if text not in ("true", "false"):
            raise ValueError(f"expected true or false, got {text!r}")
        return text == "true"
    return kind(text)
