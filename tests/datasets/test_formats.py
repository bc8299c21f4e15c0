"""Formats are detected by content; unknown content is reported."""

from __future__ import annotations

import errno
import gzip
import importlib
import os
from collections import Counter
from pathlib import Path

import pytest

from datasets import samples
from drivax.datasets.conversion import convert
from drivax.datasets.formats import READERS, detect, find_reader, survey
from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.errors import DataError, UsageError


def test_content_decides_the_format_not_the_name(wire, write_records):
    assert detect(write_records("example.tfrecord", wire.scenario())).name == "womd-scenario"
    assert detect(write_records("scenario.bin", wire.example())).name == "womd-example"


SAMPLES = sorted(path.stem for path in Path(samples.__file__).parent.glob("[a-z]*.py"))


def test_every_reader_has_a_sample():
    assert {reader.name.replace("-", "_") for reader in READERS} == set(SAMPLES)


@pytest.fixture(scope="module")
def sampled(tmp_path_factory):
    """Where the sample of every format lies: its own folder, and the file that is read."""
    folder = tmp_path_factory.mktemp("samples")
    paths = {}
    for name in SAMPLES:
        (folder / name).mkdir()
        paths[name] = importlib.import_module(f"datasets.samples.{name}").write(folder / name)
    return folder, paths


def test_each_reader_recognises_only_its_own(sampled, write_records, tmp_path):
    """Not the other formats' files, their companions, or what is no recording at all."""
    (tmp_path / "text").write_text("no recording")
    (tmp_path / "empty").touch()
    others = [
        write_records("o", b"\x0a\x03abc"),
        tmp_path / "text",
        tmp_path / "empty",
        tmp_path / "missing",
        tmp_path,
    ]
    files = [path for path in sorted(sampled[0].rglob("*")) if path.is_file()] + others
    for reader in READERS:
        assert [path for path in files if reader.recognise(path)] == [
            sampled[1][reader.name.replace("-", "_")]
        ]


def test_a_mixed_folder_is_sorted_by_content(sampled):
    """Companions (maps, poses, tables) are neither recordings nor ignored files."""
    found = survey(sampled[0])
    assert {one.path: one.format for one in found.inputs} == {
        path: name.replace("_", "-") for name, path in sampled[1].items()
    }
    every = sum(path.is_file() for path in sampled[0].rglob("*"))
    assert found.ignored == 0 and found.companions == every - len(READERS) > 0
    assert found.paths() == [one.path for one in found.inputs]
    assert found.paths("gpudrive") == [sampled[1]["gpudrive"]] and found.paths(None) == []


def test_names_are_relative_to_what_was_given(sampled, tmp_path):
    found = survey(sampled[0])
    assert "gpudrive/tfrecord-00000-of-01000_1.json" in {
        found.relative_path(one.path) for one in found.inputs
    }
    assert found.relative_path(tmp_path / "elsewhere" / "map.json") == "map.json"
    one = survey(sampled[1]["gpudrive"])
    assert one.relative_path(sampled[1]["gpudrive"]) == "tfrecord-00000-of-01000_1.json"


def test_sensor_data_is_not_opened(tmp_path, wire, write_records, monkeypatch):
    """Camera images and sweeps lie next to nuScenes' tables by the hundred thousand."""
    good = write_records("a.tfrecord", wire.scenario())
    for name in ("image.JPG", "sweep.pcd.bin", "blob.png"):
        (tmp_path / name).write_bytes(b"content")
    asked = []
    monkeypatch.setattr(
        "drivax.datasets.formats.recognise", lambda path: asked.append(path) or WomdScenario()
    )
    found = survey(tmp_path)
    assert asked == [good] and found.ignored == 3


def test_missing_extra_is_reported_only_for_files_that_need_it(sampled, tmp_path, monkeypatch):
    def fail():
        raise UsageError("reading TFRecord files needs google-crc32c", cure="pip install 'drivax[womd]'")

    monkeypatch.setattr("drivax.datasets.womd.tfrecord._crc32c", fail)
    others = survey(sampled[0]).formats - Counter({"womd-scenario": 9})
    assert set(others) == {name.replace("_", "-") for name in SAMPLES if not name.startswith("womd")} - {
        "scenariomax"
    }
    convert(sampled[1]["gpudrive"], tmp_path / "set")
    with pytest.raises(UsageError, match=r"drivax\[womd\]"):
        convert(sampled[1]["womd_example"], tmp_path / "other")
    noise = tmp_path / "noise"
    noise.write_bytes(bytes(range(1, 99)))
    assert detect_error(noise).cure == "pip install 'drivax[womd]'"


def detect_error(path):
    with pytest.raises(DataError) as caught:
        detect(path)
    return caught.value


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
        (gzip.compress(b"some shard" * 50, mtime=0), "gzip-compressed"),
        (b"PK\x03\x04" + bytes(60), "zip archive"),
        (bytes(range(1, 99)), "not a TFRecord file"),
        (None, "No such file"),
    ],
)
def test_errors_for_unrecognised_files_say_why(content, problem, tmp_path):
    path = tmp_path / "shard.tfrecord"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=problem) as caught:
        detect(path)
    assert caught.value.file == path and caught.value.cure


def test_a_file_without_permission_has_its_own_cure(tmp_path, monkeypatch):
    def fail(*arguments, **settings):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    (tmp_path / "shard.tfrecord").write_bytes(b"x")
    monkeypatch.setattr(Path, "open", fail)
    assert "change the permissions" in detect_error(tmp_path / "shard.tfrecord").cure


def test_errors_for_other_tfrecords_say_what_drivax_reads(wire, write_records):
    images = wire.blob(1, wire.entry("image/encoded", wire.blob(1, wire.blob(1, b"jpeg"))))
    with pytest.raises(DataError, match=r"without the features of motion data.*motion data set"):
        detect(write_records("images.tfrecord", images))


def test_unknown_format_suggests_a_known_one():
    with pytest.raises(UsageError, match="did you mean 'womd-scenario'"):
        find_reader("womd_scenario")
    with pytest.raises(UsageError, match=r"use one of auto, av2-motion, .*womd-scenario"):
        find_reader("parquet")


def test_folder_is_searched_to_any_depth_in_order(wire, write_records, tmp_path):
    second = write_records("b/deep/training.tfrecord-00001-of-00002", wire.scenario())
    first = write_records("a/renamed.bin", wire.example())
    damaged = write_records("c/damaged.tfrecord")
    write_records("b/.hidden.tfrecord", wire.scenario())
    (tmp_path / "b" / "README.md").write_text("read me")
    found = survey(tmp_path)
    assert (found.paths(), found.ignored) == ([first, second, damaged], 1)
    assert found.paths(None) == [damaged]
    # By name the damaged one may belong to either format; by content the renamed one is an example.
    found = survey(tmp_path, "womd-example")
    assert (found.paths(), found.ignored) == ([first, second, damaged], 1)
    assert survey(second).paths() == [second]


def test_folder_without_recordings(tmp_path):
    (tmp_path / "a.csv").write_bytes(b"1,2")
    with pytest.raises(DataError, match="none of the 1 files") as caught:
        survey(tmp_path)
    assert caught.value.file == tmp_path and caught.value.cure
    with pytest.raises(DataError, match="none of the 1 files in it is of the format nuplan"):
        survey(tmp_path, "nuplan")
    with pytest.raises(DataError, match="does not exist"):
        survey(tmp_path / "none")
