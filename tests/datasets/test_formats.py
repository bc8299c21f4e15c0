"""Formats are told by content, and what cannot be told is named."""

from __future__ import annotations

import gzip

import pytest

from drivax.datasets.formats import READERS, detect, find_files, reader_named
from drivax.errors import DataError, UsageError


def test_content_decides_not_the_name(wire, write_records):
    assert detect(write_records("example.tfrecord", wire.scenario())).name == "womd-scenario"
    assert detect(write_records("scenario.bin", wire.example())).name == "womd-example"


def test_each_reader_recognises_only_its_own(wire, write_records, tmp_path):
    (tmp_path / "text").write_text("no recording")
    (tmp_path / "empty").touch()
    files = {
        "womd-scenario": write_records("s", wire.scenario()),
        "womd-example": write_records("e", wire.example()),
        "": write_records("o", b"\x0a\x03abc"),
        "text": tmp_path / "text",
        "empty": tmp_path / "empty",
        "missing": tmp_path / "missing",
    }
    for reader in READERS:
        assert [name for name, path in files.items() if reader.recognise(path)] == [reader.name]


def test_first_record_may_be_damaged(wire, tmp_path):
    first = bytearray(wire.frame(wire.scenario()))
    first[400] ^= 1
    path = tmp_path / "shard"
    path.write_bytes(bytes(first) + wire.frame(wire.scenario()))
    assert detect(path).name == "womd-scenario"


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "empty"),
        (gzip.compress(b"some shard" * 50), "gzip-compressed"),
        (b"PK\x03\x04" + bytes(60), "not a TFRecord file"),
        (None, "No such file"),
    ],
)
def test_unrecognised_files_say_why(content, problem, tmp_path):
    path = tmp_path / "shard.tfrecord"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=problem) as caught:
        detect(path)
    assert caught.value.file == path and caught.value.cure


def test_other_tfrecords_say_what_drivax_reads(wire, write_records):
    images = wire.blob(1, wire.entry("image/encoded", wire.blob(1, wire.blob(1, b"jpeg"))))
    with pytest.raises(DataError, match=r"does not know.*womd-scenario, womd-example"):
        detect(write_records("images.tfrecord", images))


def test_unknown_format_suggests():
    with pytest.raises(UsageError, match="did you mean 'womd-scenario'"):
        reader_named("womd_scenario")
    with pytest.raises(UsageError, match="use one of auto, womd-scenario"):
        reader_named("parquet")


def test_folder_is_searched_to_any_depth_in_order(wire, write_records, tmp_path):
    second = write_records("b/deep/training.tfrecord-00001-of-00002", wire.scenario())
    first = write_records("a/renamed.bin", wire.example())
    damaged = write_records("c/damaged.tfrecord")
    write_records("b/.hidden.tfrecord", wire.scenario())
    (tmp_path / "b" / "README.md").write_text("read me")
    assert find_files(tmp_path) == ([first, second, damaged], 1)
    # By name the damaged one may belong to either format; by content the renamed one is an example.
    assert find_files(tmp_path, "womd-example") == ([first, second, damaged], 1)
    assert find_files(second) == ([second], 0)


def test_folder_without_recordings(tmp_path):
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    with pytest.raises(DataError, match="none of the 1 files") as caught:
        find_files(tmp_path)
    assert caught.value.file == tmp_path and caught.value.cure
    with pytest.raises(DataError, match="does not exist"):
        find_files(tmp_path / "none")
