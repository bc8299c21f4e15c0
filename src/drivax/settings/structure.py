"""Conversion of YAML to plain values, of plain values to configuration records, and back.

Errors name the line, or the dotted path of the wrong value. YAML follows the 1.2 core rules: ``3e-4`` is a number,
``no`` a string, ``010`` ten. Unlike in YAML 1.2, ``0x10`` and ``0o17`` are strings, ``1_000`` is a number and ``None``
null. Duplicate keys, and keys that are not strings, are errors.
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
from drivax.reading import DAMAGE

_UNIONS = (Union, types.UnionType)
#: Largest numbers of characters, nested levels and values (aliases expanded) of a YAML text; 100 characters of a text
#: count as another value, so that messages and checks of names stay short.
_MOST_CHARACTERS, _MOST_LEVELS, _MOST_VALUES, _TEXT_VALUE = 1 << 20, 64, 50_000, 100
#: Accepted types of values for each scalar type, and its name in messages.
_SCALARS: dict[Any, tuple[Any, str]] = {
    bool: (bool, "true or false"),
    int: (int, "an integer"),
    float: (int | float, "a number"),
    type(None): (type(None), "null"),
}


class _Problem(ValueError):
    """A wrong value, with its path inside the enclosing value, and a cure."""

    def __init__(self, problem: str, path: str = "", cure: str | None = None) -> None:
        super().__init__(problem)
        self.problem = problem
        self.path = path
        self.cure = cure


class FlagText(str):
    """The text of a command-line value, parsed by the type of its setting."""

    __slots__ = ()


class NameAlone(str):
    """The key ``kind`` of a section that was written as a bare name; plain mappings, which have no kind, ignore it."""

    __slots__ = ()


def structure(values: Any, cls: Any) -> Any:
    """Return an instance of ``cls`` from plain values.

    Raises:
        UsageError: ``path: problem; cure`` of the first wrong value.
    """
    try:
        return _converter().structure(values, cls)
    except Exception as error:
        first = _first_problem(error, "")
        problem = f"{first.path}: {first.problem}" if first.path else first.problem
        raise UsageError(problem, cure=first.cure or "correct this setting") from error


def plain(record: Any) -> Any:
    """Return a record as mappings, lists and scalars; members of unions carry ``kind``."""
    return _to_plain(record, type(record))


def kind_of(cls: type) -> str:
    """Return the ``kind:`` of a record in a union: the default of its field ``kind``, else its name in snake_case."""
    for field in dataclasses.fields(cls):
        if field.name == "kind":
            return str(field.default)
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", cls.__name__).lower()


def _parse_flag(value: Any) -> Any:
    """Parse the text of a command-line flag; return any other value unchanged."""
    if not isinstance(value, FlagText):
        return value
    try:
        return parse_yaml(str(value))
    except UsageError as error:
        raise _refusal(value, "a value that YAML can read") from error


def _refusal(value: Any, expected: str) -> ValueError:
    return ValueError(f"{str(value) if isinstance(value, FlagText) else value!r} is not {expected}")


def _to_scalar(value: Any, cls: Any) -> Any:
    """Convert to a boolean, number or null; integers may be written as floats, floats as integers."""
    result = _parse_flag(value)
    if cls is int and isinstance(result, float) and result.is_integer():
        result = int(result)  # such as steps: 25e6
    accepts, name = _SCALARS[cls]
    if isinstance(result, bool) != (cls is bool) or not isinstance(result, accepts):
        raise _refusal(value, name)
    return float(result) if cls is float else result


def _to_str(value: Any, _: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r} is not text (quote it)")
    return str(value)


def _to_path(value: Any, _: Any) -> Path:
    return Path(value if isinstance(value, Path) else _to_str(value, None))


def _to_literal(value: Any, cls: Any) -> Any:
    """Return the option that equals a value; a flag is compared as text, then as the YAML value of its text."""
    options = get_args(cls)
    for candidate in (value, _parse_flag(value)):
        for literal in options:
            if type(candidate) in (type(literal), FlagText) and candidate == literal:
                return literal
    names = [str(option) for option in options]
    quotes = "without quotes" if isinstance(value, str) else "in quotes"
    cure = f"write it {quotes}" if str(value) in names else did_you_mean(str(value), names)
    raise _Problem(f"{str(value)!r} is not one of {', '.join(map(str, options))}", cure=cure)


def _to_tuple(value: Any, cls: Any) -> tuple[Any, ...]:
    items = _parse_flag(value)
    if not isinstance(items, list | tuple):
        raise _refusal(value, "a list")
    members: tuple[Any, ...] = get_args(cls)
    if len(members) == 2 and members[1] is Ellipsis:
        members = (members[0],) * len(items)
    if not members:
        return tuple(items)
    if len(members) != len(items):
        raise ValueError(f"{len(items)} values, not {len(members)}")
    pairs = enumerate(zip(items, members, strict=True))
    return tuple(_to_item(item, member, f"[{number}]") for number, (item, member) in pairs)


def _to_mapping(value: Any, cls: Any) -> dict[str, Any]:
    """Convert to a mapping from text to values of its item type."""
    items = _parse_flag(value)
    if not isinstance(items, Mapping):
        raise _refusal(value, "a mapping")
    item_type = get_args(cls)[1]
    entries = {name: item for name, item in items.items() if not isinstance(name, NameAlone)}
    return {name: _to_item(item, item_type, str(name)) for name, item in entries.items()}


def _to_item(value: Any, cls: Any, place: str) -> Any:
    """Convert a value within a list or a mapping; problems name its place there."""
    try:
        return _converter().structure(value, cls)
    except Exception as error:  # hooks and the converter raise errors of several types
        raise _first_problem(error, place) from error


def _to_union(value: Any, cls: Any) -> Any:
    """Convert to a user-defined object, to a record by its kind, or to the first other type that fits."""
    members = get_args(cls)
    records = {kind_of(member): member for member in members if _is_record(member)}
    # A flag may hold a section, {kind: ...}. Without records, leave it to the members, so that text stays text.
    value = _parse_flag(value) if isinstance(value, FlagText) and records else value
    for member in members:
        if _accepts_user_objects(member) and is_dotted(_kind(value)):
            return _to_user_object(value, member)
    if isinstance(value, str) and value in records:
        return _converter().structure({}, records[value])
    if isinstance(value, Mapping) and records:
        return _to_record_of_kind(dict(value), records)
    problems: list[_Problem] = []
    for member in sorted(members, key=_rank_member):
        if not _is_record(member):
            try:
                return _converter().structure(value, member)
            except (ValueError, TypeError, ClassValidationError, IterableValidationError) as error:
                if member is not type(None):
                    problems.append(_first_problem(error, ""))
    if records:
        raise ValueError(f"{value!r} is not a section with a kind ({', '.join(records)})")
    cure = next((problem.cure for problem in problems if problem.cure), None)
    raise _Problem(" and ".join(problem.problem for problem in problems), cure=cure)


def _kind(value: Any) -> Any:
    """Return the kind of a section, or any other value, which may name a kind itself."""
    return value.get("kind") if isinstance(value, Mapping) else value


def _to_user_object(value: Any, cls: Any) -> Any:
    """Return a user-defined object by its dotted name, or from a section with that ``kind`` and settings."""
    value = _parse_flag(value)
    name = _kind(value)
    if not isinstance(name, str):
        forms = "a dotted name (package.module:name) nor a section with such a kind"
        raise ValueError(f"{value!r} is neither {forms}")
    user_object = find_named(name)
    items = value.items() if isinstance(value, Mapping) else ()
    options = {key: item for key, item in items if key != "kind"}
    if options and not _is_record(user_object):
        raise _Problem(f"{name!r} takes no settings", cure="make it a frozen dataclass")
    if _is_protocol(cls):
        check_protocol(user_object, name, cls)
    else:
        _check_callable(user_object, name, cls)
    return _converter().structure(options, user_object) if _is_record(user_object) else user_object


def _check_callable(user_object: Any, name: str, cls: Any) -> None:
    """Check that a function, or an instance of a dataclass, can be called with the arguments of ``cls``."""
    function, instance = user_object, ()
    if isinstance(user_object, type):
        has_call = _is_record(user_object) and any("__call__" in vars(base) for base in user_object.__mro__)
        function, instance = (user_object.__call__ if has_call else None), (user_object,)
    if not callable(function):
        raise _Problem(f"{name!r} is not callable", cure="name a function")
    arguments = get_args(cls)[0] if get_args(cls) else ...
    if arguments is not ...:
        check_arguments(function, name, (*instance, *arguments))


def _rank_member(member: Any) -> int:
    """Rank a member of a union in the order of attempts: numbers from narrow to wide, text last."""
    order = (type(None), bool, int, float)
    return order.index(member) if member in order else len(order) + (member is str)


def _to_record_of_kind(value: dict[str, Any], records: dict[str, Any]) -> Any:
    """Convert a section to the record of its ``kind``, which may be missing if there is only one."""
    if len(records) == 1 and "kind" not in value:
        return _converter().structure(value, next(iter(records.values())))
    if "kind" not in value:
        raise _Problem("has no kind", cure=f"use one of {', '.join(records)}")
    kind = str(value["kind"])
    if kind not in records:
        raise _Problem(f"unknown kind {kind!r}", cure=did_you_mean(kind, list(records)))
    if "kind" not in {field.name for field in dataclasses.fields(records[kind])}:
        del value["kind"]
    return _converter().structure(value, records[kind])


def _record_hook(cls: Any, converter: cattrs.BaseConverter) -> Any:
    """Return the hook of a record class: it accepts null, a mapping (with ``preset``), or an instance's dotted name."""
    options: dict[str, Any] = {"_cattrs_forbid_extra_keys": True, "_cattrs_detailed_validation": True}
    build = make_dict_structure_fn(cls, converter, **options)

    def hook(value: Any, _: Any) -> Any:
        """Return the record of a value, with the defaults of ``cls`` or of the preset that it names."""
        value = {} if value is None else _parse_flag(value)
        if is_dotted(value):
            record = find_named(value)
            if not isinstance(record, cls):
                raise ValueError(f"{value!r} is not a {cls.__name__}")
            return record
        if not isinstance(value, Mapping):
            names = ", ".join(field.name for field in dataclasses.fields(cls))
            raise _refusal(value, f"a section of settings ({names})")
        new_names = getattr(cls, "renamed", {})
        value = {new_names.get(key, key): item for key, item in value.items()}
        if _names_preset(cls, value):
            base = cls.preset(str(value["preset"]))
            changes = {name: item for name, item in value.items() if name != "preset"}
            value = _merge_defaults(_to_plain(base, cls), base, changes)
        return build(_complete_sections(cls, value), cls)

    return hook


def _complete_sections(cls: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Complete nested sections with the defaults of the enclosing record, not with those of their own class."""
    result = dict(values)
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        default = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        section = _parse_flag(values.get(field.name)) if _is_record(type(default)) else None
        if isinstance(section, Mapping):
            result[field.name] = _merge_defaults(_to_plain(default, hints[field.name]), default, section)
    return result


def _names_preset(cls: Any, values: Mapping[str, Any]) -> bool:
    """Return whether a section starts from a preset of its record, ``cls.preset(name)``."""
    field_names = {field.name for field in dataclasses.fields(cls)}
    return "preset" in values and "preset" not in field_names and callable(getattr(cls, "preset", None))


def _merge_defaults(base: dict[str, Any], default: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``values`` on top of ``base`` (``default`` as plain values), unless they name a kind or preset."""
    changes_kind = "kind" in values and str(values["kind"]) != kind_of(type(default))
    if changes_kind or _names_preset(type(default), values):
        return dict(values)
    result = base | dict(values)
    for name, value in values.items():
        nested_default = getattr(default, name, None)
        if _is_record(type(nested_default)) and isinstance(value, Mapping):
            result[name] = _merge_defaults(base[name], nested_default, value)
    return result


def _is_record(cls: Any) -> bool:
    return isinstance(cls, type) and dataclasses.is_dataclass(cls)


def _is_protocol(cls: Any) -> bool:
    return isinstance(cls, type) and bool(getattr(cls, "_is_protocol", False))


def _accepts_user_objects(cls: Any) -> bool:
    """Return whether a type accepts user-defined objects."""
    return _is_protocol(cls) or cls is Callable or get_origin(cls) is Callable


@functools.cache
def _converter() -> cattrs.Converter:
    converter = cattrs.Converter()
    for cls, hook in {**dict.fromkeys(_SCALARS, _to_scalar), str: _to_str, Path: _to_path}.items():
        converter.register_structure_hook(cls, hook)
    converter.register_structure_hook_func(lambda cls: get_origin(cls) is Literal, _to_literal)
    converter.register_structure_hook_func(lambda cls: cls is tuple or get_origin(cls) is tuple, _to_tuple)
    converter.register_structure_hook_func(lambda cls: get_origin(cls) is dict, _to_mapping)
    converter.register_structure_hook_func(lambda cls: get_origin(cls) in _UNIONS, _to_union)
    converter.register_structure_hook_func(_accepts_user_objects, _to_user_object)
    converter.register_structure_hook_factory(_is_record, _record_hook)
    return converter


def _first_problem(error: BaseException, path: str) -> _Problem:
    """Return the first problem inside a cattrs error, with its dotted path below ``path``."""
    if isinstance(error, ForbiddenExtraKeysError):
        names = [field.name for field in dataclasses.fields(error.cl)]
        name = min(error.extra_fields)
        return _Problem("unknown setting", _join(path, name), did_you_mean(name, names))
    if isinstance(error, ClassValidationError | IterableValidationError):
        inner_errors, own_errors = error.group_exceptions()
        if inner_errors:
            inner, note = inner_errors[0]
            name = getattr(note, "name", None)
            inner_path = _join(path, name) if name is not None else f"{path}[{getattr(note, 'index', '?')}]"
            return _first_problem(inner, inner_path)
        return _first_problem(own_errors[0], path)
    if isinstance(error, _Problem):
        return _Problem(error.problem, _join(path, error.path), error.cure)
    if isinstance(error, KeyError):
        return _Problem(f"the setting {error.args[0]!r} is missing", path)
    if isinstance(error, TypeError) and "missing" in str(error):  # "Cls.__init__() missing 1 required ..."
        return _Problem(str(error).split(") ")[-1], path)
    if isinstance(error, DrivaxError):
        return _Problem(error.problem, path, error.cure)
    return _Problem(str(error) or type(error).__name__, path)


def _join(path: str, name: str) -> str:
    """Return a dotted path; ``name`` may be empty, or a place in a list (``[0]``)."""
    return f"{path}.{name}" if path and name and not name.startswith("[") else path + name


def _to_plain(value: Any, annotation: Any) -> Any:
    """Convert a value to the mappings, lists and scalars of YAML."""
    if _is_record(type(value)):
        hints = typing.get_type_hints(type(value))
        fields = {f.name: _to_plain(getattr(value, f.name), hints[f.name]) for f in dataclasses.fields(value)}
        members = _members(annotation)
        if any(map(_accepts_user_objects, (annotation, *members))) and type(value) not in members:
            return {"kind": dotted_name(type(value))} | {k: v for k, v in fields.items() if k != "kind"}
        needs_kind = "kind" not in fields and any(_is_record(member) for member in members)
        return {"kind": kind_of(type(value))} | fields if needs_kind else fields
    if isinstance(value, Mapping):
        item_type = get_args(annotation)[-1] if get_args(annotation) else Any
        return {str(key): _to_plain(item, item_type) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_plain(item, _item_type(annotation, number)) for number, item in enumerate(value)]
    if callable(value):
        return dotted_name(value)
    return str(value) if isinstance(value, Path) else value


def _members(annotation: Any) -> tuple[Any, ...]:
    """Return the members of a union, none for other types."""
    return get_args(annotation) if get_origin(annotation) in _UNIONS else ()


def _item_type(annotation: Any, number: int) -> Any:
    """Return the type of an item of a tuple or list."""
    for candidate in (annotation, *_members(annotation)):
        if get_origin(candidate) in (tuple, list):
            item_types = get_args(candidate)
            all_same = item_types[-1] is Ellipsis or len(item_types) <= number
            return item_types[0 if all_same else number]
    return Any


def parse_yaml(text: str, file: Path | None = None) -> Any:
    """Return the plain values of a YAML text.

    Raises:
        UsageError: Invalid YAML, a duplicate key, or too large a value or text, with its line if known.
    """
    try:
        if len(text) > _MOST_CHARACTERS:
            raise ValueError(f"has more than {_MOST_CHARACTERS:,} characters")
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or "invalid"
        location = "YAML" if mark is None else f"line {mark.line + 1}"
        raise UsageError(f"{location}: {problem}", file=file, cure="fix the file") from error
    except DAMAGE as error:  # a value that its tag does not allow, such as an integer of 5,000 digits
        raise UsageError(f"YAML: invalid ({error})", file=file, cure="fix the file") from error


def write_yaml(values: Any) -> str:
    """Return mappings, lists and scalars as YAML; :func:`parse_yaml` is the inverse."""
    options: dict[str, Any] = {"sort_keys": False, "default_flow_style": None, "allow_unicode": True}
    return yaml.dump(values, Dumper=_Dumper, width=100, **options)


class _Loader(yaml.SafeLoader):
    """Loader of YAML 1.2 core scalars that refuses duplicate keys, and deep or large values."""

    def __init__(self, stream: Any) -> None:
        super().__init__(stream)
        #: Current depth, number of values (aliases expanded), and that number within each node by its id.
        self._depth, self._count, self._counts = 0, 0, dict[int, int]()

    def compose_node(self, parent: Any, index: Any) -> Any:
        event, before = self.peek_event(), self._count
        self._depth += 1
        self._count += 1
        if self._depth > _MOST_LEVELS:
            self._refuse(f"more than {_MOST_LEVELS} levels", event)
        node = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent):
            if id(node) not in self._counts:
                self._refuse("a value that contains itself", event)
            self._count = before + self._counts[id(node)]
        elif isinstance(event, yaml.ScalarEvent):
            self._count += len(event.value) // _TEXT_VALUE
        self._counts[id(node)] = self._count - before
        if self._count > _MOST_VALUES:
            self._refuse(f"more than {_MOST_VALUES:,} values", event)
        self._depth -= 1
        return node

    def _refuse(self, problem: str, event: Any) -> None:
        raise yaml.MarkedYAMLError(None, None, problem, event.start_mark)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        keys: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str) or key in keys:
                problem = "appears twice" if isinstance(key, str) else "is not a string"
                mark = key_node.start_mark
                raise yaml.constructor.ConstructorError(None, None, f"the key {key!r} {problem}", mark)
            keys.add(key)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Dumper that quotes strings that the loader would read as other types."""

    def ignore_aliases(self, data: Any) -> bool:
        """Write values that occur several times in full, without YAML anchors."""
        return True


_NUMBER = r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
_FLOAT = rf"^(?:{_NUMBER}|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
#: Tag, pattern and possible first characters of scalars that are not strings.
_RULES = (
    ("tag:yaml.org,2002:bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("tag:yaml.org,2002:int", r"^[-+]?[0-9][0-9_]*$", "-+0123456789"),
    ("tag:yaml.org,2002:float", _FLOAT, "-+.0123456789"),
    ("tag:yaml.org,2002:null", r"^(?:~|null|Null|NULL|None|)$", ["~", "n", "N", ""]),
)


def _set_rules(cls: Any) -> None:
    """Replace PyYAML's rules (YAML 1.1) for scalars."""
    cls.yaml_implicit_resolvers = {}
    for tag, pattern, first in _RULES:
        cls.add_implicit_resolver(tag, re.compile(pattern), list(first))


def _construct_int(loader: Any, node: Any) -> int:
    return int(loader.construct_scalar(node))  # 010 is ten


_set_rules(_Loader)
_set_rules(_Dumper)
_Loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
