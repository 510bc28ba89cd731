"""Environments of Grid2Op, made once and copied: to make one takes about a second, to copy it a hundredth."""

import functools

from rl2grid.engines.reference.extract import make_environment


def made_once(make, key):
    """``make``, whose results are made once for each ``key`` of the arguments; callers get copies."""
    originals = {}

    @functools.wraps(make)
    def copied(*arguments):
        name = key(*arguments)
        if name not in originals:
            originals[name] = make(*arguments)
        return originals[name].copy()

    return copied


copied_environment = made_once(make_environment, lambda name: name)
"""The bundled environment of this name, to be changed and closed at will."""
