"""SQLite files and GeoPackage geometries, against files written with sqlite3 and shapely alone."""

from __future__ import annotations

import sqlite3
import struct
import tracemalloc
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import shapely

from datasets.samples import nuplan as sample
from drivax.datasets.nuplan import sqlite
from drivax.datasets.nuplan.sqlite import geometries, open_database, read_layer
from drivax.errors import DataError

SHAPES = (
    shapely.LineString([(-115.1, 36.1), (-115.0, 36.2)]),
    shapely.Polygon(
        [(-115.1, 36.1), (-115.0, 36.1), (-115.0, 36.3)], [[(-115.03, 36.11), (-115.02, 36.11), (-115.02, 36.12)]]
    ),
    shapely.MultiLineString([[(1.0, 2.0), (3.0, 4.0)], [(5.0, 6.0), (7.0, 8.5)]]),
    shapely.Point(9.0, -3.0),
    shapely.LineString([(0.0, 0.0, 5.0), (1.0, 1.0, 6.0)]),
)  # fmt: skip


def package(path: Path, encode=sample.blob, shapes=SHAPES) -> Path:
    layer = sample.Layer(("name", "size"))
    for i, shape in enumerate(shapes):
        layer.add(10 * (i + 1), shape, f"shape {i}", i / 2)
    sample.write_map(path, {"things": layer}, encode)
    return path


def execute(path: Path, *statements: str) -> None:
    with closing(sqlite3.connect(path)) as db, db:
        for statement in statements:
            db.execute(statement)


@pytest.mark.parametrize("envelope", [True, False])
@pytest.mark.parametrize("little", [True, False])
def test_geometries_in_either_byte_order_with_and_without_envelope(tmp_path, envelope, little):
    path = package(tmp_path / "map.gpkg", partial(sample.blob, envelope=envelope, little=little))
    with open_database(path) as database:
        layer = read_layer(database, "things", ("size", "absent"))
        assert layer is not None
        found = geometries(database, layer, np.array([4, 0, 1, 2, 3]))
    assert layer.fid.tolist() == [10, 20, 30, 40, 50]
    assert layer.epsg == 4326
    assert layer.columns == {"size": (0.0, 0.5, 1.0, 1.5, 2.0), "absent": (None,) * 5}
    np.testing.assert_array_equal(layer.bounds, [shape.bounds for shape in SHAPES])
    assert [a.equals(SHAPES[i]) for a, i in zip(found, (4, 0, 1, 2, 3), strict=True)] == [True] * 5


@pytest.mark.parametrize("code", [2, 3, 4])
def test_envelopes_with_heights_and_measures(tmp_path, code):
    """Envelope codes 2 to 4 add z, m or both after x and y."""

    def encode(shape):
        west, south, east, north = shape.bounds
        extra = (0.0, 1.0) * (2 if code == 4 else 1)
        bounds = struct.pack(f"<{4 + len(extra)}d", west, east, south, north, *extra)
        return b"GP\0" + bytes([code << 1 | 1]) + struct.pack("<i", 4326) + bounds + shapely.to_wkb(shape)

    path = package(tmp_path / "map.gpkg", encode)
    with open_database(path) as database:
        layer = read_layer(database, "things")
        assert layer is not None
        found = geometries(database, layer, np.arange(5))
    np.testing.assert_array_equal(layer.bounds, [shape.bounds for shape in SHAPES])
    assert all(a.equals(b) for a, b in zip(found, SHAPES, strict=True))


def test_touching_equals_brute_force(tmp_path):
    rng = np.random.default_rng(3)
    corners = rng.uniform(-1.0, 1.0, (200, 2))
    shapes = [
        shapely.box(x, y, x + w, y + h)
        for (x, y), (w, h) in zip(corners, rng.uniform(0.01, 0.4, (200, 2)), strict=True)
    ]
    with open_database(package(tmp_path / "map.gpkg", shapes=shapes)) as database:
        layer = read_layer(database, "things")
    assert layer is not None
    for x, y in rng.uniform(-1.0, 1.0, (20, 2)):
        box = (x, y, x + 0.2, y + 0.3)
        expected = [i for i, shape in enumerate(shapes) if shape.intersects(shapely.box(*box))]
        assert layer.query_box(box).tolist() == expected


BAD = {
    "null": None,
    "text": "POINT (1 2)",
    "short": b"GP",
    "other magic": b"XX\0\1" + bytes(4) + shapely.to_wkb(SHAPES[3]),
    "reserved envelope": b"GP\0\x0d" + bytes(4) + bytes(32) + shapely.to_wkb(SHAPES[3]),
    "extension": b"GP\0\x21" + bytes(4) + shapely.to_wkb(SHAPES[3]),
    "damaged wkb": b"GP\0\1" + bytes(4) + b"\x01\x02\0\0\0\xff\xff\xff\x7f" + bytes(32),
    "no such type": b"GP\0\1" + bytes(4) + b"\x01\x63\0\0\0\xff\xff\xff\x7f" + bytes(32),
    "curve": b"GP\0\1" + bytes(4) + b"\x01\x08\0\0\0\x03\0\0\0" + struct.pack("<6d", 0, 0, 1, 1, 2, 0),
    "empty": b"GP\0\x11" + bytes(4) + shapely.to_wkb(shapely.Polygon()),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_invalid_geometries_are_none_without_bounds(tmp_path, name):
    path = package(tmp_path / "map.gpkg")
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("UPDATE things SET geom = ? WHERE fid = 20", (BAD[name],))
    with open_database(path) as database:
        layer = read_layer(database, "things")
        assert layer is not None
        found = geometries(database, layer, np.arange(5))
    assert found[1] is None or found[1].is_empty
    assert found[0].equals(SHAPES[0]) and found[2].equals(SHAPES[2])
    assert np.isnan(layer.bounds[1]).all()
    assert 1 not in layer.query_box((-180.0, -90.0, 180.0, 90.0))


@pytest.mark.parametrize("envelope", [True, False])
def test_nan_coordinates_raise_no_warning(tmp_path, envelope):
    """A signalling NaN (its quiet bit is 0) makes the processor raise a flag that numpy would report."""
    body = b"\x01\x02\0\0\0\x02\0\0\0" + struct.pack("<Q", 0x7FF0000000000001) + struct.pack("<3d", 1, 2, 3)

    def encode(shape):
        head = sample.blob(shape, envelope=envelope)
        return head[: 8 + 32 * envelope] + body

    with open_database(package(tmp_path / "map.gpkg", encode)) as database:
        layer = read_layer(database, "things")
        assert layer is not None
        assert len(geometries(database, layer, np.arange(5))) == 5


def test_damaged_files_are_reported(tmp_path):
    with pytest.raises(DataError, match="file not found"), open_database(tmp_path / "missing.gpkg"):
        pass
    other = tmp_path / "other.gpkg"
    other.write_bytes(b"PK\3\4" * 100)
    with pytest.raises(DataError, match="is not an SQLite file"), open_database(other):
        pass
    path = package(tmp_path / "map.gpkg")
    data = bytearray(path.read_bytes())
    data[4096:] = b"\xff" * (len(data) - 4096)
    path.write_bytes(data)
    with open_database(path) as database, pytest.raises(DataError, match="SQLite cannot read it") as caught:
        database.rows("SELECT * FROM things")
    assert caught.value.file == path


def test_missing_layers_tables_and_columns(tmp_path):
    path = package(tmp_path / "map.gpkg")
    with open_database(path) as database:
        assert read_layer(database, "elsewhere") is None
        assert database.columns("things") == {"fid", "geom", "name", "size"}
        with pytest.raises(DataError, match="has no table roads"):
            database.require("roads", "fid")
        with pytest.raises(DataError, match="table things has no column colour"):
            database.require("things", "fid", "colour")
    execute(path, "UPDATE gpkg_geometry_columns SET column_name = 'x; DROP TABLE things'")
    with open_database(path) as database, pytest.raises(DataError, match="has no geometry column"):
        read_layer(database, "things")


def test_views_are_no_tables(tmp_path):
    """A view can compute forever; only tables are read."""
    path = package(tmp_path / "map.gpkg")
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS fid FROM n"
    execute(path, f"CREATE VIEW endless AS {endless}")
    with open_database(path) as database:
        assert database.columns("endless") == frozenset()
        with pytest.raises(DataError, match="interrupted"):
            database.rows("SELECT count(*) FROM endless")


@pytest.mark.parametrize(
    ("column", "words"),
    [
        (f"text TEXT DEFAULT '{'x' * 16_000}'", "rows of more than 35 MB"),
        ("text AS (hex(zeroblob(1000000)))", "has no table many"),
        ("rowid AS (hex(zeroblob(1000000)))", "has no table many"),
    ],
)
def test_rows_that_become_more_than_the_file_are_refused(tmp_path, column, words):
    """A column with a long default, which rows before it do not store, or a computed one makes 80 MB of 50 kB."""
    path = package(tmp_path / "map.gpkg")
    rows = ", ".join(f"({number})" for number in range(5000))
    execute(path, "CREATE TABLE many (fid INTEGER)", f"INSERT INTO many VALUES {rows}")
    execute(path, f"ALTER TABLE many ADD COLUMN {column}")
    tracemalloc.start()
    try:
        with open_database(path) as database, pytest.raises(DataError, match=words):
            database.require("many", "fid")
            database.rows("SELECT text FROM many")
        assert tracemalloc.get_traced_memory()[1] < 40e6
    finally:
        tracemalloc.stop()


def test_long_statements_of_the_schema_are_refused(tmp_path):
    path = package(tmp_path / "map.gpkg")
    execute(path, f"CREATE TABLE many (fid INTEGER, text TEXT DEFAULT '{'x' * 30_000}')")
    with open_database(path) as database, pytest.raises(DataError, match="too big"):
        database.columns("things")


def test_rows_of_several_queries_count_together(tmp_path, monkeypatch):
    path = package(tmp_path / "map.gpkg")
    monkeypatch.setattr(sqlite, "_MOST_RESULT", 20_000)
    with open_database(path) as database:
        query = "SELECT fid, zeroblob(10000) FROM things WHERE fid IN"
        assert len(database.rows_in(query, [10])) == len(database.rows_in(query, [20])) == 1
        with pytest.raises(DataError, match="rows of more than 20 kB"):
            database.rows_in(query, [10, *range(1000, 1500), 20])


def test_huge_cells_are_refused_before_they_are_read(tmp_path):
    path = package(tmp_path / "map.gpkg")
    with open_database(path) as database, pytest.raises(DataError, match="too big"):
        database.rows("SELECT zeroblob(1000000000)")


def test_nothing_is_written_next_to_the_file(tmp_path):
    path = package(tmp_path / "map.gpkg")
    execute(path, "PRAGMA journal_mode = WAL")
    before = path.read_bytes()
    names = sorted(file.name for file in tmp_path.iterdir())
    path.chmod(0o444)
    with open_database(path) as database:
        read_layer(database, "things")
        assert sorted(file.name for file in tmp_path.iterdir()) == names
        with pytest.raises(DataError, match="readonly"):
            database.rows("DELETE FROM things")
    assert path.read_bytes() == before


def test_file_names_may_hold_url_characters(tmp_path):
    path = package(tmp_path / "50% of #1?.gpkg")
    with open_database(path) as database:
        layer = read_layer(database, "things")
    assert layer is not None and len(layer.fid) == 5


def test_gdal_reads_the_sample(tmp_path):
    """If pyogrio is installed, GDAL reads the hand-made map and agrees on every layer."""
    pyogrio = pytest.importorskip("pyogrio")
    path = tmp_path / "map.gpkg"
    layers = sample.map_layers()
    sample.write_map(path, layers)
    for name, layer in layers.items():
        _, fids, shapes, _ = pyogrio.raw.read(path, layer=name, return_fids=True)
        assert fids.tolist() == list(layer.rows)
        expected = [shape for shape, _ in layer.rows.values()]
        assert shapely.equals(shapely.from_wkb(shapes), expected).all()
