"""Observations as graphs: busbars are nodes, lines are edges, in arrays of fixed shapes.

A graph is a function of the flat observation alone, so that final observations, stored ones and those of worker
processes can be converted too. Node ``s`` is busbar 1 of substation ``s``, node ``n_sub + s`` its busbar 2. Edges
``0 .. n_line - 1`` lead from a line's origin to its extremity, the next ``n_line`` back.

================= ============================ ======= ==============================================================
name              shape                        dtype   meaning
================= ============================ ======= ==============================================================
``nodes``         [2 n_sub, feature]           float32 sums over the elements on a busbar, see below
``node_mask``     [2 n_sub]                    int8    1 where an element is connected to the busbar
``edge_index``    [2, 2 n_line]                int64   source and target node (PyTorch Geometric's convention)
``edges``         [2 n_line, feature]          float32 features of the line, see below
``edge_mask``     [2 n_line]                   int8    0 for a line out of service; its index then names busbars 1
``t``             [1], or [7] with a calendar  float32 share of the episode, and the calendar
================= ============================ ======= ==============================================================

A graph has what the flat observation has, and no flows in MW, which that lacks. Features, in this order:

========================================================= =========== ====== ======================================
node feature                                              unit        tasks  with ``normalize="physical"`` over
========================================================= =========== ====== ======================================
``gen_p``, ``load_p``, ``storage_power``                  MW          T R H  the grid's largest ``gen_pmax``
``storage_charge``                                        MWh         T R H  the same number
``theta``: mean over generators, loads, storages; else 0  degrees     T R H  180
``theta_observed``: 1 where there is such an element      0 or 1      T R H  1
``elements``: of the substation's, share on this busbar   share       T R H  1
``time_before_cooldown_sub``: of the substation           steps       T H    ``rules.cooldown_sub``
``target_dispatch``, ``actual_dispatch``,
``gen_margin_up``, ``gen_margin_down``,
``gen_p_before_curtail``                                  MW          R H    the grid's largest ``gen_pmax``
``curtailment``, ``curtailment_limit``: times ``gen_pmax``
of the renewable generators                               MW          R H    the grid's largest ``gen_pmax``
========================================================= =========== ====== ======================================

Edge features are ``rho``, ``time_before_cooldown_line``, ``timestep_overflow`` (T, H), ``time_next_maintenance`` and
``duration_next_maintenance``, as in the flat observation, operator features of lines where they are observed, and
``forward``, 1 from origin to extremity.

Tasks ``R`` do not observe the topology, but cannot divide a substation either: all elements are on busbar 1, and a
line is in service where it carries current. After a game over no busbar and no line is in use.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rl2grid.envs.tasks import Task
from rl2grid.errors import UsageError
from rl2grid.mdp.features import (
    CALENDAR,
    OPERATOR_FEATURES,
    changes_topology,
    feature_slices,
    injects,
    operator_groups,
    operator_line_features,
    physical_scale,
)

Graph = dict[str, NDArray[Any]]
"""The arrays of the module's first table; those of many environments have them as first axis."""

_SHARED_NODE_FEATURES = ("gen_p", "load_p", "storage_power", "storage_charge", "theta", "theta_observed", "elements")
_REDISPATCH = ("target_dispatch", "actual_dispatch", "gen_margin_up", "gen_margin_down", "gen_p_before_curtail")
_CURTAILMENT = ("curtailment", "curtailment_limit")
_NODE_FEATURES = {
    "T": (*_SHARED_NODE_FEATURES, "time_before_cooldown_sub"),
    "R": (*_SHARED_NODE_FEATURES, *_REDISPATCH, *_CURTAILMENT),
    "H": (*_SHARED_NODE_FEATURES, "time_before_cooldown_sub", *_REDISPATCH, *_CURTAILMENT),
}
_MAINTENANCE = ("time_next_maintenance", "duration_next_maintenance")
_EDGE_FEATURES = {
    "T": ("rho", "time_before_cooldown_line", "timestep_overflow", *_MAINTENANCE, "forward"),
    "R": ("rho", "time_before_cooldown_line", *_MAINTENANCE, "forward"),
    "H": ("rho", "time_before_cooldown_line", "timestep_overflow", *_MAINTENANCE, "forward"),
}
_HALF_TURN = 180.0


class _Nodes(NamedTuple):
    """Where elements are: int64 [n, element], the number of nodes for an element that is off."""

    every: NDArray[np.int64]
    gen: NDArray[np.int64]
    load: NDArray[np.int64]
    storage: NDArray[np.int64]
    origin: NDArray[np.int64]
    extremity: NDArray[np.int64]


class GraphBuilder:
    """Makes graphs of the flat observations of one task."""

    def __init__(self, task: Task, normalize: str | None = "physical", operator_features: str | None = None) -> None:
        """``normalize``, ``operator_features``: the keywords with which the observations were made."""
        grid = task.grid
        self._grid, self._kind = grid, task.kind
        self._slices = feature_slices(grid, task.kind, operator_features)
        shift, scale = physical_scale(grid, task.kind, operator_features)
        times = OPERATOR_FEATURES[CALENDAR] if CALENDAR in operator_groups(operator_features) else ()
        self._physical = normalize == "physical"
        self._shift, self._scale = (shift, scale) if self._physical else (np.zeros_like(shift), np.ones_like(scale))
        self.node_features: tuple[str, ...] = _NODE_FEATURES[task.kind]
        """Names of the columns of ``nodes``."""
        *of_edges, forward = _EDGE_FEATURES[task.kind]
        self.edge_features: tuple[str, ...] = (*of_edges, *operator_line_features(operator_features), forward)
        """Names of the columns of ``edges``."""
        self.time_features: tuple[str, ...] = ("t", *times)
        """Names of the entries of ``t``."""
        self._node_scale = self._scale_of_nodes()

    @property
    def space(self) -> gymnasium.spaces.Dict:
        """The space of the graph of one observation."""
        n, m = 2 * self._grid.n_sub, 2 * self._grid.n_line
        real = {
            "nodes": (n, len(self.node_features)),
            "edges": (m, len(self.edge_features)),
            "t": (len(self.time_features),),
        }
        boxes: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32) for name, shape in real.items()
        }
        boxes["node_mask"] = gymnasium.spaces.Box(0, 1, (n,), np.int8)
        boxes["edge_mask"] = gymnasium.spaces.Box(0, 1, (m,), np.int8)
        boxes["edge_index"] = gymnasium.spaces.Box(0, n - 1, (2, m), np.int64)  # type: ignore[arg-type]
        return gymnasium.spaces.Dict(boxes)

    def graph(self, observation: NDArray[np.float32]) -> Graph:
        """The graph of one observation, float32 [feature]."""
        return {name: array[0] for name, array in self.graphs(observation[np.newaxis]).items()}

    def graphs(self, observations: NDArray[np.float32]) -> Graph:
        """The graphs of observations, float32 [n, feature], in new arrays with ``n`` as first axis."""
        raw = observations.astype(np.float64) * self._scale + self._shift
        features = {name: raw[:, part] for name, part in self._slices.items()}
        topology = self._topology(features)
        places = self._nodes(topology)
        in_use = self._sum(places.every, np.ones(topology.shape)) > 0
        in_service = (places.origin < 2 * self._grid.n_sub) & (places.extremity < 2 * self._grid.n_sub)
        return {
            "nodes": (self._node_values(features, places) / self._node_scale).astype(np.float32),
            "node_mask": in_use.astype(np.int8),
            "edge_index": self._edge_index(places, in_service),
            "edges": self._edge_values(observations),
            "edge_mask": np.tile(in_service, 2).astype(np.int8),
            "t": np.concatenate([observations[:, self._slices[name]] for name in self.time_features], axis=1),
        }

    def _topology(self, features: dict[str, NDArray[np.float64]]) -> NDArray[np.int64]:
        """Busbar of every element, int64 [n, element], -1 when off."""
        if changes_topology(self._kind):
            return np.rint(features["topo_vect"]).astype(np.int64)
        grid, carries = self._grid, features["rho"] > 0
        topology = np.ones((len(carries), grid.dim_topo), np.int64)
        topology[:, grid.line_or_pos_topo_vect] = np.where(carries, 1, -1)
        topology[:, grid.line_ex_pos_topo_vect] = np.where(carries, 1, -1)
        topology[~carries.any(axis=1)] = -1
        return topology

    def _nodes(self, topology: NDArray[np.int64]) -> _Nodes:
        grid = self._grid
        every = np.where(topology > 0, grid.element_to_subid + grid.n_sub * (topology - 1), 2 * grid.n_sub)
        return _Nodes(
            every,
            every[:, grid.gen_pos_topo_vect],
            every[:, grid.load_pos_topo_vect],
            every[:, grid.storage_pos_topo_vect],
            every[:, grid.line_or_pos_topo_vect],
            every[:, grid.line_ex_pos_topo_vect],
        )

    def _sum(self, nodes: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sums of the values [n, element] on each node, float64 [n, node]; elements that are off do not count."""
        n, width = len(nodes), 2 * self._grid.n_sub + 1
        flat = (nodes + width * np.arange(n)[:, np.newaxis]).ravel()
        sums = np.bincount(flat, weights=values.ravel(), minlength=n * width)
        return cast("NDArray[np.float64]", sums.reshape(n, width)[:, :-1])

    def _node_values(self, features: dict[str, NDArray[np.float64]], places: _Nodes) -> NDArray[np.float64]:
        grid = self._grid
        none = np.zeros((len(places.every), grid.n_storage))
        observed = np.concatenate((places.gen, places.load, places.storage), axis=1)
        angles = (features["gen_theta"], features["load_theta"], features.get("storage_theta", none))
        count = self._sum(observed, np.ones(observed.shape))
        columns = [
            self._sum(places.gen, features["gen_p"]),
            self._sum(places.load, features["load_p"]),
            self._sum(places.storage, features.get("storage_power", none)),
            self._sum(places.storage, features.get("storage_charge", none)),
            self._sum(observed, np.concatenate(angles, axis=1)) / np.maximum(count, 1),
            count > 0,
            self._sum(places.every, np.ones(places.every.shape)) / np.tile(grid.sub_info, 2),
        ]
        if changes_topology(self._kind):
            columns.append(np.tile(features["time_before_cooldown_sub"], 2))
        if injects(self._kind):
            renewable = np.where(grid.gen_renewable, grid.gen_pmax, 0.0)
            columns += [self._sum(places.gen, features[name]) for name in _REDISPATCH]
            columns += [self._sum(places.gen, features[name] * renewable) for name in _CURTAILMENT]
        return np.stack(columns, axis=-1)

    def _scale_of_nodes(self) -> NDArray[np.float64]:
        if not self._physical:
            return np.ones(len(self.node_features))
        largest = float(self._grid.gen_pmax.max())
        scales = dict.fromkeys(self.node_features, largest)
        scales |= {"theta": _HALF_TURN, "theta_observed": 1.0, "elements": 1.0}
        if changes_topology(self._kind):
            scales["time_before_cooldown_sub"] = max(float(self._grid.rules.cooldown_sub), 1.0)
        return np.array(list(scales.values()))

    def _edge_index(self, places: _Nodes, in_service: NDArray[np.bool_]) -> NDArray[np.int64]:
        grid = self._grid
        origin = np.where(in_service, places.origin, grid.line_or_to_subid)
        extremity = np.where(in_service, places.extremity, grid.line_ex_to_subid)
        there, back = np.concatenate((origin, extremity), axis=1), np.concatenate((extremity, origin), axis=1)
        return np.stack((there, back), axis=1)

    def _edge_values(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        columns = [observations[:, self._slices[name]] for name in self.edge_features if name != "forward"]
        edges = np.tile(np.stack(columns, axis=-1), (1, 2, 1))
        forward = np.broadcast_to(np.repeat([[1.0], [0.0]], self._grid.n_line, axis=0), (*edges.shape[:2], 1))
        return np.concatenate((edges, forward), axis=-1, dtype=np.float32)


class GraphObservation(gymnasium.ObservationWrapper[Graph, Any, NDArray[np.float32]]):
    """A task that observes graphs: ``observation_space`` is the ``Dict`` of the module's table.

    Raises:
        UsageError: another wrapper has changed the observations before, or the environment is no task of rl2grid.
    """

    def __init__(self, env: gymnasium.Env[NDArray[np.float32], Any]) -> None:
        super().__init__(env)
        self.builder = _builder(env)
        self.observation_space = cast("gymnasium.Space[Graph]", self.builder.space)

    def observation(self, observation: NDArray[np.float32]) -> Graph:
        """The graph of a flat observation."""
        return self.builder.graph(observation)


class VectorGraphObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """Many environments of a task that observe graphs, ``infos["final_obs"]`` included.

    Raises:
        UsageError: as :class:`GraphObservation`.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self.builder = _builder(env)
        self.single_observation_space = self.builder.space
        self.observation_space = batch_space(self.builder.space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Graph, dict[str, Any]]:
        """Begin an episode in every environment."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self.builder.graphs(observations), infos

    def step(self, actions: Any) -> tuple[Graph, NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step every environment."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        if "final_obs" in infos:
            finals = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(infos["_final_obs"]):
                finals[i] = self.builder.graph(infos["final_obs"][i])
            infos = {**infos, "final_obs": finals}
        return self.builder.graphs(observations), rewards, terminated, truncated, infos


def _builder(env: Any) -> GraphBuilder:
    base = env.unwrapped
    if not isinstance(getattr(base, "task", None), Task):
        raise UsageError(f"{type(base).__name__} is no task of rl2grid: only those have graphs.")
    if env.observation_space.shape != base.observation_space.shape or env.observation_space.dtype != np.float32:
        raise UsageError("Graphs are made of flat observations: wrap the task before other wrappers change them.")
    return GraphBuilder(base.task, base.options.normalize, base.options.operator_features)
