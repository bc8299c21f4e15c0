"""Files of a stranger: bounds before memory is taken, and damage in one line."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import os
import struct
import tokenize
import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import numpy as np
import pytest

from drivax import reading
from drivax.datasets.nuscenes.map import city
from drivax.errors import DataError, UsageError
from drivax.evaluation import episode_table
from drivax.evaluation.episode_table import KEYS, _read_columns
from drivax.reading import (
    check_regular,
    explain_damage,
    parse_array,
    read_arrays,
    read_bytes,
    read_csv,
    read_json,
    read_lines,
    read_text,
)
from drivax.report.runs import _curves
from drivax.settings import parse_yaml
from drivax.tracking.run_folder import RunFolder
from drivax.tracking.sinks import JsonLines, read_rows


def header(text: str) -> bytes:
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text) + 1) + text.encode() + b"\n"


def test_a_link_to_itself_is_no_regular_file(tmp_path):
    file = tmp_path / "a"
    file.symlink_to(file)
    with pytest.raises(DataError, match=r"a: cannot be read \(Too many levels of symbolic links\); again"):
        check_regular(file, "again")


def test_arrays_are_those_of_numpy(tmp_path):
    file = tmp_path / "a.npz"
    arrays = {
        "ids": np.array(["a", "bb"]), "none": np.zeros((0, 3)), "scalar": np.array(2.5),
        "fortran": np.asfortranarray(np.arange(6).reshape(2, 3)), "flags": np.array([True, False]),
    }  # fmt: skip
    np.savez_compressed(file, **arrays)
    result = read_arrays(file, "again", 10_000)
    assert list(result) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(result[name], array)
        assert result[name].dtype == array.dtype


def test_names_that_become_equal_are_refused(tmp_path):
    file = tmp_path / "a.npz"
    with zipfile.ZipFile(file, "w") as archive:
        for name in ("a", "a.npy"):
            archive.writestr(name, header("{'descr': '<f8', 'fortran_order': False, 'shape': (0,)}"))
    with pytest.raises(DataError, match="a name occurs twice"):
        read_arrays(file, "write it again", 1 << 20)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (header("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}"), "Python objects"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}"), "length differs"),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -8)}") + bytes(64), "length differs"),
        (header("(" * 60_000), "damaged"),
        (header("-" * 60_000 + "1"), "nested too deeply"),
        (header("{'descr': '<f8', 'shape': (1L, \"\"\""), "damaged"),
        (b"\x93NUMPY\x09\0", "version"),
        (b"", "damaged"),
    ],
)
def test_hostile_array_is_refused_in_one_line(tmp_path, content, words):
    file = tmp_path / "a.npz"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a.npy", content)
    with pytest.raises(DataError, match=words) as caught:
        read_arrays(file, "write it again", 1 << 20)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(str(file))
    assert caught.value.cure == "write it again"


def test_archive_that_unpacks_to_more_than_expected_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    file = tmp_path / "a.npz"
    np.savez_compressed(file, a=np.zeros(1 << 20))
    monkeypatch.setattr(zipfile.ZipFile, "open", lambda *_: pytest.fail("unpacked"))
    with pytest.raises(DataError, match=r"unpacks to 8\.4 MB, more than the 1\.0 MB expected"):
        read_arrays(file, "again", 1_000_000)


@pytest.mark.parametrize("size", [0, 100])
def test_archive_with_lying_size_takes_no_more_memory_than_the_size(tmp_path, size):
    file = tmp_path / "a.npz"
    np.savez_compressed(file, a=np.zeros(8 << 20))
    content = bytearray(file.read_bytes())
    entry = content.index(b"PK\1\2")
    content[entry + 24 : entry + 28] = struct.pack("<I", size)
    file.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match="Bad CRC-32"):
            read_arrays(file, "again", 1 << 20)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "error",
    [
        zlib.error("x"), tokenize.TokenError("x", (1, 2)), NotImplementedError("x"), RuntimeError("encrypted"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "x"), RecursionError("x"), SystemError("x"), EOFError(),
        zipfile.BadZipFile("x"), KeyError("x"), OverflowError("x"), OSError("x"), struct.error("x"),
    ],
)  # fmt: skip
def test_each_kind_of_damage_becomes_one_line(tmp_path, error):
    with pytest.raises(DataError) as caught, explain_damage(tmp_path / "a", "copy it again"):
        raise error
    line = str(caught.value)
    assert line.startswith(f"{tmp_path / 'a'}: ") and line.endswith("); copy it again") and "()" not in line


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (OSError(errno.ESTALE, "x"), DataError, "mount the disk again"),
        (PermissionError(errno.EACCES, "x"), DataError, "change the permissions"),
        (OSError(errno.EMFILE, "x"), UsageError, "ulimit -n"),
        (MemoryError(), UsageError, "raise the limit"),
    ],
)
def test_disks_and_limits_have_cures_of_their_own(tmp_path, error, kind, words):
    with pytest.raises(kind, match=words) as caught, explain_damage(tmp_path / "a", "copy it again"):
        raise error
    assert caught.value.file == tmp_path / "a" and "copy it again" not in str(caught.value)


def test_sizes_and_kinds_of_files_are_bounded(tmp_path):
    file = tmp_path / "a"
    file.touch()
    os.truncate(file, 20 << 30)  # sparse
    with pytest.raises(DataError, match="has 21 GB, more than the 67 MB that are read"):
        read_json(file, "again")
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(DataError, match="not a regular file"):
            read_bytes(path, "again")
    (tmp_path / "b").write_bytes(b"\xff")
    with pytest.raises(DataError, match="is not text"):
        read_text(tmp_path / "b", "again")
    (tmp_path / "c").write_text("[" * 100_000)
    with pytest.raises(DataError, match=r"c: is not valid JSON \(nested too deeply\); again"):
        read_json(tmp_path / "c", "again")


@pytest.mark.parametrize("read", [lambda file: _read_columns(file, 9), city])
def test_tables_and_maps_that_would_take_2_gb_are_refused(tmp_path, read):
    """Values take up to 27 times as much memory as their text."""
    file = tmp_path / "large"
    file.touch()
    os.truncate(file, 75 << 20)  # sparse
    with pytest.raises(DataError, match="has 79 MB, more than the 67 MB that are read"):
        read(file)


def test_large_evaluations_have_large_tables(tmp_path):
    file = tmp_path / "episodes.csv"
    file.touch()
    for size, scenarios, most in ((130 << 20, 100_000, "102 MB"), (2 << 30, 10**9, "537 MB")):
        os.truncate(file, size)  # sparse
        with pytest.raises(DataError, match=f"more than the {most} that are read"):
            _read_columns(file, scenarios)


def test_threads_parse_headers_in_turn(monkeypatch):
    """Python's ``ast`` raises SystemError in several threads at a time (3.11)."""
    stream = io.BytesIO()
    np.save(stream, np.arange(3))
    inside = []

    def magic(file):
        inside.append(reading._HEADER_LOCK.locked())
        return original(file)

    original = np.lib.format.read_magic
    monkeypatch.setattr(np.lib.format, "read_magic", magic)
    with ThreadPoolExecutor(4) as pool:
        arrays = list(pool.map(parse_array, [stream.getvalue()] * 20))
    assert inside == [True] * 20 and all(array.tolist() == [0, 1, 2] for array in arrays)


@contextlib.contextmanager
def memory_below(most: int) -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a" * (4 << 20), "a row of more than 1,048,576 characters"),
        ("ab," * (2 << 20), "a row of more than 1,048,576 characters"),
        pytest.param('"a\n",' * (1 << 20), "a row of more than 1,048,576 characters", marks=pytest.mark.slow),
        ("a" * 200_000, "field larger than field limit"),
        pytest.param("a\n" * 200_000, None, marks=pytest.mark.slow),
    ],
)
def test_table_takes_the_memory_of_one_row(tmp_path, text, words):
    """As lists of texts these have 12 to 100 MB."""
    file = tmp_path / "a.csv"
    file.write_text(text)
    refused = nullcontext() if words is None else pytest.raises(DataError, match=words)
    with memory_below(12 << 20), refused:
        assert sum(1 for _ in read_csv(file, "again")) == 200_000


def test_log_takes_the_memory_of_one_line(tmp_path):
    file = tmp_path / "metrics.jsonl"
    file.write_text('{"step":0}\n' * 30_000 + '{"st')
    with memory_below(1 << 20):
        assert sum(1 for _ in read_rows(file)) == 30_000
    with memory_below(1 << 20):
        JsonLines(file, resume_step=0).close()
    assert file.read_bytes() == b'{"step": 0}\n' * 30_000
    file.write_text("a" * (2 << 20))
    with memory_below(8 << 20), pytest.raises(DataError, match="more than 1,048,576 characters"):
        list(read_lines(file, "again"))


def test_long_log_is_read_by_row(tmp_path):
    run = RunFolder(tmp_path, {})
    run.metrics.write_text('{"step":0}\n')
    os.truncate(run.metrics, 75 << 20)  # sparse
    assert next(run.metric_rows()) == {"step": 0}
    with pytest.raises(
        DataError, match=r"has 79 MB, more than the 67 MB that are read; use RunFolder.metric_rows"
    ):
        run.read_metrics()
    os.truncate(run.metrics, 1 << 30)
    with pytest.raises(DataError, match=r"has 1\.1 GB, more than the 537 MB that are read; train again"):
        next(run.metric_rows())


def test_log_of_too_many_quantities_is_refused(tmp_path):
    """Names take more memory than their values."""
    run = RunFolder(tmp_path, {})
    run.metrics.write_text(json.dumps({"step": 7, **{f"x{number}": 0 for number in range(10_001)}}))
    with pytest.raises(DataError, match=r"metrics\.jsonl: record 7: has more than 10,000 quantities"):
        _curves(run)


@pytest.mark.parametrize("value", ["[0],", '{"a":0},', "0,"])
def test_json_of_too_many_values_is_refused_before_it_is_parsed(tmp_path, value):
    """Lists of one value take 30 times the memory of their text."""
    file = tmp_path / "a.json"
    file.write_text(f"[{value * (5 << 20)}0]")
    with (
        memory_below(file.stat().st_size + (1 << 20)),
        pytest.raises(
            DataError, match=r"is not valid JSON \([\d,]+ values, more than the 4,194,304"
        ) as caught,
    ):
        read_json(file, "again")
    assert caught.value.file == file and caught.value.cure == "again"


def test_table_of_episodes_is_read_in_the_memory_of_its_numbers(tmp_path):
    file = tmp_path / "episodes.csv"
    header, row = ",".join((*KEYS, *"abcdefgh")), "p,d,scenario-{},s,0,log,1,,0.5,1,1,1,1,1"
    file.write_text("\n".join([header, *(row.format(number) for number in range(10_000))]))
    with memory_below(4 << 20):  # as rows of text: 12 MB
        keys, metrics = _read_columns(file, 10_000)
    assert keys["scenario_id"][9_999] == "scenario-9999" and len(keys["planner"]) == 10_000
    assert metrics["c"].tolist() == [0.5] * 10_000 and np.isnan(metrics["b"]).all()


def test_table_of_too_many_cells_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(episode_table, "_MOST_CELLS", 1000)
    file = tmp_path / "episodes.csv"
    file.write_text(
        "\n".join([",".join((*KEYS, "a")), *(f"p,d,{number},s,0,log,1" for number in range(100))])
    )
    with pytest.raises(DataError, match="record 33: the table has too many cells"):
        _read_columns(file, 100)
    file.write_text("\n".join([",".join(KEYS), *[",,,,,"] * 100]))
    with pytest.raises(DataError, match="record 83: the table has too many cells"):
        _read_columns(file, 100)


LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{','.join([f'*{before}'] * 9)}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (LAUGHS, "line 5: more than 50,000 values"),
        ("a: &a [*a]", "line 1: a value that contains itself"),
        (f"a: &a {'x' * 900_000}\nb: [{','.join(['*a'] * 40_000)}]", "line 2: more than 50,000 values"),
        ("[" * 10_000, "more than 64 levels"),
        ("a: " + "9" * 5000, "digits"),
        ("a: !!timestamp x", "invalid"),
        ("a: !!bool x", "invalid"),
        ("a: '" + "x" * (1 << 20) + "'", "more than 1,048,576 characters"),
    ],
)
def test_yaml_is_bounded(text, words):
    with pytest.raises(UsageError, match=words) as caught:
        parse_yaml(text)
    assert len(str(caught.value)) < 1200


def test_yaml_aliases_are_values():
    assert parse_yaml("a: &x [1, 2]\nb: [*x, *x]") == {"a": [1, 2], "b": [[1, 2], [1, 2]]}


def test_records_and_cures_of_messages_are_cut():
    error = DataError("damaged", file="a", record="r" * 10**6, cure="c" * 10**6)
    assert len(str(error)) < 2000 and len(error.args[0]) < 1000


def test_messages_keep_the_ends_of_long_values():
    line = str(DataError(f"{'x' * 10**6} is not a number", file="a", cure="again"))
    assert len(line) < 1000 and line.startswith("a: xxx") and line.endswith("xxx is not a number; again")
