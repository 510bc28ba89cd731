"""Logs: lines are appended, and the last one is found whatever a killed process left."""

from __future__ import annotations

import re
from pathlib import Path

from rl2grid.records.logs import last_line, note, open_log


def test_lines_are_appended_with_their_time(tmp_path: Path):
    note(tmp_path, "started at 0 of 384 decisions")
    note(tmp_path, "ärger")
    first, second = (tmp_path / "log.txt").read_text(encoding="utf-8").splitlines()
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00 started at 0 of 384 decisions", first)
    assert second.endswith("+00:00 ärger")


def test_the_last_line_is_the_last_one_with_something_in_it(tmp_path: Path):
    assert last_line(tmp_path) is None
    with open_log(tmp_path) as log:
        log.write("\n \n")
    assert last_line(tmp_path) is None
    with open_log(tmp_path) as log:
        log.write("Traceback\n  MemoryError: no more\n\n")
    assert last_line(tmp_path) == "MemoryError: no more"
    (tmp_path / "log.txt").write_bytes(b"whole\nhalf of a \xc3")
    assert last_line(tmp_path) == "half of a \N{REPLACEMENT CHARACTER}"
