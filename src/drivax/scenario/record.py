"""Data records: frozen dataclasses that are pytrees."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, TypeVar, cast, dataclass_transform

import jax

Record = TypeVar("Record")


def static(*, default: Any = MISSING) -> Any:
    """Declare a field that is part of the pytree structure: hashable, and fixed when a program is compiled."""
    return field(default=default, metadata={"static": True})


@dataclass_transform(frozen_default=True, field_specifiers=(field, static))
def record(cls: type[Record]) -> type[Record]:
    """Make a class a frozen dataclass and a pytree.

    Unflattening bypasses ``__init__``: transformations put objects other than arrays into leaves, which a constructor
    that checks shapes would refuse.
    """
    data_class = dataclass(frozen=True)(cls)
    leaf_names = tuple(f.name for f in fields(cast(Any, data_class)) if not f.metadata.get("static"))
    static_names = tuple(f.name for f in fields(cast(Any, data_class)) if f.metadata.get("static"))

    def flatten(value: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        return tuple(getattr(value, n) for n in leaf_names), tuple(getattr(value, n) for n in static_names)

    def flatten_with_keys(value: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        keyed_leaves = tuple((jax.tree_util.GetAttrKey(n), getattr(value, n)) for n in leaf_names)
        return keyed_leaves, tuple(getattr(value, n) for n in static_names)

    def unflatten(aux: tuple[Any, ...], children: Iterable[Any]) -> Any:
        value = object.__new__(data_class)
        for name, child in (*zip(leaf_names, children, strict=True), *zip(static_names, aux, strict=True)):
            object.__setattr__(value, name, child)
        return value

    jax.tree_util.register_pytree_with_keys(data_class, flatten_with_keys, unflatten, flatten)
    return data_class
