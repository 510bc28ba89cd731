"""The agent that plays at random: the floor that learning has to leave behind."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from rl2grid.agents.agent import Action, Info, Observation
from rl2grid.streams import Purpose, Stream


class RandomAgent:
    """Plays uniformly among the legal actions, or uniformly in the box of a redispatching task; on joint tasks both.

    Draws come from counter-based streams: the actions of an episode are a function of the seed, the
    episode number and the masks met, on every machine and with every version of the libraries.
    """

    name = "random"

    def __init__(self, seed: int = 0) -> None:
        """Episodes are numbered 0, 1, 2, ... at each ``reset``, unless ``seed_episode`` names them."""
        self._seed = seed
        self._episode = 0

    def bind(self, env: gymnasium.Env[Any, Any]) -> None:
        """Remember the environment, whose masks are asked for at every decision."""
        self._env: Any = env.unwrapped
        self._space = env.action_space

    def seed_episode(self, seed: int, episode: int) -> None:
        """Draw from the stream (``seed``, ``episode``) from the next ``reset`` on."""
        self._seed, self._episode = seed, episode

    def reset(self, i: int) -> None:
        """Begin the stream of the next episode."""
        self._stream = Stream(self._seed, self._episode, Purpose.AGENT)
        self._episode += 1

    def act(self, observation: Observation, info: Info) -> Action:
        """A legal action, each with the same probability; do nothing is one of them."""
        if isinstance(self._space, gymnasium.spaces.Dict):
            return {name: self._draw(part) for name, part in self._space.items()}
        return self._draw(self._space)

    def _draw(self, space: gymnasium.Space[Any]) -> Action:
        """A topology action or an injection."""
        if isinstance(space, gymnasium.spaces.Box):
            draws = self._stream.uniform(int(np.prod(space.shape))).reshape(space.shape)
            return (space.low + draws * (space.high - space.low)).astype(space.dtype)
        legal = np.flatnonzero(self._env.action_masks())
        return int(legal[self._stream.integer(len(legal))])
