"""Making entries of a leaderboard, and playing their actions again.

An episode is a function of task, options, scenario, seed and actions. Whoever has those can play it without the agent
and must find the same numbers, to the last bit, with the same versions of the libraries on the same kind of processor.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from rl2grid.agents.agent import Action, Agent, Info, Observation
from rl2grid.envs.options import TaskOptions
from rl2grid.envs.registration import register_all
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import AGENTS, make_agent
from rl2grid.evaluation.episode import play_episode
from rl2grid.evaluation.protocol import question
from rl2grid.mdp.rewards import resolve_reward
from rl2grid.records.collection import CELL_FILE, EVALUATION_FOLDER, RUN_FOLDER, find_evaluations
from rl2grid.records.entries import (
    Actions,
    Entry,
    PlayedActions,
    action_dtype,
    episode_hash,
    facts_of,
)
from rl2grid.records.episodes import Episode
from rl2grid.records.evaluations import EVALUATION_FILE, Evaluation, load_evaluation
from rl2grid.records.trainings import RUN_FILE
from rl2grid.records.versions import library_versions
from rl2grid.scenarios.library import check_in_split
from rl2grid.training.energy import ENERGY_FILE

OnProgress = Callable[[float], None]
"""Told how many episodes were played, the share of the current one included."""

_KEYWORDS = tuple(field.name for field in fields(TaskOptions) if field.name not in ("scenario", "gamma"))


def find_evaluation(folder: Path, split: str) -> Path:
    """The one evaluation that ``folder`` is, or that the run or cell of a study in it has on ``split``.

    Raises:
        UsageError: there is none, or more than one.
    """
    if (folder / CELL_FILE).is_file() and (folder / EVALUATION_FOLDER / EVALUATION_FILE).is_file():
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
) -> Entry:
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
    player = _find_agent(result, run, agent)
    keywords = _keywords(result.identity, str(evaluation))
    task = find_task(result.identity["task"])
    _check_question(task, keywords, result.identity, _scenarios(result.episodes), str(evaluation))
    played = []
    with _environment(task, keywords) as env:
        player.bind(env)
        for number, episode in enumerate(result.episodes):
            kept: list[Action] = []
            again = _play(player, env, episode, kept, _after(number, on_progress))
            difference = _difference(episode, again)
            if difference:
                raise UsageError(
                    f"Episode {episode.scenario}, seed {episode.seed} of {evaluation} is played differently now: "
                    f"{difference}{_other_versions(result.identity)}."
                )
            played.append(PlayedActions(again, _as_array(kept, task)))
    on_progress(len(played))
    return Entry(
        label or result.episodes[0].agent,
        result.identity,
        result.command,
        None if run is None or agent is not None else _training_facts(run),
        tuple(played),
    )


def check_entry(entry: Entry, name: str) -> None:
    """Refuse an entry that cannot be played here, or that is about other data or actions.

    Args:
        entry: as it was read.
        name: what messages call it.

    Raises:
        UsageError: what is different.
    """
    task, keywords = find_task(entry.identity["task"]), _keywords(entry.identity, name)
    scenarios = _scenarios(entry.evaluation.episodes)
    for scenario in scenarios:
        try:
            check_in_split(task.grid_id, keywords["split"], scenario)
        except UsageError as error:
            raise UsageError(f"{name} cannot be played: {error}") from None
    _check_question(task, keywords, entry.identity, scenarios, name)
    for episode in entry.episodes:
        _check_actions(episode, task, name)
        if episode.episode.start != entry.identity["start"]:
            raise UsageError(f"{name} was changed: episode {episode.name} begins at another row.")


def verify_entry(entry: Entry, on_progress: OnProgress = lambda played: None) -> str | None:
    """Play the stored actions again.

    Args:
        entry: one that :func:`check_entry` accepts.
        on_progress: told how far it is.

    Returns:
        Which episode differs, and how; None if all are exactly as stored.
    """
    task = find_task(entry.identity["task"])
    with _environment(task, _keywords(entry.identity, "")) as env:
        for number, stored in enumerate(entry.episodes):
            agent = _StoredActions(stored.actions)
            try:
                again = _play(agent, env, stored.episode, [], _after(number, on_progress))
            except _NoMoreActionsError:
                return f"Episode {stored.name} goes on after its {len(stored.actions)} stored actions"
            except UsageError as error:
                return f"Episode {stored.name} cannot be played: {str(error).removesuffix('.')}"
            difference = _difference(stored.episode, again)
            if difference:
                return f"Episode {stored.name} differs: {difference}{_other_versions(entry.identity)}"
    on_progress(len(entry.episodes))
    return None


class _NoMoreActionsError(Exception):
    """An episode asks for more actions than are stored."""


class _StoredActions:
    """Plays actions in the order in which they are stored."""

    name = "stored actions"

    def __init__(self, actions: Actions) -> None:
        self._actions = iter(actions)

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Nothing to look at."""

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation, info: Info) -> Action:
        """The next action, whatever is observed."""
        action = next(self._actions, None)
        if action is None:
            raise _NoMoreActionsError
        return int(action) if np.ndim(action) == 0 else action


def _after(played: int, on_progress: OnProgress) -> OnProgress:
    """What to tell of an episode that comes after ``played`` others."""
    return lambda share: on_progress(played + share)


def _play(agent: Agent, env: gymnasium.Env[Any, Any], asked: Episode, kept: list[Action], tell: OnProgress) -> Episode:
    """Play an episode again and keep the actions."""

    def note(action: Action, info: Info) -> None:
        kept.append(np.array(action))
        tell(int(info["step"]) / int(info["episode_length"]))

    return play_episode(agent, env, scenario=asked.scenario, seed=asked.seed, start=asked.start, on_decision=note)


def _difference(stored: Episode, played: Episode) -> str:
    """What is not the same, in words; nothing if all is."""
    then, now = facts_of(stored), facts_of(played)
    for name in ("survival", *then):
        if then[name] != now[name]:
            return f"its {name} is stored as {then[name]!r}, played again it is {now[name]!r}"
    if episode_hash(then) != episode_hash(now):
        return f"its hash is stored as {episode_hash(then)}, played again it is {episode_hash(now)}"
    return ""


def _other_versions(identity: Mapping[str, Any]) -> str:
    """Where versions are not those of the identity, these versions in brackets."""
    here, there = library_versions(), identity.get("versions", {})
    other = [f"{name} {there.get(name)} then, {here.get(name)} now" for name in here if here[name] != there.get(name)]
    return f" ({'; '.join(other)})" if other else ""


def _check_question(
    task: Task, keywords: Mapping[str, Any], identity: Mapping[str, Any], scenarios: tuple[str, ...], name: str
) -> None:
    here = question(task, keywords, identity["start"], scenarios)
    for key, value in json.loads(json.dumps(here)).items():
        if identity.get(key) != value:
            raise UsageError(
                f"{name} cannot be played: its {key} is {identity.get(key)!r}, that of this installation is {value!r}."
            )


def _check_actions(episode: PlayedActions, task: Task, name: str) -> None:
    actions = episode.actions
    if task.kind == "T":
        fits = actions.ndim == 1 and actions.dtype.kind == "u" and bool((actions < task.n_actions).all())
        allowed = f"ids of 0 to {task.n_actions - 1}"
    else:
        fits = actions.shape[1:] == (task.n_actions,) and actions.dtype == np.float32
        fits = fits and bool((np.abs(actions) <= 1).all())
        allowed = f"float32 of {task.n_actions} values between -1 and 1"
    if not fits:
        raise UsageError(f"{name} was changed: actions of the episode {episode.name} are not {allowed}.")


def _as_array(kept: list[Action], task: Task) -> Actions:
    if task.kind == "T":
        return np.array(kept, dtype=np.int64).astype(action_dtype(task.n_actions))
    return np.array(kept, dtype="<f4").reshape(len(kept), task.n_actions)


def _keywords(identity: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Keywords of the environments of an evaluation."""
    try:
        keywords = {key: identity[key] for key in _KEYWORDS}
    except KeyError as error:
        raise UsageError(f"{name} cannot be played: its identity has no {error.args[0]}.") from None
    reward = keywords["reward"]
    keywords["reward"] = tuple(reward) if isinstance(reward, list) else reward
    if isinstance(reward, str) and "." in reward:
        raise UsageError(f"{name} cannot be played: its reward is the function {reward}, which no file can hold.")
    try:
        TaskOptions(**keywords)
        resolve_reward(keywords["reward"])
    except (UsageError, TypeError, ValueError) as error:
        raise UsageError(f"{name} cannot be played: {error}") from None
    return keywords


def _scenarios(episodes: tuple[Episode, ...]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(episode.scenario for episode in episodes))


def _run_around(evaluation: Path) -> Path | None:
    """The run that an evaluation lies in, or beside in a cell of a study."""
    above = evaluation.resolve().parent
    for folder in (above.parent, above / RUN_FOLDER):
        if (folder / RUN_FILE).is_file():
            return folder
    return None


def _find_agent(result: Evaluation, run: Path | None, agent: str | None) -> Agent:
    identity, task = result.identity, result.identity["task"]
    if agent is not None:
        candidates: list[str | Path] = [agent]
    elif run is not None:
        candidates = [path for path in sorted(run.glob("*.pt")) if path.is_file()]
    elif identity["agent"] in AGENTS:
        candidates = [str(identity["agent"])]
    else:
        raise UsageError(f"Agent {identity['agent']!r} of {result.folder} was not found: name it with --agent.")
    for candidate in candidates:
        made = make_agent(candidate, task)
        if json.loads(json.dumps(getattr(made, "identity", None))) == identity["agent_identity"]:
            return made
    looked = " or ".join(map(str, candidates)) or f"in {run}"
    raise UsageError(
        f"The agent that was evaluated in {result.folder} is not {looked} as it is now: name it with --agent, or "
        "evaluate again."
    )


def _training_facts(run: Path) -> dict[str, Any]:
    # Imported here: agents without training do without torch.
    from rl2grid.training.commands import training_command

    config = json.loads((run / RUN_FILE).read_text(encoding="utf-8"))
    request = config["request"]
    energy = run / ENERGY_FILE
    account = json.loads(energy.read_text(encoding="utf-8")) if energy.is_file() else {}
    return {
        "algorithm": request["algorithm"],
        "hyperparameters": request["hyperparameters"],
        "env_keywords": request["env_keywords"],
        "identity": config["identity"],
        "command": training_command(run),
        "energy": {key: value for key, value in account.items() if key not in ("assumptions", "parts")} or None,
    }


@contextmanager
def _environment(task: Task, keywords: Mapping[str, Any]) -> Iterator[gymnasium.Env[Any, Any]]:
    register_all()
    env: gymnasium.Env[Any, Any] = gymnasium.make(task.id, disable_env_checker=True, **keywords)
    try:
        yield env
    finally:
        env.close()
