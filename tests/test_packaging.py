"""An installed package is the whole package."""

import ast
import tomllib
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Names of the files in the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    (path,) = WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    return set(zipfile.ZipFile(path).namelist())


def test_the_wheel_holds_every_module_and_every_data_file(wheel: set[str]) -> None:
    present = {
        path.relative_to(SOURCE).as_posix()
        for path in (SOURCE / "rl2grid").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {path.partition("/")[2].partition("/")[0] for path in present} >= {"cli", "grids", "mdp", "algorithms"}
    assert any(path.endswith(".npz") for path in present)
    assert present == {path for path in wheel if path.startswith("rl2grid/")}


def test_every_folder_of_modules_is_a_package() -> None:
    for module in (SOURCE / "rl2grid").rglob("*.py"):
        assert (module.parent / "__init__.py").is_file(), module


def test_commands_lead_to_a_function(wheel: set[str]) -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    assert "rl2grid" in scripts
    for target in scripts.values():
        module, _, function = target.partition(":")
        path = f"{module.replace('.', '/')}.py"
        assert path in wheel
        body = ast.parse((SOURCE / path).read_text(encoding="utf-8")).body
        assert function in {node.name for node in body if isinstance(node, ast.FunctionDef)}
