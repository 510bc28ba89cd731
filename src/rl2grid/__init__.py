"""rl2grid: a benchmark for reinforcement learning in power-grid operation.

Importing the package registers the tasks with Gymnasium, whichever of the two is imported first::

    import gymnasium, rl2grid
    env = gymnasium.make("rl2grid/bus14-T0-v0", heuristic="idle")

:func:`tasks` lists them, :func:`train` trains an agent, :func:`load` brings its policy back, and :func:`evaluate` plays
the episodes by which agents are compared. :func:`teach` stores what an agent decides, for others to learn from. A grid
of one's own gets the same tasks with :func:`register_system`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl2grid.envs.on_import import register_from_environment, register_with_gymnasium

if TYPE_CHECKING:
    from rl2grid.agents.agent import Agent
    from rl2grid.algorithms.policy_agent import PolicyAgent
    from rl2grid.envs.tasks import Task
    from rl2grid.grids import System
    from rl2grid.records.evaluations import Evaluation

__all__ = ["evaluate", "load", "register_system", "tasks", "teach", "train"]
__version__ = "1.0.0rc1"

register_with_gymnasium()

# What the functions need is imported when they are called: help does without NumPy, environments without PyTorch.


def tasks(grid: str | None = None) -> dict[str, Task]:
    """All tasks by id, in the order in which ``rl2grid tasks`` prints them.

    Args:
        grid: Id of a grid, such as ``"bus14"``: its tasks only.

    Raises:
        UsageError: there is no such grid.
    """
    from rl2grid.envs.tasks import all_tasks
    from rl2grid.errors import one_of

    every = all_tasks()
    if grid is None:
        return dict(every)
    chosen = {task_id: task for task_id, task in every.items() if task.grid_id == grid}
    if not chosen:
        raise one_of("Grid", grid, tuple(dict.fromkeys(task.grid_id for task in every.values())))
    return chosen


def register_system(system: System) -> None:
    """Give a grid everything that the seven have: tasks, scenarios, rankings, evaluation, pages.

    Its tasks are ``rl2grid/<id>-T<level>[-LSI|-TLO]-v0``, ``rl2grid/<id>-R-v0`` and
    ``rl2grid/<id>-H<level>[-LSI|-TLO]-v0``. Workers of vectors and evaluations know it too. It takes the place of an
    earlier system of the same grid, in environments that are made from then on.

    Args:
        system: The grid, with what it plays.

    Raises:
        UsageError: its id cannot be part of a task's, or is that of another grid; or there is nothing to play.
    """
    from rl2grid.envs import registration

    registration.register_system(system)


def train(
    algorithm: str,
    task: Task | str,
    *,
    folder: str | Path | None = None,
    preset: str = "default",
    start_from: str | Path | None = None,
    hyperparameters: Mapping[str, Any] | None = None,
    validation_months: int | None = 20,
    evaluate_every: int = 50_000,
    num_threads: int | None = None,
    progress: bool = True,
    **options: Any,
) -> Path:
    """Train an agent from the beginning and return its run folder, which :func:`load` and :func:`evaluate` take.

    ``rl2grid train`` does the same, and ``rl2grid train --resume FOLDER`` goes on with a run that was interrupted.

    Args:
        algorithm: ``"ppo"``, ``"lagrangian-ppo"``, ``"dqn"``, ``"sac"``, ``"td3"`` or ``"imitation"``.
        task: The task or its id; the namespace and the version of an id may be left out.
        folder: Where the run is written, a folder that does not exist yet; None: ``runs/<task>-<algorithm>-<seed>``.
        preset: Where the hyperparameters come from that are not given.
        start_from: A run folder or checkpoint whose policy is where it begins; None: a new one.
        hyperparameters: Of the algorithm, such as ``{"total_timesteps": 100_000, "seed": 1}`` (decisions to train for).
        validation_months: How many validation months pick the best policy; None: all, 0: none.
        evaluate_every: Decisions between two validations; there is one more at the end.
        num_threads: Native engine: threads that play the environments; None: one per processor core. Results do not
            depend on it.
        progress: Whether to show a progress bar.
        options: Keywords of ``gymnasium.make``, such as ``heuristic`` or ``reward``.

    Raises:
        UsageError: the request cannot be met; nothing was written.
        ImportError: PyTorch is not installed.
    """
    from rl2grid.envs.tasks import find_task
    from rl2grid.training import request, runs
    from rl2grid.training.validation import find_validator

    chosen = find_task(task)
    changes = dict(hyperparameters or {})
    if start_from is not None:
        changes["start_from"] = str(start_from)
    args = request.RunArgs(
        task=chosen,
        hyperparameters=request.hyperparameters(algorithm, chosen, preset, **changes),
        algorithm=algorithm,
        folder=None if folder is None else Path(folder),
        env_keywords=options,
        evaluate_every=evaluate_every,
        validation_months=validation_months,
        num_threads=num_threads,
        progress=progress,
    )
    return runs.train(args, evaluate=find_validator(args))


def teach(
    teacher: str | Path | Agent,
    task: Task | str,
    *,
    months: int = 20,
    output: str | Path | None = None,
    seed: int = 0,
    pupil: str | Path | Agent | None = None,
    progress: bool = False,
    **options: Any,
) -> Path:
    """Label training months with what a teacher decides; ``rl2grid teach`` does the same, ``docs/labels.md`` says more.

    Args:
        teacher: Name of an agent without training, such as ``"planner"``, the path of a run folder or checkpoint, or an
            agent that is not bound to an environment yet.
        task: The task or its id; the namespace and the version of an id may be left out.
        months: Of the training library; of a folder that has labels already, as many or more.
        output: Folder of the labels, to begin or to go on with; None: by task and teacher in ``runs``.
        seed: Of which months are played.
        pupil: Who acts while the teacher says what it would do: another round in the same folder.
        progress: Whether to show a progress bar.
        options: Keywords of ``gymnasium.make``, such as ``heuristic``, and further ones of
            :func:`rl2grid.training.teaching.teach`.

    Returns:
        The folder, which ``rl2grid.records.labels.read_labels`` reads.

    Raises:
        UsageError: the request cannot be met, or ``output`` holds other labels; nothing was written.
    """
    from rl2grid.training import teaching

    return teaching.teach(
        teacher,
        task,
        months=months,
        output=None if output is None else Path(output),
        seed=seed,
        pupil=pupil,
        progress=progress,
        **options,
    ).folder


def evaluate(
    agent: str | Path | Agent,
    task: Task | str,
    *,
    split: str = "validation",
    months: int | None = None,
    scenarios: Sequence[str] | None = None,
    seeds: Sequence[int] = (0,),
    output: str | Path | None = None,
    progress: bool = False,
    **options: Any,
) -> Evaluation:
    """Play every month of a split with every seed; ``rl2grid evaluate`` does the same.

    Args:
        agent: Name of an agent without training, such as ``"greedy"``, the path of a run folder or checkpoint, or an
            agent that is not bound to an environment yet.
        task: The task or its id; the namespace and the version of an id may be left out.
        split: ``"validation"`` to choose by, ``"test"`` for the last number, ``"train"`` or ``"bundled"``.
        months: Play the first so many of the split; None: all of it.
        scenarios: Play these of the split only, instead of the first ones.
        seeds: Of maintenance, opponent and agent: episodes per month.
        output: Folder to store the evaluation in, and to go on with; None: nothing is stored.
        progress: Whether to show a progress bar.
        options: Keywords of ``gymnasium.make``, such as ``heuristic`` (by default the one that a policy was trained
            with), and further ones of :func:`rl2grid.evaluation.protocol.evaluate`.

    Returns:
        One row per episode in ``episodes``, and their means with intervals in ``summary``.

    Raises:
        UsageError: the request cannot be met, or ``output`` holds another evaluation; nothing was written.
    """
    from rl2grid.evaluation import protocol

    return protocol.evaluate(
        agent,
        task,
        split=split,
        months=months,
        scenarios=scenarios,
        seeds=seeds,
        output=None if output is None else Path(output),
        progress=progress,
        **options,
    )


def load(run: str | Path, *, deterministic: bool = True) -> PolicyAgent:
    """The policy of a training run, or of one checkpoint file, as an agent; nothing in the file is executed.

    Args:
        run: A run folder (its best policy by validation, else its latest), a checkpoint file, or a policy that comes
            with the package, such as ``"pretrained/bus14-T0"`` (``rl2grid pretrained`` lists them).
        deterministic: Whether to play the most probable action instead of a sample.

    Raises:
        UsageError: there is no checkpoint, or it cannot be read.
        ImportError: PyTorch is not installed.
    """
    from rl2grid.algorithms.policy_agent import load_agent

    return load_agent(Path(run), deterministic=deterministic)


# Last: what it imports may use everything above.
register_from_environment()
