"""Keywords of ``gymnasium.make`` as flags."""

from __future__ import annotations

import argparse
from typing import Any

from rl2grid.envs.options import option_texts, options_without
from rl2grid.errors import UsageError
from rl2grid.evaluation.flags import LOOKING, flag_of
from rl2grid.mdp.rewards import resolve_reward

GIVEN_OTHERWISE = ("split", "scenario", "gamma")
"""Keywords that a command gives itself, or asks for in another way."""
NAMES: tuple[str, ...] = tuple(option.name for option in options_without(*GIVEN_OTHERWISE))
"""Keywords that are flags."""


AGENT_HELP = (
    "do-nothing, random, recovery, greedy, greedy-n1, milp, dc-opf, planner, planner-open, rehearsal, foresight, a run "
    "folder or checkpoint, pretrained/NAME, or one of your own as package.module:Agent or ./agent.py"
)
"""What is played; a test compares it with the agents that there are."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add a flag for each of :data:`NAMES`; those that are not given leave no trace."""
    group = parser.add_argument_group(
        "environment",
        "keywords of the environment; the heuristic and what is observed are by default those of a trained policy",
    )
    for option in options_without(*GIVEN_OTHERWISE):
        choices = option.metadata.get("choices")
        how: dict[str, Any] = {"choices": tuple(map(str, choices))} if choices else {"metavar": option.name.upper()}
        if isinstance(option.default, bool):
            how = {"action": argparse.BooleanOptionalAction}
        group.add_argument(
            f"--{flag_of(option.name)}",
            default=argparse.SUPPRESS,
            help=flag_text(option.name).replace("%", "%%"),
            **how,
        )


def add_looking(parser: argparse.ArgumentParser, others: str = "") -> None:
    """Add the flags that say how a policy looks before it acts; ``others`` follows their help."""
    for name, metavar, text in (
        (
            "top-k",
            "K",
            "of policies: the what-if chooses of K, their best actions or, of continuous ones, around the best",
        ),
        ("rehearse", "STEPS", "of policies: so much of a crisis, 24 for instance, is played in imagined worlds first"),
    ):
        parser.add_argument(f"--{name}", type=int, default=None, metavar=metavar, help=text + others)


def looking(options: argparse.Namespace) -> dict[str, int]:
    """How policies are to look before they act: what was given of :data:`rl2grid.evaluation.flags.LOOKING`."""
    return {name: value for name in LOOKING if (value := getattr(options, name)) is not None}


def flag_text(name: str) -> str:
    """What a keyword means, for the help of its flag."""
    declared = {option.name: option for option in options_without()}
    return str(declared[name].metadata.get("flag") or option_texts()[name])


def given(options: argparse.Namespace) -> dict[str, Any]:
    """The keywords that were given."""
    keywords = {name: getattr(options, name) for name in NAMES if hasattr(options, name)}
    keywords = {name: None if value == "None" else value for name, value in keywords.items()}
    if "reward" in keywords:
        keywords["reward"] = reward_of(keywords["reward"])
    if keywords.get("episode_length") is not None:
        keywords["episode_length"] = _whole_number("episode_length", keywords["episode_length"])
    return keywords


def _whole_number(name: str, text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"--{flag_of(name)} {text} is not allowed: give a whole number, or None.") from None


def reward_of(text: str) -> str | tuple[float, ...]:
    """The keyword ``reward`` that a name, or weights separated by commas, stand for.

    Raises:
        UsageError: it is neither.
    """
    try:
        reward: str | tuple[float, ...] = tuple(float(part) for part in text.split(","))
    except ValueError:
        reward = text
    resolve_reward(reward)
    return reward
