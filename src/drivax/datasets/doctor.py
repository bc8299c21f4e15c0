"""Diagnosis of a file or folder: its format, missing files, and the size of its scenario set, without conversion."""

from __future__ import annotations

import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from drivax.datasets import formats
from drivax.datasets.formats import AUTO, Survey, find_reader, survey
from drivax.datasets.reader import BadRecord, Description, Reader, attempt, with_steps
from drivax.errors import DataError, UsageError
from drivax.files import check_space, count_text, format_bytes, free_bytes
from drivax.reading import read_json
from drivax.scenario.manifest import MANIFEST, read_manifest
from drivax.scenario.recording import STRIDE
from drivax.scenario.schema import CAPACITIES, STEPS, Capacity, record_dtype
from drivax.seal import SEAL, check_seal, require_entries

#: Maximum number of files of a format that are inspected, as a sample of all.
_SAMPLE = 24
#: Maximum number of files of a format whose scenarios are counted; the count of a sample is scaled by file size.
_COUNT_FILES = 48
#: Maximum number of files of unknown format that are named.
_MOST_NAMES = 10
#: Maximum numbers of notes and flavours listed for several files of one kind, and of runs of missing shards.
_NOTES, _FLAVOURS, _RUNS = 6, 3, 8
_NO_SEAL = (
    f"no {SEAL}, as in folders of earlier versions: changes to files that decide results are not detected"
)
_SHARD = re.compile(r"(?P<prefix>.*)-(?P<number>\d{5})-of-(?P<total>\d{5})")


@dataclass(frozen=True)
class Part:
    """Files of one format, data set and version.

    ``description`` merges those of ``sample_size`` files (all intact ones if ``whole``): sum of ``recordings`` (None if
    unknown for a file), most frequent ``notes``, all ``missing`` files. ``convertible``: at least one is complete.
    """

    format: str
    description: Description
    sample_size: int
    whole: bool
    convertible: bool = True


@dataclass(frozen=True)
class Diagnosis:
    """Diagnosis of a path.

    Attributes:
        path: The file or folder.
        parts: What can be read in it.
        files: Number of files by recognised format.
        input_bytes: Size of these files and of those that only have the name of a format's files.
        companions: Number of files that belong to them (maps, poses, indices); ``ignored`` is that of all others.
        scenarios: Estimated number of scenarios after conversion; ``set_bytes`` is their size.
        free_bytes: Free space on the disk of ``path``.
        shards: One sentence per family of numbered shards.
        notes: Remarks about the folder.
        problems: Problems, with cures, of the folder, files of unknown format, and damaged files.
        convertible: Whether ``drivax convert`` can convert some of it.
    """

    path: Path
    parts: tuple[Part, ...] = ()
    files: Counter[str] = field(default_factory=Counter)
    input_bytes: int = 0
    companions: int = 0
    ignored: int = 0
    scenarios: int = 0
    set_bytes: int = 0
    free_bytes: int = 0
    shards: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    problems: tuple[BadRecord, ...] = ()
    convertible: bool = False


def diagnose(path: str | Path, format: str = AUTO) -> Diagnosis:
    """Identify the content of a file or folder; defects of the data are returned as problems, not raised.

    Raises:
        UsageError: There is no such format, or a package that it needs is missing.
    """
    path = Path(path)
    # A scenario set or a run folder holds files, but none to convert.
    if path.is_dir() and (error := formats.explain_own(path)) is not None:
        problems = (BadRecord.of(error, path), *_seal_problems(path))
        notes = () if len(problems) > 1 or (path / SEAL).exists() else (_NO_SEAL,)
        return Diagnosis(path, notes=notes, problems=problems)
    data = attempt(survey, path, format, file=path)
    if isinstance(data, BadRecord):
        return Diagnosis(path, problems=(data,))
    parts, problems = _parts(data)
    if not parts and path.is_dir() and (error := formats.explain_folder(path)) is not None:
        problems.insert(0, BadRecord.of(error, path))
    expected = estimate(data, path, CAPACITIES["default"], STRIDE, None)
    return Diagnosis(
        path=path,
        parts=parts,
        files=data.formats,
        input_bytes=_size(data.paths()),
        companions=data.companions,
        ignored=data.ignored,
        scenarios=expected.scenarios,
        set_bytes=expected.size_bytes,
        free_bytes=expected.free_bytes,
        shards=tuple(gaps(data.paths())),
        problems=tuple(problems),
        convertible=any(part.convertible for part in parts),
    )


def _seal_problems(folder: Path) -> Iterator[BadRecord]:
    """Yield the problems of the seal of a scenario set or run folder; earlier versions wrote none."""
    for name, read in ((MANIFEST, read_manifest), ("run.json", _check_run)):
        file = folder / name
        if file.exists() and isinstance(problem := attempt(read, folder, file=file), BadRecord):
            yield problem


def _check_run(folder: Path) -> None:
    """Check the seal of a run folder as ``RunFolder.open`` does, which imports JAX."""
    check_seal(folder / "run.json")
    info = read_json(folder / "run.json", "run the command again")
    if isinstance(info, dict) and info.get("sealed"):
        require_entries(folder, "config.yaml")


def _parts(data: Survey) -> tuple[tuple[Part, ...], list[BadRecord]]:
    """Describe a sample of the files of each format; list files of unknown format, and damaged files of the sample."""
    groups: defaultdict[tuple[str, str, str | None, bool], list[Description]] = defaultdict(list)
    unknown = data.paths(None)[:_MOST_NAMES]
    problems = [BadRecord.of(formats.explain(file), file) for file in unknown]
    for name in sorted(data.formats):
        files = data.paths(name)
        step = -(-len(files) // _SAMPLE)
        for file in files[::step]:
            description = attempt(find_reader(name).describe, file, file=file)
            if isinstance(description, BadRecord):
                problems.append(description)
            else:
                groups[name, description.dataset, description.version, step == 1].append(description)
    parts = [
        Part(name, _merge(sample), len(sample), whole, any(not file.missing for file in sample))
        for (name, _, _, whole), sample in groups.items()
    ]
    return tuple(parts), problems


def _merge(sample: Sequence[Description]) -> Description:
    """Merge the descriptions of files of one data set and version."""
    flavours = sorted({description.flavour for description in sample})
    more = f" and {len(flavours) - _FLAVOURS} more" if len(flavours) > _FLAVOURS else ""
    counts = [description.recordings for description in sample if description.recordings is not None]
    return replace(
        sample[0],
        flavour="; ".join(flavours[:_FLAVOURS]) + more,
        recordings=sum(counts) if len(counts) == len(sample) else None,
        notes=tuple(_notes(sample)),
        missing=tuple(dict.fromkeys(name for description in sample for name in description.missing)),
    )


def _notes(sample: Sequence[Description]) -> Iterator[str]:
    """Yield the notes on a file, or the most frequent ones on several, with the number of files unless it is all."""
    counts = Counter(note for description in sample for note in dict.fromkeys(description.notes))
    most = _NOTES if len(sample) > 1 else len(counts)
    for note, times in counts.most_common(most):
        yield note if times == len(sample) else f"{note} (in {times} of {len(sample)} files)"
    if len(counts) > most:
        more = count_text(len(counts) - most, "more note")
        yield f"{more}; run drivax doctor on a single file to see all of its notes"


def gaps(paths: Sequence[Path]) -> list[str]:
    """Return a sentence per folder and family of numbered shards (``NAME-00003-of-00150``): how many it has.

    Missing numbers are listed if they form at most 8 runs; families with the same name are listed with their folder.
    """
    families: defaultdict[tuple[Path, str, int], set[int]] = defaultdict(set)
    for path in paths:
        if match := _SHARD.fullmatch(path.name):
            families[path.parent, match["prefix"], int(match["total"])].add(int(match["number"]))
    sentences, family_counts = [], Counter(prefix for _, prefix, _ in families)
    root = os.path.commonpath([folder for folder, _, _ in families]) if families else ""
    for (folder, prefix, total), numbers in sorted(families.items()):
        name = prefix if family_counts[prefix] == 1 else (folder / prefix).relative_to(root).as_posix()
        missing = sorted(set(range(total)) - numbers)
        if not missing:
            sentences.append(f"{name}: all {total:,} shards")
            continue
        runs = np.split(missing, np.flatnonzero(np.diff(missing) > 1) + 1)
        names = (f"{run[0]:05d}" if len(run) == 1 else f"{run[0]:05d} to {run[-1]:05d}" for run in runs)
        names_text = f", missing {', '.join(names)}" if len(runs) <= _RUNS else ""
        sentences.append(f"{name}: {total - len(missing):,} of {total:,} shards{names_text}")
    return sentences


@dataclass(frozen=True)
class SizeEstimate:
    """Size of a conversion and free space of the disk."""

    scenarios: int
    size_bytes: int
    free_bytes: int

    def __str__(self) -> str:
        size, free = format_bytes(self.size_bytes), format_bytes(self.free_bytes)
        return f"about {count_text(self.scenarios, 'scenario')}, {size}; {free} free"

    def check(self, out: Path, written: int = 0) -> None:
        """Refuse a set that will not fit; ``written`` of its scenarios are on the disk already."""
        size_bytes = self.size_bytes * max(self.scenarios - written, 0) // max(self.scenarios, 1)
        check_space(out, size_bytes, "make room, choose another disk, or use --limit")


def estimate(data: Survey, out: Path, capacity: Capacity, stride: int, limit: int | None) -> SizeEstimate:
    """Estimate a conversion without filters by counting scenarios, in a sample of the files where there are many.

    Args:
        data: The files to convert.
        out: Folder of the set, which need not exist.
        capacity: Padded sizes.
        stride: Steps between the starts of two windows.
        limit: Largest number of scenarios; None for all.
    """
    total = 0.0
    for name in data.formats:
        paths = data.paths(name)
        sample = paths[:: -(-len(paths) // _COUNT_FILES)]
        reader = with_steps(find_reader(name), capacity.steps)
        count = sum(_count(reader, path, stride, capacity.steps) for path in sample)
        total += _size(paths) / max(_size(sample), 1) * count
    scenarios = round(total) if limit is None else min(round(total), limit)
    return SizeEstimate(scenarios, scenarios * record_dtype(capacity).itemsize, free_bytes(out))


def _count(reader: Reader, path: Path, stride: int, length: int) -> int:
    """Estimate the number of scenarios that a file becomes; 0 if it cannot be read."""
    try:
        scenarios = reader.count(path)
        if (stride, length) == (STRIDE, STEPS) or scenarios == 0:
            return scenarios
        recordings = reader.describe(path).recordings
    except (DataError, UsageError):
        return 0
    if not recordings:
        return scenarios
    # Readers count windows of the usual stride and length; estimate the recordings' length from their number.
    steps = STEPS + STRIDE * max(scenarios / recordings - 1, 0)
    return round(recordings * max((steps - length) // stride + 1, 1))


def _size(paths: Sequence[Path]) -> int:
    return sum(path.stat().st_size for path in paths)
