"""Importing a scenario folder: everything that could go wrong without a word is refused."""

import bz2
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import folder as scenario_folder
from rl2grid.scenarios.bundled import bundled_folders
from rl2grid.scenarios.cache import data_folder
from rl2grid.scenarios.folder import read_folder
from rl2grid.scenarios.library import import_folder, load_scenario

BUS14 = load_grid("bus14")
Table = list[list[str]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of a bundled series whose name no other test uses."""
    return Path(shutil.copytree(bundled_folders(BUS14)["0000"], tmp_path / tmp_path.name))


def edit(folder: Path, name: str, change: Callable[[Table], None]) -> None:
    """Change the cells of a file, header in row 0, and store it uncompressed."""
    path = folder / f"{name}.csv.bz2"
    table = [line.split(";") for line in bz2.decompress(path.read_bytes()).decode().splitlines()]
    change(table)
    path.unlink()
    (folder / f"{name}.csv").write_text("\n".join(";".join(row) for row in table) + "\n")


def set_cell(row: int, column: int, value: str) -> Callable[[Table], None]:
    def change(table: Table) -> None:
        table[row + 1][column] = value

    return change


def drop_column(table: Table) -> None:
    for row in table:
        del row[3]


def drop_rows(table: Table) -> None:
    del table[-5:]


def reverse_columns(table: Table) -> None:
    for row in table:
        row.reverse()


def rename(old: str, new: str) -> Callable[[Table], None]:
    def change(table: Table) -> None:
        table[0][table[0].index(old)] = new

    return change


def test_a_copied_folder_gives_the_bundled_series(folder: Path) -> None:
    imported, bundled = import_folder(BUS14, folder), load_scenario("bus14", "bundled/0000")
    assert imported.id == f"folder/{folder.name}"
    assert imported.source == "folder"
    assert imported.content_hash == bundled.content_hash
    for name, array in bundled.arrays().items():
        np.testing.assert_array_equal(getattr(imported, name), array)


def test_plain_csv_in_another_order_of_columns_is_the_same(folder: Path) -> None:
    edit(folder, "prod_p", reverse_columns)
    assert import_folder(BUS14, folder).content_hash == load_scenario("bus14", "bundled/0000").content_hash


def test_a_changed_folder_is_read_again(folder: Path) -> None:
    import_folder(BUS14, folder)
    edit(folder, "load_p", set_cell(5, 0, "30.5"))
    assert import_folder(BUS14, folder).load_p[5, 0] == 30.5


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("load_p", drop_column, "load_p.csv lacks the columns load_4_3 of grid bus14"),
        ("load_p", rename("load_2_1", "load_2_9"), "load_p.csv, column load_2_9: grid bus14 has load_1_0"),
        ("prod_p", rename("gen_5_3", "gen_5_2"), "prod_p.csv, column gen_5_2 occurs twice"),
        ("load_q", set_cell(17, 2, "nan"), "load_q.csv, column load_3_2, row 17: 'nan' is no finite number"),
        ("load_q", set_cell(17, 2, "inf"), "load_q.csv, column load_3_2, row 17: 'inf' is no finite number"),
        ("load_q", set_cell(17, 2, ""), "load_q.csv, column load_3_2, row 17: '' is no finite number"),
        ("prod_v", set_cell(0, 1, "high"), "prod_v.csv, column gen_1_0, row 0: 'high' is no finite number"),
        ("load_p", lambda table: table[4].pop(), "load_p.csv, row 3 has 10 values: the 11 of the header"),
        ("load_p", lambda table: table.__delitem__(slice(1, None)), "load_p.csv has 0 rows"),
        ("prod_p", drop_rows, "prod_p.csv has 571 rows: the 576 of load_p are needed"),
        ("load_p_forecasted", drop_rows, "load_p_forecasted.csv has 571 rows: a multiple of the 576"),
        ("load_p", set_cell(9, 3, "-0.5"), "load_p.csv, column load_4_3, row 9: the load is -0.5 MW"),
        ("prod_p", set_cell(9, 1, "150"), "prod_p.csv, column gen_1_0, row 9: the generation is 150.0 MW, and"),
        ("prod_p", set_cell(9, 3, "150"), "prod_p.csv, column gen_5_2, row 9: the generation is 150.0 MW, and"),
        ("prod_p", set_cell(9, 3, "-5"), "prod_p.csv, column gen_5_2, row 9: the generation is -5.0 MW, and"),
    ],
)
def test_bad_tables_are_refused(folder: Path, name: str, change: Callable[[Table], None], message: str) -> None:
    edit(folder, name, change)
    with pytest.raises(UsageError) as error:
        import_folder(BUS14, folder)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
    assert not list(data_folder().rglob(f"folder.{folder.name}*.npy")), "nothing is imported by half"


@pytest.mark.parametrize(("file", "message"), [("load_q.csv.bz2", "load_q.csv"), ("start_datetime.info", "is missing")])
def test_missing_files_are_named(folder: Path, file: str, message: str) -> None:
    (folder / file).unlink()
    with pytest.raises(UsageError, match=message):
        import_folder(BUS14, folder)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("time_interval.info", "00:15", "rows must be 00:05 apart"),
        ("start_datetime.info", "yesterday", "a time such as 2019-01-05 23:55 is needed"),
        ("load_p.csv.bz2", "no archive", "a complete CSV file is needed"),
        ("hazards.csv", ";".join(BUS14.name_line) + ("\n" + ";".join("00000100000000000000")) * 576, "row 0: a hazard"),
    ],
)
def test_other_bad_files_are_refused(folder: Path, file: str, text: str, message: str) -> None:
    (folder / file).write_text(text)
    with pytest.raises(UsageError, match=message):
        import_folder(BUS14, folder)


def test_a_truncated_archive_is_refused(folder: Path) -> None:
    path = folder / "prod_p.csv.bz2"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UsageError, match="a complete CSV file is needed"):
        import_folder(BUS14, folder)


def test_an_archive_that_expands_without_end_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / "prod_p.csv.bz2"
    content = path.read_bytes()
    path.write_bytes(content + bz2.compress(b""))  # several streams in a row are one file
    before = read_folder(load_grid("bus14"), folder).arrays["prod_p"]
    monkeypatch.setattr(scenario_folder, "MAX_TABLE_BYTES", 2**22)
    path.write_bytes(bz2.compress(bytes(2**24)))
    assert path.stat().st_size < 200
    with pytest.raises(UsageError, match=r"prod_p\.csv\.bz2 cannot be read \(it expands to more than 4 MiB\)"):
        read_folder(load_grid("bus14"), folder)
    assert before.size


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"There is no scenario folder .*nowhere\."):
        import_folder(BUS14, tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("grid_id", "name"), [("bus36-M", "Scenario_april_000"), ("bus36-MO-v1", "Scenario_august_21_wk1")]
)
def test_interconnections_may_be_negative_and_renewables_above_pmax(grid_id: str, name: str) -> None:
    """As they are in Grid2Op's own series."""
    grid = load_grid(grid_id)
    scenario = import_folder(grid, bundled_folders(grid)[name])
    assert scenario.load_p.min() < 0
    assert grid_id == "bus36-M" or (scenario.prod_p > grid.gen_pmax).any()
