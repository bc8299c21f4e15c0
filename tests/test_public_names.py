"""The public surface: every exported name imports and is documented."""

from __future__ import annotations

import ast
import importlib
import inspect
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "src" / "drivax"
STUBS = sorted(PACKAGE.rglob("__init__.pyi"))
#: Modules, not packages, with public names.
MODULES = [PACKAGE / "errors.py"]


def module_name(file: Path) -> str:
    place = file.parent if file.stem == "__init__" else file.with_suffix("")
    return ".".join(place.relative_to(PACKAGE.parent).parts)


@pytest.mark.parametrize("file", [*STUBS, *MODULES], ids=module_name)
def test_exported_names_import_and_are_documented(file: Path):
    module = importlib.import_module(module_name(file))
    assert module.__doc__
    assert module.__all__
    for name in module.__all__:
        if name in {neighbour.stem for neighbour in file.parent.glob("*.py")}:
            importlib.import_module(f"{module.__name__}.{name}")  # It must not hide the function of its name.
        value = getattr(module, name)
        assert not inspect.ismodule(value), f"{module.__name__}.{name} is a module"
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), f"{module.__name__}.{name} has no docstring"


def test_packages_export_names():
    """Packages without names of their own are commands, and road families, which ``roads`` exports."""
    packages = {file.parent for file in PACKAGE.rglob("__init__.py")}
    silent = sorted(
        module_name(folder / "__init__.py") for folder in packages - {stub.parent for stub in STUBS}
    )
    assert silent == ["drivax.cli", "drivax.synthetic.roads.families"]


@pytest.mark.parametrize("stub", STUBS, ids=module_name)
def test_exports_name_their_module_and_keep_their_name(stub: Path):
    for node in ast.parse(stub.read_text()).body:
        assert isinstance(node, ast.ImportFrom), f"{stub}: {ast.unparse(node)}"
        assert node.level == 1, f"{stub}: {ast.unparse(node)}"
        assert all(alias.name == alias.asname for alias in node.names)
        assert not any(alias.name.startswith("_") for alias in node.names)


def test_one_level_has_what_a_user_needs():
    import drivax

    needed = {
        "generate", "convert", "load", "ScenarioSet", "Scenario", "make_simulator", "Task", "ObservationConfig",
        "RewardConfig", "train", "evaluate", "compare", "curate", "write_report", "jax_planner", "python_planner",
        "make", "make_agent", "make_planner",
    }  # fmt: skip
    assert needed <= set(drivax.__all__) <= set(dir(drivax))
    with pytest.raises(AttributeError):
        _ = drivax.no_such_name
