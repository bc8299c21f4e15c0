"""Things of the user's own by dotted name, ``package.module:name``: how YAML says what Python would import.

Below every room but the errors, so that rooms which know no YAML can find what a configuration names.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
from pathlib import Path
from typing import Any

from drivax.errors import UsageError, did_you_mean

_FORM = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")


def is_dotted(value: Any) -> bool:
    """Whether a value has the form of a dotted name: words with dots, one colon."""
    return isinstance(value, str) and _FORM.fullmatch(value) is not None


def find_named(name: str) -> Any:
    """What a dotted name stands for; its module is imported.

    Modules are looked for where Python looks, and then in the present folder.

    Raises:
        UsageError: The name is no dotted name, its module cannot be imported, or has nothing of that name.
    """
    if not is_dotted(name):
        raise UsageError(f"{name!r} is no dotted name", cure="write package.module:name")
    module_name, _, path = name.partition(":")
    found = _module(module_name, name)
    for part in path.split("."):
        if not hasattr(found, part):
            inside = [known for known in vars(found) if not known.startswith("_")]
            raise UsageError(f"{name!r}: {module_name!r} has no {part!r}", cure=did_you_mean(part, inside))
        found = getattr(found, part)
    return found


def _module(module_name: str, name: str) -> Any:
    if module_name in sys.modules:
        return sys.modules[module_name]
    top = module_name.split(".")[0]
    here = str(Path.cwd())
    if here not in sys.path and top not in sys.modules and importlib.util.find_spec(top) is None:
        sys.path.append(here)
        importlib.invalidate_caches()
    try:
        return importlib.import_module(module_name)
    except Exception as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and (module_name == missing or module_name.startswith(f"{missing}.")):
            raise UsageError(
                f"{name!r}: there is no module {missing!r}",
                cure="install it, put its folder on PYTHONPATH, or start in its folder",
            ) from error
        told = f"{type(error).__name__}: {error}"
        raise UsageError(
            f"{name!r}: importing {module_name!r} fails with {told}", cure="correct it there"
        ) from error


def dotted_name(thing: Any) -> str:
    """The dotted name of a function or class.

    Raises:
        UsageError: It has none, as a lambda or what was defined inside a function.
    """
    name = f"{getattr(thing, '__module__', None)}:{getattr(thing, '__qualname__', None)}"
    try:
        found = find_named(name)
    except UsageError:
        found = None
    if found is not thing:
        shown = getattr(thing, "__qualname__", repr(thing))
        raise UsageError(
            f"{shown} has no name that a file could hold", cure="define it at the top level of a module"
        )
    return name


def refuse_arguments(thing: Any, name: str, wanted: tuple[Any, ...]) -> None:
    """Refuses a callable that cannot take these positional arguments.

    Raises:
        ValueError: It takes others.
    """
    try:
        signature = inspect.signature(thing)
    except (TypeError, ValueError):
        return  # builtins say nothing
    try:
        signature.bind(*wanted)
    except TypeError as error:
        types = ", ".join(getattr(one, "__name__", str(one)) for one in wanted)
        raise ValueError(f"{name!r} takes {signature}; it is called with ({types})") from error


def refuse_missing(thing: Any, name: str, protocol: Any) -> None:
    """Refuses what lacks a member of a protocol.

    Raises:
        ValueError: Names the first that is missing.
    """
    for member in protocol_members(protocol):
        if not hasattr(thing, member):
            raise ValueError(f"{name!r} lacks {member!r}; see {protocol.__module__}.{protocol.__name__}")


def protocol_members(protocol: Any) -> list[str]:
    """Names of what a protocol asks for, those of the protocols that it extends included."""
    names: list[str] = []
    for cls in reversed(protocol.__mro__):
        if getattr(cls, "_is_protocol", False) and cls.__name__ not in ("Protocol", "Generic"):
            own = [*vars(cls).get("__annotations__", {}), *vars(cls)]
            names += [n for n in own if not n.startswith("_") and n not in names]
    return names
