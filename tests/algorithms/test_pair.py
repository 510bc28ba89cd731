"""Two functions at once."""

import threading

import pytest

from rl2grid.algorithms.pair import Pair


@pytest.mark.parametrize("at_once", [False, True])
def test_both_results_come_back_in_order(at_once):
    assert Pair(at_once).run(lambda: 1, lambda: 2) == (1, 2)


def test_they_run_at_once():
    meeting = threading.Barrier(2, timeout=10)
    assert len(set(Pair(at_once=True).run(meeting.wait, meeting.wait))) == 2


@pytest.mark.parametrize("at_once", [False, True])
@pytest.mark.parametrize("place", [0, 1])
def test_what_either_raises_is_raised(at_once, place):
    functions = [lambda: None, lambda: None]
    functions[place] = lambda: 1 / 0
    pair = Pair(at_once)
    with pytest.raises(ZeroDivisionError):
        pair.run(*functions)
    assert pair.run(lambda: 1, lambda: 2) == (1, 2)
