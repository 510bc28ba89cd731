"""A data folder of its own for the tests of this folder."""

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="session", autouse=True)
def data_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RL2GRID_DATA", str(tmp_path_factory.mktemp("data")))
        patch.delenv("RL2GRID_FULL_DATA", raising=False)
        yield
