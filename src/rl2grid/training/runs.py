"""Training runs: one folder each, written so that a kill at any moment loses at most some minutes.

A run folder holds

- ``config.json``: the request, its identity (versions, hashes) and its seeds;
- ``metrics.csv`` and ``tensorboard/``: see :mod:`rl2grid.algorithms.metrics`;
- ``checkpoint.pt``: everything needed to go on, see :mod:`rl2grid.algorithms.checkpoint`;
- ``replay/``: what DQN, SAC and TD3 remember, until the run is finished, see :mod:`rl2grid.algorithms.replay`;
- ``best.pt``: the best policy on the validation scenarios so far, see :func:`rl2grid.training.validation.score`;
- ``energy.json``: energy and CO2, see :mod:`rl2grid.training.energy`;
- ``wandb.json``, ``wandb/``: of a tracked run, see :mod:`rl2grid.training.tracking`;
- ``log.txt``: what happened when, see :mod:`rl2grid.records.logs`.

A run that was interrupted and resumed any number of times ends with the same weights, bit for bit, and
the same metrics as one that was not (times apart), on the same machine with the same library versions.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import gymnasium

from rl2grid.algorithms.checkpoint import load_checkpoint, save_checkpoint
from rl2grid.algorithms.metrics import MetricsWriter
from rl2grid.algorithms.policy_agent import BEST_FILE, CHECKPOINT_FILE, PolicyAgent
from rl2grid.algorithms.registry import VectorEnvironment, find_algorithm
from rl2grid.algorithms.starting import StartingPolicy
from rl2grid.algorithms.trainer import Learner
from rl2grid.envs.joint import VectorJointAsBox, VectorJointAsDiscrete
from rl2grid.envs.options import changed_options
from rl2grid.envs.registration import register_all
from rl2grid.errors import UsageError
from rl2grid.records import logs
from rl2grid.records.locks import LockedError, locked
from rl2grid.records.trainings import RUN_FILE, create_run_folder
from rl2grid.records.versions import processor
from rl2grid.scenarios.library import check_training_room
from rl2grid.scenarios.making import number_of_makers
from rl2grid.training.energy import EnergyAccount
from rl2grid.training.interrupts import stop_requests
from rl2grid.training.limits import TimeLimit
from rl2grid.training.progress import progress_bar
from rl2grid.training.request import (
    RunArgs,
    complete,
    configuration_of,
    find_limits,
    identity_of,
    read_config,
    stored_request,
)
from rl2grid.training.tracking import check_tracking, tracked
from rl2grid.training.validation import Evaluate, score

REPLAY_FOLDER = "replay"

UNLIMITED = TimeLimit(None)


def make_envs(args: RunArgs) -> VectorEnvironment:
    """The training environments of a run; those of joint tasks flattened as the algorithm needs them.

    Raises:
        UsageError: the request cannot be met.
    """
    number_of_makers()  # a setting that is refused is refused here, before there is a run folder
    if find_algorithm(args.algorithm).plays_months and args.env_keywords.get("scenario") is None:
        check_training_room(args.task.grid_id, args.hyperparameters.num_envs + args.hyperparameters.total_timesteps)
    register_all()
    envs: Any = gymnasium.make_vec(
        args.task.id,
        num_envs=args.hyperparameters.num_envs,
        num_threads=args.num_threads,
        num_workers=args.num_workers,
        gamma=args.hyperparameters.gamma,
        **changed_options(args.env_keywords),
    )
    if args.task.kind != "H":
        return cast("VectorEnvironment", envs)
    asked = getattr(args.hyperparameters, "joint_actions", None)
    continuous = find_algorithm(args.algorithm).plays_continuous("H", asked)
    return VectorJointAsBox(envs) if continuous else VectorJointAsDiscrete(envs)


def train(
    args: RunArgs,
    *,
    evaluate: Evaluate | None = None,
    limit: TimeLimit = UNLIMITED,
    make_envs: Callable[[RunArgs], VectorEnvironment] = make_envs,
) -> Path:
    """Train from the beginning; returns the run folder.

    Ctrl-C (or a termination signal) ends the run after the current iteration, with a checkpoint; a second
    one at once. So does the time limit. In any case :func:`resume` goes on.

    Args:
        args: What to train.
        evaluate: Validation, which picks ``best.pt``; None: only ``checkpoint.pt`` is written.
        limit: When to stop; there is one iteration at least.
        make_envs: Makes the training environments.

    Raises:
        UsageError: the request cannot be met; nothing was written.
    """
    args = complete(args)
    folder = args.folder
    assert folder is not None
    if folder.exists():
        raise UsageError(f"Folder {str(folder)!r} exists already: resume the run in it, or choose another folder.")
    envs = make_envs(args)
    try:
        trainer = find_algorithm(args.algorithm).trainer(args.hyperparameters, envs)
        trainer.begin_as_asked()
        identity = identity_of(args) | trainer.identity()
        run = _Run(folder, args, identity, trainer, evaluate)
        create_run_folder(folder, configuration_of(args, identity), run.save_beginning)
        with _locked(folder):
            _run(run, envs, limit, None)
    finally:
        envs.close()
    return folder


def resume(
    folder: Path,
    *,
    evaluate: Evaluate | None = None,
    limit: TimeLimit = UNLIMITED,
    progress: bool = True,
    make_envs: Callable[[RunArgs], VectorEnvironment] = make_envs,
) -> Path:
    """Go on with the run in ``folder``, from its last checkpoint.

    ``progress`` says whether a bar is shown, which is not for one that was begun without.

    Raises:
        UsageError: no run there, one that another process is writing, one made of other data, or one whose checkpoint
            is missing, damaged or another run's: to begin again would overwrite what was reached.
    """
    args, identity = read_config(folder)
    check_tracking(args.wandb_project)
    with _locked(folder):
        now = identity_of(args)
        for name in ("grid_hash", "scenario_pack_hash", "action_set_hash", "split_version", "targets_version"):
            if identity.get(name) != now.get(name):
                raise UsageError(
                    f"The run in {str(folder)!r} cannot be resumed: its {name} was {identity.get(name)}, "
                    f"now it is {now.get(name)}."
                )
        args = replace(args, progress=progress and args.progress)
        checkpoint = _checkpoint_of(folder, args)
        envs = make_envs(args)
        try:
            trainer = find_algorithm(args.algorithm).trainer(args.hyperparameters, envs)
            for name, value in trainer.identity().items():
                if json.loads(json.dumps(value)) != identity.get(name):
                    raise UsageError(
                        f"The run in {str(folder)!r} cannot be resumed: its {name} are no longer those it began with."
                    )
            now |= {name: identity[name] for name in ("labels", "start") if name in identity}
            if "start" in checkpoint:
                trainer.begin_with(StartingPolicy(**checkpoint["start"]))
            run = _Run(folder, args, now, trainer, evaluate)
            if identity.get("versions") != now["versions"]:
                run.note(f"library versions differ from those the run began with: {now['versions']}")
            _run(run, envs, limit, checkpoint if checkpoint["decisions"] else None)
        finally:
            envs.close()
    return folder


def _checkpoint_of(folder: Path, args: RunArgs) -> dict[str, Any]:
    """The checkpoint of a run, which every run has from its beginning.

    Raises:
        UsageError: it is missing, damaged, or was written by another run.
    """
    path = folder / CHECKPOINT_FILE
    if not path.is_file():
        raise UsageError(
            f"The run in {str(folder)!r} cannot be resumed: its {CHECKPOINT_FILE} is missing, and to begin again would "
            "overwrite what it has reached; restore the file, or begin a new run in another folder."
        )
    checkpoint = load_checkpoint(path, task=args.task.id)
    mine = {"algorithm": args.algorithm, "hyperparameters": asdict(args.hyperparameters)}
    for name, value in mine.items():
        if checkpoint.get(name) != value:
            raise UsageError(
                f"The run in {str(folder)!r} cannot be resumed: its {CHECKPOINT_FILE} is of a run with other "
                f"{name} than its {RUN_FILE} says."
            )
    return checkpoint


def is_finished(folder: Path) -> bool:
    """Whether the run in ``folder`` used up its budget, so that there is nothing to resume."""
    checkpoint = folder / CHECKPOINT_FILE
    return checkpoint.exists() and bool(load_checkpoint(checkpoint)["run"]["finished"])


class _Run:
    """A run in progress: its folder, its trainer and what was reached so far."""

    def __init__(
        self,
        folder: Path,
        args: RunArgs,
        identity: Mapping[str, Any],
        trainer: Learner,
        evaluate: Evaluate | None,
    ) -> None:
        self.folder = folder
        self.args = args
        self.identity = identity
        self.trainer = trainer
        self.evaluate = evaluate
        self.limits = find_limits(args)
        self.best_score: tuple[float, ...] | None = None
        """Of ``best.pt``."""
        self.wall_time = 0.0
        """Seconds of training and validation, those before interruptions included."""

    def contents(self) -> dict[str, Any]:
        """The sections of a checkpoint, without ``training``."""
        return {**self._description(), "policy": self.trainer.policy_state()}

    def save(self) -> None:
        """Write ``checkpoint.pt``."""
        contents = {**self.contents(), "training": self.trainer.state_dict(), "run": self._progress()}
        save_checkpoint(self.folder / CHECKPOINT_FILE, contents)

    def save_beginning(self, folder: Path) -> None:
        """Write a ``checkpoint.pt`` that nothing was learned for yet: where there is none, it was lost."""
        start = self.trainer.start
        begun_with = {} if start is None else {"start": start.state_dict()}
        save_checkpoint(folder / CHECKPOINT_FILE, {**self._description(), "run": self._progress(), **begun_with})

    def _description(self) -> dict[str, Any]:
        return {
            "algorithm": self.args.algorithm,
            "task": self.args.task.id,
            "env_keywords": dict(self.args.env_keywords),
            "hyperparameters": asdict(self.args.hyperparameters),
            "identity": dict(self.identity),
            "decisions": self.trainer.decisions,
        }

    def _progress(self) -> dict[str, Any]:
        return {
            "best_score": self.best_score,
            "wall_time": self.wall_time,
            "finished": self.trainer.finished,
        }

    def load(self, checkpoint: Mapping[str, Any]) -> None:
        """Be where the run was when ``checkpoint`` was written."""
        try:
            self.best_score, self.wall_time = checkpoint["run"]["best_score"], checkpoint["run"]["wall_time"]
            self.trainer.load_state_dict(checkpoint["training"])
        except KeyError as error:
            raise UsageError(
                f"The checkpoint in {str(self.folder)!r} lacks {error}, because another version of rl2grid wrote it: "
                "go on with that version, or begin a new run."
            ) from error

    def validate(self) -> dict[str, float]:
        """Evaluate the policy as it is, and keep it if it is the best so far."""
        assert self.evaluate is not None
        contents = self.contents()
        result = self.evaluate(PolicyAgent(contents))
        reached = score(result, self.limits)
        # Of equally good policies the latest: it has learned from more than the validation scenarios show.
        if self.best_score is None or reached >= self.best_score:
            self.best_score = reached
            save_checkpoint(self.folder / BEST_FILE, {**contents, "run": {"score": reached}})
            safe = f"{result['safe_completed']:.2%} safe and completed, " if self.limits else ""
            self.note(
                f"best validation so far: {safe}survival {result['survival']:.4f}, "
                f"after {self.trainer.decisions} decisions"
            )
        return {f"validation/{name}": float(value) for name, value in result.items()}

    @property
    def best_survival(self) -> float | None:
        """Validation survival of ``best.pt``."""
        return None if self.best_score is None else self.best_score[-1]

    def note(self, text: str) -> None:
        """Append a line to the log."""
        logs.note(self.folder, text)


def _run(run: _Run, envs: VectorEnvironment, limit: TimeLimit, checkpoint: Mapping[str, Any] | None) -> None:
    """Train until the budget is used up, a signal asks to stop or the time is up; closes the environments."""
    args, trainer = run.args, run.trainer
    trainer.store_in(run.folder / REPLAY_FOLDER)
    if checkpoint is not None:
        run.load(checkpoint)
    begun = "resumed" if checkpoint else "started"
    run.note(f"{begun} at {trainer.decisions} of {_budget(args, trainer)} decisions on {processor()}")
    after_step = trainer.decisions if checkpoint is not None else -1
    saved_at, saved_decisions = time.monotonic(), trainer.decisions
    config = {"request": stored_request(args), "identity": dict(run.identity)}
    title = f"{args.algorithm} on {args.task.id}"
    with (
        closing(MetricsWriter(run.folder, after_step=after_step, tensorboard=args.tensorboard)) as metrics,
        tracked(run.folder, args.wandb_project, config) as track,
        _accounted(run.folder, trainer, envs) as energy,
        stop_requests() as stop,
        progress_bar(title, trainer.decisions, _budget(args, trainer), shown=args.progress) as show,
    ):
        while not trainer.finished and not stop.is_set():
            began, decisions, grid_steps = time.perf_counter(), trainer.decisions, trainer.grid_steps
            values = trainer.iterate()
            seconds = time.perf_counter() - began
            values["charts/SPS"] = (trainer.decisions - decisions) / seconds
            values["charts/grid_SPS"] = (trainer.grid_steps - grid_steps) / seconds
            due = trainer.decisions // args.evaluate_every > decisions // args.evaluate_every
            validated = run.evaluate is not None and (due or trainer.finished)
            if validated:
                values |= run.validate()
            run.wall_time += time.perf_counter() - began
            metrics.write(trainer.decisions, trainer.grid_steps, run.wall_time, values)
            track(trainer.decisions, values)
            show(trainer.decisions, values.get("charts/survival"), run.best_survival)
            if validated or time.monotonic() - saved_at >= args.checkpoint_seconds:
                run.save()
                energy.save()
                saved_at, saved_decisions = time.monotonic(), trainer.decisions
            if limit.reached:
                break
        if trainer.decisions != saved_decisions:
            run.save()
        if trainer.finished:
            shutil.rmtree(run.folder / REPLAY_FOLDER, ignore_errors=True)
    run.note(f"{'finished' if trainer.finished else 'stopped'} at {trainer.decisions} decisions")


@contextmanager
def _accounted(folder: Path, trainer: Learner, envs: VectorEnvironment) -> Iterator[EnergyAccount]:
    """The energy account of a run, complete at the end; closes the environments."""
    account, decisions = EnergyAccount(folder), trainer.decisions
    try:
        yield account
    finally:
        # The processor time of worker processes is known once they have ended.
        envs.close()
        if trainer.decisions > decisions:
            account.finish()


def _budget(args: RunArgs, trainer: Learner) -> int:
    """Decisions of the whole run: the largest number of full iterations within the request."""
    return trainer.num_iterations * args.hyperparameters.num_envs * args.hyperparameters.num_steps


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes from writing into a run folder; the lock goes with this process, however it ends."""
    try:
        with locked(folder):
            yield
    except LockedError as error:
        raise UsageError(f"Folder {str(folder)!r} is being written by another process: wait until it ends.") from error
