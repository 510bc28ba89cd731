"""Labels of training months: what is kept of what a teacher decides, whoever acts, and how labelling goes on."""

from __future__ import annotations

import copy
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rl2grid
from rl2grid.agents.agent import Considered, injecting_action, topology_action
from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.planner import Planner
from rl2grid.agents.random_agent import RandomAgent
from rl2grid.envs.grid_env import PowerGridEnv
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.crew import Job
from rl2grid.mdp.actions import continuous_layout
from rl2grid.records.labels import LABELS_FILE, Labels, is_labels, month_path, read_labels
from rl2grid.scenarios.splits import TRAINING_SEEDS
from rl2grid.training import teaching
from rl2grid.training.labeller import returns_of
from rl2grid.training.request import hyperparameters
from rl2grid.training.teaching import DISCOUNTS, summary_of, teach

SHORT: dict[str, Any] = {"months": 2, "workers": 0, "episode_length": 25}


@pytest.fixture(autouse=True)
def few_years(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two years of the library are enough."""
    draw = teaching.draw_scenario
    monkeypatch.setattr(
        teaching, "draw_scenario", lambda grid, split, seed, number: draw(grid, split, seed, number % 2)
    )


def taught(folder: Path, *arguments: Any, **options: Any) -> Labels:
    """The labels that were asked for."""
    made = teach(*arguments, output=folder, **{**SHORT, **options})
    return read_labels([made.folder], arguments[1])[1]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.npz")}


class Overloaded:
    """A teacher to whom no grid is safe: it plays any legal action, and prefers those of small numbers."""

    name = "overloaded"

    def __init__(self, sign: float = 1.0) -> None:
        self._sign = sign
        self.overruled_by: list[Any] = []

    def bind(self, env: Any) -> None:
        self._env, self._space = env.unwrapped, env.action_space

    def reset(self, i: int) -> None:
        self._n = 0

    def act(self, observation: Any, info: Any) -> Any:
        self._n += 1
        legal = np.flatnonzero(self._env.action_masks())
        return topology_action(self._space, int(legal[self._n % len(legal)]))

    def explain(self) -> Considered:
        return Considered("place", [3, 1, 2, 10**6], [self._sign * value for value in (0.3, 0.2, 0.1, 0.0)])

    def overruled(self, played: Any) -> None:
        self.overruled_by.append(played)


class FarAway(DoNothing):
    """A teacher that wants every injection three steps away, and asks for nothing."""

    def aim(self) -> Any:
        return np.full(continuous_layout(find_task("bus14-R").grid).size, 3.0, np.float32)


class AlwaysFirst(DoNothing):
    """A teacher that plays the first action, whether it may be played or not."""

    def act(self, observation: Any, info: Any) -> Any:
        return 1


@pytest.mark.parametrize(
    ("task", "teacher", "candidates"),
    [("bus14-T0", "greedy", 8), ("bus14-R", "dc-opf", 0), ("bus14-H0", "planner", 8), ("bus14-T0", "do-nothing", 0)],
)
def test_every_kind_of_task_is_labelled(tmp_path: Path, task: str, teacher: str, candidates: int):
    labels = taught(tmp_path / "labels", teacher, task, thin=1.0)
    assert len(labels) == 50
    assert labels.candidates.shape[1] == candidates
    assert (labels.topology is None, labels.injection is None) == (task[6] == "R", task[6] == "T")
    assert (labels.weights == 1).all()
    assert not labels.pupil.any()
    assert np.flatnonzero(labels.ending).tolist() == [24, 49]
    assert len(np.unique(labels.observations[:25, 0])) == 25
    for month in (slice(0, 25), slice(25, 50)):
        again = returns_of(labels.rewards[month], labels.n_steps[month], DISCOUNTS[task[6]])
        np.testing.assert_array_equal(labels.returns[month], again)


def test_observations_and_masks_are_those_of_the_environment(tmp_path: Path):
    import gymnasium

    labels = taught(tmp_path / "labels", "random", "bus14-T0", thin=1.0, months=1)
    job = teaching._job(rl2grid.tasks()["rl2grid/bus14-T0-v0"], 0, 0, 0)
    env = gymnasium.make("rl2grid/bus14-T0-v0", gamma=0.9, episode_length=25)
    from rl2grid.evaluation.episode import environment_seed

    observation, _ = env.reset(seed=environment_seed(job.scenario, job.seed), options={"scenario": job.scenario})
    assert labels.masks is not None
    assert labels.topology is not None
    for k in range(len(labels)):
        np.testing.assert_array_equal(labels.observations[k], observation)
        np.testing.assert_array_equal(labels.masks[k], env.unwrapped.action_masks())  # type: ignore[attr-defined]
        observation, _, terminated, truncated, info = env.step(int(labels.topology[k]))
        assert (labels.rewards[k], labels.n_steps[k]) == (info["discounted_reward"], info["n_steps"])
        assert labels.ending[k] == (1 if terminated else 2 if truncated else 0)
    env.close()


def test_months_are_of_the_training_library(tmp_path: Path):
    months = teach("do-nothing", "bus14-T0", output=tmp_path / "labels", **SHORT).months
    assert all(int(month.scenario.removeprefix("generated/").split("-")[0]) in TRAINING_SEEDS for month in months)
    assert len({month.seed for month in months}) == 2


def test_of_safe_states_without_an_action_few_are_kept_and_returns_stay_what_they_were(tmp_path: Path):
    whole = taught(tmp_path / "whole", "do-nothing", "bus14-T0", thin=1.0, episode_length=100)
    thinned = taught(tmp_path / "thinned", "do-nothing", "bus14-T0", thin=4.0, episode_length=100)
    assert 20 < len(thinned) < 90
    assert set(thinned.weights.tolist()) <= {1.0, 4.0}
    assert 100 < thinned.weights.sum() < 300
    places = [int(np.flatnonzero((whole.observations == row).all(axis=1))[0]) for row in thinned.observations]
    assert places == sorted(places)
    np.testing.assert_array_equal(thinned.returns, whole.returns[places])
    np.testing.assert_array_equal(thinned.rewards, whole.rewards[places])


def test_where_the_teacher_acts_every_state_is_kept(tmp_path: Path):
    labels = taught(tmp_path / "labels", Overloaded(), "bus14-T0", thin=1000.0)
    assert labels.topology is not None
    assert (labels.topology > 0).mean() > 0.9
    assert (labels.weights[labels.topology > 0] == 1).all()


def test_what_a_teacher_is_on_its_way_to_is_kept_beside_what_it_asks_for(tmp_path: Path):
    labels = taught(tmp_path / "labels", FarAway(), "bus14-R", thin=1.0)
    assert labels.injection is not None
    assert labels.aim is not None
    assert (labels.aim == 3.0).all()
    assert (labels.injection == 0.0).all()
    others = taught(tmp_path / "others", "dc-opf", "bus14-R", thin=1.0)
    assert others.injection is not None
    assert others.aim is not None
    np.testing.assert_array_equal(others.aim, others.injection)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_values_of_candidates_are_higher_for_better_ones(tmp_path: Path, sign: float):
    labels = taught(tmp_path / "labels", Overloaded(sign), "bus14-T0", thin=1.0)
    first = labels.candidates[0]
    assert first[:3].tolist() == [3, 1, 2]
    assert (first[3:] == -1).all()
    assert (np.diff(labels.values[0, :3]) < 0).all()
    assert (labels.values[0, 3:] == 0).all()


def test_an_illegal_decision_is_labelled_as_what_is_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    labels = taught(tmp_path / "legal", AlwaysFirst(), "bus14-T0", thin=1.0)
    assert labels.topology is not None
    assert (labels.topology == 1).all()
    monkeypatch.setattr(PowerGridEnv, "action_masks", lambda self: np.arange(50) != 1)
    labels = taught(tmp_path / "illegal", AlwaysFirst(), "bus14-T0", thin=1.0)
    assert labels.topology is not None
    assert (labels.topology == 0).all()


def test_of_an_illegal_joint_decision_no_aim_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    class FarAndFirst(FarAway):
        def act(self, observation: Any, info: Any) -> Any:
            return {"topology": 1, "injection": np.zeros(6, np.float32)}

    legal = taught(tmp_path / "legal", FarAndFirst(), "bus14-H0", thin=1.0, months=1)
    assert legal.aim is not None
    assert (legal.aim == 3.0).all()
    monkeypatch.setattr(PowerGridEnv, "action_masks", lambda self: np.arange(50) != 1)
    illegal = taught(tmp_path / "illegal", FarAndFirst(), "bus14-H0", thin=1.0, months=1)
    assert illegal.aim is not None
    assert (illegal.aim == 0.0).all()


@pytest.mark.parametrize("task", ["bus14-T0", "bus14-H0"])
def test_a_pupil_acts_and_the_teacher_says_what_it_would_do(tmp_path: Path, task: str):
    alone = taught(tmp_path / "labels", Overloaded(), task, thin=1.0)
    both = taught(tmp_path / "labels", Overloaded(), task, thin=1.0, pupil=RandomAgent())
    assert len(both) > len(alone)
    assert not both.pupil[: len(alone)].any()
    assert both.pupil[len(alone) :].all()
    assert sorted(path.name for path in tmp_path.glob("labels/round-*")) == ["round-0", "round-1"]
    again = taught(tmp_path / "labels", Overloaded(), task, thin=1.0, pupil=RandomAgent())
    assert_same(both, again)


def assert_same(one: Labels, other: Labels) -> None:
    for each in fields(Labels):
        np.testing.assert_array_equal(getattr(one, each.name), getattr(other, each.name))


def test_a_pupil_acts_as_often_as_it_is_asked_to_and_the_teacher_is_told(tmp_path: Path):
    taught(tmp_path / "labels", "do-nothing", "bus14-T0", episode_length=60, months=1)
    teacher = Overloaded()
    setup = teaching.LabelSetup(
        rl2grid.tasks()["rl2grid/bus14-T0-v0"], teacher, DoNothing(), 0.5, 1.0, 8, 0.9, {"episode_length": 60}
    )
    player = setup.player(1)
    ((_, labelled),) = player.play([teaching._job(setup.task, 0, 1, 0)], lambda progress: None)
    labels = labelled.labels
    player.close()
    assert 0.25 < labels.pupil.mean() < 0.75
    assert labels.topology is not None
    assert len(teacher.overruled_by) == int((labels.pupil & (labels.topology != 0)).sum())


def test_a_planner_plans_anew_when_another_topology_was_played_than_it_planned_for():
    """A plan of dispatch is made for the topology that the planner's own action leads to."""
    import gymnasium

    env = gymnasium.make("rl2grid/bus14-H0-v0", split="validation", episode_length=20)
    planner = Planner()
    planner.bind(env)
    observation, info = env.reset(seed=0)
    planner.reset(0)
    planner.act(observation, info)
    planner.overruled(topology_action(env.action_space, 0))
    assert not planner._is_plan_void
    planner.overruled(injecting_action(env.action_space, np.zeros(6, np.float32), 3))
    assert planner._is_plan_void
    planner.act(*env.step(topology_action(env.action_space, 0))[::4])
    assert not planner._is_plan_void
    env.close()


def test_decisions_inside_a_heuristic_are_not_the_agents(tmp_path: Path):
    labels = taught(tmp_path / "labels", "greedy", "bus14-T0", heuristic="idle", episode_length=1000)
    assert (labels.n_steps > 1).any()
    assert (labels.weights == 1).all(), "the agent is asked where the grid is not safe"
    assert (labels.candidates[:, 0] >= 0).all()
    assert (np.diff(labels.values, axis=1)[labels.candidates[:, 1:] >= 0] <= 0).all()


def test_labels_depend_neither_on_workers_nor_on_interruptions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    options = {**SHORT, "months": 3, "thin": 3.0}
    teach("greedy", "bus14-T0", output=tmp_path / "alone", **options)
    row = teaching._row

    def interrupted(folder: Any, month: int, job: Job, labelled: Any) -> Any:
        if month == 1:
            raise KeyboardInterrupt
        return row(folder, month, job, labelled)

    monkeypatch.setattr(teaching, "_row", interrupted)
    with pytest.raises(KeyboardInterrupt):
        teach("greedy", "bus14-T0", output=tmp_path / "resumed", **options)
    assert list(contents(tmp_path / "resumed")) == ["round-0/00000.npz"]
    with pytest.raises(UsageError, match=r"is unfinished, 1 of 3 months are there: go on with `teach\('greedy'"):
        read_labels([tmp_path / "resumed"], "bus14-T0")
    monkeypatch.setattr(teaching, "_row", row)
    kept = month_path(tmp_path / "resumed", 0, 0).stat().st_mtime_ns
    teach("greedy", "bus14-T0", output=tmp_path / "resumed", **{**options, "workers": 1})
    assert month_path(tmp_path / "resumed", 0, 0).stat().st_mtime_ns == kept
    assert contents(tmp_path / "resumed") == contents(tmp_path / "alone")


def test_months_that_are_there_are_not_played_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    first = teach("do-nothing", "bus14-T0", output=tmp_path / "labels", **{**SHORT, "months": 1})
    more = teach("do-nothing", "bus14-T0", output=tmp_path / "labels", **SHORT)
    assert more.months[:1] == first.months
    monkeypatch.setattr(teaching, "make_crew", None)
    again = teach("do-nothing", "bus14-T0", output=tmp_path / "labels", **SHORT)
    assert again == more
    assert summary_of(again)["months"] == 2
    assert summary_of(again)["decisions"] == 50


def test_the_public_function_returns_the_folder(tmp_path: Path):
    folder = rl2grid.teach("do-nothing", "bus14-R", output=str(tmp_path / "labels"), **SHORT)
    assert is_labels(folder)


def test_a_library_without_room_is_refused_before_anything_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RL2GRID_DATA", str(tmp_path / "data"))
    (tmp_path / "data").mkdir()
    monkeypatch.setattr("rl2grid.scenarios.training_years.free_bytes", lambda: 10**6)
    with pytest.raises(UsageError, match="are free: free some"):
        rl2grid.teach("greedy", "bus14-T0", months=1, output=tmp_path / "labels")
    assert not (tmp_path / "labels").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"months": 0}, "months=0 is not allowed: give a number from 1 to 100,000"),
        ({"months": 1.5}, "months=1.5 is not allowed"),
        ({"seed": -1}, "seed=-1 is not allowed"),
        ({"thin": 0.5}, "thin=0.5 is not allowed"),
        ({"thin": float("nan")}, "thin=nan is not allowed"),
        ({"thin": "10"}, "thin='10' is not allowed"),
        ({"gamma": 1.5}, "gamma=1.5 is not allowed"),
        ({"gamma": "0.9"}, "gamma='0.9' is not allowed"),
        ({"workers": -1}, "workers=-1 is not allowed"),
        ({"pupil": "random", "pupil_share": 0.0}, "pupil_share=0.0 is not allowed"),
        ({"pupil_share": 0.5}, "pupil_share=0.5 is of a pupil, and there is none"),
        ({"pupil_top_k": 3}, "pupil_top_k is of a pupil that is given by name or path"),
        ({"pupil": RandomAgent(), "pupil_top_k": 3}, "pupil_top_k is of a pupil that is given by name or path"),
        ({"pupil": "random", "pupil_top_k": 3}, "leave it out for random"),
        ({"top_k": 3}, "top_k compares the best actions of a trained policy: leave it out for greedy"),
        ({"rehearse": 3}, "rehearse plays the crises of a trained policy in advance: leave it out for greedy"),
        ({"pupil": "nobody"}, "Agent 'nobody' does not exist"),
        ({"pupil": "random"}, "holds no labels yet"),
        ({"split": "test"}, "Labels of the test scenarios are refused"),
        ({"scenario": "generated/1000000-00"}, "Option 'scenario'"),
        ({"reward": lambda state, i: (0.0, 0.0, 0.0)}, "Labels store their reward by name"),
        ({"heuristic": "bold"}, "heuristic"),
        ({"sead": 1}, "Option 'sead' does not exist"),
        ({"opponent": True}, "bus14 has no opponent"),
    ],
)
def test_what_cannot_be_labelled_is_refused_and_nothing_written(tmp_path: Path, change: dict[str, Any], words: str):
    with pytest.raises(UsageError, match=words):
        teach("greedy", "bus14-T0", output=tmp_path / "labels", **{**SHORT, **change})
    assert not (tmp_path / "labels" / LABELS_FILE).exists()


def test_a_teacher_that_cannot_play_the_task_is_refused_and_nothing_written(tmp_path: Path):
    with pytest.raises(UsageError, match="'dc-opf' cannot play a topology task"):
        teach("dc-opf", "bus14-T0", output=tmp_path / "labels", **SHORT)
    assert not (tmp_path / "labels").exists()


def test_other_labels_do_not_go_into_the_same_folder(tmp_path: Path):
    teach("do-nothing", "bus14-T0", output=tmp_path / "labels", **SHORT)
    before = contents(tmp_path)
    for change, words in (
        ({"heuristic": "idle"}, r"different heuristic \(None, not idle\)"),
        ({"thin": 2.0}, r"different thin \(10.0, not 2.0\)"),
        ({"months": 1}, "has 2 months"),
    ):
        with pytest.raises(UsageError, match=words):
            teach("do-nothing", "bus14-T0", output=tmp_path / "labels", **{**SHORT, **change})
    with pytest.raises(UsageError, match="different teacher"):
        teach("random", "bus14-T0", output=tmp_path / "labels", **SHORT)
    assert contents(tmp_path) == before


def test_a_pupil_looks_before_it_acts_if_it_is_to(tmp_path: Path):
    pupil = "pretrained/bus14-T0-idle"
    for folder, changes in (("plain", {}), ("looking", {"pupil_top_k": 5})):
        teach("greedy", "bus14-T0", output=tmp_path / folder, heuristic="idle", **SHORT)
        teach("greedy", "bus14-T0", output=tmp_path / folder, pupil=pupil, **changes, **SHORT)
    who = [json.loads((tmp_path / folder / LABELS_FILE).read_text())["rounds"][1] for folder in ("plain", "looking")]
    assert [each["pupil"]["identity"].get("top_k") for each in who] == [None, 5]
    assert "pupil_top_k=5" in who[1]["command"]
    assert "pupil_top_k" not in who[0]["command"]


def test_a_policy_that_teaches_looks_before_it_acts_if_it_is_to(tmp_path: Path):
    said = []
    for folder, changes in (("plain", {}), ("looking", {"top_k": 5}), ("rehearsing", {"rehearse": 6})):
        teach("pretrained/bus14-T0-idle", "bus14-T0", output=tmp_path / folder, **changes, **SHORT)
        said.append(json.loads((tmp_path / folder / LABELS_FILE).read_text()))
    assert [each["teacher_identity"].get("top_k") for each in said] == [None, 5, None]
    assert [each["teacher_identity"].get("rehearse") for each in said] == [None, None, 6]
    assert "top_k=5" in said[1]["rounds"][0]["command"]
    with pytest.raises(UsageError, match="different teacher"):
        teach("pretrained/bus14-T0-idle", "bus14-T0", output=tmp_path / "plain", top_k=5, **SHORT)
    with pytest.raises(UsageError, match="top_k and rehearse are of a teacher that is given by name or path"):
        teach(RandomAgent(), "bus14-T0", output=tmp_path / "own", top_k=5, **SHORT)
    assert not (tmp_path / "own").exists()


def test_a_pupil_of_other_environments_is_refused(tmp_path: Path):
    teach("do-nothing", "bus14-T0", output=tmp_path / "labels", **SHORT)
    pupil = copy.copy(RandomAgent())
    pupil.env_keywords = {"heuristic": "idle"}  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match="The pupil was trained with heuristic='idle', and the labels are of"):
        teach("do-nothing", "bus14-T0", output=tmp_path / "labels", pupil=pupil, heuristic=None, **SHORT)


@pytest.mark.parametrize("task", ["bus14-T0", "bus14-R", "bus14-H0"])
def test_labels_have_the_discount_with_which_imitation_learns_them(task: str):
    assert hyperparameters("imitation", task).gamma == DISCOUNTS[find_task(task).kind]
