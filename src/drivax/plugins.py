"""User-defined classes and functions by dotted name, ``package.module:name``, as in configuration files."""

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
    """Return whether a value has the form ``package.module:name``."""
    return isinstance(value, str) and _FORM.fullmatch(value) is not None


def find_named(name: str) -> Any:
    """Import the object with a dotted name.

    Modules are searched on Python's path first, then in the current folder.

    Raises:
        UsageError: The name is not dotted, its module cannot be imported, or the module lacks the object.
    """
    if not is_dotted(name):
        raise UsageError(f"{name!r} is not a dotted name", cure="write package.module:name")
    module_name, _, path = name.partition(":")
    target = _import(module_name, name)
    for attribute in path.split("."):
        if not hasattr(target, attribute):
            names = [candidate for candidate in vars(target) if not candidate.startswith("_")]
            cure = did_you_mean(attribute, names, otherwise=f"define {attribute} there")
            raise UsageError(f"{name!r}: {module_name!r} has no {attribute!r}", cure=cure)
        target = getattr(target, attribute)
    return target


def _import(module_name: str, name: str) -> Any:
    if module_name in sys.modules:
        return sys.modules[module_name]
    package, folder = module_name.split(".")[0], str(Path.cwd())
    if folder not in sys.path and package not in sys.modules and importlib.util.find_spec(package) is None:
        sys.path.append(folder)
        importlib.invalidate_caches()
    try:
        return importlib.import_module(module_name)
    except Exception as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and (module_name == missing or module_name.startswith(f"{missing}.")):
            raise UsageError(
                f"{name!r}: module {missing!r} not found",
                cure="install it, add its folder to PYTHONPATH, or run from its folder",
            ) from error
        raise UsageError(
            f"{name!r}: importing {module_name!r} fails with {type(error).__name__}: {error}",
            cure="fix the module",
        ) from error


def dotted_name(thing: Any) -> str:
    """Return the dotted name of a function or class.

    Raises:
        UsageError: The object is a lambda, or defined inside a function.
    """
    name = f"{getattr(thing, '__module__', None)}:{getattr(thing, '__qualname__', None)}"
    try:
        target = find_named(name)
    except UsageError:
        target = None
    if target is not thing:
        label = getattr(thing, "__qualname__", repr(thing))
        raise UsageError(
            f"{label} cannot be saved in a configuration", cure="define it at the top level of a module"
        )
    return name


def check_arguments(function: Any, name: str, arguments: tuple[Any, ...]) -> None:
    """Check that a callable accepts these positional arguments.

    Raises:
        ValueError: The signature differs.
    """
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return  # builtins have no signature
    try:
        signature.bind(*arguments)
    except TypeError as error:
        types = ", ".join(getattr(argument, "__name__", str(argument)) for argument in arguments)
        raise ValueError(f"{name!r} takes {signature}; it is called with ({types})") from error


def check_protocol(thing: Any, name: str, protocol: Any) -> None:
    """Check that an object has all members of a protocol.

    Raises:
        ValueError: A member is missing.
    """
    for member in protocol_members(protocol):
        if not hasattr(thing, member):
            raise ValueError(f"{name!r} lacks {member!r}; see {protocol.__module__}.{protocol.__name__}")


def protocol_members(protocol: Any) -> list[str]:
    """Return the public members of a protocol and of the protocols that it extends."""
    names: list[str] = []
    for cls in reversed(protocol.__mro__):
        if getattr(cls, "_is_protocol", False) and cls.__name__ not in ("Protocol", "Generic"):
            members = [*vars(cls).get("__annotations__", {}), *vars(cls)]
            names += [n for n in members if not n.startswith("_") and n not in names]
    return names
