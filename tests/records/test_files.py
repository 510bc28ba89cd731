"""Folders to write to: made, or refused in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rl2grid.errors import UsageError
from rl2grid.records.files import check_folder, make_folder


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
