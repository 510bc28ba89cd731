"""The simulators that play the decision process."""

from collections.abc import Mapping

ENGINES: tuple[str, ...] = ("native", "reference")
"""Engines by name: ``native`` is ours, compiled; ``reference`` is Grid2Op with LightSim2Grid."""

HEURISTICS: tuple[str, ...] = ("idle", "recovery", "careful", "secure")
"""What may play while the grid is safe (``secure``: and bears losses, and units are at rest); without one, the agent
decides every step."""

INJECTION_RULES: Mapping[str, int] = {"secure": 2}
"""Version of a heuristic's rules on redispatching and joint tasks, where it is not the first."""

DISPATCHES: tuple[str, ...] = ("exact", "grid2op")
"""How the redispatch problem of a step is solved; see ``docs/dispatch.md``."""
