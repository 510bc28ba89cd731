"""Who looks and has learned nothing, beside who learned and looks."""

from __future__ import annotations

import pytest
from sample_ledger import cells, ledger, trained, untrained

from rl2grid.analysis.ledger_looks import looks_table
from rl2grid.errors import UsageError


def test_learning_is_compared_with_the_same_look_alone_on_the_months_that_both_played():
    results = ledger(
        untrained("greedy", [0.9, 0.9, 0.9]),
        *(trained(seed, [0.2, 0.4, 0.9]) for seed in (1, 2)),  # does not look
        *(trained(seed, [0.6, 0.8, 0.9], top_k=30) for seed in (1, 2)),
        *(trained(seed, [0.9, 0.9, 0.9], top_k=100) for seed in (1, 2)),  # at others
        trained(1, [0.9, 0.9, 0.9], top_k=30, algorithm="sac"),  # a single one
    )
    beginnings = ledger(*(trained(seed, [0.5, 0.5], steps=10, algorithm="sac", top_k=30) for seed in (1, 2)))
    headings, _, row = cells(looks_table(results, beginnings))
    assert headings == [
        "task", "heuristic", "looking", "months", "learned nothing", "who learned", "survival", "gain", "p",
    ]  # fmt: skip
    assert row[:4] == ["bus14-T0", "`idle`", "best of 30", "2"]
    assert row[4].startswith("0.500 [")
    assert row[5] == "ppo (2 of 1,000)"
    assert row[6].startswith("0.700 [")
    assert row[7].startswith("+0.200 [")
    assert 0 < float(row[8]) < 1


def test_p_values_are_corrected_over_the_rows_of_a_task():
    survivals = [0.5 + 0.01 * (month % 7) for month in range(40)]
    others = [one + 0.006 + 0.03 * (month % 3 - 1) for month, one in enumerate(survivals)]
    several = [
        trained(seed, [one + 0.001 * seed for one in others], top_k=30, algorithm=algorithm)
        for algorithm in ("ppo", "sac")
        for seed in (1, 2)
    ]
    beginnings = ledger(*(trained(seed, survivals, steps=10, algorithm="sac", top_k=30) for seed in (1, 2)))
    [[*_, alone]] = cells(looks_table(ledger(*several[:2]), beginnings))[2:]
    both = cells(looks_table(ledger(*several), beginnings))[2:]
    assert [row[5].split()[0] for row in both] == ["ppo", "sac"]
    assert [float(row[8]) for row in both] == pytest.approx([2 * float(alone)] * 2, abs=0.002)


def test_whom_nobody_is_like_has_no_row():
    beginnings = ledger(*(trained(seed, [0.5, 0.5], steps=10, top_k=30) for seed in (1, 2)))
    assert len(looks_table(ledger(untrained("greedy", [0.9, 0.9])), beginnings).splitlines()) == 2


def test_without_any_it_is_said_how_to_get_them():
    with pytest.raises(UsageError, match=r"look_alone\.py play"):
        looks_table({}, {})
