"""The command line: what it prints, and how it refuses."""

import errno
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import rl2grid
from rl2grid.algorithms import ppo
from rl2grid.cli import tasks
from rl2grid.cli.main import main
from rl2grid.errors import DamageWarning, UsageError
from rl2grid.records.evaluations import load_evaluation


def refused(capsys, *command_line):
    """The one sentence with which a command line is refused."""
    assert main(command_line) == 2
    captured = capsys.readouterr()
    (sentence,) = captured.err.strip().splitlines()
    assert sentence.startswith("rl2grid: ")
    assert sentence.endswith((".", "?"))
    return sentence


def test_tasks_lists_all_with_their_sizes(capsys):
    assert main(["tasks"]) == 0
    output = capsys.readouterr().out
    assert "199 tasks" in output
    assert "73,357 discrete" in output
    assert "69 continuous" in output
    assert "multi-area opponent" in output


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "runs/a/metrics.csv"),
            "runs/a/metrics.csv cannot be read or written: No space left on device; make room, and begin or resume "
            "again.",
        ),
        (OSError(errno.EROFS, "Read-only file system"), "A file cannot be read or written: Read-only file system."),
        (UsageError("Agent \x1b[31mred\x07 is unknown."), "Agent  [31mred  is unknown."),
    ],
)
def test_a_full_or_read_only_disk_is_one_sentence(monkeypatch, capsys, error, sentence):
    def fail(options, output):
        raise error

    monkeypatch.setattr(tasks, "_run", fail)
    assert refused(capsys, "tasks") == f"rl2grid: {sentence}"


def test_what_was_set_aside_is_said_in_one_sentence(monkeypatch, capsys):
    def warn(options, output):
        warnings.warn("It was set aside.", DamageWarning, stacklevel=1)
        return 0

    monkeypatch.setattr(tasks, "_run", warn)
    for _ in range(2):  # every time
        assert main(["tasks"]) == 0
        assert capsys.readouterr().err == "rl2grid: It was set aside.\n"


@pytest.mark.parametrize("missing", ["torch", "matplotlib"])
def test_without_the_extras_the_demonstration_says_what_to_install(missing):
    hide = f"import sys; sys.modules[{missing!r}] = None; from rl2grid.cli.main import main; sys.exit(main(['demo']))"
    done = subprocess.run([sys.executable, "-c", hide], capture_output=True)
    assert done.returncode == 2
    (sentence,) = done.stderr.decode().strip().splitlines()
    assert sentence.endswith("install it with `pip install rl2grid[train,analysis]`.")


def test_tasks_of_one_grid(capsys):
    assert main(["tasks", "--grid", "bus14"]) == 0
    output = capsys.readouterr().out
    assert "13 tasks" in output
    assert "50 discrete and 6 continuous" in output
    assert "bus36" not in output


@pytest.mark.parametrize(
    ("command_line", "part"),
    [
        (["tasks", "--grid", "bus15"], "choose one of bus14, bus36-M"),
        (["frobnicate"], "choose from 'demo', 'tasks'"),
        (["tasks", "--grids", "bus14"], "--grids"),
        (["train", "ppo"], "needs an algorithm and a task"),
        (["train", "td4", "bus14-T0"], "Algorithm 'td4' does not exist: choose one of ppo"),
        (["train", "ppo", "bus14-T7"], "with level 0, 1"),
        (["train", "ppo", "bus14-T0", "--sede", "3"], "Flag --sede does not exist: did you mean --seed"),
        (["train", "ppo", "bus14-T0", "--seed", "x"], "rl2grid: --seed takes a whole number, not 'x'; see"),
        (
            ["train", "ppo", "bus14-T0", "--decisions", "1e5"],
            "rl2grid: --decisions takes a whole number, not '1e5'; see",
        ),
        (["train", "ppo", "bus14-T0", "--threads", "x"], "rl2grid: --threads takes a whole number, not 'x'; see"),
        (["train", "ppo", "bus14-T0", "--gamma", "a"], "rl2grid: --gamma takes a number, not 'a'; see"),
        (["train", "ppo", "bus14-T0", "--max-minutes", "x"], "rl2grid: --max-minutes takes a number, not 'x'; see"),
        (["train", "ppo", "bus14-T0", "--actor-layers", "1e2"], "rl2grid: --actor-layers does not take '1e2'; see"),
        (["train", "ppo", "bus14-T0", "--preset", "best"], "choose one of default, paper"),
        (["train", "ppo", "bus14-T0", "--heuristic", "lazy"], "choose one of None, idle, recovery"),
        (["train", "ppo", "bus14-T0", "--num-envs", "0"], "rl2grid: PPO needs num_envs of at least 1"),
        (["train", "ppo", "bus14-T0", "--engine", "fast"], "choose one of native, reference"),
        (["train", "ppo", "bus14-T0", "--workers", "2"], "is not for engine='native': give num_threads"),
        (["train", "ppo", "bus14-T0", "--threads", "0"], "num_threads=0 is not allowed"),
        (["train", "ppo", "bus14-R", "--constraint", "N-1"], "choose one of None, LSI, TLO"),
        (["train", "ppo", "bus14-T0-LSI", "--constraint", "TLO"], "constraint='TLO' contradicts task"),
        (["train", "lagrangian-ppo", "bus14-R"], "needs a constraint"),
        (["train", "lagrangian-ppo", "bus14-T0", "--seed", "2"], "needs a constraint"),
        (["train", "--resume", "no-such-run"], "holds no run"),
        (["train", "--resume", "no-such-run", "--max-minutes", "-1"], "give a positive number of minutes"),
        (["train", "--resume", "no-such-run", "--seed", "1"], "--seed does not exist: when it goes on, a run keeps"),
        (["train", "ppo", "bus14-T0", "--max-minutes", "0"], "give a positive number of minutes"),
        (["evaluate", "genius", "bus14-T0"], "choose one of do-nothing, random, recovery"),
        (["evaluate", "do-nothing", "bus99-T0"], "with a grid of bus14"),
        (["evaluate", "do-nothing", "bus14-T0", "--split", "dev"], "choose from 'train', 'validation'"),
        (["evaluate", "do-nothing", "bus14-T0", "--seeds", "0"], "seeds"),
        (["evaluate", "do-nothing", "bus14-T0", "--months", "0"], "months=0 is not allowed"),
        (
            ["evaluate", "do-nothing", "bus14-T0", "--months", "x"],
            "rl2grid: --months takes a whole number, not 'x'; see",
        ),
        (["evaluate", "do-nothing", "bus14-T0", "--engine", "fast"], "choose from 'native', 'reference'"),
        (["evaluate", "do-nothing", "bus14-T0", "--constraint", "N-1"], "choose from 'None', 'LSI', 'TLO'"),
        (["evaluate", "do-nothing", "bus14-T0-LSI", "--constraint", "TLO"], "contradicts task"),
        (["rank", "bus15"], "choose one of bus14"),
        (["rank", "bus14", "--sampling", "lucky"], "choose one of exhaustive, uniform"),
        (["rank", "bus14", "--states", "0"], "at least 2"),
    ],
)
def test_refusals_are_one_sentence_with_what_is_allowed(capsys, tmp_path, monkeypatch, command_line, part):
    monkeypatch.chdir(tmp_path)
    assert part in refused(capsys, *command_line)
    assert not list(tmp_path.iterdir()), "a refused command must write nothing"


@pytest.mark.parametrize(
    "command_line",
    [
        ["evaluate", "do-nothing", "bus14-T0", "--output"],
        ["train", "ppo", "bus14-T0", "--output"],
        ["rank", "bus14", "--output"],
        ["watch", "do-nothing", "bus14-T0", "--output"],
        ["demo", "--output"],
        ["study", "run", "paper", "--scale", "quick", "--output"],
        ["study", "tune", "TUNING", "--output"],
    ],
)
def test_outputs_below_a_file_are_refused_before_anything_is_played(capsys, tmp_path, monkeypatch, command_line):
    (tmp_path / "file").write_text("")
    tuning = 'algorithm = "ppo"\ntask = "bus14-T0"\ntrials = 1\nname = "few"\n'
    (tmp_path / "few.toml").write_text(tuning)
    command_line = [str(tmp_path / "few.toml") if word == "TUNING" else word for word in command_line]
    monkeypatch.setattr(ppo.PPO, "iterate", None)
    monkeypatch.setattr("rl2grid.evaluation.protocol.make_crew", None)
    sentence = refused(capsys, *command_line, str(tmp_path / "file" / "a" / "b"))
    assert "cannot be made" in sentence


def test_an_interrupt_at_once_tells_how_the_training_goes_on(capsys, tmp_path, monkeypatch):
    def interrupted(args, **_):
        if args.task.id == "rl2grid/bus14-T0-v0":
            Path("runs/bus14-T0-v0-ppo-1").mkdir(parents=True)
        raise KeyboardInterrupt

    monkeypatch.setattr("rl2grid.training.runs.train", interrupted)
    monkeypatch.chdir(tmp_path)
    assert main(["train", "ppo", "bus14-T0", "--seed", "1"]) == 130
    assert "go on with `rl2grid train --resume runs/bus14-T0-v0-ppo-1`" in capsys.readouterr().err
    assert main(["train", "ppo", "bus14-R", "--seed", "1"]) == 130
    assert "the same command goes on" in capsys.readouterr().err


def test_the_report_of_a_training_reads_its_checkpoint_once(capsys, monkeypatch):
    asked = []
    monkeypatch.setattr("rl2grid.training.runs.train", lambda args, **_: Path("run"))
    monkeypatch.setattr("rl2grid.training.runs.is_finished", asked.append)
    assert main(["train", "ppo", "bus14-T0"]) == 130
    assert asked == [Path("run")]


def test_help_of_training_lists_hyperparameters_with_their_meaning(capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["train", "ppo", "bus14-T0", "--help"])
    assert exit_.value.code == 0
    output = capsys.readouterr().out
    assert "--clip-coefficient" in output
    assert "--heuristic" in output


def test_works_as_a_module_and_says_its_version():
    command = [sys.executable, "-m", "rl2grid", "--version"]
    assert (
        subprocess.run(command, capture_output=True, text=True, check=True).stdout == f"rl2grid {rl2grid.__version__}\n"
    )


def test_an_evaluation_names_its_engine_and_may_use_the_other(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for flags, folder in (
        ([], "validation-2-months"),
        (["--engine", "reference", "--workers", "0"], "validation-2-months-engine-reference"),
    ):
        assert main(["evaluate", "do-nothing", "bus14-T0", "--months", "2", *flags]) == 0
        assert f"{folder}/episodes.csv" in capsys.readouterr().out.replace("\n", "")
    native, reference = (
        load_evaluation(Path("runs/bus14-T0-v0-do-nothing/evaluation") / folder)
        for folder in ("validation-2-months", "validation-2-months-engine-reference")
    )
    assert [result.identity["engine"] for result in (native, reference)] == ["native", "reference"]
    assert "--engine" not in native.command
    assert reference.command.endswith("--engine reference")
    for mine, theirs in zip(native.episodes, reference.episodes, strict=True):
        assert (mine.grid_steps, mine.game_over) == (theirs.grid_steps, theirs.game_over)
        assert mine.episode_return == pytest.approx(theirs.episode_return, rel=1e-6)
