"""Conversion: order, skipping, strictness, limits, audit, workers, and that nothing partial is left."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from drivax.cli import main
from drivax.datasets.convert import Conversion, convert, convert_file
from drivax.datasets.reader import BadRecord
from drivax.errors import DataError, UsageError
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet


@pytest.fixture
def folder(wire, write_records, tmp_path):
    """Three files: two good records; good, damaged, good; a duplicate and a record of the other form."""
    write_records("src/a.tfrecord", wire.scenario("a0"), wire.scenario("a1"))
    bad = bytearray(wire.frame(wire.scenario("b1")))
    bad[100] ^= 8
    path = tmp_path / "src" / "b.tfrecord"
    path.write_bytes(wire.frame(wire.scenario("b0")) + bytes(bad) + wire.frame(wire.scenario("b2")))
    write_records("src/c.tfrecord", wire.scenario("a0"), wire.example("c1"), wire.scenario("c2", id=b""))
    return tmp_path / "src"


def digest(path):
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(path.iterdir())}


def leftovers(folder):
    return sorted(path.name for path in folder.iterdir())


def test_converts_in_order_and_reports_what_it_skipped(folder, tmp_path):
    calls = []
    result = convert(folder, tmp_path / "set", progress=lambda *call: calls.append(call))
    opened = ScenarioSet.open(tmp_path / "set")
    assert [entry["scenario_id"] for entry in opened.entries] == ["a0", "a1", "b0", "b2"]
    assert (result.scenarios, result.files, result.ignored) == (4, 3, 0)
    places = [(bad.file.name, bad.record) for bad in result.skipped]
    assert places == [("b.tfrecord", 1), ("c.tfrecord", "a0"), ("c.tfrecord", 1), ("c.tfrecord", 2)]
    causes = [bad.problem for bad in result.skipped]
    assert "checksum" in causes[0] and "already" in causes[1] and "tf.Examples" in causes[2]
    assert all(bad.cure for bad in result.skipped)
    assert calls[-1] == (3, 3, 4) and [call[0] for call in calls] == sorted(call[0] for call in calls)


def test_scenario_holds_what_the_file_says(folder, tmp_path, wire):
    convert(folder / "a.tfrecord", tmp_path / "set")
    scenario = ScenarioSet.open(tmp_path / "set")[0]
    assert isinstance(scenario, Scenario)
    source = scenario.source
    assert (source.steps, source.tracks, source.tracks_valid_now, source.lights) == (91, 3, 2, 2)
    assert source.map_features == {
        "lane": 3, "road_line": 2, "road_edge": 2, "crosswalk": 1, "speed_bump": 1, "stop_sign": 1, "driveway": 1
    }  # fmt: skip
    points = [len(wire.line(0.0, stop=40.0))] * 2 + [len(wire.line(0.0, start=40.0))]
    assert source.map_points == sum(points) + 4 * len(wire.line(0.0)) + 3 * 4 + 1
    np.testing.assert_allclose(scenario.origin, [wire.X0, wire.Y0, 30.5])
    np.testing.assert_allclose(scenario.agent_xy[:, 0, 0], np.arange(91) - 10.0)


def test_any_number_of_workers_gives_the_same_bytes(folder, tmp_path):
    one = convert(folder, tmp_path / "one")
    two = convert(folder, tmp_path / "two", Conversion(workers=2))
    assert digest(tmp_path / "one") == digest(tmp_path / "two")
    assert one.skipped == two.skipped


def test_strict_stops_and_leaves_nothing(folder, tmp_path):
    with pytest.raises(DataError, match=r"b\.tfrecord: record 1: the payload is damaged"):
        convert(folder, tmp_path / "set", Conversion(strict=True))
    assert leftovers(tmp_path) == ["src"]


@pytest.mark.parametrize(
    ("limit", "workers", "ids"), [(1, 1, ["a0"]), (3, 1, ["a0", "a1", "b0"]), (2, 2, ["a0", "a1"])]
)
def test_limit(folder, tmp_path, limit, workers, ids):
    convert(folder, tmp_path / "set", Conversion(limit=limit, workers=workers))
    assert [entry["scenario_id"] for entry in ScenarioSet.open(tmp_path / "set").entries] == ids


def test_audit_is_stored_with_its_scenario(folder, tmp_path):
    batches = []

    def audit(scenarios):
        batches.append(len(scenarios))
        return [{"name": int(scenario.id[1]), "fine": True} for scenario in scenarios]

    convert(folder, tmp_path / "set", audit=audit)
    found = [entry["audit"] for entry in ScenarioSet.open(tmp_path / "set").entries]
    assert found == [{"name": number, "fine": True} for number in (0, 1, 0, 2)]
    assert batches == [4]  # audited together, not one by one


def test_audit_that_forgets_one_is_refused(folder, tmp_path):
    with pytest.raises(ValueError, match="zip"):
        convert(folder, tmp_path / "set", audit=lambda scenarios: [])
    assert leftovers(tmp_path) == ["src"]


def test_overwrite(folder, tmp_path):
    convert(folder, tmp_path / "set", Conversion(limit=1))
    with pytest.raises(UsageError, match="--overwrite"):
        convert(folder, tmp_path / "set")
    assert len(ScenarioSet.open(tmp_path / "set")) == 1
    convert(folder, tmp_path / "set", Conversion(overwrite=True))
    assert len(ScenarioSet.open(tmp_path / "set")) == 4
    assert leftovers(tmp_path) == ["set", "src"]


def test_nothing_convertible_names_the_first_cause(wire, write_records, tmp_path):
    single = write_records("src/only.tfrecord", wire.scenario(sdc=wire.whole(6, 40)))
    with pytest.raises(
        DataError, match=r"only\.tfrecord: record 0: sdc_track_index names track 40"
    ) as caught:
        convert(single, tmp_path / "set")
    assert "others" not in str(caught.value)
    write_records("src/second.tfrecord")
    with pytest.raises(DataError, match=r"record 0: sdc_track_index .*other 1 record"):
        convert(tmp_path / "src", tmp_path / "set")
    assert leftovers(tmp_path) == ["src"]


def test_wrong_format_is_refused_with_the_right_one(folder, tmp_path):
    with pytest.raises(DataError, match="use --format womd-scenario"):
        convert(folder / "a.tfrecord", tmp_path / "set", Conversion(format="womd-example", strict=True))


@pytest.mark.parametrize(
    "options",
    [Conversion(format="wmod"), Conversion(capacity="huge"), Conversion(limit=0), Conversion(workers=0)],
)
def test_options_that_cannot_be_meant(options, folder, tmp_path):
    with pytest.raises(UsageError) as caught:
        convert(folder, tmp_path / "set", options)
    assert caught.value.cure


def test_recording_that_cannot_be_assembled_is_a_bad_record(wire, write_records):
    gone = [wire.state(0, 0, 9.0, 0, 0, 0, 0, 0, 0, valid=False)] * 91
    tracks = b"".join(wire.blob(2, track) for track in (*wire.tracks()[:2], wire.track(1, 1, gone)))
    path = write_records("x.tfrecord", wire.scenario("without ego", tracks=tracks), wire.scenario("fine"))
    bad, good = convert_file(path, Conversion())
    assert isinstance(bad, BadRecord) and bad.file == path and bad.record == "without ego" and bad.cure
    assert isinstance(good, Scenario)


def test_unexpected_failure_is_a_bad_record_too(wire, write_records, monkeypatch):
    def fail(*_):
        raise IndexError("off by one")

    monkeypatch.setattr("drivax.datasets.convert.assemble", fail)
    (bad,) = convert_file(write_records("x.tfrecord", wire.scenario("odd")), Conversion())
    assert isinstance(bad, BadRecord)
    assert (bad.record, bad.problem) == ("odd", "assembling failed (IndexError: off by one)")


def test_long_recordings_become_windows_of_one_segment(wire, write_records, tmp_path):
    path = write_records("long.tfrecord", wire.scenario("long", steps=180, now=wire.whole(10, 0)))
    convert(path, tmp_path / "set")
    entries = ScenarioSet.open(tmp_path / "set").entries
    assert len(entries) == 3 and {entry["segment"] for entry in entries} == {"long"}  # (180 - 91) // 40 + 1
    assert len({entry["scenario_id"] for entry in entries}) == 3


def test_test_split_is_kept_and_flagged(wire, write_records, tmp_path):
    convert(write_records("test.tfrecord", wire.scenario("test", steps=11)), tmp_path / "set")
    (entry,) = ScenarioSet.open(tmp_path / "set").entries
    assert "NO_FUTURE" in entry["flags"] and entry["source"]["steps"] == 11


def test_reading_and_assembling_never_import_jax(wire, write_records):
    path = write_records("x.tfrecord", wire.scenario(), wire.example())
    program = f"""
import sys, pathlib
import drivax.datasets.convert, drivax.scenario.assemble, drivax.scenario.store
assert "google.protobuf" not in sys.modules and "google_crc32c" not in sys.modules
from drivax.datasets.convert import Conversion, convert_file
kinds = [type(item).__name__ for item in convert_file(pathlib.Path({str(path)!r}), Conversion())]
assert kinds == ["Scenario", "BadRecord"], kinds
assert "jax" not in sys.modules
"""
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True, timeout=60)


def test_interrupt_leaves_nothing(wire, write_records, tmp_path):
    """Ctrl-C on a terminal reaches the whole process group, workers included."""
    shard = write_records("src/0.tfrecord", wire.scenario()).read_bytes() * 300
    (tmp_path / "src" / "0.tfrecord").write_bytes(shard)
    for name in "123":
        os.link(tmp_path / "src" / "0.tfrecord", tmp_path / "src" / f"{name}.tfrecord")
    command = [
        sys.executable,
        "-m",
        "drivax",
        "convert",
        str(tmp_path / "src"),
        str(tmp_path / "set"),
        "--workers",
        "2",
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    deadline = time.monotonic() + 30
    while not list(tmp_path.glob(".set.*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(1.5)  # workers are up, or starting
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    # A worker caught while Python starts may complain before us.
    assert (process.returncode, errors.splitlines()[-1]) == (130, "drivax: interrupted")
    assert leftovers(tmp_path) == ["src"]


# --- The commands.


def test_command_says_what_it_wrote_and_what_it_skipped(folder, tmp_path, capsys):
    (folder / "notes.txt").write_text("not a recording")
    assert main(["convert", str(folder), str(tmp_path / "set"), "--workers", "1"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"{tmp_path / 'set'}: 4 scenarios from 3 files in ")
    assert out.endswith("4 records skipped, 1 file of other formats ignored\n")
    lines = err.splitlines()
    progress, *lines = lines
    assert progress.startswith("converting: 3 files")
    assert len(lines) == 4 and all(line.startswith("skipped ") for line in lines)
    assert f"{folder / 'b.tfrecord'}: record 1: the payload is damaged" in lines[0]


def test_command_strict_fails_in_one_line(folder, tmp_path, capsys):
    assert main(["convert", str(folder), str(tmp_path / "set"), "--strict", "--workers", "1"]) == 1
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1 and "record 1" in err
    assert leftovers(tmp_path) == ["src"]


@pytest.mark.parametrize("flags", [["--limit", "0"], ["--format", "wmod"], ["--workers", "many"]])
def test_command_usage_errors(folder, tmp_path, flags, capsys):
    assert main(["convert", str(folder), str(tmp_path / "set"), *flags]) == 2
    assert capsys.readouterr().err


def test_inspect_json_is_the_contract(folder, tmp_path, capsys):
    convert(folder, tmp_path / "set")
    assert main(["inspect", str(tmp_path / "set"), "--json"]) == 0
    scenarios = json.loads(capsys.readouterr().out)["scenarios"]
    assert len(scenarios) == 4
    assert set(scenarios[0]) == {
        "scenario_id", "dataset", "segment", "steps", "tracks", "tracks_valid_now", "map_features", "map_points",
        "lights", "segments", "overflow", "flags", "audit",
    }  # fmt: skip
    assert scenarios[1]["scenario_id"] == "a1" and scenarios[1]["tracks_valid_now"] == 2


def test_inspect_tables_fit_a_hundred_columns(folder, tmp_path, capsys):
    convert(folder, tmp_path / "set", audit=lambda batch: [{"collision": 1, "gone": None} for _ in batch])
    assert main(["inspect", str(tmp_path / "set")]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 100
    for words in (
        "4 (recorded segments: 4",
        "collision 4 in 4",
        "every checksum is right",
        "LANE_GRAPH",
        "b2",
    ):
        assert words in out
    assert "gone" not in out


def test_inspect_notices_damage_unless_told_not_to_look(folder, tmp_path, capsys):
    convert(folder, tmp_path / "set")
    shard = tmp_path / "set" / "shard-00000.npy"
    data = bytearray(shard.read_bytes())
    data[-70_000] ^= 1
    shard.write_bytes(bytes(data))
    assert main(["inspect", str(tmp_path / "set")]) == 1
    assert "shard-00000.npy: record 3: " in capsys.readouterr().err
    # In a process of its own: the run-time type checks of the tests look into sequences, and so at the damage.
    command = [sys.executable, "-m", "drivax", "inspect", str(tmp_path / "set"), "--no-check"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "not tested" in done.stdout
