"""Tables of Argoverse 2: columns as arrays, and the memory that crafted files of a few kilobytes may take."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from drivax.datasets.argoverse import tables
from drivax.datasets.argoverse.tables import Kind, read_table
from drivax.errors import DataError

COLUMNS: dict[str, Kind] = {"name": "text", "x": "number"}
FORMATS = {
    "snappy.parquet": {"compression": "snappy"},
    "zstd.parquet": {"compression": "zstd", "data_page_version": "2.0"},
    "plain.parquet": {"compression": "none", "use_dictionary": False, "row_group_size": 3},
    "plain.feather": {},
    "lz4.feather": {"compression": "lz4"},
    "zstd.feather": {"compression": "zstd"},
}


def write(path, table, **options):
    if path.suffix == ".parquet":
        pq.write_table(table, path, **options)
        return path
    options = pa.ipc.IpcWriteOptions(**options)
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_file(file, table.schema, options=options) as writer:
        writer.write_table(table, max_chunksize=3 if table.num_rows < 100 else None)
    return path


#: Arrays in cycles may outlive the test, and need the pool of their memory.
POOLS: list[pa.MemoryPool] = []


@contextlib.contextmanager
def memory_below(most: float) -> Iterator[None]:
    """Check the peak of Arrow's memory."""
    before = pa.default_memory_pool()
    pool = pa.proxy_memory_pool(before)
    POOLS.append(pool)
    pa.set_memory_pool(pool)
    try:
        yield
        assert pool.max_memory() < most
    finally:
        pa.set_memory_pool(before)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("is_dictionary", [False, True])
def test_columns_of_each_form(tmp_path, form, is_dictionary):
    names = ["b", "a", "", "b", None, "c", "a", "b"]
    column = pa.array(names).dictionary_encode() if is_dictionary else pa.array(names)
    table = pa.table({"x": np.arange(8.0), "name": column, "other": np.arange(8)})
    result = read_table(write(tmp_path / form, table, **FORMATS[form]), COLUMNS)
    assert result.rows == 8 and result.unread == {"other"}
    assert result.texts["name"].words == ("b", "a", "", "c")
    assert result.texts["name"].of_row.tolist() == [0, 1, 2, 0, 2, 3, 1, 0]
    assert result.numbers["x"].tolist() == list(range(8))


@pytest.mark.parametrize("form", FORMATS)
def test_optional_columns_may_be_missing(tmp_path, form):
    path = write(tmp_path / form, pa.table({"x": np.arange(8.0)}), **FORMATS[form])
    result = read_table(path, COLUMNS, optional=("name",))
    assert result.rows == 8 and not result.texts
    with pytest.raises(DataError, match="has no column name"):
        read_table(path, COLUMNS)


def test_words_of_several_dictionaries_and_repeated_words(tmp_path):
    parts = [(["x", "b", "x"], [2, 1, 0]), (["b", "y"], [1, 0, 1])]
    column = pa.chunked_array([
        pa.DictionaryArray.from_arrays(pa.array(codes, pa.int8()), words) for words, codes in parts
    ])  # fmt: skip
    table = pa.table({"name": column, "x": np.zeros(6)})
    for form in ("plain.parquet", "zstd.feather"):
        options = FORMATS[form] | ({} if "parquet" in form else {"emit_dictionary_deltas": False})
        path = write(tmp_path / form, table.unify_dictionaries() if "feather" in form else table, **options)
        words = read_table(path, COLUMNS).texts["name"]
        assert [words.text(row) for row in range(6)] == ["x", "b", "x", "y", "b", "y"]
        assert words.words == ("x", "b", "y")


@pytest.mark.parametrize("form", ["zstd.parquet", "zstd.feather"])
def test_long_word_of_all_rows_is_in_memory_once(tmp_path, form):
    """As texts of their own the rows have 1 GB."""
    codes = pa.array(np.zeros(1000, np.int32))
    table = pa.table({"name": pa.DictionaryArray.from_arrays(codes, ["x" * 1_000_000]), "x": np.zeros(1000)})
    path = write(tmp_path / form, table, compression="zstd")
    with memory_below(20e6):
        words = read_table(path, COLUMNS).texts["name"]
    assert len(words.words) == 1 and not words.of_row.any()


def small_file_of_150_mb(path, **options):
    return write(path, pa.table({"name": ["x" * 1000] * 150_000, "x": np.zeros(150_000)}), **options)


@pytest.mark.parametrize(
    ("form", "options", "words"),
    [
        ("a.parquet", {"compression": "zstd", "use_dictionary": False}, "unpacks to more than 134 MB"),
        ("a.feather", {"compression": "zstd"}, "unpacks to more than 134 MB"),
        (
            "a.parquet",
            {"compression": "none", "use_dictionary": ["x"], "column_encoding": {"name": "DELTA_BYTE_ARRAY"}},
            "a page of encoding 7",
        ),
    ],
)
def test_small_files_that_become_large_are_refused(tmp_path, form, options, words):
    path = small_file_of_150_mb(tmp_path / form, **options)
    assert path.stat().st_size < 2e6
    with memory_below(5e6), pytest.raises(DataError, match=words) as caught:
        read_table(path, COLUMNS)
    assert caught.value.file == path and "\n" not in str(caught.value)


@pytest.mark.parametrize("end", [b"\x40\x78\x2e", b"\xff\xff\xff\x7e", b"\xff\xff\xff\xff\x00\x00\x40", b""])
def test_ends_of_a_stream_are_not_lengths(tmp_path, end):
    """Arrow would take the first four bytes as the length of a message, here up to 2 GB, and allocate it."""
    path = tmp_path / "a.feather"
    path.write_bytes(b"\x80\x04\x8e" + bytes(7) + end)
    with (
        memory_below(5e6),
        pytest.raises(DataError, match=r"is not a valid table \(a message of invalid length"),
    ):
        read_table(path, COLUMNS)


def test_columns_are_checked_by_their_place(tmp_path):
    path = small_file_of_150_mb(tmp_path / "a.parquet", compression="zstd", use_dictionary=False)
    head, found, rest = path.read_bytes().rpartition(b"\x04name")
    path.write_bytes(head + found.replace(b"a", b"o") + rest)
    assert pq.read_metadata(path).row_group(0).column(0).path_in_schema == "nome"
    with memory_below(5e6), pytest.raises(DataError, match="unpacks to more than 134 MB"):
        read_table(path, COLUMNS)


def test_damaged_footers_do_not_end_the_process(tmp_path):
    path = write(tmp_path / "a.parquet", pa.table({"x": np.arange(3.0), "name": list("abc")}))
    program = """
import struct, sys
from pathlib import Path
from drivax.datasets.argoverse.tables import read_table
from drivax.errors import DataError
path = Path(sys.argv[1])
data = path.read_bytes()
refused = 0
for place in range(len(data) - 8 - struct.unpack("<I", data[-8:-4])[0], len(data)):
    for flip in (1, 4):
        path.write_bytes(data[:place] + bytes([data[place] ^ flip]) + data[place + 1 :])
        try:
            read_table(path, {"name": "text", "x": "number"})
        except DataError:
            refused += 1
print(refused)
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 100


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(
    ("limit", "words"), [("MOST_ROWS", "more than 7 rows"), ("MOST_BYTES", "more than 7 bytes")]
)
def test_rows_and_bytes_are_counted_before_they_are_read(tmp_path, monkeypatch, form, limit, words):
    table = pa.table({"x": np.arange(8.0), "name": list("abcdefgh")})
    path = write(tmp_path / form, table, **FORMATS[form])
    monkeypatch.setattr(tables, limit, 7)
    monkeypatch.setattr(pq.ParquetFile, "read", lambda *_, **__: pytest.fail("read"))
    with pytest.raises(DataError, match=words):
        read_table(path, COLUMNS)


@pytest.mark.parametrize("form", FORMATS)
def test_pages_and_messages_are_counted(tmp_path, monkeypatch, form):
    path = write(tmp_path / form, pa.table({"x": np.zeros(8), "name": list("abcdefgh")}), **FORMATS[form])
    monkeypatch.setattr(tables, "_MOST_PARTS", 1)
    with pytest.raises(DataError, match="more than 1 pages or messages"):
        read_table(path, COLUMNS)


def test_headers_of_pages_take_room(tmp_path, monkeypatch):
    path = write(tmp_path / "a.parquet", pa.table({"x": np.zeros(8), "name": list("abcdefgh")}))
    group = pq.read_metadata(path).row_group(0)
    with_headers = sum(group.column(number).total_uncompressed_size for number in range(2))
    monkeypatch.setattr(tables, "MOST_BYTES", with_headers)
    read_table(path, COLUMNS)
    monkeypatch.setattr(tables, "MOST_BYTES", with_headers - 1)
    with pytest.raises(DataError, match="unpacks to more than"):
        read_table(path, COLUMNS)


def test_messages_beyond_the_file_are_refused(tmp_path):
    """pyarrow takes memory for the length that a message claims."""
    path = write(tmp_path / "a.feather", pa.table({"x": np.zeros(8), "name": list("abcdefgh")}))
    data = path.read_bytes()
    length = max(message.body.size for message in pa.ipc.MessageReader.open_stream(data[8:]))
    claimed = length.to_bytes(8, "little")
    assert claimed in data
    path.write_bytes(data.replace(claimed, (1 << 60).to_bytes(8, "little")))
    with pytest.raises(DataError, match="a message outside the file"):
        read_table(path, COLUMNS)


def test_row_groups_that_share_pages_are_refused(tmp_path):
    path = write(tmp_path / "a.parquet", pa.table({"x": np.zeros(3), "name": list("abc")}))
    metadata = pq.read_metadata(path)
    metadata.append_row_groups(pq.read_metadata(path))
    metadata.write_metadata_file(tmp_path / "footer")
    path.write_bytes(path.read_bytes() + (tmp_path / "footer").read_bytes())
    assert pq.read_table(path).num_rows == 6
    with pytest.raises(DataError, match="columns that overlap"):
        read_table(path, COLUMNS)


@pytest.mark.parametrize(
    ("column", "kind"),
    [
        (pa.array([[1.0]] * 3), "list<"),
        (pa.array(["a"] * 3, pa.string_view()), "string_view"),
        (pa.RunEndEncodedArray.from_arrays([3], [1.0]), "run_end_encoded"),
        (pa.array(["1", "2", "3"]), "string"),
    ],
)
def test_columns_of_other_types_are_refused(tmp_path, column, kind):
    name = "name" if kind == "string_view" else "x"
    table = pa.table({"x": np.zeros(3), "name": list("abc")} | {name: column})
    with pytest.raises(DataError, match=f"column {name} contains {kind}"):
        read_table(write(tmp_path / "a.feather", table), COLUMNS)


def test_dots_in_names_are_refused(tmp_path):
    """pyarrow reads ``name.b`` with ``name``, although its pages were not checked."""
    table = pa.table({"x": np.zeros(3), "name": list("abc"), "name.b": np.zeros(3)})
    with pytest.raises(DataError, match="a dot in its name"):
        read_table(write(tmp_path / "a.parquet", table), COLUMNS)


def test_long_footers_and_messages_are_refused(tmp_path):
    table = pa.table({"x": np.zeros(3), "name": list("abc")}).replace_schema_metadata({"a": "x" * 500_000})
    for form, words in (("a.parquet", "a footer of"), ("a.feather", "a message of invalid length")):
        with pytest.raises(DataError, match=words):
            read_table(write(tmp_path / form, table), COLUMNS)
