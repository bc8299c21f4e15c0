"""TFRecord files without TensorFlow: framing, with both checksums verified, and formats of motion data in them.

A record is ``uint64 length | uint32 masked CRC of the length | payload | uint32 masked CRC of the payload``, all
little-endian; the mask rotates a CRC-32C right by 15 bits and adds 0xA282EAD8 (TensorFlow, ``record_writer.h``).
There is no file header, no index and no count. Records of motion data are recognised by their content.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from drivax.datasets import parsing
from drivax.datasets.reader import BadRecord, attempt, read_head
from drivax.datasets.womd.messages import ExampleFeatures, parse
from drivax.errors import DataError, DrivaxError, UsageError, import_extra
from drivax.files import format_bytes
from drivax.reading import explain_damage
from drivax.scenario.recording import Recording, is_even
from drivax.scenario.schema import LEAST_STEPS, AgentKind

_Array = np.ndarray[Any, Any]

#: Wire type of fields with a length, and the fields of ``Feature`` by kind of list.
_LENGTH, _BYTES, _FLOATS, _INTEGERS = 2, 1, 2, 3
#: Indices of the bytes of a varint: seven bits each, so at most ten for 64 bits.
_GROUPS = np.arange(10, dtype=np.uint64)
_HEADER_BYTES, _FOOTER_BYTES = 12, 4
_MASK = 0xA282EAD8
#: Longest record, bytes: those of WOMD and ScenarioMax have 1 to 5 MB. Parsed protocol buffers of empty messages take
#: 50 times as much memory (1.6 GB).
_LONGEST_BYTES = 32 << 20
_FETCH = "copy or download the file again"
DATASET = "womd"
FULL_NAME = "Waymo Open Motion Dataset"
SCENARIO_FORMAT, EXAMPLE_FORMAT, SCENARIOMAX_FORMAT = "womd-scenario", "womd-example", "scenariomax"
#: Shards are called ``...tfrecord-00000-of-01000``, samples ``....tfrecord``.
PATTERNS = ("*.tfrecord", "*.tfrecord-*", "*.tfrecords")
_CONTENTS = {
    SCENARIO_FORMAT: "WOMD Scenario protos",
    EXAMPLE_FORMAT: "WOMD tf.Examples",
    SCENARIOMAX_FORMAT: "ScenarioMax tf.Examples",
}
#: Signs of ScenarioMax's writer that an example must show; a single one may be damage or another exporter.
_SIGNS = 2


def example(features: Mapping[str, bytes | _Array]) -> bytes:
    """Serialise a tf.Example, its features in order of their names.

    Values are bytes (a list of one), integer arrays (int64 lists) or floating-point arrays (float32 lists); arrays are
    flattened row by row.
    """
    # Field 1 of Example are the features, field 1 of those the entries, with key 1 and value 2.
    entries = b"".join(
        _field(1, _field(1, name.encode()) + _field(2, _feature(features[name]))) for name in sorted(features)
    )
    return _field(1, entries)


def _feature(value: bytes | _Array) -> bytes:
    """Serialise a ``Feature``: the list of its kind, whose only field has number 1."""
    if isinstance(value, bytes):
        return _field(_BYTES, _field(1, value))
    if np.issubdtype(value.dtype, np.floating):
        return _field(_FLOATS, _field(1, value.astype("<f4").tobytes()))
    return _field(_INTEGERS, _field(1, varints(value)))


def _field(number: int, content: bytes) -> bytes:
    """Serialise a field with a length: tag, length, content."""
    return bytes((number << 3 | _LENGTH,)) + varints(np.array([len(content)])) + content


def varints(values: _Array) -> bytes:
    """Serialise integers as varints: seven bits per byte, least significant first; negative ones take ten bytes."""
    bits = values.reshape(-1, 1).astype(np.int64).view(np.uint64)
    groups = bits >> (np.uint64(7) * _GROUPS)
    continues = groups >= 128
    # Write the first byte, and every byte after one that continues.
    is_written = np.concatenate((np.ones_like(continues[:, :1]), continues[:, :-1]), axis=1)
    content = (groups & np.uint64(127)) | (continues.astype(np.uint64) << np.uint64(7))
    return content.astype(np.uint8)[is_written].tobytes()


def shard_name(name: str, number: int, shards: int) -> str:
    """Return the usual file name of a shard."""
    return f"{name}.tfrecord-{number:05d}-of-{shards:05d}"


def write_record(file: BinaryIO, payload: bytes) -> None:
    """Append one record."""
    crc32c = _crc32c()
    length = struct.pack("<Q", len(payload))
    for part in (length, payload):
        file.write(part)
        file.write(struct.pack("<I", mask_crc(crc32c(part))))


def mask_crc(crc: int) -> int:
    """Mask a CRC-32C as TFRecord does: rotate right by 15 bits, add a constant, modulo 2**32."""
    return (((crc >> 15) | (crc << 17)) + _MASK) & 0xFFFFFFFF


def read_records(path: str | Path) -> Iterator[tuple[int, bytes | DataError]]:
    """Yield record numbers (from 0) with their payloads, or with an error in place of a damaged record.

    Records after a damaged payload are read; after a damaged length, or where the file ends early, no further record
    can be located and the error is the last item. An empty file yields one error.

    Raises:
        DataError: The file cannot be opened.
        UsageError: A package of the extra ``womd`` is missing, or too many files are open.
    """
    crc32c = _crc32c()
    path = Path(path)
    with explain_damage(path, "check the path"):
        file = path.open("rb")
    with file:
        size = os.fstat(file.fileno()).st_size
        if size == 0:
            yield 0, DataError("the file is empty", file=path, record=0, cure=_FETCH)
        number = 0
        while file.tell() < size:
            try:
                record = _read_record(file, size, crc32c)
            except _FramingError as error:
                yield number, DataError(error.problem, file=path, record=number, cure=error.cure)
                return
            if record is None:
                problem = "the payload is damaged (checksum mismatch)"
                yield number, DataError(problem, file=path, record=number, cure=_FETCH)
            else:
                yield number, record
            number += 1


class _FramingError(DataError):
    """An error after which the next record cannot be located."""

    def __init__(self, problem: str, cure: str = _FETCH) -> None:
        super().__init__(problem, cure=cure)


def _read_record(file: BinaryIO, size: int, crc32c: Callable[[bytes], int]) -> bytes | None:
    """Read the payload of the next record; None if its checksum is wrong.

    Raises:
        _FramingError: The next record cannot be located: a length is damaged, or the file ends early.
    """
    start = file.tell()
    header = file.read(_HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        problem = f"truncated: a record's header has {_HEADER_BYTES} bytes, the file has {len(header)} left"
        raise _FramingError(problem)
    length, length_crc = struct.unpack("<QI", header)
    if mask_crc(crc32c(header[:8])) != length_crc:
        raise _bad_length(header, start)
    remaining = size - file.tell()
    if length + _FOOTER_BYTES > remaining:
        problem = f"truncated: the record needs {length + _FOOTER_BYTES} bytes, the file has {remaining} left"
        raise _FramingError(problem)
    if length > _LONGEST_BYTES:
        problem = f"{format_bytes(length)}, more than the {format_bytes(_LONGEST_BYTES)} that are read"
        raise _FramingError(f"the record has {problem}")
    payload = file.read(length)
    footer = file.read(_FOOTER_BYTES)
    if len(footer) < _FOOTER_BYTES:
        raise _FramingError("the file became shorter while it was read")
    return payload if mask_crc(crc32c(payload)) == struct.unpack("<I", footer)[0] else None


def count_records(path: str | Path) -> int:
    """Count complete records by their lengths, without checks; 0 if the file cannot be opened. Needs no package."""
    try:
        with Path(path).open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            position = count = 0
            while position + _HEADER_BYTES + _FOOTER_BYTES <= size:
                file.seek(position)
                position += int.from_bytes(file.read(8), "little") + _HEADER_BYTES + _FOOTER_BYTES
                count += position <= size
            return count
    except OSError:
        return 0


def looks_framed(path: Path) -> bool:
    """Return whether the file begins with a length and its checksum. Needs no package, never raises."""
    header = read_head(path, _HEADER_BYTES)
    is_whole = len(header) == _HEADER_BYTES
    return is_whole and mask_crc(_crc32c_slowly(header[:8])) == struct.unpack_from("<I", header, 8)[0]


def _crc32c_slowly(data: bytes) -> int:
    """Compute a CRC-32C bit by bit (Castagnoli's polynomial, reflected): enough for the eight bytes of a length."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def _bad_length(header: bytes, start: int) -> _FramingError:
    """Return the error for a length whose checksum differs; ``start`` is the first byte of the record."""
    if start > 0:
        return _FramingError(
            "the length is damaged (checksum mismatch), so the rest of the file cannot be read"
        )
    if header[:2] == b"\x1f\x8b":
        return _FramingError("the file is gzip-compressed", "decompress it first (gunzip)")
    if header[0] == 0x78 and int.from_bytes(header[:2], "big") % 31 == 0:
        return _FramingError("the file is zlib-compressed", "decompress it first (zlib)")
    return _FramingError(
        "not a TFRecord file, or damaged (checksum mismatch in the first record's length)",
        f"give an uncompressed TFRecord; if it should be one, {_FETCH}",
    )


def _crc32c() -> Callable[[bytes], int]:
    return import_extra("google_crc32c").value


def format_of(payload: bytes) -> str | None:
    """Return the name of a payload's format by its content; None for anything but motion data."""
    example = parse("Example", payload)
    if example is not None and any(entry.key == "state/current/x" for entry in example.features.feature):
        return SCENARIOMAX_FORMAT if scenariomax_signs(ExampleFeatures(example)) >= _SIGNS else EXAMPLE_FORMAT
    scenario = parse("Scenario", payload)
    if scenario is not None and scenario.scenario_id and scenario.tracks:
        return SCENARIO_FORMAT
    return None


def scenariomax_signs(features: ExampleFeatures) -> int:
    """Count how many of ScenarioMax's three signs an example shows; WOMD's examples show none.

    The signs: the prediction difficulty is missing; the ids of tracks that are valid at the current step equal their
    rows, and the ego is row 0; all times of the current step are negative.
    """
    ids_are_rows = has_no_times = False
    with suppress(DataError):
        ids, valid = features.numbers("state/id"), features.numbers("state/current/valid") == 1
        rows = np.flatnonzero(valid) if valid.size == ids.size else np.zeros(0, np.int64)
        ego = np.flatnonzero(features.numbers("state/is_sdc") == 1)
        ids_are_rows = rows.size > 0 and bool((ids[rows] == rows).all()) and ego.tolist() == [0]
        has_no_times = bool((features.numbers("state/current/timestamp_micros") < 0).all())
    return sum((not features.has("state/difficulty_level"), ids_are_rows, has_no_times))


def _first(path: Path) -> bytes:
    """Return the payload of the first readable record; without any, raise the error of the first record."""
    damage = None
    for _, record in read_records(path):
        if isinstance(record, bytes):
            return record
        damage = damage or record
    raise damage or DataError("the file is empty", file=path, cure="download it again")


@dataclass(frozen=True)
class TfRecordReader:
    """Base of the readers of TFRecord files with one recording per record."""

    name: str
    patterns: tuple[str, ...] = PATTERNS
    companions: tuple[str, ...] = ()

    def decode(self, payload: bytes) -> Recording:
        """Return the recording in a payload."""
        raise NotImplementedError

    def recognise(self, path: Path) -> bool:
        """Return whether the first readable record is of this format; never raises."""
        try:
            return looks_framed(path) and format_of(_first(path)) == self.name
        except UsageError:
            # A package is missing: claim the file as Scenario protos; reading it then reports the package.
            return self.name == SCENARIO_FORMAT
        except DataError:
            return False

    def first(self, path: Path) -> Recording:
        """Return the recording of the first readable record."""
        recording = attempt(self._decode, _first(path), file=path)
        if isinstance(recording, BadRecord):
            raise recording.error()
        return recording

    def count(self, path: Path) -> int:
        """Return the number of records times the windows of the first readable one; 0 if it cannot be decoded."""
        try:
            return count_records(path) * parsing.windows_of(len(self.decode(_first(path)).timestamps_s))
        except DrivaxError:
            return 0

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """Yield the recordings, and a bad record in place of each that cannot be decoded."""
        for number, payload in read_records(path):
            if isinstance(payload, DataError):
                yield BadRecord.of(payload, path, number)
            else:
                yield attempt(self._decode, payload, file=path, record=number)

    def _decode(self, payload: bytes) -> Recording:
        """Return the recording in a payload; for a payload of another known format the error names that format."""
        try:
            return self.decode(payload)
        except DataError as error:
            content = format_of(payload)
            if content in (None, self.name):
                raise
            problem = f"contains {_CONTENTS[content]}, not {_CONTENTS[self.name]}"
            raise DataError(problem, cure=f"use --format {content}") from error


def agent_kind(code: int) -> AgentKind:
    """Return the class of a WOMD object type from 1 to 4 (other); 0 (unset) and codes of later versions are OTHER."""
    return AgentKind(code) if 1 <= code <= 4 else AgentKind.OTHER


def notes_of(recording: Recording) -> tuple[str, ...]:
    """Return notes for users about a file, from its first recording: length, windows, lights, spacing of frames."""
    steps, now = len(recording.timestamps_s), recording.current_step
    notes = [f"{steps} steps, current step {now}"]
    if parsing.windows_of(steps) > 1:
        notes.append(f"each recording becomes {parsing.windows_of(steps)} windows of 91 steps")
    elif steps < LEAST_STEPS:
        notes.append(f"fewer than {LEAST_STEPS} steps: stored, but refused for training and evaluation")
    if not recording.lights:
        notes.append("no traffic lights in the first record")
    if not is_even(recording.timestamps_s):
        notes.append(parsing.UNEVEN)
    return tuple(notes)
