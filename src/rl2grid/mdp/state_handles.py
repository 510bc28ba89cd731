"""A state as compiled code is handed it when that is called often: by the address of a handle."""

from __future__ import annotations

from rl2grid.handles import opener
from rl2grid.mdp.state import GridState

open_state = opener(GridState)
"""From the address of a handle to the state, in compiled code."""
