"""What all tests share."""

import os

import pytest
from grid2op_copies import made_once

from rl2grid.compile_notices import VARIABLE
from rl2grid.engines.reference import engine
from rl2grid.scenarios.making import MAKERS

os.environ[VARIABLE] = "1"  # what commands print is compared, whether or not something was compiled before
os.environ[MAKERS] = "0"  # tests need few years of training, and all cores


@pytest.fixture(scope="session", autouse=True)
def grid2op_environments_are_made_once():
    """Reference engines of this process copy the first Grid2Op environment of their kind."""
    with pytest.MonkeyPatch.context() as patch:
        make = made_once(engine._make_grid2op, lambda grid, scenario, dispatch: (grid.id, dispatch))
        patch.setattr(engine, "_make_grid2op", make)
        yield
