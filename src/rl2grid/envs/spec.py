"""What a policy observes and what it can do, as one value: networks are built from it.

Of a task of rl2grid, a :class:`Spec` tells which entries of the flat observation belong to which elements of the grid,
how elements are connected, and what every action does to which of them. Of any other Gymnasium task with a flat
observation it tells the sizes alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from rl2grid.envs.graph import GraphBuilder
from rl2grid.envs.joint import discrete_of
from rl2grid.envs.tasks import Task, find_task
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.mdp.actions import ActionCatalogue, ContinuousLayout, continuous_layout, level_catalogue
from rl2grid.mdp.features import (
    ALL_GROUPS,
    CALENDAR,
    OPERATOR_FEATURES,
    feature_slices,
    operator_line_features,
    physical_scale,
)

ELEMENTS = ("time", "gen", "load", "line", "element", "sub", "storage")
"""What entries of an observation can belong to; ``element`` is an entry of the topology vector."""

_OF = {
    "t": "time",
    "rho": "line",
    "line_status": "line",
    "timestep_overflow": "line",
    "time_before_cooldown_line": "line",
    "time_next_maintenance": "line",
    "duration_next_maintenance": "line",
    "topo_vect": "element",
    "time_before_cooldown_sub": "sub",
    "target_dispatch": "gen",
    "actual_dispatch": "gen",
    "curtailment": "gen",
    "curtailment_limit": "gen",
    **dict.fromkeys(OPERATOR_FEATURES[CALENDAR], "time"),
    **dict.fromkeys(operator_line_features(ALL_GROUPS), "line"),
}
"""Features whose name does not begin with what they are of."""


@dataclass(frozen=True)
class Feature:
    """Consecutive entries of an observation."""

    name: str
    """As in the table of :mod:`rl2grid.mdp.features`."""
    begin: int
    end: int
    of: str
    """One of :data:`ELEMENTS`: entry ``begin + k`` is of the ``k``-th such element."""


@dataclass(frozen=True, eq=False)
class JointActions:
    """The two parts of a joint task's action, flattened or not; see :mod:`rl2grid.envs.joint`."""

    topology: ActionCatalogue
    injection: ContinuousLayout


@dataclass(frozen=True, eq=False)
class Spec:
    """What a policy observes and what it can do; read-only, picklable, at most some 100 kB but for large catalogues."""

    observation_size: int
    """Entries of the flat observation, float32."""
    action_size: int
    """Discrete actions, or dimensions of a continuous one in [-1, 1]. Of a joint task: of the flattened action."""
    continuous: bool
    """A joint task's are continuous by themselves (:class:`~rl2grid.envs.joint.JointAsBox`)."""
    task: str | None = None
    """Id of the task of rl2grid; None: another environment, of which there is nothing below."""
    normalize: str | None = None
    """The keyword with which observations are made."""
    operator_features: str | None = None
    """Likewise."""
    features: tuple[Feature, ...] = ()
    """The observation from its first to its last entry."""
    shift: NDArray[np.float32] | None = None
    """[observation_size]; ``entry * scale + shift`` is in physical units."""
    scale: NDArray[np.float32] | None = None
    """[observation_size]"""
    grid: Grid | None = None
    """Substations, the elements at them (``*_to_subid``), and their places in ``topo_vect`` (``*_pos_topo_vect``)."""
    actions: ActionCatalogue | ContinuousLayout | JointActions | None = None
    """Discrete: kind, target and moved elements of every action. Continuous: what every dimension controls. Joint:
    both."""

    def feature(self, name: str) -> Feature:
        """The feature called ``name``.

        Raises:
            UsageError: it is not observed.
        """
        for feature in self.features:
            if feature.name == name:
                return feature
        names = ", ".join(feature.name for feature in self.features) or "nothing but numbers without names"
        raise UsageError(f"Feature {name!r} is not observed here: there are {names}.")

    def graph_builder(self) -> GraphBuilder:
        """What makes graphs of such observations; see :mod:`rl2grid.envs.graph`.

        Raises:
            UsageError: the environment has no grid.
        """
        if self.task is None:
            raise UsageError("Only tasks of rl2grid have graphs: this environment has no grid.")
        return GraphBuilder(find_task(self.task), self.normalize, self.operator_features)

    def state_dict(self) -> dict[str, Any]:
        """Plain values from which :func:`spec_from_state` makes it again."""
        return {
            "observation_size": self.observation_size,
            "action_size": self.action_size,
            "continuous": self.continuous,
            "task": self.task,
            "normalize": self.normalize,
            "operator_features": self.operator_features,
        }


def task_spec(task: Task, normalize: str | None = "physical", operator_features: str | None = None) -> Spec:
    """The spec of environments of a task; ``normalize`` and ``operator_features`` as they are made with."""
    grid, kind = task.grid, task.kind
    slices = feature_slices(grid, kind, operator_features)
    shift, scale = physical_scale(grid, kind, operator_features)
    if normalize != "physical":
        shift, scale = np.zeros_like(shift), np.ones_like(scale)
    for array in (shift, scale):
        array.setflags(write=False)
    return Spec(
        observation_size=len(shift),
        action_size=task.n_actions,
        continuous=task.injects,
        task=task.id,
        normalize=normalize,
        operator_features=operator_features,
        features=tuple(Feature(name, part.start, part.stop, _element(name)) for name, part in slices.items()),
        shift=shift,
        scale=scale,
        grid=grid,
        actions=_actions(task, grid),
    )


def _actions(task: Task, grid: Grid) -> ActionCatalogue | ContinuousLayout | JointActions:
    if not task.changes_topology:
        return continuous_layout(grid)
    catalogue = level_catalogue(grid, task.level)
    return JointActions(catalogue, continuous_layout(grid)) if task.injects else catalogue


def spec_of(env: Any) -> Spec:
    """The spec of an environment or of a vector of them.

    What the task defines is in it where observations and actions still are those of the task: a wrapper may have
    changed them.

    Raises:
        UsageError: observations that are no vectors, or actions that are neither ``Discrete`` nor vectors, as those of
            joint tasks that are not flattened.
    """
    observations = getattr(env, "single_observation_space", None) or env.observation_space
    actions = getattr(env, "single_action_space", None) or env.action_space
    base = env.unwrapped
    task = getattr(base, "task", None)
    shape = observations.shape
    if shape is None or len(shape) != 1:
        raise UsageError(f"Policies read flat observations, not observations of shape {shape}.")
    if isinstance(actions, gymnasium.spaces.Discrete):
        sizes = Spec(int(shape[0]), int(actions.n), continuous=False)
    elif isinstance(actions, gymnasium.spaces.Box) and len(actions.shape) == 1:
        sizes = Spec(int(shape[0]), int(actions.shape[0]), continuous=True)
    elif isinstance(actions, gymnasium.spaces.Dict) and isinstance(task, Task):
        raise UsageError(
            f"Policies play Discrete actions and vectors, not the joint ones of {task.id}: wrap it in JointAsBox or "
            "JointAsDiscrete of rl2grid.envs.joint, a vector in VectorJointAsBox or VectorJointAsDiscrete."
        )
    else:
        raise UsageError(f"Policies play Discrete actions and vectors, not {actions}.")
    if not isinstance(task, Task):
        return sizes
    return _with_task(sizes, task_spec(task, base.options.normalize, base.options.operator_features))


def spec_from_state(state: Mapping[str, Any]) -> Spec:
    """The spec whose ``state_dict`` this was; without what its task defines if that has changed since.

    Raises:
        UsageError: there is no such task any more.
    """
    sizes = Spec(state["observation_size"], state["action_size"], state["continuous"])
    if state["task"] is None:
        return sizes
    # Policies that were stored before there were such features do not name them.
    return _with_task(sizes, task_spec(find_task(state["task"]), state["normalize"], state.get("operator_features")))


def _with_task(sizes: Spec, spec: Spec) -> Spec:
    """What a task defines, where the sizes are those of the task."""
    assert spec.task is not None
    task = find_task(spec.task)
    if task.kind == "H" and not sizes.continuous and sizes.action_size == discrete_of(task).n:
        spec = replace(spec, action_size=sizes.action_size, continuous=False)
    mine, theirs = ((each.observation_size, each.action_size, each.continuous) for each in (spec, sizes))
    return spec if mine == theirs else sizes


def _element(feature: str) -> str:
    return _OF.get(feature) or feature.split("_")[0]
