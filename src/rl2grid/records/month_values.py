"""What a policy did in every month, in few bytes: enough for any figure, and for any comparison on the same months.

A column is one line of numbers, in the order of the months and of the seeds within each: ``"8064*3 512"`` stands for
three completed months of 8,064 steps and one that was lost after 512.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rl2grid.arrays import F64
from rl2grid.mdp.constraint_table import CONSTRAINTS
from rl2grid.records.episodes import Episode

LENGTH, SURVIVED = "length", "survived"
COSTS: tuple[str, ...] = tuple(constraint.column for constraint in CONSTRAINTS.values())


def pack_months(episodes: Sequence[Episode]) -> dict[str, str]:
    """The columns of an evaluation, whose episodes are in the order of months, then seeds."""
    survived = [round(episode.survival * episode.episode_length) for episode in episodes]
    columns: dict[str, Sequence[float]] = {
        LENGTH: [episode.episode_length for episode in episodes],
        SURVIVED: survived,
        **{column: [getattr(episode, column) for episode in episodes] for column in COSTS},
    }
    return {name: _packed(values) for name, values in columns.items()}


def unpack_months(columns: Mapping[str, str], seeds: int) -> dict[str, F64]:
    """Survival, whether a month was completed, and costs, float64 [month, seed] each.

    Raises:
        ValueError: columns that were not packed so.
    """
    arrays = {name: np.array(_unpacked(text), np.float64).reshape(-1, seeds) for name, text in columns.items()}
    if set(arrays) != {LENGTH, SURVIVED, *COSTS} or len({array.shape for array in arrays.values()}) > 1:
        raise ValueError(f"Values of months need {LENGTH}, {SURVIVED} and costs alike, got {', '.join(columns)}.")
    length, survived = arrays.pop(LENGTH), arrays.pop(SURVIVED)
    return {"survival": survived / length, "completed": (survived == length).astype(np.float64), **arrays}


def _packed(values: Sequence[float]) -> str:
    words = []
    for value, alike in itertools.groupby(values):
        number = sum(1 for _ in alike)
        text = str(int(value)) if value == int(value) else repr(round(value, 3))
        words.append(f"{text}*{number}" if number > 1 else text)
    return " ".join(words)


def _unpacked(text: str) -> list[float]:
    values: list[float] = []
    for word in text.split():
        value, _, number = word.partition("*")
        values += [float(value)] * int(number or 1)
    return values


def common_months(first: Mapping[str, Any], other: Mapping[str, Any]) -> int:
    """How many months two tests have in common: those that the shorter played, which the longer began with.

    Args:
        first: which months one test played, as :attr:`rl2grid.records.ledger.HashedTest.months` says.
        other: the same of another.

    Returns:
        0 where lists, versions or seeds differ.
    """
    same = all(first.get(key) == other.get(key) for key in ("split", "split_version", "generator_version", "seeds"))
    return min(int(first["number"]), int(other["number"])) if same else 0
