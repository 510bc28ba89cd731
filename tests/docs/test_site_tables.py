"""Tables of the site can be read on a phone, and the first page says what the ledger holds."""

import importlib
import sys

import pytest

pytest.importorskip("mkdocs")

from documentation import ROOT

from rl2grid.analysis.ledger_table import ledger_rows, short_ledger_table
from rl2grid.envs.tasks import find_task
from rl2grid.records.ledger import agent_of, read_ledger
from rl2grid.records.statistics import estimate
from rl2grid.studies.study import load_study

LEDGER = ROOT / "benchmarks" / "results" / "baselines.json"
PAPER = ROOT / "benchmarks" / "results" / "paper.json"


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "docs" / "hooks"), *sys.path])
    return importlib.import_module("tables")


def table(headings, *rows):
    head = "".join(f"<th>{heading}</th>\n" for heading in headings)
    body = "".join("<tr>\n" + "".join(f"<td>{cell}</td>\n" for cell in row) + "</tr>\n" for row in rows)
    return f"<table>\n<thead>\n<tr>\n{head}</tr>\n</thead>\n<tbody>\n{body}</tbody>\n</table>"


def test_cells_of_wide_tables_are_told_their_headings(tables):
    wide = table(("a", "<code>b</code> &lt; c", "d", "e"), ("1", "2", "", "4 " * 20))
    named = tables.named_cells(wide)
    assert named.startswith('<table data-cards="">')
    for cell in (
        '<td data-heading="a">1</td>',
        '<td data-heading="b &lt; c">2</td>',
        '<td data-heading="e" data-long="">4 4',
    ):
        assert cell in named


def test_narrow_tables_stay_and_empty_headings_go(tables):
    narrow = table(("a", "b"), ("1", "2"))
    assert tables.named_cells(narrow) == narrow
    assert "<thead>" not in tables.named_cells(table(("", ""), ("1", "2")))


def test_a_short_table_has_the_best_first():
    lines = short_ledger_table(read_ledger(LEDGER), find_task("bus14-T0").id).splitlines()
    assert lines[0].startswith("| agent | survival | to do-nothing |")
    assert "**" in lines[2]
    survivals = [float(line.split("|")[2].strip(" *").split()[0]) for line in lines[2:]]
    assert survivals == sorted(survivals, reverse=True)
    alone = {digest: one for digest, one in read_ledger(LEDGER).items() if one.agent != "do-nothing"}
    assert "to do-nothing" not in short_ledger_table(alone, find_task("bus36-M-H1").id)


def test_every_cell_of_the_paper_has_its_test():
    def named(task, agent, heuristic):
        return task, agent, heuristic or "none"

    cells = load_study("baselines", "full").cells
    tested = read_ledger(PAPER).values()
    assert {named(cell.task.id, cell.agent, cell.heuristic) for cell in cells} == {
        named(one.task, one.agent, one.heuristic) for one in tested
    }
    budgets = {one.configuration["hyperparameters"]["total_timesteps"] for one in tested if one.training}
    assert budgets == {cell.training.hyperparameters["total_timesteps"] for cell in cells if cell.training is not None}


def test_the_first_page_says_what_was_measured():
    results = read_ledger(LEDGER)

    def survivals(task, *agents, decisions=None, trainings=1, heuristic=None):
        of_task = {k: one for k, one in results.items() if one.task == find_task(task).id}
        chosen = [row for row in ledger_rows(of_task, results) if agent_of(row.first.configuration) in agents]
        if decisions is not None:
            chosen = [
                row for row in chosen if row.first.configuration["hyperparameters"]["total_timesteps"] == decisions
            ]
        if heuristic is not None:
            chosen = [row for row in chosen if row.first.heuristic == heuristic]
        repeated = [row for row in chosen if len(row.results) >= trainings]
        return sorted(estimate(row.scores("survival")).value for row in repeated)

    page = " ".join((ROOT / "docs" / "index.md").read_text(encoding="utf-8").split())
    assert f"**{survivals('bus14-T0', 'greedy', 'planner')[-1]:.1%}** of a month" in page
    learned = survivals("bus14-T0", "ppo", "dqn", "sac", heuristic="careful")
    assert f"**{100 * learned[0]:.0f} to {learned[-1]:.0%}** there by agents that learned" in page
    assert f"**{survivals('bus36-MO-v0-T1', 'greedy')[-1]:.0%}** by the same search" in page
    assert f"**{survivals('bus36-MO-v0-T1', 'planner')[-1]:.0%}** by the planner's sequences" in page
    *_, best = survivals("bus36-MO-v0-T0", "ppo", decisions=2_000_000, trainings=5)
    assert f"**{best:.0%}** there, with fewer actions, by PPO" in page
    assert f"the search comes to {survivals('bus36-MO-v0-T0', 'greedy')[-1]:.0%} (500" in page
