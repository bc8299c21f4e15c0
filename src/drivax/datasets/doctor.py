"""What a file or folder is, what is missing, and what it would become; without converting anything."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from drivax.datasets import unsupported
from drivax.datasets.estimate import estimate, free_bytes, input_bytes
from drivax.datasets.formats import AUTO, Input, Survey, detect, reader_named, survey
from drivax.datasets.reader import BadRecord, Description
from drivax.errors import DataError, DrivaxError
from drivax.scenario.recording import STRIDE
from drivax.scenario.schema import CAPACITIES

#: Files of a format that are inspected; they stand for the others.
_SAMPLE = 24
#: Damaged or unknown files that are named.
_NAMED = 10
#: Notes given on files of one kind.
_NOTES = 6
_FLAVOURS = 3
_SHARD = re.compile(r"(?P<prefix>.*)-(?P<number>\d{5})-of-(?P<total>\d{5})")


@dataclass(frozen=True)
class Part:
    """Files of one format, data set and version.

    Attributes:
        format: As in ``--format``.
        description: What they are; ``recordings`` is the sum over the files that were looked into, None where some
            file does not tell; ``notes`` and ``missing`` are those of all of them.
        looked: How many were looked into.
        whole: Whether those are all that there are.
    """

    format: str
    description: Description
    looked: int
    whole: bool


@dataclass(frozen=True)
class Diagnosis:
    """What a path is.

    Attributes:
        path: The file or folder.
        parts: What can be read in it.
        files: Number of files by format.
        input_bytes: Their size, without what is read along with them.
        companions, ignored: How many other files are read along, and how many belong to no format.
        scenarios: About how many scenarios it will become.
        set_bytes: About how large they will be.
        free_bytes: What the disk of ``path`` has left.
        shards: What is incomplete in numbered shards, one sentence each.
        problems: What is wrong, and what to do about it; most important first.
        convertible: Whether ``drivax convert`` would make something of it.
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
    problems: tuple[BadRecord, ...] = ()
    convertible: bool = False


def diagnose(path: str | Path, format: str = AUTO) -> Diagnosis:
    """Finds out what a file or folder is. Nothing that is wrong with the data is an exception.

    Args:
        path: A file or a folder.
        format: A format, or ``auto``.

    Raises:
        UsageError: There is no such format, or a package that it needs is missing.
    """
    path = Path(path)
    # A scenario set or a run folder holds files, but none to convert.
    known = unsupported.explain_own(path) if path.is_dir() else None
    try:
        if known is not None:
            raise known
        data = survey(path, format)
    except DataError as error:
        return Diagnosis(path, problems=(BadRecord.of(error, path),))
    parts, problems = _parts(data)
    if not parts and path.is_dir() and (whole := unsupported.explain_folder(path)) is not None:
        problems.insert(0, BadRecord.of(whole, path))
    expected = estimate(data, path, CAPACITIES["default"], STRIDE, None)
    return Diagnosis(
        path=path,
        parts=parts,
        files=data.formats,
        input_bytes=input_bytes(data.inputs),
        companions=data.companions,
        ignored=data.ignored,
        scenarios=expected.scenarios,
        set_bytes=expected.size_bytes,
        free_bytes=free_bytes(path),
        shards=tuple(gaps([entry.path for entry in data.inputs])),
        problems=tuple(problems),
        convertible=any(not part.description.missing for part in parts),
    )


def _parts(data: Survey) -> tuple[tuple[Part, ...], list[BadRecord]]:
    groups: defaultdict[tuple[str, str, str | None, bool], list[Description]] = defaultdict(list)
    problems = [_unknown(entry) for entry in data.inputs if entry.format is None][:_NAMED]
    for name in sorted(data.formats):
        files = [entry.path for entry in data.inputs if entry.format == name]
        step = -(-len(files) // _SAMPLE)
        for file in files[::step]:
            try:
                description = reader_named(name).describe(file)
            except DataError as error:
                problems.append(BadRecord.of(error, file))
                continue
            groups[name, description.dataset, description.version, step == 1].append(description)
    parts = tuple(
        Part(format, Description(dataset, _flavours(many), version, *_together(many)), len(many), whole)
        for (format, dataset, version, whole), many in groups.items()
    )
    return parts, problems


def _flavours(many: Sequence[Description]) -> str:
    flavours = sorted({description.flavour for description in many})
    more = f" and {len(flavours) - _FLAVOURS} more" if len(flavours) > _FLAVOURS else ""
    return "; ".join(flavours[:_FLAVOURS]) + more


def _together(many: Sequence[Description]) -> tuple[int | None, tuple[str, ...], tuple[str, ...]]:
    counts = [description.recordings for description in many if description.recordings is not None]
    missing = dict.fromkeys(name for description in many for name in description.missing)
    return sum(counts) if len(counts) == len(many) else None, tuple(_notes(many)), tuple(missing)


def _notes(many: Sequence[Description]) -> Iterator[str]:
    """The notes that most files share, with how many do where it is not all."""
    counts = Counter(note for description in many for note in dict.fromkeys(description.notes))
    for note, times in counts.most_common(_NOTES):
        yield note if times == len(many) else f"{note} (in {times} of {len(many)} files)"
    if len(counts) > _NOTES:
        yield f"{len(counts) - _NOTES} more notes on single files; name one of them to see its own"


def _unknown(entry: Input) -> BadRecord:
    """What is wrong with a file that is called as those of a format are, and holds something else."""
    try:
        detect(entry.path)
    except DrivaxError as error:
        return BadRecord.of(error, entry.path)
    return BadRecord(entry.path, None, "changed while it was looked at", "run drivax doctor again")


def gaps(paths: Sequence[Path]) -> list[str]:
    """Which shards of numbered families (``NAME-00003-of-00150``) are not there, one sentence per family."""
    families: defaultdict[tuple[Path, str, int], set[int]] = defaultdict(set)
    for path in paths:
        match = _SHARD.fullmatch(path.name)
        if match:
            families[path.parent, match["prefix"], int(match["total"])].add(int(match["number"]))
    sentences = []
    for (_, prefix, total), numbers in sorted(families.items()):
        missing = sorted(set(range(total)) - numbers)
        if not missing:
            sentences.append(f"{prefix}: all {total:,} shards")
            continue
        runs = _runs(missing)
        named = f", missing {', '.join(runs)}" if len(runs) <= 8 else ""
        sentences.append(f"{prefix}: {total - len(missing):,} of {total:,} shards{named}")
    return sentences


def _runs(numbers: Sequence[int]) -> list[str]:
    """Ascending numbers as runs: ``00003``, ``00007 to 00010``."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return [f"{first:05d}" if first == last else f"{first:05d} to {last:05d}" for first, last in runs]
