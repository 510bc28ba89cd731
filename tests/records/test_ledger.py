"""The ledger of test results: what is kept, and that what is stored stays as it is."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sample_results import result

from rl2grid.errors import UsageError
from rl2grid.records.evaluations import identity_hash
from rl2grid.records.ledger import add_test, hashed_test, read_ledger

LEDGER = Path(__file__).parents[2] / "benchmarks" / "results" / "baselines.json"
CONFIGURATION = {"agent": "greedy", "task": "rl2grid/bus14-T0-v0", "heuristic": "idle"}


def test_what_is_kept_of_an_evaluation():
    kept = hashed_test(CONFIGURATION, {}, result("greedy", [[0.5], [1.0]]))
    assert kept.test["episodes"] == 2
    assert kept.test["survival"] == 0.75
    assert (kept.agent, kept.heuristic) == ("greedy", "idle")
    other = hashed_test(CONFIGURATION, {}, result("greedy", [[0.5], [0.9]]))
    assert other.episodes_hash != kept.episodes_hash


def test_results_come_back_by_their_configuration(tmp_path: Path):
    path = tmp_path / "ledger.json"
    assert read_ledger(path) == {}
    kept = hashed_test(CONFIGURATION, {}, result("greedy", [[0.5], [1.0]]))
    add_test(path, kept)
    assert read_ledger(path) == {identity_hash(CONFIGURATION): kept}


def test_results_that_are_added_at_once_are_all_kept(tmp_path: Path):
    path = tmp_path / "ledger.json"
    configurations = [{**CONFIGURATION, "task": f"rl2grid/bus14-T{level}-v0"} for level in range(12)]
    with ThreadPoolExecutor(len(configurations)) as threads:
        list(
            threads.map(
                lambda one: add_test(path, hashed_test(one, {}, result("greedy", [[0.5], [1.0]]))), configurations
            )
        )
    assert set(read_ledger(path)) == {identity_hash(one) for one in configurations}


def test_the_ledger_of_the_baselines_keeps_its_bytes(tmp_path: Path):
    """Read and written again it is the same file, and every result stands under the hash of its configuration."""
    results = read_ledger(LEDGER)
    assert len(results) > 10
    path = tmp_path / "ledger.json"
    for digest, kept in results.items():
        assert digest == identity_hash(kept.configuration)
    path.write_text(LEDGER.read_text())
    add_test(path, results[next(iter(results))])
    assert path.read_bytes() == LEDGER.read_bytes()


@pytest.mark.parametrize("text", ["", "[]", "{", "# A page", json.dumps({"a": {"configuration": {}}})])
def test_other_files_are_refused(tmp_path: Path, text: str):
    (tmp_path / "ledger.json").write_text(text)
    with pytest.raises(UsageError, match=r"ledger\.json is no ledger of test results: .*; give a file that 'rl2grid"):
        read_ledger(tmp_path / "ledger.json")
    with pytest.raises(UsageError, match="cannot be read as a ledger of test results: Is a directory"):
        read_ledger(tmp_path)
