"""Plays one episode to be watched: any agent, recorded step by step."""

from __future__ import annotations

import gymnasium

from rl2grid.envs.registration import register_all
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent
from rl2grid.evaluation.protocol import AS_TRAINED, env_keywords
from rl2grid.evaluation.recording import OnStep, record_episode
from rl2grid.records.recordings import Recording
from rl2grid.scenarios.library import check_in_split, list_scenarios


def play_to_watch(
    agent: str,
    task: Task | str,
    *,
    split: str = "validation",
    scenario: str | None = None,
    seed: int = 0,
    heuristic: str | None = AS_TRAINED,
    steps: int | None = None,
    top_k: int | None = None,
    rehearse: int | None = None,
    on_step: OnStep | None = None,
) -> Recording:
    """Play and record one episode; it is the one that an evaluation with the same seed plays.

    Args:
        agent: a name, run folder, checkpoint or agent of one's own; see :func:`rl2grid.evaluation.agents.make_agent`.
        task: the task, or its id, whose namespace and version may be left out.
        split: whose scenario is played.
        scenario: None: the first of the split.
        seed: of maintenance, opponent and agent.
        heuristic: None, one of :data:`rl2grid.engines.HEURISTICS`, or the one that the policy was trained with.
        steps: record no more grid steps than these.
        top_k: of a policy: how many of its best actions the what-if compares; None: it plays its best.
        rehearse: of a policy: how many grid steps of a crisis are played in imagined worlds first; None: none are.
        on_step: called after every grid step.

    Raises:
        UsageError: the request cannot be met; nothing was played.
    """
    task = find_task(task)
    if steps is not None and steps < 1:
        raise UsageError(f"steps={steps} is not allowed: give a number of grid steps, at least 1.")
    if seed < 0:
        raise UsageError(f"seed={seed} is not allowed: give an integer that is not negative.")
    chosen = make_agent(agent, task, top_k=top_k, rehearse=rehearse)
    keywords = env_keywords(chosen, {"split": split, "heuristic": heuristic})
    if scenario is None:
        scenario = list_scenarios(task.grid_id, split)[0]
    check_in_split(task.grid_id, split, scenario)
    register_all()
    env = gymnasium.make(task.id, disable_env_checker=True, **keywords)
    try:
        chosen.bind(env)
        return record_episode(chosen, env, scenario=scenario, seed=seed, steps=steps, on_step=on_step)
    finally:
        env.close()
