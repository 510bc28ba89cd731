"""A study as it is stored: its cells, what came out of each, and all their episodes.

::

    study.json        cells, states, commands, identity hashes, minutes
    episodes.csv      all evaluated episodes of the finished cells
    cells/<cell>/     ``cell.json``, ``run/``, ``evaluation/`` and, at the very end, ``result.json``
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rl2grid.errors import UsageError
from rl2grid.records.episodes import COLUMN_NAMES, EPISODES_FILE, format_row, read_episodes
from rl2grid.records.evaluation_folder import PARTIAL_FILE
from rl2grid.records.files import write_json

STUDY_FILE, CELLS_FOLDER = "study.json", "cells"
CELL_FILE, RESULT_FILE = "cell.json", "result.json"
RUN_FOLDER, EVALUATION_FOLDER = "run", "evaluation"


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
    return dict(read_json(path)) if path.is_file() else None


def write_cell(folder: Path, cell: Mapping[str, Any]) -> None:
    """Make the folder of a cell."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / CELL_FILE, cell)


def is_cell_finished(folder: Path) -> bool:
    """Whether a cell has its result."""
    return (folder / RESULT_FILE).is_file()


def read_result(folder: Path) -> CellResult | None:
    """The result of a finished cell; None if it is not finished."""
    path = folder / RESULT_FILE
    return CellResult(**read_json(path)) if path.exists() else None


def write_result(folder: Path, result: CellResult) -> None:
    """Write the result of a cell, which is then finished."""
    write_json(folder / RESULT_FILE, vars(result))


def played_episodes(folder: Path) -> int:
    """Episodes of the evaluation that are on disk."""
    for name in (EPISODES_FILE, PARTIAL_FILE):
        path = folder / EVALUATION_FOLDER / name
        if path.exists():
            return max(path.read_text(encoding="utf-8").count("\n") - 1, 0)
    return 0


def read_study(folder: Path) -> dict[str, Any] | None:
    """What is known of a study; None where nothing is.

    Raises:
        UsageError: the file cannot be read.
    """
    path = folder / STUDY_FILE
    return dict(read_json(path)) if path.exists() else None


def write_study(folder: Path, study: Mapping[str, Any]) -> None:
    """Write what is known of a study."""
    write_json(folder / STUDY_FILE, study)


def write_study_episodes(folder: Path, cells: Iterable[tuple[str, int | None]]) -> None:
    """Put the episodes of finished cells into one file, whole or not at all.

    Args:
        folder: of the study.
        cells: name and seed of the training, None without one, of every finished cell.
    """
    path = folder / EPISODES_FILE
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with temporary.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(("cell", "training_seed", *COLUMN_NAMES)) + "\n")
        for name, seed in cells:
            for episode in read_episodes(folder / CELLS_FOLDER / name / EVALUATION_FOLDER / EPISODES_FILE):
                file.write(f"{name},{'' if seed is None else seed},{format_row(episode)}")
    os.replace(temporary, path)


def read_json(path: Path) -> Any:
    """A file of a study.

    Raises:
        UsageError: it cannot be read.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"{path} cannot be read as part of a study: {error}.") from None
