"""``info`` of many environments at once, in the form that Gymnasium's vector environments give it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import Flags
from rl2grid.envs.info import COMPONENTS, COSTS
from rl2grid.mdp import reports
from rl2grid.mdp.reports import Report
from rl2grid.mdp.scores import SCORES

Words = NDArray[np.object_]

_COUNTS = {
    reports.START: "start",
    reports.START_REDRAWS: "start_redraws",
    reports.GRID_STEPS: "grid_steps",
    reports.STEP: "step",
    reports.EPISODE_LENGTH: "episode_length",
    reports.DECISIONS: "decisions",
    reports.N_STEPS: "n_steps",
    reports.RESET_STEPS: "reset_steps",
    reports.GAME_OVER: "game_over",
}
_FLAGS = {reports.ILLEGAL: "illegal", reports.AMBIGUOUS: "ambiguous", reports.OVER: "over"}
_NUMBERS = {
    reports.SURVIVAL: "survival",
    reports.COST: "cost",
    reports.RESET_REWARD: "reset_reward",
    reports.EPISODE_RETURN: "episode_return",
    reports.DISCOUNTED_REWARD: "discounted_reward",
}
_DICTS = {
    reports.REWARD_COMPONENTS: ("reward_components", COMPONENTS),
    reports.TRANSITION_COSTS: ("costs", COSTS),
    reports.RESET_COMPONENTS: ("reset_components", COMPONENTS),
    reports.RESET_COSTS: ("reset_costs", COSTS),
    reports.EPISODE_COMPONENTS: ("episode_components", COMPONENTS),
    reports.EPISODE_COSTS: ("episode_costs", COSTS),
    reports.EPISODE_SCORES: ("scores", SCORES),
}
"""By the line of the first entry: the key, and the names of the entries."""


class _Blank(NamedTuple):
    """Infos whose values are still to be put in, each beside its mask."""

    infos: dict[str, Any]
    dicts: list[dict[str, Any]]
    """Of each key of ``_DICTS``."""


class InfoForm:
    """Which keys infos have, and where their values are.

    Every step names dozens of arrays: names and places are put in order once.

    Args:
        words: keys of texts and of what ``str`` makes texts of.
        tells_discounted: whether there is a discounted reward.
        n: number of environments.
    """

    def __init__(self, words: Sequence[str], tells_discounted: bool, n: int) -> None:
        names = [_COUNTS, _FLAGS, _NUMBERS]
        self._keys = [*words, *(lines[line] for lines in names for line in range(len(lines))), "attacked_lines"]
        self._dicts = [(key, first, entries, _beside_masks(entries)) for first, (key, entries) in _DICTS.items()]
        self._all = _beside_masks((*self._keys, *(key for key, *_ in self._dicts)))
        self._tells_discounted = tells_discounted
        everybody = np.ones(n, np.bool_)
        everybody.flags.writeable = False
        self._blank = self._blank_of(everybody)

    def named(self, words: Sequence[Words], report: Report, told: Flags | None = None) -> dict[str, Any]:
        """Infos by key of :data:`rl2grid.envs.info.INFO_KEYS`, arrays [n] or dicts of such, each beside its mask.

        Args:
            words: object [n] for each key.
            report: the numbers.
            told: the mask of every key, bool [n]: the environments that have infos. None: all have; the mask, which
                all steps share, cannot be written.
        """
        blank = self._blank if told is None else self._blank_of(told)
        infos, numbers = blank.infos.copy(), list(report.numbers)
        values = (*words, *report.counts, *report.flags, *numbers[: len(_NUMBERS)], report.attacked)
        # Assigned one by one: for so few that is faster than to update, or to take slices.
        for key, value in zip(self._keys, values, strict=True):
            infos[key] = value
        for (key, line, entries, _), masks in zip(self._dicts, blank.dicts, strict=True):
            infos[key] = entries_of = masks.copy()
            for entry in entries:
                entries_of[entry] = numbers[line]
                line += 1
        if not self._tells_discounted:
            del infos["discounted_reward"], infos["_discounted_reward"]
        return infos

    def _blank_of(self, told: Flags) -> _Blank:
        return _Blank(dict.fromkeys(self._all, told), [dict.fromkeys(names, told) for *_, names in self._dicts])


def _beside_masks(keys: Sequence[str]) -> list[str]:
    """Keys, each before that of its mask."""
    return [name for key in keys for name in (key, f"_{key}")]
