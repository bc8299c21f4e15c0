"""User-defined classes and functions by dotted name, ``package.module:name``, as in configuration files.

A name that the user writes resolves anywhere. A name in data (a run folder, a policy, a score table) resolves only to a
component of drivax, or within a module that the user trusts.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import inspect
import re
import sys
import typing
from collections.abc import Collection, Iterator, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from types import BuiltinFunctionType
from typing import Any

from drivax.errors import UsageError, did_you_mean

#: ``zoo:NAME`` is a policy of the package, never a module.
_FORM = re.compile(r"(?!zoo:)[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")
#: First arguments of reward terms and of features.
_TERM_ARGUMENTS = (("before", "now", "around"), ("bank", "context", "frames"))
#: Packages that are not on Python's path: the current folder is searched for their modules and what these import.
_local_packages: set[str] = set()


def is_dotted(value: Any) -> bool:
    """Return whether a value has the form ``package.module:name``."""
    return isinstance(value, str) and _FORM.fullmatch(value) is not None


def is_trusted(name: str, trust: Collection[str]) -> bool:
    """Return whether a name leads into drivax, or into one of these modules and packages."""
    module_name = name.partition(":")[0]
    return any(f"{module_name}.".startswith(f"{module}.") for module in ("drivax", *trust))


def find_named(name: str, trust: Collection[str] | None = None) -> Any:
    """Import the object with a dotted name.

    Modules are searched on Python's path first, then in the current folder, which later imports do not search.

    Args:
        name: ``package.module:name``.
        trust: None for a name that the user wrote; for a name in data, the modules that the user trusts.

    Raises:
        UsageError: The name is not dotted or not trusted, its module cannot be imported or lacks the object, or the
            object may not be named by data.
    """
    if not is_dotted(name):
        raise UsageError(f"{name!r} is not a dotted name", cure="write package.module:name")
    if trust is not None and not is_trusted(name, trust):
        raise UsageError(f"{name!r} is not part of drivax", cure=trust_cure([name]))
    module_name, _, path = name.partition(":")
    target, place = _import(module_name, name), module_name
    for attribute in path.split("."):
        if not hasattr(target, attribute):
            names = [member for member in getattr(target, "__dict__", ()) if not member.startswith("_")]
            cure = did_you_mean(attribute, names, otherwise=f"define {attribute} there")
            raise UsageError(f"{name!r}: {place!r} has no {attribute!r}", cure=cure)
        target, place = getattr(target, attribute), f"{place}{'.' if ':' in place else ':'}{attribute}"
    if trust is not None and not _may_be_named(target, name):
        raise UsageError(f"{name!r} is not a component of {module_name!r}", cure="do not use this file")
    return target


def trust_cure(names: Collection[str]) -> str:
    """Return the cure for names in data whose modules are not trusted."""
    modules = sorted({name.partition(":")[0] for name in names})
    flags = " ".join(f"--trust-code {module}" for module in modules)
    return f"read the code, then pass {flags} (in Python trust={modules})"


def _may_be_named(thing: Any, name: str) -> bool:
    """Return whether data may name an object: one that the package in the name defines, or a component of drivax.

    A component is a dataclass, an instance of one, or a reward term or feature of ``drivax.tasks`` (a pure function),
    without a leading underscore in its name.
    """
    if (package := _package_of(thing)) != "drivax":
        return package == name.partition(":")[0].partition(".")[0]
    is_private = re.search(r"(^|[.:])_", name) is not None
    return not is_private and (is_dataclass(thing) or _is_term(thing))


def _package_of(thing: Any) -> str:
    return str(getattr(thing, "__module__", None)).partition(".")[0]


def _is_term(thing: Any) -> bool:
    """Return whether an object is a reward term or a feature of drivax."""
    is_of_tasks = inspect.isfunction(thing) and thing.__module__.startswith("drivax.tasks.")
    return is_of_tasks and tuple(inspect.signature(thing).parameters)[:3] in _TERM_ARGUMENTS


def _import(module_name: str, name: str) -> Any:
    if module_name in sys.modules:
        return sys.modules[module_name]
    package = module_name.split(".")[0]
    if package not in sys.modules and importlib.util.find_spec(package) is None:
        _local_packages.add(package)
    try:
        with _current_folder() if package in _local_packages else contextlib.nullcontext():
            return importlib.import_module(module_name)
    except Exception as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing is not None and f"{module_name}.".startswith(f"{missing}."):
            cure = "install it, add its folder to PYTHONPATH, or run from its folder"
            if package == "drivax":  # A file may be of a newer version.
                cure = "upgrade drivax, or do not use this file"
            raise UsageError(f"{name!r}: module {missing!r} not found", cure=cure) from error
        problem = f"{name!r}: importing {module_name!r} fails with {type(error).__name__}: {error}"
        raise UsageError(problem, cure="fix the module") from error


@contextlib.contextmanager
def _current_folder() -> Iterator[None]:
    """Search the current folder last, only while a module that the user names is imported."""
    path, folder = sys.path, str(Path.cwd())
    is_new = folder not in path
    if is_new:
        path.append(folder)
        importlib.invalidate_caches()
    try:
        yield
    finally:
        if is_new and folder in path:
            path.remove(folder)


def dotted_name(thing: Any) -> str:
    """Return the dotted name of a function or class.

    Raises:
        UsageError: The name does not lead to the object: a lambda, an instance, or defined inside a function.
    """
    name = f"{getattr(thing, '__module__', None)}:{getattr(thing, '__qualname__', None)}"
    with contextlib.suppress(UsageError):
        if find_named(name) is thing:
            return name
    label = getattr(thing, "__qualname__", repr(thing))
    cure = "define it by def or class, at the top level of a module"
    raise UsageError(f"{label} cannot be saved in a configuration", cure=cure)


def check_arguments(function: Any, name: str, arguments: tuple[Any, ...]) -> None:
    """Check that a callable accepts a positional argument of each type; a term of drivax must annotate these types.

    Raises:
        ValueError: The signature differs or is unknown, as for some builtins.
    """
    hints = typing.get_type_hints(function) if _is_term(function) else {}
    if not _accepts(function, arguments) or (hints and tuple(hints.values())[: len(arguments)] != arguments):
        types = ", ".join(getattr(argument, "__name__", str(argument)) for argument in arguments)
        signature = _signature(function) or "unknown arguments"
        raise ValueError(f"{name!r} takes {signature}; it is called with ({types})")


def _accepts(function: Any, arguments: tuple[Any, ...]) -> bool:
    """Return whether a callable is known to accept these positional arguments."""
    signature = _signature(function)
    try:
        return signature is not None and signature.bind(*arguments) is not None
    except TypeError:
        return False


def _signature(function: Any) -> inspect.Signature | None:
    try:
        return inspect.signature(function)
    except (TypeError, ValueError):
        return None


def result_class(function: Any) -> type | None:
    """Return the class of the object that a class or function makes, from its annotation; None if unknown."""
    if isinstance(function, type):
        return function
    if isinstance(function, BuiltinFunctionType):
        return type(None)  # no builtin function makes a component
    try:
        result = typing.get_type_hints(function).get("return")
    except Exception:  # evaluating an annotation may raise any error
        return None
    return result if isinstance(result, type) else None


def makes(function: Any, protocol: Any) -> bool:
    """Return whether a class or function, called without arguments, may make an object of a protocol."""
    cls = result_class(function)
    methods = [name for name in protocol_members(protocol) if callable(getattr(protocol, name, None))]
    has_methods = cls is None or all(callable(getattr(cls, name, None)) for name in methods)
    return callable(function) and has_methods and _accepts(function, ())


def check_protocol(thing: Any, name: str, protocol: Any) -> None:
    """Check that an object, or a dataclass by its fields, has all members of a protocol.

    Raises:
        UsageError: A member is missing.
        ValueError: A method takes other arguments.
    """
    for member in protocol_members(protocol):
        if not hasattr(thing, member) and member not in getattr(thing, "__dataclass_fields__", ()):
            cure = f"see {protocol.__module__}.{protocol.__name__}"
            raise UsageError(f"{name!r} lacks {member!r}", cure=cure)
        _check_method(thing, name, member, getattr(protocol, member, None))


def _check_method(thing: Any, name: str, member: str, expected: Any) -> None:
    """Check the number of a method's arguments, and for objects of drivax also their names."""
    method = getattr(thing, member, None)
    if not inspect.isfunction(expected) or not callable(method):
        return
    # The signature of a bound method lacks `self`.
    arguments = tuple(inspect.signature(expected).parameters)[not isinstance(thing, type) :]
    signature = _signature(method)
    has_names = signature is not None and tuple(signature.parameters)[: len(arguments)] == arguments
    if not _accepts(method, arguments) or (_package_of(thing) == "drivax" and not has_names):
        raise ValueError(f"{name!r}: {member} takes {signature}, not ({', '.join(arguments)})")


def protocol_members(protocol: Any) -> list[str]:
    """Return the public members of a protocol and of the protocols that it extends."""
    names: list[str] = []
    for cls in reversed(protocol.__mro__):
        if getattr(cls, "_is_protocol", False) and cls.__name__ not in ("Protocol", "Generic"):
            members = [*vars(cls).get("__annotations__", {}), *vars(cls)]
            names += [n for n in members if not n.startswith("_") and n not in names]
    return names


def name_of(function: Any, name: str = "") -> str:
    """Return ``name``, else the name of the function, else that of its class in snake_case."""
    name = name or getattr(function, "__name__", None) or ""
    if not name:
        name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(function).__name__).lower()
    if not name.isidentifier():
        raise ValueError(f"{name!r} is not a name; pass one with name=")
    return name


def check_unique(section: str, names: Sequence[str], taken: Sequence[str]) -> None:
    """Raise a ValueError if a name occurs twice or is in ``taken``."""
    used = set(taken)
    for name in names:
        if name in used:
            raise ValueError(f"{section}: name {name!r} is taken; pass another with name=")
        used.add(name)
