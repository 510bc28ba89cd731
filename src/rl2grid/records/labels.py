"""Labels: what a teacher decided in the states that it or its pupil met, as ``rl2grid teach`` stores them.

::

    labels.json              what was asked for: task, teacher, environment, rounds; written first
    round-0/00000.npz        the labels of one month, and what became of the month
    round-1/...              months in which a pupil acted and the teacher told what it would have done

A file of a month is written whole or not at all and ends with a SHA-256 of itself, so that nothing of a file that was
changed is looked at. Its arrays are those of :class:`Labels`, compressed; what they may be is known from the task
before any of them is expanded.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32, F64, I8, I64, Flags
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import action_set_hash
from rl2grid.mdp.features import observation_size
from rl2grid.records.files import checksum, misfit, not_what, read_json, write_bytes
from rl2grid.scenarios.episodes import MAX_STEPS

LABELS_FILE = "labels.json"
WENT_ON, GAME_OVER, COMPLETED = 0, 1, 2
"""How a transition ended, see :attr:`Labels.ending`."""
NO_CANDIDATE = -1
MOST_CANDIDATES = 64
"""Actions per decision that a folder may tell of."""
MOST_MONTHS = 100_000
"""Of a round: their numbers have five digits."""

_DIGEST_SIZE = 64
_MOST_HEADER = 2**16
"""Bytes of what a file says of its month, and of the description of an array."""
_HEADER = "month.json"
_WHAT = "a file of labels"
_REMEDY = "remove it, and the command that wrote it plays the month again"
_DESCRIPTION = {
    "task": str,
    "teacher": str,
    "teacher_identity": (dict, NoneType),
    "env_keywords": dict,
    "gamma": float,
    "thin": float,
    "seed": int,
    "candidates": int,
    "identity": {
        "grid_hash": str,
        "action_set_hash": (str, NoneType),
        "observation_size": int,
        "versions": dict,
    },
    "rounds": [{"months": int, "pupil": (dict, NoneType), "pupil_share": float, "command": str}],
}
_MONTH = {
    "request": str, "round": int, "number": int, "scenario": str, "seed": int, "start": int, "grid_steps": int,
    "survival": float, "decisions": int, "acted": int, "labels": int,
}  # fmt: skip


@dataclass(frozen=True)
class Labels:
    """n decisions, those of an episode one after the other, whose months follow each other."""

    observations: F32
    """float32 [n, observation_size], as the environment gives them; no statistics of a run have scaled them."""
    masks: Flags | None
    """bool [n, topology actions], which of them were legal; None on redispatching tasks."""
    topology: I64 | None
    """int64 [n], the teacher's topology action, which is legal; None on redispatching tasks."""
    injection: F32 | None
    """float32 [n, m], the teacher's continuous action in [-1, 1]; None on topology tasks."""
    aim: F32 | None
    """float32 [n, m], the continuous action that would bring injections at once where the teacher wants them: beyond
    [-1, 1] where that takes more than a step, ``injection`` where it does not tell; None on topology tasks."""
    candidates: I64
    """int64 [n, k], legal topology actions that the teacher considered, best first; :data:`NO_CANDIDATE`: it considered
    fewer. k is 0 where a teacher never says any."""
    values: F32
    """float32 [n, k], what it thinks of them, higher is better; 0 where there is no candidate."""
    weights: F32
    """float32 [n], how many decisions this one stands for: of those that ask for nothing, few are kept."""
    rewards: F64
    """float64 [n], discounted reward of the transition that was played from there."""
    n_steps: I64
    """int64 [n], its grid steps."""
    ending: I8
    """int8 [n], 0: the episode went on, 1: game over, 2: the month was completed with this transition."""
    pupil: Flags
    """bool [n], whether the action that was played is a pupil's, not the teacher's."""
    returns: F64
    """float64 [n], discounted sum of the rewards from there to the end of the episode as it was played, those of
    decisions that were left out included; what would have followed a completed month is not in it."""

    def __len__(self) -> int:
        return len(self.weights)


class LabelShape(NamedTuple):
    """What decides how large a label is."""

    observation_size: int
    n_topology_actions: int
    """0: the task has none."""
    n_injections: int
    """0: the task has none."""
    n_candidates: int

    def columns(self) -> dict[str, tuple[np.dtype[Any], tuple[int, ...]]]:
        """The kind of number of each array as it is stored, and the shape of what it says of one decision."""
        f32, i64 = np.dtype(np.float32), np.dtype(np.int64)
        columns: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {"observations": (f32, (self.observation_size,))}
        if self.n_topology_actions:
            columns["masks"] = np.dtype(np.uint8), (-(-self.n_topology_actions // 8),)
            columns["topology"] = i64, ()
        if self.n_injections:
            columns["injection"] = columns["aim"] = f32, (self.n_injections,)
        return columns | {
            "candidates": (i64, (self.n_candidates,)),
            "values": (f32, (self.n_candidates,)),
            "weights": (f32, ()),
            "rewards": (np.dtype(np.float64), ()),
            "n_steps": (i64, ()),
            "ending": (np.dtype(np.int8), ()),
            "pupil": (np.dtype(np.bool_), ()),
            "returns": (np.dtype(np.float64), ()),
        }

    @property
    def row_bytes(self) -> int:
        """Bytes of one label as it is stored, not compressed."""
        return sum(dtype.itemsize * int(np.prod(row)) for dtype, row in self.columns().values())


@dataclass(frozen=True)
class MonthRow:
    """What became of a month that was labelled."""

    request: str
    """Hash of what was asked for; see :func:`request_hash`."""
    round: int
    number: int
    """Of the month in its round."""
    scenario: str
    seed: int
    start: int
    """Row of the scenario at which it began."""
    grid_steps: int
    """Played."""
    survival: float
    """Share of the episode that was survived, by whoever acted."""
    decisions: int
    """Of the episode."""
    acted: int
    """Those in which the teacher does something."""
    labels: int
    """Decisions that were kept."""


@dataclass(frozen=True)
class LabelsDescription:
    """What labels were read, of one folder or of several that belong together."""

    task: str
    teacher: str
    """What tables call it; several are separated by commas."""
    env_keywords: Mapping[str, Any]
    """Keywords of the environments: ``heuristic``, ``normalize`` and all others but ``gamma``."""
    gamma: float
    """Discount of a grid step in ``rewards`` and ``returns``."""
    months: int
    rounds: int
    """The most of a folder: 1 without a pupil."""
    rows: tuple[MonthRow, ...]
    """The months, in the order of their labels."""
    identity: Mapping[str, Any]
    """``grid_hash``, ``action_set_hash``, ``observation_size``, ``versions``, and of each folder the months of its
    rounds in ``months`` and the hash of its labels in ``labels``."""


def label_shape(task: Task, candidates: int, operator_features: str | None = None) -> LabelShape:
    """The shape of the labels of a task whose environments observe these groups as well."""
    observed = observation_size(task.grid, task.kind, operator_features)
    return LabelShape(observed, task.n_topology_actions, task.n_injections, candidates)


def observed_groups(description: Mapping[str, Any]) -> str | None:
    """The operator features that the environments of labels observed."""
    groups: str | None = description["env_keywords"].get("operator_features")
    return groups


def task_identity(task: Task, operator_features: str | None = None) -> dict[str, Any]:
    """What labels and whoever learns of them must agree on: the grid, its actions, what is observed."""
    return {
        "grid_hash": task.grid.hash,
        "action_set_hash": action_set_hash(task.grid, task.level) if task.changes_topology else None,
        "observation_size": observation_size(task.grid, task.kind, operator_features),
    }


def request_hash(description: Mapping[str, Any], number: int) -> str:
    """Short hash of everything that decides what the months of a round are, but how many there are.

    Args:
        description: what :data:`LABELS_FILE` holds.
        number: of the round.
    """
    of_all = {name: value for name, value in description.items() if name != "rounds"}
    of_round = {name: description["rounds"][number][name] for name in ("pupil", "pupil_share")}
    return checksum([of_all, number, of_round])


def month_path(folder: Path, number: int, month: int) -> Path:
    """The file of a month of a round."""
    return folder / f"round-{number}" / f"{month:05d}.npz"


def is_labels(folder: Path) -> bool:
    """Whether a folder holds labels, all of them or not."""
    return (folder / LABELS_FILE).is_file()


def read_labels(folders: Sequence[Path], task_id: str) -> tuple[LabelsDescription, Labels]:
    """The labels of one folder or of several, checked.

    Args:
        folders: as ``rl2grid teach`` wrote them.
        task_id: the task that they are to be of.

    Raises:
        UsageError: a folder holds no labels of the task, not all that were asked for, was changed, was given twice, or
            does not belong to the others; or the actions or observations of the task are no longer what they were.
    """
    if not folders:
        raise UsageError("No folder of labels was given: give at least one that 'rl2grid teach' wrote.")
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise UsageError("A folder of labels was given twice: give each once.")
    task = find_task(task_id)
    descriptions = [read_labels_description(folder) for folder in folders]
    for folder, description in zip(folders, descriptions, strict=True):
        _check_task(folder, description, task)
        _check_together(folders[0], descriptions[0], folder, description)
    parts = [
        read_month(month_path(folder, number, month), shape, wanted, number, month)
        for folder, description in zip(folders, descriptions, strict=True)
        for shape in [label_shape(task, description["candidates"], observed_groups(description))]
        for number, each in enumerate(description["rounds"])
        for wanted in [request_hash(description, number)]
        for month in _complete(folder, number, each)
    ]
    labels = joined([labels for _, labels in parts])
    if len(labels) == 0:
        raise UsageError(f"{folders[0]} holds no decision: the agent was never asked in its months; label others.")
    first = descriptions[0]
    return LabelsDescription(
        task=first["task"],
        teacher=", ".join(dict.fromkeys(each["teacher"] for each in descriptions)),
        env_keywords=_tuples(first["env_keywords"]),
        gamma=float(first["gamma"]),
        months=len(parts),
        rows=tuple(row for row, _ in parts),
        rounds=max(len(each["rounds"]) for each in descriptions),
        identity={
            **first["identity"],
            "months": [[each["months"] for each in description["rounds"]] for description in descriptions],
            "labels": [checksum(each) for each in descriptions],
        },
    ), labels


def read_labels_description(folder: Path) -> dict[str, Any]:
    """What :data:`LABELS_FILE` of a folder says.

    Raises:
        UsageError: there is none, or it was changed.
    """
    if not is_labels(folder):
        raise UsageError(f"{folder} holds no labels: give a folder that 'rl2grid teach' wrote.")
    path, remedy = folder / LABELS_FILE, "give a folder as 'rl2grid teach' wrote it"
    description: dict[str, Any] = read_json(path, "a description of labels", remedy, _DESCRIPTION)
    for each in description["rounds"]:
        if not 1 <= each["months"] <= MOST_MONTHS:
            raise not_what(path, "a description of labels", f"a round has {each['months']} months", remedy)
    if not description["rounds"] or not 0 <= description["candidates"] <= MOST_CANDIDATES:
        raise not_what(path, "a description of labels", "it has no rounds, or too many candidates", remedy)
    return description


def joined(parts: Sequence[Labels]) -> Labels:
    """Labels of several months, those with fewer candidates filled up.

    Args:
        parts: at least one, of one task.
    """
    most = max(part.candidates.shape[1] for part in parts)
    columns: dict[str, Any] = {}
    for each in fields(Labels):
        values = [getattr(part, each.name) for part in parts]
        if each.name in ("candidates", "values"):
            fill = NO_CANDIDATE if each.name == "candidates" else 0
            values = [np.pad(v, ((0, 0), (0, most - v.shape[1])), constant_values=fill) for v in values]
        columns[each.name] = None if values[0] is None else np.concatenate(values)
    return Labels(**columns)


def write_month(path: Path, month: MonthRow, labels: Labels) -> None:
    """Write the labels of a month, whole or not at all; the same labels make the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        _add(archive, _HEADER, json.dumps(asdict(month)).encode())
        for each in fields(Labels):
            array = getattr(labels, each.name)
            if array is not None:
                stored = np.packbits(array, axis=1) if each.name == "masks" else array
                _add(archive, f"{each.name}.npy", _npy(stored))
        archive.comment = bytes(_DIGEST_SIZE)
    content = buffer.getvalue()[:-_DIGEST_SIZE]
    write_bytes(path, content + hashlib.sha256(content).hexdigest().encode())


def read_month(path: Path, shape: LabelShape, request: str, number: int, month: int) -> tuple[MonthRow, Labels]:
    """What :func:`write_month` wrote.

    Args:
        path: the file.
        shape: that its labels must have.
        request: hash of the request that it must be of.
        number: of its round.
        month: its number in the round.

    Raises:
        UsageError: it cannot be read, was changed, or is another month's.
    """
    with _opened(path, shape) as archive:
        row = _read_header(path, archive)
        if (row.request, row.round, row.number) != (request, number, month):
            raise not_what(path, _WHAT, "it is of another month or of other labels", _REMEDY)
        columns = shape.columns()
        names = {_HEADER, *(f"{name}.npy" for name in columns)}
        if set(archive.namelist()) != names or len(archive.infolist()) != len(names):
            raise not_what(path, _WHAT, "it holds other arrays than the labels of this task", _REMEDY)
        arrays = {name: _read_array(path, archive, name, row.labels, *kind) for name, kind in columns.items()}
    labels = _as_labels(arrays, shape)
    complaint = _misfit(labels, shape)
    if complaint:
        raise not_what(path, _WHAT, complaint, _REMEDY)
    return row, labels


def read_row(path: Path, shape: LabelShape) -> MonthRow:
    """What became of a month, without its labels; the file is checked as a whole.

    Raises:
        UsageError: it cannot be read, or was changed.
    """
    with _opened(path, shape) as archive:
        return _read_header(path, archive)


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    # ZipInfo has no time of its own: what is written depends on nothing but the content.
    info = zipfile.ZipInfo(name)
    info.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(info, content, compresslevel=6)


def _npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
    return buffer.getvalue()


def _opened(path: Path, shape: LabelShape) -> zipfile.ZipFile:
    """The archive in a file, once its checksum is the right one."""
    most = 2 * (MAX_STEPS * shape.row_bytes + (len(shape.columns()) + 1) * _MOST_HEADER)
    try:
        with path.open("rb") as file:
            content = file.read(most + 1)
        if len(content) > most:
            raise not_what(path, _WHAT, f"it is larger than any month of this task, {most} bytes", _REMEDY)
        if hashlib.sha256(content[:-_DIGEST_SIZE]).hexdigest().encode() != content[-_DIGEST_SIZE:]:
            raise not_what(path, _WHAT, "it was changed since it was written", _REMEDY)
        return zipfile.ZipFile(io.BytesIO(content))
    except OSError as error:
        raise UsageError(f"{path} cannot be read as {_WHAT}: {error.strerror or error}.") from None
    except zipfile.BadZipFile:
        raise not_what(path, _WHAT, "it is no archive", _REMEDY) from None


def _part(path: Path, archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """What a part expands to, if that is not more than it may be."""
    try:
        info = archive.getinfo(name)
        if info.file_size > most:
            raise not_what(path, _WHAT, f"its {name} would expand to {info.file_size} bytes", _REMEDY)
        with archive.open(info) as file:
            return file.read(most)
    except KeyError:
        raise not_what(path, _WHAT, f"{name} is missing", _REMEDY) from None
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError, zlib.error) as error:
        raise not_what(path, _WHAT, f"its {name} cannot be expanded ({error})", _REMEDY) from None


def _read_header(path: Path, archive: zipfile.ZipFile) -> MonthRow:
    try:
        header = json.loads(_part(path, archive, _HEADER, _MOST_HEADER))
    except (ValueError, RecursionError):
        raise not_what(path, _WHAT, f"its {_HEADER} is no JSON", _REMEDY) from None
    complaint = misfit(header, _MONTH)
    if complaint is None and set(header) != set(_MONTH):
        complaint = f"its {_HEADER} says more than a month has"
    if complaint is None and not 0 <= header["labels"] <= header["decisions"] <= MAX_STEPS:
        complaint = f"it has {header['labels']} labels of {header['decisions']} decisions"
    if complaint:
        raise not_what(path, _WHAT, complaint, _REMEDY)
    return MonthRow(**header)


def _read_array(
    path: Path, archive: zipfile.ZipFile, name: str, n: int, dtype: np.dtype[Any], row: tuple[int, ...]
) -> NDArray[Any]:
    size = n * dtype.itemsize * int(np.prod(row))
    content = _part(path, archive, f"{name}.npy", size + _MOST_HEADER)
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        if version != (1, 0):
            raise ValueError(f"version {version}")
        shape, fortran, kind = np.lib.format.read_array_header_1_0(file, max_header_size=_MOST_HEADER)
    except ValueError as error:
        raise not_what(path, _WHAT, f"its {name} is no array ({str(error).splitlines()[0]})", _REMEDY) from None
    if shape != (n, *row) or kind != dtype or fortran:
        found = f"{kind} {list(shape)} instead of {dtype} {[n, *row]}"
        raise not_what(path, _WHAT, f"its {name} is {found}", _REMEDY)
    values = content[file.tell() :]
    if len(values) != size:
        raise not_what(path, _WHAT, f"its {name} has {len(values)} bytes instead of {size}", _REMEDY)
    return np.frombuffer(values, dtype).reshape(shape)


def _as_labels(arrays: Mapping[str, NDArray[Any]], shape: LabelShape) -> Labels:
    columns: dict[str, Any] = {each.name: arrays.get(each.name) for each in fields(Labels)}
    if columns["masks"] is not None:
        columns["masks"] = np.unpackbits(columns["masks"], axis=1, count=shape.n_topology_actions).view(np.bool_)
    return Labels(**columns)


def _misfit(labels: Labels, shape: LabelShape) -> str | None:
    """What no teacher can have said, in words; None: nothing."""
    n_actions = shape.n_topology_actions
    told: list[NDArray[Any]] = [labels.observations, labels.values, labels.rewards, labels.returns]
    told += [] if labels.aim is None else [labels.aim]
    checks: list[tuple[bool, str]] = [
        (not all(bool(np.isfinite(each).all()) for each in told), "some of its numbers are not finite"),
        (not _within(labels.weights, 1.0, float(MAX_STEPS)), "a weight is below 1 or too large"),
        (not _within(labels.n_steps, 1, MAX_STEPS), "a transition has no steps, or too many"),
        (not _within(labels.ending, WENT_ON, COMPLETED), "a transition ended in no known way"),
        (not _within(labels.candidates, NO_CANDIDATE, n_actions - 1), "a candidate is no action of the task"),
    ]
    if labels.injection is not None:
        checks.append((not _within(labels.injection, -1.0, 1.0), "a continuous action is not within -1 and 1"))
    if labels.topology is not None and labels.masks is not None:
        known = _within(labels.topology, 0, n_actions - 1)
        checks.append((not known, "a label is no action of the task"))
        if known:
            legal = labels.masks[np.arange(len(labels)), labels.topology]
            checks.append((not bool(legal.all()), "a label is an action that was not legal"))
    return next((words for is_wrong, words in checks if is_wrong), None)


def _within(values: NDArray[Any], least: float, most: float) -> bool:
    """Whether all values are, none of them being no number."""
    return bool(((values >= least) & (values <= most)).all())


def _complete(folder: Path, number: int, of_round: Mapping[str, Any]) -> Iterable[int]:
    """The months of a round, all of which are there."""
    months = range(int(of_round["months"]))
    done = sum(month_path(folder, number, month).is_file() for month in months)
    if done < len(months):
        raise UsageError(
            f"Round {number} of {folder} is unfinished, {done} of {len(months)} months are there: go on with "
            f"`{of_round['command']}`."
        )
    return months


def _check_task(folder: Path, description: Mapping[str, Any], task: Task) -> None:
    if description["task"] != task.id:
        raise UsageError(f"{folder} holds labels of {description['task']}, not of {task.id}: label that task.")
    now = task_identity(task, observed_groups(description))
    for name, words in _DEFINES.items():
        if description["identity"][name] != now[name]:
            raise UsageError(f"{folder} was labelled when {task.id} had other {words}: label its months again.")


_DEFINES = {"grid_hash": "values of its grid", "action_set_hash": "actions", "observation_size": "observations"}


def _check_together(first: Path, one: Mapping[str, Any], other: Path, two: Mapping[str, Any]) -> None:
    """Refuse labels that would not mean the same side by side."""
    for name, words in (("env_keywords", "keywords of the environment"), ("gamma", "gamma")):
        if one[name] != two[name]:
            raise UsageError(
                f"{first} and {other} were labelled with different {words}, {one[name]} and {two[name]}: give folders "
                "that agree."
            )


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values read from JSON, where tuples are stored as lists."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
