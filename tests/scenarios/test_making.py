"""Months made ahead of their use."""

import shutil
from pathlib import Path

import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import making
from rl2grid.scenarios.generated import pack_folder, pack_path
from rl2grid.scenarios.library import make_scenarios
from rl2grid.scenarios.making import make_packs

BUS14 = load_grid("bus14")


@pytest.fixture(autouse=True)
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))


def packs(months: list[tuple[int, int]]) -> list[bytes]:
    return [pack_path(BUS14, *month).read_bytes() for month in months]


def test_making_skips_what_is_there() -> None:
    assert list(make_packs(BUS14, [(3, 1), (3, 0)], workers=1)) == [0, 1, 2]
    before = packs([(3, 0), (3, 1)])
    assert list(make_packs(BUS14, [(3, 0), (3, 1), (3, 2)])) == [2, 3]
    assert packs([(3, 0), (3, 1)]) == before


def test_processes_make_the_same_packs() -> None:
    months = [(3, 0), (3, 1), (4, 0)]
    assert sorted(make_packs(BUS14, months, workers=2))[-1] == 3
    made = packs(months)
    shutil.rmtree(pack_folder(BUS14))
    list(make_packs(BUS14, months, workers=1))
    assert packs(months) == made


def test_a_process_that_dies_or_cannot_write_ends_the_making(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    months = [(3, 0), (4, 0)]
    monkeypatch.setattr(making, "_MAKER", "import sys; sys.exit(7)")
    with pytest.raises(UsageError, match="made months of bus14 died with exit status 7"):
        list(make_packs(BUS14, months, workers=2))
    monkeypatch.undo()
    (tmp_path / "file").touch()
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "file"))
    with pytest.raises(UsageError, match="set RL2GRID_DATA to one that can"):
        list(make_packs(BUS14, months, workers=2))


def test_the_months_of_scenarios_are_made_once_each_and_recorded_series_are_there() -> None:
    made, total = make_scenarios(
        "bus14", ["generated/3-01", "generated/3-01+02", "generated/3-02[0:99]", "bundled/0000"]
    )
    assert total == 2
    assert list(made) == [0, 1, 2]
    with pytest.raises(UsageError, match="must look like 17-03"):
        make_scenarios("bus14", ["generated/3-12"])
