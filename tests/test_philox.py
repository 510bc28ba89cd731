"""Random numbers of compiled code are those of the streams."""

import numpy as np
import pytest

from rl2grid.philox import fill_uniforms, stream_key
from rl2grid.streams import Purpose, Stream


@pytest.mark.parametrize("first", [0, 1, 2, 3, 4, 7, 1000, 2**20 + 1])
@pytest.mark.parametrize(("seed", "episode"), [(0, 0), (1, 2), (2**63 - 1, 5), (1_000_095, 2**40 + 3)])
def test_numbers_of_any_place_are_those_of_the_stream(seed: int, episode: int, first: int) -> None:
    expected = Stream(seed, episode, Purpose.SERIES).uniform(first + 9)[first:]
    for size in (0, 1, 3, 9):
        drawn = np.full(size, -1.0)
        fill_uniforms(seed, stream_key(episode, int(Purpose.SERIES)), first, drawn)
        np.testing.assert_array_equal(drawn, expected[:size])


def test_streams_of_one_seed_differ() -> None:
    drawn = np.empty((2, 8))
    fill_uniforms(3, stream_key(4, int(Purpose.START)), 0, drawn[0])
    fill_uniforms(3, stream_key(4, int(Purpose.OPPONENT)), 0, drawn[1])
    assert not np.isin(drawn[0], drawn[1]).any()
