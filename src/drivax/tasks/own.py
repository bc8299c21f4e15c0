"""Names of users' own terms and groups."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any


def name_of(function: Any, name: str = "") -> str:
    """Return ``name``, or that of the function, or that of its class in snake_case."""
    name = name or getattr(function, "__name__", None) or ""
    if not name:
        name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(function).__name__).lower()
    if not name.isidentifier():
        raise ValueError(f"{name!r} is not a name; pass one with name=")
    return name


def check_unique(section: str, names: Sequence[str], taken: Sequence[str]) -> None:
    """Check that names are distinct and not taken."""
    used = set(taken)
    for name in names:
        if name in used:
            raise ValueError(f"{section}: name {name!r} is taken; pass another with name=")
        used.add(name)
