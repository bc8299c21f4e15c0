"""Configuration records: frozen dataclasses <-> YAML <-> command-line overrides.

A configuration record holds scalars, strings, literals, paths, tuples, other records, and unions of records, which
carry a ``kind`` key in YAML (:func:`kind_of`). What a section leaves out keeps the default of the record that holds
the section; in a record that has presets (a class method ``preset(name)``) the key ``preset`` names one to start from
instead, and a dumped record holds what came of it. Nothing is guessed: an unknown key or a value of the wrong type is a
:class:`~drivax.errors.UsageError` that names the dotted path and, where there is one, the nearest valid name. YAML is
read by the 1.2 core rules, so ``3e-4`` is a number and ``no`` is a word.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from drivax.errors import UsageError, did_you_mean
from drivax.settings.structure import Flag, kind_of, plain, structure
from drivax.settings.text import parse_yaml, write_yaml

__all__ = ["dump", "kind_of", "load", "parse_yaml", "plain", "preset", "presets"]

Record = TypeVar("Record")


def load(cls: type[Record], source: str | Path | Mapping[str, Any], overrides: Sequence[str] = ()) -> Record:
    """A configuration record from YAML and command-line overrides.

    Args:
        cls: The dataclass to build; keys that ``source`` lacks take its defaults.
        source: A YAML file, the name of a preset, or a mapping.
        overrides: ``["--optimizer.lr", "1e-3", "--resume"]`` or ``["--optimizer.lr=1e-3"]``; hyphens in names
            count as underscores. Choosing another ``kind`` drops the settings of the former one.

    Raises:
        UsageError: No such file or preset, damaged YAML, an unknown key, or a value of the wrong type.
    """
    file = None if isinstance(source, Mapping) else _find(source)
    values = parse_yaml(_read(file), file) if file else source
    if values is None:
        values = {}
    if not isinstance(values, Mapping):
        raise UsageError("is not a mapping of settings", file=file, cure="write 'name: value' lines")
    values = _override(_copy(values), overrides)
    try:
        return structure(values, cls)
    except ValueError as error:
        raise UsageError(str(error), file=file) from error


def dump(record: Any) -> str:
    """YAML text of a record, defaults included; ``load(type(record), parse_yaml(dump(record))) == record``."""
    return write_yaml(plain(record))


def preset(name: str) -> Path:
    """The packaged configuration file ``configs/<name>.yaml``.

    Raises:
        UsageError: There is none of that name.
    """
    names = presets()
    if name not in names:
        raise UsageError(f"there is no preset or file {name!r}", cure=did_you_mean(name, names))
    return _configs() / f"{name}.yaml"


def presets() -> list[str]:
    """Names of all presets (sub-folders with a slash)."""
    folder = _configs()
    return sorted(str(path.relative_to(folder).with_suffix("")) for path in folder.rglob("*.yaml"))


def _configs() -> Path:
    package = Path(__file__).resolve().parent.parent
    packaged = package / "configs"
    # A checkout keeps them at its root; a wheel inside the package.
    return packaged if packaged.is_dir() else package.parent.parent / "configs"


def _find(source: str | Path) -> Path:
    path = Path(source)
    if path.is_file():
        return path
    # A folder may bear the name of a preset (`drivax demo` writes one called demo).
    if path.is_dir() and source not in presets():
        raise UsageError(
            "is a folder, not a configuration file", file=path, cure="name a .yaml file or a preset"
        )
    if isinstance(source, Path) or path.suffix in (".yaml", ".yml"):
        raise UsageError(
            "does not exist", file=path, cure=f"name a file or a preset ({', '.join(presets())})"
        )
    return preset(source)


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UsageError("is not text", file=file, cure="name a YAML file") from error


def _override(values: dict[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    for path, text in _pairs(overrides):
        *parents, last = path
        place = values
        for name in parents:
            inner = place.get(name)
            if not isinstance(inner, dict):
                # A record that is left out, null or given by a flag starts from its defaults.
                inner = place[name] = {}
            place = inner
        if last == "kind" and str(place.get("kind")) != text:
            place.clear()
        place[last] = Flag(text)
    return values


def _pairs(overrides: Sequence[str]) -> list[tuple[list[str], str]]:
    pairs = []
    rest = list(overrides)
    while rest:
        flag = rest.pop(0)
        if not flag.startswith("--") or flag == "--":
            raise UsageError(f"{flag!r} is no setting", cure="write --section.key value")
        name, sign, text = flag[2:].partition("=")
        if not sign:
            text = rest.pop(0) if rest and not rest[0].startswith("--") else "true"
        pairs.append((name.replace("-", "_").split("."), text))
    return pairs


def _copy(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: _copy(value) if isinstance(value, Mapping) else value for key, value in values.items()}
