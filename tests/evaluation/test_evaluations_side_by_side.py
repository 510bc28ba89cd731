"""Episodes that are played side by side are those that are played one after the other, to the bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rl2grid.agents.agent import Agent
from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.random_agent import RandomAgent
from rl2grid.algorithms.policy_agent import load_agent
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.tasks import find_task
from rl2grid.evaluation import setting as setting_module
from rl2grid.evaluation import side_by_side
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.crew import Job, Progress, make_crew
from rl2grid.evaluation.protocol import env_keywords, evaluate
from rl2grid.evaluation.setting import Setting
from rl2grid.evaluation.side_by_side import episodes_abreast
from rl2grid.records.episodes import Episode
from rl2grid.scenarios.library import list_scenarios


def played(setting: Setting, jobs: list[Job], workers: int = 0) -> dict[Job, Episode]:
    with make_crew(setting, workers) as crew:
        return {job: replace(episode, wall_time_s=0.0) for job, episode in crew.play(jobs, lambda _: None)}


def setting_of(agent: Agent, task: str, heuristic: str | None, **options: Any) -> Setting:
    keywords = env_keywords(agent, {"split": "validation", "heuristic": heuristic, **options})
    return Setting(find_task(task).id, agent, keywords, 3)


@pytest.mark.parametrize(
    ("agent", "task", "heuristic", "steps"),
    [
        ("do-nothing", "bus14-T0", None, 600),
        ("do-nothing", "bus118-MOB-v0-R", "idle", 300),
        ("pretrained/bus14-T0", "bus14-T0", None, 150),
        ("pretrained/bus14-R", "bus14-R", None, 80),
        ("pretrained/bus14-R", "bus14-R", "recovery", 1500),
        ("pretrained/bus36-MO-v0-T1", "bus36-MO-v0-T1", "careful", 600),
        ("do-nothing", "bus14-T0-TLO", "idle", 600),
        ("do-nothing", "bus14-H0", None, 600),
        ("pretrained/bus14-H1", "bus14-H1", "recovery", 500),
        ("pretrained/bus36-MO-v0-H1", "bus36-MO-v0-H1", None, 60),
    ],
)
def test_rows_are_those_of_single_environments(agent: str, task: str, heuristic: str | None, steps: int) -> None:
    months = list_scenarios(find_task(task).grid_id, "validation")[:4]
    jobs = [Job(month, seed, 0) for month in months for seed in (0, 1)]
    setting = setting_of(make_agent(agent, find_task(task)), task, heuristic, episode_length=steps)
    alone, together = played(replace(setting, abreast=1), jobs), played(setting, jobs)
    assert together == alone
    assert len({episode.episode_return for episode in alone.values()}) > 2
    assert any(not episode.completed for episode in alone.values()) or steps < 600


@pytest.mark.parametrize("calm", [slice(0, 8), slice(0, 4)])
def test_episodes_that_end_before_a_decision_make_way_for_the_next(calm: slice) -> None:
    """Of eight in three rows all, or so many that not every row has one to play."""
    months = list_scenarios("bus14", "validation")[:40]
    setting = setting_of(DoNothing(), "bus14-T0", "idle", episode_length=40)
    jobs = [Job(month, 0, 0) for month in months]
    alone = played(replace(setting, abreast=1), jobs)
    without = [job for job in jobs if not alone[job].decisions]
    jobs = without[calm] + [job for job in jobs if alone[job].decisions][:1]
    assert played(setting, jobs) == {job: alone[job] for job in jobs}
    assert all(alone[job].completed for job in without)


def test_it_tells_of_all_running_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(side_by_side, "REPORT_SECONDS", 0.0)
    told: list[Progress] = []
    jobs = [Job(month, 0, 0) for month in list_scenarios("bus14", "validation")[:3]]
    with make_crew(setting_of(DoNothing(), "bus14-T0", None, episode_length=30), 0) as crew:
        for _ in crew.play(jobs, told.append):
            pass
    assert {progress.job for progress in told} == set(jobs)
    assert {progress.grid_steps for progress in told} == set(range(1, 30))
    assert {progress.episode_length for progress in told} == {30}


class Stubborn(DoNothing):
    """Acts otherwise than what it inherits from."""

    def act(self, observation: Any, info: Any) -> Any:
        return 1


class Wrapped:
    """Passes on all that it does not do itself."""

    def __init__(self, agent: Agent, action: int = 1) -> None:
        self._agent, self._action = agent, action

    def __getattr__(self, name: str) -> Any:
        return getattr(self._agent, name)

    def act(self, observation: Any, info: Any) -> Any:
        return self._action


def test_only_who_decides_for_many_as_for_each_plays_side_by_side() -> None:
    task, options = find_task("bus14-T0"), TaskOptions(heuristic="idle")
    assert episodes_abreast(DoNothing(), options) > 1
    assert episodes_abreast(load_agent(Path("pretrained/bus14-T0")), options) > 1
    others: list[Any] = [
        RandomAgent(),
        Stubborn(),
        Wrapped(DoNothing()),
        make_agent("greedy", task),
        make_agent("pretrained/bus14-T0", task, top_k=3),
        load_agent(Path("pretrained/bus14-T0"), deterministic=False),
    ]
    replaced = DoNothing()
    replaced.act = lambda observation, info: 1  # type: ignore[method-assign]
    assert [episodes_abreast(agent, options) for agent in (*others, replaced)] == [1] * 7
    for slow in (TaskOptions(engine="reference"), TaskOptions(reward=lambda *_: 0.0)):
        assert episodes_abreast(DoNothing(), slow) == 1


def test_workers_play_side_by_side_as_well() -> None:
    jobs = [Job(month, 0, 0) for month in list_scenarios("bus14", "validation")[:9]]
    setting = setting_of(DoNothing(), "bus14-T0", None, episode_length=100)
    assert played(setting, jobs, workers=2) == played(replace(setting, abreast=1), jobs)


def test_an_evaluation_plays_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    months: dict[str, Any] = {"months": 3, "episode_length": 100}
    monkeypatch.setattr(setting_module, "BoundAgent", None)
    here = evaluate("do-nothing", "bus14-T0", **months)
    monkeypatch.undo()
    there = evaluate(Wrapped(DoNothing(), 0), "bus14-T0", **months)
    assert [episode.episode_return for episode in here.episodes] == [
        episode.episode_return for episode in there.episodes
    ]
    assert np.isfinite([episode.wall_time_s for episode in here.episodes]).all()
