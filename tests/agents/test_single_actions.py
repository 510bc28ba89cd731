"""The example of docs/algorithms/greedy.md: observations labelled with an agent's actions."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "docs" / "algorithms" / "greedy.md"


def example() -> str:
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[0]


@pytest.mark.parametrize(
    ("task", "agent", "shape"), [("bus14-T0-v0", "greedy", ()), ("bus14-T0-v0", "greedy-n1", ()),
                                 ("bus14-R-v0", "greedy", (6,)), ("bus14-R-v0", "dc-opf", (6,))]
)  # fmt: skip
def test_the_example_labels_observations(task, agent, shape):
    names: dict[str, Any] = {}
    exec(example().replace("bus14-T0-v0", task).replace('"greedy"', f'"{agent}"'), names)
    observations, labels = names["dataset"]
    assert observations.dtype == np.float32
    assert observations.shape == (20, *names["env"].observation_space.shape)
    assert labels.shape == (20, *shape)
    assert all(label in names["env"].action_space for label in labels)
    assert len(np.unique(observations[:, 0])) == 20
