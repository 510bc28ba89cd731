"""Policies that come with the package: what their cards say is true of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import pytest

import rl2grid
from rl2grid.algorithms.policy_agent import PolicyAgent
from rl2grid.algorithms.pretrained import LARGEST, ModelCard, Survival, cards
from rl2grid.cli.main import main
from rl2grid.envs.registration import register_all
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.evaluation.agents import make_agent

PAGE = Path(__file__).resolve().parents[2] / "docs" / "algorithms" / "pretrained.md"
EVERY = pytest.mark.parametrize("card", cards(), ids=lambda card: card.name)


def words(of: Survival) -> str:
    return f"{of.survival:.3f} [{of.low:.3f}, {of.high:.3f}]"


def row(card: ModelCard) -> str:
    """The row of the page."""
    own, *others = card.validation
    looking = [each for each in others if each.agent.startswith(own.agent)]
    beside = ", ".join(f"{each.agent} {each.survival:.3f}" for each in others if each not in looking)
    looked = ", ".join(f"{each.agent.removeprefix(f'{own.agent}, ')}: {words(each)}" for each in looking)
    return f"| `{card.name}` | {card.algorithm} | {words(own)} | {looked} | {beside} | {own.months} |"


@EVERY
def test_it_is_the_policy_that_its_card_says_and_plays(card: ModelCard):
    assert card.file.stat().st_size <= LARGEST
    agent = rl2grid.load(f"pretrained/{card.name}")
    assert agent.identity["policy_hash"] == card.policy_hash
    assert agent.identity["algorithm"] == card.algorithm
    assert agent.task == find_task(card.task).id
    assert agent.env_keywords.get("heuristic") == card.heuristic
    register_all()
    env = gymnasium.make(agent.task, **agent.env_keywords)
    agent.bind(env)
    observation, info = env.reset(seed=5)
    agent.reset(0)
    for _ in range(3):
        if info["over"]:
            break
        observation, _, _, _, info = env.step(agent.act(observation, info))
    env.close()


@EVERY
def test_the_page_says_what_the_card_says(card: ModelCard):
    assert row(card) in PAGE.read_text(encoding="utf-8").splitlines()


def test_a_folder_of_the_same_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    agent = make_agent("pretrained/bus14-T0")
    assert isinstance(agent, PolicyAgent)
    assert agent.name == "pretrained-bus14-T0"
    (tmp_path / "pretrained" / "bus14-T0").mkdir(parents=True)
    with pytest.raises(UsageError, match="holds no policy"):
        make_agent("pretrained/bus14-T0")


def test_others_are_refused_with_the_names_that_there_are():
    with pytest.raises(UsageError, match=r"Pretrained policy 'pretrained/bus14-T9' .*pretrained/bus14-T0"):
        rl2grid.load("pretrained/bus14-T9")
    with pytest.raises(UsageError, match="is of task"):
        make_agent("pretrained/bus14-T0", find_task("bus14-T1"))


def test_the_command_lists_them_and_tells_the_card_of_one(capsys: Any):
    assert main(["pretrained"]) == 0
    listed = capsys.readouterr().out
    assert all(f"pretrained/{card.name}" in listed for card in cards())
    lines = {line.split()[0]: line for line in listed.splitlines() if line.startswith("pretrained/")}
    assert "0.794 best of 100" in lines["pretrained/bus118-MOB-v1-H1"]
    assert "best of" not in lines["pretrained/bus36-MO-v0-T0"]  # it survives less long so
    assert main(["pretrained", "pretrained/bus14-T0"]) == 0
    told = capsys.readouterr().out
    assert "rl2grid teach greedy bus14-T0" in told
    assert "Limits: " in told
