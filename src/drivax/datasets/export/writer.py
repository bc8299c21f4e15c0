"""Export of a scenario set, or a part of it, as a set, tf.Examples or GPUDrive JSON."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from drivax.datasets.export.tfexample import PATHS, tf_example
from drivax.datasets.gpudrive import file_name, gpudrive_content
from drivax.datasets.womd.tfrecord import example, shard_name, write_record
from drivax.errors import DataError, UsageError, did_you_mean
from drivax.files import PartialFolder, check_output, explain_full_disk, sync_and_close, write_json
from drivax.scenario.schema import common_capacity
from drivax.scenario.select.selection import select_scenarios
from drivax.scenario.store import ScenarioSet, ScenarioWriter, check_set_space

#: File that describes an export in another format.
NOTE = "export.json"
#: Called with (scenarios done, scenarios).
Progress = Callable[[int, int], None]
#: The file of every scenario, and counts of what did not fit.
_Written = tuple[list[str], Counter[str]]


@dataclass(frozen=True)
class Export:
    """Options of an export.

    Attributes:
        format: ``set`` (a scenario set), ``tfexample`` (TFRecord shards) or ``gpudrive`` (JSON files).
        filters: Only scenarios with this property (NAME=A|B, NAME!=A, NAME>=N); can be repeated.
        ids: Only scenarios named in this file: one id per line, or data set, tab and id (a split file).
        limit: At most N scenarios.
        paths: Routes in tf.Examples: 10 of 300 points at 1 m, or 10 of 500 points at 0.5 m.
        shard_size: Scenarios per TFRecord shard.
        overwrite: Replace OUT if it is an earlier export (or a scenario set, for the format set).
    """

    format: str = "set"
    filters: tuple[str, ...] = ()
    ids: Path | None = None
    limit: int | None = None
    paths: Literal["vmax", "published"] = "vmax"
    shard_size: int = 500
    overwrite: bool = False

    def check(self) -> None:
        """Check the options."""
        for name, choices in (("format", ("set", *_WRITERS)), ("paths", tuple(PATHS))):
            if (value := getattr(self, name)) not in choices:
                raise UsageError(f"unknown {name} {value!r}", cure=did_you_mean(value, choices))
        for name in ("limit", "shard_size"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise UsageError(f"{name.replace('_', '-')} is {value}", cure="use 1 or more")


@dataclass(frozen=True)
class Exported:
    """Result of an export: folder, numbers of scenarios and files, and counts of elements that did not fit, by name."""

    path: Path
    scenarios: int
    files: int
    lost: Mapping[str, int]


def export(
    set_path: str | Path, out: str | Path, options: Export | None = None, progress: Progress | None = None
) -> Exported:
    """Write scenarios of a set in another format or as a new set, which appears under ``out`` when it is complete.

    Raises:
        DataError: The set is damaged, an id is not in it, or no scenario is selected.
        UsageError: An option is invalid, or ``out`` exists and may not be replaced.
    """
    options, out = options or Export(), Path(out)
    options.check()
    scenarios = ScenarioSet.open(set_path)
    id_files = () if options.ids is None else (options.ids,)
    rows = select_scenarios(scenarios, options.filters, id_files, options.limit)
    if options.format == "set":
        return write_part(scenarios, rows, out, options.overwrite, progress)
    _refuse_existing(out, options)
    partial = PartialFolder(out)
    partial.open(restart=options.overwrite)
    try:
        work = _Work(scenarios, rows, partial.content, out.name, options, progress)
        with explain_full_disk(out):
            files, lost = _WRITERS[options.format](work)
        write_json(partial.content / NOTE, _note(work, files, +lost))
        _refuse_existing(out, options)  # another process may have written it in the meantime
        partial.publish()
    finally:
        partial.close()
    return Exported(out, len(rows), len(set(files)), +lost)


def write_part(
    scenarios: ScenarioSet,
    rows: Sequence[int],
    out: Path,
    overwrite: bool = False,
    progress: Progress | None = None,
    selection: Mapping[str, Any] | None = None,
    further: Callable[[Path], None] | None = None,
) -> Exported:
    """Write scenarios of a set as a new set: records and entries unchanged.

    Args:
        scenarios: The set.
        rows: Rows of the set, in the order of the new one.
        out: Folder to create.
        overwrite: Replace an existing scenario set; other folders are never replaced.
        progress: Called with (scenarios done, scenarios).
        selection: Entries of the manifest that say how the rows were selected, as plain JSON values.
        further: Called with the folder of the complete set before it gets its name, to add files.

    Raises:
        UsageError: ``out`` exists and may not be replaced, or is the input set.
    """
    refuse_part(scenarios, out)
    part = {"set": scenarios.path.name, "hash": scenarios.hash, **(selection or {})}
    source = {**scenarios.manifest["source"], "part_of": part}
    check_set_space(out, scenarios.capacity, len(rows))
    with ScenarioWriter(out, scenarios.capacity, source, overwrite=overwrite, further=further) as writer:
        for number, row in enumerate(rows, start=1):
            writer.add(scenarios[row])
            if progress is not None:
                progress(number, len(rows))
    return Exported(out, len(rows), len(ScenarioSet.open(out).manifest["shards"]), {})


def merge(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    filters: Sequence[str] = (),
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Exported:
    """Write the scenarios of several sets as one set, which appears under ``out`` when it is complete.

    Records of smaller capacities are padded. Every scenario keeps its data set, segment and tags.

    Args:
        paths: The sets, in the order of the new one.
        out: Folder to create.
        filters: Conditions on scenarios, such as ``type=turn_left`` (``scenario.select.selection``).
        overwrite: Replace an existing scenario set; other folders are never replaced.
        progress: Called with (scenarios done, scenarios).

    Raises:
        DataError: A set is damaged, no scenario of it is selected, or two sets have the same scenario.
        UsageError: There are fewer than two sets, their capacities differ in steps or grid, or ``out`` exists and may
            not be replaced.
    """
    out, sets = Path(out), [ScenarioSet.open(path) for path in paths]
    if len(sets) < 2:
        raise UsageError("merge needs at least two sets", cure="name two or more")
    capacity = common_capacity(scenarios.capacity for scenarios in sets)
    rows = [select_scenarios(scenarios, filters) for scenarios in sets]
    total, first_set = sum(map(len, rows)), dict[tuple[str, str], int]()
    for number, (scenarios, numbers) in enumerate(zip(sets, rows, strict=True)):
        for entry in map(scenarios.entries.__getitem__, numbers):
            name = entry["dataset"], entry["scenario_id"]
            if (other := first_set.setdefault(name, number)) != number:
                problem = f"scenario {name[1]!r} of {name[0]!r} is also in {sets[other].path}"
                raise DataError(
                    problem, file=scenarios.path, cure="name each set once, or leave it out: --filter"
                )
    for scenarios in sets:
        refuse_part(scenarios, out)
    source = {"merged": [{"set": s.path.name, "hash": s.hash, "source": s.manifest["source"]} for s in sets]}
    check_set_space(out, capacity, total)
    with ScenarioWriter(out, capacity, source, overwrite=overwrite) as writer:
        for scenarios, numbers in zip(sets, rows, strict=True):
            for number in numbers:
                writer.add(scenarios[number].fit(capacity))
                if progress is not None:
                    progress(len(writer), total)
            scenarios.release()
    return Exported(out, total, len(ScenarioSet.open(out).manifest["shards"]), {})


def refuse_part(scenarios: ScenarioSet, out: Path) -> None:
    """Raise a UsageError if ``out`` is the input set."""
    if out.exists() and out.resolve() == scenarios.path.resolve():
        raise UsageError("is the input set", file=out, cure="choose another output")


@dataclass(frozen=True)
class _Work:
    """An export to write: rows of a set, the folder to write into, and the name that the folder will get."""

    scenarios: ScenarioSet
    rows: Sequence[int]
    folder: Path
    name: str
    options: Export
    progress: Progress | None

    def report(self, done: int) -> None:
        if self.progress is not None:
            self.progress(done, len(self.rows))


def _write_examples(work: _Work) -> _Written:
    """Write TFRecord shards of tf.Examples."""
    lost, files, size = Counter[str](), list[str](), work.options.shard_size
    shards = -(-len(work.rows) // size)
    for number in range(shards):
        path = work.folder / shard_name(work.name, number, shards)
        with path.open("wb") as file:
            for row in work.rows[number * size : (number + 1) * size]:
                features, left_out = tf_example(work.scenarios[row], PATHS[work.options.paths])
                write_record(file, example(features))
                lost.update(left_out)
                files.append(path.name)
                work.report(len(files))
            sync_and_close(file)
    return files, lost


def _write_gpudrive(work: _Work) -> _Written:
    """Write one JSON file per scenario."""
    files = [file_name(number) for number in range(len(work.rows))]
    for number, (row, name) in enumerate(zip(work.rows, files, strict=True), start=1):
        content = gpudrive_content(work.scenarios[row], name)
        with (work.folder / name).open("wb") as file:
            file.write(json.dumps(content, allow_nan=False).encode())
            sync_and_close(file)
        work.report(number)
    return files, Counter()


_WRITERS: Mapping[str, Callable[[_Work], _Written]] = {
    "tfexample": _write_examples,
    "gpudrive": _write_gpudrive,
}


def _note(work: _Work, files: Sequence[str], lost: Mapping[str, int]) -> dict[str, Any]:
    """Return the content of ``export.json``: data set, segment and file of each scenario, which formats do not keep."""
    scenarios, names = work.scenarios, ("scenario_id", "dataset", "segment")
    return {
        "drivax_version": metadata.version("drivax"),
        "format": work.options.format,
        "set": {"name": scenarios.path.name, "hash": scenarios.hash, "source": scenarios.manifest["source"]},
        "lost": dict(lost),
        "scenarios": [
            {**{key: scenarios.entries[row][key] for key in names}, "file": file}
            for row, file in zip(work.rows, files, strict=True)
        ],
    }


def _refuse_existing(out: Path, options: Export) -> None:
    """Refuse a path that exists, except an empty folder, or an export if it may be overwritten."""
    is_empty = out.is_dir() and not any(out.iterdir())
    if is_empty or not (out.exists() or out.is_symlink()):
        return
    if not (out / NOTE).is_file():
        raise UsageError("exists and is not an export", file=out, cure="choose another name")
    check_output(out, options.overwrite, folder=True)
