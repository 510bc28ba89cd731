"""Labels as they are stored: what comes back, and what is refused."""

from __future__ import annotations

import hashlib
import io
import re
import zipfile
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forged import rewrite
from sample_labels import A_PUPIL, NO_PUPIL, made_up_labels, request_of, write_made_up_labels

from rl2grid.errors import UsageError
from rl2grid.records.label_folder import open_labels
from rl2grid.records.labels import (
    LABELS_FILE,
    Labels,
    MonthRow,
    joined,
    month_path,
    read_labels,
    write_month,
)

TASKS = ["bus14-T0", "bus14-R", "bus14-H0"]


def assert_equal(one: Labels, other: Labels) -> None:
    for each in fields(Labels):
        first, second = getattr(one, each.name), getattr(other, each.name)
        if first is None:
            assert second is None
        else:
            np.testing.assert_array_equal(first, second)
            assert first.dtype == second.dtype


@pytest.mark.parametrize("task", TASKS)
def test_labels_come_back_bit_by_bit(tmp_path: Path, task: str):
    written = write_made_up_labels(tmp_path / "a", task)
    description, labels = read_labels([tmp_path / "a"], f"rl2grid/{task}-v0")
    assert_equal(labels, joined(written))
    assert (description.months, description.rounds, description.gamma) == (2, 1, 0.99)
    assert description.teacher == "greedy"
    assert description.env_keywords["normalize"] == "physical"


def test_rounds_and_folders_follow_each_other(tmp_path: Path):
    first = write_made_up_labels(tmp_path / "a", "bus14-T0")
    second = write_made_up_labels(tmp_path / "a", "bus14-T0", of_round=A_PUPIL)
    third = write_made_up_labels(tmp_path / "b", "bus14-T0", teacher="planner", candidates=5)
    description, labels = read_labels([tmp_path / "a", tmp_path / "b"], "bus14-T0")
    assert_equal(labels, joined([*first, *second, *third]))
    assert (description.months, description.rounds, description.teacher) == (6, 2, "greedy, planner")
    assert labels.candidates.shape[1] == 5
    assert (labels.candidates[: 4 * 20, 3:] == -1).all()


def test_the_same_labels_make_the_same_bytes(tmp_path: Path):
    for name in ("a", "b"):
        write_made_up_labels(tmp_path / name, "bus14-T0")
    first, second = (month_path(tmp_path / name, 0, 1).read_bytes() for name in ("a", "b"))
    assert first == second


def test_a_month_without_a_decision_is_one(tmp_path: Path):
    write_made_up_labels(tmp_path, "bus14-T0", n=0)
    with pytest.raises(UsageError, match="holds no decision"):
        read_labels([tmp_path], "bus14-T0")


def test_months_may_be_added_to_a_round_and_not_taken_off(tmp_path: Path):
    request = request_of("bus14-T0")
    write_made_up_labels(tmp_path, "bus14-T0")
    with open_labels(tmp_path, request, {**NO_PUPIL, "months": 3}) as labels:
        assert (labels.number, sorted(labels.rows())) == (0, [0, 1])
    with pytest.raises(UsageError, match=r"Round 0 of .* is unfinished, 2 of 3 months are there: go on with `rl2grid"):
        read_labels([tmp_path], "bus14-T0")
    with pytest.raises(UsageError, match="has 3 months: ask for as many"), open_labels(tmp_path, request, NO_PUPIL):
        pass


def test_a_round_begins_when_the_one_before_is_complete(tmp_path: Path):
    request = request_of("bus14-T0")
    with pytest.raises(UsageError, match="holds no labels yet"), open_labels(tmp_path, request, A_PUPIL):
        pass
    with open_labels(tmp_path, request, NO_PUPIL):
        pass
    with pytest.raises(UsageError, match=r"Round 0 .* is unfinished"), open_labels(tmp_path, request, A_PUPIL):
        pass
    write_made_up_labels(tmp_path, "bus14-T0")
    with open_labels(tmp_path, request, A_PUPIL) as labels:
        assert labels.number == 1
    other = {**A_PUPIL, "pupil": {"policy_hash": "b2"}}
    with pytest.raises(UsageError, match=r"Round 1 .* is unfinished"), open_labels(tmp_path, request, other):
        pass


@pytest.mark.parametrize(
    ("change", "words"),
    [({"teacher": "planner"}, "different teacher"), ({"gamma": 0.9}, "different gamma"), ({"seed": 1}, "seed")],
)
def test_another_request_does_not_go_into_the_same_folder(tmp_path: Path, change: dict[str, Any], words: str):
    write_made_up_labels(tmp_path, "bus14-T0")
    with pytest.raises(UsageError, match=words), open_labels(tmp_path, request_of("bus14-T0", **change), NO_PUPIL):
        pass


def test_two_processes_do_not_write_the_same_folder(tmp_path: Path):
    request = request_of("bus14-T0")
    with (
        open_labels(tmp_path, request, NO_PUPIL),
        pytest.raises(UsageError, match="Another process is writing"),
        open_labels(tmp_path, request, NO_PUPIL),
    ):
        pass


def test_files_of_others_are_not_written_among(tmp_path: Path):
    (tmp_path / "mine.txt").touch()
    with pytest.raises(UsageError, match="holds other files"), open_labels(tmp_path, request_of("bus14-T0"), NO_PUPIL):
        pass


@pytest.mark.parametrize(
    ("task", "words"),
    [("bus14-T1", "labels of rl2grid/bus14-T0-v0, not of"), ("bus14-T9", "does not exist")],
)
def test_labels_of_another_task_are_refused(tmp_path: Path, task: str, words: str):
    write_made_up_labels(tmp_path, "bus14-T0")
    with pytest.raises(UsageError, match=words):
        read_labels([tmp_path], task)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("action_set_hash", "0", "had other actions"),
        ("observation_size", 7, "had other observations"),
        ("grid_hash", "0", "had other values of its grid"),
    ],
)
def test_labels_of_what_the_task_was_are_refused(tmp_path: Path, name: str, value: Any, words: str):
    write_made_up_labels(tmp_path, "bus14-T0")
    rewrite(tmp_path / LABELS_FILE, lambda contents: contents["identity"].update({name: value}))
    with pytest.raises(UsageError, match=words):
        read_labels([tmp_path], "bus14-T0")


def test_folders_must_agree(tmp_path: Path):
    write_made_up_labels(tmp_path / "a", "bus14-T0")
    write_made_up_labels(tmp_path / "b", "bus14-T0", gamma=0.9)
    with pytest.raises(UsageError, match=r"different gamma, 0\.99 and 0\.9"):
        read_labels([tmp_path / "a", tmp_path / "b"], "bus14-T0")
    with pytest.raises(UsageError, match="holds no labels"):
        read_labels([tmp_path / "a", tmp_path / "c"], "bus14-T0")
    with pytest.raises(UsageError, match="No folder"):
        read_labels([], "bus14-T0")
    with pytest.raises(UsageError, match="given twice: give each once"):
        read_labels([tmp_path / "a", tmp_path / "c" / ".." / "a"], "bus14-T0")


def test_a_changed_byte_is_noticed(tmp_path: Path):
    write_made_up_labels(tmp_path, "bus14-T0")
    path = month_path(tmp_path, 0, 1)
    content = path.read_bytes()
    for place in (0, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        with pytest.raises(UsageError, match=re.escape(f"{path} is no file of labels: it was changed")):
            read_labels([tmp_path], "bus14-T0")
    path.write_bytes(content[:100])
    with pytest.raises(UsageError, match="it was changed"):
        read_labels([tmp_path], "bus14-T0")


def test_a_month_of_another_folder_is_noticed(tmp_path: Path):
    write_made_up_labels(tmp_path / "a", "bus14-T0")
    write_made_up_labels(tmp_path / "b", "bus14-T0", seed=1)
    for target in (month_path(tmp_path / "a", 0, 0), month_path(tmp_path / "a", 0, 1)):
        month_path(tmp_path / "b", 0, 0).replace(target)
        with pytest.raises(UsageError, match="it is of another month or of other labels"):
            read_labels([tmp_path / "a"], "bus14-T0")
        write_made_up_labels(tmp_path / "b", "bus14-T0", seed=1)
        target.unlink()
        write_made_up_labels(tmp_path / "a", "bus14-T0")


def forge(path: Path, parts: dict[str, bytes]) -> None:
    """Replace parts of a file, and seal it again."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()} | parts
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, part in content.items():
            archive.writestr(name, part)
        archive.comment = bytes(64)
    sealed = buffer.getvalue()[:-64]
    path.write_bytes(sealed + hashlib.sha256(sealed).hexdigest().encode())


def npy(array: np.ndarray[Any, Any], shape: tuple[int, ...] | None = None) -> bytes:
    buffer = io.BytesIO()
    header = {"descr": array.dtype.str, "fortran_order": False, "shape": array.shape if shape is None else shape}
    np.lib.format.write_array_header_1_0(buffer, header)
    return buffer.getvalue() + array.tobytes()


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("month.json", b"{", "its month.json is no JSON"),
        ("month.json", b"{}", "request is missing"),
        ("weights.npy", b"x", "its weights is no array"),
        ("weights.npy", bytes(10**8), "would expand to 100000000 bytes"),
        ("weights.npy", npy(np.ones(3, np.float32)), r"its weights is float32 \[3\] instead of float32 \[20\]"),
        ("weights.npy", npy(np.ones(20)), "float64"),
        ("weights.npy", npy(np.ones(3, np.float32), (20,)), "has 12 bytes instead of 80"),
        ("weights.npy", npy(np.array([None] * 20)), "is object"),
        ("more.npy", npy(np.ones(20)), "it holds other arrays"),
    ],
)
def test_forged_files_are_refused_before_they_are_expanded(tmp_path: Path, name: str, content: bytes, words: str):
    write_made_up_labels(tmp_path, "bus14-T0")
    forge(month_path(tmp_path, 0, 0), {name: content})
    with pytest.raises(UsageError, match=words):
        read_labels([tmp_path], "bus14-T0")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"topology": np.full(20, 10**6)}, "a label is no action of the task"),
        ({"candidates": np.full((20, 3), -2)}, "a candidate is no action of the task"),
        ({"weights": np.full(20, np.nan, np.float32)}, "a weight"),
        ({"returns": np.full(20, np.inf)}, "not finite"),
        ({"n_steps": np.zeros(20, np.int64)}, "has no steps"),
        ({"ending": np.full(20, 3, np.int8)}, "ended in no known way"),
    ],
)
def test_what_no_teacher_can_have_said_is_refused(tmp_path: Path, change: dict[str, Any], words: str):
    write_made_up_labels(tmp_path, "bus14-T0")
    with open_labels(tmp_path, request_of("bus14-T0"), NO_PUPIL) as folder:
        row = MonthRow(folder.request, 0, 1, "generated/1000000-00", 1, 0, 100, 1.0, 20, 0, 20)
    write_month(month_path(tmp_path, 0, 1), row, replace(made_up_labels("bus14-T0", 20), **change))
    with pytest.raises(UsageError, match=words):
        read_labels([tmp_path], "bus14-T0")


def test_a_label_must_have_been_legal(tmp_path: Path):
    (labels, _) = write_made_up_labels(tmp_path, "bus14-T0")
    assert labels.masks is not None
    with open_labels(tmp_path, request_of("bus14-T0"), NO_PUPIL) as folder:
        row = folder.rows()[1]
    write_month(month_path(tmp_path, 0, 1), row, replace(labels, masks=np.zeros_like(labels.masks)))
    with pytest.raises(UsageError, match="an action that was not legal"):
        read_labels([tmp_path], "bus14-T0")
