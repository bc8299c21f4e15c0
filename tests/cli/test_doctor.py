"""``drivax doctor``: what it says about every kind of data, in a hundred columns, and how it exits."""

from __future__ import annotations

import gzip
import importlib
import json
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from datasets.samples import womd_scenario as wire
from drivax import kernels
from drivax.cli import doctor, main
from drivax.datasets.conversion import convert
from drivax.datasets.doctor import Part, _notes, diagnose, gaps
from drivax.datasets.formats import detect, survey
from drivax.datasets.reader import Description
from drivax.errors import DataError, UsageError
from drivax.tracking.run_folder import zoo

FORMATS = {
    "av2_motion": "Argoverse 2 Motion Forecasting",
    "av2_sensor": "Argoverse 2 Sensor",
    "gpudrive": "Waymo Open Motion Dataset",
    "nuplan": "nuPlan",
    "nuscenes": "nuScenes",
    "scenariomax": "ScenarioMax",
    "scenarionet": "ScenarioNet",
    "womd_example": "Waymo Open Motion Dataset",
    "womd_scenario": "Waymo Open Motion Dataset",
}


def sample(name: str, folder: Path) -> Path:
    """The folder with the sample of a format."""
    folder.mkdir(parents=True)
    importlib.import_module(f"datasets.samples.{name}").write(folder)
    return folder


def asked(path: Path, capsys) -> tuple[int, str]:
    """Return exit status and output without line breaks."""
    status = main(["doctor", str(path)])
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 100
    return status, " ".join(out.split())


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_described_and_convertible(name, tmp_path, capsys):
    status, out = asked(sample(name, tmp_path / "data"), capsys)
    assert status == 0
    for words in (
        FORMATS[name],
        f"format {name.replace('_', '-')}: 1 file",
        "next drivax convert",
        "after convert about ",
    ):
        assert words in out, out
    assert "missing" not in out and "of unknown format" not in out


def test_a_folder_of_everything(tmp_path, capsys):
    """Several formats side by side: each is described by itself, companions are no ignored files."""
    for name in FORMATS:
        sample(name, tmp_path / "data" / name)
    (tmp_path / "data" / "notes.md").write_text("mine")
    status, out = asked(tmp_path / "data", capsys)
    assert status == 0
    found = diagnose(tmp_path / "data")
    assert found.files == {name.replace("_", "-"): 1 for name in FORMATS}
    assert found.ignored == 1 and found.companions >= 12
    assert "1 of unknown format, ignored" in out
    assert {part.format for part in found.parts} == set(found.files)


# --- What is missing.


@pytest.mark.parametrize(
    ("name", "gone", "words"),
    [
        ("nuplan", "maps", "map.gpkg"),
        ("nuscenes", "maps/expansion", "maps/expansion"),
        ("av2_motion", "log_map_archive_*.json", "log_map_archive"),
        ("av2_sensor", "*/map", "map"),
        ("av2_sensor", "*/city_SE3_egovehicle.feather", "city_SE3_egovehicle.feather"),
        ("av2_sensor", "*/annotations.feather", "without annotations, like those of the test split"),
        ("nuscenes", "v1.0-*/sample.json", "tables of nuScenes, but not all that are needed"),
    ],
)
def test_missing_parts_are_named(name, gone, words, tmp_path, capsys):
    folder = sample(name, tmp_path / "data")
    for path in list(folder.glob(gone)):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    status, out = asked(folder, capsys)
    assert status == 1 and words in out and "cannot be converted" in out, out


# --- The wrong flavour.


def frame() -> bytes:
    """A perception ``Frame``: context with a name, a timestamp, a pose, an image, from the wire format."""
    context = wire.blob(1, wire.blob(1, b"10017090168044687777_6380_000_6400_000"))
    image = wire.blob(4, wire.whole(1, 1) + wire.blob(2, b"\xff\xd8\xff jpeg"))
    return context + wire.whole(2, 1_550_083_467_346_370) + wire.blob(3, b"") + image


def end_to_end() -> bytes:
    """An ``E2EDFrame``: a frame without a pose, and the past of ego."""
    states = wire.blob(1, wire.blob(1, b"0123-45") + b"")
    inner = states + wire.blob(4, wire.whole(1, 1) + wire.blob(2, b"jpeg"))
    return wire.blob(1, inner) + wire.blob(3, wire.blob(1, b"\0\0\0\0")) + wire.whole(4, 1)


def example() -> bytes:
    """A ``tf.Example`` of something else."""
    return wire.blob(1, wire.blob(1, wire.blob(1, b"image/encoded") + wire.blob(2, wire.blob(1, b""))))


WRONG = {
    "perception.tfrecord": (lambda: wire.frame(frame()), "perception data set", "motion data set"),
    "e2e.tfrecord": (lambda: wire.frame(end_to_end()), "end-to-end driving data set", "motion data set"),
    "other.tfrecord": (lambda: wire.frame(example()), "tf.Examples without the features", "motion data set"),
    "unknown.tfrecord": (lambda: wire.frame(b"\x0a\x03abc"), "records drivax does not know", "motion data set"),
    "shard.tfrecord": (lambda: gzip.compress(b"shard" * 99), "gzip-compressed", "gunzip"),
    "short.tfrecord": (lambda: wire.frame(wire.scenario())[:500], "truncated", "again"),
    "empty.tfrecord": (lambda: b"", "empty", "again"),
    "log.db": (lambda: b"SQLite format 3\0" + bytes(4096), "without nuPlan's tables", "logs of nuPlan"),
    "part-0.parquet": (lambda: b"PAR1" + bytes(99) + b"PAR1", "not named as a scenario of Argoverse 2", "motion"),
    "table.feather": (lambda: b"ARROW1\0\0" + bytes(99), "not named as annotations", "folder of the log"),
    "sd_x.pkl": (lambda: pickle.dumps({"id": 1}), "but not a ScenarioNet scenario", "sd_*.pkl"),
    "tfrecord-1_1.json": (
        lambda: json.dumps({"name": "x", "objects": [], "roads": []}).encode(),
        "without GPUDrive's positions", "GPUDrive's present converter"
    ),
    "log_map_archive_x.json": (lambda: b'{"lane_segments": {}}', "without its recording", "scenario_*.parquet"),
    "sample.json": (lambda: b'[{"token": "a", "scene_token": "b"}]', "a table of nuScenes", "metadata archive"),
    "notes.json": (lambda: b'{"mine": 1}', "JSON of an unknown data set", "as downloaded"),
    "data.zip": (lambda: b"PK\x03\x04" + bytes(99), "zip archive", "unzip"),
    "data.tar": (lambda: bytes(257) + b"ustar" + bytes(512), "tar archive", "tar xf"),
    "array.npy": (lambda: b"\x93NUMPY\x01\0" + bytes(99), "numpy array", "name its folder"),
    "noise.bin": (lambda: bytes(range(1, 256)), "not a TFRecord file", "uncompressed TFRecord"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_unsupported_flavours_name_the_alternative(name, tmp_path, capsys):
    content, problem, cure = WRONG[name]
    (tmp_path / name).write_bytes(content())
    status, out = asked(tmp_path / name, capsys)
    assert status == 1 and problem in out and cure in out.partition("fix")[2], out
    # The conversion says the same, in one line.
    assert main(["convert", str(tmp_path / name), str(tmp_path / "set"), "--workers", "1"]) == 1
    assert problem in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "set").exists()


def test_scenario_sets_are_referred_to_inspect(tmp_path, capsys):
    (tmp_path / "shard.tfrecord").write_bytes(wire.frame(wire.scenario(steps=11, map=b"")))
    convert(tmp_path / "shard.tfrecord", tmp_path / "set")
    status, out = asked(tmp_path / "set", capsys)
    assert status == 1 and "already a scenario set of drivax" in out and "drivax inspect" in out
    assert "seal.json" not in out and "changed" not in out
    manifest = tmp_path / "set" / "manifest.json"
    manifest.write_text(manifest.read_text().replace("shard.tfrecord", "other.tfrecord") + " ")
    assert "manifest.json: changed since drivax wrote it" in asked(tmp_path / "set", capsys)[1]
    (tmp_path / "set" / "seal.json").unlink()
    out = asked(tmp_path / "set", capsys)[1]
    assert "seal.json: is missing" in out and "earlier versions" not in out
    content = json.loads(manifest.read_text())
    for shard in content["shards"]:
        del shard["crc_sha256"]
    manifest.write_text(json.dumps(content))
    diagnosis = diagnose(tmp_path / "set")
    assert (
        len(diagnosis.problems) == 1
        and "no seal.json, as in folders of earlier versions" in diagnosis.notes[0]
    )
    assert "note" in asked(tmp_path / "set", capsys)[1]


@pytest.mark.parametrize("sealed", [False, True])
def test_seal_of_a_run_is_a_problem_only_if_it_was_lost(tmp_path, sealed):
    (tmp_path / "run.json").write_text(json.dumps({"sealed": sealed}))
    diagnosis = diagnose(tmp_path)
    assert [problem.file.name for problem in diagnosis.problems[1:]] == ["seal.json"] * sealed
    assert len(diagnosis.notes) == (not sealed)


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"run.json": "{}", "config.yaml": "", "episodes.csv": ""}, "drivax report"),
        ({"dataset_summary.pkl": "x", "dataset_mapping.pkl": "x"}, "without its scenarios"),
        ({"maps/a/map.gpkg": "x", "maps/nuplan-maps-v1.0.json": "{}"}, "maps of nuPlan without logs"),
        ({"readme.md": "hello"}, "none of the 1 files in it is of a known format"),
        ({}, "has no files"),
    ],
)
def test_folders_without_recordings(files, words, tmp_path, capsys):
    folder = tmp_path / "data"
    folder.mkdir()
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    status, out = asked(folder, capsys)
    assert status == 1 and words in out, out


def test_empty_paths_are_named(tmp_path, capsys):
    status, out = asked(tmp_path / "none", capsys)
    assert status == 1 and "does not exist" in out
    with pytest.raises(UsageError, match="unknown format"):
        diagnose(tmp_path, "wmod")


def test_damaged_files_in_a_folder_are_listed(tmp_path, capsys):
    for number in range(12):
        (tmp_path / f"{number:02d}.tfrecord").write_bytes(
            wire.frame(wire.scenario(steps=11)) if number else b""
        )
    (tmp_path / "12.tfrecord").write_bytes(wire.frame(frame()))
    status, out = asked(tmp_path, capsys)
    assert status == 0 and "womd-scenario: 11 files" in out
    assert "00.tfrecord: the file is empty" in out and "12.tfrecord: frames of the Waymo perception" in out


def test_many_files_are_sampled(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("drivax.datasets.doctor._SAMPLE", 4)
    for number in range(8):
        (tmp_path / f"{number}.tfrecord").write_bytes(wire.frame(wire.scenario(steps=11)))
    status, out = asked(tmp_path, capsys)
    assert status == 0 and "8 files (4 of them inspected), 4 recordings in those" in out
    assert "about 8 scenarios" in out


def test_a_file_that_lacks_nothing_is_convertible_next_to_one_without_its_map(tmp_path):
    for name in ("whole", "half"):
        sample("av2_motion", tmp_path / name)
    (map_path,) = (tmp_path / "half").rglob("log_map_archive_*.json")
    map_path.unlink()
    found = diagnose(tmp_path)
    assert found.parts[0].description.missing == (map_path.name,) and found.convertible


def test_the_test_split_of_nuscenes_is_not_convertible(tmp_path):
    folder = sample("nuscenes", tmp_path / "data")
    for path in folder.rglob("sample_annotation.json"):
        path.write_text("[]")
    found = diagnose(folder)
    assert (found.convertible, found.scenarios) == (False, 0)


def test_all_notes_on_a_single_file_are_listed():
    notes = tuple(f"note {number}" for number in range(8))
    one, other = Description("a", "b", notes=notes), Description("a", "b", notes=notes[:7])
    assert list(_notes([one])) == list(notes)
    assert list(_notes([one, other]))[6:] == [
        "2 more notes; run drivax doctor on a single file to see all of its notes"
    ]


@pytest.mark.parametrize("function", [diagnose, detect, survey])
def test_a_pipe_is_refused_unopened(function, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    try:
        (problem,) = function(tmp_path / "pipe").problems
    except DataError as error:
        problem = error
    assert "not a regular file" in problem.problem


def test_unknown_number_of_recordings_is_not_mentioned():
    part = Part("nuplan", Description("nuPlan", "log"), 4, whole=False)
    assert ("format", "nuplan: 8 files (4 of them inspected)") in doctor._part_rows(part, 8)


# --- Shards.


@pytest.mark.parametrize(
    ("numbers", "sentence"),
    [
        ([0, 1, 2, 3, 4], "all 5 shards"),
        ([0, 2], "2 of 5 shards, missing 00001, 00003 to 00004"),
        ([4], "1 of 5 shards, missing 00000 to 00003"),
    ],
)
def test_gaps_in_shard_numbers_are_named(numbers, sentence):
    paths = [Path("w") / f"training.tfrecord-{number:05d}-of-00005" for number in numbers]
    assert gaps([*paths, Path("w/other.tfrecord")]) == [f"training.tfrecord: {sentence}"]


def test_many_gaps_are_counted_only():
    paths = [Path(f"t.tfrecord-{number:05d}-of-00100") for number in range(0, 100, 2)]
    assert gaps(paths) == ["t.tfrecord: 50 of 100 shards"]


def test_families_of_one_name_are_named_with_their_folder():
    paths = [Path(split, "t.tfrecord-00000-of-00001") for split in ("train", "val")]
    assert gaps(paths) == ["train/t.tfrecord: all 1 shards", "val/t.tfrecord: all 1 shards"]


def test_families_of_one_name_in_folders_of_one_name_are_distinguished():
    paths = [Path("data", version, "train", "t.tfrecord-00000-of-00001") for version in ("v1", "v2")]
    assert gaps(paths) == [
        "v1/train/t.tfrecord: all 1 shards",
        "v2/train/t.tfrecord: all 1 shards",
    ]


def test_shards_are_grouped_by_folder(tmp_path, capsys):
    for split in ("training", "validation"):
        (tmp_path / split).mkdir()
        path = tmp_path / split / f"{split}.tfrecord-00001-of-00003"
        path.write_bytes(wire.frame(wire.scenario(steps=11)))
    status, out = asked(tmp_path, capsys)
    assert status == 0
    for split in ("training", "validation"):
        assert f"{split}.tfrecord: 1 of 3 shards, missing 00000, 00002" in out


# --- The machine.


def test_doctor_lists_packages_and_resources_in_100_columns(capsys):
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 100
    for words in ("python", "jax", "cpu", "cores", "memory", "GB free here", "womd (Waymo", *zoo()):
        assert words in out
    line = next(line for line in out.splitlines() if line.startswith("native kernels"))
    assert " ".join(line.split()[2:]) in " ".join(kernels.state().split())


def test_a_missing_extra_names_its_pip_line(monkeypatch):
    monkeypatch.setattr(doctor, "EXTRAS", {"womd": ("Waymo", ("sys", "not_there", "not_there.inside"))})
    monkeypatch.setattr(doctor, "devices", lambda: "cpu")
    rows = dict(doctor.machine())
    assert rows["womd (Waymo)"] == "not_there, inside are not installed; pip install 'drivax[womd]'"


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("import time; time.sleep(9)", "does not answer"),
        ("raise SystemExit('no driver')", "does not start: no driver"),
        ("print('a message of a plugin')", "its list of devices cannot be read"),
        ('print(\'[["gpu", "NVIDIA H100"], ["cpu", "cpu"]]\')', "gpu: NVIDIA H100, cpu"),
    ],
)
def test_devices_are_asked_in_a_process_of_their_own(program, words, monkeypatch):
    monkeypatch.setattr(doctor, "_LIST_DEVICES", program)
    assert words in doctor.devices(timeout_s=1.0)


def test_inspecting_data_needs_no_jax(tmp_path):
    sample("gpudrive", tmp_path / "data")
    program = (
        "import sys; from drivax.cli import main; status = main(['doctor', sys.argv[1]]);"
        " sys.exit(status or 'jax' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "data")], capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
