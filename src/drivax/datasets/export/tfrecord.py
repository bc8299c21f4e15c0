"""TFRecord files and tf.Examples written without TensorFlow.

A tf.Example is a protocol-buffer map from names to lists of bytes, float32 or int64 (``tensorflow/core/example``). It
is written field by field: faster than through a message, and always the same bytes. Framing is that of
``drivax.datasets.womd.tfrecord``.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np

from drivax.datasets.womd.tfrecord import masked
from drivax.errors import UsageError

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
    """Append one record.

    Raises:
        UsageError: google-crc32c is not installed.
    """
    try:
        import google_crc32c
    except ImportError as error:
        raise UsageError(
            "writing TFRecord files needs google-crc32c", cure="pip install 'drivax[womd]'"
        ) from error
    length = struct.pack("<Q", len(payload))
    for part in (length, payload):
        file.write(part)
        file.write(struct.pack("<I", masked(google_crc32c.value(part))))
