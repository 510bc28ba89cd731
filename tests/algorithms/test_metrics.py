"""Metrics in CSV and TensorBoard, and what a resumed run does with rows of the interrupted one."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest

from rl2grid.algorithms.metrics import MetricsWriter


def write(folder: Path, steps: list[int], *, after_step: int = -1, tensorboard: bool = False) -> None:
    writer = MetricsWriter(folder, after_step=after_step, tensorboard=tensorboard)
    for step in steps:
        writer.write(step, 10 * step, 0.5 * step, {"charts/survival": step / 7, "losses/value_loss": 1.0})
    writer.close()


def test_rows_make_one_column_per_metric_in_pandas(tmp_path: Path):
    write(tmp_path, [1, 2, 3])
    table = pd.read_csv(tmp_path / "metrics.csv")
    assert list(table.columns) == ["step", "grid_steps", "wall_time", "name", "value", "checksum"]
    wide = table.pivot(index="step", columns="name", values="value")
    assert wide["charts/survival"].tolist() == pytest.approx([1 / 7, 2 / 7, 3 / 7], rel=1e-15)
    assert table["grid_steps"].tolist() == [10, 10, 20, 20, 30, 30]


def test_values_that_are_not_finite_survive(tmp_path: Path):
    writer = MetricsWriter(tmp_path, tensorboard=False)
    writer.write(1, 1, 0.0, {"a": math.nan, "b": math.inf})
    writer.close()
    values = pd.read_csv(tmp_path / "metrics.csv")["value"].tolist()
    assert math.isnan(values[0])
    assert values[1] == math.inf


@pytest.mark.parametrize("tail", ["", "4,40,2.0,charts/surv", "5,", "6"])
def test_rows_after_the_checkpoint_are_written_once(tmp_path: Path, tail: str):
    write(tmp_path, [1, 2, 3, 4])
    straight = (tmp_path / "metrics.csv").read_text()
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write(tail)
    write(tmp_path, [3, 4], after_step=2)
    assert (tmp_path / "metrics.csv").read_text() == straight


@pytest.mark.parametrize("torn", ["", "step,gri"])
def test_a_file_torn_within_its_header_is_begun_again(tmp_path: Path, torn: str):
    (tmp_path / "metrics.csv").write_text(torn)
    write(tmp_path, [1])
    assert len(pd.read_csv(tmp_path / "metrics.csv")) == 2


def test_tensorboard_shows_the_values_of_the_resumed_run(tmp_path: Path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    write(tmp_path, [1, 2, 3], tensorboard=True)
    write(tmp_path, [2, 3], after_step=1, tensorboard=True)
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload().Scalars("charts/survival")
    assert [event.step for event in events] == [1, 2, 3]
    assert events[-1].value == pytest.approx(3 / 7)
