"""The declaration of an episode's columns, and what follows from it."""

from __future__ import annotations

from dataclasses import MISSING, fields

import pytest
from sample_results import episode

from rl2grid.records.entries import episode_hash, facts_of
from rl2grid.records.episodes import (
    COLUMN_NAMES,
    COLUMNS,
    FACTS,
    LABELS,
    OPERATION,
    Episode,
    Origin,
    format_row,
    read_episodes,
    write_episodes,
)
from rl2grid.records.evaluations import labels

HEADER = (
    "task,agent,heuristic,split,scenario,seed,start,episode_length,grid_steps,decisions,survival,completed,game_over,"
    "last_overloads,last_outages,last_cut_off,episode_return,return_survive,return_overload,return_cost,cost_lsi,"
    "cost_tlo,score_margin,score_overload,score_topology,illegal,ambiguous,foresight,{}wall_time_s,engine,scenario_pack_hash,"
    "action_set_hash,agent_hash,identity"
)
"""Of the files that are stored already; the newer ones say what operation cost."""
OF_OPERATION = (
    "cost_losses,cost_redispatch,cost_curtailment,cost_storage,cost_blackout,storage_energy,renewable_used,"
    "renewable_available,"
)
IDENTITY = {
    "task": "t", "agent": "a", "agent_identity": {"x": 1}, "heuristic": None, "split": "test", "engine": "native",
    "scenario_pack_hash": "p", "action_set_hash": None,
}  # fmt: skip


def test_files_keep_their_columns():
    assert ",".join(COLUMN_NAMES) == HEADER.format(OF_OPERATION)


def test_files_of_before_there_was_a_cost_of_operation_are_read(tmp_path):
    path = tmp_path / "episodes.csv"
    row = format_row(episode("may", 3, 1 / 3)).replace(",0," + "," * 8 + "0.5", ",0,0.5")
    path.write_text(f"{HEADER.format('')}\n{row}")
    assert read_episodes(path) == (episode("may", 3, 1 / 3),)
    assert not episode("may", 3, 1 / 3).knows_operation


def test_what_operation_cost_is_a_fact_where_it_is_known(tmp_path):
    known = episode(**{column.name: 1.5 for column in OPERATION})
    write_episodes(tmp_path / "episodes.csv", [known])
    assert read_episodes(tmp_path / "episodes.csv") == (known,)
    assert known.cost_operation == 5 * 1.5
    changed = episode(**{column.name: 1.5 + (column.name == "cost_blackout") for column in OPERATION})
    assert len({episode_hash(facts_of(one)) for one in (episode(), known, changed)}) == 3


def test_a_row_keeps_its_bytes():
    assert format_row(episode("may", 3, 1 / 3, last_overloads="3 17")) == (
        "rl2grid/bus14-T0-v0,someone,none,validation,may,3,0,100,34,7,0.3333333333333333,false,DIVERGENCE,3 17,4,,30.0,"
        "33.33333333333333,-0.3333333333333333,-5.0,1.0,10.0,11.0,-0.25,-2.0,1,0,0,,,,,,,,,0.5,reference,pack,actions,,identity\n"
    )


def test_a_hash_of_facts_stays_what_it_was():
    """Stored entries hold these hashes: the order and the types of the facts are theirs."""
    assert episode_hash(facts_of(episode())) == "e5c6489b33875247"


def test_every_column_says_what_it_means():
    assert all(column.meaning and column.type in (str, int, float, bool) for column in COLUMNS)
    assert [column.name for column in COLUMNS if column.origin is Origin.CLOCK] == ["wall_time_s"]
    assert [column.name for column in COLUMNS if column.origin is Origin.AGENT] == ["foresight"]
    of_nobody_else = {column for column in COLUMNS if column.origin not in (Origin.CLOCK, Origin.AGENT)}
    assert {*LABELS, *FACTS, *OPERATION} == of_nobody_else


def test_an_evaluation_decides_exactly_the_labels():
    assert set(labels(IDENTITY)) == {column.name for column in LABELS}
    assert labels(IDENTITY)["heuristic"] == "none"
    assert len(labels(IDENTITY)["agent_hash"]) == 16


def test_what_was_played_is_never_left_out():
    optional = {each.name for each in fields(Episode) if each.default is not MISSING}
    assert optional == {*(column.name for column in (*LABELS, *OPERATION)), "foresight"}
    with pytest.raises(TypeError, match="survival"):
        Episode(**{name: value for name, value in vars(episode()).items() if name != "survival"})
