"""The local copy: made once, checked, repaired, never half there."""

import json
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.scenarios import cache
from rl2grid.scenarios.cache import CachedSeries, cached_series, remove_damaged
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


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Files whose values were hashed since, where every file counts as settled."""
    files: list[Path] = []
    is_sound = cache._is_sound

    def counted(data: Path, record: dict) -> bool:
        files.append(data)
        return is_sound(data, record)

    monkeypatch.setattr(cache, "_is_sound", counted)
    monkeypatch.setattr(cache, "_SETTLED", 0)
    return files


def test_values_are_hashed_again_only_where_the_file_has_changed(folder: Path, tmp_path: Path, hashed: list) -> None:
    first = load(tmp_path / "log")
    for expected in (1, 1, 1):
        assert load(tmp_path / "log").content_hash == first.content_hash
        assert len(hashed) == expected
    (data,) = folder.glob("*.npy")
    os.utime(data)
    for _ in range(2):
        load(tmp_path / "log")
        assert len(hashed) == 2
    assert (tmp_path / "log").read_text() == "built\n"
    assert len(list(folder.iterdir())) == 3


@pytest.mark.parametrize("keep_time", [False, True])
def test_a_changed_value_is_found_after_the_copy_was_hashed(
    folder: Path, tmp_path: Path, hashed: list, keep_time: bool
) -> None:
    load(tmp_path / "log")
    load(tmp_path / "log")
    (data,) = folder.glob("*.npy")
    before = data.stat()
    with data.open("r+b") as stream:
        stream.seek(-3, os.SEEK_END)
        stream.write(b"\x07")
    if keep_time:
        os.utime(data, ns=(before.st_atime_ns, before.st_mtime_ns))
    series = load(tmp_path / "log")
    assert (tmp_path / "log").read_text() == "built\nbuilt\n"
    np.testing.assert_array_equal(series.arrays["load_p"], content().arrays["load_p"])


def test_a_file_that_has_just_changed_is_not_trusted(folder: Path, tmp_path: Path, hashed: list, monkeypatch) -> None:
    monkeypatch.setattr(cache, "_SETTLED", 60 * 10**9)
    for _ in range(3):
        load(tmp_path / "log")
    assert len(hashed) == 2


def test_what_changes_no_time_is_found_by_looking_at_every_copy(
    folder: Path, tmp_path: Path, hashed: list, monkeypatch
) -> None:
    monkeypatch.setattr(cache, "_status", lambda data: [1, 2, 3, 4])
    load(tmp_path / "log")
    load(tmp_path / "log")
    cached_series("bus14", "sound", "f" * 20, content)
    (data,) = folder.glob("mix*.npy")
    raw = bytearray(data.read_bytes())
    raw[-3] ^= 1
    data.write_bytes(raw)
    load(tmp_path / "log")
    assert (tmp_path / "log").read_text() == "built\n"
    assert remove_damaged("bus14") == [data]
    assert remove_damaged("bus14") == []
    assert [path.name for path in folder.glob("*.npy")] == ["sound-ffffffffffffffff.npy"]
    load(tmp_path / "log")
    assert (tmp_path / "log").read_text() == "built\nbuilt\n"


@pytest.mark.parametrize("edit", [('"offset": 128', '"offset": 64'), ("23:55", "23:50"), ("<f4", "<i4")])
def test_every_entry_of_the_manifest_counts(folder: Path, tmp_path: Path, hashed: list, edit: tuple[str, str]) -> None:
    before = load(tmp_path / "log").content_hash
    (manifest,) = folder.glob("*.json")
    assert edit[0] in manifest.read_text()
    manifest.write_text(manifest.read_text().replace(*edit))
    assert load(tmp_path / "log").content_hash == before
    assert (tmp_path / "log").read_text() == "built\nbuilt\n"


def test_a_folder_that_is_only_read_is_hashed_every_time(
    folder: Path, tmp_path: Path, hashed: list, monkeypatch
) -> None:
    load(tmp_path / "log")

    def refused(path: Path, text: str) -> None:
        raise PermissionError(path)

    monkeypatch.setattr(Path, "write_text", refused)
    for expected in (1, 2):
        load(tmp_path / "log")
        assert len(hashed) == expected


MANY = """
import resource, sys
from datetime import datetime
import numpy as np
from rl2grid.errors import UsageError
from rl2grid.scenarios.cache import cached_series
from rl2grid.scenarios.folder import FolderContent
resource.setrlimit(resource.RLIMIT_NOFILE, (40, int(sys.argv[1])))
content = FolderContent(datetime(2019, 1, 6), {"load_p": np.zeros((10, 3), np.float32)})
try:
    series = [cached_series("bus14", f"generated.{number}", "0" * 20, lambda: content) for number in range(80)]
    print(len(series))
except UsageError as error:
    print(error)
"""


@pytest.mark.parametrize(("most", "said"), [(200, "80"), (40, "This process has as many open files as it may")])
def test_more_months_are_mapped_than_a_process_may_have_files_at_first(folder: Path, most: int, said: str) -> None:
    command = [sys.executable, "-c", MANY, str(most)]
    environment = os.environ | {"PYTHONPATH": str(Path(cache.__file__).parents[2])}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert ended.stdout.startswith(said)
