"""Names of a user's own terms and groups."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any


def own_name(function: Any, given: str = "") -> str:
    """The name that a term goes by: the given one, or the function's, or its class's in snake_case.

    Raises:
        ValueError: The name is no word, as that of a lambda.
    """
    name = given or getattr(function, "__name__", None)
    if name is None:
        name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(function).__name__).lower()
    if not name.isidentifier():
        raise ValueError(f"{name!r} is no name; give it one with name=")
    return name


def refuse_taken(where: str, names: Sequence[str], taken: Sequence[str]) -> None:
    """Refuses names that something else bears.

    Raises:
        ValueError: Names the first.
    """
    seen = set(taken)
    for name in names:
        if name in seen:
            raise ValueError(f"{where} has {name!r}, a name that is taken; give another with name=")
        seen.add(name)
