"""Files are written whole or not at all; folders to write to are made, or refused in one sentence."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from rl2grid.errors import UsageError
from rl2grid.records.files import check_folder, make_folder, write_json, write_text


def test_a_file_that_cannot_be_written_whole_stays_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_json(tmp_path / "file", {"a": 1})
    before = (tmp_path / "file").read_bytes()
    assert before == b'{\n  "a": 1\n}\n'
    with pytest.raises(UnicodeEncodeError):
        write_text(tmp_path / "file", 1000 * "words" + "\ud800")
    assert (tmp_path / "file").read_bytes() == before

    def killed(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_text(tmp_path / "file", "half a file")
    assert (tmp_path / "file").read_bytes() == before


def test_a_folder_is_made_with_those_above_it_and_may_exist(tmp_path: Path):
    for _ in range(2):
        make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


@pytest.mark.parametrize("refuse", [make_folder, check_folder])
def test_a_folder_below_a_file_is_refused(tmp_path: Path, refuse: Callable[[Path], None]):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "a", tmp_path / "file" / "a" / "b"):
        with pytest.raises(UsageError, match=r"^Folder .*[ab] cannot be made: .*\.$"):
            refuse(path)


def test_looking_makes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    check_folder(Path("a") / "b")
    assert not list(tmp_path.iterdir())


def test_a_folder_below_one_that_may_not_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(UsageError, match=r"may not be written\.$"):
        check_folder(tmp_path / "a")
