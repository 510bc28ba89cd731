"""What imitation learns from: labels on the device of a network, what each of them counts, and which are held out."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rl2grid.arrays import F32, I64, Flags
from rl2grid.records.labels import NO_CANDIDATE, Labels

ACTING_SHARE = 0.25
"""What decisions in which the teacher acts have of all weight at least, if nothing else is asked for."""
MOST_ACTING_WEIGHT = 20.0
"""... unless they would have to count more than this."""


class Batch(NamedTuple):
    """Some labels, on the device of the network; every array is [batch, ...]."""

    observations: Tensor
    """float32, normalised"""
    masks: Tensor | None
    """bool, legal topology actions"""
    topology: Tensor | None
    """int64, the teacher's"""
    injection: Tensor | None
    """float32, the teacher's"""
    aim: Tensor | None
    """float32, where it wants injections, see :class:`Labels`"""
    candidates: Tensor
    """int64 [batch, k], -1: none"""
    values: Tensor
    """float32 [batch, k]"""
    stands_for: Tensor
    """float32, decisions"""
    weights: Tensor
    """float32, what the loss multiplies it with: 1 in the mean of all that is learned from"""
    acts: Tensor
    """bool, whether the teacher acts"""
    returns: Tensor
    """float32, scaled"""


class Examples:
    """Labels on the device of a network, observations normalised."""

    def __init__(self, labels: Labels, observations: Tensor, weights: F32, acts: Flags, reward_scale: float) -> None:
        device = observations.device
        self._actions = 0 if labels.masks is None else labels.masks.shape[1]
        # One bit per action: levels have up to 73,357 of them.
        self._masks = None if labels.masks is None else np.packbits(labels.masks, axis=1)
        self._columns = {
            "observations": observations,
            "topology": None if labels.topology is None else torch.as_tensor(labels.topology, device=device),
            "injection": None if labels.injection is None else torch.as_tensor(labels.injection, device=device),
            "aim": None if labels.aim is None else torch.as_tensor(labels.aim, device=device),
            "candidates": torch.as_tensor(labels.candidates, device=device),
            "values": torch.as_tensor(labels.values, device=device),
            "stands_for": torch.as_tensor(labels.weights, device=device),
            "weights": torch.as_tensor(weights, device=device),
            "acts": torch.as_tensor(acts, device=device),
            "returns": torch.as_tensor((labels.returns * reward_scale).astype(np.float32), device=device),
        }
        self._device = device

    def __len__(self) -> int:
        return len(self._columns["acts"])  # type: ignore[arg-type]

    def rows(self, chosen: I64) -> Batch:
        """The labels with these indices."""
        masks = None
        if self._masks is not None:
            unpacked = np.unpackbits(self._masks[chosen], axis=1, count=self._actions).view(np.bool_)
            masks = torch.from_numpy(unpacked).to(self._device)
        indices = torch.from_numpy(chosen).to(self._device)
        columns = {name: None if each is None else each[indices] for name, each in self._columns.items()}
        return Batch(masks=masks, **columns)  # type: ignore[arg-type]

    def batches(self, size: int) -> Iterator[Batch]:
        """All labels, in order."""
        for first in range(0, len(self), size):
            yield self.rows(np.arange(first, min(first + size, len(self))))


def chosen_rows(labels: Labels, rows: NDArray[Any]) -> Labels:
    """Some of the labels, by index or bool [n]."""
    columns: dict[str, Any] = {each.name: getattr(labels, each.name) for each in fields(Labels)}
    kept: dict[str, Any] = {name: None if column is None else column[rows] for name, column in columns.items()}
    return Labels(**kept)


def shortlisted(labels: Labels, weights: F32, on_it: Flags) -> tuple[Labels, F32]:
    """Labels of a policy that knows no other actions than those on a shortlist, bool [action], and their weights [n].

    What the teacher plays besides teaches nothing, and is not agreed with.
    """
    assert labels.masks is not None
    assert labels.topology is not None
    known = np.where(labels.candidates == NO_CANDIDATE, False, on_it[labels.candidates])
    candidates = np.where(known, labels.candidates, NO_CANDIDATE)
    changed = replace(labels, masks=labels.masks & on_it, candidates=candidates)
    return changed, np.where(on_it[labels.topology], weights, np.float32(0.0))


def teacher_acts(labels: Labels) -> Flags:
    """Where the teacher does anything, bool [n]."""
    acts = np.zeros(len(labels), np.bool_)
    if labels.topology is not None:
        acts |= labels.topology != 0
    if labels.injection is not None:
        acts |= (labels.injection != 0.0).any(axis=1)
    return acts


def factor_of_acting(weights: F32, acts: Flags, asked_for: float | None) -> float:
    """How much more decisions count in which the teacher acts (:mod:`rl2grid.algorithms.imitation`)."""
    if asked_for is not None:
        return asked_for
    acting, resting = float(weights[acts].sum()), float(weights[~acts].sum())
    if not acting:
        return 1.0
    return min(max(ACTING_SHARE / (1.0 - ACTING_SHARE) * resting / acting, 1.0), MOST_ACTING_WEIGHT)


def held_out(scenarios: Sequence[str], share: float) -> frozenset[str]:
    """The months that are not learned from: the same whoever acted in them, and whatever the seed of the run is.

    At least one of several where the share is above 0, and never all.
    """
    months = sorted(set(scenarios), key=lambda month: hashlib.sha256(month.encode()).digest())
    count = max(round(share * len(months)), 1) if share > 0.0 else 0
    return frozenset(months[: min(count, len(months) - 1)])


def weighted_statistics(observations: F32, weights: F32) -> dict[str, Any]:
    """State of an :class:`~rl2grid.envs.normalization.ObservationNormalizer` that saw each of them so many times."""
    total = float(weights.sum(dtype=np.float64))
    average = np.zeros(observations.shape[1])
    squares = np.zeros(observations.shape[1])
    for first in range(0, len(weights), 4096):  # in float64, a part at a time
        part = slice(first, first + 4096)
        average += weights[part].astype(np.float64) @ observations[part].astype(np.float64) / total
    for first in range(0, len(weights), 4096):
        part = slice(first, first + 4096)
        squares += weights[part].astype(np.float64) @ np.square(observations[part] - average)
    count = max(round(total), 1)
    return {"count": count, "mean": average, "squares": squares * (count / total)}
