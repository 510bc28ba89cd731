"""Held-out months that are not the published ones are named, and played."""

import hashlib
import json
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rl2grid.cli import data
from rl2grid.cli.main import main
from rl2grid.grids import GRID_IDS, load_grid
from rl2grid.scenarios import generated, library, published
from rl2grid.scenarios.fingerprint import VERSION
from rl2grid.scenarios.library import load_scenario
from rl2grid.scenarios.making import make_packs
from rl2grid.scenarios.packs import read_raw
from rl2grid.scenarios.published import DeviationWarning, compare_with_published, hash_pack
from rl2grid.scenarios.series_hash import hash_of_series
from rl2grid.scenarios.splits import SPLIT_VERSION

BUS14 = load_grid("bus14")
NAMES = ("17-03", "17-04")


@pytest.fixture
def manifest(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """Hashes of two months of bus14: published are the first as it is, and another than the second."""
    for _ in make_packs(BUS14, [(17, 3), (17, 4)], workers=1):
        pass
    hashes = {name: str(hash_pack(BUS14, name)) for name in NAMES}
    monkeypatch.setattr(published, "HELD_OUT_SPLITS", {"test": NAMES})
    version = f"{VERSION} {SPLIT_VERSION}"
    monkeypatch.setattr(published, "_manifest", lambda: {version: {"bus14": {"test": hashes["17-03"][:8] + 8 * "0"}}})
    monkeypatch.setattr(published, "_warned", set())
    library._load_generated_scenario.cache_clear()
    published.published_hashes.cache_clear()
    yield hashes
    published.published_hashes.cache_clear()


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
    monkeypatch.setattr(published, "_manifest", lambda: {"1 1": {"bus14": {"test": 16 * "0"}}})
    published.published_hashes.cache_clear()
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
    manifest = json.loads(file.read_text())
    assert set(manifest) == {f"{VERSION} {SPLIT_VERSION}"}
    assert set(manifest[f"{VERSION} {SPLIT_VERSION}"]) <= set(GRID_IDS)
    for hashes in map(published.published_hashes, manifest[f"{VERSION} {SPLIT_VERSION}"]):
        assert set(hashes) == set(published.held_out_months())
        assert all(re.fullmatch("[0-9a-f]{8}", each) for each in hashes.values())


def test_what_is_to_be_published_is_what_is_read_back(manifest, monkeypatch) -> None:
    version = f"{VERSION} {SPLIT_VERSION}"
    listed = published.listed_hashes(BUS14)
    monkeypatch.setattr(published, "_manifest", lambda: {version: {"bus14": listed}})
    published.published_hashes.cache_clear()
    assert published.published_hashes("bus14") == {name: digest[:8] for name, digest in manifest.items()}
