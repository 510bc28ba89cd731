"""Months made ahead of their use."""

import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import making, training_years
from rl2grid.scenarios.generated import pack_folder, pack_path
from rl2grid.scenarios.library import make_scenarios
from rl2grid.scenarios.making import MAKERS, make_library_beside, make_packs
from rl2grid.scenarios.splits import TRAINING_SEEDS
from rl2grid.scenarios.training_years import is_year_there, training_year

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


def test_the_library_is_made_beside_and_its_makers_end_with_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    stops: list[Callable[[], None]] = []
    monkeypatch.setenv(MAKERS, "2")
    monkeypatch.setattr(making, "_IDLE_MAKER", making._MAKER)  # other tests leave no time
    monkeypatch.setattr(making.atexit, "register", stops.append)
    hash_here = training_year(BUS14, TRAINING_SEEDS[1]).content_hash
    make_library_beside(BUS14)
    make_library_beside(BUS14)
    assert len(stops) == 2, "once per process"
    until = time.monotonic() + 60
    while sum(is_year_there(BUS14, seed) for seed in TRAINING_SEEDS) < 5:
        assert time.monotonic() < until, "nobody makes the library"
        time.sleep(0.05)
    for stop in stops:
        stop()
    assert training_year(BUS14, TRAINING_SEEDS[0]).load_p.any()
    training_years._open_year.cache_clear()
    assert training_year(BUS14, TRAINING_SEEDS[1]).content_hash == hash_here


def test_nothing_is_made_beside_where_nobody_shall_or_all_is_there_or_has_no_room(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(making, "_Maker", None)
    make_library_beside(BUS14)  # no makers in tests
    monkeypatch.setenv(MAKERS, "3")
    monkeypatch.setattr(making, "is_stored", lambda grid, seed, month: True)
    making._make_beside.cache_clear()
    make_library_beside(BUS14)
    monkeypatch.setattr(making, "is_stored", lambda grid, seed, month: False)
    monkeypatch.setattr(training_years, "free_bytes", lambda: 10**9)  # less than the library and what is left to others
    making._make_beside.cache_clear()
    make_library_beside(BUS14)
    monkeypatch.setenv(MAKERS, "many")
    making._make_beside.cache_clear()
    with pytest.raises(UsageError, match="RL2GRID_MAKERS=many is no number of processes"):
        make_library_beside(BUS14)


def test_training_years_are_made_ahead_a_year_at_a_time() -> None:
    seed = TRAINING_SEEDS[2]
    assert list(make_packs(BUS14, [(seed, 3), (seed, 4)], workers=1)) == [0, 1, 2]
    assert is_year_there(BUS14, seed)
    assert list(make_packs(BUS14, [(seed, 5)], workers=1)) == [1]


def test_months_that_do_not_fit_are_refused_before_any_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(making, "free_bytes", lambda: 10**6)
    with pytest.raises(UsageError, match=r"^20 months of bus14 are still to be made and take up to 2 MB in .*1 MB are"):
        next(make_packs(BUS14, [(seed, 0) for seed in range(910, 930)]))
    assert not any(making.is_stored(BUS14, seed, 0) for seed in range(910, 930))
