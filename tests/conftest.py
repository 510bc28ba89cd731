"""What all tests share."""

import gc
import os

import pytest

from rl2grid.compile_notices import VARIABLE
from rl2grid.scenarios.making import MAKERS

os.environ[VARIABLE] = "1"  # what commands print is compared, whether or not something was compiled before
os.environ[MAKERS] = "0"  # tests need few years of training, and all cores


def pytest_collection_finish():
    """Libraries stay: the collector need not visit their million objects again and again."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def stable_baselines3_logs_where_pytest_cleans_up(tmp_path_factory: pytest.TempPathFactory):
    """Rather than in a new folder of the system's temporary files for every model."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_LOGDIR", str(tmp_path_factory.mktemp("stable-baselines3")))
        yield


@pytest.fixture(scope="session", autouse=True)
def files_of_grid2op_are_read_once():
    """To read a grid, of which several environments are made, is more than half of making one."""
    import pandapower  # here, as below: to import Grid2Op takes seconds, in the process that only hands out tests too
    import pandas as pd
    from grid2op_copies import read_once

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pandapower, "from_json", read_once(pandapower.from_json))
        patch.setattr(pd, "read_csv", read_once(pd.read_csv))
        yield


@pytest.fixture(scope="session", autouse=True)
def grid2op_environments_are_made_once():
    """Reference engines of this process copy the first Grid2Op environment of their kind."""
    from grid2op_copies import made_once

    from rl2grid.engines.reference import engine

    with pytest.MonkeyPatch.context() as patch:
        make = made_once(engine._make_grid2op, lambda grid, scenario, dispatch: (grid.id, dispatch))
        patch.setattr(engine, "_make_grid2op", make)
        yield
