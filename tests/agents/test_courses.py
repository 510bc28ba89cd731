"""What agents have in common that let others play on."""

from __future__ import annotations

import pytest

from rl2grid.agents.foresight import Foresight
from rl2grid.agents.rehearsal import Rehearsal
from rl2grid.errors import UsageError


@pytest.mark.parametrize("agent", [Foresight, Rehearsal])
def test_nonsense_is_refused(agent):
    for attempts in (0, 2.5, "many", True, None):
        with pytest.raises(UsageError, match=r"attempts=.* is not allowed: give a whole number"):
            agent(attempts=attempts)
    with pytest.raises(UsageError, match="guide='planner' is not allowed: give an agent"):
        agent("planner")
