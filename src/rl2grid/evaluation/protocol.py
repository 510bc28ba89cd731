"""The evaluation protocol: any agent over an enumerated list of scenarios and seeds, one row per episode.

Nothing is sampled: every scenario of the split is played from its beginning with every seed (seeds matter
where maintenance, an opponent or the agent draw random numbers). Validation picks models; the test list is
for the final word.

An evaluation that is stored goes to a folder of its own, see :mod:`rl2grid.records.evaluation_folder`. A row is on disk
when its episode ends. After a kill the same call goes on with the episodes that are missing. The result depends neither
on the number of workers nor on interruptions.
"""

from __future__ import annotations

import copy
import itertools
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rl2grid.agents.agent import Agent
from rl2grid.envs.options import OBSERVED_WITH, TaskOptions, options_of
from rl2grid.envs.tasks import Task, constraint_of, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.crew import Job, make_crew
from rl2grid.evaluation.progress import show_progress, watch_making
from rl2grid.evaluation.setting import Setting
from rl2grid.evaluation.side_by_side import episodes_abreast
from rl2grid.mdp.actions import action_set_hash
from rl2grid.mdp.rewards import resolve_reward, reward_name
from rl2grid.records.episodes import Episode
from rl2grid.records.evaluation_folder import open_store
from rl2grid.records.evaluations import Evaluation, labels
from rl2grid.records.files import check_folder, printable
from rl2grid.records.versions import library_versions
from rl2grid.scenarios.episodes import MAX_STEPS, check_length
from rl2grid.scenarios.library import (
    check_in_split,
    generator_version,
    list_scenarios,
    load_scenario,
    make_scenarios,
    scenario_pack_hash,
    split_version,
)

_MANY_JOBS = 100
"""Episodes of the native engine that are worth processes of their own."""
AS_TRAINED = "as trained"
"""Value of ``heuristic``: the one that the policy was trained with; none for agents without training."""


def evaluate(
    agent: str | Path | Agent,
    task: Task | str,
    *,
    split: str = "validation",
    months: int | None = None,
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
            checkpoint or run folder, ``"package.module:Agent"``, ``"./agent.py"``, or an agent that is not bound to an
            environment yet.
        task: the task, or its id, whose namespace and version may be left out.
        split: whose scenarios are played: ``"validation"``, ``"test"``, ``"train"`` or ``"bundled"``.
        months: play the first so many of the split, of all seasons alike; None: all of it.
        scenarios: play these of the split only, instead of the first ones.
        seeds: of maintenance, opponent and agent; each scenario has its own draws with the same seed
            (:func:`rl2grid.evaluation.episode.environment_seed`).
        start: row of each scenario at which its episodes begin.
        heuristic: None, one of :data:`rl2grid.engines.HEURISTICS`, or :data:`AS_TRAINED`.
        workers: processes that play at the same time, each many episodes side by side if the agent decides for many
            (:class:`~rl2grid.agents.agent.SideBySideAgent`); 0: this process plays; None: this one for less than 100
            episodes of the native engine, and for agents that are not given by name or path, else one per processor
            core. No influence on results.
        output: folder to store the evaluation in, and to continue it from; None: nothing is stored.
        progress: whether to show a progress bar with rate and remaining time.
        name: what tables call the agent; None: its own name.
        command: what to type to obtain the result again; None: this call.
        options: further keywords of ``gymnasium.make``, such as ``reward`` or ``opponent``.

    Raises:
        UsageError: the request cannot be met, or ``output`` holds another evaluation. Nothing was written.
    """
    task = find_task(task)
    chosen = make_agent(agent, task) if isinstance(agent, str | Path) else _checked(agent)
    keywords = env_keywords(chosen, {**options, "split": split, "heuristic": heuristic})
    checked = options_of(task, keywords)
    resolve_reward(keywords.get("reward", "default"))
    chosen_scenarios = _checked_scenarios(task, split, months, scenarios)
    jobs = _jobs(chosen_scenarios, seeds, start)
    _check_lengths(task, chosen_scenarios, start, keywords.get("episode_length"))
    processes = _number_of_workers(workers, checked.engine, agent, len(jobs))
    if output is not None:
        check_folder(output)  # before months are made, which takes minutes
    # The agent whose identity is stored, not its path: a run that still trains replaces the file.
    setting = Setting(task.id, chosen, keywords, episodes_abreast(chosen, checked))
    made, total = make_scenarios(task.grid_id, chosen_scenarios)
    there = next(made)
    if there < total:  # what the agent refuses, likewise; workers are sent the agent, which is not to be bound then
        (copy.deepcopy(setting) if processes else setting).player(1).close()
    watch_making(task.grid_id, itertools.chain((there,), made), total, progress)
    return run_evaluation(
        setting,
        jobs,
        identity=_identity(task, chosen, printable(name or chosen.name), keywords, start, chosen_scenarios),
        command=command or _call(agent, task, keywords, months, scenarios, seeds, start, name),
        workers=processes,
        output=output,
        progress=progress,
    )


def check_playable(agent: Agent, task: Task, options: Mapping[str, Any]) -> None:
    """Bind an agent to an environment, as playing would: what it refuses is known before months are made or played.

    Args:
        agent: is bound afterwards, and not to be played.
        task: the task.
        options: keywords of the environment, as :func:`evaluate` takes them.

    Raises:
        UsageError: the agent cannot play the task, or not with these options.
    """
    keywords = env_keywords(agent, {"heuristic": AS_TRAINED, **options})
    Setting(task.id, agent, keywords).player(1).close()


def first_months(task: Task, split: str, months: int | None) -> tuple[str, ...]:
    """The first scenarios of a split, of all seasons alike; ``months`` None: all.

    Raises:
        UsageError: no such split, or a number of months below 1 or above what there is.
    """
    listed = list_scenarios(task.grid_id, split)
    if months is not None and (not isinstance(months, int) or not 1 <= months <= len(listed)):
        raise UsageError(
            f"months={months!r} is not allowed: the split {split} of {task.grid_id} has {len(listed)}; give a number "
            f"from 1 to {len(listed)}."
        )
    return listed[:months]


def at_most(task: Task, split: str, months: int | None) -> tuple[str, ...]:
    """:func:`first_months` of a number that nobody asked for: all where there are fewer.

    Raises:
        UsageError: no such split, or a number of months below 1.
    """
    return first_months(task, split, None if months is None else min(months, len(list_scenarios(task.grid_id, split))))


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
    words = f"Evaluating {setting.agent.name}"
    with open_store(output, request, command) as store, show_progress(words, jobs, progress) as display:
        done = {_job(episode): episode for episode in store.episodes}
        display.skip(done)
        missing = [job for job in jobs if job not in done]
        if missing:
            with make_crew(setting, workers) as crew:
                for job, played in crew.play(missing, display.advance):
                    episode = replace(played, **of_all)
                    store.add(episode)
                    display.finish(job, episode.grid_steps)
                    done[job] = episode
        episodes = tuple(done[job] for job in jobs)
        store.finish(episodes)
    return Evaluation(episodes, identity, command, output)


def env_keywords(agent: Agent, keywords: dict[str, Any]) -> dict[str, Any]:
    """Keywords of the environments: those given, else what the policy was trained with, else the defaults."""
    trained: Mapping[str, Any] = getattr(agent, "env_keywords", {})
    if keywords["heuristic"] == AS_TRAINED:
        keywords["heuristic"] = trained.get("heuristic")
    for name in OBSERVED_WITH:
        if name in trained:
            keywords.setdefault(name, trained[name])
    unknown = sorted(set(keywords) - set(TaskOptions.__dataclass_fields__))
    if unknown:
        allowed = ", ".join(TaskOptions.__dataclass_fields__)
        raise UsageError(f"Option {unknown[0]!r} does not exist: choose from {allowed}.")
    TaskOptions(**keywords)
    return keywords


def _checked(agent: Agent) -> Agent:
    if isinstance(agent, type) or not isinstance(agent, Agent):
        raise UsageError(
            f"Agent {agent!r} is none: give a name, a path, or what has a name and the methods bind, reset and act."
        )
    return agent


def _number_of_workers(workers: int | None, engine: str, agent: str | Path | Agent, n_jobs: int) -> int:
    if workers is None:
        # Few native episodes are over before another process has started, and an agent of the caller's own script may
        # not be known there.
        is_here = engine == "native" and (n_jobs < _MANY_JOBS or not isinstance(agent, str | Path))
        return 0 if is_here else os.cpu_count() or 1
    if not isinstance(workers, int) or workers < 0:
        raise UsageError(f"workers={workers!r} is not allowed: give a number of processes, 0 or more.")
    return workers


def _checked_scenarios(task: Task, split: str, months: int | None, scenarios: Sequence[str] | None) -> tuple[str, ...]:
    if scenarios is None:
        return first_months(task, split, months)
    if months is not None:
        raise UsageError(f"months={months!r} and scenarios exclude each other: give one of them.")
    if not scenarios:
        raise UsageError(f"No scenario was given: name some of the split {split} of {task.grid_id}, or leave it out.")
    for scenario in scenarios:
        check_in_split(task.grid_id, split, scenario)
    return tuple(scenarios)


def _check_lengths(task: Task, scenarios: Sequence[str], start: int, episode_length: int | None) -> None:
    """Refuse an episode that does not fit into some scenario, before anything is played."""
    if episode_length is None:
        return
    for scenario in scenarios:
        # A generated month has as many steps as an episode at most, and need not be made to know it.
        whole = scenario.startswith("generated/") and "[" not in scenario
        check_length(
            scenario, MAX_STEPS if whole else load_scenario(task.grid_id, scenario).n_steps, episode_length, start
        )


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
    options["reward"] = reward_name(reward) if callable(reward) else reward
    return {
        **{key: value for key, value in options.items() if key not in ("scenario", "gamma")},
        "constraint": constraint_of(task, options["constraint"]),
        "start": start,
        "grid_hash": task.grid.hash,
        "generator_version": generator_version(task.grid_id, options["split"]),
        "split_version": split_version(task.grid_id, options["split"]),
        "scenario_pack_hash": scenario_pack_hash(task.grid_id, options["split"], scenarios),
        "action_set_hash": action_set_hash(task.grid, task.level) if task.changes_topology else None,
    }


def _call(
    agent: str | Path | Agent,
    task: Task,
    keywords: Mapping[str, Any],
    months: int | None,
    scenarios: Sequence[str] | None,
    seeds: Sequence[int],
    start: int,
    name: str | None,
) -> str:
    shown = repr(str(agent)) if isinstance(agent, str | Path) else f"<{agent.name}>"
    arguments: dict[str, Any] = {**keywords, "seeds": list(seeds)}
    if months is not None:
        arguments["months"] = months
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
