"""Imported series: what is read back, and what is refused before it is expanded."""

from __future__ import annotations

from datetime import datetime

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.grids import load_grid
from rl2grid.scenarios import imported
from rl2grid.scenarios.folder import FolderContent

BUS14 = load_grid("bus14")


@pytest.fixture
def stored(tmp_path, monkeypatch):
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path))
    sizes = {"load_p": BUS14.n_load, "load_q": BUS14.n_load, "prod_p": BUS14.n_gen, "prod_v": BUS14.n_gen}
    arrays = {name: np.zeros((300, size), np.float32) for name, size in sizes.items()}
    return imported.store_imported(BUS14, "mine", FolderContent(datetime(2019, 1, 6), arrays))


def test_a_series_that_expands_to_more_than_years_is_not_expanded(stored, monkeypatch):
    assert imported._read(stored).arrays["load_p"].shape == (300, BUS14.n_load)
    monkeypatch.setattr(imported, "MAX_BYTES", 2**14)  # zeros take less than a kilobyte when they are packed
    assert stored.stat().st_size < 2**14
    monkeypatch.setattr(np, "load", lambda path: pytest.fail("it was expanded"))
    with pytest.raises(UsageError, match=r"mine\.npz is damaged \(it expands to more than"):
        imported.load_imported(BUS14, "mine")


def test_a_cut_series_is_refused(stored):
    stored.write_bytes(stored.read_bytes()[:-100])
    with pytest.raises(UsageError, match="import its folder again"):
        imported.load_imported(BUS14, "mine")
