"""Files are written whole or not at all; folders to write to are made, or refused in one sentence."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from rl2grid.errors import UsageError
from rl2grid.records.files import (
    check_folder,
    in_file_name,
    make_folder,
    read_json,
    write_json,
    write_record,
    write_text,
)


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
    check_folder(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_file_is_no_folder_that_could_be_made(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"file is a file: give a folder\.$"):
        check_folder(tmp_path / "file")


def test_a_folder_below_one_that_may_not_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(UsageError, match=r"may not be written\.$"):
        check_folder(tmp_path / "a")


@pytest.mark.parametrize(
    ("find", "replace", "refused"),
    [
        ("41", "42", True),
        ('"checksum"', '"checksul"', True),
        ('41,\n  "checksum"', '42,\n  "chmcksum"', True),
        ("", "", False),
    ],
)
def test_a_record_is_read_as_it_was_written_or_not_at_all(tmp_path: Path, find: str, replace: str, refused: bool):
    path = tmp_path / "record.json"
    write_record(path, {"name": "one", "number": 41})
    assert path.read_text().count(find) >= 1
    path.write_text(path.read_text().replace(find, replace))
    if refused:
        with pytest.raises(UsageError, match="it was changed since it was written"):
            read_json(path, "a record", "write it again")
    else:
        assert read_json(path, "a record", "write it again") == {"name": "one", "number": 41}


def test_a_record_whose_checksum_was_removed_is_meant(tmp_path: Path):
    path = tmp_path / "record.json"
    path.write_text('{"number": 42}')
    assert read_json(path, "a record", "write it again") == {"number": 42}


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("ppo", "ppo"),
        ("dc-opf+1.5", "dc-opf+1.5"),
        ("../../x", "..-..-x"),
        ("mine<!--<script>{data}\x1b[31m", "mine----script-data-31m"),
        ("n" * 500, "n" * 120),
        ("网" * 500, "网" * 40),
    ],
)
def test_a_text_becomes_a_part_of_the_name_of_a_file(text: str, part: str, tmp_path: Path):
    assert in_file_name(text) == part
    (tmp_path / f"before-{part}.html").touch()
    assert [path.parent for path in tmp_path.rglob("*.html")] == [tmp_path]
