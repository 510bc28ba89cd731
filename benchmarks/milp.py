"""Nodes and seconds of the programmes of the agent ``milp``: ``python benchmarks/milp.py bus14-T0 4``.

The first programme of stressed training states (``heuristic="idle"``, seeds from 0), solved to optimality; months that
end before their first decision are left out. Seconds are the solver's alone.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium
import numpy as np

import rl2grid  # noqa: F401  (registers the tasks)
from rl2grid.agents import linear_programme
from rl2grid.agents.dc_flow import dc_point
from rl2grid.agents.milp import best_action
from rl2grid.mdp.actions import full_catalogue
from rl2grid.powerflow.model import load_network

TIME_LIMIT = 120.0
"""Seconds per state."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task")
    parser.add_argument("seeds", type=int)
    options = parser.parse_args()
    solve = linear_programme.milp
    measured: list[tuple[int, int, float]] = []

    def timed(*arguments: Any, **keywords: Any) -> Any:
        began = time.perf_counter()
        result = solve(*arguments, **keywords)
        measured.append((seed, result.mip_node_count, time.perf_counter() - began))
        return result

    env = gymnasium.make(f"rl2grid/{options.task}-v0", heuristic="idle", disable_env_checker=True)
    base: Any = env.unwrapped
    linear_programme.milp = timed
    for seed in range(options.seeds):
        _, info = env.reset(seed=seed)
        if info["over"]:
            continue
        point = dc_point(base.state, 0, base.grid, load_network(base.grid))
        catalogue = full_catalogue(base.grid).take(base.action_catalogue_ids)
        last_busbar = np.ones(base.grid.dim_topo, np.int32)
        best_action(base.grid, point, catalogue, base.action_masks(), last_busbar, TIME_LIMIT)
    for seed, nodes, seconds in measured:
        print(f"seed {seed}: {nodes} nodes, {seconds:.2f} s")


if __name__ == "__main__":
    main()
