"""Untrusted SQLite files, opened read-only with bounded queries, and the layers of GeoPackages.

A geometry of a GeoPackage is a BLOB: a header of 8 bytes, an optional envelope, then WKB (OGC 12-128r19, clause 2.1.3).
"""

from __future__ import annotations

import contextlib
import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from sys import getsizeof
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from drivax.errors import DataError, import_extra
from drivax.files import format_bytes
from drivax.reading import check_regular, explain_damage

Array = np.ndarray[Any, Any]

_MAGIC = b"SQLite format 3\0"
_CURE = "download the file again"
#: Longest accepted text or BLOB, bytes, a million corners of a polygon; a damaged length must not allocate more.
_LONGEST_CELL = 1 << 24
#: Longest statement of the schema, bytes; those of nuPlan and GeoPackages have up to 3,000. It bounds the default of a
#: column, which rows without the column repeat.
_LONGEST_STATEMENT = 20_000
#: Memory of the rows of a result, bytes: half a million boxes take 250 MB. Damage and defaults can multiply the rows of
#: small files, which may therefore take only the first number plus 16 times their size.
_LEAST_RESULT, _MOST_RESULT, _RESULT_PER_BYTE = 32 << 20, 512 << 20, 16
#: Rows that are fetched before their memory is counted.
_ROWS_AT_ONCE = 8
#: Limit of virtual machine instructions of a query: a million, plus 20 per byte of the file (a full scan takes about
#: 0.1 per byte). It ends queries on damaged trees with cycles.
_STEPS_PER_BYTE = 20
_STEPS_AT_ONCE = 100_000
#: Maximum number of parameters of a query; old builds of SQLite take 999.
_VALUES_AT_ONCE = 500
_GEOGRAPHIC = 4326
#: Bytes of the envelope by its code: none, xy, xyz, xym, xyzm.
_ENVELOPE_BYTES = (0, 32, 48, 48, 64)
#: Bytes of a geometry's header with an envelope in the plane.
_HEAD_BYTES = 40


class Database:
    """One SQLite file, opened by :func:`open_database`.

    Queries neither sort nor join: SQLite would store the rows in temporary files of any size.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        self._instructions_left = self._budget = 0
        connection.set_progress_handler(self._tick, _STEPS_AT_ONCE)

    def _tick(self) -> int:
        """Count instructions of the query; SQLite ends it if the result is not 0."""
        self._instructions_left -= _STEPS_AT_ONCE
        return int(self._instructions_left < 0)

    def rows(self, query: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Return all rows of a query.

        Raises:
            DataError: SQLite cannot read them, or they take too much memory or too long.
        """
        self._budget = self._result_limit()
        return self._fetch(query, values)

    def rows_in(self, query: str, values: Sequence[Any]) -> list[tuple[Any, ...]]:
        """Return all rows of a query that ends in ``IN``, for any number of values."""
        self._budget = self._result_limit()
        rows = []
        for start in range(0, len(values), _VALUES_AT_ONCE):
            batch = values[start : start + _VALUES_AT_ONCE]
            rows += self._fetch(f"{query} ({', '.join('?' * len(batch))})", batch)
        return rows

    def _result_limit(self) -> int:
        return min(_LEAST_RESULT + _RESULT_PER_BYTE * self.path.stat().st_size, _MOST_RESULT)

    def _fetch(self, query: str, values: Sequence[Any]) -> list[tuple[Any, ...]]:
        """Return the rows of a query; deduct their memory from the budget."""
        self._instructions_left = 1_000_000 + _STEPS_PER_BYTE * self.path.stat().st_size
        rows: list[tuple[Any, ...]] = []
        try:
            cursor = self._connection.execute(query, values)
            while batch := cursor.fetchmany(_ROWS_AT_ONCE):
                self._budget -= sum(map(getsizeof, batch)) + sum(map(getsizeof, chain.from_iterable(batch)))
                if self._budget < 0:
                    raise MemoryError(f"rows of more than {format_bytes(self._result_limit())}")
                rows += batch
        except (sqlite3.Error, UnicodeDecodeError, OverflowError, MemoryError) as error:
            problem = f"SQLite cannot read it ({str(error) or 'out of memory'})"
            raise DataError(problem, file=self.path, cure=_CURE) from error
        return rows

    def tables(self) -> frozenset[str]:
        """Return the names of all tables but those of SQLite itself."""
        names = self.rows("SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite%'")
        return frozenset(str(name) for (name,) in names)

    def columns(self, table: str) -> frozenset[str]:
        """Return the names of a table's columns; none if it is missing, virtual or a view, or has computed columns."""
        # Virtual tables have the type 'table', too, but run the code of their module.
        query = "SELECT 1 FROM sqlite_master WHERE name = ? AND type = 'table' AND sql LIKE 'CREATE TABLE%'"
        if not self.rows(query, (table,)):
            return frozenset()
        columns = self.rows("SELECT name, hidden FROM pragma_table_xinfo(?)", (table,))
        is_computed = any(hidden for _, hidden in columns)  # computed values could need any amount of memory
        return frozenset() if is_computed else frozenset(str(name) for name, _ in columns)

    def require(self, table: str, *columns: str) -> None:
        """Raise a DataError unless a table has these columns."""
        present = self.columns(table)
        if not present:
            raise DataError(f"has no table {table}", file=self.path, cure=_CURE)
        if missing := [name for name in columns if name not in present]:
            raise DataError(f"its table {table} has no column {missing[0]}", file=self.path, cure=_CURE)


@contextlib.contextmanager
def open_database(path: Path) -> Iterator[Database]:
    """Open a SQLite file read-only and as immutable: no lock, no journal, nothing is written next to it."""
    check_regular(path, _CURE)
    with explain_damage(path, "check the path"), path.open("rb") as file:
        head = file.read(len(_MAGIC))
    if head != _MAGIC:
        raise DataError("is not an SQLite file", file=path, cure=_CURE)
    try:
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
    except sqlite3.Error as error:
        raise DataError(f"SQLite cannot open it ({error})", file=path, cure=_CURE) from error
    with contextlib.closing(connection):
        connection.text_factory = lambda value: value.decode("utf-8", "replace")
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_CELL)
        connection.setlimit(sqlite3.SQLITE_LIMIT_SQL_LENGTH, _LONGEST_STATEMENT)
        database = Database(path, connection)
        database.rows("PRAGMA trusted_schema = OFF")
        yield database


@dataclass(frozen=True)
class Layer:
    """A layer of a GeoPackage without its geometries.

    Attributes:
        name: Table.
        geometry: Geometry column.
        epsg: EPSG code of the coordinate system of the geometries.
        fid: Feature ids (row ids).
        bounds: West, south, east, north in that system; NaN where a geometry is unreadable.
        columns: Values of the requested columns; None for columns that the layer lacks.
    """

    name: str
    geometry: str
    epsg: int
    fid: Int64[np.ndarray, " feature"]
    bounds: Float64[np.ndarray, "feature 4"]
    columns: Mapping[str, tuple[Any, ...]]

    def query_box(self, box: tuple[float, float, float, float]) -> Int64[np.ndarray, " row"]:
        """Return the rows whose bounds touch a box (west, south, east, north)."""
        west, south, east, north = box
        low, high = self.bounds[:, :2], self.bounds[:, 2:]
        return np.flatnonzero((low <= (east, north)).all(axis=1) & (high >= (west, south)).all(axis=1))


def read_layer(database: Database, name: str, columns: Sequence[str] = ()) -> Layer | None:
    """Read a layer without its geometries; None for one that the GeoPackage lacks."""
    present = database.columns(name)
    database.require("gpkg_geometry_columns", "table_name", "column_name", "srs_id")
    entries = database.rows(
        "SELECT column_name, srs_id FROM gpkg_geometry_columns WHERE table_name = ?", (name,)
    )
    if not present or not entries:
        return None
    geometry, epsg = entries[0]
    if geometry not in present or not str(geometry).isidentifier():
        raise DataError(f"layer {name} has no geometry column", file=database.path, cure=_CURE)
    available = [column for column in columns if column in present]
    selection = ", ".join(["rowid", f"substr({geometry}, 1, {_HEAD_BYTES})", *(f'"{c}"' for c in available)])
    rows = database.rows(f"SELECT {selection} FROM {name} ORDER BY rowid")
    values = {column: tuple(row[i + 2] for row in rows) for i, column in enumerate(available)}
    layer = Layer(
        name=name,
        geometry=geometry,
        epsg=epsg if isinstance(epsg, int) and epsg > 0 else _GEOGRAPHIC,
        fid=np.array([row[0] for row in rows], np.int64),
        bounds=np.array([_envelope(row[1]) for row in rows], np.float64).reshape(-1, 4),
        columns={column: values.get(column, (None,) * len(rows)) for column in columns},
    )
    # Where the header has no envelope, compute the bounds from the geometry itself.
    rows_without = np.flatnonzero(~np.isfinite(layer.bounds).all(axis=1))
    if len(rows_without):
        shapes = geometries(database, layer, rows_without)
        with np.errstate(invalid="ignore"):
            layer.bounds[rows_without] = [
                (np.nan,) * 4 if shape is None else shape.bounds for shape in shapes
            ]
    return layer


def _envelope(head: Any) -> tuple[float, float, float, float]:
    """Return the bounds in the header of a geometry BLOB; NaN without them."""
    is_complete = isinstance(head, bytes) and len(head) >= _HEAD_BYTES and head[:2] == b"GP"
    # Byte 3 holds flags: bit 0 the byte order, bits 1 to 3 the code of the envelope, bits 4 and 5 empty and extended.
    if not is_complete or not 1 <= head[3] >> 1 & 7 <= 4:
        return np.nan, np.nan, np.nan, np.nan
    west, east, south, north = struct.unpack_from("<4d" if head[3] & 1 else ">4d", head, 8)
    return west, south, east, north


def geometries(database: Database, layer: Layer, rows: Int64[np.ndarray, " row"]) -> Array:
    """Return the geometries of rows as an array of shapely objects; None for unreadable ones."""
    shapely = import_extra("shapely")
    fids = layer.fid[rows].tolist()
    query = f"SELECT rowid, {layer.geometry} FROM {layer.name} WHERE rowid IN"
    blob_by_fid = {fid: _wkb(blob) for fid, blob in database.rows_in(query, fids)}
    blobs = np.array([None, *map(blob_by_fid.get, fids)], dtype=object)[1:]
    with np.errstate(invalid="ignore"):  # coordinates that are NaN
        try:
            return np.asarray(shapely.from_wkb(blobs, on_invalid="ignore"))
        except NotImplementedError:  # one of them is a curve
            return np.array([_decode(blob) for blob in blobs], dtype=object)


def _decode(blob: bytes | None) -> Any:
    """Decode a geometry; None for a curve or an unreadable one."""
    with contextlib.suppress(NotImplementedError):
        return import_extra("shapely").from_wkb(blob, on_invalid="ignore")
    return None


def _wkb(blob: Any) -> bytes | None:
    """Return the WKB in a geometry BLOB; None for an empty geometry, an extension, and anything else."""
    if not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP":
        return None
    code = blob[3] >> 1 & 7
    if code >= len(_ENVELOPE_BYTES) or blob[3] & 0b110000:
        return None
    return blob[8 + _ENVELOPE_BYTES[code] :]
