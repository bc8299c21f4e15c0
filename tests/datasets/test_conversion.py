"""Conversion: order, skipped records, strictness, limits, audit, workers, and resuming."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow
import pytest

from datasets.samples import av2_motion, av2_sensor, nuplan, nuscenes
from drivax.cli import main
from drivax.datasets.conversion import Conversion, convert, convert_file
from drivax.datasets.doctor import estimate
from drivax.datasets.formats import find_reader, survey
from drivax.datasets.reader import BadRecord
from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.errors import DataError, UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CAPACITIES, Scenario, record_dtype
from drivax.scenario.store import ScenarioSet


@pytest.fixture
def folder(wire, write_records, tmp_path):
    """Three files: two good records; good, damaged, good; a duplicate and a record of the other format."""
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


def test_scenario_holds_the_content_of_the_file(folder, tmp_path, wire):
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
def test_limit_keeps_the_first_scenarios(folder, tmp_path, limit, workers, ids):
    convert(folder, tmp_path / "set", Conversion(limit=limit, workers=workers))
    assert [entry["scenario_id"] for entry in ScenarioSet.open(tmp_path / "set").entries] == ids


def test_duplicates_in_a_file_do_not_count_toward_the_limit(wire, write_records, tmp_path):
    path = write_records("x.tfrecord", *(wire.scenario(name) for name in ("a", "a", "b", "c")))
    convert(path, tmp_path / "set", Conversion(limit=2))
    assert [entry["scenario_id"] for entry in ScenarioSet.open(tmp_path / "set").entries] == ["a", "b"]


def test_audit_is_stored_with_its_scenario(folder, tmp_path):
    batches = []

    def audit(scenarios):
        batches.append(len(scenarios))
        return [{"name": int(scenario.id[1]), "fine": True} for scenario in scenarios]

    convert(folder, tmp_path / "set", audit=audit)
    found = [entry["audit"] for entry in ScenarioSet.open(tmp_path / "set").entries]
    assert found == [{"name": number, "fine": True} for number in (0, 1, 0, 2)]
    assert batches == [4]  # audited together, not one by one


def test_audit_without_a_scenario_is_refused(folder, tmp_path):
    with pytest.raises(ValueError, match="zip"):
        convert(folder, tmp_path / "set", audit=lambda scenarios: [])
    assert leftovers(tmp_path) == ["src"]


def test_existing_set_is_replaced_only_with_overwrite(folder, tmp_path):
    convert(folder, tmp_path / "set", Conversion(limit=1))
    with pytest.raises(UsageError, match="--overwrite"):
        convert(folder, tmp_path / "set")
    assert len(ScenarioSet.open(tmp_path / "set")) == 1
    convert(folder, tmp_path / "set", Conversion(overwrite=True))
    assert len(ScenarioSet.open(tmp_path / "set")) == 4
    assert leftovers(tmp_path) == ["set", "src"]


def test_error_names_the_first_cause_if_nothing_is_converted(wire, write_records, tmp_path):
    single = write_records("src/only.tfrecord", wire.scenario(sdc=wire.whole(6, 40)))
    with pytest.raises(
        DataError, match=r"only\.tfrecord: record 0: sdc_track_index names track 40"
    ) as caught:
        convert(single, tmp_path / "set")
    assert "others" not in str(caught.value)
    write_records("src/second.tfrecord")
    with pytest.raises(
        DataError, match=r"record 0: sdc_track_index .*1 more record could not be converted either"
    ):
        convert(tmp_path / "src", tmp_path / "set")
    assert leftovers(tmp_path) == ["src"]


def test_wrong_format_is_refused_with_the_right_name(folder, tmp_path):
    with pytest.raises(DataError, match="use --format womd-scenario"):
        convert(folder / "a.tfrecord", tmp_path / "set", Conversion(format="womd-example", strict=True))


@pytest.mark.parametrize(
    "options",
    [
        Conversion(format="wmod"),
        Conversion(capacity="huge"),
        Conversion(limit=0),
        Conversion(workers=0),
        Conversion(stride=0),
        Conversion(shard_size=0),
        Conversion(split="80/20"),
        Conversion(filters=("colour=red",)),
    ],
)
def test_invalid_options_are_refused(options, folder, tmp_path):
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


def test_unexpected_failure_is_a_bad_record(wire, write_records, monkeypatch):
    def fail(*_):
        raise IndexError("off by one")

    monkeypatch.setattr("drivax.datasets.conversion.assemble", fail)
    (bad,) = convert_file(write_records("x.tfrecord", wire.scenario("odd")), Conversion())
    assert isinstance(bad, BadRecord)
    assert (bad.record, bad.problem) == ("odd", "assembling failed (IndexError: off by one)")


def test_lack_of_memory_skips_no_record(wire, write_records, monkeypatch):
    monkeypatch.setattr("drivax.datasets.conversion.assemble", lambda *_: [0] * 2**62)
    with pytest.raises(MemoryError):
        list(convert_file(write_records("x.tfrecord", wire.scenario("fine")), Conversion()))


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
import drivax.datasets.conversion, drivax.scenario.build.assemble, drivax.scenario.store
assert "google.protobuf" not in sys.modules and "google_crc32c" not in sys.modules
from drivax.datasets.conversion import Conversion, convert_file
kinds = [type(item).__name__ for item in convert_file(pathlib.Path({str(path)!r}), Conversion())]
assert kinds == ["Scenario", "BadRecord"], kinds
assert "jax" not in sys.modules
"""
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True, timeout=60)


def drivax_process(*call, **options):
    """The command, stopped by Ctrl-C even where these tests run in the background of a shell, which ignores it."""
    heed = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"{heed}; from drivax.cli import main; raise SystemExit(main())"
    command = [sys.executable, "-c", program, *map(str, call)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, **options)


def fill_with_shards(folder, record, count):
    """``count`` names of one file that has the record 300 times, and nothing else in the folder."""
    folder.mkdir()
    (folder / "0.tfrecord").write_bytes(record.read_bytes() * 300)
    record.unlink()
    for number in range(1, count):
        os.link(folder / "0.tfrecord", folder / f"{number}.tfrecord")


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds child processes in /proc")
def test_interrupt_that_reaches_workers_first_is_an_interrupt(wire, write_records, tmp_path):
    fill_with_shards(tmp_path / "src", write_records("record", wire.scenario()), 2)
    process = drivax_process("convert", tmp_path / "src", tmp_path / "set", "--workers", 2)
    workers, deadline = [], time.monotonic() + 30
    while len(workers) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        workers = [c for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]
    time.sleep(0.5)
    for worker in workers:
        os.kill(int(worker), signal.SIGKILL)
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert len(workers) == 2 and (process.returncode, errors.splitlines()[-1]) == (130, "drivax: interrupted")
    assert leftovers(tmp_path) == ["src"]


def test_interrupt_leaves_nothing(wire, write_records, tmp_path):
    """Ctrl-C on a terminal reaches the whole process group, workers included."""
    fill_with_shards(tmp_path / "src", write_records("record", wire.scenario()), 4)
    process = drivax_process(
        "convert", tmp_path / "src", tmp_path / "set", "--workers", 2, start_new_session=True
    )
    deadline = time.monotonic() + 30
    while not list(tmp_path.glob(".set.*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(1.5)  # workers are up, or starting
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    # A worker caught while Python starts may complain before us.
    assert (process.returncode, errors.splitlines()[-1]) == (130, "drivax: interrupted")
    assert leftovers(tmp_path) == ["src"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signal_to_the_process_leaves_nothing(wire, write_records, tmp_path, number):
    """A batch system or a closed terminal sends it; workers get none and stop with their parent."""
    fill_with_shards(tmp_path / "src", write_records("record", wire.scenario()), 16)
    process = drivax_process("convert", tmp_path / "src", tmp_path / "new" / "set", "--workers", 2)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("new/.set.partial/spool-*/*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(number)
    process.send_signal(number)  # shells repeat SIGHUP
    _, errors = process.communicate(timeout=120)
    expected = (128 + number, f"drivax: stopped by {number.name}")
    assert (process.returncode, errors.splitlines()[-1]) == expected
    assert leftovers(tmp_path) == ["src"]


def test_unreadable_file_is_skipped_and_a_full_process_stops(folder, tmp_path, monkeypatch):
    reader = type(find_reader("womd-scenario"))
    read = reader.read

    def read_or_fail(number):
        def fail(self, path):
            if path.name == "a.tfrecord":
                raise OSError(number, os.strerror(number))
            yield from read(self, path)

        return fail

    monkeypatch.setattr(reader, "read", read_or_fail(errno.EIO))
    result = convert(folder, tmp_path / "set")
    bad = [bad for bad in result.skipped if "input/output error" in bad.problem]
    assert [(bad.file.name, bad.cure.split(" or ")[0]) for bad in bad] == [
        ("a.tfrecord", "mount the disk again")
    ]
    assert result.scenarios > 0
    monkeypatch.setattr(reader, "read", read_or_fail(errno.EMFILE))
    with pytest.raises(OSError):
        convert(folder, tmp_path / "other")


@pytest.mark.parametrize("name", ["womd-scenario", "nuplan", "av2-motion"])
def test_too_many_open_files_end_a_conversion(name, tmp_path, monkeypatch):
    def fail(*arguments, **settings):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    path = tmp_path / "source"
    path.write_bytes(b"x")
    monkeypatch.setattr(Path, "open", fail)
    monkeypatch.setattr(pyarrow, "OSFile", fail)
    with pytest.raises(UsageError, match="too many open files"):
        list(convert_file(path, Conversion(format=name)))


def test_file_that_cannot_be_opened_is_a_bad_record(tmp_path):
    (bad,) = convert_file(tmp_path / "gone.tfrecord", Conversion(format="womd-scenario"))
    assert isinstance(bad, BadRecord) and bad.problem == "file not found" and bad.cure


# --- What is left out, and what is written next to the scenarios.


def numbered(scenarios):
    """An audit whose findings are known: the number in the scenario's id, and whether it is even."""
    numbers = [int(scenario.id[1:]) for scenario in scenarios]
    return [{"distance_m": float(number), "clean": number % 2 == 0} for number in numbers]


@pytest.fixture
def thirty(wire, write_records, tmp_path):
    """Three files of ten records, n0 to n29; the fourth of each is damaged."""
    for file in range(3):
        frames = [wire.frame(wire.scenario(f"n{10 * file + row}", steps=11, map=b"")) for row in range(10)]
        frames[3] = frames[3][:200] + bytes([frames[3][200] ^ 1]) + frames[3][201:]
        path = tmp_path / "src" / f"{file}.tfrecord"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"".join(frames))
    return tmp_path / "src"


def ids(path):
    return [int(entry["scenario_id"][1:]) for entry in ScenarioSet.open(path).entries]


GOOD = [number for number in range(30) if number % 10 != 3]


@pytest.mark.parametrize("shard_size", [2, 512])
@pytest.mark.parametrize(
    ("options", "kept", "filtered"),
    [
        ({}, GOOD, 0),
        ({"filters": ("audit.clean=true",)}, [n for n in GOOD if n % 2 == 0], 12),
        ({"filters": ("audit.clean=false", "audit.distance_m>20")}, [21, 25, 27, 29], 23),
        ({"filters": ("audit.clean=true",), "limit": 4}, [0, 2, 4, 6], 2),
        ({"limit": 5}, GOOD[:5], 0),
    ],
)
def test_filters_apply_to_findings_of_the_audit(thirty, tmp_path, shard_size, options, kept, filtered):
    result = convert(thirty, tmp_path / "set", Conversion(shard_size=shard_size, **options), audit=numbered)
    assert ids(tmp_path / "set") == kept
    manifest = json.loads((tmp_path / "set" / "manifest.json").read_text())
    assert (result.filtered, manifest["source"]["filtered"]) == (filtered, filtered)
    assert result.scenarios == len(kept)
    assert [shard["count"] for shard in manifest["shards"][:-1]] == [shard_size] * (
        len(kept) // shard_size - (len(kept) % shard_size == 0)
    )


def test_filters_that_no_scenario_satisfies(thirty, tmp_path):
    with pytest.raises(DataError, match="none of the 27 scenarios satisfies the filters; use wider"):
        convert(thirty, tmp_path / "set", Conversion(filters=("audit.distance_m>99",)), audit=numbered)
    assert leftovers(tmp_path) == ["src"]


def test_manifest_lists_read_and_skipped_files(thirty, tmp_path):
    convert(thirty, tmp_path / "set", Conversion(split="50/30/20"))
    source = json.loads((tmp_path / "set" / "manifest.json").read_text())["source"]
    assert (source["folder"], source["files"], source["formats"]) == ("src", 3, {"womd-scenario": 3})
    assert (source["skipped"], source["split"], source["stride"]) == (3, "50/30/20", 40)
    assert [(row["file"], row["record"]) for row in source["skipped_records"]] == [
        ("0.tfrecord", 3), ("1.tfrecord", 3), ("2.tfrecord", 3)
    ]  # fmt: skip
    assert all("checksum" in row["problem"] for row in source["skipped_records"])


def test_split_files_cover_the_set(thirty, tmp_path):
    convert(thirty, tmp_path / "set", Conversion(split="50/30/20"))
    lines = [
        line for name in ("train", "validation", "test")
        for line in (tmp_path / "set" / "splits" / f"{name}.txt").read_text().splitlines()
    ]  # fmt: skip
    assert sorted(lines) == sorted(f"womd\tn{number}" for number in GOOD)
    ScenarioSet.open(tmp_path / "set").check()


def test_stride_sets_the_starts_of_windows(wire, write_records, tmp_path):
    path = write_records("long.tfrecord", wire.scenario("long", steps=180, now=wire.whole(10, 0)))
    plans = []
    convert(path, tmp_path / "set", Conversion(stride=10), announce=plans.append)
    entries = ScenarioSet.open(tmp_path / "set").entries
    assert [entry["scenario_id"] for entry in entries] == [f"long@{start}" for start in range(0, 81, 10)]
    # Estimated from the three windows of the usual stride: 91 + 2 x 40 steps at least.
    assert plans[0].estimate.scenarios == 9


def test_route_style_is_passed_on(folder, tmp_path, monkeypatch):
    asked = []

    def remember(recording, capacity, routes):
        asked.append(routes)
        return assemble(recording, capacity, routes)

    monkeypatch.setattr("drivax.datasets.conversion.assemble", remember)
    convert(folder, tmp_path / "set", Conversion(limit=1, routes="published"))
    assert asked == ["published"]


def test_plan_is_announced_before_the_work(thirty, tmp_path):
    plans, calls = [], []
    convert(
        thirty, tmp_path / "set", Conversion(limit=7), lambda *call: calls.append(call), None, plans.append
    )
    (plan,) = plans
    assert plan.data.formats == {"womd-scenario": 3} and plan.written == 0
    assert plan.estimate.scenarios == 7
    assert plan.estimate.size_bytes == 7 * record_dtype(CAPACITIES["default"]).itemsize
    assert plan.estimate.free_bytes > 0


def test_length_of_scenarios_is_an_option_and_a_property_of_the_set(wire, tmp_path):
    recording = wire.frame(wire.scenario(steps=199))
    (tmp_path / "a.tfrecord").write_bytes(recording)
    found, plans = {}, []
    for future_s in (8.0, 15.0, 18.0, 20.0):
        out, options = tmp_path / f"set-{future_s:g}", Conversion(future_s=future_s)
        convert(tmp_path / "a.tfrecord", out, options, announce=plans.append)
        opened = ScenarioSet.open(out)
        found[opened.capacity.steps] = [int(scenario.steps) for scenario in opened]
        assert opened.manifest["capacity"]["steps"] == 11 + 10 * future_s
    assert found == {91: [91] * 3, 161: [161], 191: [191], 211: [199]}
    assert [plan.estimate.scenarios for plan in plans] == [3, 1, 1, 1]
    for wrong in (1.0, 61.0):
        with pytest.raises(UsageError, match=f"future_s is {wrong:g}; use 2 to 60 seconds"):
            convert(tmp_path / "a.tfrecord", tmp_path / "wrong", Conversion(future_s=wrong))


def test_many_files_are_sampled_and_scaled_by_size(wire, tmp_path, monkeypatch):
    monkeypatch.setattr("drivax.datasets.doctor._COUNT_FILES", 4)
    record = wire.frame(wire.scenario(steps=11))
    (tmp_path / "src").mkdir()
    for number in range(12):
        (tmp_path / "src" / f"{number:02d}.tfrecord").write_bytes(record * (1 + number % 3))
    found = survey(tmp_path / "src")
    counted, count = [], WomdScenario.count
    monkeypatch.setattr(
        WomdScenario, "count", lambda self, path: counted.append(path.stem) or count(self, path)
    )
    guess = estimate(found, tmp_path / "set", CAPACITIES["default"], 40, None)
    # Files 0, 3, 6 and 9 are counted, one record each; the others are two and three times as large.
    assert counted == ["00", "03", "06", "09"] and guess.scenarios == 24
    assert estimate(found, tmp_path / "set", CAPACITIES["default"], 40, 10).scenarios == 10


def test_too_small_disk_is_reported_before_the_start(thirty, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(total=1 << 60, free=5_000_000))
    with pytest.raises(
        DataError, match=r"set: no space: needs about 1\d MB, the disk has 5\.0 MB left; make room"
    ):
        convert(thirty, tmp_path / "set")
    assert leftovers(tmp_path) == ["src"]
    convert(thirty, tmp_path / "set", Conversion(limit=5))


# --- Killed and continued.

#: Converts with small shards; workers and the moment of death are arguments.
PROGRAM = """
import os, sys, time
from pathlib import Path
from drivax.datasets.conversion import Conversion, convert

def audit(batch):
    return [{"distance_m": float(scenario.id[1:]), "batch": len(batch)} for scenario in batch]

def progress(done, files, scenarios):
    time.sleep(0.01)
    if scenarios == int(sys.argv[4]):
        os.kill(os.getpid(), 9)

if __name__ == "__main__":
    filters = ("audit.distance_m!=11",) if sys.argv[5] == "filtered" else ()
    options = Conversion(workers=int(sys.argv[3]), shard_size=4, filters=filters, split="60/20/20")
    convert(sys.argv[1], sys.argv[2], options, progress, audit)
"""


@pytest.fixture
def program(tmp_path):
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)

    def start(src, out, workers=1, die_at=-1, filtered="all"):
        command = [sys.executable, str(path), str(src), str(out), str(workers), str(die_at), filtered]
        with (tmp_path / "said").open("w") as said:
            return subprocess.Popen(command, stderr=said, start_new_session=True)

    return start


def ended(process, seconds=20.0):
    """Waits until the process and all that it started are gone."""
    process.wait(seconds)
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def every_file(folder):
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*")) if path.is_file()
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("workers", "filtered", "deaths"), [(1, "all", (6, 13, 14, 26)), (2, "filtered", (6, 14))]
)
def test_killed_at_given_moments_and_resumed_to_the_same_bytes(
    thirty, tmp_path, program, workers, filtered, deaths
):
    assert program(thirty, tmp_path / "whole", 1, filtered=filtered).wait(60) == 0
    for die_at in deaths:
        process = program(thirty, tmp_path / "set", workers, die_at, filtered)
        assert ended(process), "workers outlived their parent"
        assert process.returncode == -9 and not (tmp_path / "set").exists()
        assert (tmp_path / ".set.partial" / "progress").is_dir()
    process = program(thirty, tmp_path / "set", workers, filtered=filtered)
    assert process.wait(60) == 0, (tmp_path / "said").read_text()
    assert every_file(tmp_path / "set") == every_file(tmp_path / "whole")
    assert leftovers(tmp_path) == ["program.py", "said", "set", "src", "whole"]


@pytest.mark.slow
def test_killed_at_random_moments_and_resumed_to_the_same_bytes(thirty, tmp_path, program):
    assert program(thirty, tmp_path / "whole").wait(60) == 0
    moments = random.Random(time.time_ns())
    killed = 0
    for _ in range(12):
        process = program(thirty, tmp_path / "set", workers=1 + killed % 2)
        while not (tmp_path / ".set.partial" / "content").exists() and process.poll() is None:
            time.sleep(0.005)
        time.sleep(moments.uniform(0.0, 0.5))
        process.kill()
        assert ended(process)
        if (tmp_path / "set").exists():
            break
        killed += 1
    else:
        assert program(thirty, tmp_path / "set").wait(60) == 0
    assert killed > 0
    assert every_file(tmp_path / "set") == every_file(tmp_path / "whole")


def test_resuming_reports_written_scenarios_and_reads_the_rest(thirty, tmp_path):
    options = Conversion(shard_size=4)

    def stop(done, files, scenarios):
        if scenarios == 14:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(thirty, tmp_path / "set", options, stop, numbered)
    assert leftovers(tmp_path) == [".set.partial", "src"]
    read, plans = [], []

    def audit(batch):
        read.extend(int(scenario.id[1:]) for scenario in batch)
        return numbered(batch)

    result = convert(thirty, tmp_path / "set", options, None, audit, plans.append)
    assert (plans[0].written, result.written, result.scenarios) == (12, 12, 27)
    assert read == GOOD[12:]
    assert [(bad.file, bad.record) for bad in result.skipped] == [
        (thirty / f"{n}.tfrecord", 3) for n in range(3)
    ]


def test_conversion_that_stopped_at_its_limit_adds_nothing(thirty, tmp_path):
    options = Conversion(shard_size=5, limit=10)

    def stop(done, files, scenarios):
        if scenarios == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(thirty, tmp_path / "set", options, stop)
    result = convert(thirty, tmp_path / "set", options)
    assert (result.written, result.scenarios, result.files, ids(tmp_path / "set")) == (10, 10, 2, GOOD[:10])


def test_skipped_records_of_an_earlier_run_count_under_strict(thirty, tmp_path):
    def stop(done, files, scenarios):
        if scenarios == 14:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(thirty, tmp_path / "set", Conversion(shard_size=4), stop)
    with pytest.raises(DataError, match=r"0\.tfrecord: record 3: .*checksum"):
        convert(thirty, tmp_path / "set", Conversion(shard_size=4, strict=True))


def test_other_data_or_options_are_not_resumed(thirty, tmp_path):
    def stop(done, files, scenarios):
        if scenarios == 14:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(thirty, tmp_path / "set", Conversion(shard_size=4), stop)
    with pytest.raises(UsageError, match=r"other options \(stride\).*--overwrite to start again"):
        convert(thirty, tmp_path / "set", Conversion(shard_size=4, stride=20))
    content = (thirty / "2.tfrecord").read_bytes()
    for place in (20, len(content) - 20):  # of the same size and name
        (thirty / "2.tfrecord").write_bytes(content[:place] + b"?" + content[place + 1 :])
        with pytest.raises(UsageError, match=r"other options \(files\)"):
            convert(thirty, tmp_path / "set", Conversion(shard_size=4))
    (thirty / "2.tfrecord").unlink()
    with pytest.raises(UsageError, match=r"other options \(files\)"):
        convert(thirty, tmp_path / "set", Conversion(shard_size=4))
    assert convert(thirty, tmp_path / "set", Conversion(shard_size=4, overwrite=True)).written == 0
    assert leftovers(tmp_path) == ["set", "src"]


@pytest.mark.parametrize(
    ("sample", "companion"),
    [
        (av2_motion.write, "log_map_archive_*.json"),
        (av2_sensor.write, "log_map_archive_*.json"),
        (av2_sensor.write, "city_SE3_egovehicle.feather"),
        (nuplan.write_full, "map.gpkg"),
        (nuplan.write_full, "nuplan-maps-*.json"),
        (nuscenes.write, "expansion/*.json"),
        (nuscenes.write, "ego_pose.json"),
    ],
)
def test_conversion_is_not_resumed_with_other_companions(tmp_path, sample, companion):
    (tmp_path / "src").mkdir()
    path = sample(tmp_path / "src")
    (file,) = [file for file in (tmp_path / "src").rglob("*") if file.match(companion)]
    content = file.read_bytes()

    def stop(done, files, scenarios):
        raise KeyboardInterrupt

    for src in (path, tmp_path / "src"):
        out = tmp_path / f"set of {src.name}"
        with pytest.raises(KeyboardInterrupt):
            convert(src, out, Conversion(shard_size=1), stop)
        file.write_bytes(content + b" ")
        with pytest.raises(UsageError, match=r"other options \(companions\).*--overwrite to start again"):
            convert(src, out, Conversion(shard_size=1))
        file.write_bytes(content)
        assert convert(src, out, Conversion(shard_size=1)).written == 1


@pytest.mark.parametrize(
    "changes", [{"place": [3, 0]}, {"place": [0.5, 1]}, {"place": 1}, {"filtered": "x"}, {"skipped": [{"file": 1}]}]
)  # fmt: skip
def test_forged_note_is_reported_in_one_line(thirty, tmp_path, changes):
    def stop(done, files, scenarios):
        if scenarios == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(thirty, tmp_path / "set", Conversion(shard_size=4), stop)
    note = tmp_path / ".set.partial" / "progress" / "00000.json"
    value = json.loads(note.read_text())["value"]
    value["note"].update(changes)
    digest = hashlib.sha256(json.dumps([0, value], sort_keys=True).encode()).hexdigest()
    note.write_text(json.dumps({"sha256": digest, "value": value}))
    with pytest.raises(
        DataError, match=r"\.set\.partial: unfinished output is damaged .*; remove this folder"
    ):
        convert(thirty, tmp_path / "set", Conversion(shard_size=4))


def test_two_conversions_to_one_set_at_once_are_refused(thirty, tmp_path):
    def second(done, files, scenarios):
        if scenarios == 1:
            with pytest.raises(UsageError, match="another process is writing it"):
                convert(thirty, tmp_path / "set")

    convert(thirty, tmp_path / "set", progress=second)
    assert len(ScenarioSet.open(tmp_path / "set")) == 27


def test_dead_worker_is_reported_in_one_line(thirty, tmp_path, program):
    process = program(thirty, tmp_path / "set", workers=2)
    while not list(tmp_path.glob(".set.partial/spool-*/*")):
        time.sleep(0.01)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    workers = [pid for pid in children if "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text()]
    os.kill(int(workers[0]), signal.SIGKILL)
    assert ended(process)
    assert "a worker process died" in (tmp_path / "said").read_text().splitlines()[-1]


@pytest.mark.slow
def test_memory_of_workers(real_data, tmp_path):
    """Two shards of 300 of the largest real record: a worker holds one scenario, not its shard."""
    record = (real_data / "womd" / "motion_data_one_scenario.tfrecord").read_bytes()
    (tmp_path / "src").mkdir()
    for name in "ab":
        (tmp_path / "src" / f"{name}.tfrecord").write_bytes(record * 300)
    program = """
import resource, sys
from drivax.datasets.conversion import Conversion, convert
if __name__ == "__main__":
    convert(sys.argv[1], sys.argv[2], Conversion(workers=2))
    for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN):
        print(resource.getrusage(who).ru_maxrss)
"""
    (tmp_path / "program.py").write_text(program)
    command = [sys.executable, str(tmp_path / "program.py"), str(tmp_path / "src"), str(tmp_path / "set")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    parent, worker = (int(line) * 1024 for line in done.stdout.split())
    assert worker < 1.5e9 and parent < 1.5e9


# --- The commands.


@pytest.mark.slow
def test_command_reports_written_and_skipped_records(folder, tmp_path, capsys):
    (folder / "notes.txt").write_text("not a recording")
    assert main(["convert", str(folder), str(tmp_path / "set"), "--workers", "1"]) == 0
    out, err = capsys.readouterr()
    announced, done = out.splitlines(keepends=True)
    # Eight records are counted; which of them can be read shows later.
    assert announced.startswith("found womd-scenario (3 files): about 8 scenarios, 4.")
    assert done.startswith(f"{tmp_path / 'set'}: 4 scenarios from 3 files in ")
    assert done.endswith("4 records skipped, 1 file of other formats ignored\n")
    lines = err.splitlines()
    progress, *lines = lines
    assert progress.startswith("converting: 3 files")
    assert len(lines) == 4 and all(line.startswith("skipped ") for line in lines)
    assert f"{folder / 'b.tfrecord'}: record 1: the payload is damaged" in lines[0]


def test_command_says_that_it_can_be_resumed(thirty, tmp_path, capsys, monkeypatch):
    def interrupted(src, out, options, progress, audit, announce):
        def stop(done, files, scenarios):
            if scenarios == 14:
                raise KeyboardInterrupt

        return convert(src, out, replace(options, shard_size=4), stop if first else progress, None, announce)

    monkeypatch.setattr("drivax.cli.convert.convert", interrupted)
    first = True
    assert main(["convert", str(thirty), str(tmp_path / "set"), "--workers", "1"]) == 130
    assert capsys.readouterr().err.splitlines() == [
        "drivax: finished parts are kept; the same command resumes",
        "drivax: interrupted",
    ]
    first = False
    assert main(["convert", str(thirty), str(tmp_path / "set"), "--workers", "1"]) == 0
    announced, continuing, done = capsys.readouterr().out.splitlines()
    assert announced.startswith("found womd-scenario (3 files): about 30 scenarios")
    assert continuing == "continuing after 12 scenarios"
    assert ": 27 scenarios from 3 files in " in done and "12 of them written before" in done


def test_command_strict_fails_in_one_line(folder, tmp_path, capsys):
    assert main(["convert", str(folder), str(tmp_path / "set"), "--strict", "--workers", "1"]) == 1
    out, err = capsys.readouterr()
    assert out.startswith("found ") and len(out.splitlines()) == 1
    assert len(err.splitlines()) == 1 and "record 1" in err
    assert leftovers(tmp_path) == ["src"]


@pytest.mark.parametrize("flags", [["--limit", "0"], ["--format", "wmod"], ["--workers", "many"]])
def test_command_usage_errors(folder, tmp_path, flags, capsys):
    assert main(["convert", str(folder), str(tmp_path / "set"), *flags]) == 2
    assert capsys.readouterr().err


def test_inspect_json_has_the_documented_fields(folder, tmp_path, capsys):
    convert(folder, tmp_path / "set")
    assert main(["inspect", str(tmp_path / "set"), "--json"]) == 0
    scenarios = json.loads(capsys.readouterr().out)["scenarios"]
    assert len(scenarios) == 4
    assert set(scenarios[0]) == {
        "scenario_id", "dataset", "segment", "steps", "tracks", "tracks_valid_now", "map_features", "map_points",
        "lights", "lost", "segments", "overflow", "flags", "audit", "origin",
    }  # fmt: skip
    assert scenarios[1]["scenario_id"] == "a1" and scenarios[1]["tracks_valid_now"] == 2
    stored = ScenarioSet.open(tmp_path / "set")
    assert [row["origin"] for row in scenarios] == [scenario.origin.tolist() for scenario in stored]


def test_inspect_tables_fit_a_hundred_columns(folder, tmp_path, capsys):
    convert(folder, tmp_path / "set")
    assert main(["inspect", str(tmp_path / "set")]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 100
    for words in ("4 (recorded segments: 4", "all checksums match", "LANE_GRAPH", "b2"):
        assert words in out


def test_inspect_reports_damage_unless_the_check_is_off(folder, tmp_path, capsys):
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
