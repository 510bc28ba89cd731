"""The evaluation protocol: any agent over an enumerated list of scenarios and seeds, one row per episode.

Nothing is sampled: every scenario of the split is played from its beginning with every seed (seeds matter
where maintenance, an opponent or the agent draw random numbers). Validation picks models; the test list is
for the final word.

An evaluation that is stored goes to a folder of its own::

    evaluation.json          identity, request, command; the aggregates once it is complete
    episodes.partial.csv     while it runs: the rows finished so far
    episodes.csv             all rows, in the order of scenarios, then seeds

A row is on disk when its episode ends. After a kill the same call goes on with the episodes that are
missing. The result depends neither on the number of workers nor on interruptions.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import rich.progress
from filelock import FileLock, Timeout

from rl2grid.agents.agent import Agent
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.tasks import Task, constraint_of, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.crew import Job, Progress, Setting, make_crew
from rl2grid.mdp.actions import action_set_hash
from rl2grid.records.episodes import EPISODES_FILE, Episode, format_row, read_episodes, write_episodes
from rl2grid.records.evaluations import EVALUATION_FILE, Evaluation, labels, read_request, write_evaluation
from rl2grid.records.files import check_folder, make_folder
from rl2grid.records.summary import Summary, summarise
from rl2grid.records.versions import library_versions
from rl2grid.scenarios.library import check_in_split, generator_version, list_scenarios, scenario_pack_hash

PARTIAL_FILE = "episodes.partial.csv"
LOCK_FILE = ".lock"

AS_TRAINED = "as trained"
"""Value of ``heuristic``: the one that the policy was trained with; none for agents without training."""


def evaluate(
    agent: str | Path | Agent,
    task_id: str,
    *,
    split: str = "validation",
    scenarios: Sequence[str] | None = None,
    seeds: Sequence[int] = (0,),
    start: int = 0,
    heuristic: str | None = AS_TRAINED,
    workers: int | None = None,
    output: Path | None = None,
    progress: bool = False,
    name: str | None = None,
    command: str | None = None,
    **options: Any,
) -> Evaluation:
    """Play every scenario with every seed.

    Args:
        agent: ``"do-nothing"``, ``"random"``, ``"recovery"``, ``"greedy"``, ``"milp"``, ``"dc-opf"``, the path of a
            checkpoint or run folder, or an agent that is not bound to an environment yet.
        task_id: id of the task; the namespace and the version may be left out.
        split: whose scenarios are played: ``"validation"``, ``"test"``, ``"train"`` or ``"bundled"``.
        scenarios: play these only; None: all of the split.
        seeds: of maintenance, opponent and agent; each scenario has its own draws with the same seed
            (:func:`rl2grid.evaluation.episode.environment_seed`).
        start: row of each scenario at which its episodes begin.
        heuristic: None, ``"idle"``, ``"recovery"`` or :data:`AS_TRAINED`.
        workers: processes that play at the same time; 0: this process plays; None: this one on the native engine,
            one per processor core on the reference engine. No influence on results.
        output: folder to store the evaluation in, and to continue it from; None: nothing is stored.
        progress: whether to show a progress bar with rate and remaining time.
        name: what tables call the agent; None: its own name.
        command: what to type to obtain the result again; None: this call.
        options: further keywords of ``gymnasium.make``, such as ``reward`` or ``opponent``.

    Raises:
        UsageError: the request cannot be met, or ``output`` holds another evaluation. Nothing was written.
    """
    task = find_task(task_id)
    chosen = make_agent(agent, task.id) if isinstance(agent, str | Path) else agent
    keywords = env_keywords(chosen, {**options, "split": split, "heuristic": heuristic})
    chosen_scenarios = _checked_scenarios(task, split, scenarios)
    jobs = _jobs(chosen_scenarios, seeds, start)
    return run_evaluation(
        # The agent whose identity is stored, not its path: a run that still trains replaces the file.
        Setting(task.id, chosen, keywords),
        jobs,
        identity=_identity(task, chosen, name or chosen.name, keywords, start, chosen_scenarios),
        command=command or _call(agent, task, keywords, scenarios, seeds, start, name),
        workers=_number_of_workers(workers, TaskOptions(**keywords).engine),
        output=output,
        progress=progress,
    )


def evenly_spread(task_id: str, split: str, months: int | None) -> tuple[str, ...]:
    """Some months of a split, evenly spread over it; ``months`` None, or more than there are: all.

    Raises:
        UsageError: no such task or split, or a number of months below 1.
    """
    if months is not None and months < 1:
        raise UsageError(f"months={months} is not allowed: give a number of months, at least 1.")
    listed = list_scenarios(find_task(task_id).grid_id, split)
    number = min(months or len(listed), len(listed))
    return tuple(listed[k * len(listed) // number] for k in range(number))


def run_evaluation(
    setting: Setting,
    jobs: Sequence[Job],
    *,
    identity: Mapping[str, Any],
    command: str,
    workers: int = 0,
    output: Path | None = None,
    progress: bool = False,
) -> Evaluation:
    """Play ``jobs``, those excepted that ``output`` holds already; see :func:`evaluate`.

    Args:
        setting: task, agent and keywords of the environments.
        jobs: the episodes, in the order in which they are to be listed.
        identity: what the result is a result of; see :class:`~rl2grid.records.evaluations.Evaluation`.
        command: what to type to obtain the result again.
        workers: processes; 0: this process plays.
        output: folder; None: nothing is stored.
        progress: whether to show a progress bar.
    """
    of_all = labels(identity)
    request = {"identity": dict(identity), "identity_hash": of_all["identity"], "jobs": [list(job) for job in jobs]}
    with _store(output, request, command) as store, _display(setting, jobs, progress) as display:
        done = {_job(episode): episode for episode in store.episodes}
        display.skip(done)
        missing = [job for job in jobs if job not in done]
        if missing:
            with make_crew(setting, workers) as crew:
                for played in crew.play(missing, display.advance):
                    episode = replace(played, **of_all)
                    store.add(episode)
                    display.finish(episode)
                    done[_job(episode)] = episode
        episodes = tuple(done[job] for job in jobs)
        store.finish(episodes)
    return Evaluation(episodes, identity, command, output)


def env_keywords(agent: Agent, keywords: dict[str, Any]) -> dict[str, Any]:
    """Keywords of the environments: those given, else what the policy was trained with, else the defaults."""
    trained: Mapping[str, Any] = getattr(agent, "env_keywords", {})
    if keywords["heuristic"] == AS_TRAINED:
        keywords["heuristic"] = trained.get("heuristic")
    if "normalize" in trained:
        keywords.setdefault("normalize", trained["normalize"])
    unknown = sorted(set(keywords) - set(TaskOptions.__dataclass_fields__))
    if unknown:
        allowed = ", ".join(TaskOptions.__dataclass_fields__)
        raise UsageError(f"Option {unknown[0]!r} does not exist: choose from {allowed}.")
    TaskOptions(**keywords)
    return keywords


def _number_of_workers(workers: int | None, engine: str) -> int:
    if workers is None:
        # A native episode is over before another process has started.
        return 0 if engine == "native" else os.cpu_count() or 1
    if not isinstance(workers, int) or workers < 0:
        raise UsageError(f"workers={workers!r} is not allowed: give a number of processes, 0 or more.")
    return workers


def _checked_scenarios(task: Task, split: str, scenarios: Sequence[str] | None) -> tuple[str, ...]:
    if scenarios is None:
        return list_scenarios(task.grid_id, split)
    if not scenarios:
        raise UsageError(f"No scenario was given: name some of the split {split} of {task.grid_id}, or leave it out.")
    for scenario in scenarios:
        check_in_split(task.grid_id, split, scenario)
    return tuple(scenarios)


def _jobs(scenarios: Sequence[str], seeds: Sequence[int], start: int) -> list[Job]:
    if not seeds or any(not isinstance(seed, int) or seed < 0 for seed in seeds):
        raise UsageError(f"seeds={seeds!r} is not allowed: give at least one integer, none negative.")
    jobs = [Job(scenario, seed, start) for scenario in scenarios for seed in seeds]
    if len(set(jobs)) != len(jobs):
        raise UsageError("A scenario or seed was given twice: an episode counts once.")
    return jobs


def _identity(
    task: Task, agent: Agent, name: str, keywords: Mapping[str, Any], start: int, scenarios: Sequence[str]
) -> dict[str, Any]:
    who = {"task": task.id, "agent": name, "agent_identity": getattr(agent, "identity", None)}
    return {**who, **question(task, keywords, start, scenarios), "versions": library_versions()}


def question(task: Task, keywords: Mapping[str, Any], start: int, scenarios: Sequence[str]) -> dict[str, Any]:
    """What an evaluation asks of an agent, as it stands in its identity: options, data and actions.

    Raises:
        UsageError: a keyword or a scenario does not exist.
    """
    options = asdict(TaskOptions(**keywords))
    reward = options["reward"]
    options["reward"] = f"{reward.__module__}.{reward.__qualname__}" if callable(reward) else reward
    return {
        **{key: value for key, value in options.items() if key not in ("scenario", "gamma")},
        "constraint": constraint_of(task, options["constraint"]),
        "start": start,
        "grid_hash": task.grid.hash,
        "generator_version": generator_version(options["split"]),
        "scenario_pack_hash": scenario_pack_hash(task.grid_id, options["split"], scenarios),
        "action_set_hash": action_set_hash(task.grid, task.level) if task.kind == "T" else None,
    }


def _call(
    agent: str | Path | Agent,
    task: Task,
    keywords: Mapping[str, Any],
    scenarios: Sequence[str] | None,
    seeds: Sequence[int],
    start: int,
    name: str | None,
) -> str:
    shown = repr(str(agent)) if isinstance(agent, str | Path) else f"<{agent.name}>"
    arguments: dict[str, Any] = {**keywords, "seeds": list(seeds)}
    if scenarios is not None:
        arguments["scenarios"] = list(scenarios)
    if start:
        arguments["start"] = start
    if name is not None:
        arguments["name"] = name
    words = ", ".join(f"{key}={value!r}" for key, value in arguments.items())
    return f"evaluate({shown}, {task.id!r}, {words})"


def _job(episode: Episode) -> Job:
    return Job(episode.scenario, episode.seed, episode.start)


class _Store:
    """Where finished rows go; this one forgets them."""

    episodes: tuple[Episode, ...] = ()
    """Rows of an earlier, interrupted call."""

    def add(self, episode: Episode) -> None:
        """Keep a finished row."""

    def finish(self, episodes: tuple[Episode, ...]) -> None:
        """Keep the complete list."""

    def close(self) -> None:
        """Let others write."""


class _FolderStore(_Store):
    """Keeps rows in a folder, which is not made before the first of them."""

    def __init__(self, folder: Path, request: Mapping[str, Any], command: str) -> None:
        self._folder, self._request, self._command = folder, request, command
        self._finished, self._partial = folder / EPISODES_FILE, folder / PARTIAL_FILE
        self._lock: FileLock | None = None
        if not folder.exists():
            check_folder(folder)
            return
        if not folder.is_dir():
            raise UsageError(f"{folder} is a file: give a folder to store the evaluation in.")
        self._take_lock()
        try:
            self.episodes = self._stored_episodes()
        except BaseException:
            self.close()
            raise

    def add(self, episode: Episode) -> None:
        if self._lock is None:
            make_folder(self._folder)
            self._take_lock()
            self._check_still_unused()
        if not self._partial.exists():
            self._describe(None)
            write_episodes(self._partial, self.episodes)
        with self._partial.open("a", encoding="utf-8", newline="") as file:
            file.write(format_row(episode))

    def finish(self, episodes: tuple[Episode, ...]) -> None:
        write_episodes(self._finished, episodes)
        self._describe(summarise(episodes))
        self._partial.unlink(missing_ok=True)

    def close(self) -> None:
        if self._lock is not None:
            self._lock.release()

    def _stored_episodes(self) -> tuple[Episode, ...]:
        if not (self._folder / EVALUATION_FILE).exists():
            return ()
        _check_same_request(self._folder, self._request)
        if self._finished.exists():
            return read_episodes(self._finished)
        if not self._partial.exists():
            return ()
        episodes = read_episodes(self._partial)
        # Without the torn line that a kill may have left at the end.
        write_episodes(self._partial, episodes)
        return episodes

    def _check_still_unused(self) -> None:
        """Refuse what another process wrote since this evaluation began, when there was no folder."""
        if not (self._folder / EVALUATION_FILE).exists():
            return
        _check_same_request(self._folder, self._request)
        raise UsageError(
            f"Another process wrote this evaluation to {self._folder} meanwhile: ask again to go on with what it wrote."
        )

    def _describe(self, summary: Summary | None) -> None:
        write_evaluation(self._folder / EVALUATION_FILE, {**self._request, "command": self._command}, summary)

    def _take_lock(self) -> None:
        self._lock = FileLock(self._folder / LOCK_FILE)
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise UsageError(
                f"Another process is writing to {self._folder}: wait for it, or choose another folder."
            ) from None


def _check_same_request(folder: Path, request: Mapping[str, Any]) -> None:
    stored = read_request(folder / EVALUATION_FILE)
    mine, theirs = request["identity"], stored["identity"]
    differing = [key for key in {**theirs, **mine} if _plain(mine.get(key)) != theirs.get(key)]
    if not differing and stored["jobs"] != request["jobs"]:
        differing = ["scenarios or seeds"]
    if differing:
        raise UsageError(
            f"{folder} holds another evaluation, with a different {differing[0]}: choose another folder, or remove it."
        )


def _plain(value: Any) -> Any:
    """A value as JSON gives it back."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


@contextmanager
def _store(folder: Path | None, request: Mapping[str, Any], command: str) -> Iterator[_Store]:
    store = _Store() if folder is None else _FolderStore(folder, request, command)
    try:
        yield store
    finally:
        store.close()


class _Display:
    """Tells of the course of an evaluation; this one keeps silent."""

    def skip(self, jobs: Iterable[Job]) -> None:
        """These were played in an earlier call."""

    def advance(self, progress: Progress) -> None:
        """An episode is under way."""

    def finish(self, episode: Episode) -> None:
        """An episode ended."""


class _ProgressBar(_Display):
    """Episodes done, grid steps per second, remaining time."""

    def __init__(self, bar: rich.progress.Progress, setting: Setting, n_jobs: int) -> None:
        self._bar = bar
        self._began = time.monotonic()
        self._shares: dict[Job, float] = {}
        self._steps: dict[Job, int] = {}
        self._finished = 0
        self._n_jobs = n_jobs
        self._id = bar.add_task(f"Evaluating {setting.agent.name}", total=n_jobs, rate="", count=f"0/{n_jobs}")

    def skip(self, jobs: Iterable[Job]) -> None:
        self._shares |= dict.fromkeys(jobs, 1.0)
        self._finished = len(self._shares)
        self._show()

    def advance(self, progress: Progress) -> None:
        self._shares[progress.job] = progress.grid_steps / progress.episode_length
        self._steps[progress.job] = progress.grid_steps
        self._show()

    def finish(self, episode: Episode) -> None:
        job = _job(episode)
        self._shares[job], self._steps[job] = 1.0, episode.grid_steps
        self._finished += 1
        self._show()

    def _show(self) -> None:
        rate = sum(self._steps.values()) / max(time.monotonic() - self._began, 1e-3)
        self._bar.update(
            self._id,
            completed=sum(self._shares.values()),
            rate=f"{rate:,.0f} grid steps/s",
            count=f"{self._finished}/{self._n_jobs} episodes",
        )


@contextmanager
def _display(setting: Setting, jobs: Sequence[Job], progress: bool) -> Iterator[_Display]:
    if not progress:
        yield _Display()
        return
    columns = (
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.TextColumn("{task.fields[count]}"),
        rich.progress.TextColumn("{task.fields[rate]}"),
        rich.progress.TimeRemainingColumn(),
    )
    with rich.progress.Progress(*columns) as bar:
        yield _ProgressBar(bar, setting, len(jobs))
