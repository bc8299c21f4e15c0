"""Names in data: a run, a policy or a score table names code only of drivax, or of modules that the user trusts."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from drivax.errors import UsageError
from drivax.plugins import find_named, is_dotted, is_trusted, trust_cure
from drivax.settings.structure import Flag, plain


def check_names(values: Any, trust: Collection[str], file: Path | None = None) -> None:
    """Check the names in plain values of a file before one of them is used; those of flags are the user's.

    Raises:
        UsageError: A name leads to a module that is not trusted, or to something that is no component.
    """
    names = _names(values)
    if others := sorted(name for name in names if not is_trusted(name, trust)):
        raise UsageError(f"names code, {', '.join(others)}", file=file, cure=trust_cure(others))
    for name in sorted(names):
        try:
            find_named(name, trust)
        except UsageError as error:
            raise UsageError(error.problem, file=file, cure=error.cure) from error


def modules_of(record: Any) -> list[str]:
    """Return the modules outside drivax whose code a configuration names."""
    return sorted({name.partition(":")[0] for name in _names(plain(record)) if not is_trusted(name, ())})


def _names(values: Any) -> set[str]:
    """Return the dotted names in nested values, keys included."""
    return {text for text in _texts(values) if is_dotted(text)}


def _texts(values: Any) -> Iterator[str]:
    """Yield the texts in nested values other than flags; a list that YAML repeats by an alias counts once."""
    stack, seen = [values], set[int]()
    while stack:
        value = stack.pop()
        if isinstance(value, str) and not isinstance(value, Flag):
            yield value
        elif isinstance(value, Mapping | list | tuple) and id(value) not in seen:
            seen.add(id(value))
            stack += (*value, *value.values()) if isinstance(value, Mapping) else value
