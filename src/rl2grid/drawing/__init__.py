"""Grids as pictures: what environments render and figures show. Needs Matplotlib, and nothing above the MDP."""
