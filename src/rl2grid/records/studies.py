"""A study as it is stored: its cells, what came out of each, and all their episodes.

::

    study.json        cells, states, commands, identity hashes, minutes
    episodes.csv      all evaluated episodes of the finished cells
    cells/<cell>/     ``cell.json``, ``run/``, ``evaluation/`` and, at the very end, ``result.json``; where a teacher
                      labels what is learned from, before them ``labels/`` and ``pupil-1/``, ``pupil-2/``, ...
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any

from rl2grid.errors import UsageError
from rl2grid.records.episodes import COLUMN_NAMES, EPISODES_FILE, format_row, read_episodes
from rl2grid.records.evaluation_folder import PARTIAL_FILE
from rl2grid.records.evaluations import is_evaluation, read_description
from rl2grid.records.files import read_json, write_record, write_text

STUDY_FILE, CELLS_FOLDER = "study.json", "cells"
CELL_FILE, RESULT_FILE = "cell.json", "result.json"
RUN_FOLDER, EVALUATION_FOLDER, LABELS_FOLDER = "run", "evaluation", "labels"
_PART, _REMEDY = "a part of a study", "remove it, and the study makes it again"
_CELL = {
    "name": str,
    "agent": str,
    "task": str,
    "heuristic": (str, NoneType),
    "split": str,
    "training": (dict, NoneType),
}
_RESULT = {"minutes": float, "identity": str, "survival": float, "episodes": int}
_STUDY = {"cells": [{"cell": str}]}


@dataclass(frozen=True)
class CellResult:
    """What is said of a finished cell."""

    minutes: float
    """Of training, validation and evaluation."""
    identity: str
    """Hash of the evaluation's identity."""
    survival: float
    """Mean over the evaluated episodes."""
    episodes: int


def read_cell(folder: Path) -> dict[str, Any] | None:
    """What is asked of a cell; None for a folder that is none.

    Raises:
        UsageError: the file cannot be read.
    """
    path = folder / CELL_FILE
    if not path.is_file():
        return None
    cell: dict[str, Any] = read_json(path, _PART, _REMEDY, _CELL)
    return cell


def write_cell(folder: Path, cell: Mapping[str, Any]) -> None:
    """Make the folder of a cell."""
    folder.mkdir(parents=True, exist_ok=True)
    write_record(folder / CELL_FILE, dict(cell))


def is_cell_finished(folder: Path) -> bool:
    """Whether a cell has its result."""
    return (folder / RESULT_FILE).is_file()


def read_result(folder: Path) -> CellResult | None:
    """The result of a finished cell; None if it is not finished.

    Raises:
        UsageError: the file cannot be read, or is that of another cell.
    """
    path = folder / RESULT_FILE
    if not path.exists():
        return None
    stored = read_json(path, _PART, _REMEDY, _RESULT)
    result = CellResult(**{name: stored[name] for name in _RESULT})
    evaluation = folder / EVALUATION_FOLDER
    request = read_description(evaluation).request if is_evaluation(evaluation) else {}
    if "identity_hash" in request and (request["identity_hash"], len(request["jobs"])) != (
        result.identity,
        result.episodes,
    ):
        raise UsageError(f"{path} belongs to another evaluation than that of its cell: {_REMEDY}.")
    return result


def write_result(folder: Path, result: CellResult) -> None:
    """Write the result of a cell, which is then finished."""
    write_record(folder / RESULT_FILE, vars(result))


def played_episodes(folder: Path) -> int:
    """Episodes of the evaluation that are on disk."""
    for name in (EPISODES_FILE, PARTIAL_FILE):
        path = folder / EVALUATION_FOLDER / name
        if path.exists():
            return max(path.read_bytes().count(b"\n") - 1, 0)
    return 0


def read_study(folder: Path) -> dict[str, Any] | None:
    """What is known of a study; None where nothing is.

    Raises:
        UsageError: the file cannot be read.
    """
    path = folder / STUDY_FILE
    if not path.exists():
        return None
    study: dict[str, Any] = read_json(path, _PART, _REMEDY, _STUDY)
    return study


def write_study(folder: Path, study: Mapping[str, Any]) -> None:
    """Write what is known of a study."""
    write_record(folder / STUDY_FILE, dict(study))


def write_study_episodes(folder: Path, cells: Iterable[tuple[str, int | None]]) -> None:
    """Put the episodes of finished cells into one file, whole or not at all.

    Args:
        folder: of the study.
        cells: name and seed of the training, None without one, of every finished cell.
    """
    rows = [",".join(("cell", "training_seed", *COLUMN_NAMES)) + "\n"]
    for name, seed in cells:
        for episode in read_episodes(folder / CELLS_FOLDER / name / EVALUATION_FOLDER / EPISODES_FILE):
            rows.append(f"{name},{'' if seed is None else seed},{format_row(episode)}")
    write_text(folder / EPISODES_FILE, "".join(rows))
