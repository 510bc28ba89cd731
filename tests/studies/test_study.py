"""Studies: what a file means, what is refused, and that failures, stops and kills lose nothing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import pandas as pd
import pytest

import rl2grid
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import AGENTS, make_agent
from rl2grid.records.files import write_json
from rl2grid.records.labels import read_labels_description
from rl2grid.records.locks import is_locked
from rl2grid.records.studies import read_result
from rl2grid.studies import run as study_run
from rl2grid.studies.backends import Local, Slurm
from rl2grid.studies.cell import BUSY, FAILED, FINISHED, REFUSED, CellResult, commands, prepare, run_cell
from rl2grid.studies.cells import cell_from_dict, cell_to_dict
from rl2grid.studies.run import run_study
from rl2grid.studies.states import State, read_states
from rl2grid.studies.study import included_studies, parse_study
from rl2grid.studies.toml_file import read_toml
from rl2grid.training.teaching import Taught, teach

GROUP: dict[str, Any] = {"algorithms": ["ppo"], "tasks": ["bus14-T0"]}


PUPIL = {"algorithms": ["imitation"], "teacher": "greedy", "rounds": [2, 2]}
TAUGHT = {**PUPIL, "algorithms": ["ppo"]}


def contents(**changes: Any) -> dict[str, Any]:
    group = {**GROUP, **changes.pop("group", {})}
    return {"name": "some", "budget": 1024, "months": 2, **changes, "group": [group]}


def test_cells_are_the_product_and_the_nearest_setting_counts():
    group = {"heuristics": ["none", "idle"], "agents": ["greedy"], "seeds": {"full": [7, 8]}, "budget": 4096}
    scales = {"quick": {"budget": 512, "seeds": [3]}, "full": {"budget": 2048}}
    quick = parse_study(contents(group=group, scale=scales))
    assert [cell.name for cell in quick.cells] == [
        "bus14-T0-v0-greedy",
        "bus14-T0-v0-ppo-3",
        "bus14-T0-v0-greedy-idle",
        "bus14-T0-v0-ppo-idle-3",
    ]
    assert quick.output == Path("studies/some/quick")
    assert {cell.decisions for cell in quick.cells} == {0, 4096}
    full = parse_study(contents(group=group, scale=scales), "full")
    assert [cell.training.seed for cell in full.cells if cell.training] == [7, 8, 7, 8]


def test_hyperparameters_are_those_of_all_then_those_of_one_algorithm():
    table = {"num_envs": 4, "ppo": {"actor_layers": [8, 8]}}
    study = parse_study(contents(group={"algorithms": ["ppo", "sac"], "hyperparameters": table}))
    ppo, sac = (cell.training.resolved(cell.task) for cell in study.cells if cell.training)
    assert (ppo.num_envs, sac.num_envs) == (4, 4)
    assert ppo.actor_layers == (8, 8) != sac.actor_layers


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"sede": 1}, "Key of the study, 'sede' does not exist (did you mean 'seeds'?)"),
        ({"group": {"task": ["bus14-T0"]}}, "Key of group 1, 'task' does not exist (did you mean 'tasks'?)"),
        ({"group": {"algorithms": ["pop"]}}, "algorithm 'pop' does not exist (did you mean 'ppo'?)"),
        ({"group": {"agents": ["greed"]}}, "agent 'greed' does not exist (did you mean 'greedy'?)"),
        ({"group": {"heuristics": ["lazy"]}}, "choose one of none, idle, recovery"),
        ({"group": {"tasks": ["bus14-T9"]}}, "with level 0, 1"),
        ({"group": {"algorithms": ["td3"]}}, "'td3' cannot learn rl2grid/bus14-T0-v0, which has discrete actions"),
        ({"group": {"algorithms": [], "agents": ["dc-opf"]}}, "agent 'dc-opf' cannot play rl2grid/bus14-T0-v0"),
        ({"group": {"hyperparameters": {"gama": 0.9}}}, "'gama' does not exist (did you mean 'gamma'?)"),
        ({"group": {"hyperparameters": {"num_envs": "4"}}}, "num_envs must be a whole number, not '4'"),
        ({"group": {"hyperparameters": {"initial_do_nothing": "a"}}}, "initial_do_nothing must be a number, not 'a'"),
        ({"group": {"hyperparameters": {"actor_layers": ["a"]}}}, "must be a list, each entry a whole number"),
        ({"group": {"hyperparameters": {"actor_layers": 8}}}, "must be a list, each entry a whole number"),
        ({"group": {"hyperparameters": {"gamma": True}}}, "gamma must be a number, not True"),
        ({"group": {"hyperparameters": {"seed": 4}}}, "give seeds"),
        ({"group": {"hyperparameters": {"sac": {"tau": 1}}}}, "hyperparameters of sac, which it does not train"),
        ({"group": {"environment": {"dispatch": "best"}}}, "choose one of exact, grid2op"),
        ({"group": {"environment": {"reward": "best"}}}, "Reward 'best' does not exist"),
        ({"group": {"algorithms": ["lagrangian-ppo"]}}, "Group 1: Lagrangian PPO needs a constraint"),
        ({"group": {"tasks": ["bus14-T0-TLO"], "environment": {"constraint": "LSI"}}}, "constraint='LSI' contradicts"),
        (
            {
                "group": {
                    "algorithms": [],
                    "agents": ["greedy"],
                    "tasks": ["bus14-T0-TLO"],
                    "environment": {"constraint": "LSI"},
                }
            },
            "constraint='LSI' contradicts",
        ),
        ({"group": {"budget": {"quick": 1}}}, "scale 'quick' does not exist"),
        ({"budget": 3}, "total_timesteps (--decisions) of at least"),
        ({"budget": "much"}, "budget must be a whole number of at least 1, not 'much'"),
        ({"split": "exam"}, "split 'exam' does not exist"),
        ({"preset": "best"}, "choose one of default, paper"),
        ({"preset": ["a"]}, "Group 1 needs preset, a text in quotation marks"),
        ({"seeds": [1, 1]}, "Cell bus14-T0-v0-ppo-1 is listed twice"),
        ({"name": "a/b"}, "name may contain letters"),
        ({"group": {"algorithms": ["imitation"]}}, "trains pupils: give teacher, an agent, and rounds"),
        ({"group": {**PUPIL, "teacher": "greed"}}, "(did you mean 'greedy'?)"),
        ({"group": {**PUPIL, "teacher": "dc-opf"}}, "agent 'dc-opf' cannot play"),
        ({"group": {**PUPIL, "rounds": 20}}, "rounds must be a list such as [200, 200], not 20"),
        ({"group": {**PUPIL, "rounds": [20, 0]}}, "each of rounds must be a whole number of at least 1, not 0"),
        ({"group": {**PUPIL, "hyperparameters": {"labels": ["some"]}}}, "has labels and a teacher"),
        ({"group": {**PUPIL, "algorithms": ["dqn"]}}, "trains dqn, which cannot go on from a pupil"),
        ({"group": {**TAUGHT, "hyperparameters": {"start_from": "some"}}}, "has start_from and a teacher"),
        ({"group": {"teacher": "greedy"}}, "trains pupils: give teacher, an agent, and rounds"),
        ({"group": {**TAUGHT, "pupil_budget": 0}}, "pupil_budget must be a whole number of at least 1, not 0"),
        ({"group": {**TAUGHT, "pupil_budget": 7}}, "Imitation needs total_timesteps (--decisions) of at least"),
    ],
)
def test_a_bad_file_is_refused_in_one_sentence(changes: dict[str, Any], part: str):
    with pytest.raises(UsageError) as refusal:
        parse_study(contents(**changes))
    assert part in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("task", ["bus14-T0", "bus14-R"])
@pytest.mark.parametrize("agent", AGENTS)
def test_studies_accept_the_tasks_that_an_agent_can_play(agent: str, task: str):
    with closing(gymnasium.make(find_task(task).id, split="validation")) as env:
        group = {"algorithms": [], "agents": [agent], "tasks": [task]}
        try:
            make_agent(agent).bind(env)
        except UsageError:
            with pytest.raises(UsageError, match="cannot play"):
                parse_study(contents(group=group))
        else:
            assert len(parse_study(contents(group=group)).cells) == 1


def test_the_keyword_constrains_a_task_without_a_constraint():
    group = {"algorithms": ["lagrangian-ppo"], "environment": {"constraint": "LSI"}}
    assert len(parse_study(contents(group=group)).cells) == 1


@pytest.mark.parametrize("name", sorted(included_studies()))
def test_included_studies_are_valid_at_every_scale(name: str):
    file = read_toml(included_studies()[name])
    sizes = [len(parse_study(file, scale).cells) for scale in file["scale"]]
    assert sizes == sorted(sizes)
    assert list(file["scale"]) == ["quick", "full"]


def test_the_paper_at_full_scale_has_the_reward_of_its_code_its_hyperparameters_and_budget():
    cells = parse_study(read_toml(included_studies()["paper"]), "full").cells
    assert all(cell.environment["reward"] == "released" for cell in cells)
    trained = [cell for cell in cells if cell.training is not None]
    assert all(cell.training.preset == "paper" and cell.decisions == 80_000_000 for cell in trained)


@pytest.mark.parametrize("name", sorted(included_studies()))
def test_cells_of_included_studies_can_be_compared(name: str):
    file = read_toml(included_studies()[name])
    for scale in file["scale"]:
        asked: dict[Task, set[tuple[Any, ...]]] = {}
        for cell in parse_study(file, scale).cells:
            asked.setdefault(cell.task, set()).add((cell.split, cell.scenarios, cell.evaluation_seeds))
        assert [task for task, questions in asked.items() if len(questions) > 1] == []


def test_a_cell_survives_its_file(tmp_path: Path):
    group = {"environment": {"reward": [1.0, 0.5, 0.25]}, "hyperparameters": {"actor_layers": [8]}}
    (cell,) = parse_study(contents(group=group)).cells
    assert cell_from_dict(json.loads(json.dumps(cell_to_dict(cell)))) == cell
    prepare(tmp_path, cell)
    prepare(tmp_path, cell)
    (other,) = parse_study(contents(group=group, budget=2048)).cells
    with pytest.raises(UsageError, match="another training"):
        prepare(tmp_path, other)


def test_a_pupil_is_labelled_for_in_rounds_and_goes_on_after_an_interruption(tmp_path: Path, monkeypatch):
    group = {
        **PUPIL,
        "environment": {"episode_length": 288},
        "hyperparameters": {"num_steps": 1024, "actor_layers": [8]},
    }
    (cell,) = parse_study(contents(group=group, budget=2048, split="validation", validations=1)).cells
    assert cell_from_dict(json.loads(json.dumps(cell_to_dict(cell)))) == cell
    prepare(tmp_path / "whole", cell)
    run_cell(tmp_path / "whole")
    labels = read_labels_description(tmp_path / "whole" / "labels")
    assert [(each["months"], each["pupil"] is None) for each in labels["rounds"]] == [(2, True), (2, False)]

    def stop_at_the_second_round(*words: Any, pupil: Path | None, **keywords: Any) -> Taught:
        if pupil is not None:
            raise KeyboardInterrupt
        return teach(*words, pupil=pupil, **keywords)

    prepare(tmp_path / "stopped", cell)
    with monkeypatch.context() as patch:
        patch.setattr("rl2grid.studies.cell.teach", stop_at_the_second_round)
        with pytest.raises(KeyboardInterrupt):
            run_cell(tmp_path / "stopped")
    assert (tmp_path / "stopped" / "pupil-1").exists()
    run_cell(tmp_path / "stopped")
    whole, stopped = (read_result(tmp_path / name) for name in ("whole", "stopped"))
    assert whole is not None
    assert stopped is not None
    assert whole.survival == stopped.survival
    words = commands(tmp_path / "whole", cell)
    assert [line.split()[1] for line in words] == ["teach", "train", "teach", "train", "evaluate"]


@pytest.mark.slow
def test_an_algorithm_goes_on_from_the_last_pupil(tmp_path: Path):
    group = {
        **TAUGHT,
        "pupil_budget": 20_000,
        "environment": {"episode_length": 288},
        "hyperparameters": {"actor_layers": [8], "gamma": 0.95},
    }
    (cell,) = parse_study(contents(group=group, budget=512, split="validation", validations=1)).cells
    assert cell.name == "bus14-T0-v0-ppo-from-imitation-1"
    assert cell_from_dict(json.loads(json.dumps(cell_to_dict(cell)))) == cell
    prepare(tmp_path, cell)
    run_cell(tmp_path)
    words = [line.split()[1:3] for line in commands(tmp_path, cell)]
    assert words == [
        *(["teach", "greedy"], ["train", "imitation"]) * 2,
        ["train", "ppo"],
        ["evaluate", str(tmp_path / "run")],
    ]
    began = json.loads((tmp_path / "run" / "config.json").read_text())["identity"]["start"]
    assert began["algorithm"] == "imitation"
    assert began["path"] == str(tmp_path / "pupil-2")


class FakeBackend:
    """Ends each submitted cell with the next of its statuses."""

    slots = 1

    def __init__(self, statuses: dict[str, list[int]]) -> None:
        self.statuses, self.submitted = statuses, []

    def submit(self, folder: Path) -> FakeBackend:
        self.submitted.append(folder.name)
        status = self.statuses[folder.name].pop(0)
        if status == FINISHED:
            write_json(folder / "result.json", vars(CellResult(1.0, "abc", 0.5, 2)))
        else:
            (folder / "log.txt").write_text(f"failed with {status}\n\n")
        self._status = status
        return self

    def poll(self) -> int:
        return self._status

    def stop(self) -> None: ...


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(study_run, "_POLL_SECONDS", 0.001)
    monkeypatch.setattr(study_run, "_BUSY_SECONDS", 0.001)
    monkeypatch.setattr(study_run, "write_study_episodes", lambda folder, cells: None)


def test_failures_are_tried_again_refusals_are_not_and_the_others_go_on(tmp_path: Path, quick):
    study = parse_study(contents(seeds=[1, 2, 3, 4]), output=tmp_path)
    names = [cell.name for cell in study.cells]
    statuses = {names[0]: [FAILED] * 9, names[1]: [REFUSED], names[2]: [BUSY, FAILED, FINISHED], names[3]: [FINISHED]}
    backend = FakeBackend(statuses)
    states = run_study(study, backend)
    assert [state.state for state in states] == [State.FAILED, State.FAILED, State.DONE, State.DONE]
    assert [backend.submitted.count(name) for name in names] == [3, 1, 3, 1]
    assert states[0].error == "failed with 1"
    assert [state.state for state in read_states(study)] == [state.state for state in states]

    again = FakeBackend({names[0]: [FINISHED], names[1]: [FINISHED]})
    assert {state.state for state in run_study(study, again)} == {State.DONE}
    assert again.submitted == names[:2], "finished cells are not run again"
    stored = json.loads((tmp_path / "study.json").read_text())
    assert {entry["state"] for entry in stored["cells"]} == {"done"}
    assert stored["cells"][0]["commands"][0].startswith(
        "rl2grid train ppo bus14-T0 --decisions 1024 --evaluate-every 102 --validation-months 2 --output"
    )
    assert stored["cells"][0]["commands"][1].endswith("--split test --seeds 1 --months 2 --heuristic None")


WAITING_CELL = """
import sys, time
from pathlib import Path
from filelock import FileLock
from rl2grid.records.files import write_json
from rl2grid.studies.cell import serve
folder = Path(sys.argv[1])
def do():
    with FileLock(folder / ".lock").acquire(timeout=0):
        (folder / "began").touch()
        try:
            time.sleep(60)
        finally:
            (folder / "ended").touch()
sys.exit(serve(do))
"""


def wait_for(path: Path) -> None:
    end = time.monotonic() + 300.0  # starting three processes takes half a minute where others compete for the cores
    while not path.exists():
        assert time.monotonic() < end, f"{path} does not appear"
        time.sleep(0.02)


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(Path(rl2grid.__file__).parents[1])}


def test_a_cell_on_a_full_disk_fails_with_a_sentence_and_may_be_tried_again():
    code = (
        "import errno, sys\nfrom rl2grid.studies.cell import serve\n"
        "def do():\n    raise OSError(errno.ENOSPC, 'No space left on device', 'run/metrics.csv')\nsys.exit(serve(do))"
    )
    command, pipe = [sys.executable, "-c", code], subprocess.PIPE
    with subprocess.Popen(command, env=environment(), stdin=pipe, stderr=pipe, text=True) as process:
        said = process.stderr.read()  # before the standard input ends, which asks a cell to stop
    assert process.returncode == FAILED
    assert said == "rl2grid: run/metrics.csv cannot be read or written: No space left on device.\n"


@pytest.mark.slow
def test_an_interrupt_lets_the_cells_end_in_good_order(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", environment()["PYTHONPATH"])
    study = parse_study(contents(), output=tmp_path)
    folder = study.folder(study.cells[0])

    def interrupt() -> None:
        wait_for(folder / "began")
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        run_study(study, Local(1, (sys.executable, "-c", WAITING_CELL)))
    assert (folder / "ended").exists()
    assert not is_locked(folder)


STUDY_FILE = """
name = "killed"
split = "validation"
months = 1
budget = 1_536
validations = 3
[[group]]
algorithms = ["ppo"]
tasks = ["bus14-T0"]
heuristics = ["idle"]
"""


def start(tmp_path: Path, output: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "rl2grid", "study", "run", "killed.toml", "--output", output]
    return subprocess.Popen(command, cwd=tmp_path, env=environment(), stdout=subprocess.DEVNULL)


@pytest.mark.slow
def test_a_study_killed_in_the_middle_ends_with_the_same_episodes(tmp_path: Path):
    (tmp_path / "killed.toml").write_text(STUDY_FILE)
    assert start(tmp_path, "straight").wait() == 0
    killed = start(tmp_path, "killed")
    wait_for(tmp_path / "killed" / "cells" / "bus14-T0-v0-ppo-idle-1" / "run" / "metrics.csv")
    killed.kill()
    killed.wait()
    assert start(tmp_path, "killed").wait() == 0
    straight, again = (
        pd.read_csv(tmp_path / name / "episodes.csv").drop(columns="wall_time_s") for name in ("straight", "killed")
    )
    assert len(straight) == 1
    pd.testing.assert_frame_equal(straight, again)


@pytest.mark.slow
def test_jobs_of_submitit_work_on_cells(tmp_path: Path, monkeypatch):
    pytest.importorskip("submitit")
    group = {"algorithms": [], "agents": ["do-nothing"]}
    study = parse_study(contents(months=1, split="validation", group=group), output=tmp_path / "out")
    backend = Slurm(tmp_path / "jobs", 1, {"timeout_min": 5}, cluster="local")
    (state,) = run_study(study, backend)
    assert state.state == State.DONE
    assert (tmp_path / "out" / "episodes.csv").read_text().count("\n") == 2


@pytest.mark.slow
def test_ray_works_on_cells(tmp_path: Path):
    ray = pytest.importorskip("ray")
    from rl2grid.studies.backends import Ray

    group = {"algorithms": [], "agents": ["do-nothing"]}
    study = parse_study(contents(months=1, split="validation", group=group), output=tmp_path / "out")
    try:
        (state,) = run_study(study, Ray(1))
    finally:
        ray.shutdown()
    assert state.state == State.DONE
