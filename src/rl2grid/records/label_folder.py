"""The folder of labels, written so that a kill at any moment loses at most the months that are under way."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.records.files import check_own, make_folder, write_record
from rl2grid.records.labels import (
    LABELS_FILE,
    Labels,
    MonthRow,
    is_labels,
    label_shape,
    month_path,
    observed_groups,
    read_labels_description,
    read_row,
    request_hash,
    write_month,
)
from rl2grid.records.locks import LockedError, take_lock


class LabelFolder:
    """A round of labels that is being written; see :func:`open_labels`."""

    def __init__(self, folder: Path, description: Mapping[str, Any], number: int) -> None:
        self.number = number
        """Of the round."""
        self._folder, self._description = folder, description
        task = find_task(description["task"])
        self._shape = label_shape(task, description["candidates"], observed_groups(description))
        self.request = request_hash(description, number)
        """What the files of its months must say."""

    @property
    def n_months(self) -> int:
        """How many months the round is to have."""
        return int(self._description["rounds"][self.number]["months"])

    def rows(self) -> dict[int, MonthRow]:
        """The months that are there, by number.

        Raises:
            UsageError: the file of one was changed, or is of other labels.
        """
        paths = {month: month_path(self._folder, self.number, month) for month in range(self.n_months)}
        found = {month: read_row(path, self._shape) for month, path in paths.items() if path.is_file()}
        for month, row in found.items():
            if (row.request, row.round, row.number) != (self.request, self.number, month):
                raise UsageError(f"{paths[month]} is of another month or of other labels: remove it, and ask again.")
        return found

    def add(self, row: MonthRow, labels: Labels) -> None:
        """Keep a month."""
        path = month_path(self._folder, self.number, row.number)
        make_folder(path.parent)
        write_month(path, row, labels)


@contextmanager
def open_labels(folder: Path, request: Mapping[str, Any], of_round: Mapping[str, Any]) -> Iterator[LabelFolder]:
    """A round of labels in a folder: the one that such a pupil has there already, else the next.

    Args:
        folder: made if there is none.
        request: what :data:`~rl2grid.records.labels.LABELS_FILE` is to say, without its rounds.
        of_round: ``months``, ``pupil``, ``pupil_share`` and ``command``; of a round that is there, months may be added.

    Raises:
        UsageError: the folder holds other labels or other files, cannot be made, another process writes to it, the
            round has more months already, or the round before it is unfinished.
    """
    check_own(folder, (LABELS_FILE,), "labels")
    if of_round["pupil"] is not None and not is_labels(folder):
        raise UsageError(f"{folder} holds no labels yet: label months that the teacher plays first, without a pupil.")
    make_folder(folder)
    try:
        lock = take_lock(folder)
    except LockedError:
        raise UsageError(f"Another process is writing to {folder}: wait for it, or choose another folder.") from None
    try:
        request = json.loads(json.dumps(request))  # as it is read again, without tuples
        rounds = _rounds_before(folder, request)
        number = _round_of(folder, rounds, of_round)
        description = {**request, "rounds": [*rounds[:number], dict(of_round), *rounds[number + 1 :]]}
        write_record(folder / LABELS_FILE, description)
        yield LabelFolder(folder, description, number)
    finally:
        lock.release()


def _rounds_before(folder: Path, request: Mapping[str, Any]) -> list[dict[str, Any]]:
    if not is_labels(folder):
        return []
    stored = read_labels_description(folder)
    rounds: list[dict[str, Any]] = stored.pop("rounds")
    differing = _differing(stored, request)
    if differing:
        raise UsageError(
            f"{folder} holds other labels, with a different {differing[0]}: choose another folder, or remove it."
        )
    return rounds


def _round_of(folder: Path, rounds: list[dict[str, Any]], of_round: Mapping[str, Any]) -> int:
    """The number of the round that is asked for."""
    for number, each in enumerate(rounds):
        if (each["pupil"], each["pupil_share"]) == (of_round["pupil"], of_round["pupil_share"]):
            if of_round["months"] < each["months"]:
                raise UsageError(
                    f"Round {number} of {folder} has {each['months']} months: ask for as many, or for more."
                )
            return number
    for number, each in enumerate(rounds):
        done = sum(month_path(folder, number, month).is_file() for month in range(each["months"]))
        if done < each["months"]:
            raise UsageError(
                f"Round {number} of {folder} is unfinished, {done} of {each['months']} months are there: go on with "
                f"`{each['command']}` first."
            )
    return len(rounds)


def _differing(stored: Mapping[str, Any], request: Mapping[str, Any]) -> list[str]:
    """In what two requests differ, in words: the entries of a part that differs, where it has some."""
    words = []
    for name in {**stored, **request}:
        mine, theirs = request.get(name), stored.get(name)
        if mine != theirs and isinstance(mine, dict) and isinstance(theirs, dict):
            words += _differing(theirs, mine)
        elif mine != theirs:
            words.append(f"{name.replace('_', ' ')} ({theirs}, not {mine})")
    return words
