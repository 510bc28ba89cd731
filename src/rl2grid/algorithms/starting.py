"""Policies that runs begin with: those of other runs, with the statistics by which they read observations.

A run keeps what it began with, in its checkpoint: it goes on when the file is gone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from rl2grid.algorithms.hyperparameters import SharedArgs
from rl2grid.algorithms.networks import shortlist
from rl2grid.algorithms.policy_agent import agent_of, read_policy
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.envs.spec import Spec, spec_from_state
from rl2grid.envs.tasks import find_task
from rl2grid.errors import UsageError
from rl2grid.mdp.actions import ActionCatalogue


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
        same = ("task", "action_size") if self._chooses_as_in(spec) else ()
        for name, words in _WORDS.items():
            if name not in same and theirs.get(name) != mine[name]:
                if name == "task" and None not in (theirs["task"], spec.task):
                    raise self.refusal(f"it is of task {theirs['task']}, not {spec.task}, {_ELSEWHERE}")
                if name == "continuous" and theirs["task"] is not None:
                    way = "box" if theirs[name] else "discrete"
                    raise self.refusal(f"it plays joint actions otherwise: set joint_actions to {way}")
                raise self.refusal(f"it has {words.format(theirs.get(name))}, here are {words.format(mine[name])}")
        network = self.policy["factory"]["name"]
        if network != args.network:
            raise self.refusal(f"its network is {network!r}, not {args.network!r}: set network to the former")
        if self._shortlist_in(spec) != args.shortlist:
            raise self.refusal(f"its shortlist is {self._shortlist_in(spec)}: set shortlist to the same")
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

    def moved_to(self, spec: Spec) -> StartingPolicy:
        """The same policy as one of the task of ``spec``, for which :meth:`check` has found it to fit."""
        size = self._shortlist_in(spec)
        chosen = {} if size is None else {"shortlist": size}
        factory = {**self.policy["factory"], "spec": spec.state_dict(), **chosen}
        return replace(self, policy={**self.policy, "factory": factory})

    def _chooses_as_in(self, spec: Spec) -> bool:
        """Whether it chooses among actions that it has in another task of the grid as well, in the same order.

        Levels of topology actions begin with those of the lower ones: a policy of one level, or of a shortlist of its
        actions, is a policy of every level that has these.
        """
        theirs = self.policy["factory"]["spec"]
        size = self._shortlist_in(spec)
        if size is None or theirs["task"] is None or spec.task is None or size > spec.action_size:
            return False
        a, b = find_task(theirs["task"]), find_task(spec.task)
        if (a.grid_id, a.constraint, a.kind, b.kind) != (b.grid_id, b.constraint, "T", "T"):
            return False
        first, second = (_on_shortlist(each, size) for each in (spec_from_state(theirs), spec))
        if first is None or second is None:
            return False
        return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in ("kind", "target", "mask"))

    def _shortlist_in(self, spec: Spec) -> int | None:
        """How many actions it chooses among in the task of ``spec``; None: all of them."""
        theirs = self.policy["factory"]["spec"]
        size: int | None = self.policy["factory"].get("shortlist")
        if size is not None or theirs["continuous"] or theirs["task"] == spec.task:
            return size
        return theirs["action_size"] if theirs["action_size"] < spec.action_size else None

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
_ELSEWHERE = "and only one of topology actions goes on in other levels of its grid, where these stand in the same order"


def _on_shortlist(spec: Spec, size: int) -> ActionCatalogue | None:
    """What is chosen among, of a topology task with a shortlist of ``size``; None: its actions are not the task's."""
    if not isinstance(spec.actions, ActionCatalogue):
        return None
    return spec.actions.take(shortlist(spec, size).astype(np.int32))


def read_starting_policy(path: str) -> StartingPolicy:
    """The policy of a run folder (its best by validation, else its latest) or of a checkpoint, of whatever task.

    Raises:
        UsageError: there is none.
    """
    file, contents = read_policy(Path(path))
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
