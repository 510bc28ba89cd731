"""``rl2grid train <algorithm> <task>``: a training run in a folder of its own, resumable at any moment."""

from __future__ import annotations

import contextlib
import difflib
import io
import sys
from dataclasses import Field, asdict, dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from rl2grid.algorithms.registry import algorithm_names
from rl2grid.cli.complaints import in_words
from rl2grid.cli.keywords import flag_text, reward_of
from rl2grid.cli.main import INTERRUPTED
from rl2grid.cli.output import Output
from rl2grid.envs.options import TaskOptions, changed_options, options_of, options_without
from rl2grid.envs.tasks import Task, find_task, short_id
from rl2grid.errors import UsageError
from rl2grid.evaluation.flags import flag_of
from rl2grid.scenarios.splits import VALIDATION_MONTHS
from rl2grid.training.limits import TimeLimit

if TYPE_CHECKING:
    from rl2grid.algorithms.registry import Hyperparameters

GIVEN_OTHERWISE = ("split", "gamma")
"""Keywords that a training decides itself."""

_HELP = f"""\
usage: rl2grid train <algorithm> <task> [flags]
       rl2grid train --resume <run folder> [--max-minutes <minutes>] [--quiet] [--json]

Trains an algorithm ({", ".join(algorithm_names())}) on a task (see `rl2grid tasks`) and writes a run folder:
configuration, metrics.csv, tensorboard/, checkpoint.pt, best.pt by validation, log.txt. A run that was
interrupted goes on with --resume. Flags and their defaults with --help after the task, for example
`rl2grid train ppo bus14-T0 --help`.
"""


@dataclass(frozen=True)
class TrainFlags:
    """How the run is made; the environment's keywords and the algorithm's hyperparameters are flags as well."""

    preset: str = "default"
    """Hyperparameters to start from: ``default``, ``paper``, or ``tuned`` (SAC, and PPO with continuous
    actions); single flags replace single values."""
    output: Path | None = None
    """Run folder, which must not exist yet; None: runs/<task>-<algorithm>-<seed>."""
    threads: int | None = None
    """Native engine: threads that play the environments; None: one per processor core. No influence on results."""
    workers: int | None = None
    """Reference engine: processes that play them; None: one per processor core. No influence on results."""
    evaluate_every: int = 50_000
    """Decisions between two evaluations on the validation scenarios."""
    validation_months: int | None = VALIDATION_MONTHS
    """How many of the validation scenarios are played; None: all; 0: none, so that no best policy is picked."""
    checkpoint_seconds: float = 60.0
    """A checkpoint is written when the last one is older than this, and at the end."""
    max_minutes: float | None = None
    """Minutes after which the run stops with a checkpoint, to be resumed; None: no limit."""
    track: bool = False
    """Whether Weights & Biases gets the metrics; not before `wandb sync` with WANDB_MODE=offline."""
    wandb_project: str = "rl2grid"
    """The project that gets them."""
    json: bool = False
    """Whether to print the results as JSON and nothing else."""
    quiet: bool = False
    """Whether to print the results alone: no progress, no remarks."""


@dataclass(frozen=True)
class ResumeFlags:
    """How a run goes on; all else is stored with it."""

    max_minutes: float | None = None
    """Minutes after which the run stops again with a checkpoint; None: no limit."""
    json: bool = False
    """Whether to print the results as JSON and nothing else."""
    quiet: bool = False
    """Whether to print the results alone: no progress, no remarks."""


def train(command_line: list[str]) -> int:
    """Run the subcommand.

    Raises:
        UsageError: the request cannot be met; nothing was written.
    """
    if not command_line or command_line[0] in ("-h", "--help"):
        print(_HELP)
        return 0
    if command_line[0] == "--resume":
        return _resume(command_line[1:])
    if len(command_line) < 2 or command_line[1].startswith("-"):
        raise UsageError("Training needs an algorithm and a task, for example `rl2grid train ppo bus14-T0`.")
    algorithm, task, flags = command_line[0], command_line[1], command_line[2:]
    return _begin(algorithm, task, flags)


def _resume(arguments: list[str]) -> int:
    if not arguments or arguments[0].startswith("-"):
        raise UsageError("Resuming needs one run folder, for example `rl2grid train --resume runs/bus14-T0-v0-ppo-1`.")
    from rl2grid.training import request, runs
    from rl2grid.training.validation import find_validator

    path, flags = Path(arguments[0]), arguments[1:]
    _refuse_unknown(flags, [*fields(ResumeFlags)], "when it goes on, a run keeps what it began with.")
    own = _parse("rl2grid train --resume", flags, ResumeFlags())
    limit = TimeLimit(own.max_minutes)
    args, _ = request.read_config(path)
    output = Output(json=own.json, quiet=own.quiet)
    folder = runs.resume(path, evaluate=find_validator(args), limit=limit, progress=output.talks)
    return _report(folder, args.task, limit, output)


def _begin(algorithm: str, task_id: str, flags: list[str]) -> int:
    task = find_task(task_id)
    try:
        from rl2grid.training import request, runs
        from rl2grid.training.validation import find_validator
    except ImportError as error:
        raise UsageError(f"Training needs {error.name}: install it with `pip install rl2grid[train]`.") from None
    deciding = {name: _value(flags, f"--{flag_of(name)}") for name in request.DECIDING}
    chosen = {name: value for name, value in deciding.items() if value is not None}
    hyperparameters = request.hyperparameters(algorithm, task, _value(flags, "--preset") or "default", **chosen)
    known = [*fields(TrainFlags), *options_without(*GIVEN_OTHERWISE), *fields(hyperparameters)]
    _refuse_unknown(flags, known, "see --help after the task for all flags.")
    own, keywords, hyperparameters = _parse_all(f"rl2grid train {algorithm} {task.id}", flags, hyperparameters)
    limit, output = TimeLimit(own.max_minutes), Output(json=own.json, quiet=own.quiet)
    keywords["reward"] = reward_of(keywords["reward"])
    keywords = {name: value for name, value in keywords.items() if _is_given(name, flags)} | changed_options(keywords)
    options_of(task, keywords)
    args = request.RunArgs(
        task=task,
        hyperparameters=hyperparameters,
        algorithm=algorithm,
        folder=own.output,
        env_keywords=keywords,
        num_threads=own.threads,
        num_workers=own.workers,
        checkpoint_seconds=own.checkpoint_seconds,
        evaluate_every=own.evaluate_every,
        validation_months=own.validation_months,
        wandb_project=own.wandb_project if own.track else None,
        progress=output.talks,
    )
    try:
        folder = runs.train(args, evaluate=find_validator(args), limit=limit)
    except KeyboardInterrupt:
        folder = request.find_folder(args)
        if not folder.exists():
            raise  # the same command begins it
        print(f"rl2grid: interrupted; go on with `rl2grid train --resume {folder}`.", file=sys.stderr)
        return INTERRUPTED
    return _report(folder, task, limit, output)


def _report(folder: Path, task: Task, limit: TimeLimit, output: Output) -> int:
    from rl2grid.training import runs
    from rl2grid.training.energy import energy_line

    used = energy_line(folder)
    if used:
        output.remark(f"Energy of the run so far: {used}, see {folder / 'energy.json'}.")
    finished = runs.is_finished(folder)
    output.results(run=folder, finished=finished)
    output.close()
    if not finished and limit.reached:
        output.text(f"Run stopped by --max-minutes: {folder}. Go on with `rl2grid train --resume {folder}`.")
        return 0
    if not finished:
        output.text(f"Run stopped: {folder}. Go on with `rl2grid train --resume {folder}`.")
        return INTERRUPTED
    output.text(f"Run complete: {folder}. Evaluate it with `rl2grid evaluate {folder} {short_id(task.id)}`.")
    return 0


def _is_given(name: str, flags: list[str]) -> bool:
    """Whether a keyword of the environment stands among the flags, at its default or not."""
    return any(flag.split("=", 1)[0].replace("_", "-") == f"--{flag_of(name)}" for flag in flags)


def _value(flags: list[str], name: str) -> str | None:
    """What the flag ``name`` says; None: it is not there."""
    for flag, value in zip(flags, [*flags, ""][1:], strict=True):
        if flag == name:
            return value
        if flag.startswith(f"{name}="):
            return flag.removeprefix(f"{name}=")
    return None


def _parse_all(
    program: str, flags: list[str], hyperparameters: Hyperparameters
) -> tuple[TrainFlags, dict[str, Any], Hyperparameters]:
    """The flags of the run, the environment's keywords and the algorithm's flags, of one list."""
    import tyro

    environment, learning = _environment_flags(), _hyperparameter_flags(type(hyperparameters))
    request = make_dataclass(
        "Request",
        [
            ("flags", tyro.conf.OmitArgPrefixes[TrainFlags]),
            ("environment", tyro.conf.OmitArgPrefixes[environment]),  # type: ignore[misc, valid-type]
            ("hyperparameters", tyro.conf.OmitArgPrefixes[learning]),  # type: ignore[misc, valid-type]
        ],
    )
    chosen = {each.name: getattr(hyperparameters, each.name) for each in fields(hyperparameters)}
    parsed = _parse(program, flags, request(TrainFlags(), environment(), learning(**chosen)))
    chosen = {name: getattr(parsed.hyperparameters, name) for name in chosen}
    return parsed.flags, asdict(parsed.environment), type(hyperparameters)(**chosen)


def _hyperparameter_flags(of: type[Any]) -> type[Any]:
    """A dataclass like ``of``, whose fields are called as flags call them."""
    import tyro

    hints = get_type_hints(of)
    renamed = {each.name: each.default for each in fields(of) if flag_of(each.name) != each.name.replace("_", "-")}
    return make_dataclass(
        of.__name__,
        [
            (name, Annotated[hints[name], tyro.conf.arg(name=flag_of(name))], field(default=default))
            for name, default in renamed.items()
        ],
        bases=(of,),
        frozen=True,
    )


def _environment_flags() -> type[Any]:
    """A dataclass with the keywords that are flags; a reward is text."""
    import tyro

    hints = get_type_hints(TaskOptions) | {"reward": str}
    return make_dataclass(
        "Environment",
        [
            (
                option.name,
                Annotated[hints[option.name], tyro.conf.arg(help=flag_text(option.name))],
                field(default=option.default),
            )
            for option in options_without(*GIVEN_OTHERWISE)
        ],
    )


def _parse(program: str, flags: list[str], default: Any) -> Any:
    """A dataclass like ``default`` with the values of the flags.

    Raises:
        UsageError: a flag or a value that does not exist.
    """
    import tyro

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(type(default), prog=program, args=flags, default=default)
    except SystemExit as stop:
        if not stop.code:
            raise  # --help was asked for
        raise UsageError(f"{in_words(_sentence(complaint.getvalue()))}; see {program} --help.") from None


def _sentence(box: str) -> str:
    """What a parser says in a box of several lines, as one sentence without its full stop."""
    lines = [line.strip(" \u2502|") for line in box.splitlines()]
    text = [line for line in lines if line and line[0] not in "-\u2500\u256d\u2570"]
    begin = next((k for k, line in enumerate(text) if line.startswith("Error parsing")), 0)
    end = next((k for k, line in enumerate(text) if line.startswith(("Argument helptext", "For full helptext"))), None)
    return " ".join(text[begin:end]).removesuffix(".")


def _refuse_unknown(flags: list[str], known: list[Field[Any]], advice: str) -> None:
    """Refuse flags that are not known, with ``advice`` where no known one is spelt nearly so."""
    names = {"--help", *(f"--{flag_of(field.name)}" for field in known)}
    names |= {f"--no-{flag_of(field.name)}" for field in known if field.type == "bool"}
    for flag in flags:
        name = flag.split("=", 1)[0].replace("_", "-")
        if not flag.startswith("--") or name in names:
            continue
        close = difflib.get_close_matches(name, sorted(names), n=3)
        hint = f"did you mean {' or '.join(close)}?" if close else advice
        raise UsageError(f"Flag {name} does not exist: {hint}")
