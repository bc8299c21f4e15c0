"""Columns of Argoverse 2 tables (parquet and feather files) as checked numpy arrays.

The headers of a file are checked before pyarrow, which trusts them, allocates memory for its unpacked size. Formats:
Apache Parquet, ``parquet.thrift`` in Thrift's compact protocol; Apache Arrow, ``Message.fbs`` in FlatBuffers, of which
a feather file (version 2) holds a stream.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int

from drivax.datasets.reader import read_head
from drivax.errors import DataError, explain_system, import_extra
from drivax.files import format_bytes
from drivax.reading import DAMAGE, check_regular

DATASET = "av2"
#: The recording car, a Ford Fusion: length, width and height of its box in the sensor logs, metres.
EGO_SIZE = (4.877, 2.0, 1.473)
#: Distance of the box centre ahead of the car's pose, and height of the pose. Poses are at the middle of the rear axle,
#: one wheel radius above ground: on real logs the axis that does not slip sideways in turns is within 0.3 m of them,
#: and the map 0.33 m below. The centre is half the wheelbase of 2.85 m ahead, less 0.09 m: the rear overhang is longer.
CENTRE_AHEAD_M = 1.34
AXLE_HEIGHT_M = 0.33
#: Largest plausible values: city coordinates in metres, speeds in m/s, sizes in metres, tracks times steps.
FARTHEST_M, FASTEST_MPS, LARGEST_M, MOST_STATES = 1e6, 200.0, 100.0, 2_000_000
PARQUET_MAGIC = b"PAR1"
_AGAIN = "download it again"
Array = np.ndarray[Any, Any]
Kind = Literal["number", "integer", "text"]
#: Limits of a file: the longest logs have some ten thousand rows, which take a few megabytes; damaged files can claim
#: any number.
MOST_ROWS, MOST_BYTES = 1_000_000, 128 << 20
#: Longest footer of a file, and longest header of a page or batch, bytes; those of Argoverse 2 have up to 5,000. Each
#: value in one may take some thousand bytes of memory.
_LONGEST_FOOTER, _LONGEST_HEADER = 1 << 18, 1 << 16
#: Maximum number of pages or messages: even empty ones take time; files of Argoverse 2 have up to a hundred.
_MOST_PARTS = 1 << 14
#: Accepted encodings of parquet pages: all but DELTA_BYTE_ARRAY (7), which repeats the beginning of the previous text.
_ENCODINGS = (0, 2, 3, 4, 5, 6, 8, 9)
#: Compact protocol: types of values, and the fields of a page header that hold the header of its content.
_TRUE, _FALSE, _BYTE, _I32, _I64, _DOUBLE, _BINARY, _LIST, _STRUCT = (
    1, 2, 3, 5, 6, 7, 8, 9, 12,
)  # fmt: skip
_DATA, _DICTIONARY, _DATA_V2 = 5, 7, 8
#: Arrow streams: offset of the stream in a feather file, continuation marker before a message, types of messages.
_STREAM, _CONTINUES = 8, 0xFFFFFFFF
_SCHEMA, _DICTIONARY_BATCH, _RECORD_BATCH = 1, 2, 3


@dataclass(frozen=True)
class Words:
    """A dictionary-encoded text column: distinct texts in order of appearance, and the index of each row's text."""

    words: tuple[str, ...]
    of_row: Int[Array, " row"]

    def text(self, row: int) -> str:
        """Return the text of a row."""
        return self.words[self.of_row[row]]


@dataclass(frozen=True)
class ArrowTable:
    """Columns of a table by name: float64 or int64 arrays, and texts; ``unread`` names the other columns."""

    rows: int
    numbers: Mapping[str, Array]
    texts: Mapping[str, Words]
    unread: frozenset[str]

    def stack(self, names: Sequence[str]) -> Array:
        """Stack columns of numbers, float64 ``[row, name]``."""
        return np.stack([self.numbers[name] for name in names], axis=1).astype(np.float64)


def read_table(path: Path, columns: Mapping[str, Kind], optional: Sequence[str] = ()) -> ArrowTable:
    """Read columns of a parquet or feather file; ``columns`` gives the kind of each by name.

    ``optional`` columns, which not every version of the format has, may be missing from the file.

    Raises:
        DataError: The file is missing or damaged, has no rows, or lacks a column.
        UsageError: pyarrow is missing, or too many files are open.
    """
    pa = import_extra("pyarrow")
    check_regular(path, _AGAIN)
    try:
        table, unread = _load(path, columns, optional)
        if table.num_rows == 0:
            raise DataError("contains no rows", file=path, cure=_AGAIN)
        kinds = [(name, columns[name], table.column(name)) for name in table.column_names]
        texts = {name: _words(column) for name, kind, column in kinds if kind == "text"}
        numbers = {
            name: _numbers(column, kind == "integer", name) for name, kind, column in kinds if kind != "text"
        }
    except FileNotFoundError as error:
        raise DataError("is missing", file=path, cure=_AGAIN) from error
    except DataError as error:
        raise DataError(error.problem, file=path, cure=error.cure) from error
    except (pa.ArrowException, OSError, *DAMAGE) as error:
        if isinstance(error, OSError) and (failure := explain_system(error, path)):
            raise failure from error
        raise DataError(f"is not a valid table ({str(error)[:160]})", file=path, cure=_AGAIN) from error
    return ArrowTable(table.num_rows, numbers, texts, unread)


def _load(path: Path, columns: Mapping[str, Kind], optional: Sequence[str]) -> tuple[Any, frozenset[str]]:
    """Return the columns as an Arrow table, and the names of the columns that were not read.

    The table is validated, because string offsets of damaged files may point anywhere.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with pa.OSFile(str(path)) as source:
        if read_head(path, 4) == PARQUET_MAGIC:
            check_footer(source)
            file = pq.ParquetFile(source)
            schema, parquet_schema = file.schema_arrow, file.schema
            names = _select_columns(schema, columns, optional)
            indices = [i for i in range(len(parquet_schema)) if parquet_schema.column(i).path in names]
            check_pages(source, indices)
            # Text stays dictionary-encoded: every row may repeat one text of a megabyte.
            texts = [name for name in names if columns[name] == "text"]
            file = pq.ParquetFile(source, metadata=file.metadata, read_dictionary=texts)
            table = file.read(columns=names, use_threads=False)
        else:
            # Read the stream inside the file and not its footer, which may point elsewhere.
            check_messages(source)
            schema = pa.ipc.open_stream(source).schema
            names = _select_columns(schema, columns, optional)
            check_messages(source)
            indices = [schema.names.index(name) for name in names]
            options = pa.ipc.IpcReadOptions(use_threads=False, included_fields=indices)
            table = pa.ipc.open_stream(source, options=options).read_all()
    table.validate(full=True)
    return table, frozenset(schema.names) - {*names}


def _select_columns(schema: Any, columns: Mapping[str, Kind], optional: Sequence[str]) -> list[str]:
    """Return the names of the columns to read.

    Raises:
        DataError: A required column is missing, a column is repeated or has another type, or a name contains a dot.
    """
    names = [name for name in columns if name in schema.names or name not in optional]
    for name in names:
        if schema.names.count(name) != 1:
            problem = f"has {'several columns' if name in schema.names else 'no column'} {name}"
            raise DataError(problem, cure="name a table of Argoverse 2, or download it again")
        # Other types, such as run-end encoded ones, may repeat one value without limit.
        if not _is_plain(arrow_type := schema.field(name).type, columns[name]):
            raise DataError(f"column {name} contains {str(arrow_type)[:80]}", cure=_AGAIN)
    # pyarrow would read ``a.b`` together with ``a``.
    if any("." in name for name in schema.names):
        raise DataError("has a column with a dot in its name", cure=_AGAIN)
    return names


def _is_plain(arrow_type: Any, kind: Kind) -> bool:
    """Return whether columns of a kind may have this Arrow type."""
    import pyarrow as pa

    if kind == "text":
        arrow_type = arrow_type.value_type if pa.types.is_dictionary(arrow_type) else arrow_type
        return pa.types.is_string(arrow_type) or pa.types.is_large_string(arrow_type)
    return pa.types.is_integer(arrow_type) or (kind == "number" and pa.types.is_floating(arrow_type))


def _numbers(column: Any, is_integer: bool, name: str) -> Array:
    """Return a numeric column as int64 if ``is_integer``, else as float64; refuse null values."""
    if column.null_count:
        raise DataError(
            f"column {name} contains {column.type} with {column.null_count} null values", cure=_AGAIN
        )
    return column.to_numpy().astype(np.int64 if is_integer else np.float64)


def _words(column: Any) -> Words:
    """Return a text column, with "" for null; its Arrow dictionary may hold unused or repeated words."""
    import pyarrow as pa

    is_dictionary = pa.types.is_dictionary(column.type)
    array = (column.unify_dictionaries() if is_dictionary else column.dictionary_encode()).combine_chunks()
    codes = array.indices.cast(pa.int64()).fill_null(-1).to_numpy()
    unique_codes, first, inverse = np.unique(codes, return_index=True, return_inverse=True)
    order = np.argsort(first)
    texts = array.dictionary.take(pa.array(unique_codes[order], mask=unique_codes[order] < 0)).to_pylist()
    words: dict[str, int] = {}
    word_index = np.empty(len(unique_codes), np.int64)
    word_index[order] = [words.setdefault(text or "", len(words)) for text in texts]
    return Words(tuple(words), word_index[inverse])


def check_footer(source: Any) -> None:
    """Refuse a parquet file whose footer has an implausible length.

    Raises:
        Exception: One of ``reading.DAMAGE``, as in all checks of sizes.
    """
    if (length := _footer_length(source)) > _LONGEST_FOOTER:
        raise ValueError(f"a footer of {format_bytes(length)}")
    source.seek(0)


def _footer_length(source: Any) -> int:
    source.seek(max(source.size() - 8, 0))
    return struct.unpack("<I", source.read(8)[:4])[0]


def check_pages(source: Any, columns: Sequence[int]) -> None:
    """Refuse a parquet file if the columns with these indices have too many rows or unpack to too many bytes.

    The footer is decoded here, because pyarrow aborts the process if the sizes in it contradict its schema.
    """
    length = _footer_length(source)
    source.seek(source.size() - 8 - length)
    footer, _ = _read_struct(source.read(length), 0)
    groups = footer[4, _LIST]
    budget, rows = _Budget(), sum(group[3, _I64] for group in groups)
    budget.take(rows, 0)
    groups = groups if rows else []  # columns of empty files have no offsets
    previous_end = 0
    for start, end in sorted(_extent(group[1, _LIST][number]) for group in groups for number in columns):
        if not 0 <= start <= end <= source.size():
            raise ValueError("a column outside the file")
        if start < previous_end:  # row groups that share pages would repeat them
            raise ValueError("columns that overlap")
        previous_end = end
        while start < end:
            start += _check_page(source, start, budget)
    source.seek(0)


def _extent(column: Mapping[tuple[int, int], Any]) -> tuple[int, int]:
    """Return the byte range of a column of a row group: first byte, and one past the last."""
    metadata = column[3, _STRUCT]
    start = metadata[9, _I64]
    # The page of a dictionary comes before the pages of data.
    start = min(start, metadata.get((11, _I64), start))
    return start, start + metadata[7, _I64]


def check_messages(source: Any) -> None:
    """Refuse a feather file with too many rows or unpacked bytes; leave ``source`` at the start of its stream."""
    budget, position = _Budget(), _STREAM
    while left := source.size() - position:
        if left < 8:  # Arrow would take what is there as a length, and allocate it
            raise ValueError("a message of invalid length")
        source.seek(position)
        mark, length = struct.unpack("<II", source.read(8))
        if mark != _CONTINUES or length > _LONGEST_HEADER:
            raise ValueError("a message of invalid length")
        if not length:
            break
        budget.take_part(length)
        header, body = source.read(length), position + 8 + length
        message = _root(header)
        kind, content = _scalar(header, message, 1, "<B"), _table(header, message, 2)
        if kind == _DICTIONARY_BATCH:
            content = _table(header, content, 1)
        if kind in (_DICTIONARY_BATCH, _RECORD_BATCH):
            _check_batch(source, header, content, body, budget, kind == _RECORD_BATCH)
        elif kind != _SCHEMA:
            raise ValueError(f"a message of kind {kind}")
        if not 0 <= (size := _scalar(header, message, 3, "<q")) <= source.size() - body:
            raise ValueError("a message outside the file")
        position = body + size
    source.seek(_STREAM)


class _Budget:
    """Rows, bytes and parts that a file may still use."""

    def __init__(self) -> None:
        self._rows, self._bytes, self._parts = MOST_ROWS, MOST_BYTES, _MOST_PARTS

    def take_part(self, length: int) -> None:
        """Deduct a page or message with a header of ``length`` bytes, without its content."""
        self._parts -= 1
        self.take(0, length)
        if self._parts < 0:
            raise ValueError(f"more than {_MOST_PARTS:,} pages or messages")

    def take(self, rows: int, size: int) -> None:
        if rows < 0 or size < 0:
            raise ValueError("a negative length")
        self._rows -= rows
        self._bytes -= size
        if self._rows < 0:
            raise ValueError(f"more than {MOST_ROWS:,} rows")
        if self._bytes < 0:
            raise ValueError(f"unpacks to more than {format_bytes(MOST_BYTES)}")


def _check_page(source: Any, start: int, budget: _Budget) -> int:
    """Deduct a page from the budget; return its length in the file, bytes."""
    source.seek(start)
    fields, length = _read_struct(source.read(_LONGEST_HEADER), 0)
    size = fields[3, _I32]
    if size < 0:
        raise ValueError("a page of negative length")
    budget.take_part(length)
    budget.take(0, fields[2, _I32])
    for field, encoding in ((_DATA, 2), (_DICTIONARY, 2), (_DATA_V2, 4)):
        content = fields.get((field, _STRUCT), {})
        if content and content[encoding, _I32] not in _ENCODINGS:
            raise ValueError(f"a page of encoding {content[encoding, _I32]}")
        if not 0 <= content.get((1, _I32), 0) <= MOST_ROWS:
            raise ValueError(f"a page of {content[1, _I32]} values")
    return length + size


def _read_struct(data: bytes, position: int, depth: int = 8) -> tuple[dict[tuple[int, int], Any], int]:
    """Read a struct of the compact protocol: its fields by number and type, and the position after it.

    As in pyarrow, a field of an unexpected type does not count, and the last of repeated fields does.
    """
    if not depth:
        raise ValueError("nested too deeply")
    fields: dict[tuple[int, int], Any] = {}
    number = 0
    while head := data[position]:
        position += 1
        kind = head & 15
        if head >> 4:
            number += head >> 4
        else:
            number, position = _read_signed(data, position)
        fields[number, kind], position = _read_value(data, position, kind, depth)
    return fields, position + 1


def _read_value(data: bytes, position: int, kind: int, depth: int) -> tuple[Any, int]:
    if kind in (_TRUE, _FALSE):
        return kind == _TRUE, position
    if kind == _BYTE:
        return data[position], position + 1
    if _BYTE < kind <= _I64:
        return _read_signed(data, position)
    if kind == _DOUBLE:
        return None, position + 8
    if kind == _BINARY:
        length, position = _read_varint(data, position)
        return None, position + length
    if kind == _STRUCT:
        return _read_struct(data, position, depth - 1)
    if kind == _LIST:
        return _read_list(data, position, depth)
    raise ValueError(f"a header with a value of kind {kind}")


def _read_list(data: bytes, position: int, depth: int) -> tuple[list[Any], int]:
    count, kind = data[position] >> 4, data[position] & 15
    position += 1
    if count == 15:
        count, position = _read_varint(data, position)
    values: list[Any] = []
    for _ in range(count):  # Each takes a byte or more: booleans in lists are bytes.
        value, position = _read_value(data, position, _BYTE if kind in (_TRUE, _FALSE) else kind, depth)
        values.append(value)
    return values, position


def _read_varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[position]
        value, shift, position = value | (byte & 127) << shift, shift + 7, position + 1
        if byte < 128:
            return value, position
        if shift > 63:
            raise ValueError("an integer of more than ten bytes")


def _read_signed(data: bytes, position: int) -> tuple[int, int]:
    value, position = _read_varint(data, position)
    return value >> 1 ^ -(value & 1), position


def _check_batch(source: Any, header: bytes, batch: int, body: int, budget: _Budget, has_rows: bool) -> None:
    """Deduct a record batch, or the batch of a dictionary (without rows), from the budget."""
    rows = _scalar(header, batch, 0, "<q")
    budget.take(rows * has_rows, 0)
    is_compressed = _field(header, batch, 3) is not None
    start = _field(header, batch, 2)
    if start is None:
        return
    start += _unpack("<I", header, start)
    for number in range(_unpack("<I", header, start)):
        offset, size = struct.unpack_from("<qq", header, start + 4 + 16 * number)
        if is_compressed and size >= 8:
            source.seek(body + offset)
            unpacked = int.from_bytes(source.read(8), "little", signed=True)
            size = size if unpacked == -1 else unpacked
        budget.take(0, size)


def _root(data: bytes) -> int:
    return _unpack("<I", data, 0)


def _field(data: bytes, table: int, number: int) -> int | None:
    """Return the position of a field of a FlatBuffers table; None if the table lacks it."""
    vtable = table - _unpack("<i", data, table)
    entry = 4 + 2 * number
    if entry >= _unpack("<H", data, vtable):
        return None
    offset = _unpack("<H", data, vtable + entry)
    return table + offset if offset else None


def _scalar(data: bytes, table: int, number: int, format_code: str) -> int:
    position = _field(data, table, number)
    return 0 if position is None else _unpack(format_code, data, position)


def _table(data: bytes, table: int, number: int) -> int:
    position = _field(data, table, number)
    if position is None:
        raise ValueError("a message without content")
    return position + _unpack("<I", data, position)


def _unpack(format_code: str, data: bytes, position: int) -> int:
    if position < 0:
        raise ValueError("a position before the message")
    return struct.unpack_from(format_code, data, position)[0]
