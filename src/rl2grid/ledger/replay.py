"""Playing the episodes of an evaluation again.

An episode is a function of task, options, scenario, seed and actions. Whoever has those can play it without the agent
and must find the same numbers, to the last bit, with the same versions of the libraries on the same kind of processor.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import gymnasium

from rl2grid.agents.agent import Action, Agent, Info
from rl2grid.envs.options import TaskOptions, changed_options
from rl2grid.envs.registration import register_all
from rl2grid.envs.tasks import Task
from rl2grid.errors import UsageError
from rl2grid.evaluation.episode import play_episode
from rl2grid.evaluation.protocol import question
from rl2grid.mdp.rewards import resolve_reward
from rl2grid.records.entries import episode_hash, facts_of
from rl2grid.records.episodes import Episode
from rl2grid.records.versions import library_versions

OnProgress = Callable[[float], None]
"""Told how many episodes were played, the share of the current one included."""

_KEYWORDS = tuple(field.name for field in fields(TaskOptions) if field.name not in ("scenario", "gamma"))


@contextmanager
def environment(task: Task, keywords: Mapping[str, Any]) -> Iterator[gymnasium.Env[Any, Any]]:
    """An environment to play episodes again in, closed at the end."""
    register_all()
    env: gymnasium.Env[Any, Any] = gymnasium.make(task.id, disable_env_checker=True, **changed_options(keywords))
    try:
        yield env
    finally:
        env.close()


def play_again(
    agent: Agent, env: gymnasium.Env[Any, Any], asked: Episode, kept: list[Action], tell: OnProgress
) -> Episode:
    """Play an episode again and keep the actions."""

    def note(action: Action, info: Info) -> None:
        kept.append(copy.deepcopy(action))
        tell(int(info["step"]) / int(info["episode_length"]))

    return play_episode(agent, env, scenario=asked.scenario, seed=asked.seed, start=asked.start, on_decision=note)


def after(played: int, on_progress: OnProgress) -> OnProgress:
    """What to tell of an episode that comes after ``played`` others."""
    return lambda share: on_progress(played + share)


def difference(stored: Episode, played: Episode) -> str:
    """What is not the same, in words; nothing if all is."""
    then, now = facts_of(stored), facts_of(played)
    for name in ("survival", *then):
        if then[name] != now[name]:
            return f"its {name} is stored as {then[name]!r}, played again it is {now[name]!r}"
    again = episode_hash({name: now[name] for name in then})
    if episode_hash(then) != again:
        return f"its hash is stored as {episode_hash(then)}, played again it is {again}"
    return ""


def other_versions(identity: Mapping[str, Any]) -> str:
    """Where versions are not those of the identity, these versions in brackets."""
    here, there = library_versions(), identity.get("versions", {})
    other = [f"{name} {there.get(name)} then, {here.get(name)} now" for name in here if here[name] != there.get(name)]
    return f" ({'; '.join(other)})" if other else ""


def keywords_of(identity: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Keywords of the environments of an evaluation."""
    try:
        # What names no length was played at the default one.
        keywords = {key: {"episode_length": None, **identity}[key] for key in _KEYWORDS}
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


def check_question(
    task: Task, keywords: Mapping[str, Any], identity: Mapping[str, Any], scenarios: tuple[str, ...], name: str
) -> None:
    """Refuse to play again what asked something else than it would ask here.

    Raises:
        UsageError: what is different.
    """
    here = question(task, keywords, identity["start"], scenarios)
    for key, value in json.loads(json.dumps(here)).items():
        if identity.get(key) != value:
            raise UsageError(
                f"{name} cannot be played: its {key} is {identity.get(key)!r}, that of this installation is {value!r}."
            )


def scenarios_of(episodes: tuple[Episode, ...]) -> tuple[str, ...]:
    """Months of episodes, in order of appearance."""
    return tuple(dict.fromkeys(episode.scenario for episode in episodes))
