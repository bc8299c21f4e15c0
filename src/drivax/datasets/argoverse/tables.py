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
            unpacked_size.check_footer(source)
            file = pq.ParquetFile(source)
            schema, parquet_schema = file.schema_arrow, file.schema
            names = _select_columns(schema, columns, optional)
            indices = [i for i in range(len(parquet_schema)) if parquet_schema.column(i).path in names]
            unpacked_size.check_pages(source, indices)
            # Text stays dictionary-encoded: every row may repeat one text of a megabyte.
            texts = [name for name in names if columns[name] == "text"]
            file = pq.ParquetFile(source, metadata=file.metadata, read_dictionary=texts)
            table = file.read(columns=names, use_threads=False)
        else:
            # Read the stream inside the file and not its footer, which may point elsewhere.
            unpacked_size.check_messages(source)
            schema = pa.ipc.open_stream(source).schema
            names = _select_columns(schema, columns, optional)
            unpacked_size.check_messages(source)
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
