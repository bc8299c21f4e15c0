"""Scripts of ``experiments`` for tests of what they measure."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent


def load_script(name: str) -> ModuleType:
    """Import a module of ``experiments``, such as ``learning.benchmark``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(REPOSITORY)
        return importlib.import_module(f"experiments.{name}")
