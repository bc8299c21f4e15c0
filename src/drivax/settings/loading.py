"""Load configuration records from presets, YAML files and command-line overrides; check the code that they name."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from drivax.errors import DataError, UsageError, did_you_mean
from drivax.plugins import find_named, is_dotted, is_trusted, trust_cure
from drivax.reading import read_text
from drivax.settings.structure import FlagText, NameAlone, parse_yaml, plain, structure, write_yaml

Record = TypeVar("Record")


def load(
    cls: type[Record], source: str | Path | Mapping[str, Any], overrides: Sequence[str] = (), *,
    trust: Collection[str] | None = None,
) -> Record:  # fmt: skip
    """Return a configuration record from YAML and command-line overrides.

    Args:
        cls: The dataclass to build; its defaults apply to keys that ``source`` lacks.
        source: The name of a preset, a YAML file (a string is its path if :func:`is_path`), or a mapping.
        overrides: ``["--optimizer.lr", "1e-3", "--resume"]`` or ``["--optimizer.lr=1e-3"]``; hyphens in names
            count as underscores. A ``kind`` other than that in ``source`` discards the settings of its section.
        trust: None for a source that the user wrote. Otherwise the source is data, such as the configuration of a
            run: it may name code of drivax and of these modules only, and extends no other file.

    Raises:
        UsageError: File or preset not found, invalid YAML, a cycle, unknown key, a value of the wrong type, or a name
            that is not trusted.
    """
    if isinstance(source, Mapping):
        file, values = None, _copy(source)
    else:
        file = _find_file(source)
        values = _read_settings(file, follow_extends=trust is None)
    values = _override(values, overrides)
    if trust is not None:
        check_names(values, trust, file)
    try:
        return structure(values, cls)
    except UsageError as error:
        raise UsageError(error.problem, file=file, cure=error.cure) from error


def dump(record: Any) -> str:
    """Return a record as YAML, defaults included; ``load(type(record), parse_yaml(dump(record))) == record``."""
    return write_yaml(plain(record))


def preset(name: str) -> Path:
    """Return the path of the packaged configuration file ``configs/<name>.yaml``."""
    names = presets()
    if name not in names:
        if Path(name).is_file():
            raise UsageError(f"no preset {name!r}", cure=f"write ./{name} for the file")
        raise UsageError(f"no preset or file {name!r}", cure=did_you_mean(name, names))
    return _configs() / f"{name}.yaml"


def presets() -> list[str]:
    """Return the names of all presets, relative to ``configs``."""
    folder = _configs()
    return sorted(str(path.relative_to(folder).with_suffix("")) for path in folder.rglob("*.yaml"))


def is_path(name: str) -> bool:
    """Return whether a name, if not a preset, is a path: it has a folder (``./NAME``) or a suffix (``NAME.yaml``)."""
    return Path(name).name != name or Path(name).suffix != ""


def _configs() -> Path:
    """Folder of the packaged configuration files."""
    package = Path(__file__).resolve().parent.parent
    folder = package / "configs"
    # At the root of a checkout, inside the package of a wheel.
    return folder if folder.is_dir() else package.parent.parent / "configs"


def _find_file(source: str | Path) -> Path:
    """Return the file of a preset if ``source`` is its name, else the file at the path ``source``."""
    if isinstance(source, str) and (source in presets() or not is_path(source)):
        return preset(source)
    path = Path(source)
    if path.is_file():
        return path
    if path.is_dir():
        problem = "not a configuration file but a folder"
        raise UsageError(problem, file=path, cure="name a .yaml file or a preset")
    if isinstance(source, Path) or path.suffix in (".yaml", ".yml"):
        cure = f"name a file or a preset ({', '.join(presets())})"
        raise UsageError("file not found", file=path, cure=cure)
    return preset(source)


def _read_settings(
    file: Path, extended_by: tuple[Path, ...] = (), follow_extends: bool = True
) -> dict[str, Any]:
    """Return the settings of a file, merged over those of the file that it ``extends``.

    ``extended_by`` has the files that extend this one, outermost first. Without ``follow_extends``, ``extends`` is a
    setting like any other.
    """
    try:
        values = parse_yaml(read_text(file, "name a YAML file"), file)
    except DataError as error:
        raise UsageError(error.problem, file=file, cure=error.cure) from error
    values = {} if values is None else values
    if not isinstance(values, dict):
        raise UsageError("not a mapping of settings", file=file, cure="write 'name: value' lines")
    if not follow_extends or "extends" not in values:
        return values
    base, chain = _find_base(file, values.pop("extends")), (*extended_by, file.resolve())
    if base.resolve() in chain:
        cycle = " -> ".join(path.name for path in (*chain, base))
        raise UsageError(f"extends itself: {cycle}", file=file, cure="remove an extends line")
    return _merge(_read_settings(base, chain), values)


def _find_base(file: Path, name: Any) -> Path:
    """Return the preset, or the file relative to ``file``, that ``file`` extends."""
    name, names = str(name), presets()
    if name in names:
        return preset(name)
    if is_path(name) and (file.parent / name).is_file():
        return file.parent / name
    cure = "name a file relative to this one" if Path(name).suffix else did_you_mean(name, names)
    raise UsageError(f"extends {name!r}, which is not found", file=file, cure=cure)


def _merge(base: Any, values: Any) -> Any:
    """Merge ``values`` over ``base`` by key; a section with another kind or preset replaces that of ``base``."""
    if not isinstance(values, dict):
        return values
    base = _section(base)
    if any(name in values and values[name] != base.get(name) for name in ("kind", "preset")):
        return values
    return base | {name: _merge(base.get(name), value) for name, value in values.items()}


def _section(value: Any) -> dict[str, Any]:
    """Return a setting as a section: a mapping unchanged, a name as its ``kind``, other values as an empty section."""
    content = parse_yaml(value) if isinstance(value, FlagText) else value
    if isinstance(content, str):
        return {NameAlone("kind"): type(value)(content)}
    return content if isinstance(content, dict) else {}


def _override(values: dict[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Set the values of command-line flags in nested mappings, in place."""
    for path, text in _parse_flags(overrides):
        *parents, key = path
        section = values
        for name in parents:
            section[name] = _section(section.get(name))
            section = section[name]
        if key == "kind" and str(section.get("kind")) != text:
            section.clear()  # Settings of the former kind do not apply.
        section[key] = FlagText(text)
    return values


def _parse_flags(overrides: Sequence[str]) -> list[tuple[list[str], str]]:
    """Return the path of keys and the text of each flag, ``true`` for a flag without a value."""
    pairs, arguments = [], list(overrides)
    while arguments:
        flag = arguments.pop(0)
        if not flag.startswith("--") or flag == "--":
            raise UsageError(f"unexpected argument {flag!r}", cure="write --section.key value")
        name, sign, text = flag[2:].partition("=")
        if not sign:
            text = arguments.pop(0) if arguments and not arguments[0].startswith("--") else "true"
        pairs.append((name.replace("-", "_").split("."), text))
    return pairs


def _copy(values: Mapping[str, Any]) -> dict[str, Any]:
    """Copy nested mappings, so that overrides leave those of the caller alone."""
    return {key: _copy(value) if isinstance(value, Mapping) else value for key, value in values.items()}


def check_names(values: Any, trust: Collection[str], file: Path | None = None) -> None:
    """Check the dotted names in plain values of a file before any of them is imported; those in flags are trusted.

    Raises:
        UsageError: A name leads to a module that is not trusted, or to something that is not a component.
    """
    names = sorted(_names(values))
    if foreign := [name for name in names if not is_trusted(name, trust)]:
        raise UsageError(f"names code, {', '.join(foreign)}", file=file, cure=trust_cure(foreign))
    for name in names:
        try:
            find_named(name, trust)
        except UsageError as error:
            raise UsageError(error.problem, file=file, cure=error.cure) from error


def modules_of(record: Any) -> list[str]:
    """Return the modules outside drivax whose code a configuration names."""
    return sorted({name.partition(":")[0] for name in _names(plain(record)) if not is_trusted(name, ())})


def _names(values: Any) -> set[str]:
    """Return the dotted names in nested values, keys included, except those of flags."""
    stack, names, visited = [values], set[str](), set[int]()
    while stack:
        value = stack.pop()
        if is_dotted(value) and not isinstance(value, FlagText):
            names.add(value)
        elif isinstance(value, Mapping | list | tuple) and id(value) not in visited:
            visited.add(id(value))  # YAML may repeat a list by aliases.
            stack += (*value, *value.values()) if isinstance(value, Mapping) else value
    return names
