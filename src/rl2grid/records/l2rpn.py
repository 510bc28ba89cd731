r"""The scores of the L2RPN competitions, from what the episode of an agent cost and what two baselines cost there.

What an agent's episode costs, :math:`c`, is the operation of the steps played (:mod:`rl2grid.mdp.operation`) and, after
a game over, the demand of all later steps at the price of the grid's dearest generator. The score is a line through
four points: 100 for no cost, 80 for that of reconnecting lines where no line is ever tripped by an overload, 0 for that
of doing nothing, and -100 for a blackout from the beginning. Where the two baselines cost the same there are three
points. Grid2Op's classes are ``ScoreL2RPN2020`` (also the operational part of ``ScoreICAPS2021``), ``ScoreL2RPN2022``
and ``ScoreL2RPN2023``; ``docs/l2rpn.md`` says where we deviate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from types import MappingProxyType

import numpy as np

from rl2grid.errors import UsageError
from rl2grid.records.episodes import OPERATION, Episode
from rl2grid.records.files import read_json, write_record
from rl2grid.records.statistics import Scores

L2RPN_FILE = "l2rpn.json"
STORAGE_PRICE = 10.0
"""Of a MWh that storage takes in or gives out, in 2022."""
_OPERATIONAL, _RENEWABLE = 0.6, 0.15
"""Weights of the score of 2023. The rest, 0.25, is for alerts, which our agents do not raise."""

Operation = Mapping[str, float]
"""What an episode cost, by the names of :data:`rl2grid.records.episodes.OPERATION`."""


@dataclass(frozen=True)
class Baselines:
    """What two baselines cost in a month."""

    demand: float
    """Of all steps, at the price of the grid's dearest generator: what a blackout from the beginning costs."""
    nothing: Operation
    """Doing nothing."""
    reconnecting: Operation
    """Reconnecting lines at once, on a grid whose lines are never tripped by an overload."""


@dataclass(frozen=True)
class L2RPNScores:
    """The scores of an episode, -100 to 100 each."""

    score_2020: float
    """Of 2020, and the operational part of 2021 and 2023."""
    score_2022: float
    """Of 2022: storage has a price of its own."""
    renewable_2023: float
    """The part of 2023 for renewable energy that was used."""
    score_2023: float
    """Of 2023 without its part for alerts, whose weight is shared out among the others."""


COLUMNS: tuple[str, ...] = tuple(each.name for each in fields(L2RPNScores))
HEADINGS: Mapping[str, str] = MappingProxyType(
    {
        "score_2020": "L2RPN 2020",
        "score_2022": "L2RPN 2022",
        "renewable_2023": "2023 renewable",
        "score_2023": "2023 without alerts",
    }
)
"""What tables call the scores."""


def operation_of(episode: Episode) -> Operation:
    """What an episode cost.

    Raises:
        UsageError: the episode does not say.
    """
    if not episode.knows_operation:
        raise UsageError(
            "L2RPN's scores need what operation cost, which these episodes do not say: evaluate them again."
        )
    return {column.name: float(getattr(episode, column.name)) for column in OPERATION}


def scores_of(played: Operation, baselines: Baselines) -> L2RPNScores:
    """The scores of an episode."""
    score_2020 = operational_score(played, baselines, cost_2020)
    renewable = renewable_score(played["renewable_used"], played["renewable_available"])
    mixed = (_OPERATIONAL * score_2020 + _RENEWABLE * renewable) / (_OPERATIONAL + _RENEWABLE)
    return L2RPNScores(score_2020, operational_score(played, baselines, cost_2022), renewable, mixed)


def cost_2020(played: Operation) -> float:
    """What the steps played cost: losses, redispatch, curtailment and storage at the running price."""
    return _without_storage(played) + played["cost_storage"]


def cost_2022(played: Operation) -> float:
    """What the steps played cost where storage has a price of its own."""
    return _without_storage(played) + STORAGE_PRICE * played["storage_energy"]


def operational_score(played: Operation, baselines: Baselines, cost: Callable[[Operation], float]) -> float:
    """The score of what an episode cost.

    Args:
        played: by the agent.
        baselines: in the same month.
        cost: of the steps played, :func:`cost_2020` or :func:`cost_2022`.
    """
    # The month ends where the second baseline does, which is lost only where there is no power flow.
    beyond = baselines.reconnecting["cost_blackout"]

    def whole(one: Operation) -> float:
        return cost(one) + max(one["cost_blackout"] - beyond, 0.0)

    nothing, reconnecting, worst = whole(baselines.nothing), whole(baselines.reconnecting), baselines.demand - beyond
    if nothing == reconnecting:
        return float(np.interp(whole(played), [0.0, nothing, worst], [100.0, 0.0, -100.0]))
    return float(np.interp(whole(played), [0.0, reconnecting, nothing, worst], [100.0, 80.0, 0.0, -100.0]))


def renewable_score(used: float, available: float) -> float:
    """100 where all energy of renewables was used, 0 for 80% of it, -100 for 50% and less."""
    share = 100.0 if abs(available) <= 1e-6 else 100.0 * used / available
    distance = _surlinear(share) - _surlinear(80.0)
    most = _surlinear(100.0) - _surlinear(80.0) if share >= 80.0 else _surlinear(80.0) - _surlinear(50.0)
    return 100.0 * max(distance / most, -1.0)


def _without_storage(played: Operation) -> float:
    return played["cost_losses"] + played["cost_redispatch"] + played["cost_curtailment"]


def _surlinear(share: float) -> float:
    return max(share, 1e-6) * math.log(max(share, 1e-6))


def write_scores(folder: Path, episodes: Sequence[Episode], baselines: Sequence[Baselines]) -> tuple[L2RPNScores, ...]:
    """Store the scores of an evaluation beside its episodes, with what they follow from; returns them."""
    scores = tuple(scores_of(operation_of(one), baseline) for one, baseline in zip(episodes, baselines, strict=True))
    rows = [
        {"scenario": one.scenario, "seed": one.seed, "start": one.start, "scores": asdict(score), **asdict(baseline)}
        for one, score, baseline in zip(episodes, scores, baselines, strict=True)
    ]
    write_record(folder / L2RPN_FILE, {"identity": episodes[0].identity, "episodes": rows})
    return scores


def read_scores(folder: Path, episodes: Sequence[Episode]) -> tuple[L2RPNScores, ...] | None:
    """The scores that were stored beside these episodes; None where there are none.

    Raises:
        UsageError: the file is no file of scores.
    """
    path = folder / L2RPN_FILE
    if not path.is_file():
        return None
    remedy = "remove it, and evaluate again with --l2rpn"
    record = read_json(path, "a file of L2RPN's scores", remedy, {"identity": str, "episodes": list})
    found = {(row["scenario"], row["seed"], row["start"]): row["scores"] for row in record["episodes"]}
    keys = [(one.scenario, one.seed, one.start) for one in episodes]
    if record["identity"] != episodes[0].identity or not all(key in found for key in keys):
        return None
    return tuple(L2RPNScores(**found[key]) for key in keys)


def score_columns(runs: Sequence[Sequence[Episode]], scores: Sequence[Sequence[L2RPNScores]]) -> dict[str, Scores]:
    """The scores by name, as statistics take them.

    Args:
        runs: episodes of each run; every scenario with every seed.
        scores: of these episodes.
    """
    columns = {}
    for name in COLUMNS:
        tables = []
        for episodes, values in zip(runs, scores, strict=True):
            keys = [(one.scenario, one.seed) for one in episodes]
            order = sorted(range(len(keys)), key=keys.__getitem__)
            column = np.array([getattr(values[k], name) for k in order])
            tables.append(column.reshape(len({scenario for scenario, _ in keys}), -1))
        columns[name] = Scores(np.stack(tables), (-100.0, 100.0))
    return columns
