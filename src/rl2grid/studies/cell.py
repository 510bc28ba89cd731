"""One cell of a study in its folder: trained, evaluated, and gone on with after any interruption.

A cell's folder holds

- ``cell.json``: what is asked for;
- ``labels/`` and ``pupil-1/``, ``pupil-2/``, ...: what a teacher labelled, see :mod:`rl2grid.training.teaching`, and
  the pupils on whose states the next round is labelled, or from the last of which the run goes on;
- ``run/``: the training run, if the agent learns, see :mod:`rl2grid.training.runs`;
- ``evaluation/``: the episodes, see :mod:`rl2grid.evaluation.protocol`;
- ``log.txt``: what its processes printed, see :mod:`rl2grid.records.logs`;
- ``result.json``: written at the very end.

``python -m rl2grid.studies.cell <folder>`` does the work, on one thread. It stops with a checkpoint when it
gets a termination signal or when its standard input is closed, which happens when the process that started it dies.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from rl2grid.algorithms.registry import Hyperparameters
from rl2grid.errors import UsageError
from rl2grid.evaluation.flags import evaluate_command
from rl2grid.evaluation.protocol import evaluate
from rl2grid.records.locks import LockedError, locked
from rl2grid.records.logs import last_line, open_log
from rl2grid.records.metrics import trained_seconds
from rl2grid.records.studies import (
    CELL_FILE,
    EVALUATION_FOLDER,
    CellResult,
    read_cell,
    read_result,
    write_cell,
    write_result,
)
from rl2grid.scenarios.splits import VALIDATION_MONTHS
from rl2grid.studies.cells import Cell, Round, Step, cell_from_dict, cell_to_dict
from rl2grid.training import request, runs
from rl2grid.training.commands import teach_command, train_command
from rl2grid.training.teaching import PUPIL_SHARE, THIN, teach
from rl2grid.training.validation import validator

FINISHED, FAILED, REFUSED, BUSY, STOPPED = 0, 1, 2, 75, 130
"""Exit statuses. ``REFUSED``: trying again is no use; ``BUSY``: another process has the cell; ``STOPPED``: asked to."""

COMMAND: tuple[str, ...] = (sys.executable, "-m", "rl2grid.studies.cell")
_SINGLE_THREADED = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def prepare(folder: Path, cell: Cell) -> None:
    """Make the folder of a cell.

    Raises:
        UsageError: it holds a cell of another definition.
    """
    wanted = json.loads(json.dumps(cell_to_dict(cell)))
    stored = read_cell(folder)
    if stored is None:
        write_cell(folder, wanted)
        return
    for key, value in wanted.items():
        if stored.get(key) != value:
            raise UsageError(
                f"{folder} holds a cell with another {key}: remove it, or choose another folder with --output."
            )


def commands(folder: Path, cell: Cell) -> list[str]:
    """What to type to obtain the cell by hand."""
    keywords, lines, agent = {"heuristic": cell.heuristic, **cell.environment}, [], cell.agent
    for step in _steps(folder, cell):
        if step.round is not None:
            lines.append(_teach_command(cell, step.round, step.hyperparameters))
        lines.append(train_command(_run_args(cell, step), step.preset, step.folder))
        agent = str(step.folder)
    return [*lines, evaluate_command(agent, cell.task, cell.split, cell.evaluation_seeds, cell.months, keywords)]


def _steps(folder: Path, cell: Cell) -> list[Step]:
    return [] if cell.training is None else cell.training.steps(cell.task, folder)


def _teach_command(cell: Cell, labelled: Round, hyperparameters: Hyperparameters) -> str:
    return teach_command(
        labelled.teacher,
        cell.task,
        {"heuristic": cell.heuristic, **cell.environment},
        months=labelled.months,
        seed=hyperparameters.seed,
        pupil=labelled.pupil,
        pupil_share=PUPIL_SHARE,
        gamma=hyperparameters.gamma,
        thin=THIN,
        output=labelled.folder,
    )


def run_cell(folder: Path) -> None:
    """Do what is missing of a cell.

    Raises:
        UsageError: what is asked for cannot be done.
        KeyboardInterrupt: a signal asked to stop; calling this again goes on.
        LockedError: another process works on it.
    """
    with locked(folder):
        if read_result(folder) is None:
            _finish(folder)


def _finish(folder: Path) -> None:
    stored = read_cell(folder)
    if stored is None:
        raise UsageError(f"{folder} holds no cell: there is no {CELL_FILE} in it.")
    cell = cell_from_dict(stored)
    agent: str | Path = cell.agent
    steps = _steps(folder, cell)
    for step in steps:
        if step.round is not None:
            _teach(cell, step.round, step.hyperparameters)
        _train(cell, step)
        agent = step.folder
    result = evaluate(
        agent,
        cell.task,
        split=cell.split,
        scenarios=cell.scenarios,
        seeds=range(cell.evaluation_seeds),
        heuristic=cell.heuristic,
        workers=0,
        output=folder / EVALUATION_FOLDER,
        command=commands(folder, cell)[-1],
        **cell.environment,
    )
    seconds = sum(trained_seconds(step.folder) for step in steps) + sum(
        episode.wall_time_s for episode in result.episodes
    )
    summary = CellResult(
        minutes=round(seconds / 60.0, 2),
        identity=result.episodes[0].identity,
        survival=result.summary.survival.value,
        episodes=len(result.episodes),
    )
    write_result(folder, summary)


def _teach(cell: Cell, labelled: Round, hyperparameters: Hyperparameters) -> None:
    """Label a round, or what is missing of it."""
    teach(
        labelled.teacher,
        cell.task,
        months=labelled.months,
        output=labelled.folder,
        seed=hyperparameters.seed,
        heuristic=cell.heuristic,
        pupil=labelled.pupil,
        gamma=hyperparameters.gamma,
        workers=0,
        command=_teach_command(cell, labelled, hyperparameters),
        **cell.environment,
    )


def _train(cell: Cell, step: Step) -> None:
    """Train, or go on.

    Raises:
        KeyboardInterrupt: it was asked to stop before the end.
    """
    run = step.folder
    if not run.exists():
        args = _run_args(cell, step)
        runs.train(args, evaluate=validator(args))
    elif not runs.is_finished(run):
        runs.resume(run, evaluate=validator(request.read_config(run)[0]))
    if not runs.is_finished(run):
        raise KeyboardInterrupt


def _run_args(cell: Cell, step: Step) -> request.RunArgs:
    native = cell.environment.get("engine", "native") == "native"
    return request.RunArgs(
        task=cell.task,
        hyperparameters=step.hyperparameters,
        algorithm=step.algorithm,
        folder=step.folder,
        env_keywords={"heuristic": cell.heuristic, **cell.environment},
        num_threads=1 if native else None,
        num_workers=None if native else 0,
        evaluate_every=step.evaluate_every,
        validation_months=min(cell.months or VALIDATION_MONTHS, VALIDATION_MONTHS),
        progress=False,
    )


class CellProcess:
    """A process that works on a cell."""

    def __init__(self, folder: Path, command: Sequence[str] = COMMAND) -> None:
        """Start it; what it prints goes to the cell's log."""
        with open_log(folder) as log:
            # A session of its own: Ctrl-C in a terminal reaches the study alone, which passes it on once.
            self._process = subprocess.Popen(
                [*command, str(folder)],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **_SINGLE_THREADED},
                start_new_session=True,
            )

    def poll(self) -> int | None:
        """The exit status; None while it works."""
        return self._process.poll()

    def stop(self) -> None:
        """Ask it to write a checkpoint and end."""
        # The same sign as the death of this process, so that both together count once.
        assert self._process.stdin is not None
        self._process.stdin.close()

    def wait(self) -> int:
        """Wait for its end; returns the exit status."""
        return self._process.wait()


def work(folder: Path, command: Sequence[str] = COMMAND) -> int:
    """Work on a cell in a process of its own and wait; returns its exit status."""
    process = CellProcess(folder, command)
    try:
        return process.wait()
    except BaseException:
        process.stop()
        process.wait()
        raise


def serve(do: Callable[[], None]) -> int:
    """Do something until it is done, or until a signal or the end of the standard input; returns the exit status."""
    try:
        signal.signal(signal.SIGTERM, _interrupt)
        threading.Thread(target=_stop_when_input_ends, daemon=True).start()
        do()
    except LockedError:
        return BUSY
    except KeyboardInterrupt:
        return STOPPED
    except UsageError as error:
        print(f"rl2grid: {error}", file=sys.stderr)
        return REFUSED
    except OSError as error:  # a disk that is full may have room when it is tried again
        print(f"rl2grid: {error.filename or 'A file'} cannot be read or written: {error.strerror}.", file=sys.stderr)
        return FAILED
    except Exception:
        traceback.print_exc()
        return FAILED
    return FINISHED


def last_error(folder: Path) -> str:
    """The last line that the processes of a cell printed."""
    return last_line(folder) or "it left no message"


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def _stop_when_input_ends() -> None:
    # Not by sys.stdin, whose lock this thread would hold while the interpreter shuts down.
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(serve(lambda: run_cell(Path(sys.argv[1]))))
