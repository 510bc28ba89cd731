"""Where the cells of a study are worked on: this machine, a Ray cluster, or Slurm."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from rl2grid.errors import UsageError, one_of
from rl2grid.studies.cell import COMMAND, FAILED, STOPPED, CellProcess, work


class Job(Protocol):
    """A cell that was submitted."""

    def poll(self) -> int | None:
        """Exit status (see :mod:`rl2grid.studies.cell`); None while it waits or works."""

    def stop(self) -> None:
        """Ask it to write a checkpoint and end."""


class Backend(Protocol):
    """Somewhere to submit cells to."""

    slots: int
    """Cells to have submitted at the same time."""

    def submit(self, folder: Path) -> Job:
        """Work on the cell in ``folder``."""


class Local:
    """The machine of the study itself: one process per cell."""

    def __init__(self, slots: int | None = None, command: Sequence[str] = COMMAND) -> None:
        """``slots``: cells at the same time; None: one per core. ``command``: what works on the folder given to it."""
        self.slots = slots or len(os.sched_getaffinity(0))
        self._command = tuple(command)

    def submit(self, folder: Path) -> Job:
        """Work on the cell in ``folder``."""
        return CellProcess(folder, self._command)


class Ray:
    """A Ray cluster: the one that runs, else one on this machine. The output must be on a disk that all nodes share."""

    def __init__(self, slots: int | None = None, command: Sequence[str] = COMMAND) -> None:
        """Connect.

        Raises:
            UsageError: Ray is not installed.
        """
        try:
            import ray
        except ImportError:
            raise UsageError("The backend ray needs Ray: `pip install rl2grid[ray]` installs it.") from None
        self._ray = ray
        if not ray.is_initialized():
            try:
                ray.init(address="auto", log_to_driver=False)
            except ConnectionError:
                ray.init(num_cpus=slots, log_to_driver=False, include_dashboard=False)
        self.slots = slots or max(int(ray.cluster_resources().get("CPU", 1)), 1)
        self._work = ray.remote(num_cpus=1, max_retries=0)(work)
        self._command = tuple(command)

    def submit(self, folder: Path) -> Job:
        """Work on the cell in ``folder``."""
        return _RayJob(self._ray, self._work.remote(folder.resolve(), self._command))


class _RayJob:
    def __init__(self, ray: Any, reference: Any) -> None:
        self._ray, self._reference = ray, reference

    def poll(self) -> int | None:
        ready, _ = self._ray.wait([self._reference], timeout=0)
        if not ready:
            return None
        try:
            return int(self._ray.get(self._reference))
        except (self._ray.exceptions.TaskCancelledError, KeyboardInterrupt):
            return STOPPED
        except self._ray.exceptions.RayError as error:
            return STOPPED if isinstance(getattr(error, "cause", None), KeyboardInterrupt) else FAILED

    def stop(self) -> None:
        self._ray.cancel(self._reference)


class Slurm:
    """Slurm jobs, one per cell, by submitit. The output must be on a disk that all nodes share."""

    def __init__(
        self,
        folder: Path,
        slots: int | None = None,
        parameters: Mapping[str, Any] | None = None,
        cluster: str = "slurm",
        command: Sequence[str] = COMMAND,
    ) -> None:
        """Check that jobs can be submitted.

        Args:
            folder: where submitit keeps its files.
            slots: jobs that wait or run at the same time; None: 1,000.
            parameters: submitit's, such as ``timeout_min`` or ``slurm_partition``.
            cluster: ``"slurm"``, or ``"local"`` for jobs on this machine.
            command: what works on the folder given to it.

        Raises:
            UsageError: submitit or Slurm is not installed, or a parameter does not exist.
        """
        try:
            import submitit
        except ImportError:
            raise UsageError("The backend slurm needs submitit: `pip install rl2grid[slurm]` installs it.") from None
        try:
            self._executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
            self._executor.update_parameters(
                **{"name": "rl2grid", "cpus_per_task": 1, "timeout_min": 48 * 60, **(parameters or {})}
            )
        except (RuntimeError, NameError, ValueError, TypeError, AssertionError) as error:
            raise UsageError(f"Jobs cannot be submitted to Slurm: {str(error).splitlines()[0].rstrip('.')}.") from None
        self._not_completed = submitit.core.utils.UncompletedJobError
        self._failed = submitit.core.utils.FailedJobError
        self.slots = slots or 1000
        self._command = tuple(command)

    def submit(self, folder: Path) -> Job:
        """Work on the cell in ``folder``."""
        job = self._executor.submit(work, folder.resolve(), self._command)
        return _SlurmJob(job, self._failed, self._not_completed)


class _SlurmJob:
    def __init__(self, job: Any, failed: type[Exception], not_completed: type[Exception]) -> None:
        self._job, self._failed, self._not_completed = job, failed, not_completed
        self._cancelled = False

    def poll(self) -> int | None:
        if not self._job.done():
            return None
        if self._cancelled:  # submitit would wait for a result that never comes
            return STOPPED
        try:
            return int(self._job.result())
        except self._failed:
            return FAILED
        except self._not_completed:
            # Ended from outside: cancelled, preempted or out of time.
            return STOPPED

    def stop(self) -> None:
        self._cancelled = True
        self._job.cancel()


BACKENDS: dict[str, Callable[[Path, int | None, Mapping[str, Any]], Backend]] = {
    "local": lambda folder, slots, parameters: Local(slots),
    "ray": lambda folder, slots, parameters: Ray(slots),
    "slurm": lambda folder, slots, parameters: Slurm(folder, slots, parameters),
}
"""Made of a folder for job files, the number of slots, and the study's table ``slurm``."""


def make_backend(name: str, folder: Path, slots: int | None, parameters: Mapping[str, Any]) -> Backend:
    """A backend by its name.

    Raises:
        UsageError: there is none of this name, or what it needs is not installed.
    """
    if name not in BACKENDS:
        raise one_of("Backend", name, tuple(BACKENDS))
    if slots is not None and slots < 1:
        raise UsageError(f"--jobs {slots} is not allowed: at least 1 is needed.")
    return BACKENDS[name](folder, slots, parameters)
