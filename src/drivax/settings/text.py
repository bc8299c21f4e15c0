"""YAML by the 1.2 core rules: ``3e-4`` is a number, ``no`` a string, ``010`` ten; duplicate keys are errors."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from drivax.errors import UsageError


def parse_yaml(text: str, file: Path | None = None) -> Any:
    """Return the plain values of a YAML text.

    Raises:
        UsageError: Invalid YAML or a duplicate key, with the line.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or "invalid"
        place = "YAML" if mark is None else f"line {mark.line + 1}"
        raise UsageError(f"{place}: {problem}", file=file, cure="fix the file") from error


def write_yaml(values: Any) -> str:
    """Return mappings, lists and scalars as YAML; :func:`parse_yaml` is the inverse."""
    return yaml.dump(
        values, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True
    )


class _Loader(yaml.SafeLoader):
    """Reads YAML 1.2 core scalars and refuses duplicate keys."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is not a string", key_node.start_mark
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} appears twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Quotes strings that the loader would read as other types."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_NUMBER = r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
_RULES = (
    ("tag:yaml.org,2002:bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("tag:yaml.org,2002:int", r"^[-+]?[0-9][0-9_]*$", "-+0123456789"),
    (
        "tag:yaml.org,2002:float",
        rf"^(?:{_NUMBER}|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$",
        "-+.0123456789",
    ),
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
