"""TFRecord files without TensorFlow: framing with both checksums tested.

A record is ``uint64 length | uint32 masked CRC of the length | payload | uint32 masked CRC of the payload``, all
little-endian; the mask rotates a CRC-32C right by 15 bits and adds 0xA282EAD8 (TensorFlow, ``record_writer.h``).
There is no file header, no index and no count.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from drivax.datasets.parsing import import_extra
from drivax.errors import DataError

_Array = np.ndarray[Any, Any]

#: Wire type of everything that has a length, and the fields of ``Feature`` by kind of list.
_LENGTH, _BYTES, _FLOATS, _INTEGERS = 2, 1, 2, 3
#: Values that encode in seven bits a byte: at most ten bytes for 64 bits.
_GROUPS = np.arange(10, dtype=np.uint64)


def example(features: Mapping[str, bytes | _Array]) -> bytes:
    """A serialised tf.Example, its features in order of their names.

    Args:
        features: By name: bytes (a list of one), an integer array (int64 list) or a floating-point array (float32
            list); arrays are flattened row by row.
    """
    entries = b"".join(
        _field(1, _field(1, name.encode()) + _field(2, _feature(features[name]))) for name in sorted(features)
    )
    return _field(1, entries)


def _feature(value: bytes | _Array) -> bytes:
    if isinstance(value, bytes):
        return _field(_BYTES, _field(1, value))
    if np.issubdtype(value.dtype, np.floating):
        return _field(_FLOATS, _field(1, value.astype("<f4").tobytes()))
    return _field(_INTEGERS, _field(1, varints(value)))


def _field(number: int, content: bytes) -> bytes:
    return bytes((number << 3 | _LENGTH,)) + varints(np.array([len(content)])) + content


def varints(values: _Array) -> bytes:
    """Integers as variable-length ones: seven bits a byte, the least first; negative ones take ten bytes."""
    bits = values.reshape(-1, 1).astype(np.int64).view(np.uint64)
    groups = bits >> (np.uint64(7) * _GROUPS)
    more = groups >= 128
    used = np.concatenate((np.ones_like(more[:, :1]), more[:, :-1]), axis=1)
    return (
        ((groups & np.uint64(127)) | (more.astype(np.uint64) << np.uint64(7)))
        .astype(np.uint8)[used]
        .tobytes()
    )


def shard_name(name: str, number: int, shards: int) -> str:
    """The usual file name of a shard."""
    return f"{name}.tfrecord-{number:05d}-of-{shards:05d}"


def write_record(file: BinaryIO, payload: bytes) -> None:
    """Append one record."""
    crc32c = import_extra("google_crc32c").value
    length = struct.pack("<Q", len(payload))
    for part in (length, payload):
        file.write(part)
        file.write(struct.pack("<I", masked(crc32c(part))))


_HEADER_BYTES, _FOOTER_BYTES = 12, 4
_MASK = 0xA282EAD8
#: Protocol buffers end here; a longer record is damage, whatever its checksum says.
_LONGEST_BYTES = 2**31 - 1
_FETCH = "copy or download the file again"


def masked(crc: int) -> int:
    """TFRecord's mask of a CRC-32C: rotate right by 15 bits, add a constant, modulo 2**32."""
    return (((crc >> 15) | (crc << 17)) + _MASK) & 0xFFFFFFFF


def read_records(path: str | Path) -> Iterator[tuple[int, bytes | DataError]]:
    """Record numbers (from 0) with their payloads, or with the error that stands in a record's place.

    Records after one whose payload is damaged are read; where a length is damaged or the file ends early, nothing
    after it can be found and the iteration ends with the error.

    Args:
        path: The file.

    Yields:
        (record number, payload or error). An empty file yields one error.
    """
    crc32c = _crc32c()
    path = Path(path)
    try:
        file = path.open("rb")
    except OSError as error:
        raise DataError(error.strerror or "cannot be opened", file=path, cure="check the path") from error
    with file:
        size = os.fstat(file.fileno()).st_size
        if size == 0:
            yield 0, DataError("the file is empty", file=path, record=0, cure=_FETCH)
        number = 0
        while file.tell() < size:
            record = _read_one(file, size, crc32c)
            lost = isinstance(record, DataError) and record.record == _LOST
            if isinstance(record, DataError):
                record = DataError(record.problem, file=path, record=number, cure=record.cure)
            yield number, record
            if lost:
                return
            number += 1


#: Marks an error after which the next record cannot be found.
_LOST = "lost"


def _read_one(file: BinaryIO, size: int, crc32c: Callable[[bytes], int]) -> bytes | DataError:
    start = file.tell()
    header = file.read(_HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        return DataError(
            f"truncated: {len(header)} bytes where a record's header of {_HEADER_BYTES} should be",
            record=_LOST,
            cure=_FETCH,
        )
    length, length_crc = struct.unpack("<QI", header)
    if masked(crc32c(header[:8])) != length_crc:
        return _bad_length(header, start)
    left = size - file.tell()
    if length > _LONGEST_BYTES or length + _FOOTER_BYTES > left:
        return DataError(
            f"truncated: the record needs {length + _FOOTER_BYTES} bytes, the file has {left} left",
            record=_LOST,
            cure=_FETCH,
        )
    payload = file.read(length)
    footer = file.read(_FOOTER_BYTES)
    if len(footer) < _FOOTER_BYTES:
        return DataError("the file became shorter while it was read", record=_LOST, cure=_FETCH)
    if masked(crc32c(payload)) != struct.unpack("<I", footer)[0]:
        return DataError("the payload is damaged (checksum mismatch)", cure=_FETCH)
    return payload


def count_records(path: str | Path) -> int:
    """How many records the file seems to hold: lengths are followed, nothing is checked, payloads are not read.

    Needs no package. 0 where the file cannot be opened; a record that the file's end cuts off is not counted.
    """
    try:
        with Path(path).open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            place = count = 0
            while place + _HEADER_BYTES + _FOOTER_BYTES <= size:
                file.seek(place)
                place += int.from_bytes(file.read(8), "little") + _HEADER_BYTES + _FOOTER_BYTES
                count += place <= size
            return count
    except OSError:
        return 0


def looks_framed(path: str | Path) -> bool:
    """Whether the file begins as a TFRecord does: a length with the right checksum. Needs no package, never raises."""
    try:
        with Path(path).open("rb") as file:
            header = file.read(_HEADER_BYTES)
    except (OSError, ValueError):
        return False
    if len(header) < _HEADER_BYTES:
        return False
    return masked(_crc32c_slowly(header[:8])) == struct.unpack_from("<I", header, 8)[0]


def _crc32c_slowly(data: bytes) -> int:
    """CRC-32C bit by bit (Castagnoli's polynomial, reflected): enough for the eight bytes of a length."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def _bad_length(header: bytes, start: int) -> DataError:
    if start == 0 and header[:2] == b"\x1f\x8b":
        return DataError("the file is gzip-compressed", record=_LOST, cure="decompress it first (gunzip)")
    if start == 0 and header[0] == 0x78 and int.from_bytes(header[:2], "big") % 31 == 0:
        return DataError("the file is zlib-compressed", record=_LOST, cure="decompress it first (zlib)")
    if start == 0:
        return DataError(
            "not a TFRecord file, or damaged (checksum mismatch in the first record's length)",
            record=_LOST,
            cure=f"give an uncompressed TFRecord; if it should be one, {_FETCH}",
        )
    return DataError(
        "the length is damaged (checksum mismatch), so the rest of the file cannot be read",
        record=_LOST,
        cure=_FETCH,
    )


def _crc32c() -> Callable[[bytes], int]:
    return import_extra("google_crc32c").value
