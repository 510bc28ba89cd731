"""``rl2grid data``: what it does, and how it refuses."""

import bz2
import io
import shutil
from pathlib import Path

import filelock
import numpy as np
import pytest

from rl2grid.cli import data
from rl2grid.cli.main import main
from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import generated
from rl2grid.scenarios.bundled import bundled_folders
from rl2grid.scenarios.library import load_scenario

BUS14 = load_grid("bus14")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The data folder, empty, beside the working directory."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "data"))
    monkeypatch.delenv("RL2GRID_FULL_DATA", raising=False)
    return tmp_path / "data"


def refused(capsys, *command_line: str) -> str:
    """The one sentence with which a command line is refused."""
    assert main(["data", *command_line]) == 2
    (sentence,) = capsys.readouterr().err.strip().splitlines()
    assert sentence.startswith("rl2grid: ")
    assert sentence.endswith((".", "?"))
    return sentence


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_months_are_made_once_and_listed(capsys, folder: Path) -> None:
    assert main(["data", "make", "bus14", "--seed", "17", "--months", "3-4,7", "--workers", "1"]) == 0
    assert "3 months of bus14" in capsys.readouterr().out
    made = {month: generated.pack_path(BUS14, 17, month).stat().st_mtime_ns for month in (3, 4, 7)}
    assert main(["data", "make", "bus14", "--seed", "17", "--months", "3,4,5", "--workers", "1"]) == 0
    assert made[3] == generated.pack_path(BUS14, 17, 3).stat().st_mtime_ns
    assert generated.pack_path(BUS14, 17, 5).is_file()
    capsys.readouterr()
    assert main(["data", "list", "bus14"]) == 0
    output = capsys.readouterr().out
    assert "7 series" in output
    assert "4 months, seeds 17" in output
    assert "bus36" not in output


def test_a_year_of_training_is_said_to_be_in_the_library(capsys, folder: Path, monkeypatch) -> None:
    monkeypatch.setattr("rl2grid.cli.data.make_packs", lambda grid, months, workers: iter([len(months)]))
    assert main(["data", "make", "bus14", "--seed", "1000003"]) == 0
    assert f"12 months of bus14 are in {folder / 'series'}" in capsys.readouterr().out.replace("\n", "")


def test_months_of_a_split_are_made_and_counted(capsys, monkeypatch) -> None:
    assert main(["data", "make", "bus14", "--split", "test", "--months", "2", "--workers", "1"]) == 0
    assert "2 months of bus14" in capsys.readouterr().out
    main(["data", "list", "bus14"])
    assert "test 2/500" in capsys.readouterr().out


def test_an_interrupted_making_goes_on(capsys, monkeypatch) -> None:
    make = generated._make

    def interrupted(grid, seed, month):
        if month == 2:
            raise KeyboardInterrupt
        make(grid, seed, month)

    monkeypatch.setattr(generated, "_make", interrupted)
    command = ["data", "make", "bus14", "--seed", "3", "--months", "0-3", "--workers", "1"]
    assert main(command) == 130
    assert "the same command goes on" in capsys.readouterr().err
    assert files(generated.pack_folder(BUS14)) == ["03.lock", "3-00.pack", "3-01.pack"]
    monkeypatch.setattr(generated, "_make", make)
    assert main(command) == 0
    assert files(generated.pack_folder(BUS14)) == ["03.lock", *(f"3-0{month}.pack" for month in range(4))]


def test_a_scenario_goes_out_and_comes_back(capsys, folder: Path, tmp_path: Path) -> None:
    assert main(["data", "export", "bus14", "generated/17-03[0:400]", "mine"]) == 0
    assert "Wrote 400 rows of generated/17-03[0:400]" in capsys.readouterr().out
    assert main(["data", "import", "bus14", "mine"]) == 0
    assert "Imported folder/mine: 400 rows from " in capsys.readouterr().out
    np.testing.assert_array_equal(
        load_scenario("bus14", "folder/mine").prod_p, load_scenario("bus14", "generated/17-03[0:400]").prod_p
    )
    main(["data", "list", "bus14"])
    assert "imported" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("file", "edit", "part"),
    [
        ("load_p", lambda lines: [lines[0], lines[1], lines[2].replace(";", ";nan", 1), *lines[3:]], "row 1"),
        ("prod_p", lambda lines: [lines[0].replace("gen_1_0", "gen_9_9"), *lines[1:]], "column gen_9_9"),
        ("load_q", lambda lines: lines[:-3], "rows"),
        ("load_p", lambda lines: [lines[0], "-" + lines[1], *lines[2:]], "column load_1_0, row 0"),
        ("prod_p", lambda lines: [*lines[:4], "9" + lines[4], *lines[5:]], "row 3"),
    ],
)
def test_a_bad_folder_is_named_by_file_column_and_row(capsys, folder: Path, file: str, edit, part: str) -> None:
    shutil.copytree(bundled_folders(BUS14)["0000"], "bad")
    path = Path("bad") / f"{file}.csv.bz2"
    with io.TextIOWrapper(bz2.open(path)) as stream:
        lines = stream.read().splitlines()
    path.write_bytes(bz2.compress(("\n".join(edit(lines)) + "\n").encode()))
    sentence = refused(capsys, "import", "bus14", "bad")
    assert file in sentence
    assert part in sentence
    assert not (folder / "imported").exists()


@pytest.mark.parametrize(
    ("command_line", "part"),
    [
        (["frobnicate"], "choose from 'list', 'make'"),
        (["list", "bus15"], "choose one of bus14"),
        (["make", "bus15", "--seed", "1"], "choose one of bus14"),
        (["make", "bus14"], "--seed --split"),
        (["make", "bus14", "--seed", "one"], "--seed"),
        (["make", "bus14", "--seed", "-1"], "choose an integer from 0 to 2^63 - 1"),
        (["make", "bus14", "--seed", "1", "--months", "12"], "numbers from 0 to 11"),
        (["make", "bus14", "--seed", "1", "--months", "june"], "numbers from 0 to 11"),
        (["make", "bus14", "--seed", "1", "--months", "4-3"], "numbers from 0 to 11"),
        (["make", "bus14", "--seed", "1", "--workers", "0"], "at least 1 process"),
        (["make", "bus14", "--split", "bundled"], "choose from 'train', 'validation', 'test'"),
        (["make", "bus14", "--split", "train", "--months", "3"], "leave --months out"),
        (["make", "bus14", "--split", "test", "--months", "501"], "no first 501 months: choose from 1 to 500"),
        (["make", "bus14", "--split", "validation", "--months", "0-3"], "choose from 1 to 200"),
        (["import", "bus14", "nowhere"], "There is no scenario folder"),
        (["export", "bus14", "bundled/9", "mine"], "choose one of bundled/0000"),
        (["export", "bus14", "generated/7", "mine"], "must look like 17-03"),
        (["check", "bus15"], "choose one of bus14"),
        (["check", "bus14", "--years", "0"], "at least 1 is needed"),
        (["clean"], "add --yes"),
        (["download", "bus15"], "choose one of bus14"),
    ],
)
def test_refusals_are_one_sentence_and_write_nothing(capsys, folder: Path, command_line, part: str) -> None:
    assert part in refused(capsys, *command_line)
    # Copies of bundled series, which are there to be read, may be made of course.
    assert not [name for name in files(folder) if not name.startswith("series/")]
    assert not list(Path().iterdir())


def test_an_unreachable_dataset_is_one_sentence(capsys, monkeypatch) -> None:
    def unreachable(name: str) -> None:
        raise UsageError(f"Grid2Op's list of datasets, asked for {name}, cannot be read.")

    monkeypatch.setattr(data, "find_archive", unreachable)
    assert "asked for l2rpn_case14_sandbox" in refused(capsys, "download", "bus14")


def test_what_can_be_made_again_is_removed_after_asking(capsys, folder: Path, monkeypatch) -> None:
    main(["data", "export", "bus14", "generated/17-03[0:40]", "mine"])
    main(["data", "import", "bus14", "mine"])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda prompt: "")
    assert main(["data", "clean"]) == 0
    assert "Nothing was removed" in capsys.readouterr().out
    assert (folder / "packs").exists()
    assert main(["data", "clean", "--yes"]) == 0
    assert "MB" in capsys.readouterr().out
    assert [name for name in files(folder) if not name.endswith(".lock")] == ["imported/bus14/mine.npz"]
    assert load_scenario("bus14", "folder/mine").n_rows == 40


def test_what_is_being_made_is_left_alone_and_what_may_not_be_removed_is_told(
    capsys, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("packs/bus14/x/17-03.pack", "packs/bus14/x/18-03.pack", "series/v1/bus14/generated.3-00-a.npy"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(bytes(1000))
    with filelock.FileLock(folder / "packs/bus14/x/17.lock"):
        assert main(["data", "clean", "--yes"]) == 0
    shown = capsys.readouterr().out
    assert "2.0 kB" in shown
    assert "1 files that another process is making were left alone." in shown
    assert [name for name in files(folder) if not name.endswith(".lock")] == ["packs/bus14/x/17-03.pack"]

    def refuse(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(1, "Operation not permitted", str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    assert main(["data", "clean", "--yes"]) == 1
    captured = capsys.readouterr()
    assert "0 bytes" in captured.out
    assert captured.err == "rl2grid: 1 files may not be removed by this user.\n"


@pytest.mark.slow
def test_a_check_writes_a_page(capsys) -> None:
    assert main(["data", "check", "bus14", "--years", "1"]) == 0
    output = capsys.readouterr().out
    assert "Largest loading of a line" in output
    assert Path("reports/scenarios-bus14.html").stat().st_size > 100_000


def test_damaged_copies_are_found_and_removed(capsys, folder: Path) -> None:
    load_scenario("bus14", "bundled/0000")
    (copy,) = folder.glob("series/v1/bus14/bundled.0000-*.npy")
    with copy.open("r+b") as stream:
        stream.seek(-1, 2)
        stream.write(b"\x55")
    assert main(["data", "list", "bus14"]) == 0
    assert f"Removed {copy}, which was damaged" in capsys.readouterr().out
    assert not copy.exists()
    assert main(["data", "list", "bus14"]) == 0
    assert "Removed" not in capsys.readouterr().out


def test_progress_shows_rate_and_time_left(capsys) -> None:
    assert main(["data", "export", "bus14", "bundled/0000", "mine"]) == 0
    shown = capsys.readouterr().err
    assert "Writing mine" in shown
    assert "100%" in shown
    assert "values/s" in shown
    assert "0:00:00" in shown
    assert main(["data", "import", "bus14", "mine"]) == 0
    shown = capsys.readouterr().err
    assert "Reading mine" in shown
    assert "/s" in shown


def test_without_an_action_help_is_shown(capsys) -> None:
    assert main(["data"]) == 0
    assert "download" in capsys.readouterr().out
