"""What ``import rl2grid`` does: its tasks are registered with Gymnasium, and the systems of a user.

Gymnasium takes a tenth of a second and NumPy another; help and lists of tasks need neither. Gymnasium 1 loads no
plugins by itself. Importing ``rl2grid`` therefore registers the tasks at once if Gymnasium is there, and otherwise
leaves a finder that does so at the end of its import.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

from rl2grid.errors import UsageError

VARIABLE = "RL2GRID_SYSTEMS"
"""Environment variable that names what registers a user's systems when ``rl2grid`` is imported: modules or Python
files, separated as in ``PATH``. Commands and the processes that they start know the systems by it."""

_GYMNASIUM = "gymnasium"


class _GymnasiumFinder:
    """Finds Gymnasium where the finders behind it do, and registers the tasks at the end of its import.

    A ``MetaPathFinder`` without the name, the import of which takes as long as all else here.
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """None for every other module."""
        if fullname != _GYMNASIUM:
            return None
        others = (finder for finder in sys.meta_path if not isinstance(finder, _GymnasiumFinder))
        spec = next(filter(None, (finder.find_spec(fullname, path, target) for finder in others)), None)
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        def exec_module(module: ModuleType) -> None:
            execute(module)
            _register_all()

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def register_with_gymnasium() -> None:
    """Have Gymnasium know the tasks from now on, or from when it is imported."""
    if sys.modules.get(_GYMNASIUM) is not None:
        _register_all()
    else:
        sys.meta_path.insert(0, _GymnasiumFinder())


def _register_all() -> None:
    from rl2grid.envs.registration import register_all

    register_all()


def register_from_environment() -> None:
    """Import what :data:`VARIABLE` names.

    Raises:
        UsageError: there is no such module or file.
    """
    for name in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        if name.endswith(".py"):
            _run_file(Path(name))
            continue
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise UsageError(
                f"{VARIABLE} names {name!r}, which cannot be imported ({error}): give modules or Python files."
            ) from error


def _run_file(file: Path) -> None:
    import importlib.util

    name = f"rl2grid_systems_{file.stem}"
    if name in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(name, file)
    if not file.is_file() or spec is None or spec.loader is None:
        raise UsageError(f"{VARIABLE} names {file}, and there is no such file: give modules or Python files.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
