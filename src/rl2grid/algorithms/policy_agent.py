"""A trained policy as an agent: what the evaluation plays."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from rl2grid.agents.agent import Action, Actions, Considered, Info, Observation, nearest_of
from rl2grid.algorithms.checkpoint import load_checkpoint
from rl2grid.algorithms.networks import find_network
from rl2grid.algorithms.networks.mlp import freeze
from rl2grid.algorithms.pretrained import PREFIX, is_pretrained, pretrained
from rl2grid.algorithms.registry import find_algorithm
from rl2grid.arrays import F32, Flags
from rl2grid.dense.choices import find_best
from rl2grid.envs.joint import JointAsBox, JointAsDiscrete
from rl2grid.envs.normalization import ObservationNormalizer
from rl2grid.envs.options import DEFAULTS, OBSERVED_WITH, changed_options
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.records.trainings import RUN_FILE, is_run, read_configuration
from rl2grid.streams import Purpose, Stream

BEST_FILE = "best.pt"
"""In a run folder: the policy with the highest validation survival so far."""
CHECKPOINT_FILE = "checkpoint.pt"
"""In a run folder: everything needed to go on."""
WIDTH = 3.0
"""How much further away than a policy explores a better continuous action is looked for."""
PROPOSALS = 100
"""Continuous actions from which those are chosen that are tried in rehearsals."""
_EXPLAINED = 2000
"""Actions of which an explanation tells at most."""
MAX_WEIGHT = 1e8
"""A larger one is no weight that was learned."""
SMALL_NETWORK = 2**24
"""Weights of a network that is made to see whether those of the file fit. Networks of one's own may have fewer weights
than widths of layers suggest; a larger one is not made for a file that does not hold as many."""


class PolicyAgent:
    """Plays a policy as it was when the checkpoint was written; neither it nor its statistics change any more."""

    def __init__(self, contents: Mapping[str, Any], *, deterministic: bool = True, name: str | None = None) -> None:
        """An agent from the sections of a checkpoint.

        Args:
            contents: See :mod:`rl2grid.algorithms.checkpoint`; ``training`` is not needed.
            deterministic: Whether to play the most probable action instead of a sample (DQN and TD3 have no others).
            name: What tables call the agent; by default the name of the algorithm.
        """
        policy = contents["policy"]
        self.name = name or str(contents["algorithm"])
        self.task: str = contents["task"]
        self.env_keywords: dict[str, Any] = changed_options(contents["env_keywords"])
        """Keywords of the environments that it was trained in, those at their defaults left out: play it with the same
        ``heuristic``, unless the difference is what is studied."""
        self.deterministic = deterministic
        self._network = find_algorithm(contents["algorithm"]).load_policy(policy)
        self._row_by_row = "factory" in policy and find_network(policy["factory"]["name"]).row_by_row
        self._mask_actions = bool(policy["mask_actions"])
        self._has_scores = not self._network.continuous and _says_by_itself(self._network, "scores")
        self._has_means = self._network.continuous and _says_by_itself(self._network, "means")
        self._all_legal = np.ones((1, self._network.action_size), np.bool_)
        self._normalizer: ObservationNormalizer | None = None
        if policy["normalizer"] is not None:
            self._normalizer = ObservationNormalizer(self._network.observation_size)
            self._normalizer.load_state_dict(policy["normalizer"])
            self._normalizer.freeze()
        self._generator = torch.Generator().manual_seed(0)
        self.identity: dict[str, Any] = {
            "algorithm": contents["algorithm"],
            "policy_hash": _hash(self._network),
            "normaliser_hash": self._normalizer.normaliser_hash if self._normalizer else None,
            "decisions": contents["decisions"],
            "deterministic": deterministic,
            "trained_with": dict(contents["identity"]),
        }
        """What a result of this agent must name beside the evaluation's own identity."""

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Remember the environment, whose masks are asked for at every decision.

        Raises:
            UsageError: its observations or actions are not those that the policy was trained with.
        """
        base: Any = env.unwrapped
        task = base.task.id
        if task != self.task:
            raise UsageError(f"The policy was trained on task {self.task!r} and cannot play task {task!r}.")
        for name in OBSERVED_WITH:
            trained, offered = self.env_keywords.get(name, DEFAULTS[name]), getattr(base.options, name)
            if trained != offered:
                raise UsageError(
                    f"The policy was trained with {name}={trained!r} and cannot read observations of "
                    f"{name}={offered!r}: make the environment with the former."
                )
        self._flattened = _flattened(env, self._network.continuous)
        self._env: Any = self._flattened or base
        size = env.observation_space.shape
        if self._flattened is not None:
            env = self._flattened
        actions = env.action_space.shape[0] if self._network.continuous else env.action_space.n  # type: ignore
        if size != (self._network.observation_size,) or actions != self._network.action_size:
            raise UsageError(
                f"The policy reads {self._network.observation_size} features and chooses among "
                f"{self._network.action_size} actions, but the environment has {size} and {actions}: "
                "the definition of the task has changed since it was trained."
            )
        freeze(self._network)  # here: who reads a policy for its hash, or hands it to other processes, plays nothing

    def reset(self, i: int) -> None:
        """Nothing to forget."""

    def seed_episode(self, seed: int, episode: int) -> None:
        """Draw samples from the stream (``seed``, ``episode``) from now on; without effect if deterministic."""
        self._generator.manual_seed(Stream(seed, episode, Purpose.AGENT).integer(2**53))

    def act(self, observation: Observation, info: Info) -> Action:
        """The action for an observation: its id, or float32 [dimensions] in [-1, 1], or a joint action."""
        rows, legal = self._seen = self._read(observation)
        if self.deterministic and self._has_scores:
            return self._as_action(int(self._scores(rows, legal).argmax()))
        if self.deterministic and self._has_means:
            return self._as_action(self._network.means(rows)[0].clip(-1.0, 1.0))
        with torch.no_grad():
            actions = self._network.act(*_tensors(rows, legal), None if self.deterministic else self._generator)
        if self._network.continuous:
            return self._as_action(actions[0].clamp(-1.0, 1.0).numpy())
        return self._as_action(int(actions[0]))

    @property
    def decides_side_by_side(self) -> bool:
        """Whether it decides for many environments as for each: samples are drawn for one episode, and not every
        network gives the same beside others.
        """
        return self.deterministic and self._row_by_row

    def act_side_by_side(self, observations: NDArray[np.float32], masks: Callable[[], NDArray[np.bool_]]) -> Actions:
        """See :class:`~rl2grid.agents.agent.SideBySideAgent`."""
        if self._normalizer is not None:
            observations = self._normalizer.normalize(observations)
        legal = torch.as_tensor(self._extended(masks())) if self._mask_actions else None
        with torch.no_grad():
            actions: torch.Tensor = self._network.act(torch.as_tensor(observations, dtype=torch.float32), legal, None)
        played = (actions.clamp(-1.0, 1.0) if self._network.continuous else actions).numpy()
        return played if self._flattened is None else _joined([self._flattened.action(each) for each in played])

    def _extended(self, masks: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Masks of topology actions as those of all actions that it knows, bool [k, action]."""
        return self._flattened.extended(masks) if isinstance(self._flattened, JointAsDiscrete) else masks

    @property
    def continuous(self) -> bool:
        """Whether its actions are continuous."""
        return bool(self._network.continuous)

    @property
    def preference(self) -> str:
        """What it prefers actions by: ``probability`` or ``value``."""
        return str(self._network.preference)

    def best(self, observation: Observation, k: int) -> tuple[list[Action], F32]:
        """The ``k`` legal discrete actions that it prefers, the best first, and by what; fewer if there are.

        Of that :meth:`preferences_of` makes probabilities or values.
        """
        rows, legal = self._seen = self._read(observation)
        return self._best_of(self._order(rows, legal), self._env.action_masks() if legal is None else legal[0], k)

    def _best_of(self, order: F32, allowed: Flags, k: int) -> tuple[list[Action], F32]:
        """The ``k`` actions that come first by an order of those that are allowed, and by what."""
        best = np.empty(min(k, len(order)), np.int32)
        chosen = best[: find_best(order, allowed, best)]
        return [self._as_action(action) for action in chosen.tolist()], order[chosen]

    def preferences_of(self, order: F32) -> list[float]:
        """What :attr:`preference` names, of what :meth:`best` orders actions by."""
        of_probabilities = self._has_scores and self.preference == "probability"
        return (torch.from_numpy(order).exp() if of_probabilities else order).tolist()

    @property
    def is_deterministic(self) -> bool:
        """Whether there is nothing to draw: TD3's policy has one action for an observation, and no distribution."""
        return not hasattr(self._network, "distribution")

    def draws(self, observation: Observation, k: int) -> list[Action]:
        """``k`` continuous actions, :data:`WIDTH` times as far from the most probable one as its distribution draws."""
        observations = torch.from_numpy(self._read(observation)[0])
        with torch.no_grad():
            probable = self._network.act(observations, None, None).clamp(-1.0, 1.0)
            drawn = self._network.act(observations.expand(k, -1), None, self._generator)
        actions = (probable + WIDTH * (drawn - probable)).clamp(-1.0, 1.0)
        return [self._as_action(action) for action in actions.numpy()]

    def proposals(self, observation: Observation, info: Info) -> list[Action]:
        """Of continuous actions the most probable one, and what is drawn around it, :data:`PROPOSALS` in all."""
        return [self.act(observation, info), *self.draws(observation, PROPOSALS - 1)]

    def _read(self, observation: Observation) -> tuple[F32, Flags | None]:
        """An observation as the network reads it, and the actions that it may play, each with one row."""
        read = (
            np.array(observation, np.float32) if self._normalizer is None else self._normalizer.normalize(observation)
        )
        legal = self._env.action_masks()[np.newaxis] if self._mask_actions else None
        return read[np.newaxis], legal

    def _scores(self, rows: F32, legal: Flags | None) -> F32:
        """Log-probabilities or values of discrete actions, [action], as the network says them without tensors."""
        scores: F32 = self._network.scores(rows, self._all_legal if legal is None else legal)[0]
        return scores

    def _order(self, rows: F32, legal: Flags | None) -> F32:
        """By which discrete actions are ordered, [action]."""
        if self._has_scores:
            return self._scores(rows, legal)
        with torch.no_grad():
            preferences: F32 = self._network.preferences(*_tensors(rows, legal))[0].numpy()
        return preferences

    def _as_action(self, action: Action) -> Action:
        """What the environment takes, of an action that the policy knows."""
        return action if self._flattened is None else self._flattened.action(action)

    def explain(self) -> Considered | None:
        """The best actions of the last decision by the policy's probabilities or values; None if they are continuous.

        A network says them with ``preferences(observations, masks)``, which returns [batch, actions], and calls them
        ``preference``.
        """
        if self._network.continuous or not hasattr(self._network, "preferences"):
            return None
        actions, order = self._best_of(self._order(*self._seen), self._all_legal[0], _EXPLAINED)
        return Considered(self._network.preference, actions, self.preferences_of(order))


def _says_by_itself(network: torch.nn.Module, name: str) -> bool:
    """Whether a network says without tensors what it decides: who inherits that, but decides otherwise, does not."""
    return nearest_of(type(network), name, "act", "preferences", "distribution", "forward", "each") == name


def _tensors(rows: F32, legal: Flags | None) -> tuple[torch.Tensor, torch.Tensor | None]:
    return torch.from_numpy(rows), None if legal is None else torch.from_numpy(legal)


def _flattened(env: gymnasium.Env[Any, Any], continuous: bool) -> JointAsBox | JointAsDiscrete | None:
    """A joint task as a policy plays it; None: a task with one kind of action."""
    if not isinstance(env.action_space, gymnasium.spaces.Dict):
        return None
    return JointAsBox(env) if continuous else JointAsDiscrete(env)


def _joined(actions: Sequence[Mapping[str, Any]]) -> dict[str, NDArray[Any]]:
    """Joint actions, one of each environment, as one of all."""
    return {name: np.array([action[name] for action in actions]) for name in actions[0]}


def load_agent(
    path: Path, task: Task | str | None = None, *, deterministic: bool = True, name: str | None = None
) -> PolicyAgent:
    """The policy of a checkpoint, or of a run folder (its best by validation, else its latest).

    Args:
        path: A checkpoint file, a run folder, or ``pretrained/<name>``, see :mod:`rl2grid.algorithms.pretrained`.
        task: The task that it is to play, or its id; None: the one it was trained on.
        deterministic: Whether to play the most probable action instead of a sample (DQN and TD3 have no others).
        name: What tables call the agent; by default the name of the algorithm.

    Raises:
        UsageError: no checkpoint there, or one of another task or another version of rl2grid.
    """
    if is_pretrained(path):
        name = name or f"pretrained-{pretrained(path).name}"
    file, contents = read_policy(path, task)
    return agent_of(file, contents, deterministic=deterministic, name=name)


def read_policy(path: Path, task: Task | str | None = None) -> tuple[Path, dict[str, Any]]:
    """The file in which the policy of a checkpoint or run folder is, and its sections; see :func:`load_agent`.

    Raises:
        UsageError: no checkpoint there, or one of another task.
    """
    if is_pretrained(path):
        path = pretrained(path).file
    path = Path(path)
    if not path.exists():
        raise UsageError(f"{str(path)!r} does not exist: give a run folder, a checkpoint, or {PREFIX}NAME.")
    if path.is_dir():
        best, latest = path / BEST_FILE, path / CHECKPOINT_FILE
        if not best.is_file() and not latest.is_file():
            raise UsageError(f"Folder {str(path)!r} holds no policy: give one that 'rl2grid train' wrote.")
        path = best if best.is_file() else latest
    contents = load_checkpoint(path, task=None if task is None else find_task(task).id)
    if is_run(path.parent):
        _check_place(path, contents)
    if "policy" not in contents and contents.get("decisions") == 0:
        raise UsageError(f"Checkpoint {str(path)!r} has no policy yet: its run has just begun.")
    return path, contents


def agent_of(
    path: Path, contents: Mapping[str, Any], *, deterministic: bool = True, name: str | None = None
) -> PolicyAgent:
    """The agent of what :func:`read_policy` returned.

    Raises:
        UsageError: another version of rl2grid wrote it, or nobody learned it.
    """
    try:
        _check_policy(path, contents["policy"])
        return PolicyAgent(contents, deterministic=deterministic, name=name)
    except KeyError as error:
        raise UsageError(f"Checkpoint {str(path)!r} lacks {error}: another version of rl2grid wrote it.") from error
    except (AttributeError, RuntimeError, TypeError) as error:
        raise UsageError(f"Checkpoint {str(path)!r} holds no policy that can be played: {_reason(error)}.") from error


def _reason(error: Exception) -> str:
    """What is wrong, in a line; of weights that do not fit PyTorch says which in a second one."""
    first, *others = str(error).strip().splitlines() or [""]
    if not others or not first.startswith("Error(s) in loading state_dict"):
        return first
    return f"its weights are those of another network ({others[0].strip().removesuffix('.')})"


def _check_place(path: Path, contents: Mapping[str, Any]) -> None:
    """Refuse a checkpoint of another run than that of its folder.

    Raises:
        UsageError: they differ.
    """
    request = read_configuration(path.parent)["request"]
    for name in ("task", "algorithm", "hyperparameters"):
        if json.dumps(contents.get(name), sort_keys=True) != json.dumps(request[name], sort_keys=True):
            raise UsageError(
                f"Checkpoint {str(path)!r} is of a run with other {name} than {RUN_FILE} beside it says: give a folder "
                "as 'rl2grid train' wrote it."
            )


def _check_policy(path: Path, policy: Mapping[str, Any]) -> None:
    """Refuse numbers that no training ends with, and networks that are larger than the weights that are there.

    Raises:
        UsageError: which of them.
    """
    arrays = list(_arrays_of(policy))
    if not all(bool(torch.isfinite(array).all()) for array in arrays if array.is_floating_point()):
        raise UsageError(f"Checkpoint {str(path)!r} cannot be played: some of its numbers are infinite or none at all.")
    weights = list(_arrays_of(policy["network"]))
    if any(bool((array.abs() > MAX_WEIGHT).any()) for array in weights if array.is_floating_point()):
        raise UsageError(f"Checkpoint {str(path)!r} cannot be played: some of its weights are beyond {MAX_WEIGHT:g}.")
    there = sum(array.numel() for array in weights)
    widths = [value for name, value in policy.items() if name.endswith("layers")]
    needed = max((a * b for layers in widths for a, b in itertools.pairwise(layers)), default=0)
    widest = max((width for layers in widths for width in layers), default=0)
    if max(needed, widest, int(policy.get("n_costs", 0))) > max(there, SMALL_NETWORK):
        raise UsageError(f"Checkpoint {str(path)!r} cannot be played: its networks have other sizes than its weights.")


def _arrays_of(value: Any) -> Iterator[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        yield torch.from_numpy(np.array(value))
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _arrays_of(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _arrays_of(item)


def _hash(network: torch.nn.Module) -> str:
    """Short SHA-256 of all weights."""
    digest = hashlib.sha256()
    for name, tensor in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(tensor.numpy()).tobytes())
    return digest.hexdigest()[:16]
