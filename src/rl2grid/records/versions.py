"""Versions of everything that a result depends on."""

from __future__ import annotations

import platform
from importlib import metadata

TARGETS_VERSION = 2
"""Version of what algorithms learn from. 1 counted the steps that a reset plays into the first transition, whose
consequences weighed next to nothing then; 2 counts every transition from its decision."""

LIBRARIES: tuple[str, ...] = ("rl2grid", "grid2op", "lightsim2grid", "numba", "numpy", "gymnasium", "torch")
"""Packages whose version is part of the identity of a result."""


def processor() -> str:
    """The kind of processor, as compilers name it, as ``x86_64 znver4``; on one, results are equal to the last bit."""
    from llvmlite.binding import get_host_cpu_name  # here: names of versions are wanted where nothing is compiled

    return f"{platform.machine()} {get_host_cpu_name()}"


def library_versions() -> dict[str, str]:
    """Versions of Python and of :data:`LIBRARIES`; packages that are not installed are left out."""
    versions = {"python": platform.python_version()}
    for library in LIBRARIES:
        try:
            versions[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return versions
