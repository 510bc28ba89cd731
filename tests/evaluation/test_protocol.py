"""The evaluation protocol on a fake grid, and once on the real one."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from fake_grid import LENGTH
from forged import rewrite

from rl2grid.agents.do_nothing import DoNothing
from rl2grid.agents.random_agent import RandomAgent
from rl2grid.algorithms import ppo
from rl2grid.algorithms.checkpoint import save_checkpoint
from rl2grid.engines import ENGINES
from rl2grid.envs.registration import register_all
from rl2grid.errors import UsageError
from rl2grid.evaluation import protocol as evaluation
from rl2grid.evaluation.crew import Job, make_crew
from rl2grid.evaluation.episode import environment_seed, play_episode
from rl2grid.evaluation.protocol import evaluate, run_evaluation
from rl2grid.evaluation.setting import Setting
from rl2grid.grids import GRID_IDS
from rl2grid.records.episodes import EPISODES_FILE, Episode
from rl2grid.records.evaluation_folder import PARTIAL_FILE
from rl2grid.records.evaluations import EVALUATION_FILE, Evaluation, load_evaluation
from rl2grid.records.files import DamageWarning
from rl2grid.scenarios.fingerprint import VERSION
from rl2grid.scenarios.library import list_scenarios
from rl2grid.training.request import hyperparameters

FAKE = "fake_grid:FakeGrid-v0"
SCENARIOS = ("april", "doomed", "may")
JOBS = [Job(scenario, seed, 0) for scenario in SCENARIOS for seed in (0, 1)]
IDENTITY = {
    "task": "fake",
    "agent": "someone",
    "agent_identity": None,
    "heuristic": "idle",
    "split": "validation",
    "engine": "fake",
    "scenario_pack_hash": "pack",
    "action_set_hash": None,
    "versions": {"rl2grid": "0"},
}


@pytest.fixture(autouse=True)
def _workers_find_the_fake_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    folders = Path(__file__).parents
    paths = [*map(str, folders[:2]), str(folders[2] / "src"), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))


def play(agent=None, jobs=JOBS, *, workers=0, output=None, identity=IDENTITY, **keywords) -> Evaluation:
    keywords.setdefault("heuristic", "idle")
    return run_evaluation(
        Setting(FAKE, agent or RandomAgent(), keywords),
        jobs,
        identity=identity,
        command="again",
        workers=workers,
        output=output,
    )


def without_times(episodes: tuple[Episode, ...]) -> list[Episode]:
    return [replace(episode, wall_time_s=0.0) for episode in episodes]


def test_one_row_per_scenario_and_seed_in_order():
    result = play()
    assert [(episode.scenario, episode.seed) for episode in result.episodes] == [(job[0], job[1]) for job in JOBS]
    assert {episode.agent for episode in result.episodes} == {"someone"}


def test_every_grid_step_counts_those_of_the_heuristic_and_of_reset_included():
    for episode in play().episodes:
        assert episode.episode_return == pytest.approx(0.75 * episode.grid_steps)
        assert episode.return_survive == episode.grid_steps
        assert episode.return_cost == pytest.approx(-0.25 * episode.grid_steps)
        assert episode.cost_tlo == pytest.approx(0.5 * episode.grid_steps)
        assert episode.decisions < episode.grid_steps


def test_an_episode_that_ends_inside_reset_is_an_episode():
    doomed = [episode for episode in play().episodes if episode.scenario == "doomed"]
    assert len(doomed) == 2
    for episode in doomed:
        assert episode.decisions == 0
        assert 0 < episode.survival == (episode.grid_steps - 1) / LENGTH < 1
        assert episode.game_over == "DIVERGENCE"
        assert episode.cost_lsi == 2.0
        assert not episode.completed


def test_the_agent_is_not_asked_about_an_episode_that_is_over():
    class Unwilling(DoNothing):
        def act(self, observation, info):
            raise AssertionError("asked")

    result = play(Unwilling(), [Job("doomed", 0, 0)])
    assert result.episodes[0].grid_steps > 0


def test_completed_episodes_have_survived_all_of_it():
    class Careful(DoNothing):
        def act(self, observation, info):
            return 1

    episode = play(Careful(), [Job("april", 0, 0)]).episodes[0]
    assert (episode.survival, episode.completed, episode.game_over) == (1.0, True, "NONE")
    assert episode.cost_lsi == 0.0


def test_results_do_not_depend_on_workers_or_order(tmp_path):
    alone = play()
    assert without_times(play(workers=2, output=tmp_path / "two").episodes) == without_times(alone.episodes)
    backwards = play(jobs=JOBS[::-1])
    assert without_times(backwards.episodes) == without_times(alone.episodes)[::-1]
    assert load_evaluation(tmp_path / "two").summary.survival == alone.summary.survival


def test_months_share_no_draws():
    seeds = {environment_seed(scenario, seed) for scenario in ("a", "b", "c") for seed in range(5)}
    assert len(seeds) == 15
    assert max(seeds) < 2**63


def test_random_episodes_differ_between_seeds_and_scenarios():
    jobs = [Job(scenario, seed, 0) for scenario in ("april", "may") for seed in range(8)]
    returns = {episode.episode_return for episode in play(jobs=jobs, heuristic=None).episodes}
    assert len(returns) > 4


def test_what_is_stored_is_what_was_returned(tmp_path):
    result = play(output=tmp_path / "out")
    loaded = load_evaluation(tmp_path / "out")
    assert loaded.episodes == result.episodes
    assert loaded.identity == IDENTITY
    assert loaded.command == "again"
    record = json.loads((tmp_path / "out" / EVALUATION_FILE).read_text())
    assert record["complete"]
    assert record["summary"]["survival"]["value"] == result.summary.survival.value
    assert not (tmp_path / "out" / PARTIAL_FILE).exists()


def test_an_interrupted_evaluation_plays_only_what_is_missing(tmp_path):
    log = tmp_path / "log"
    with pytest.raises(ValueError, match="told to fail"):
        play(output=tmp_path / "out", log=str(log), fail_on="may")
    assert (tmp_path / "out" / PARTIAL_FILE).read_text().count("\n") == 1 + 4
    with pytest.raises(UsageError, match=r"is unfinished: continue it with again, with output='.*out'"):
        load_evaluation(tmp_path / "out")
    log.unlink()
    result = play(output=tmp_path / "out", log=str(log))
    assert log.read_text().split("\n") == ["may 0", "may 1", ""]
    assert without_times(result.episodes) == without_times(play().episodes)


def test_a_finished_evaluation_plays_nothing(tmp_path):
    first = play(output=tmp_path / "out")
    again = play(output=tmp_path / "out", fail_on="april")
    assert again.episodes == first.episodes


def test_a_torn_row_is_played_again(tmp_path):
    with pytest.raises(ValueError, match="told to fail"):
        play(output=tmp_path / "out", fail_on="may")
    partial = tmp_path / "out" / PARTIAL_FILE
    partial.write_text(partial.read_text()[:-10])
    result = play(output=tmp_path / "out")
    assert without_times(result.episodes) == without_times(play().episodes)


def test_killed_in_the_middle_and_continued_equals_uninterrupted(tmp_path):
    out = tmp_path / "out"
    code = f"""
import test_protocol as t
from pathlib import Path
t.play(output=Path({str(out)!r}), workers=1, delay=0.01)
"""
    process = subprocess.Popen([sys.executable, "-c", code])
    partial = out / PARTIAL_FILE
    deadline = time.monotonic() + 60
    while not partial.exists() or partial.read_text().count("\n") < 2:
        assert time.monotonic() < deadline, "no episode was finished in a minute"
        assert process.poll() is None, "the evaluation ended before it could be killed"
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (out / EPISODES_FILE).exists()
    result = play(output=out)
    assert without_times(result.episodes) == without_times(play().episodes)


def test_another_evaluation_is_not_mixed_in(tmp_path):
    play(output=tmp_path / "out")
    before = (tmp_path / "out" / EPISODES_FILE).read_text()
    with pytest.raises(UsageError, match="holds another evaluation, with a different agent"):
        play(output=tmp_path / "out", identity={**IDENTITY, "agent": "another"})
    with pytest.raises(UsageError, match="holds another evaluation, with a different scenarios or seeds"):
        play(output=tmp_path / "out", jobs=JOBS[:2])
    assert (tmp_path / "out" / EPISODES_FILE).read_text() == before


def test_an_evaluation_is_not_written_among_other_files(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(UsageError, match="holds other files, and no evaluation"):
        play(output=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_damaged_row_is_played_again(tmp_path):
    with pytest.raises(ValueError, match="told to fail"):
        play(output=tmp_path / "out", fail_on="may")
    partial = tmp_path / "out" / PARTIAL_FILE
    lines = partial.read_text().splitlines(keepends=True)
    partial.write_text("".join([lines[0], lines[1].replace(",", ",1", 1), *lines[2:]]))
    with pytest.warns(DamageWarning, match=f"{len(lines) - 2} of its rows are whole and of this evaluation"):
        result = play(output=tmp_path / "out")
    assert without_times(result.episodes) == without_times(play().episodes)


def test_rows_that_no_description_vouches_for_are_not_taken(tmp_path):
    """A kill between the rows and their description leaves both files."""
    play(output=tmp_path / "out")
    rows = tmp_path / "out" / EPISODES_FILE
    rewrite(tmp_path / "out" / "evaluation.json", lambda record: record.update(complete=False))
    rows.write_text("half")
    result = play(output=tmp_path / "out")
    assert without_times(result.episodes) == without_times(play().episodes)
    assert load_evaluation(tmp_path / "out").episodes == result.episodes


def test_two_writers_do_not_mix(tmp_path):
    class Second(DoNothing):
        def act(self, observation, info):
            with pytest.raises(UsageError, match="Another process is writing"):
                play(output=tmp_path / "out")
            return 1

    jobs = [Job("doomed", 0, 0), Job("april", 0, 0)]
    play(Second(), jobs, output=tmp_path / "out")


@pytest.mark.parametrize(
    ("identity", "sentence"),
    [
        ({**IDENTITY, "agent": "another"}, "holds another evaluation, with a different agent"),
        (IDENTITY, "Another process wrote this evaluation to .* meanwhile"),
    ],
)
@pytest.mark.parametrize("fail_on", ["may", None])
def test_a_folder_that_was_written_meanwhile_is_not_mixed(tmp_path, identity, sentence, fail_on):
    """Both begin before there is a folder; the other one ends, or breaks off, before this one has a row."""
    out = tmp_path / "out"

    class Slower(DoNothing):
        def act(self, observation, info):
            if not out.exists():
                with contextlib.suppress(ValueError):
                    play(output=out, fail_on=fail_on)
            return 1

    with pytest.raises(UsageError, match=sentence):
        play(Slower(), output=out, identity=identity)
    result = play(output=out)
    assert without_times(result.episodes) == without_times(play().episodes)


@pytest.mark.parametrize("workers", [0, 1])
def test_a_refused_request_leaves_nothing_behind(tmp_path, workers):
    with pytest.raises(UsageError, match="Heuristic 'lazy' does not exist"):
        play(output=tmp_path / "out", workers=workers, heuristic="lazy")
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(UsageError, match="is a file"):
        play(output=tmp_path / "out")


def test_a_worker_that_fails_says_where():
    with pytest.raises(RuntimeError, match=r"scenario='may', seed=0(?s:.)*told to fail"):
        play(workers=1, fail_on="may")


def test_a_worker_that_dies_is_noticed():
    with pytest.raises(RuntimeError, match="died with exit status 3 while it played Job"):
        play(workers=1, exit_on="may")


def test_bad_requests_are_refused_in_one_sentence_before_months_are_made(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "make_scenarios", lambda *request: pytest.fail("months are made"))
    bad = {
        "choose one of do-nothing, random, recovery": {"agent": "ppoo"},
        "Task 'bus15-T0' does not exist": {"task": "bus15-T0"},
        "choose one of train, validation, test, bundled": {"split": "exam"},
        "choose one of None, idle, recovery": {"heuristic": "lazy"},
        "is not in the split validation of bus14": {"scenarios": ["nowhere"]},
        "No scenario was given": {"scenarios": []},
        "has 200; give a number from 1 to 200": {"months": 201},
        "months='two' is not allowed": {"months": "two"},
        "exclude each other": {"months": 2, "scenarios": ["generated/710000-00"]},
        "give at least one integer": {"seeds": []},
        "none negative": {"seeds": [-1]},
        "given twice": {"seeds": [3, 3]},
        "give a number of processes": {"workers": -1},
        "Option 'colour' does not exist": {"colour": "red"},
        "Agent 5 is none": {"agent": 5},
        "Agent <class .*DoNothing'> is none": {"agent": DoNothing},
    }
    for message, arguments in bad.items():
        with pytest.raises(UsageError, match=message) as caught:
            evaluate(**{"agent": "random", "task": "bus14-T0", "output": tmp_path / "out", **arguments})
        assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_what_an_agent_refuses_is_known_before_months_are_made(monkeypatch):
    def make(*request):
        yield 0
        pytest.fail("months are made")

    monkeypatch.setattr(evaluation, "make_scenarios", lambda *request: (make(), 1))
    with pytest.raises(UsageError, match="cannot play a redispatching task"):
        evaluate("recovery", "bus14-R")


def test_what_is_asked_before_months_are_made_does_not_hinder_workers(monkeypatch):
    asked = {"scenarios": list_scenarios("bus14", "validation")[:1], "episode_length": 5}
    expected = evaluate("planner", "bus14-T0", **asked)
    monkeypatch.setattr(evaluation, "make_scenarios", lambda *request: (iter((0, 1)), 1))
    played = evaluate("planner", "bus14-T0", **asked, workers=1)
    assert played.summary.survival == expected.summary.survival


def test_the_first_months_of_a_split_are_played():
    played = evaluate("do-nothing", "bus14-T0", months=2)
    assert tuple(episode.scenario for episode in played.episodes) == list_scenarios("bus14", "validation")[:2]
    assert "months=2" in played.command


@pytest.mark.parametrize("grid_id", GRID_IDS)
def test_every_grid_can_be_evaluated(grid_id):
    scenario = list_scenarios(grid_id, "bundled")[0]
    for kind in ("T0", "R"):
        result = evaluate(
            "random", f"{grid_id}-{kind}", split="bundled", scenarios=(f"{scenario}[0:5]",), seeds=(0,), workers=0
        )
        (episode,) = result.episodes
        assert 1 <= episode.grid_steps <= 4
        assert episode.episode_return <= episode.grid_steps


@pytest.mark.parametrize("engine", ENGINES)
def test_bus14_rows_agree_with_the_environment(tmp_path, engine):
    options = {"seeds": (0, 1), "heuristic": "idle", "engine": engine, "workers": 0}
    options["scenarios"] = list_scenarios("bus14", "validation")[:2]
    result = evaluate(RandomAgent(), "bus14-T0", output=tmp_path / "out", **options)
    assert load_evaluation(tmp_path / "out").episodes == result.episodes
    assert len(result.episodes) == 2 * result.summary.scenarios == 4
    assert result.identity["task"] == "rl2grid/bus14-T0-v0"
    assert result.identity["engine"] == engine == result.episodes[0].engine
    assert result.identity["scenario_pack_hash"].startswith(f"{VERSION}-")
    assert len(result.identity["action_set_hash"]) == 16
    for episode in result.episodes:
        assert episode.return_survive == episode.grid_steps - (not episode.completed)
        assert 0 <= episode.survival <= 1
        assert (episode.survival == 1) == episode.completed == (episode.game_over == "NONE")
        weighted = episode.return_survive + 0.5 * episode.return_overload + 0.5 * episode.return_cost
        assert episode.episode_return == pytest.approx(weighted)


def test_a_constraint_that_contradicts_the_task_is_refused():
    with pytest.raises(UsageError, match="contradicts task"):
        evaluate(DoNothing(), "bus14-T0-LSI", constraint="TLO")


@pytest.mark.parametrize("engine", ENGINES)
def test_the_final_info_counts_what_was_added_up(engine):
    register_all()
    keywords = {"engine": engine, "heuristic": "recovery", "split": "validation"}
    env = gymnasium.make("rl2grid/bus14-T0-v0", disable_env_checker=True, **keywords)
    agent = RandomAgent()
    agent.bind(env)
    last = {}

    class Watched(gymnasium.Wrapper):
        def step(self, action):
            result = self.env.step(action)
            last.update(result[4])
            return result

    played = play_episode(agent, Watched(env), scenario=list_scenarios("bus14", "validation")[0], seed=0)
    assert played.episode_return == pytest.approx(last["episode_return"])
    assert played.return_overload == pytest.approx(last["episode_components"]["overload"])
    assert played.cost_tlo == pytest.approx(last["episode_costs"]["TLO"])
    assert played.cost_lsi == last["episode_costs"]["LSI"]
    assert played.decisions == last["decisions"]
    assert np.isfinite(played.score_margin)
    env.close()


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy of bus14-T0 that was never trained, as a run with the idle heuristic would store it."""
    register_all()
    arguments = hyperparameters("ppo", "bus14-T0", num_envs=1, seed=3)
    keywords = {"heuristic": "idle", "normalize": "physical"}
    envs = gymnasium.make_vec("rl2grid/bus14-T0-v0", num_envs=1, gamma=arguments.gamma, **keywords)
    trainer = ppo.PPO(arguments, envs)
    path = tmp_path_factory.mktemp("run") / "checkpoint.pt"
    contents = {
        "algorithm": "ppo",
        "task": "rl2grid/bus14-T0-v0",
        "env_keywords": keywords,
        "identity": {},
        "decisions": 0,
        "policy": trainer.policy_state(),
    }
    save_checkpoint(path, contents)
    envs.close()
    return path


def test_a_checkpoint_plays_as_it_was_trained(checkpoint, tmp_path):
    months = {"scenarios": list_scenarios("bus14", "validation")[:3], "name": "mine"}
    alone = evaluate(checkpoint, "bus14-T0", **months)
    assert alone.identity["heuristic"] == "idle"
    assert alone.identity["agent_identity"]["policy_hash"]
    assert {episode.agent for episode in alone.episodes} == {"mine"}
    assert all(episode.agent_hash and episode.heuristic == "idle" for episode in alone.episodes)
    remote = evaluate(checkpoint, "bus14-T0", **months, workers=1, output=tmp_path / "out")
    assert without_times(remote.episodes) == without_times(alone.episodes)
    assert remote.identity == alone.identity


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_policy_played_is_the_one_whose_hash_is_stored(checkpoint, tmp_path, monkeypatch, workers):
    """A run that still trains replaces its file at any moment, this one between the identity and the first episode."""
    path = tmp_path / "best.pt"
    shutil.copy(checkpoint, path)

    def replaced(*arguments):
        path.write_bytes(b"another policy")
        return make_crew(*arguments)

    monkeypatch.setattr(evaluation, "make_crew", replaced)
    options = {"scenarios": list_scenarios("bus14", "validation")[:1], "name": "mine"}
    result = evaluate(path, "bus14-T0", workers=workers, **options)
    monkeypatch.undo()
    assert path.read_bytes() == b"another policy"
    assert without_times(result.episodes) == without_times(evaluate(checkpoint, "bus14-T0", **options).episodes)


def test_a_checkpoint_of_another_task_is_refused(checkpoint):
    with pytest.raises(UsageError, match=r"is of task .*bus14-T0-v0.* cannot be used for task .*bus14-T1"):
        evaluate(checkpoint, "bus14-T1")
    with pytest.raises(UsageError, match="was trained with normalize='physical'"):
        evaluate(checkpoint, "bus14-T0", normalize=None)
