"""Making entries of a leaderboard: an evaluation is played again with its agent, and the actions are kept."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from rl2grid.agents.agent import Action, Agent
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import AGENTS, make_agent
from rl2grid.evaluation.flags import LOOKING
from rl2grid.evaluation.own_agents import is_own
from rl2grid.ledger.replay import (
    OnProgress,
    after,
    check_question,
    difference,
    environment,
    keywords_of,
    other_versions,
    play_again,
    scenarios_of,
)
from rl2grid.mdp.actions import INJECTION, TOPOLOGY
from rl2grid.records.collection import find_evaluations
from rl2grid.records.entries import Actions, PlayableEntry, PlayedActions, action_dtype
from rl2grid.records.evaluations import Evaluation, is_evaluation, load_evaluation
from rl2grid.records.studies import EVALUATION_FOLDER, RUN_FOLDER, read_cell
from rl2grid.records.trainings import is_run, read_configuration, read_energy


def find_evaluation(folder: Path, split: str) -> Path:
    """The one evaluation that ``folder`` is, or that the run or cell of a study in it has on ``split``.

    Raises:
        UsageError: there is none, or more than one.
    """
    if read_cell(folder) is not None and is_evaluation(folder / EVALUATION_FOLDER):
        return folder / EVALUATION_FOLDER
    found = find_evaluations(folder, split)
    if not found:
        raise UsageError(f"{folder} holds no evaluation on {split}: give a folder that 'rl2grid evaluate' wrote.")
    if len(found) > 1:
        raise UsageError(f"{folder} holds several evaluations: give one of {', '.join(map(str, found))}.")
    return found[0]


def make_entry(
    evaluation: Path,
    *,
    agent: str | None = None,
    label: str | None = None,
    on_progress: OnProgress = lambda played: None,
) -> PlayableEntry:
    """Play the episodes of an evaluation again with its agent, and keep the actions.

    Args:
        evaluation: folder of the evaluation.
        agent: a name, run folder or checkpoint; None: the run around the evaluation, else the agent that it names.
        label: what tables call the agent; None: as in the evaluation.
        on_progress: told how far it is.

    Raises:
        UsageError: the agent is not there, is another one by now, or plays differently now.
    """
    result = load_evaluation(evaluation)
    run = _run_around(evaluation)
    task = find_task(result.identity["task"])
    player = _find_agent(result, task, run, agent)
    keywords = keywords_of(result.identity, str(evaluation))
    check_question(task, keywords, result.identity, scenarios_of(result.episodes), str(evaluation))
    played = []
    with environment(task, keywords) as env:
        player.bind(env)
        for number, episode in enumerate(result.episodes):
            kept: list[Action] = []
            again = play_again(player, env, episode, kept, after(number, on_progress))
            found = difference(episode, again)
            if found:
                raise UsageError(
                    f"Episode {episode.scenario}, seed {episode.seed} of {evaluation} is played differently now: "
                    f"{found}{other_versions(result.identity)}."
                )
            played.append(PlayedActions(again, _as_array(kept, task)))
    on_progress(len(played))
    return PlayableEntry(
        label or result.episodes[0].agent,
        result.identity,
        result.command,
        None if run is None or agent is not None else _training_facts(run),
        tuple(played),
    )


def _run_around(evaluation: Path) -> Path | None:
    """The run that an evaluation lies in, or beside in a cell of a study."""
    above = evaluation.resolve().parent
    for folder in (above.parent, above / RUN_FOLDER):
        if is_run(folder):
            return folder
    return None


def _find_agent(result: Evaluation, task: Task, run: Path | None, agent: str | None) -> Agent:
    identity = result.identity
    if agent is not None:
        candidates: list[str | Path] = [agent]
    elif run is not None:
        candidates = [path for path in sorted(run.glob("*.pt")) if path.is_file()]
    elif identity["agent"] in AGENTS:
        candidates = [str(identity["agent"])]
    else:
        raise UsageError(f"Agent {identity['agent']!r} of {result.folder} was not found: name it with --agent.")
    stored = identity["agent_identity"]
    for candidate in candidates:
        made = make_agent(candidate, task, **_looking(stored, candidate))
        if json.loads(json.dumps(getattr(made, "identity", None))) == stored:
            return made
    looked = " or ".join(map(str, candidates)) or f"in {run}"
    raise UsageError(
        f"The agent that was evaluated in {result.folder} is not {looked} as it is now: name it with --agent, or "
        "evaluate again."
    )


def _looking(stored: Any, candidate: str | Path) -> dict[str, int]:
    """How a policy looked before it acted; empty where it did not, or the candidate is no policy."""
    if not isinstance(stored, dict) or candidate in AGENTS or is_own(str(candidate)):
        return {}
    return {name: stored[name] for name in LOOKING if name in stored}


def _training_facts(run: Path) -> dict[str, Any]:
    # Imported here: agents without training do without torch.
    from rl2grid.training.commands import training_command

    config = read_configuration(run)
    request = config["request"]
    account = read_energy(run) or {}
    return {
        "algorithm": request["algorithm"],
        "hyperparameters": request["hyperparameters"],
        "env_keywords": request["env_keywords"],
        "identity": config["identity"],
        "command": training_command(run),
        "energy": {key: value for key, value in account.items() if key not in ("assumptions", "parts")} or None,
    }


def _as_array(kept: list[Action], task: Task) -> Actions:
    if task.kind == "T":
        return np.array(kept, dtype=np.int64).astype(action_dtype(task.n_actions))
    rows = [np.append(action[TOPOLOGY], action[INJECTION]) for action in kept] if task.kind == "H" else kept
    return np.array(rows, dtype="<f4").reshape(len(rows), task.n_injections + (task.kind == "H"))
