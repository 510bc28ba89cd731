"""Environments of Grid2Op, made once and copied: to make one takes about a second, to copy it a hundredth."""

import copy
import functools
from unittest import mock

from rl2grid.engines.reference.extract import make_environment


def made_once(make, key):
    """``make``, whose results are made once for each ``key`` of the arguments; callers get copies."""
    originals = {}

    @functools.wraps(make)
    def copied(*arguments):
        name = key(*arguments)
        if name not in originals:
            originals[name] = _with_grids_read_once(make, *arguments)
        return originals[name].copy()

    return copied


def _with_grids_read_once(make, *arguments):
    """``make(*arguments)``: to read a grid, of which several environments are made, is more than half of it."""
    import pandapower  # here: that takes seconds, and most tests need no Grid2Op

    read = pandapower.from_json

    def read_once(file):
        if file not in _GRIDS:
            _GRIDS[file] = read(file)
        return copy.deepcopy(_GRIDS[file])

    with mock.patch.object(pandapower, "from_json", read_once):
        return make(*arguments)


_GRIDS = {}

copied_environment = made_once(make_environment, lambda name: name)
"""The bundled environment of this name, to be changed and closed at will."""
