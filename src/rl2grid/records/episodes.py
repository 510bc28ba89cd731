"""Tidy episode files: one row per episode, the raw material of every table and figure.

:class:`Episode` declares every column once, with its type, its unit, its meaning and what decides it. The files, what
entries of a leaderboard hold (:data:`FACTS`) and the table of the documentation follow from that.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from rl2grid.errors import UsageError
from rl2grid.records.files import printable, read_text, write_text

EPISODES_FILE = "episodes.csv"


class Origin(StrEnum):
    """What decides a column."""

    EVALUATION = "evaluation"
    """The evaluation that the episode is part of: equal in all its rows; empty outside of one."""
    EPISODE = "episode"
    """The environment and the actions alone: who plays the actions again finds the same, to the last bit."""
    OPERATION = "operation"
    """As :attr:`EPISODE`, but None in files that were written before there was such a column."""
    AGENT = "agent"
    """What the agent did beside its actions: who plays these again cannot tell."""
    CLOCK = "clock"
    """Nothing that a repetition reproduces."""


class Column(NamedTuple):
    """A column of a file of episodes."""

    name: str
    type: type
    """``str``, ``int``, ``float`` or ``bool``."""
    unit: str
    """Empty where there is none."""
    meaning: str
    origin: Origin
    least: float = -math.inf
    """Smallest value of a number."""
    most: float = math.inf
    """Largest value of a number."""


def _fact(
    meaning: str,
    unit: str = "",
    origin: Origin = Origin.EPISODE,
    *,
    least: float = -math.inf,
    most: float = math.inf,
) -> Any:
    return field(metadata={"meaning": meaning, "unit": unit, "origin": origin, "least": least, "most": most})


def _count(meaning: str, unit: str = "", least: int = 0) -> Any:
    return _fact(meaning, unit, least=least, most=2**63)


def _operation(meaning: str, unit: str, least: float = -math.inf) -> Any:
    origin = Origin.OPERATION
    return field(default=None, metadata={"meaning": meaning, "unit": unit, "origin": origin, "least": least})


def _label(meaning: str) -> Any:
    return field(default="", metadata={"meaning": meaning, "unit": "", "origin": Origin.EVALUATION})


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode as it was played, and as it is stored; :data:`COLUMNS` says what its columns mean.

    Its labels (:attr:`Origin.EVALUATION`) are empty until it becomes part of an evaluation.
    """

    task: str = _label("id of the task")
    agent: str = _label("what tables call the agent")
    heuristic: str = _label("`none`, `idle`, `recovery`, `careful` or `secure`")
    split: str = _label("split of the month")
    scenario: str = _fact("the month")
    seed: int = _count("of maintenance, opponent and agent, together with the month")
    start: int = _count("row of the scenario at which the episode begins")
    episode_length: int = _count("steps of a completed episode, T", "grid steps", least=1)
    grid_steps: int = _count("steps played, heuristic steps and the step of a game over included", "grid steps")
    decisions: int = _count("actions asked of the agent; 0 when the episode ended before its first decision")
    survival: float = _fact("share of the episode survived, 0 to 1", least=0.0, most=1.0)
    completed: bool = _fact("whether the last step was reached without a game over")
    game_over: str = _fact("reason of the game over; `NONE` when completed")
    last_overloads: str = _fact("lines above their limit in the state before the game over", "ids")
    last_outages: str = _fact(
        "lines out of service when the grid collapsed, by protection, attack, maintenance or choice", "ids"
    )
    last_cut_off: str = _fact(
        "substations where a load or generator was off, or something was not connected to the balancing generator",
        "ids",
    )
    episode_return: float = _fact("sum of the rewards of all grid steps")
    return_survive: float = _fact("sum of the first component of the reward, without its weight")
    return_overload: float = _fact("sum of the second")
    return_cost: float = _fact("sum of the third")
    cost_lsi: float = _fact("sum of the costs of load shedding and islanding")
    cost_tlo: float = _fact("sum of the costs of transmission line overloads")
    score_margin: float = _fact("margin score of the paper (Section 5), mean per step")
    score_overload: float = _fact("its overload score")
    score_topology: float = _fact("its topology score")
    illegal: int = _count("actions of the agent that broke a rule")
    ambiguous: int = _count("actions of the agent that contradicted themselves")
    foresight: int = field(
        default=0,
        metadata={
            "meaning": "decisions taken where the true future had been seen, by stepping a saved true world",
            "unit": "",
            "origin": Origin.AGENT,
            "least": 0.0,
        },
    )
    cost_losses: float | None = _operation(
        "[L2RPN](l2rpn.md): losses, at the dearest running generator's price", "price x MWh"
    )
    cost_redispatch: float | None = _operation("redispatch, at that price", "price x MWh", least=0.0)
    cost_curtailment: float | None = _operation("curtailment that is added, less what is taken back", "price x MWh")
    cost_storage: float | None = _operation("use of storage, at that price", "price x MWh", least=0.0)
    cost_blackout: float | None = _operation(
        "demand of all steps after a game over, at the highest price", "price x MW"
    )
    storage_energy: float | None = _operation("energy that storage took in and gave out", "MWh", least=0.0)
    renewable_used: float | None = _operation("energy that renewables produced", "MWh")
    renewable_available: float | None = _operation("energy that they would have produced without limits", "MWh")
    wall_time_s: float = _fact("time that the episode took", "s", Origin.CLOCK)
    engine: str = _label("`native` or `reference`")
    scenario_pack_hash: str = _label("of the series")
    action_set_hash: str = _label("of the topology actions; empty without any")
    agent_hash: str = _label("of the checkpoint; empty for agents without parameters")
    identity: str = _label("hash of the evaluation's full identity, which is stored beside the rows")

    @property
    def knows_operation(self) -> bool:
        """Whether what operation cost is known."""
        return self.cost_losses is not None

    @property
    def cost_operation(self) -> float:
        """What the episode cost by the rules of L2RPN 2020, blackout included; NaN where it is not known."""
        parts = (self.cost_losses, self.cost_redispatch, self.cost_curtailment, self.cost_storage, self.cost_blackout)
        return sum(math.nan if part is None else part for part in parts)


_TYPES: dict[str, type] = get_type_hints(Episode)
COLUMNS: tuple[Column, ...] = tuple(
    Column(
        each.name,
        float if _TYPES[each.name] == float | None else _TYPES[each.name],
        **{key: each.metadata[key] for key in ("unit", "meaning", "origin", "least", "most") if key in each.metadata},
    )
    for each in fields(Episode)
)
"""In the order of the files."""
COLUMN_NAMES: tuple[str, ...] = tuple(column.name for column in COLUMNS)
LABELS: tuple[Column, ...] = tuple(column for column in COLUMNS if column.origin is Origin.EVALUATION)
"""Columns that the evaluation decides, of which an episode is part."""
FACTS: tuple[Column, ...] = tuple(column for column in COLUMNS if column.origin is Origin.EPISODE)
"""Columns that the environment and the actions alone decide."""
OPERATION: tuple[Column, ...] = tuple(column for column in COLUMNS if column.origin is Origin.OPERATION)
"""Columns of what operation cost."""
_EARLIER = tuple(column for column in COLUMNS if column.origin is not Origin.OPERATION)
"""Columns of files that were written before there were those of operation."""


def write_episodes(path: Path, episodes: Iterable[Episode]) -> None:
    """Write a file of episodes, whole or not at all."""
    write_text(path, ",".join(COLUMN_NAMES) + "\n" + "".join(map(format_row, episodes)))


def read_episodes(path: Path) -> tuple[Episode, ...]:
    """The episodes of a file. A last line without its end, as a killed writer leaves it, is ignored.

    Raises:
        UsageError: the file is missing or no file of episodes.
    """
    text = read_text(path, "a file of episodes", "give it as 'rl2grid evaluate' wrote it")
    head, _, body = text[: text.rfind("\n") + 1].partition("\n")
    names = tuple(head.split(","))
    columns = next((all_ for all_ in (COLUMNS, _EARLIER) if names == tuple(one.name for one in all_)), None)
    if columns is None:
        raise UsageError(f"{path} is no file of episodes: its first line must be {','.join(COLUMN_NAMES)}.")
    return parse_episodes(path, body.split("\n")[:-1], columns)


def parse_episodes(path: Path, lines: Sequence[str], columns: Sequence[Column] = COLUMNS) -> tuple[Episode, ...]:
    """The episodes of the lines of a file with these columns, which follow its first line.

    Raises:
        UsageError: one is no episode.
    """
    try:
        rows = list(csv.reader(lines, strict=True))
    except csv.Error as error:
        raise UsageError(f"{path} is no file of episodes: {error}.") from None
    return tuple(_parse_row(path, number, row, columns) for number, row in enumerate(rows, start=2))


def check_values(values: Mapping[str, Any]) -> None:
    """Refuse values of an episode that no episode has.

    Raises:
        ValueError: which one.
    """
    for column in COLUMNS:
        value = values.get(column.name)
        if not isinstance(value, int | float) or isinstance(value, bool):
            continue
        if not math.isfinite(value) or value < column.least or value > column.most:
            allowed = f"from {column.least:g} to {column.most:g}" if math.isfinite(column.least) else "a finite number"
            raise ValueError(f"{column.name} is {value!r}, and must be {allowed}")


def format_row(episode: Episode) -> str:
    """One line of a file of episodes; numbers keep all their digits."""
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(_format(value) for value in asdict(episode).values())
    return line.getvalue()


def _format(value: Any) -> Any:
    return str(value).lower() if isinstance(value, bool) else value


def _parse_row(path: Path, number: int, row: list[str], columns: Sequence[Column]) -> Episode:
    try:
        if len(row) != len(columns):
            raise ValueError(f"it has {len(row)} values, and must have {len(columns)}")
        values = {column.name: _parse(column, text) for column, text in zip(columns, row, strict=True)}
        check_values(values)
    except ValueError as error:
        raise UsageError(f"Line {number} of {path} is no episode: {error}.") from None
    return Episode(**values)


def _parse(column: Column, text: str) -> Any:
    kind = column.type
    if column.origin is Origin.OPERATION and not text:
        return None
    if kind is bool:
        if text not in ("true", "false"):
            raise ValueError(f"expected true or false, got {text!r}")
        return text == "true"
    return printable(text) if kind is str else kind(text)
