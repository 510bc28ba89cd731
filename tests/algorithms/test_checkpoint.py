"""Checkpoints: complete or absent, loadable without executing code."""

from __future__ import annotations

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rl2grid.algorithms.checkpoint import load_checkpoint, save_checkpoint
from rl2grid.errors import UsageError

CONTENTS: dict[str, Any] = {
    "task": "rl2grid/bus14-T0-v0",
    "weights": {"layer": torch.arange(6, dtype=torch.float32).reshape(2, 3)},
    "arrays": [np.arange(3, dtype=np.float64), np.array(2.5), np.array([True, False]), np.zeros((0, 4), np.float32)],
    "betas": (0.9, 0.999),
    "large": 2**100,
    "text": "ohm",
    "nothing": None,
}


def test_values_come_back_as_they_were(tmp_path: Path):
    save_checkpoint(tmp_path / "c.pt", CONTENTS)
    loaded = load_checkpoint(tmp_path / "c.pt")
    assert torch.equal(loaded["weights"]["layer"], CONTENTS["weights"]["layer"])
    for mine, theirs in zip(loaded["arrays"], CONTENTS["arrays"], strict=True):
        assert mine.dtype == theirs.dtype
        assert mine.shape == theirs.shape
        np.testing.assert_array_equal(mine, theirs)
    for key in ("betas", "large", "text", "nothing"):
        assert loaded[key] == CONTENTS[key]


def test_no_code_is_executed_by_loading(tmp_path: Path):
    class Payload:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "executed"),)

    torch.save({"format": 1, "task": Payload()}, tmp_path / "c.pt")
    with pytest.raises(UsageError, match="not a checkpoint"):
        load_checkpoint(tmp_path / "c.pt")
    (tmp_path / "plain.pt").write_bytes(pickle.dumps(Payload(), protocol=2))
    with pytest.raises(UsageError, match="not a checkpoint"):
        load_checkpoint(tmp_path / "plain.pt")
    assert not (tmp_path / "executed").exists()


def test_what_could_not_be_loaded_is_not_saved(tmp_path: Path):
    with pytest.raises(TypeError, match="Path"):
        save_checkpoint(tmp_path / "c.pt", {"task": tmp_path})
    with pytest.raises(TypeError, match="bytes"):
        save_checkpoint(tmp_path / "c.pt", {"task": b"ohm"})
    assert not (tmp_path / "c.pt").exists()


def test_a_save_that_breaks_off_leaves_the_previous_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "c.pt"
    save_checkpoint(path, {**CONTENTS, "number": 1})
    save = torch.save

    def break_off(value: Any, file: Any) -> None:
        save(value, file)
        file.truncate(file.tell() // 2)
        raise KeyboardInterrupt

    monkeypatch.setattr(torch, "save", break_off)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(path, {**CONTENTS, "number": 2})
    assert load_checkpoint(path)["number"] == 1
    monkeypatch.undo()
    save_checkpoint(path, {**CONTENTS, "number": 3})
    assert load_checkpoint(path)["number"] == 3


def test_a_checkpoint_of_another_task_is_refused_in_one_sentence(tmp_path: Path):
    save_checkpoint(tmp_path / "c.pt", CONTENTS)
    with pytest.raises(UsageError, match=r"is of task 'rl2grid/bus14-T0-v0' and cannot .* 'rl2grid/bus14-T1-v0'\.$"):
        load_checkpoint(tmp_path / "c.pt", task="rl2grid/bus14-T1-v0")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not a checkpoint",
        b"PK\x03\x04 torn",
        b"step,grid_steps,wall_time,name,value\n",
        b"hello",
        b'{"format": 1}',
        b"2026-11-21T19:35:31+00:00 started at 0 of 384 decisions\n",
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, content: bytes):
    (tmp_path / "c.pt").write_bytes(content)
    with pytest.raises(UsageError, match="not a checkpoint"):
        load_checkpoint(tmp_path / "c.pt")


def test_a_torn_checkpoint_is_refused(tmp_path: Path):
    path = tmp_path / "c.pt"
    save_checkpoint(path, {**CONTENTS, "large": torch.zeros(20_000)})
    whole = path.read_bytes()
    for length in (10, len(whole) // 3, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(UsageError, match="not a checkpoint"):
            load_checkpoint(path)


def test_every_flipped_bit_is_noticed(tmp_path: Path):
    path = tmp_path / "c.pt"
    save_checkpoint(path, CONTENTS)
    whole = path.read_bytes()
    assert torch.load(path, weights_only=True)["format"] == 1  # still what torch.save writes
    places = np.random.default_rng(0).integers(0, 8 * len(whole), 200).tolist()
    for place in places:
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(UsageError, match="not a checkpoint"):
            load_checkpoint(path)


def test_what_expands_is_refused(tmp_path: Path):
    path = tmp_path / "c.pt"
    save_checkpoint(path, {**CONTENTS, "large": torch.zeros(100_000)})
    with zipfile.ZipFile(path) as plain, zipfile.ZipFile(tmp_path / "small.pt", "w", zipfile.ZIP_DEFLATED) as small:
        for part in plain.infolist():
            small.writestr(part.filename, plain.read(part))
    with pytest.raises(UsageError, match="it is compressed"):
        load_checkpoint(tmp_path / "small.pt")
    torch.save({"format": 1, "task": "t", "large": torch.zeros(1).expand(10**9)}, path)
    with pytest.raises(UsageError, match="it expands"):
        load_checkpoint(path)
    nested: list[Any] = []
    for _ in range(60):
        nested = [nested, nested]
    torch.save({"format": 1, "task": "t", "nested": nested}, path)
    with pytest.raises(UsageError, match="it expands"):
        load_checkpoint(path)


def test_a_missing_file_and_another_format_are_refused(tmp_path: Path):
    with pytest.raises(UsageError, match="does not exist"):
        load_checkpoint(tmp_path / "c.pt")
    torch.save({"format": 99}, tmp_path / "c.pt")
    with pytest.raises(UsageError, match="format"):
        load_checkpoint(tmp_path / "c.pt")
    torch.save({"format": 1}, tmp_path / "c.pt")
    with pytest.raises(UsageError, match="names no task"):
        load_checkpoint(tmp_path / "c.pt", task="rl2grid/bus14-T0-v0")
