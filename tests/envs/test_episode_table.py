"""Episodes of streams, noted in columns."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from rl2grid.envs.episode_table import EpisodeTable
from rl2grid.scenarios.episodes import EpisodePlan, starts_of


def begin(
    table: EpisodeTable, rows: list[int], seeds: list[int | None] | None, options: Mapping[str, Any] | None = None
) -> None:
    """After ten grid steps of every running episode; what is played is named after the row."""
    chosen, steps = np.array(rows), np.full(len(table.begun), 10, np.int32)
    plans = [EpisodePlan(0, 0, f"month {row}", 3 * row, 5, True, row) for row in rows]
    table.take(chosen, table.following(chosen, seeds, options or {}, steps), starts_of(plans))


def test_a_stream_goes_on_where_no_seed_is_given() -> None:
    table = EpisodeTable(3, maintenance=False)
    begin(table, [0, 1, 2], [7, 2**70, 9])
    assert [table.plan(i, 5)[:2] for i in range(3)] == [(7, 0), (2**70, 0), (9, 0)]
    begin(table, [0, 2], None)
    begin(table, [2, 1], [None, 4])
    assert [table.plan(i, 5)[:2] for i in range(3)] == [(7, 1), (4, 0), (9, 2)]
    assert [table.earlier_steps(i) for i in range(3)] == [10, 0, 20]
    assert table.plan(2, 5) == EpisodePlan(9, 2, "month 2", 6, 5, False, 2)


def test_who_was_never_begun_plays_a_stream_of_its_own_where_no_seed_is_given() -> None:
    table = EpisodeTable(2, maintenance=True)
    begin(table, [1], [5])
    assert table.begun.tolist() == [False, True]
    begin(table, [0, 1], [None, None])
    assert table.plan(1, 5)[:2] == (5, 1)
    assert table.plan(0, 5).number == 0
    assert table.plan(0, 5).seed > 2**32, "a seed that nobody chose is drawn from all there are"


def test_a_row_that_is_moved_alone_goes_on_from_there() -> None:
    table, plan = EpisodeTable(2, maintenance=True), EpisodePlan(3, 8, "a month", 2, 5, True, 1)
    begin(table, [0, 1], [1, 2], {"start": 4})
    table.take_one(1, plan, 60, {})
    assert (table.plan(1, 5), table.earlier_steps(1), table.options(1)) == (plan, 60, {})
    assert (table.plan(0, 5).seed, table.options(0)) == (1, {"start": 4})
    begin(table, [1], None)
    assert (table.plan(1, 5)[:2], table.earlier_steps(1)) == ((3, 9), 70)


def test_options_of_a_reset_are_those_of_its_episode_alone() -> None:
    table = EpisodeTable(2, maintenance=True)
    begin(table, [0, 1], [1, 2], {"start": 4})
    begin(table, [1], None)
    assert [table.options(i) for i in range(2)] == [{"start": 4}, {}]
