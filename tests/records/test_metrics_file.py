"""``metrics.csv`` keeps every digit, and who follows it while it grows reads whole lines alone."""

from __future__ import annotations

from pathlib import Path

from rl2grid.records.metrics import METRICS_FILE, VALIDATION, MetricsFile, MetricsTail, read_rows


def write(folder: Path, steps: list[int], *, after_step: int = -1) -> None:
    file = MetricsFile(folder, after_step=after_step)
    for step in steps:
        file.write(step, 10 * step, 0.5 * step, {"charts/survival": step / 7, VALIDATION: step / 100})
    file.close()


def test_values_come_back_digit_by_digit(tmp_path: Path):
    write(tmp_path, [1, 2, 3])
    rows = list(read_rows(tmp_path / METRICS_FILE))
    assert [float(row["value"]) for row in rows] == [value for k in (1, 2, 3) for value in (k / 7, k / 100)]
    assert rows[2] == {
        "step": "2", "grid_steps": "20", "wall_time": "1.000", "name": "charts/survival", "value": repr(2 / 7),
    }  # fmt: skip


def test_a_file_is_followed_line_by_line_while_it_grows(tmp_path: Path):
    path = tmp_path / METRICS_FILE
    tail = MetricsTail(path)
    tail.read()  # there is no file yet
    assert (tail.decisions, tail.best) == (0, None)
    write(tmp_path, [10, 30, 20])
    whole = path.read_bytes()
    # 30 is followed by a line of which only a part is there: a number that would be read, if it were read.
    path.write_bytes(whole + f"40,400,20.0,{VALIDATION},0.9".encode())
    tail.read()
    assert (tail.decisions, tail.best) == (20, 0.3)
    path.write_bytes(whole + f"40,400,20.0,{VALIDATION},0.95\n".encode())
    tail.read()
    assert (tail.decisions, tail.best) == (40, 0.95)


def test_metrics_are_followed_while_they_grow_and_after_a_cut(tmp_path: Path):
    path = tmp_path / "metrics.csv"
    tail = MetricsTail(path)
    tail.read()
    head = "step,grid_steps,wall_time,name,value\n"
    path.write_text(head + "10,1,0.1,validation/survival,0.25\n20,2,0.2,charts/SPS,5\n30,3,0.3,valid")
    tail.read()
    assert (tail.decisions, tail.best) == (20, 0.25)
    path.write_text(head + "10,1,0.1,validation/survival,0.25\n")
    tail.read()
    assert (tail.decisions, tail.best) == (10, 0.25)
    path.write_text("")
    tail.read()
    assert (tail.decisions, tail.best) == (0, None)
    path.write_text(head)
    tail.read()
    assert (tail.decisions, tail.best) == (0, None)


def test_metrics_that_were_cut_and_grew_past_what_was_read_are_read_again(tmp_path: Path):
    path = tmp_path / "metrics.csv"
    tail = MetricsTail(path)
    head = "step,grid_steps,wall_time,name,value\n10,1,0.1,validation/survival,0.25\n"
    path.write_text(head + "20,2,0.2,validation/survival,0.75\n")
    tail.read()
    path.write_text(head + "20,2,0.2000,validation/survival,0.5\n30,3,0.3,torn\n30,3,0.3,charts/SPS,5\n")
    tail.read()
    assert (tail.decisions, tail.best) == (30, 0.5)
