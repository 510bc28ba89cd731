"""Environments of Grid2Op, made once and copied: to make one takes about a second, to copy it a hundredth."""

import copy
import functools
import os

from rl2grid.engines.reference.extract import make_environment


def read_once(read):
    """``read``, by which a file is read once for all that ask for it in the same way; callers get copies."""
    contents = {}

    @functools.wraps(read)
    def copied(file, **options):
        if not isinstance(file, str | os.PathLike) or not os.path.isfile(file) or options.get("chunksize"):
            return read(file, **options)
        about = os.stat(file)
        name = (os.fspath(file), about.st_mtime_ns, about.st_size, repr(options))
        if name not in contents:
            contents[name] = read(file, **options)
        return copy.deepcopy(contents[name])

    return copied


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
