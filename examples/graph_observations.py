"""The grid as a graph: busbars are nodes, lines are edges. Prints a PyTorch Geometric `Data` where that is installed.

pip install -e ".[examples]" torch_geometric
python examples/graph_observations.py --steps 20
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium
import numpy as np

import rl2grid  # noqa: F401 - registers the tasks
from rl2grid.envs.graph import Graph, GraphObservation

try:
    import torch
    from torch_geometric.data import Data
except ImportError:
    Data = None


def in_use(graph: Graph) -> dict[str, np.ndarray]:
    """Nodes and edges that are in use now; nodes are numbered anew."""
    nodes, edges = graph["node_mask"].astype(bool), graph["edge_mask"].astype(bool)
    number = np.cumsum(nodes) - 1
    return {
        "x": graph["nodes"][nodes],
        "edge_index": number[graph["edge_index"][:, edges]],
        "edge_attr": graph["edges"][edges],
    }


def shown(arrays: dict[str, np.ndarray]) -> Any:
    """A `Data`, or the shapes of its arrays."""
    if Data is None:
        return ", ".join(f"{name} {array.dtype} {list(array.shape)}" for name, array in arrays.items())
    return Data(**{name: torch.from_numpy(array) for name, array in arrays.items()})


def main() -> None:
    """Switch at random and look at the graphs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20, help="decisions to play")
    steps = parser.parse_args().steps
    env = GraphObservation(gymnasium.make("rl2grid/bus14-T1-v0", heuristic="idle"))
    print("node features:", ", ".join(env.builder.node_features))
    print("edge features:", ", ".join(env.builder.edge_features))
    env.action_space.seed(0)
    graph, info = env.reset(seed=0)
    for _ in range(steps):
        print(shown(in_use(graph)))
        action = env.action_space.sample(env.unwrapped.action_masks().astype(np.int8))
        graph, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            print(f"survival: {info['survival']:.3f}")
            graph, info = env.reset()


if __name__ == "__main__":
    main()
