"""Who looks into the true future is marked; who imagines one is an agent like any other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rl2grid.errors import UsageError
from rl2grid.evaluation.protocol import evaluate
from rl2grid.records.entries import PlayableEntry, PlayedActions, episode_hash, facts_of, read_entry, write_entry
from rl2grid.records.episodes import read_episodes
from rl2grid.records.evaluations import check_comparable
from rl2grid.records.methods import group_methods

SCENARIO = "bundled/0000"
DECISIONS = 6


class Idle:
    """Does nothing for some decisions, then takes lines out until the grid is lost, which makes the episode short."""

    name = "idle"

    def bind(self, env: Any) -> None:
        self.env = env.unwrapped

    def reset(self, i: int) -> None:
        self.decisions = 0

    def act(self, observation: Any, info: Any) -> int:
        self.decisions += 1
        self.think()
        return 0 if self.decisions <= DECISIONS else self.decisions

    def think(self) -> None:
        """Look at nothing."""


class Oracle(Idle):
    """Steps the true world, and comes back."""

    name = "oracle"

    def think(self) -> None:
        world = self.env.save()
        self.env.step(0)
        self.env.restore(world)


class Dreamer(Idle):
    """Steps imagined worlds in place, and comes back."""

    name = "dreamer"

    def think(self) -> None:
        world = self.env.save()
        self.env.restore(self.env.imagine(self.decisions))
        self.env.step(0)
        self.env.restore(world)


class Sleeper(Idle):
    """Stays in an imagined world."""

    name = "sleeper"

    def think(self) -> None:
        self.env.restore(self.env.imagine(0))


def evaluated(agent: Any, **keywords: Any) -> Any:
    return evaluate(agent, "bus14-T0", split="bundled", scenarios=[SCENARIO], workers=0, **keywords)


def what_happened(result: Any) -> dict[str, Any]:
    return facts_of(result.episodes[0])


def test_stepping_a_saved_true_world_is_stored_and_never_ranked_with_others(tmp_path):
    oracle, idle = evaluated(Oracle(), output=tmp_path / "oracle"), evaluated(Idle())
    assert oracle.episodes[0].foresight == oracle.episodes[0].decisions
    assert oracle.foresight
    assert not idle.foresight
    assert read_episodes(tmp_path / "oracle" / "episodes.csv") == oracle.episodes
    # Knowing the future did not change it.
    assert what_happened(oracle) == what_happened(idle)
    with pytest.raises(UsageError, match="oracle stepped saved true worlds, which know the future, idle did not"):
        check_comparable([idle, oracle])
    with pytest.raises(UsageError, match="with and without foresight"):
        group_methods([oracle, idle])
    (method,) = group_methods([oracle])[oracle.identity["task"]]
    assert method.label == "oracle (with foresight)"


def test_imagining_in_place_is_no_foresight_and_changes_nothing():
    dreamer, idle = evaluated(Dreamer()), evaluated(Idle())
    assert not dreamer.foresight
    assert what_happened(dreamer) == what_happened(idle)
    check_comparable([dreamer, idle])


def test_an_agent_that_stays_in_an_imagined_world_is_refused():
    with pytest.raises(UsageError, match="sleeper left the environment in an imagined world"):
        evaluated(Sleeper())


def test_an_entry_keeps_the_foresight_of_its_episodes(tmp_path):
    result = evaluated(Oracle())
    episode = result.episodes[0]
    actions = [0] * min(DECISIONS, episode.decisions)
    actions += range(DECISIONS + 1, episode.decisions + 1)
    kept = PlayedActions(episode, np.array(actions, np.uint8))
    write_entry(tmp_path / "entry.json", PlayableEntry("oracle", result.identity, result.command, None, (kept,)))
    stored = read_entry(tmp_path / "entry.json")
    assert stored.evaluation.foresight
    assert stored.evaluation.episodes[0] == replace(episode, wall_time_s=0.0)
    # Without foresight an entry is what it was, and taking the mark away shows.
    assert episode_hash(facts_of(episode)) != episode_hash(facts_of(episode), episode.foresight)
    text = (tmp_path / "entry.json").read_text()
    (tmp_path / "entry.json").write_text(text.replace(f'"foresight": {episode.foresight},', ""))
    with pytest.raises(UsageError, match="was changed"):
        read_entry(tmp_path / "entry.json")
