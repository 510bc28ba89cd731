"""The local copy: made once, checked, repaired, never half there."""

import json
import multiprocessing
import os
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.scenarios.cache import CachedSeries, cached_series
from rl2grid.scenarios.folder import FolderContent

START = datetime(2019, 1, 5, 23, 55)
KEY = "0123456789abcdef0123"


def content(scale: float = 1.0) -> FolderContent:
    load = np.arange(30, dtype=np.float32).reshape(10, 3) * np.float32(scale)
    return FolderContent(START, {"load_p": load, "load_p_forecast": load[:, None, :], "maintenance": load > 12})


def counted_build(log: Path) -> Callable[[], FolderContent]:
    def build() -> FolderContent:
        with log.open("a") as stream:
            stream.write("built\n")
        time.sleep(0.1)
        return content()

    return build


def load(log: Path) -> CachedSeries:
    return cached_series("bus14", "mix/some name", KEY, counted_build(log))


def load_in_process(folder: str, log: str, n_processes: int) -> str:
    """Load as soon as all processes are there."""
    meeting = Path(log).parent / "meeting"
    meeting.mkdir(exist_ok=True)
    (meeting / str(os.getpid())).touch()
    while len(list(meeting.iterdir())) < n_processes:
        time.sleep(0.001)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RL2GRID_DATA", folder)
        return load(Path(log)).content_hash


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "data"))
    return tmp_path / "data" / "series" / "v1" / "bus14"


def test_a_copy_is_made_once_and_holds_what_was_built(folder: Path, tmp_path: Path) -> None:
    for _ in range(3):
        series = load(tmp_path / "log")
    assert (tmp_path / "log").read_text() == "built\n"
    assert series.start_datetime == START
    for name, array in content().arrays.items():
        np.testing.assert_array_equal(series.arrays[name], array)
        assert series.arrays[name].dtype == array.dtype
        assert series.arrays[name].ctypes.data % 64 == 0
    assert sorted(path.suffix for path in folder.iterdir()) == [".json", ".lock", ".npy"]


@pytest.mark.parametrize("suffix", [".npy", ".json"])
@pytest.mark.parametrize("damage", ["missing", "empty", "truncated", "changed", "garbage"])
def test_a_damaged_copy_is_made_again(folder: Path, tmp_path: Path, suffix: str, damage: str) -> None:
    before = load(tmp_path / "log").content_hash
    (path,) = folder.glob(f"*{suffix}")
    raw = bytearray(path.read_bytes())
    if damage == "missing":
        path.unlink()
    elif damage == "changed":
        position = raw.index(b'"sha256": "') + 12 if suffix == ".json" else len(raw) - 3
        raw[position] = ord("0") if raw[position] != ord("0") else ord("1")
        path.write_bytes(raw)
    else:
        path.write_bytes({"empty": b"", "truncated": bytes(raw[: len(raw) // 2]), "garbage": b"[1]"}[damage])
    series = load(tmp_path / "log")
    assert (tmp_path / "log").read_text() == "built\nbuilt\n"
    assert series.content_hash == before
    np.testing.assert_array_equal(series.arrays["load_p"], content().arrays["load_p"])


def test_a_failed_build_leaves_nothing(folder: Path) -> None:
    def fail() -> FolderContent:
        raise UsageError("A file is bad.")

    with pytest.raises(UsageError, match=r"A file is bad\."):
        cached_series("bus14", "x", KEY, fail)
    assert not [path for path in folder.iterdir() if path.suffix != ".lock"]


def test_processes_wait_for_one_maker(folder: Path, tmp_path: Path) -> None:
    task = (str(folder.parents[2]), str(tmp_path / "log"), 3)
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        hashes = pool.starmap(load_in_process, [task] * 3, chunksize=1)
    assert len(set(hashes)) == 1
    assert (tmp_path / "log").read_text() == "built\n"


def test_another_source_makes_another_copy(folder: Path, tmp_path: Path) -> None:
    first = load(tmp_path / "log")
    second = cached_series("bus14", "mix/some name", KEY[::-1], lambda: content(2.0))
    assert second.arrays["load_p"][1, 0] == 2 * first.arrays["load_p"][1, 0]
    assert second.content_hash != first.content_hash
    assert len(list(folder.glob("*.npy"))) == 2


def test_the_hash_depends_on_values_and_time_only(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = load(tmp_path / "log").content_hash
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "elsewhere"))
    assert cached_series("bus36-M", "other", "f" * 20, content).content_hash == first
    later = FolderContent(datetime(2020, 1, 1), content().arrays)
    assert cached_series("bus36-M", "later", "f" * 20, lambda: later).content_hash != first


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "file" / "data"))
    with pytest.raises(UsageError, match="set RL2GRID_DATA to one that can"):
        cached_series("bus14", "x", KEY, content)


def test_the_manifest_describes_every_array(folder: Path, tmp_path: Path) -> None:
    load(tmp_path / "log")
    (path,) = folder.glob("*.json")
    record = json.loads(path.read_text())
    assert record["arrays"]["load_p_forecast"] == {"dtype": "<f4", "offset": 128, "shape": [10, 1, 3]}
    assert record["start_datetime"] == "2019-01-05T23:55:00"
