"""A collection of evaluations and training runs: what tables and figures are made from, found in some folders.

A folder is one of

- an evaluation, as ``rl2grid evaluate`` writes it;
- a run, as ``rl2grid train`` writes it; the evaluations below it are taken too;
- a folder with evaluations in ``evaluation/``, such as that of an agent without training;
- what ``rl2grid demo`` writes: the run in ``run/`` and all evaluations in ``evaluation/``;
- a study, as ``rl2grid study run`` writes it: the run and the evaluation of every finished cell; or one of its cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rl2grid.errors import UsageError
from rl2grid.records.evaluations import Evaluation, is_evaluation, load_evaluation
from rl2grid.records.studies import (
    CELLS_FOLDER,
    EVALUATION_FOLDER,
    RUN_FOLDER,
    STUDY_FILE,
    is_cell_finished,
    read_cell,
    read_study,
)
from rl2grid.records.trainings import TrainingRun, is_run, read_training_run
from rl2grid.scenarios.splits import VALIDATION

LAST_POLICY = "checkpoint"
"""What the evaluations of a run's last policy are named after, which stand beside those of its best."""


@dataclass
class Collection:
    """Evaluations and runs in the order given."""

    evaluations: list[Evaluation] = field(default_factory=list)
    runs: list[TrainingRun] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    """One sentence for each thing that was to be expected and is not there."""


def collect(folders: Sequence[str], split: str | None = None) -> Collection:
    """What the folders hold.

    Args:
        folders: each ``FOLDER`` or ``LABEL=FOLDER``; the label is what tables and figures call it.
        split: whose evaluations are taken; None: validation, and of a study or a demonstration those that it made.

    Raises:
        UsageError: a folder that holds nothing of the kind, or from which something is missing.
    """
    collection = Collection()
    for words in folders:
        label, folder = parse_folder(words)
        if not folder.is_dir():
            raise UsageError(f"{folder} is no folder: give folders that 'rl2grid' wrote.")
        study = _study_folder(folder)
        if study is not None and label is not None:
            raise UsageError(f"A study has names of its own: give {folder} without {label}=.")
        if study is not None:
            _add_study(collection, study, split)
        elif (cell := read_cell(folder)) is not None:
            _add_cell(collection, folder, cell, label)
        elif is_run(folder / RUN_FOLDER):
            _add_demonstration(collection, folder, label, split)
        else:
            _add_folder(collection, folder, label, split or VALIDATION)
    return collection


def parse_folder(words: str) -> tuple[str | None, Path]:
    """Label and folder; a folder whose own name has an equals sign is a folder.

    Raises:
        UsageError: the label or the folder is empty.
    """
    label, equals, folder = words.partition("=")
    if not equals or Path(words).exists():
        return None, Path(words)
    if not label or not folder:
        raise UsageError(f"{words!r} is not allowed: give FOLDER or LABEL=FOLDER.")
    return label, Path(folder)


def find_evaluations(folder: Path, split: str) -> list[Path]:
    """The folder itself, or those below it of the split, which 'rl2grid evaluate' names after what else was asked."""
    if is_evaluation(folder):
        return [folder]
    return _evaluations_below(folder, split)


def _evaluations_below(folder: Path, name: str) -> list[Path]:
    below = (folder / EVALUATION_FOLDER).glob(f"{name}*")
    return sorted(path for path in below if is_evaluation(path))


def was_evaluated(run: Path, split: str) -> bool:
    """Whether a run, or the cell of a study that it is of, was evaluated on a split."""
    cell = read_cell(run.parent)
    of_cell = cell is not None and cell["split"] == split and is_evaluation(run.parent / EVALUATION_FOLDER)
    return of_cell or bool(find_evaluations(run, split) + _evaluations_below(run, f"{LAST_POLICY}-{split}"))


def _add_folder(collection: Collection, folder: Path, label: str | None, split: str) -> None:
    evaluations = find_evaluations(folder, split)
    last = [] if is_evaluation(folder) else _evaluations_below(folder, f"{LAST_POLICY}-{split}")
    collection.evaluations += [_named(load_evaluation(evaluation), label) for evaluation in evaluations]
    collection.evaluations += [_named(load_evaluation(one), label and f"{label} (last)") for one in last]
    if is_run(folder):
        run = read_training_run(folder, label)
        _add_run(collection, run)
        if not evaluations:
            collection.missing.append(
                f"Run {folder} was not evaluated on {split}: rl2grid evaluate {folder} {run.task} --split {split}"
            )
    elif not evaluations:
        raise UsageError(
            f"{folder} holds neither a run nor a study nor an evaluation on {split}: give folders that "
            "'rl2grid train', 'rl2grid study run' or 'rl2grid evaluate' wrote."
        )


def _add_demonstration(collection: Collection, folder: Path, label: str | None, split: str | None) -> None:
    if label is not None:
        raise UsageError(f"A demonstration has names of its own: give {folder} without {label}=.")
    evaluations = [load_evaluation(path) for path in _evaluations_below(folder, "")]
    taken = [result for result in evaluations if split in (None, result.identity["split"])]
    if not taken:
        wanted = "evaluation" if split is None else f"evaluation on {split}"
        raise UsageError(f"The demonstration {folder} has no {wanted} yet: 'rl2grid demo' goes on with it.")
    collection.evaluations += taken
    collection.runs.append(read_training_run(folder / RUN_FOLDER))


def _study_folder(folder: Path) -> Path | None:
    """The folder of a study, or that of its only scale."""
    if (folder / STUDY_FILE).is_file():
        return folder
    scales = sorted(path.parent for path in folder.glob(f"*/{STUDY_FILE}"))
    if len(scales) > 1:
        raise UsageError(f"{folder} holds several studies: give one of {', '.join(map(str, scales))}.")
    return scales[0] if scales else None


def _add_study(collection: Collection, folder: Path, split: str | None) -> None:
    taken = 0
    for entry in (read_study(folder) or {"cells": []})["cells"]:
        place = folder / CELLS_FOLDER / entry["cell"]
        if not is_cell_finished(place):
            collection.missing.append(f"Cell {place.name} of the study {folder} is not finished.")
            continue
        cell = read_cell(place)
        if cell is None or cell["name"] != place.name:
            raise UsageError(f"{place} does not hold the cell {place.name}: run the study again with the same command.")
        played = cell["split"]
        if split not in (None, played):
            collection.missing.append(
                f"Cell {place.name} of the study {folder} was evaluated on {played}, not on {split}."
            )
            continue
        _add_cell(collection, place, cell, None)
        taken += 1
    if not taken:
        wanted = "finished cell" if split is None else f"finished cell that was evaluated on {split}"
        raise UsageError(f"The study {folder} has no {wanted} yet: 'rl2grid study status' says how far it is.")


def _add_cell(collection: Collection, folder: Path, cell: Mapping[str, Any], given: str | None) -> None:
    """One cell of a study: under the label given, else under that of its group."""
    label = given or _cell_label(cell)
    collection.evaluations.append(_named(load_evaluation(folder / EVALUATION_FOLDER), label))
    if cell["training"] is not None:
        curve = label if given or not label or not cell["heuristic"] else f"{label} + {cell['heuristic']}"
        _add_run(collection, read_training_run(folder / RUN_FOLDER, curve))


def _add_run(collection: Collection, run: TrainingRun) -> None:
    """A run has a curve if it plays: who learns from labels has none."""
    if run.curve.is_of_play:
        collection.runs.append(run)


def _cell_label(cell: Mapping[str, Any]) -> str | None:
    """Agent and label of the cell's group; None without a label. A cell is named after what it is made of."""
    task, heuristic, training = cell["task"].removeprefix("rl2grid/"), cell["heuristic"], cell["training"]
    before = "-".join(part for part in (task, cell["agent"], heuristic) if part)
    after = "" if training is None else f"-{training['seed']}"
    label = cell["name"].removeprefix(before).removesuffix(after).strip("-")
    return f"{cell['agent']} {label}" if label else None


def _named(result: Evaluation, label: str | None) -> Evaluation:
    if label is None:
        return result
    return replace(result, episodes=tuple(replace(episode, agent=label) for episode in result.episodes))
