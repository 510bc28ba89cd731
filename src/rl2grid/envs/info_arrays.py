"""``info`` of many environments at once, in the form that Gymnasium's vector environments give it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import Flags
from rl2grid.envs.info import COMPONENTS, COSTS
from rl2grid.mdp import reports
from rl2grid.mdp.reports import Report
from rl2grid.mdp.scores import SCORES

Words = NDArray[np.object_]

_COUNTS = {
    "start": reports.START,
    "start_redraws": reports.START_REDRAWS,
    "step": reports.STEP,
    "episode_length": reports.EPISODE_LENGTH,
    "decisions": reports.DECISIONS,
    "n_steps": reports.N_STEPS,
    "grid_steps": reports.GRID_STEPS,
    "reset_steps": reports.RESET_STEPS,
    "game_over": reports.GAME_OVER,
}
_FLAGS = {"illegal": reports.ILLEGAL, "ambiguous": reports.AMBIGUOUS, "over": reports.OVER}
_NUMBERS = {
    "survival": reports.SURVIVAL,
    "cost": reports.COST,
    "reset_reward": reports.RESET_REWARD,
    "episode_return": reports.EPISODE_RETURN,
}
_DICTS = {
    "reward_components": (COMPONENTS, reports.REWARD_COMPONENTS),
    "costs": (COSTS, reports.TRANSITION_COSTS),
    "reset_components": (COMPONENTS, reports.RESET_COMPONENTS),
    "reset_costs": (COSTS, reports.RESET_COSTS),
    "episode_components": (COMPONENTS, reports.EPISODE_COMPONENTS),
    "episode_costs": (COSTS, reports.EPISODE_COSTS),
    "scores": (SCORES, reports.EPISODE_SCORES),
}
"""Names of the entries, and the line of the first."""


class InfoForm:
    """Which keys infos have, and where their values are.

    Every step names dozens of arrays: the names of masks and the places are looked up once.

    Args:
        words: keys of texts and of what ``str`` makes texts of.
        tells_discounted: whether there is a discounted reward.
    """

    def __init__(self, words: Sequence[str], tells_discounted: bool) -> None:
        numbers = _NUMBERS | ({"discounted_reward": reports.DISCOUNTED_REWARD} if tells_discounted else {})
        places = ({key: line for line, key in enumerate(words)}, _COUNTS, _FLAGS, numbers)
        self._lines = [
            (key, _mask_of(key), block, line) for block, lines in enumerate(places) for key, line in lines.items()
        ]
        self._dicts = [
            (key, _mask_of(key), [(name, _mask_of(name), first + k) for k, name in enumerate(names)])
            for key, (names, first) in _DICTS.items()
        ]

    def named(self, words: Words, report: Report, told: Flags) -> dict[str, Any]:
        """Infos by key of :data:`rl2grid.envs.info.INFO_KEYS`, arrays [n] or dicts of such, each beside its mask.

        Args:
            words: object [key, n].
            report: the numbers.
            told: the mask of every key, bool [n]: the environments that have infos.
        """
        numbers = report.numbers
        blocks = (words, report.counts, report.flags, numbers)
        infos: dict[str, Any] = {"attacked_lines": report.attacked, "_attacked_lines": told}
        for key, mask, block, line in self._lines:
            infos[key] = blocks[block][line]
            infos[mask] = told
        for key, mask, entries in self._dicts:
            infos[key] = values = {}
            infos[mask] = told
            for name, mask_of_name, line in entries:
                values[name] = numbers[line]
                values[mask_of_name] = told
        return infos


def _mask_of(key: str) -> str:
    return f"_{key}"
