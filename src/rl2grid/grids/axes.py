"""How long the axes of arrays are that have an entry for every element of a grid."""

from __future__ import annotations

from rl2grid.grids.grid import Grid


def axis_sizes(grid: Grid) -> dict[str, int]:
    """Size of each axis: lines, generators, loads, storage units, substations, their elements, and buses."""
    return {
        "line": grid.n_line,
        "gen": grid.n_gen,
        "load": grid.n_load,
        "storage": grid.n_storage,
        "sub": grid.n_sub,
        "topo": grid.dim_topo,
        "bus": 2 * grid.n_sub,
    }
