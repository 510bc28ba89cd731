"""What surrounds a training run: its time limit, its energy account, Weights & Biases."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from toy_runs import assert_same_run, falling, request, toy_envs

from rl2grid.errors import UsageError
from rl2grid.training.energy import CO2_PER_KWH, WATTS_PER_CORE, energy_line
from rl2grid.training.limits import TimeLimit
from rl2grid.training.runs import is_finished, resume, train


class Over(TimeLimit):
    """A limit that is reached at once."""

    def __init__(self) -> None:
        super().__init__(1e-9)


@pytest.fixture(autouse=True)
def _without_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "codecarbon", None)
    monkeypatch.setitem(sys.modules, "wandb", None)


def account(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "energy.json").read_text())


# --- Time limit -----------------------------------------------------------------------------------------------------


def test_a_run_stopped_by_its_time_limit_again_and_again_ends_like_one_that_was_not(tmp_path: Path):
    straight = train(request(tmp_path / "straight"), evaluate=falling, make_envs=toy_envs)
    folder = train(
        request(tmp_path / "run", checkpoint_seconds=1e9), evaluate=falling, limit=Over(), make_envs=toy_envs
    )
    assert "stopped at 32 decisions" in (folder / "log.txt").read_text()
    assert not is_finished(folder)
    resume(folder, evaluate=falling, limit=Over(), make_envs=toy_envs)
    assert "stopped at 64 decisions" in (folder / "log.txt").read_text()
    resume(folder, evaluate=falling, limit=TimeLimit(60.0), make_envs=toy_envs)
    assert is_finished(folder)
    assert_same_run(folder, straight)


@pytest.mark.parametrize("minutes", [0.0, -1.0, float("nan"), float("inf")])
def test_a_limit_is_a_positive_number_of_minutes(minutes: float):
    with pytest.raises(UsageError, match="give a positive number of minutes"):
        TimeLimit(minutes)
    assert not TimeLimit(None).reached
    assert not TimeLimit(60.0).reached


# --- Energy ---------------------------------------------------------------------------------------------------------


def test_energy_is_estimated_from_processor_time_and_added_up_over_interruptions(tmp_path: Path):
    folder = train(request(tmp_path / "run"), limit=Over(), make_envs=toy_envs)
    first = account(folder)
    resume(folder, make_envs=toy_envs)
    whole = account(folder)
    assert whole["method"] == "estimate"
    assert [part["cpu_seconds"] > 0.0 for part in whole["parts"]] == [True, True]
    assert whole["parts"][0] == first["parts"][0]
    seconds = sum(part["cpu_seconds"] for part in whole["parts"])
    assert whole["cpu_seconds"] == pytest.approx(seconds, rel=1e-12)
    assert whole["energy_kwh"] == pytest.approx(seconds * WATTS_PER_CORE / 3_600_000, rel=1e-12)
    assert whole["co2_kg"] == pytest.approx(whole["energy_kwh"] * CO2_PER_KWH, rel=1e-12)
    assert whole["assumptions"]["watts_per_core"] == WATTS_PER_CORE
    assert "(estimate)" in str(energy_line(folder))
    resume(folder, make_envs=toy_envs)  # it is finished: nothing is added
    assert account(folder) == whole


def test_energy_spent_before_a_crash_is_not_lost(tmp_path: Path):
    def break_off(agent: Any) -> Mapping[str, float]:
        if agent.identity["decisions"] == 192:
            raise RuntimeError
        return {"survival": 0.0}

    with pytest.raises(RuntimeError):
        train(request(tmp_path / "run"), evaluate=break_off, make_envs=toy_envs)
    assert account(tmp_path / "run")["cpu_seconds"] > 0.0


def give_codecarbon(monkeypatch: pytest.MonkeyPatch, place: tuple[float, float]) -> None:
    """A CodeCarbon that finds itself in a place, and measures 2.5 kWh and 0.125 kg."""

    class Tracker:
        def __init__(self, **options: Any) -> None:
            assert options["output_methods"] == []  # no files outside the run folder

        def start(self) -> None:
            pass

        def stop(self) -> float:
            latitude, longitude = place
            self.final_emissions_data = SimpleNamespace(energy_consumed=2.5, latitude=latitude, longitude=longitude)
            return 0.125

    module = ModuleType("codecarbon")
    module.EmissionsTracker = Tracker  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "codecarbon", module)


def test_codecarbons_figures_are_taken_where_it_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    train(request(tmp_path / "run"), limit=Over(), make_envs=toy_envs)
    estimated = account(tmp_path / "run")
    give_codecarbon(monkeypatch, (46.8131, -71.2075))
    resume(tmp_path / "run", make_envs=toy_envs)
    whole = account(tmp_path / "run")
    assert whole["method"] == "codecarbon and estimate"
    assert whole["parts"][1]["method"] == "codecarbon"
    assert whole["energy_kwh"] == pytest.approx(2.5 + estimated["energy_kwh"], rel=1e-12)
    assert whole["co2_kg"] == pytest.approx(0.125 + estimated["co2_kg"], rel=1e-12)


def test_co2_is_the_worlds_mean_where_codecarbon_does_not_know_the_place(tmp_path: Path, monkeypatch):
    give_codecarbon(monkeypatch, (46.8, -71.2))
    whole = account(train(request(tmp_path / "run"), make_envs=toy_envs))
    assert whole["method"] == "codecarbon, the world's mean CO2"
    assert whole["energy_kwh"] == 2.5
    assert whole["co2_kg"] == pytest.approx(2.5 * 0.475, rel=1e-12)


def test_a_codecarbon_that_does_not_work_ends_no_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    class Broken:
        def __init__(self, **options: Any) -> None:
            raise OSError("no sensors")

    module = ModuleType("codecarbon")
    module.EmissionsTracker = Broken  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "codecarbon", module)
    assert account(train(request(tmp_path / "run"), make_envs=toy_envs))["method"] == "estimate"


# --- Weights & Biases -----------------------------------------------------------------------------------------------


class FakeWandb(ModuleType):
    """Remembers what it is given; of several values for a step the first, as Weights & Biases does."""

    class Error(Exception):
        pass

    def __init__(self) -> None:
        super().__init__("wandb")
        self.inits: list[dict[str, Any]] = []
        self.logged: dict[int, dict[str, float]] = {}
        self.finished = 0

    def init(self, **options: Any) -> Any:
        self.inits.append(options)
        return SimpleNamespace(log=self._log, finish=self._finish)

    def _log(self, values: dict[str, float], step: int) -> None:
        self.logged.setdefault(step, values)

    def _finish(self) -> None:
        self.finished += 1


def test_a_tracked_run_sends_its_metrics_and_goes_on_under_the_same_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fake = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    folder = train(request(tmp_path / "run", wandb_project="grids"), limit=Over(), make_envs=toy_envs)
    resume(folder, make_envs=toy_envs)
    first, second = fake.inits
    assert first["id"] == second["id"]
    assert (first["project"], first["name"], first["resume"]) == ("grids", "run", "allow")
    assert first["config"]["request"]["hyperparameters"]["seed"] == 5
    assert fake.finished == 2
    rows = pd.read_csv(folder / "metrics.csv")
    sent = [(step, name) for step, values in fake.logged.items() for name in values]
    assert sent == list(zip(rows["step"], rows["name"], strict=True))
    other = train(request(tmp_path / "other", wandb_project="grids"), limit=Over(), make_envs=toy_envs)
    assert fake.inits[-1]["id"] != first["id"]
    assert json.loads((other / "wandb.json").read_text())["id"] == fake.inits[-1]["id"]


def test_tracking_is_refused_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for module in (None, ModuleType("wandb")):  # not installed; a folder of that name
        monkeypatch.setitem(sys.modules, "wandb", module)
        with pytest.raises(
            UsageError, match=r"Tracking needs wandb: install it with `pip install rl2grid\[tracking\]`"
        ):
            train(request(tmp_path / "run", wandb_project="grids"), make_envs=toy_envs)
        assert list(tmp_path.iterdir()) == []

    class Refusing(FakeWandb):
        def init(self, **options: Any) -> Any:
            raise self.Error("api_key not configured\n(no-tty).")

    monkeypatch.setitem(sys.modules, "wandb", Refusing())
    with pytest.raises(UsageError, match=r"refuses the run \(api_key not configured \(no-tty\)\): log in, or set"):
        train(request(tmp_path / "run", wandb_project="grids"), make_envs=toy_envs)


@pytest.mark.slow
def test_weights_and_biases_takes_a_run_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.undo()
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    folder = train(request(tmp_path / "run", wandb_project="grids"), limit=Over(), make_envs=toy_envs)
    resume(folder, make_envs=toy_envs)
    run_id = json.loads((folder / "wandb.json").read_text())["id"]
    files = sorted((folder / "wandb").glob(f"offline-run-*-{run_id}/run-{run_id}.wandb"))
    assert len(files) == 2
    assert b"losses/policy_loss" in files[1].read_bytes()
