"""Policies that runs begin with: those of other runs, with the statistics by which they read observations.

A run keeps what it began with, in its checkpoint: it goes on when the file is gone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import nn

from rl2grid.algorithms.hyperparameters import SharedArgs
from rl2grid.algorithms.policy_agent import agent_of, read_policy
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.envs.spec import Spec
from rl2grid.errors import UsageError


@dataclass(frozen=True)
class StartingPolicy:
    """A policy as a checkpoint holds it."""

    path: str
    """As it was given."""
    algorithm: str
    """By which it was learned."""
    decisions: int
    """From which it was learned."""
    policy_hash: str
    env_keywords: Mapping[str, Any]
    """Of the environments in which it was learned."""
    hyperparameters: Mapping[str, Any]
    policy: Mapping[str, Any]
    """The section of a checkpoint."""

    def identity(self) -> dict[str, Any]:
        """What results of a run that begins with it must name."""
        named = {name: getattr(self, name) for name in ("path", "algorithm", "decisions", "policy_hash")}
        return {**named, "budget": self.hyperparameters.get("total_timesteps")}

    def state_dict(self) -> dict[str, Any]:
        """Plain values, arrays and tensors of which it is made again."""
        return vars(self) | {"policy": dict(self.policy)}

    def network(self) -> nn.Module:
        """The network, with its weights."""
        network: nn.Module = find_algorithm(self.algorithm).load_policy(self.policy)
        return network

    def judges_like(self, args: SharedArgs, reward: Any) -> bool:
        """Whether a critic that came with it says what states are worth to a learner with these hyperparameters.

        Args:
            args: Of the learner.
            reward: The environment's keyword; None: not known.
        """
        theirs = self.env_keywords.get("reward")
        known = reward is None or theirs is None or _plain(reward) == _plain(theirs)
        mine = asdict(args)
        return known and all(self.hyperparameters.get(name) == mine[name] for name in ("gamma", "reward_scale"))

    def check(self, args: SharedArgs, spec: Spec, options: Any) -> None:
        """Refuse what a learner cannot begin with.

        Args:
            args: Its hyperparameters.
            spec: What it observes and what it can do.
            options: Keywords of its environments; None: not known.

        Raises:
            UsageError: what does not fit.
        """
        theirs, mine = self.policy["factory"]["spec"], spec.state_dict()
        for name, words in _WORDS.items():
            if theirs.get(name) != mine[name]:
                if name == "continuous" and theirs["task"] is not None:
                    way = "box" if theirs[name] else "discrete"
                    raise self.refusal(f"it plays joint actions otherwise: set joint_actions to {way}")
                raise self.refusal(f"it has {words.format(theirs.get(name))}, here are {words.format(mine[name])}")
        network = self.policy["factory"]["name"]
        if network != args.network:
            raise self.refusal(f"its network is {network!r}, not {args.network!r}: set network to the former")
        if self.policy["factory"].get("shortlist") != args.shortlist:
            raise self.refusal(f"its shortlist is {self.policy['factory'].get('shortlist')}: set shortlist to the same")
        scaled = self.policy["normalizer"] is not None
        if scaled != args.normalize_observations:
            raise self.refusal(f"normalize_observations is {scaled} there: set it to the same")
        for name in ("actor_layers", "critic_layers", "layers"):
            layers, asked = self.policy.get(name), getattr(args, name, None)
            if layers is not None and asked is not None and tuple(layers) != tuple(asked):
                raise self.refusal(f"its {name} are {' '.join(map(str, layers))}: set them to the same")
        heuristic = self.env_keywords.get("heuristic")
        if options is not None and options.heuristic != heuristic:
            raise self.refusal(
                f"it was learned with heuristic {heuristic}, not {options.heuristic}: train with the former"
            )

    def refusal(self, why: str) -> UsageError:
        """What is said where it does not fit."""
        return UsageError(f"The policy in {self.path!r} cannot be begun with: {why}.")


_WORDS = {
    "task": "task {}",
    "normalize": "observations of normalize={}",
    "operator_features": "observations with operator_features={}",
    "observation_size": "{} observed features",
    "continuous": "continuous={} actions",
    "action_size": "{} actions",
}
"""What a spec says of an environment, in words."""


def read_starting_policy(path: str, task: str | None) -> StartingPolicy:
    """The policy of a run folder (its best by validation, else its latest) or of a checkpoint.

    Args:
        path: The folder or file.
        task: Id of the task that it must be of; None: any.

    Raises:
        UsageError: there is none, or one of another task.
    """
    file, contents = read_policy(Path(path), task)
    agent = agent_of(file, contents)
    return StartingPolicy(
        path=path,
        algorithm=contents["algorithm"],
        decisions=contents["decisions"],
        policy_hash=agent.identity["policy_hash"],
        env_keywords=contents["env_keywords"],
        hyperparameters=contents.get("hyperparameters", {}),
        policy=contents["policy"],
    )


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple | list) else value
