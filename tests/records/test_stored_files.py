"""What is stored is verified when it is read: one sentence says which file is not what it should be, and why."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from forged import rewrite
from sample_folders import write_made_up_evaluation
from sample_results import episode

from rl2grid.errors import UsageError
from rl2grid.records.episodes import EPISODES_FILE, read_episodes, write_episodes
from rl2grid.records.evaluations import EVALUATION_FILE, load_evaluation
from rl2grid.records.files import (
    CHECKSUM,
    DamageWarning,
    check_own,
    misfit,
    opened_line,
    printable,
    read_json,
    sealed_line,
    write_record,
)
from rl2grid.records.metrics import METRICS_FILE, MetricsFile, read_rows, trained_seconds
from rl2grid.records.trainings import read_energy, read_tracking, write_energy, write_tracking

REMEDY = "make it again"


def read(path: Path, shape: Any = object) -> Any:
    return read_json(path, "a record", REMEDY, shape)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "it is empty"),
        (b"{", "line 1 is no JSON"),
        (b'{"a": \xff}', "byte 6 is no UTF-8"),
        (100_000 * b"[", "it is nested too deeply"),
        (b"1" * 10_000, "it holds a number that is too long"),
        (b"[]", "what it holds is no object"),
        (b'{"a": "1"}', "a is '1'"),
        (b'{"a": true}', "a is True"),
        (b'{"b": 1}', "a is missing"),
        (b'{"a": 1, "checksum": "0"}', "it was changed since it was written"),
    ],
)
def test_a_file_that_is_not_what_it_should_be_is_named_with_its_fault(tmp_path: Path, content: bytes, why: str):
    path = tmp_path / "file.json"
    path.write_bytes(content)
    with pytest.raises(UsageError) as refusal:
        read(path, {"a": int})
    assert str(refusal.value).startswith(f"{path} is no record: {why}")
    assert str(refusal.value).endswith(f"; {REMEDY}.")


def test_a_file_that_is_not_there_or_a_folder_is_named(tmp_path: Path):
    for path, why in ((tmp_path / "none", "No such file or directory"), (tmp_path, "Is a directory")):
        with pytest.raises(UsageError, match=f"cannot be read as a record: {why}"):
            read(path)


def test_shapes_are_looked_at_all_the_way_down():
    shape = {"cells": [{"cell": str, "survival": (float, type(None))}]}
    assert misfit({"cells": [{"cell": "a", "survival": 1}, {"cell": "b", "survival": None, "more": 1}]}, shape) is None
    assert misfit({"cells": [{"cell": "a", "survival": "1"}]}, shape) == "cells[0].survival is '1'"
    assert misfit({"cells": {}}, shape) == "cells is no list"


def test_every_flipped_bit_of_a_record_is_noticed_or_harmless(tmp_path: Path):
    path, value = tmp_path / "file.json", {"survival": 0.25, "cells": [1, 2], "name": "bus14"}
    write_record(path, value)
    assert read(path) == value
    whole = path.read_bytes()
    for place in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << place % 8
        path.write_bytes(damaged)
        try:
            found = read(path)
        except UsageError:
            continue
        assert {key: found.get(key) for key in value} == value  # a space, or the name of the checksum


def test_a_change_that_is_meant_leaves_the_checksum_out(tmp_path: Path):
    path = tmp_path / "file.json"
    write_record(path, {"survival": 0.25})
    assert CHECKSUM in json.loads(path.read_text())
    rewrite(path, lambda record: record.update(survival=0.5))
    assert read(path) == {"survival": 0.5}


def test_a_line_of_a_file_that_grows_has_its_checksum():
    line = sealed_line("1,2.5,charts/survival")
    assert opened_line(line) == "1,2.5,charts/survival"
    for place in range(8 * len(line)):
        damaged = bytearray(line.encode())
        damaged[place // 8] ^= 1 << place % 8
        assert opened_line(damaged.decode("latin-1")) is None


# --- Evaluations ----------------------------------------------------------------------------------------------------


def test_a_survival_that_was_edited_and_rows_of_another_evaluation_are_refused(tmp_path: Path):
    for name in ("one", "other"):
        write_made_up_evaluation(tmp_path / name, name)
    rows, theirs = tmp_path / "one" / EPISODES_FILE, (tmp_path / "other" / EPISODES_FILE).read_bytes()
    assert len(load_evaluation(tmp_path / "one").episodes) == 2
    for content in (rows.read_bytes().replace(b",0.5,false", b",0.6,false"), theirs):
        assert content != rows.read_bytes()
        before = rows.read_bytes()
        rows.write_bytes(content)
        with pytest.raises(UsageError, match=r"episodes\.csv was changed since it was written, or belongs to another"):
            load_evaluation(tmp_path / "one")
        rows.write_bytes(before)


def test_an_identity_without_its_hash_is_refused(tmp_path: Path):
    write_made_up_evaluation(tmp_path / "one")
    rewrite(tmp_path / "one" / EVALUATION_FILE, lambda record: record.update(identity_hash="0" * 16))
    with pytest.raises(UsageError, match="was changed: its identity does not have the hash"):
        load_evaluation(tmp_path / "one")


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"survival": 5.0}, "survival is 5.0, and must be from 0 to 1"),
        ({"survival": float("nan")}, "survival is nan, and must be from 0 to 1"),
        ({"episode_return": float("inf")}, "episode_return is inf, and must be a finite number"),
        ({"seed": -1}, "seed is -1, and must be from 0"),
        ({"episode_length": 0}, "episode_length is 0, and must be from 1"),
    ],
)
def test_values_that_no_episode_has_are_refused(tmp_path: Path, changes: dict[str, Any], why: str):
    write_episodes(tmp_path / EPISODES_FILE, [replace(episode(survival=0.5), **changes)])
    with pytest.raises(UsageError, match=f"Line 2 of .* is no episode: {why}"):
        read_episodes(tmp_path / EPISODES_FILE)


def test_a_short_row_is_named(tmp_path: Path):
    path = tmp_path / EPISODES_FILE
    write_episodes(path, [episode(), episode("june")])
    path.write_text("\n".join(line.rsplit(",", 3 * (k == 1))[0] for k, line in enumerate(path.read_text().split("\n"))))
    with pytest.raises(UsageError, match=r"Line 2 of .* is no episode: it has 39 values, and must have 42"):
        read_episodes(path)


def test_names_reach_nobody_with_what_moves_a_cursor_or_turns_text(tmp_path: Path):
    write_episodes(tmp_path / EPISODES_FILE, [episode(agent="\x1b[31mred\x07\u202eback")])
    (read_back,) = read_episodes(tmp_path / EPISODES_FILE)
    assert read_back.agent == " [31mred  back"
    assert printable("Grüße, 東京") == "Grüße, 東京"


# --- What only decorates --------------------------------------------------------------------------------------------


def test_a_damaged_account_is_set_aside_with_a_warning(tmp_path: Path):
    part = {"energy_kwh": 1.0, "co2_kg": 0.5, "cpu_seconds": 2.0, "wall_seconds": 3, "method": "estimate"}
    for number in (0, 1):
        write_energy(tmp_path, {**part, "parts": [part]})
        assert read_energy(tmp_path) == {**part, "parts": [part]}
        (tmp_path / "energy.json").write_text('{"parts": 3}')
        with pytest.warns(
            DamageWarning, match=r"energy\.json is no energy account: .* set aside as energy\.json\.damaged"
        ):
            assert read_energy(tmp_path) is None
        assert (tmp_path / f"energy.json.damaged{number or ''}").read_text() == '{"parts": 3}'
        assert not (tmp_path / "energy.json").exists()


def test_a_damaged_id_of_tracking_is_set_aside(tmp_path: Path):
    write_tracking(tmp_path, "abc")
    assert read_tracking(tmp_path) == "abc"
    (tmp_path / "wandb.json").write_bytes(b"\xff")
    with pytest.warns(DamageWarning, match="set aside"):
        assert read_tracking(tmp_path) is None


def test_of_damaged_metrics_the_sound_rows_are_kept(tmp_path: Path):
    file = MetricsFile(tmp_path)
    for step in (1, 2, 3):
        file.write(step, 10 * step, 0.5 * step, {"charts/survival": step / 7})
    file.close()
    path = tmp_path / METRICS_FILE
    path.write_text(path.read_text().replace("2,20,1.000", "2,20,9.000"))
    with pytest.raises(UsageError, match="metrics file: line 3 was changed; resuming the run sets it aside"):
        list(read_rows(path))
    assert trained_seconds(tmp_path) == 1.5
    with pytest.warns(DamageWarning, match=r"2 of its rows are kept\. It was set aside as metrics\.csv\.damaged"):
        MetricsFile(tmp_path, after_step=3).close()
    assert [row["step"] for row in read_rows(path)] == ["1", "3"]


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"a,b\n1,2\n", b"\n"])
def test_metrics_that_were_emptied_or_replaced_are_set_aside_with_a_word(tmp_path: Path, content: bytes):
    path = tmp_path / METRICS_FILE
    path.write_bytes(content)
    with pytest.warns(DamageWarning, match=r"0 of its rows are kept\. It was set aside as metrics\.csv\.damaged"):
        MetricsFile(tmp_path, after_step=3).close()
    assert (tmp_path / "metrics.csv.damaged").read_bytes() == content
    assert list(read_rows(path)) == []


def test_that_the_metrics_of_a_run_are_gone_is_said(tmp_path: Path):
    MetricsFile(tmp_path).close()  # a run that begins has none yet
    (tmp_path / METRICS_FILE).unlink()
    with pytest.warns(DamageWarning, match="metrics.csv is missing: what it said of the first 3 decisions is lost"):
        MetricsFile(tmp_path, after_step=3).close()
    assert list(read_rows(tmp_path / METRICS_FILE)) == []


# --- Folders of somebody else ---------------------------------------------------------------------------------------


def test_nothing_is_written_among_the_files_of_somebody_else(tmp_path: Path):
    for name in ("new", "empty", "own", "foreign"):
        if name != "new":
            (tmp_path / name).mkdir()
    (tmp_path / "own" / "mark").write_text("")
    (tmp_path / "foreign" / "thesis.tex").write_text("")
    for name in ("new", "empty", "own"):
        check_own(tmp_path / name, ("mark",), "report")
    with pytest.raises(UsageError, match="foreign holds other files, and no report: give an empty folder"):
        check_own(tmp_path / "foreign", ("mark",), "report")
    with pytest.raises(UsageError, match=r"thesis\.tex is a file: give a folder"):
        check_own(tmp_path / "foreign" / "thesis.tex", ("mark",), "report")
