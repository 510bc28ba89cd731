"""Searching for hyperparameters: many short trainings, the poor ones ended early.

A search is described by a TOML file (:mod:`rl2grid.studies.tuning`) and kept in its output folder
(:mod:`rl2grid.records.searches`).

A trial trains one configuration with each of several seeds, one after the other; what counts is their mean. A process
may be killed at any moment. The same command goes on: a trial that was under way is put back at the head of the queue
and its runs resumed. ``python -m rl2grid.studies.search <folder>`` works on trials until there are enough.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import sys
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from rl2grid.algorithms.policy_agent import PolicyAgent
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.records.files import make_own_folder
from rl2grid.records.locks import LockedError, is_locked
from rl2grid.records.logs import LOG_FILE
from rl2grid.records.metrics import read_validations
from rl2grid.records.searches import (
    JOURNAL_FILE,
    SEARCH_FILE,
    TRIALS_FOLDER,
    beginning_lock,
    read_search,
    search_lock,
    trial_lock,
    write_best,
    write_search,
)
from rl2grid.studies.cell import STOPPED, CellProcess, serve
from rl2grid.studies.tuning import Tuning, kinds_of, run_args
from rl2grid.training import request, runs
from rl2grid.training.commands import train_command
from rl2grid.training.interrupts import stop_requests
from rl2grid.training.validation import score, validator

COMMAND: tuple[str, ...] = (sys.executable, "-m", "rl2grid.studies.search")


@dataclass(frozen=True)
class Best:
    """The best configuration of a search."""

    trial: int
    survival: float
    """Mean over the seeds, of the best policies by validation; under constraints those are most often safe."""
    hyperparameters: Mapping[str, Any]
    """Those that were searched."""


def run_tuning(
    tuning: Tuning, jobs: int | None = None, console: Console | None = None, command: Sequence[str] = COMMAND
) -> Best | None:
    """Search until there are enough trials.

    Args:
        tuning: what to search.
        jobs: processes that train at the same time; None: one per core.
        console: where progress is shown; None: nowhere.
        command: what works on trials of the folder given to it.

    Returns:
        The best configuration so far; None when an interrupt asked to stop.

    Raises:
        UsageError: Optuna is missing, the folder holds another search, or not all trials could be trained.
    """
    _optuna()
    if jobs is not None and jobs < 1:
        raise UsageError(f"--jobs {jobs} is not allowed: at least 1 is needed.")
    _prepare(tuning)
    with _only_one(tuning.output), stop_requests() as stop, _progress(tuning, console) as show:
        _put_back_interrupted(tuning)
        processes = [CellProcess(tuning.output, command) for _ in range(jobs or _cores())]
        while any(process.poll() is None for process in processes):
            if stop.is_set():
                for process in processes:
                    process.stop()
                for process in processes:
                    process.wait()
                return None
            show(_open(tuning))
            stop.wait(1.0)
        show(_open(tuning))
    statuses = [process.wait() for process in processes]
    best = _best(tuning)
    if best is None or all(status not in (0, STOPPED) for status in statuses):
        raise UsageError(f"The search failed: {tuning.output / LOG_FILE} says why.")
    write_best(tuning.output, asdict(best) | {"command": best_command(tuning, best), "effort": effort(tuning)})
    ended = len(_ended(_open(tuning)))
    if ended < tuning.trials:
        raise UsageError(
            f"The search stopped after {ended} of {tuning.trials} trials: {tuning.output / LOG_FILE} says why, and "
            "the same command goes on."
        )
    return best


def best_command(tuning: Tuning, best: Best) -> str:
    """What to type to train with a configuration."""
    args = run_args(tuning, best.hyperparameters, None)
    # Validated as usual: not as often as while searching, where that is for ending poor trials.
    usual = request.RunArgs
    args = replace(args, evaluate_every=usual.evaluate_every, validation_months=usual.validation_months)
    return train_command(args, tuning.preset)


def effort(tuning: Tuning) -> dict[str, Any]:
    """What was spent on choosing, by which searches for different algorithms are to be equal."""
    ended = _ended(_open(tuning))
    trained: dict[str, int] = {}
    for trial in ended:  # of equal ones one was trained
        run = trial.user_attrs.get("run", "refused")
        trained[run] = max(trained.get(run, 0), *trial.intermediate_values, 0)
    return {
        "trials": len(ended),
        "seeds": len(tuning.seeds),
        "budget": tuning.budget,
        "decisions": sum(trained.values()),
    }


def work(folder: Path) -> None:
    """Train trials until the search has enough of them."""
    optuna = _optuna()
    tuning = _read(folder)
    study = _open(tuning)
    while (begun := _begin(tuning, study)) is not None:
        trial, chosen = begun
        # Of equal trials one trains; the others wait until it is told, and take what it reached.
        with trial_lock(folder, _trial_folder(tuning, chosen).name):
            try:
                reached = _train(tuning, trial, chosen)
            except optuna.TrialPruned:
                study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            else:
                study.tell(trial, reached)


def _read(folder: Path) -> Tuning:
    """The search that is stored in a folder."""
    stored = dict(read_search(folder) or {})
    return Tuning(**stored | {"seeds": tuple(stored["seeds"]), "task": find_task(stored["task"])}, output=folder)


def _begin(tuning: Tuning, study: Any) -> tuple[Any, dict[str, Any]] | None:
    """Begin a trial; returns it and its choices, None if there are enough trials."""
    states = _optuna().trial.TrialState
    # All that are under way count, so that parallel processes do not begin more than asked for.
    counted = (states.COMPLETE, states.PRUNED, states.RUNNING)
    with beginning_lock(tuning.output):
        number = sum(trial.state in counted for trial in study.get_trials(deepcopy=False))
        if number >= tuning.trials:
            return None
        # A seed for every trial: neither do parallel processes draw the same, nor does one that goes on draw it again.
        study.sampler = _sampler(np.random.SeedSequence((tuning.seed, number)).generate_state(1).item())
        trial = study.ask()
        kinds = kinds_of(tuning)
        return trial, {name: _suggest(trial, name, values, kinds[name]) for name, values in tuning.space.items()}


def _train(tuning: Tuning, trial: Any, chosen: Mapping[str, Any]) -> float:
    """Train one configuration with every seed; returns the mean of their best scores in validation."""
    optuna = _optuna()
    folder = _trial_folder(tuning, chosen)
    try:
        every = [run_args(tuning, chosen, folder / str(seed), seed) for seed in tuning.seeds]
    except UsageError as error:
        trial.set_user_attr("refused", str(error))
        raise optuna.TrialPruned from None
    trial.set_user_attr("run", folder.name)
    reports = Reports(trial, tuning.budget, request.find_limits(every[0]))
    was_pruned = _was_pruned(trial.study, folder)
    for args in every:
        assert args.folder is not None
        reports.begin(args.folder)
        if was_pruned:
            continue
        _train_one(args, reports)
    if was_pruned:
        raise optuna.TrialPruned
    return reports.mean


def _train_one(args: request.RunArgs, reports: Reports) -> None:
    """Train one run of a trial, or go on with it."""
    folder, validate = args.folder, validator(args)
    assert folder is not None

    def report(agent: PolicyAgent) -> Mapping[str, float]:
        result = validate(agent)
        reports.add(agent.identity["decisions"], result)
        return result

    if not folder.exists():
        runs.train(args, evaluate=report)
    elif not runs.is_finished(folder):
        runs.resume(folder, evaluate=report)
    if not runs.is_finished(folder):
        raise KeyboardInterrupt


def _was_pruned(study: Any, folder: Path) -> bool:
    """Whether a trial with this run was ended early."""
    pruned = study.get_trials(deepcopy=False, states=[_optuna().trial.TrialState.PRUNED])
    return any(trial.user_attrs.get("run") == folder.name for trial in pruned)


class Reports:
    """What a trial tells of its course, that before an interruption included: means over the runs begun so far.

    Args:
        trial: Optuna's.
        budget: decisions of a run; what run k tells after d decisions is told at k * budget + d.
        limits: of the costs of a safe episode.
    """

    def __init__(self, trial: Any, budget: int, limits: Mapping[str, float]) -> None:
        self._trial, self._budget, self._limits = trial, budget, limits
        self._told: set[int] = set()
        self._best: list[float] = []
        self._survival: list[float] = []

    @property
    def mean(self) -> float:
        """Of the best scores of the runs, see :func:`one_score`; -inf before the first."""
        return float(np.mean(self._best)) if self._best else -math.inf

    def begin(self, folder: Path) -> None:
        """Tell of the next run from now on, and of what it has told before, if it goes on."""
        self._best.append(-math.inf)
        self._survival.append(0.0)
        for decisions, means in read_validations(folder).items():
            self._tell(decisions, means)

    def add(self, decisions: int, means: Mapping[str, float]) -> None:
        """Report a validation.

        Raises:
            optuna.TrialPruned: others were better by then.
        """
        self._tell(decisions, means)
        if self._trial.should_prune():
            raise _optuna().TrialPruned

    def _tell(self, decisions: int, means: Mapping[str, float]) -> None:
        reached = one_score(means, self._limits)
        if reached >= self._best[-1]:
            self._best[-1], self._survival[-1] = reached, float(means["survival"])
            self._trial.set_user_attr("survival", float(np.mean(self._survival)))
        step = (len(self._best) - 1) * self._budget + decisions
        if step not in self._told:
            self._told.add(step)
            self._trial.report(self.mean, step)


def one_score(means: Mapping[str, float], limits: Mapping[str, float]) -> float:
    """:func:`rl2grid.training.validation.score` as one number in the same order, as searches need it.

    Shares of safe episodes of fewer than 1,000 episodes differ by more than the last weight.
    """
    first, *then = score(means, limits)
    return first + sum(1e-3 * value for value in then)


def _suggest(trial: Any, name: str, values: Any, kind: Any) -> Any:
    if isinstance(values, list):
        # A journal keeps no lists: layers are chosen by their number in the file.
        if any(isinstance(value, list) for value in values):
            return values[trial.suggest_categorical(f"number of {name}", tuple(range(len(values))))]
        return trial.suggest_categorical(name, tuple(values))
    low, high, log = values["low"], values["high"], values.get("log", False)
    if kind is int:
        return trial.suggest_int(name, low, high, log=log)
    return trial.suggest_float(name, low, high, log=log)


def _open(tuning: Tuning) -> Any:
    """Optuna's study, which all processes of the search share."""
    optuna = _optuna()
    from optuna.storages.journal import JournalFileBackend

    storage = optuna.storages.JournalStorage(JournalFileBackend(str(tuning.output / JOURNAL_FILE)))
    return optuna.create_study(
        storage=storage,
        study_name=tuning.name,
        direction="maximize",
        load_if_exists=True,
        pruner=optuna.pruners.MedianPruner(n_startup_trials=5, n_warmup_steps=tuning.budget // 5),
    )


def _sampler(seed: int) -> Any:
    # Processes that sample at the same time must not sample the same.
    return _optuna().samplers.TPESampler(constant_liar=True, seed=seed)


def _put_back_interrupted(tuning: Tuning) -> None:
    """Queue the trials that a killed process left, which is known because no other process searches."""
    state = _optuna().trial.TrialState
    study = _open(tuning)
    for trial in study.get_trials(deepcopy=False):
        if trial.state == state.RUNNING:
            # Its process may live a little longer than the one that started it, to write a checkpoint.
            runs_of_it = (tuning.output / TRIALS_FOLDER / trial.user_attrs.get("run", "none")).glob("*")
            while any(is_locked(run) for run in runs_of_it):
                time.sleep(0.2)
            study.tell(trial.number, state=state.FAIL)
            if trial.params:
                study.enqueue_trial(trial.params)


def _ended(study: Any) -> list[Any]:
    """The trials that count: complete, or ended because they were poor."""
    states = _optuna().trial.TrialState
    ended: list[Any] = study.get_trials(deepcopy=False, states=[states.COMPLETE, states.PRUNED])
    return ended


def _best(tuning: Tuning) -> Best | None:
    study, state = _open(tuning), _optuna().trial.TrialState.COMPLETE
    done = [trial for trial in study.get_trials(deepcopy=False) if trial.state == state]
    if not done:
        return None
    trial = max(done, key=lambda each: (each.value, -each.number))
    chosen = {
        name.removeprefix("number of "): tuning.space[name.removeprefix("number of ")][value]
        if name.startswith("number of ")
        else value
        for name, value in trial.params.items()
    }
    return Best(trial.number, trial.user_attrs["survival"], chosen)


def _prepare(tuning: Tuning) -> None:
    wanted = {key: value for key, value in asdict(tuning).items() if key != "output"} | {"task": tuning.task.id}
    stored = read_search(tuning.output)
    if stored is not None:
        for key, value in json.loads(json.dumps(wanted)).items():
            # More trials of the same search are welcome.
            if key != "trials" and stored.get(key) != value:
                raise UsageError(
                    f"{tuning.output} holds a search with another {key}: remove it, or choose another folder with "
                    "--output."
                )
    make_own_folder(tuning.output, (SEARCH_FILE, LOG_FILE), "search")
    write_search(tuning.output, wanted)


def _trial_folder(tuning: Tuning, chosen: Mapping[str, Any]) -> Path:
    digest = hashlib.sha256(json.dumps(chosen, sort_keys=True).encode()).hexdigest()[:12]
    return tuning.output / TRIALS_FOLDER / digest


def _optuna() -> Any:
    try:
        import optuna
    except ImportError:
        raise UsageError("A search needs Optuna: `pip install rl2grid[tune]` installs it.") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    return optuna


def _cores() -> int:
    return len(os.sched_getaffinity(0))


@contextlib.contextmanager
def _only_one(folder: Path) -> Iterator[None]:
    try:
        with search_lock(folder):
            yield
    except LockedError:
        raise UsageError(f"Another process searches in {folder}: wait for it, or choose another folder.") from None


@contextlib.contextmanager
def _progress(tuning: Tuning, console: Console | None) -> Iterator[Any]:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[best]}"))
    with Progress(*columns, console=console, disable=console is None) as bar:
        task = bar.add_task(f"{tuning.algorithm} on {tuning.task.id}", total=tuning.trials, best="")
        began = time.monotonic()

        def show(study: Any) -> None:
            ended = _ended(study)
            best_so_far = _best(tuning)
            best = f"best survival {best_so_far.survival:.3f}, " if best_so_far else ""
            pruned = sum(trial.state.name == "PRUNED" for trial in ended)
            minutes = (time.monotonic() - began) / 60.0
            bar.update(task, completed=len(ended), best=f"{best}{pruned} ended early, {minutes:.0f} min")

        yield show


if __name__ == "__main__":
    sys.exit(serve(lambda: work(Path(sys.argv[1]))))
