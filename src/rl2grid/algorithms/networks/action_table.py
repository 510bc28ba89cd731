"""What every action concerns, as arrays from which networks embed actions: the number of weights does not grow with
the number of actions.

An action has a *kind* (:data:`KINDS`), a *place* (the substation, line, generator or storage unit that it changes) and
*elements* (those that it moves to the other busbar). So have the dimensions of a continuous action, and the entries of
both flattened forms of a joint one.

Elements are counted as in the concatenation of lines' origins, lines' extremities, generators, loads and storage units,
not as in ``topo_vect``: so a network finds them in the order in which it computes them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rl2grid.algorithms.networks import Request
from rl2grid.arrays import I64
from rl2grid.envs.joint import control_moves
from rl2grid.envs.spec import JointActions, Spec
from rl2grid.grids import Grid
from rl2grid.mdp.actions import ActionCatalogue, ActionKind, ContinuousLayout, mask_integer, moved_elements

CONTROLS = ("redispatch", "curtail", "storage")
KINDS = ("nothing", "move", "switch", "reconnect", "restore", *CONTROLS, "up", "down")
"""Kinds of action: do nothing, the four changes of :class:`~rl2grid.mdp.actions.ActionKind`, what a dimension of a
continuous action controls, and the direction in which a discrete one moves a control."""
_UP, _DOWN = KINDS.index("up"), KINDS.index("down")


@dataclass(frozen=True)
class Places:
    """How places are numbered: substations, lines, generators, storage units, and nowhere."""

    n_sub: int
    n_line: int
    n_gen: int
    n_storage: int

    @classmethod
    def of(cls, grid: Grid) -> Places:
        """The places of a grid."""
        return cls(grid.n_sub, grid.n_line, grid.n_gen, grid.n_storage)

    @property
    def lines(self) -> int:
        """Number of the first line."""
        return self.n_sub

    @property
    def gens(self) -> int:
        """Number of the first generator."""
        return self.n_sub + self.n_line

    @property
    def storages(self) -> int:
        """Number of the first storage unit."""
        return self.n_sub + self.n_line + self.n_gen

    @property
    def nowhere(self) -> int:
        """The place of doing nothing, the last one."""
        return self.storages + self.n_storage

    def __len__(self) -> int:
        return self.nowhere + 1


@dataclass(frozen=True)
class ActionTable:
    """What every action, or dimension of a continuous action, concerns."""

    kinds: I64
    """[action, kind] 1 where it is of a kind; a control that is moved in a direction is of two."""
    places: I64
    """[action]"""
    elements: I64
    """Elements that actions move, those of an action one after the other."""
    offsets: I64
    """[action] where those of each action begin in ``elements``."""

    def __len__(self) -> int:
        return len(self.places)

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The four arrays as tensors; ``kinds`` as float32."""
        others = (torch.from_numpy(each) for each in (self.places, self.elements, self.offsets))
        return (torch.from_numpy(self.kinds).to(torch.float32), *others)  # type: ignore[return-value]


def action_table(spec: Spec) -> ActionTable:
    """What the actions of a task of rl2grid concern; joint ones flattened as ``spec.continuous`` says."""
    assert spec.grid is not None
    grid, actions = spec.grid, spec.actions
    if isinstance(actions, ActionCatalogue):
        return _topology(grid, actions)
    if isinstance(actions, ContinuousLayout):
        return _controls(grid, actions)
    assert isinstance(actions, JointActions)
    controls = _controls(grid, actions.injection)
    if not spec.continuous:
        controls = _moves(controls, control_moves(grid))
    return _joined(_topology(grid, actions.topology), controls)


def first_table(rows: int, width: int, request: Request) -> Tensor:
    """First weights of what is learned of each of some things, [row, width]."""
    return torch.randn(rows, width, generator=request.generator) / math.sqrt(width)


def with_first(scores: Tensor, added: Tensor) -> Tensor:
    """Scores [batch, action, ...] with something added to those of action 0."""
    return torch.cat([scores[:, :1] + added, scores[:, 1:]], dim=1)


def element_order(grid: Grid) -> I64:
    """int64 [element of ``topo_vect``]: its number in the order of this module."""
    places = (
        grid.line_or_pos_topo_vect,
        grid.line_ex_pos_topo_vect,
        grid.gen_pos_topo_vect,
        grid.load_pos_topo_vect,
        grid.storage_pos_topo_vect,
    )
    order = np.empty(grid.dim_topo, np.int64)
    order[np.concatenate(places)] = np.arange(grid.dim_topo)
    return order


def _topology(grid: Grid, catalogue: ActionCatalogue) -> ActionTable:
    places, order = Places.of(grid), element_order(grid)
    kinds = np.zeros((len(catalogue), len(KINDS)), np.int64)
    kinds[np.arange(len(catalogue)), catalogue.kind] = 1
    of_line = np.isin(catalogue.kind, (ActionKind.SWITCH, ActionKind.RECONNECT))
    target = catalogue.target.astype(np.int64) + np.where(of_line, places.lines, 0)
    target[catalogue.kind == ActionKind.NOTHING] = places.nowhere
    moved = [
        order[moved_elements(grid, int(sub), mask_integer(mask))] if kind == ActionKind.MOVE else order[:0]
        for kind, sub, mask in zip(catalogue.kind, catalogue.target, catalogue.mask, strict=True)
    ]
    return ActionTable(kinds, target, np.concatenate(moved), _offsets([len(each) for each in moved]))


def _controls(grid: Grid, layout: ContinuousLayout) -> ActionTable:
    places = Places.of(grid)
    parts = ((layout.redispatch, places.gens), (layout.curtail, places.gens), (layout.storage, places.storages))
    kinds = np.zeros((layout.size, len(KINDS)), np.int64)
    names = np.repeat([KINDS.index(name) for name in CONTROLS], [len(ids) for ids, _ in parts])
    kinds[np.arange(layout.size), names] = 1
    target = np.concatenate([ids.astype(np.int64) + first for ids, first in parts])
    return ActionTable(kinds, target, np.zeros(0, np.int64), np.zeros(layout.size, np.int64))


def _moves(controls: ActionTable, moves: np.ndarray) -> ActionTable:
    """Controls moved in a direction, of the moves float32 [move, control]."""
    control = np.abs(moves).argmax(axis=1)
    kinds = controls.kinds[control].copy()
    kinds[np.arange(len(moves)), np.where(moves.sum(axis=1) > 0, _UP, _DOWN)] = 1
    return ActionTable(kinds, controls.places[control], controls.elements, np.zeros(len(moves), np.int64))


def _joined(first: ActionTable, second: ActionTable) -> ActionTable:
    return ActionTable(
        np.concatenate((first.kinds, second.kinds)),
        np.concatenate((first.places, second.places)),
        np.concatenate((first.elements, second.elements)),
        np.concatenate((first.offsets, second.offsets + len(first.elements))),
    )


def _offsets(lengths: list[int]) -> I64:
    """Where runs of these lengths begin, int64 [run]."""
    return np.concatenate(([0], np.cumsum(lengths)[:-1])).astype(np.int64)
