"""YAML to plain values to configuration records and back; errors name the line, or the dotted path of the wrong value.

YAML follows the 1.2 core rules: ``3e-4`` is a number, ``no`` a string, ``010`` ten; duplicate keys are errors.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import cattrs
import yaml
from cattrs.errors import ClassValidationError, ForbiddenExtraKeysError, IterableValidationError
from cattrs.gen import make_dict_structure_fn

from drivax.errors import DrivaxError, UsageError, did_you_mean
from drivax.plugins import check_arguments, check_protocol, dotted_name, find_named, is_dotted

_UNIONS = (Union, types.UnionType)
#: Types of values that are accepted for a scalar, and its name in messages.
_SCALARS: dict[Any, tuple[Any, str]] = {
    bool: (bool, "true or false"),
    int: (int, "an integer"),
    float: (int | float, "a number"),
    type(None): (type(None), "null"),
}


class _Problem(ValueError):
    """A wrong value and its path inside the enclosing one."""

    def __init__(self, problem: str, path: str) -> None:
        super().__init__(problem)
        self.problem = problem
        self.path = path


class Flag(str):
    """The text of a command-line value, parsed by the type of its setting."""

    __slots__ = ()


def structure(values: Any, cls: Any) -> Any:
    """Return an instance of ``cls`` from plain values; ValueError ``path: problem; cure`` of the first wrong value."""
    try:
        return _converter().structure(values, cls)
    except Exception as error:
        problem, path = _first_problem(error, "")
        raise ValueError(f"{path}: {problem}" if path else problem) from error


def plain(record: Any) -> Any:
    """Return a record as mappings, lists and scalars; members of unions carry ``kind``."""
    return _to_plain(record, type(record))


def kind_of(cls: type) -> str:
    """Return the ``kind:`` of a record in a union: the default of its field ``kind``, else its name in snake_case."""
    for field in dataclasses.fields(cls):
        if field.name == "kind":
            return str(field.default)
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", cls.__name__).lower()


def _value(value: Any) -> Any:
    if not isinstance(value, Flag):
        return value
    try:
        return parse_yaml(str(value))
    except UsageError as error:
        raise _refuse(value, "a value that YAML can read") from error


def _refuse(value: Any, expected: str) -> ValueError:
    return ValueError(f"{str(value) if isinstance(value, Flag) else value!r} is not {expected}")


def _to_scalar(value: Any, cls: Any) -> Any:
    result = _value(value)
    if cls is int and isinstance(result, float) and result.is_integer():
        result = int(result)  # steps: 25e6
    accepted, name = _SCALARS[cls]
    if isinstance(result, bool) != (cls is bool) or not isinstance(result, accepted):
        raise _refuse(value, name)
    return float(result) if cls is float else result


def _to_str(value: Any, _: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r} is not text (quote it)")
    return str(value)


def _to_path(value: Any, _: Any) -> Path:
    return Path(value if isinstance(value, Path) else _to_str(value, None))


def _to_literal(value: Any, cls: Any) -> Any:
    allowed = get_args(cls)
    for option in (value, _value(value)):
        for candidate in allowed:
            if type(option) in (type(candidate), Flag) and option == candidate:
                return candidate
    near = did_you_mean(str(value), [str(option) for option in allowed])
    raise ValueError(f"{str(value)!r} is not one of {', '.join(map(str, allowed))}; {near}")


def _to_tuple(value: Any, cls: Any) -> tuple[Any, ...]:
    items = _value(value)
    if not isinstance(items, list | tuple):
        raise _refuse(value, "a list")
    members: tuple[Any, ...] = get_args(cls)
    if len(members) == 2 and members[1] is Ellipsis:
        members = (members[0],) * len(items)
    if not members:
        return tuple(items)
    if len(members) != len(items):
        raise ValueError(f"{len(items)} values, not {len(members)}")
    result = []
    for number, (item, member) in enumerate(zip(items, members, strict=True)):
        try:
            result.append(_converter().structure(item, member))
        except Exception as error:
            raise _Problem(*_first_problem(error, f"[{number}]")) from error
    return tuple(result)


def _to_union(value: Any, cls: Any) -> Any:
    members = get_args(cls)
    records = {kind_of(member): member for member in members if _is_record(member)}
    value = _value(value) if isinstance(value, Flag) and records else value
    for member in members:
        if _is_open(member) and is_dotted(_kind(value)):
            return _to_own(value, member)
    if isinstance(value, str) and value in records:
        return _converter().structure({}, records[value])
    if isinstance(value, Mapping) and records:
        return _to_record_of_kind(dict(value), records)
    problems = []
    for member in sorted(members, key=_specific):
        if not _is_record(member):
            try:
                return _converter().structure(value, member)
            except (ValueError, TypeError, ClassValidationError, IterableValidationError) as error:
                if member is not type(None):
                    problems.append(_first_problem(error, "")[0])
    if records:
        raise ValueError(f"{value!r} is not a section with a kind ({', '.join(records)})")
    raise ValueError(" and ".join(problems))


def _kind(value: Any) -> Any:
    return value.get("kind") if isinstance(value, Mapping) else value


def _to_own(value: Any, cls: Any) -> Any:
    """Return the user's own object, named by a dotted name or the kind of a section, whose rest a dataclass takes."""
    value = _value(value)
    name = _kind(value)
    if not isinstance(name, str):
        expected = "a dotted name (package.module:name) nor a section with such a kind"
        raise ValueError(f"{value!r} is neither {expected}")
    thing = find_named(name)
    rest = {key: item for key, item in value.items() if key != "kind"} if isinstance(value, Mapping) else {}
    if _is_record(thing):
        thing = _converter().structure(rest, thing)
    elif rest:
        raise ValueError(f"{name!r} takes no settings; make it a frozen dataclass")
    if _is_protocol(cls):
        check_protocol(thing, name, cls)
        return thing
    if not callable(thing):
        raise ValueError(f"{name!r} is not callable; name a function")
    arguments = get_args(cls)[0] if get_args(cls) else ...
    if arguments is not ...:
        check_arguments(thing, name, tuple(arguments))
    return thing


def _specific(member: Any) -> int:
    """Return the order in which members of a union are tried: numbers from narrow to wide, text last."""
    order = (type(None), bool, int, float)
    return order.index(member) if member in order else len(order) + (member is str)


def _to_record_of_kind(value: dict[str, Any], records: dict[str, Any]) -> Any:
    if len(records) == 1 and "kind" not in value:
        return _converter().structure(value, next(iter(records.values())))
    if "kind" not in value:
        raise ValueError(f"has no kind; use one of {', '.join(records)}")
    kind = str(value["kind"])
    if kind not in records:
        raise ValueError(f"unknown kind {kind!r}; {did_you_mean(kind, list(records))}")
    if "kind" not in {field.name for field in dataclasses.fields(records[kind])}:
        del value["kind"]
    return _converter().structure(value, records[kind])


def _record_hook(cls: Any, converter: cattrs.BaseConverter) -> Any:
    options: dict[str, Any] = {"_cattrs_forbid_extra_keys": True, "_cattrs_detailed_validation": True}
    build = make_dict_structure_fn(cls, converter, **options)

    def hook(value: Any, _: Any) -> Any:
        value = {} if value is None else _value(value)
        if is_dotted(value):
            record = find_named(value)
            if not isinstance(record, cls):
                raise ValueError(f"{value!r} is not a {cls.__name__}")
            return record
        if not isinstance(value, Mapping):
            names = ", ".join(field.name for field in dataclasses.fields(cls))
            raise _refuse(value, f"a section of settings ({names})")
        renamed = getattr(cls, "renamed", {})
        value = {renamed.get(key, key): item for key, item in value.items()}
        if _names_preset(cls, value):
            base = cls.preset(str(value["preset"]))
            rest = {name: given for name, given in value.items() if name != "preset"}
            value = _merge_defaults(_to_plain(base, cls), base, rest)
        return build(_on_defaults(cls, value), cls)

    return hook


def _on_defaults(cls: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``given`` with nested sections completed from the defaults of this record, not from their own."""
    result = dict(given)
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        section = _value(given.get(field.name)) if _is_record(type(default)) else None
        if isinstance(section, Mapping):
            result[field.name] = _merge_defaults(_to_plain(default, hints[field.name]), default, section)
    return result


def _names_preset(cls: Any, given: Mapping[str, Any]) -> bool:
    """Whether a section starts from a preset of its record, ``cls.preset(name)``."""
    named = {field.name for field in dataclasses.fields(cls)}
    return "preset" in given and "preset" not in named and callable(getattr(cls, "preset", None))


def _merge_defaults(base: dict[str, Any], default: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    other_kind = "kind" in values and str(values["kind"]) != kind_of(type(default))
    if other_kind or _names_preset(type(default), values):
        return dict(values)
    result = base | dict(values)
    for name, value in values.items():
        inner = getattr(default, name, None)
        if _is_record(type(inner)) and isinstance(value, Mapping):
            result[name] = _merge_defaults(base[name], inner, value)
    return result


def _is_record(cls: Any) -> bool:
    return isinstance(cls, type) and dataclasses.is_dataclass(cls)


def _is_protocol(cls: Any) -> bool:
    return isinstance(cls, type) and bool(getattr(cls, "_is_protocol", False))


def _is_callable(cls: Any) -> bool:
    return cls is Callable or get_origin(cls) is Callable


def _is_open(cls: Any) -> bool:
    """Whether the type accepts the user's own object."""
    return _is_protocol(cls) or _is_callable(cls)


@functools.cache
def _converter() -> cattrs.Converter:
    converter = cattrs.Converter()
    for cls, hook in {**dict.fromkeys(_SCALARS, _to_scalar), str: _to_str, Path: _to_path}.items():
        converter.register_structure_hook(cls, hook)
    converter.register_structure_hook_func(lambda cls: get_origin(cls) is Literal, _to_literal)
    converter.register_structure_hook_func(lambda cls: cls is tuple or get_origin(cls) is tuple, _to_tuple)
    converter.register_structure_hook_func(lambda cls: get_origin(cls) in _UNIONS, _to_union)
    converter.register_structure_hook_func(_is_open, _to_own)
    converter.register_structure_hook_factory(_is_record, _record_hook)
    return converter


def _first_problem(error: BaseException, path: str) -> tuple[str, str]:
    """Return the first problem inside a cattrs error and its dotted path."""
    if isinstance(error, ForbiddenExtraKeysError):
        names = [field.name for field in dataclasses.fields(error.cl)]
        unknown = sorted(error.extra_fields)[0]
        return f"unknown setting; {did_you_mean(unknown, names)}", _join(path, unknown)
    if isinstance(error, ClassValidationError | IterableValidationError):
        noted, plain_errors = error.group_exceptions()
        if noted:
            inner, note = noted[0]
            name = getattr(note, "name", None)
            step = _join(path, name) if name is not None else f"{path}[{getattr(note, 'index', '?')}]"
            return _first_problem(inner, step)
        return _first_problem(plain_errors[0], path)
    if isinstance(error, _Problem):
        return error.problem, path + error.path if error.path.startswith("[") else _join(path, error.path)
    if isinstance(error, KeyError):
        return f"the setting {error.args[0]!r} is missing", path
    if isinstance(error, TypeError) and "missing" in str(error):
        return str(error).split(") ")[-1], path
    if isinstance(error, DrivaxError):
        return error.problem + (f"; {error.cure}" if error.cure else ""), path
    return str(error) or type(error).__name__, path


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _to_plain(value: Any, declared: Any) -> Any:
    """Convert a value to the mappings, lists and scalars of YAML."""
    if _is_record(type(value)):
        hints = typing.get_type_hints(type(value))
        fields = {f.name: _to_plain(getattr(value, f.name), hints[f.name]) for f in dataclasses.fields(value)}
        if any(map(_is_open, (declared, *_members(declared)))) and type(value) not in _members(declared):
            return {"kind": dotted_name(type(value))} | {k: v for k, v in fields.items() if k != "kind"}
        tagged = "kind" not in fields and any(_is_record(member) for member in _members(declared))
        return {"kind": kind_of(type(value))} | fields if tagged else fields
    if isinstance(value, Mapping):
        member = get_args(declared)[-1] if get_args(declared) else Any
        return {str(key): _to_plain(item, member) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_plain(item, _item_type(declared, number)) for number, item in enumerate(value)]
    if callable(value):
        return dotted_name(value)
    return str(value) if isinstance(value, Path) else value


def _members(declared: Any) -> tuple[Any, ...]:
    return get_args(declared) if get_origin(declared) in _UNIONS else ()


def _item_type(declared: Any, number: int) -> Any:
    for candidate in (declared, *_members(declared)):
        if get_origin(candidate) in (tuple, list):
            members = get_args(candidate)
            return members[0] if members[-1] is Ellipsis or len(members) <= number else members[number]
    return Any


def parse_yaml(text: str, file: Path | None = None) -> Any:
    """Return the plain values of a YAML text; raises UsageError with the line of invalid YAML or a duplicate key."""
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or "invalid"
        place = "YAML" if mark is None else f"line {mark.line + 1}"
        raise UsageError(f"{place}: {problem}", file=file, cure="fix the file") from error


def write_yaml(values: Any) -> str:
    """Return mappings, lists and scalars as YAML; :func:`parse_yaml` is the inverse."""
    options: dict[str, Any] = {"sort_keys": False, "default_flow_style": None, "allow_unicode": True}
    return yaml.dump(values, Dumper=_Dumper, width=100, **options)


class _Loader(yaml.SafeLoader):
    """Reads YAML 1.2 core scalars and refuses duplicate keys."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str) or key in seen:
                problem = "appears twice" if isinstance(key, str) else "is not a string"
                mark = key_node.start_mark
                raise yaml.constructor.ConstructorError(None, None, f"the key {key!r} {problem}", mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Quotes strings that the loader would read as other types."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_NUMBER = r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
_FLOAT = rf"^(?:{_NUMBER}|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
_RULES = (
    ("tag:yaml.org,2002:bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("tag:yaml.org,2002:int", r"^[-+]?[0-9][0-9_]*$", "-+0123456789"),
    ("tag:yaml.org,2002:float", _FLOAT, "-+.0123456789"),
    ("tag:yaml.org,2002:null", r"^(?:~|null|Null|NULL|None|)$", ["~", "n", "N", ""]),
)


def _set_rules(cls: Any) -> None:
    cls.yaml_implicit_resolvers = {}
    for tag, pattern, first in _RULES:
        cls.add_implicit_resolver(tag, re.compile(pattern), list(first))


def _construct_int(loader: Any, node: Any) -> int:
    return int(loader.construct_scalar(node))  # 010 is ten


_set_rules(_Loader)
_set_rules(_Dumper)
_Loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
