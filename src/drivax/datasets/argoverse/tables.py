"""Columns of Argoverse 2 tables (parquet and feather files) as checked numpy arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int

from drivax.datasets.argoverse import unpacked_size
from drivax.datasets.reader import read_head
from drivax.errors import DataError, explain_system, import_extra
from drivax.reading import DAMAGE, check_regular

DATASET = "av2"
#: The recording car, a Ford Fusion: length, width and height of its box in the sensor logs, metres.
EGO_SIZE = (4.877, 2.0, 1.473)
#: Its poses are those of the middle of the rear axle, one wheel radius above ground: on real logs the axis that does
#: not slip sideways in turns is within 0.3 m of the pose, and the map 0.33 m below it. The body's middle is half the
#: wheelbase of 2.85 m ahead, less 0.09 m, because the rear overhang is longer than the front one.
CENTRE_AHEAD_M = 1.34
AXLE_HEIGHT_M = 0.33
#: Limits of what can be in a log: city coordinates in metres, speeds in m/s, sizes in metres, tracks times steps.
FARTHEST_M, FASTEST_MPS, LARGEST_M, MOST_STATES = 1e6, 200.0, 100.0, 2_000_000
PARQUET_MAGIC = b"PAR1"
_AGAIN = "download it again"
Array = np.ndarray[Any, Any]
Kind = Literal["number", "whole", "text"]


@dataclass(frozen=True)
class Words:
    """A column of text: its words in order of appearance, and the index of the word of every row."""

    words: tuple[str, ...]
    of_row: Int[Array, " row"]

    def text(self, row: int) -> str:
        """Return the text of a row."""
        return self.words[self.of_row[row]]


@dataclass(frozen=True)
class Table:
    """Columns of a table by name, float64 or int64 arrays or :class:`Words`; ``unread`` are the names of the others."""

    rows: int
    numbers: Mapping[str, Array]
    texts: Mapping[str, Words]
    unread: frozenset[str]

    def stack(self, names: Sequence[str]) -> Array:
        """Stack columns of numbers, float64 ``[row, name]``."""
        return np.stack([self.numbers[name] for name in names], axis=1).astype(np.float64)


def read_table(path: Path, columns: Mapping[str, Kind], optional: Sequence[str] = ()) -> Table:
    """Read columns of a parquet or feather file, by name and kind: any number, integers, or text.

    ``optional`` columns, which not every version of the format has, may be missing.

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
            name: _numbers(column, kind == "whole", name) for name, kind, column in kinds if kind != "text"
        }
    except FileNotFoundError as error:
        raise DataError("is missing", file=path, cure=_AGAIN) from error
    except DataError as error:
        raise DataError(error.problem, file=path, cure=error.cure) from error
    except (pa.ArrowException, OSError, *DAMAGE) as error:
        if isinstance(error, OSError) and (failure := explain_system(error, path)):
            raise failure from error
        raise DataError(f"is not a valid table ({str(error)[:160]})", file=path, cure=_AGAIN) from error
    return Table(table.num_rows, numbers, texts, unread)


def _load(path: Path, columns: Mapping[str, Kind], optional: Sequence[str]) -> tuple[Any, frozenset[str]]:
    """Return the columns as a validated Arrow table, and the names of the others.

    String offsets of damaged files may point anywhere.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with pa.OSFile(str(path)) as source:
        if read_head(path, 4) == PARQUET_MAGIC:
            unpacked_size.check_footer(source)
            file = pq.ParquetFile(source)
            schema, places = file.schema_arrow, file.schema
            names = _check(schema, columns, optional)
            read = [number for number in range(len(places)) if places.column(number).path in names]
            unpacked_size.check_pages(source, read)
            # Text stays in dictionaries: a text of a megabyte may be that of all rows.
            texts = [name for name in names if columns[name] == "text"]
            file = pq.ParquetFile(source, metadata=file.metadata, read_dictionary=texts)
            table = file.read(columns=names, use_threads=False)
        else:
            # The file is read as the stream in it: its footer may point elsewhere.
            unpacked_size.check_messages(source)
            schema = pa.ipc.open_stream(source).schema
            names = _check(schema, columns)
            unpacked_size.check_messages(source)
            indices = [schema.names.index(name) for name in names]
            options = pa.ipc.IpcReadOptions(use_threads=False, included_fields=indices)
            table = pa.ipc.open_stream(source, options=options).read_all()
    table.validate(full=True)
    return table, frozenset(schema.names) - {*names}


def _check(schema: Any, columns: Mapping[str, Kind], optional: Sequence[str] = ()) -> list[str]:
    """Return the columns that a table has; refuse it if it lacks one, or has one twice or of another type.

    Columns of other types could repeat a value, and those with dots in their names be read with others.
    """
    names = [name for name in columns if name in schema.names or name not in optional]
    for name in names:
        if schema.names.count(name) != 1:
            problem = f"has {'several columns' if name in schema.names else 'no column'} {name}"
            raise DataError(problem, cure="name a table of Argoverse 2, or download it again")
        if not _is_plain(column := schema.field(name).type, columns[name]):
            raise DataError(f"column {name} contains {str(column)[:80]}", cure=_AGAIN)
    if any("." in name for name in schema.names):
        raise DataError("has a column with a dot in its name", cure=_AGAIN)
    return names


def _is_plain(column: Any, kind: Kind) -> bool:
    """Return whether an Arrow type is one of a kind of column."""
    import pyarrow as pa

    if kind == "text":
        column = column.value_type if pa.types.is_dictionary(column) else column
        return pa.types.is_string(column) or pa.types.is_large_string(column)
    return pa.types.is_integer(column) or (kind == "number" and pa.types.is_floating(column))


def _numbers(column: Any, is_integer: bool, name: str) -> Array:
    """Return a column of integers or, unless ``is_integer``, of any numbers."""
    if column.null_count:
        raise DataError(
            f"column {name} contains {column.type} with {column.null_count} null values", cure=_AGAIN
        )
    return column.to_numpy().astype(np.int64 if is_integer else np.float64)


def _words(column: Any) -> Words:
    """Return a column of text, whose dictionary may have words of no row or the same word twice."""
    import pyarrow as pa

    is_dictionary = pa.types.is_dictionary(column.type)
    codes = (column.unify_dictionaries() if is_dictionary else column.dictionary_encode()).combine_chunks()
    rows = codes.indices.cast(pa.int64()).fill_null(-1).to_numpy()
    used, first, of_row = np.unique(rows, return_index=True, return_inverse=True)
    order = np.argsort(first)
    texts = codes.dictionary.take(pa.array(used[order], mask=used[order] < 0)).to_pylist()
    words: dict[str, int] = {}
    numbers = np.empty(len(used), np.int64)
    numbers[order] = [words.setdefault(text or "", len(words)) for text in texts]
    return Words(tuple(words), numbers[of_row])
