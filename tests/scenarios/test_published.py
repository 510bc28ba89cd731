"""Held-out months that are not the published ones are named, and played."""

import hashlib
import json
import warnings
from pathlib import Path

import numpy as np
import pytest

from rl2grid.cli import data
from rl2grid.cli.main import main
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.scenarios import generated, library, published
from rl2grid.scenarios.library import load_scenario
from rl2grid.scenarios.packs import read_raw
from rl2grid.scenarios.published import DeviationWarning, compare_with_published, hash_of_series, hash_pack

BUS14 = load_grid("bus14")
NAMES = ("17-03", "17-04")


@pytest.fixture
def manifest(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """What was published of bus14: a month as it is, and one of which a hash differs."""
    for _ in generated.make_packs(BUS14, [(17, 3), (17, 4)], workers=1):
        pass
    hashes = {"17-03": hash_pack(BUS14, "17-03"), "17-04": "0" * 64}
    monkeypatch.setattr(published, "_manifest", lambda: {generated.VERSION: {"bus14": hashes}})
    monkeypatch.setattr(published, "_warned", set())
    library._load_generated_scenario.cache_clear()
    return hashes


def test_the_hash_is_of_the_integers_of_the_month(manifest) -> None:
    raw = read_raw(generated.pack_path(BUS14, 17, 3))
    digest = hashlib.sha256()
    for name in ("load_p", "load_q", "prod_p"):
        matrix = getattr(raw, name)[:8065]
        digest.update(f"{name} {matrix.shape}".encode() + matrix.astype("<i2").tobytes())
    assert manifest["17-03"] == digest.hexdigest()
    scenario = load_scenario("bus14", "generated/17-03")
    assert hash_of_series(scenario.load_p, scenario.load_q, scenario.prod_p) == digest.hexdigest()
    changed = scenario.prod_p.copy()
    changed[5000, 2] += np.float32(0.1)
    assert hash_of_series(scenario.load_p, scenario.load_q, changed) != digest.hexdigest()


def test_a_month_that_differs_is_warned_of_once(manifest) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scenario("bus14", "generated/17-03")
    words = "The month 17-04 of bus14 differs from the one published .*: results on it are not comparable"
    with pytest.warns(DeviationWarning, match=words):
        assert load_scenario("bus14", "generated/17-04[0:300]").n_rows == 300
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_scenario("bus14", "generated/17-04").n_rows == 8065


def test_packs_are_compared(manifest) -> None:
    comparison = compare_with_published(BUS14, (*NAMES, "17-05", "600000-00"))
    assert comparison.months == 2
    assert [each.name for each in comparison.deviations] == ["17-04"]
    assert compare_with_published(load_grid("bus36-M"), NAMES).months == 0


def test_nothing_is_compared_before_it_is_published(manifest, monkeypatch) -> None:
    monkeypatch.setattr(published, "_manifest", lambda: {"another": {"bus14": manifest}})
    assert compare_with_published(BUS14, NAMES) == (0, [])


def test_making_names_what_differs(manifest, capsys, monkeypatch) -> None:
    monkeypatch.setattr(data, "HELD_OUT_SPLITS", {"test": NAMES})
    assert main(["data", "make", "bus14", "--split", "test", "--workers", "1"]) == 0
    assert "The month 17-04 of bus14 differs" in capsys.readouterr().out
    assert main(["data", "make", "bus14", "--seed", "17", "--months", "3", "--workers", "1"]) == 0
    output = capsys.readouterr().out
    assert "differs" not in output
    assert "1 held-out months of bus14 are as they were published" in output


def test_the_published_manifest_is_of_the_held_out_months() -> None:
    file = Path(published.__file__).with_name(published.MANIFEST)
    for grids in json.loads(file.read_text()).values():
        assert set(grids) <= set(GRID_IDS)
        for months in grids.values():
            assert all(
                len(digest) == 64 and generated.parse_months(name).n_months == 1 for name, digest in months.items()
            )
    for hashes in map(published.published_hashes, GRID_IDS):
        assert set(hashes) in (set(), set(published.held_out_months()))
