"""The public surface: every exported name imports and is documented."""

from __future__ import annotations

import ast
import importlib
import inspect
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "src" / "drivax"
STUBS = sorted(PACKAGE.rglob("__init__.pyi"))


def module_name(stub: Path) -> str:
    return ".".join(stub.parent.relative_to(PACKAGE.parent).parts)


@pytest.mark.parametrize("stub", STUBS, ids=module_name)
def test_exported_names_import_and_are_documented(stub: Path):
    module = importlib.import_module(module_name(stub))
    assert module.__doc__
    assert module.__all__
    for name in module.__all__:
        value = getattr(module, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), f"{module.__name__}.{name} has no docstring"


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
        "make", "make_agent",
    }  # fmt: skip
    assert needed <= set(drivax.__all__) <= set(dir(drivax))
    with pytest.raises(AttributeError):
        _ = drivax.no_such_name
