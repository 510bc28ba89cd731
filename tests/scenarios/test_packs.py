"""Packs: small, exact, checked."""

from __future__ import annotations

import time

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import cache, generated, library, packs
from rl2grid.scenarios.generator.month import raw_month
from rl2grid.scenarios.library import load_scenario
from rl2grid.scenarios.packs import read_raw, write_pack

SEED = 10_000
SIZES = {"bus14": 200_000, "bus36-MO-v0": 500_000, "bus118-M": 1_500_000, "bus118-MOB-v1": 1_500_000}


@pytest.fixture
def pack(tmp_path):
    path = tmp_path / "packs" / "10000-03.pack"
    write_pack(path, raw_month(load_grid("bus14"), SEED, 3))
    return path


@pytest.mark.parametrize(
    "grid_id", ["bus14", *(pytest.param(grid_id, marks=pytest.mark.slow) for grid_id in SIZES if grid_id != "bus14")]
)
def test_packs_give_back_every_integer_and_are_small(grid_id, tmp_path):
    raw = raw_month(load_grid(grid_id), SEED, 7)
    write_pack(tmp_path / "a.pack", raw)
    again = read_raw(tmp_path / "a.pack")
    assert again[:3] == raw[:3]
    for before, after in zip(raw[3:], again[3:], strict=True):
        assert after.dtype == np.int16
        assert np.array_equal(before, after)
    assert (tmp_path / "a.pack").stat().st_size < SIZES[grid_id]


def test_values_of_any_size_come_back(tmp_path):
    grid = load_grid("bus14")
    raw = raw_month(grid, SEED, 3)
    generator = np.random.default_rng(0)
    extremes = [generator.integers(-(2**15), 2**15, array.shape).astype(np.int16) for array in raw[3:]]
    write_pack(tmp_path / "a.pack", raw._replace(load_p=extremes[0], load_q=extremes[1], prod_p=extremes[2]))
    for before, after in zip(extremes, read_raw(tmp_path / "a.pack")[3:], strict=True):
        assert np.array_equal(before, after)


@pytest.mark.parametrize(
    "grid_id",
    ["bus14", *(pytest.param(grid_id, marks=pytest.mark.slow) for grid_id in ("bus118-M", "bus118-MOB-v1"))],
)
def test_a_month_that_was_played_before_is_opened_within_20_ms(grid_id, tmp_path, monkeypatch):
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))
    monkeypatch.setattr(cache, "_SETTLED", 0)
    before = load_scenario(grid_id, "generated/17-03")
    monkeypatch.setattr(generated, "_content", lambda grid, months: pytest.fail("the arrays were made again"))
    seconds = []
    for _ in range(5):
        library._load_generated_scenario.cache_clear()
        began = time.process_time()
        scenario = load_scenario(grid_id, "generated/17-03")
        seconds.append(time.process_time() - began)
    assert scenario is not before
    assert min(seconds) < 0.02
    base = scenario.load_p
    while isinstance(base, np.ndarray) and not isinstance(base, np.memmap) and base.base is not None:
        base = base.base
    assert isinstance(base, np.memmap) or type(base).__name__ == "mmap"


def test_damage_is_noticed(pack):
    content = bytearray(pack.read_bytes())
    content[-100] ^= 1
    pack.write_bytes(content)
    with pytest.raises(UsageError, match=r"Pack .* is damaged"):
        read_raw(pack)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "x.pack").write_text("not a pack")
    with pytest.raises(UsageError, match="is no pack"):
        read_raw(tmp_path / "x.pack")
    with pytest.raises(UsageError, match="cannot be read"):
        read_raw(tmp_path / "missing.pack")


def test_an_interrupted_writer_leaves_nothing_behind(tmp_path, monkeypatch):
    def interrupted(source, target):
        raise KeyboardInterrupt

    monkeypatch.setattr(packs.os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_pack(tmp_path / "a.pack", raw_month(load_grid("bus14"), SEED, 3))
    assert not (tmp_path / "a.pack").exists()
