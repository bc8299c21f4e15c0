"""The store: what is written comes back bit for bit, and every kind of damage is named."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import subprocess
import sys
import time
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivax.datasets.export.writer import write_part
from drivax.errors import DataError, UsageError
from drivax.files import can_resume
from drivax.scenario import manifest as manifest_module
from drivax.scenario import store
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.schema import (
    SCHEMA_VERSION,
    Capacity,
    Flag,
    Scenario,
    SourceCounts,
    record_dtype,
    stored_name,
)
from drivax.scenario.select.selection import select_scenarios
from drivax.scenario.store import ScenarioSet, ScenarioWriter, check_lengths
from drivax.seal import allow_edited, edited_files, seal

SMALL = Capacity(
    name="small", agents=3, parked=2, steps=5, segments=8, features=4, lanes=4, lights=2, stops=1, routes=2,
    route_points=6, road_rows=4, events=1, extension=2, grid=2,
)  # fmt: skip


def make_scenario(number: int, capacity: Capacity = SMALL) -> Scenario:
    """A scenario whose fields hold random numbers, as far as a scenario can; the same for the same number."""
    rng = np.random.default_rng(number)
    dtype = record_dtype(capacity)
    record = np.zeros((), dtype)
    for name in dtype.names or ():
        kind = record[name].dtype.kind
        shape = record[name].shape
        if kind == "f":
            record[name] = rng.normal(size=shape)
        elif kind in "iu":
            record[name] = rng.integers(0, 2, size=shape)  # within the bounds of all fields
        elif kind == "b":
            record[name] = rng.random(shape) < 0.5
    record["scenario_id"] = f"scenario-{number}".encode()
    record["dataset"] = b"synthetic"
    record["segment"] = f"segment-{number // 2}".encode()
    record["flags"] = int(Flag.LIGHTS | Flag.ROUTE)
    record["segment_blocks"] = (0, 2, 5, 7)
    record["steps"], record["current_step"], record["dt_s"], record["road_rows"] = capacity.steps, 1, 0.1, 1
    record["lane_length"] = 1.0
    source = SourceCounts(5, number, number // 2, {"lane": 3}, 40, 1, {"dangling_links": 2})
    return Scenario(record, capacity, source, {"agents": 2}, {"collision": False}, {"domain": "urban"})


@pytest.fixture
def scenario_set(tmp_path: Path) -> Path:
    """Seven scenarios in shards of three."""
    path = tmp_path / "set"
    with ScenarioWriter(path, SMALL, {"command": "test"}, shard_size=3) as writer:
        for number in range(7):
            writer.add(make_scenario(number))
    return path


def edit_manifest(path: Path, **changes: object) -> None:
    """Change the manifest, and seal it again."""
    file = path / "manifest.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    seal(path, file.name)


def test_stored_scenarios_equal_the_written_ones(scenario_set: Path):
    opened = ScenarioSet.open(scenario_set)
    assert len(opened) == 7
    assert opened.capacity == SMALL
    for number, scenario in enumerate(opened):
        expected = make_scenario(number)
        for name in record_dtype(SMALL).names or ():
            np.testing.assert_array_equal(scenario.record[name], expected.record[name], err_msg=name)
        assert scenario.id == f"scenario-{number}"
        assert scenario.source == expected.source
        assert (scenario.overflow, scenario.audit, scenario.tags) == (
            {"agents": 2},
            {"collision": False},
            {"domain": "urban"},
        )
    assert opened[-1].id == "scenario-6"
    assert [scenario.id for scenario in opened[5:]] == ["scenario-5", "scenario-6"]
    with pytest.raises(IndexError):
        opened[7]


def as_earlier_version(path: Path) -> Path:
    """The set without the seal and the digests that earlier versions did not write."""
    (path / "seal.json").unlink(missing_ok=True)
    manifest = json.loads((path / "manifest.json").read_text())
    for shard in manifest["shards"]:
        del shard["crc_sha256"]
    (path / "manifest.json").write_text(json.dumps(manifest, indent=1))
    return path


def test_manifest_describes_shards_and_scenarios(scenario_set: Path):
    manifest = json.loads((scenario_set / "manifest.json").read_text())
    assert [shard["count"] for shard in manifest["shards"]] == [3, 3, 1]
    assert manifest["source"] == {"command": "test"}
    assert manifest["capacity"]["name"] == "small"
    assert manifest["scenarios"][3] == {
        "scenario_id": "scenario-3",
        "dataset": "synthetic",
        "segment": "segment-1",
        "flags": ["LIGHTS", "ROUTE"],
        "segments": 7,
        "source": {
            "steps": 5, "tracks": 3, "tracks_valid_now": 1, "map_features": {"lane": 3}, "map_points": 40,
            "lights": 1, "lost": {"dangling_links": 2},
        },
        "overflow": {"agents": 2},
        "audit": {"collision": False},
        "tags": {"domain": "urban"},
    }  # fmt: skip
    for shard in manifest["shards"]:
        assert hashlib.sha256((scenario_set / shard["file"]).read_bytes()).hexdigest() == shard["sha256"]
        crcs = scenario_set / shard["file"].replace(".npy", ".crc.npy")
        assert hashlib.sha256(crcs.read_bytes()).hexdigest() == shard["crc_sha256"]


def test_sizes_of_a_set_are_those_of_its_records(scenario_set: Path):
    opened = ScenarioSet.open(scenario_set)
    assert all("sizes" in shard for shard in opened.manifest["shards"])
    assert opened.sizes == Sizes.used(list(opened)) == Sizes.used(opened)
    # Sets of earlier versions have none.
    for shard in opened.manifest["shards"]:
        del shard["sizes"]
    assert ScenarioSet(scenario_set, opened.manifest).sizes == opened.sizes


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agents": 10**9}, "size agents is 1000000000 of 3"),
        ({"slots": -1}, "size slots is -1"),
        ({"lanes": "8"}, "sizes are "),
        ({"further": 1}, "sizes are "),
    ],
)
def test_forged_sizes_are_refused(scenario_set: Path, changes: dict[str, Any], message: str):
    manifest = json.loads((scenario_set / "manifest.json").read_text())
    manifest["shards"][1]["sizes"].update(changes)
    edit_manifest(scenario_set, **manifest)
    with pytest.raises(DataError, match="manifest is damaged"):
        ScenarioSet.open(scenario_set)
    with pytest.raises(ValueError, match=message):
        Sizes.read(manifest["shards"][1]["sizes"], SMALL)


def test_files_are_plain_numpy(scenario_set: Path):
    """The format is documented as readable by numpy alone, with the field table as its description."""
    shard = np.load(scenario_set / "shard-00001.npy", mmap_mode="r")
    crcs = np.load(scenario_set / "shard-00001.crc.npy")
    manifest = json.loads((scenario_set / "manifest.json").read_text())
    assert shard.shape == (3,)
    assert crcs.dtype == np.uint32
    data = (scenario_set / "shard-00001.npy").read_bytes()
    size = manifest["record_bytes"]
    first = len(data) - 3 * size
    for row in range(3):
        raw = data[first + row * size : first + (row + 1) * size]
        assert zlib.crc32(raw) == crcs[row]
        field = next(field for field in manifest["fields"] if field["name"] == "agent_xy")
        values = np.frombuffer(raw, field["dtype"], int(np.prod(field["shape"])), field["offset"])
        np.testing.assert_array_equal(
            values.reshape(field["shape"]), make_scenario(3 + row).record["agent_xy"]
        )


def test_sets_are_reproducible_and_their_hash_follows_the_data(tmp_path: Path, scenario_set: Path):
    def write(name: str, numbers: list[int]) -> ScenarioSet:
        with ScenarioWriter(tmp_path / name, SMALL, {"command": "test"}, shard_size=3) as writer:
            for number in numbers:
                # A record whose padding bytes are not zero must be stored as one whose are.
                noisy = np.frombuffer(b"\xff" * record_dtype(SMALL).itemsize, record_dtype(SMALL)).copy()
                for field in record_dtype(SMALL).names or ():
                    noisy[field][0] = make_scenario(number).record[field]
                scenario = make_scenario(number)
                writer.add(
                    Scenario(
                        noisy.reshape(()), SMALL, scenario.source, scenario.overflow, scenario.audit,
                        scenario.tags,
                    )
                )  # fmt: skip
        return ScenarioSet.open(tmp_path / name)

    same = write("same", list(range(7)))
    for file in sorted(scenario_set.iterdir()):
        assert file.read_bytes() == (same.path / file.name).read_bytes(), file.name
    assert same.hash == ScenarioSet.open(scenario_set).hash
    assert write("other", [1, 0, 2, 3, 4, 5, 6]).hash != same.hash


def named(scenario: Scenario, **names: str) -> Scenario:
    """The scenario under other names, as ``assemble`` stores them."""
    record = scenario.record.copy()
    for name, text in names.items():
        record[name] = stored_name(text, record.dtype[name].itemsize)
    return replace(scenario, record=record, names=names)


LONG = "scene-0103_" + "0123456789abcdef" * 2 + "_" + "fedcba9876543210" * 2


def test_names_longer_than_their_fields_are_kept_in_full(tmp_path: Path):
    """Two ids and segments that differ in their last character only, beyond the 64 bytes of a field."""
    with ScenarioWriter(tmp_path / "set", SMALL, shares=(50, 0, 50)) as writer:
        for end in "ab":
            writer.add(named(make_scenario(0), scenario_id=LONG + end, segment=LONG + end + "é" * 99))
        assert ("synthetic", LONG + "a") in writer and ("synthetic", LONG) not in writer
        with pytest.raises(DataError, match=LONG + "b"):
            writer.add(named(make_scenario(0), scenario_id=LONG + "b"))
    opened = ScenarioSet.open(tmp_path / "set")
    assert (
        [entry["scenario_id"] for entry in opened.entries]
        == [s.id for s in opened]
        == [LONG + "a", LONG + "b"]
    )
    assert [s.text("segment") for s in opened] == [entry["segment"] for entry in opened.entries]
    assert opened[1].text("segment") == LONG + "b" + "é" * 99 and opened[1].text("dataset") == "synthetic"
    assert (
        select_scenarios(opened, (), (LONG + "b",))
        == select_scenarios(opened, (f"scenario_id={LONG}b",))
        == [1]
    )
    lines = "".join(file.read_text() for file in (tmp_path / "set" / "splits").glob("*.txt")).splitlines()
    assert sorted(lines) == [f"synthetic\t{LONG}a", f"synthetic\t{LONG}b"]
    again = write_part(opened, [1, 0], tmp_path / "part")
    assert [s.id for s in ScenarioSet.open(again.path)] == [LONG + "b", LONG + "a"]
    fields = [bytes(record["scenario_id"]).decode() for record in opened.records([0, 1])]
    assert len(set(fields)) == 2 and all(field.startswith("scene-0103_") for field in fields)


@pytest.mark.parametrize("text", ["x" * 64, "é" * 32, "a"])
def test_names_that_fit_their_fields_are_stored_as_they_are(text: str):
    assert stored_name(text, 64).decode() == text


@pytest.mark.parametrize("text", ["x" * 65, "é" * 33, "€" * 4000])
def test_longer_names_end_in_their_digest(text: str):
    field = stored_name(text, 64)
    begin, _, digest = field.decode().partition("~")
    assert len(field) <= 64 and text.startswith(begin)
    assert digest == hashlib.sha256(text.encode()).hexdigest()[:16]


def test_records_are_batches_in_the_order_of_the_indices(scenario_set: Path):
    opened = ScenarioSet.open(scenario_set)
    indices = [6, 0, 4, 4, -1, 2]
    records = opened.records(indices)
    assert records.dtype == record_dtype(SMALL)
    for record, index in zip(records, indices, strict=True):
        np.testing.assert_array_equal(record["agent_xy"], make_scenario(index % 7).record["agent_xy"])
        assert bytes(record["scenario_id"]).decode() == f"scenario-{index % 7}"
    assert opened.records([]).shape == (0,)
    with pytest.raises(IndexError):
        opened.records([7])
    records["agent_xy"] = 0.0  # copies: the set must not change
    assert np.any(opened[0].agent_xy)
    assert opened.records([2, 3, 1, 0, 5, 6], out=records) is records
    np.testing.assert_array_equal(records["agent_xy"][3], make_scenario(0).record["agent_xy"])
    with pytest.raises(UsageError, match="size and type"):
        opened.records([1, 2], out=records)


def test_scenarios_are_read_only_views(scenario_set: Path):
    with pytest.raises(ValueError, match="read-only"):
        ScenarioSet.open(scenario_set)[0].agent_xy[:] = 0.0


def test_a_set_can_be_sent_to_a_worker(scenario_set: Path):
    opened = ScenarioSet.open(scenario_set)
    opened[0]
    data = pickle.dumps(opened)
    assert len(data) < 2000
    assert pickle.loads(data)[6].id == "scenario-6"


def test_nothing_is_left_after_an_exception(tmp_path: Path):
    with pytest.raises(RuntimeError), ScenarioWriter(tmp_path / "set", SMALL, shard_size=1) as writer:
        writer.add(make_scenario(0))
        writer.add(make_scenario(1))
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_an_exception_while_overwriting_keeps_the_old_set(scenario_set: Path):
    with pytest.raises(RuntimeError), ScenarioWriter(scenario_set, SMALL, overwrite=True) as writer:
        writer.add(make_scenario(99))
        raise RuntimeError
    assert len(ScenarioSet.open(scenario_set)) == 7
    assert [path.name for path in scenario_set.parent.iterdir()] == ["set"]


def test_existing_set_is_replaced_only_with_overwrite(scenario_set: Path):
    with pytest.raises(UsageError, match="--overwrite"):
        ScenarioWriter(scenario_set, SMALL)
    with ScenarioWriter(scenario_set, SMALL, overwrite=True) as writer:
        writer.add(make_scenario(99))
    assert [scenario.id for scenario in ScenarioSet.open(scenario_set)] == ["scenario-99"]
    assert [path.name for path in scenario_set.parent.iterdir()] == ["set"]


def test_overwrite_never_replaces_other_folders(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(UsageError, match="not a scenario set"):
        ScenarioWriter(tmp_path, SMALL, overwrite=True)
    with pytest.raises(UsageError, match="not a scenario set"):
        ScenarioWriter(tmp_path / "thesis.tex", SMALL, overwrite=True)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_an_empty_folder_may_be_filled(tmp_path: Path):
    (tmp_path / "set").mkdir()
    with ScenarioWriter(tmp_path / "set", SMALL) as writer:
        writer.add(make_scenario(0))
    assert len(ScenarioSet.open(tmp_path / "set")) == 1


def test_writer_refuses_foreign_and_duplicate_scenarios(tmp_path: Path):
    with pytest.raises(DataError, match="no scenario"), ScenarioWriter(tmp_path / "empty", SMALL):
        pass
    with ScenarioWriter(tmp_path / "set", SMALL) as writer:
        writer.add(make_scenario(0))
        with pytest.raises(DataError, match="'scenario-0' of 'synthetic'"):
            writer.add(make_scenario(0))
        with pytest.raises(UsageError, match=r"'default'.*'small'"):
            writer.add(make_scenario(1, Capacity()))
    with pytest.raises(UsageError, match="shard_size"):
        ScenarioWriter(tmp_path / "zero", SMALL, shard_size=0)


def test_audit_values_become_strict_json(tmp_path: Path):
    scenario = make_scenario(0)
    scenario.audit.update(
        {"score": float("nan"), "count": np.int64(3), "share": np.float32(0.5), "bad": np.bool_(True)}
    )  # type: ignore[dict-item]
    with ScenarioWriter(tmp_path / "set", SMALL) as writer:
        writer.add(scenario)
    assert ScenarioSet.open(tmp_path / "set")[0].audit == {
        "collision": False, "score": None, "count": 3, "share": 0.5, "bad": True,
    }  # fmt: skip


def flip_bit(file: Path, position: int) -> None:
    data = bytearray(file.read_bytes())
    data[position] ^= 0x10
    file.write_bytes(data)


def test_flipped_bit_is_found_by_the_checksum_of_its_record(scenario_set: Path):
    record_bytes = record_dtype(SMALL).itemsize
    file = scenario_set / "shard-00001.npy"
    flip_bit(file, file.stat().st_size - record_bytes - 100)  # in the second record of the shard
    opened = ScenarioSet.open(scenario_set)
    assert opened[3].id == "scenario-3"
    for read in (lambda: opened[4], lambda: opened.records([3, 4])):
        with pytest.raises(
            DataError, match=r"shard-00001\.npy: record 1: checksum mismatch.*; copy the file"
        ):
            read()
    for read in (opened.check, lambda: list(opened), lambda: opened[2:], lambda: opened.take([0, 4])):
        with pytest.raises(DataError, match="checksum mismatch"):
            read()
    assert [scenario.id for scenario in opened.take([6, 0, 3])] == ["scenario-6", "scenario-0", "scenario-3"]
    assert ScenarioSet.open(scenario_set, verify=False)[4].id == "scenario-4"


def test_threads_map_each_shard_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Headers that several threads parse at a time raise SystemError on Python 3.11."""
    with ScenarioWriter(tmp_path / "set", SMALL, shard_size=1) as writer:
        for number in range(24):
            writer.add(make_scenario(number))
    parsing, reading = [], store.Shard._read_map

    def read_alone(shard: store.Shard):
        parsing.append(shard)
        assert len(parsing) == 1
        time.sleep(0.001)
        result = reading(shard)
        parsing.pop()
        return result

    monkeypatch.setattr(store.Shard, "_read_map", read_alone)
    ids = [scenario.id for scenario in ScenarioSet.open(tmp_path / "set")]
    assert ids == [f"scenario-{number}" for number in range(24)] and not parsing


def test_single_flipped_bits_are_found(scenario_set: Path):
    """In fields and in the padding between them: a bit in every 97th byte of a record."""
    file = scenario_set / "shard-00002.npy"
    whole = file.read_bytes()
    start = len(whole) - record_dtype(SMALL).itemsize
    for position in range(start, len(whole), 97):
        flip_bit(file, position)
        with pytest.raises(DataError, match=r"checksum mismatch|_id is not|segment is not"):
            ScenarioSet.open(scenario_set)[6]
        file.write_bytes(whole)
    ScenarioSet.open(scenario_set).check()


def test_check_compares_sha256(scenario_set: Path):
    """A record changed together with its CRC passes the CRC of earlier versions, not the manifest."""
    as_earlier_version(scenario_set)
    file = scenario_set / "shard-00002.npy"
    flip_bit(file, file.stat().st_size - 1)
    raw = file.read_bytes()[-record_dtype(SMALL).itemsize :]
    np.save(scenario_set / "shard-00002.crc.npy", np.array([zlib.crc32(raw)], np.uint32))
    opened = ScenarioSet.open(scenario_set)
    assert opened[6].id == "scenario-6"
    with pytest.raises(DataError, match="SHA-256"):
        opened.check()


def test_truncated_shard_is_refused_with_its_record(scenario_set: Path):
    file = scenario_set / "shard-00000.npy"
    file.write_bytes(file.read_bytes()[: -record_dtype(SMALL).itemsize - 1])
    with pytest.raises(
        DataError, match=r"shard-00000\.npy: record 1: shard is truncated.*1 whole records of 3"
    ):
        ScenarioSet.open(scenario_set)


@pytest.mark.parametrize("name", ["shard-00001.npy", "shard-00001.crc.npy"])
def test_missing_shard_is_named(scenario_set: Path, name: str):
    (scenario_set / name).unlink()
    with pytest.raises(DataError, match=f"{name}: shard is missing; restore"):
        ScenarioSet.open(scenario_set)


@pytest.mark.parametrize("name", ["shard-00001.npy", "shard-00001.crc.npy"])
@pytest.mark.parametrize("content", [b"", b"not numpy at all", b"\x93NUMPY\x01\x00\xff\xff"])
def test_damaged_header_is_refused(scenario_set: Path, name: str, content: bytes):
    (as_earlier_version(scenario_set) / name).write_bytes(content)
    with pytest.raises(DataError, match=f"{name}: header is damaged"):
        ScenarioSet.open(scenario_set)[3]


def test_checksums_of_another_shard(scenario_set: Path):
    (scenario_set / "shard-00002.crc.npy").write_bytes((scenario_set / "shard-00001.crc.npy").read_bytes())
    with pytest.raises(DataError, match=r"shard-00002\.crc\.npy: SHA-256 differs .*; copy the whole set"):
        ScenarioSet.open(scenario_set)
    with pytest.raises(DataError, match="checksum file does not fit"):
        ScenarioSet.open(as_earlier_version(scenario_set))[6]


@pytest.mark.parametrize("earlier", [False, True])
def test_larger_checksum_files_are_refused_before_they_are_read(scenario_set: Path, earlier: bool):
    if earlier:
        as_earlier_version(scenario_set)
    with (scenario_set / "shard-00001.crc.npy").open("r+b") as file:
        file.truncate(1 << 30)
    with pytest.raises(DataError, match=r"shard-00001\.crc\.npy: checksum file does not fit"):
        ScenarioSet.open(scenario_set)


def test_sparse_shards_do_not_allow_a_manifest_of_any_size(scenario_set: Path):
    (scenario_set / "seal.json").unlink()
    for name, size in (("shard-00000.npy", 1 << 42), ("manifest.json", 1 << 41)):
        with (scenario_set / name).open("r+b") as file:
            file.truncate(size)
    with pytest.raises(DataError, match=r"manifest\.json: has 2\.2 TB, more than the 67 MB that are read"):
        ScenarioSet.open(scenario_set)


@pytest.mark.parametrize(("blocks", "size"), [(0, 5000), (1, 0)])
def test_manifest_on_disks_that_state_no_blocks(blocks: int, size: int):
    manifest, shard = (
        os.stat_result((0,) * 6 + (5000,) + (0,) * 3, {"st_blocks": number}) for number in (blocks, 0)
    )
    assert manifest_module._size_on_disk(manifest, [shard]) == size


def exchange(first: Path, second: Path) -> None:
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)


@pytest.mark.parametrize("earlier", [False, True])
@pytest.mark.parametrize("suffixes", [(".npy",), (".npy", ".crc.npy")])
def test_exchanged_shards_are_refused_on_open(scenario_set: Path, earlier: bool, suffixes: tuple[str, ...]):
    """With their checksums, each record passes its CRC but stands in another scenario's place."""
    for suffix in suffixes:
        exchange(scenario_set / f"shard-00000{suffix}", scenario_set / f"shard-00001{suffix}")
    if earlier:
        as_earlier_version(scenario_set)
    with pytest.raises(
        DataError, match=r"shard-0000\d\.(npy: record 0: scenario_id is not|crc\.npy: SHA-256)"
    ):
        ScenarioSet.open(scenario_set)


def test_shards_of_another_set_with_the_same_ids_are_refused_on_open(tmp_path: Path, scenario_set: Path):
    with ScenarioWriter(tmp_path / "other", SMALL, shard_size=3) as writer:
        for number in range(7):
            scenario = make_scenario(number)
            scenario.record["agent_z"] += 1.0
            writer.add(scenario)
    for name in ("shard-00001.npy", "shard-00001.crc.npy"):
        (scenario_set / name).write_bytes((tmp_path / "other" / name).read_bytes())
    with pytest.raises(DataError, match=r"shard-00001\.crc\.npy: SHA-256 differs.*another set"):
        ScenarioSet.open(scenario_set)


def test_half_copied_shard_of_full_size_is_refused_on_open(scenario_set: Path):
    file = scenario_set / "shard-00001.npy"
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2].ljust(len(content), b"\0"))
    with pytest.raises(DataError, match=r"record 2: scenario_id is not 'scenario-5'.*half copied"):
        ScenarioSet.open(scenario_set)


def test_reordered_entries_are_found(scenario_set: Path):
    manifest = json.loads((scenario_set / "manifest.json").read_text())
    entries = manifest["scenarios"]
    entries[3], entries[4] = entries[4], entries[3]
    edit_manifest(scenario_set, scenarios=entries)
    with pytest.raises(DataError, match="record 0: scenario_id is not 'scenario-4'"):
        ScenarioSet.open(scenario_set)


def test_reordered_entries_within_a_shard_of_an_earlier_version_are_found_when_read(scenario_set: Path):
    entries = json.loads((scenario_set / "manifest.json").read_text())["scenarios"]
    edit_manifest(
        scenario_set, scenarios=[*entries[:3], entries[3], {**entries[4], "segment": "x"}, *entries[5:]]
    )
    opened = ScenarioSet.open(as_earlier_version(scenario_set))
    with pytest.raises(DataError, match="record 1: segment is not 'x', that of the manifest"):
        opened[4]


@pytest.mark.parametrize(
    ("old", "new"), [('"domain": "urban"', '"domain": "rural"'), ('"collision": false', '"collision": true')]
)
def test_changed_tags_and_audit_are_refused_on_open(scenario_set: Path, old: str, new: str):
    file = scenario_set / "manifest.json"
    digest = ScenarioSet.open(scenario_set).hash
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(DataError, match=r"manifest\.json: changed since drivax wrote it; .*--edited"):
        ScenarioSet.open(scenario_set)
    with allow_edited():
        assert ScenarioSet.open(scenario_set).hash == digest and edited_files() == [str(file)]
    assert ScenarioSet.open(as_earlier_version(scenario_set)).hash == digest


def test_shard_of_another_layout_is_refused(scenario_set: Path):
    np.save(scenario_set / "shard-00001.npy", np.zeros(3, np.float32))
    with pytest.raises(DataError, match="layout"):
        ScenarioSet.open(scenario_set)


def test_paths_other_than_sets_are_refused(tmp_path: Path, scenario_set: Path):
    with pytest.raises(DataError, match=r"nowhere: folder not found; name the folder"):
        ScenarioSet.open(tmp_path / "nowhere")
    with pytest.raises(DataError, match="is not a scenario set"):
        ScenarioSet.open(scenario_set / "manifest.json")
    (scenario_set / "manifest.json").unlink()
    with pytest.raises(DataError, match=r"no manifest\.json"):
        ScenarioSet.open(scenario_set)


@pytest.mark.parametrize(
    "content", ["", "{", "[]", "{}", f'{{"schema_version": {SCHEMA_VERSION}}}', "null", "\\x00\\xff"]
)
def test_damaged_manifest_is_refused_with_a_cure(scenario_set: Path, content: str):
    (scenario_set / "seal.json").unlink()
    (scenario_set / "manifest.json").write_text(content)
    with pytest.raises(DataError, match=r"manifest\.json: manifest is damaged.*; convert"):
        ScenarioSet.open(scenario_set)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"schema_version": SCHEMA_VERSION + 1},
            f"schema version {SCHEMA_VERSION + 1}, this drivax reads {SCHEMA_VERSION}; upgrade drivax",
        ),
        ({"schema_version": 1}, f"schema version 1, this drivax reads {SCHEMA_VERSION}; convert or generate"),
        ({"fields": []}, "field table"),
        ({"capacity": {"agnets": 3}}, "manifest is damaged"),
        ({"scenarios": [{"scenario_id": "x"}]}, "manifest is damaged"),
        ({"record_bytes": None}, "record_bytes, drivax_version, source are missing or of another type"),
        ({"source": []}, "record_bytes, drivax_version, source are missing or of another type"),
        ({"shards": [{"file": "shard-00000.npy"}]}, "manifest is damaged"),
        ({"shards": []}, "lists 7 scenarios but its shards contain 0"),
    ],
)
def test_manifest_of_another_kind(scenario_set: Path, changes: dict[str, object], message: str):
    edit_manifest(scenario_set, **changes)
    with pytest.raises(DataError, match=message):
        ScenarioSet.open(scenario_set)


@pytest.mark.parametrize(
    ("name", "value"),
    [("tags", {"domain": 3}), ("flags", [["x"]]), ("source", {"steps": "9"}), ("source", {"steps": 1e99})],
)
def test_entries_of_other_types_are_refused(scenario_set: Path, name: str, value: Any):
    entries = json.loads((scenario_set / "manifest.json").read_text())["scenarios"]
    entries[4][name] = entries[4][name] | value if name == "source" else value
    edit_manifest(scenario_set, scenarios=entries)
    with pytest.raises(DataError, match=r"manifest is damaged \(.*scenario 4 has "):
        ScenarioSet.open(scenario_set)


def test_errors_are_one_line(scenario_set: Path):
    (scenario_set / "seal.json").unlink()
    (scenario_set / "manifest.json").write_text('{\n"a":\n')
    with pytest.raises(DataError) as error:
        ScenarioSet.open(scenario_set)
    file, message = scenario_set / "manifest.json", str(error.value)
    assert message.startswith(f"{file}: manifest is damaged (") and message.endswith(
        f"; {manifest_module.AGAIN}"
    )
    assert "\n" not in message


def test_sets_without_their_seal_are_refused_or_marked(scenario_set: Path):
    (scenario_set / "seal.json").unlink()
    with pytest.raises(DataError, match=r"seal\.json: is missing; restore it, .* --edited"):
        ScenarioSet.open(scenario_set)
    with allow_edited():
        assert len(ScenarioSet.open(scenario_set)) == 7
        assert edited_files() == [str(scenario_set / "seal.json")]
    assert len(ScenarioSet.open(as_earlier_version(scenario_set))) == 7


def test_default_capacity_opens_with_plain_numpy(tmp_path: Path):
    """The header of a full-size record must stay below numpy's limit for untrusted headers."""
    with ScenarioWriter(tmp_path / "set", Capacity()) as writer:
        writer.add(make_scenario(0, Capacity()))
    assert np.load(tmp_path / "set" / "shard-00000.npy", mmap_mode="r").dtype == record_dtype(Capacity())


def test_a_killed_writer_leaves_nothing_under_the_name(tmp_path: Path):
    program = (
        "import os, sys; sys.path.insert(0, sys.argv[2]); import test_store as t\n"
        "w = t.ScenarioWriter(sys.argv[1], t.SMALL, shard_size=1).__enter__()\n"
        "w.add(t.make_scenario(0)); w.add(t.make_scenario(1)); os.kill(os.getpid(), 9)"
    )
    result = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "set"), str(Path(__file__).parent)], check=False
    )
    assert result.returncode == -9
    assert not (tmp_path / "set").exists()


# --- Sets that can be continued.

IDENTITY = {"data": "seven scenarios", "limit": 7}


def continued(path: Path, stop: int | None = None, **options) -> list:
    """Writes seven scenarios in shards of two, beginning where an earlier writer was; fails before ``stop``."""
    options = {"source": {"command": "test"}, "shard_size": 2, "identity": IDENTITY, **options}
    with ScenarioWriter(path, SMALL, **options) as writer:
        first = writer.notes[-1] if writer.notes else 0
        assert len(writer) == first
        for number in range(first, 7):
            if number == stop:
                raise RuntimeError
            assert writer.room == 2 - number % 2
            writer.add(make_scenario(number), note=number + 1)
        return writer.notes


def contents(path: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()
    }


@pytest.mark.parametrize("stops", [(3,), (2, 5), (0, 1, 6, 6)])
def test_a_writer_continues_after_the_last_closed_shard(tmp_path: Path, stops: tuple[int, ...]):
    continued(tmp_path / "whole")
    for stop in stops:
        with pytest.raises(RuntimeError):
            continued(tmp_path / "set", stop)
        assert not (tmp_path / "set").exists()
    assert continued(tmp_path / "set") == [number for number in (2, 4, 6) if number <= max(stops)]
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set", "whole"]


def test_nothing_is_kept_without_a_closed_shard(tmp_path: Path):
    with pytest.raises(RuntimeError):
        continued(tmp_path / "set", stop=1)
    assert list(tmp_path.iterdir()) == []


def test_unfinished_sets_of_another_identity_are_not_continued(tmp_path: Path):
    with pytest.raises(RuntimeError):
        continued(tmp_path / "set", stop=3)
    with pytest.raises(UsageError, match=r"other options \(limit\); .*--overwrite"):
        continued(tmp_path / "set", identity={**IDENTITY, "limit": 8})
    assert can_resume(tmp_path / "set")
    with pytest.raises(RuntimeError):
        continued(tmp_path / "set", stop=1, identity={**IDENTITY, "limit": 8}, overwrite=True)
    assert not can_resume(tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


def test_overwrite_continues_an_unfinished_set_of_the_same_identity(tmp_path: Path):
    continued(tmp_path / "set")
    with pytest.raises(RuntimeError):
        continued(tmp_path / "set", stop=5, overwrite=True)
    assert len(ScenarioSet.open(tmp_path / "set")) == 7  # the old set stays until the new one is whole
    assert continued(tmp_path / "set", overwrite=True) == [2, 4]
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_a_damaged_note_costs_its_shard_only(tmp_path: Path):
    continued(tmp_path / "whole")
    with pytest.raises(RuntimeError):
        continued(tmp_path / "set", stop=5)
    (tmp_path / ".set.partial" / "progress" / "00001.json").write_text('{"shard": ')
    assert continued(tmp_path / "set") == [2]
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")


@pytest.mark.parametrize(
    "changes",
    [{"shard": 1}, {"scenarios": None}, {"scenarios": [{}, {}]}, {"file": "../shard-00001.npy"}, {"count": 2.0}],
)  # fmt: skip
def test_forged_note_costs_its_shard_only(tmp_path: Path, changes: dict):
    with pytest.raises(RuntimeError):
        continued(tmp_path / "set", stop=5)
    note = tmp_path / ".set.partial" / "progress" / "00001.json"
    value = json.loads(note.read_text())["value"]
    (value if changes.keys() <= value.keys() else value["shard"]).update(changes)
    digest = hashlib.sha256(json.dumps([1, value], sort_keys=True).encode()).hexdigest()
    note.write_text(json.dumps({"sha256": digest, "value": value}))
    assert continued(tmp_path / "set") == [2]


@pytest.mark.parametrize("damage", ["flip", "delete", "delete checksums", "truncate", "note counts less"])
def test_damaged_shard_of_an_unfinished_set_is_written_again(tmp_path: Path, damage: str):
    continued(tmp_path / "whole")
    with pytest.raises(RuntimeError):
        continued(tmp_path / "set", stop=6)
    shard = tmp_path / ".set.partial" / "content" / "shard-00001.npy"
    if damage == "flip":
        flip_bit(shard, shard.stat().st_size - 100)
    elif damage == "truncate":
        shard.write_bytes(shard.read_bytes()[:-4096])
    elif damage.startswith("delete"):
        shard.with_suffix(".crc.npy" if "checksums" in damage else ".npy").unlink()
    else:
        note = tmp_path / ".set.partial" / "progress" / "00001.json"
        note.write_text(note.read_text().replace('"count": 2', '"count": 1'))
    assert continued(tmp_path / "set") == [2]
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")


def test_set_of_a_writer_killed_between_renames_opens(scenario_set: Path):
    hidden = scenario_set.parent / ".set.partial"
    hidden.mkdir()
    scenario_set.rename(hidden / "old")
    assert len(ScenarioSet.open(scenario_set)) == 7
    with pytest.raises(UsageError, match="already exists"):
        ScenarioWriter(scenario_set, SMALL)


def test_symbolic_link_to_a_set_is_followed(tmp_path: Path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "set").symlink_to(tmp_path / "disk" / "set")
    for number in range(2):
        with ScenarioWriter(tmp_path / "set", SMALL, overwrite=True) as writer:
            writer.add(make_scenario(number))
    assert (tmp_path / "set").is_symlink()
    assert [scenario.id for scenario in ScenarioSet.open(tmp_path / "disk" / "set")] == ["scenario-1"]


def test_two_writers_at_once_are_refused(tmp_path: Path):
    with ScenarioWriter(tmp_path / "set", SMALL, identity=IDENTITY) as writer:
        writer.add(make_scenario(0))
        with (
            pytest.raises(UsageError, match="another process is writing it; wait"),
            ScenarioWriter(tmp_path / "set", SMALL, identity=IDENTITY),
        ):
            pass
    assert len(ScenarioSet.open(tmp_path / "set")) == 1


@pytest.mark.parametrize("adds", [1, 3, 6, 7])
def test_a_killed_writer_is_continued_to_the_same_bytes(tmp_path: Path, adds: int):
    continued(tmp_path / "whole")
    program = (
        "import os, sys; sys.path.insert(0, sys.argv[2]); import test_store as t\n"
        "from pathlib import Path\n"
        "make, count = t.make_scenario, 0\n"
        "def counted(number):\n"
        "    global count\n"
        f"    if count == {adds}: os.kill(os.getpid(), 9)\n"
        "    count += 1\n"
        "    return make(number)\n"
        "t.make_scenario = counted\n"
        "publish = t.ScenarioWriter._finish\n"
        f"t.ScenarioWriter._finish = lambda w: os.kill(os.getpid(), 9) if {adds} == 7 else publish(w)\n"
        "t.continued(Path(sys.argv[1]))"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "set"), str(Path(__file__).parent)]
    assert subprocess.run(command, check=False).returncode == -9
    assert not (tmp_path / "set").exists()
    assert continued(tmp_path / "set") == [number for number in (2, 4, 6) if number <= adds]
    assert contents(tmp_path / "set") == contents(tmp_path / "whole")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["set", "whole"]


def test_sets_of_several_lengths_are_refused_in_one_command(scenario_set: Path, tmp_path: Path):
    longer = replace(SMALL, steps=SMALL.steps + 1)
    with ScenarioWriter(tmp_path / "longer", longer) as writer:
        writer.add(make_scenario(0, longer))
    first, second = ScenarioSet.open(scenario_set), ScenarioSet.open(tmp_path / "longer")
    check_lengths(first, first)
    problem = rf"longer: has scenarios of {longer.steps} steps, .*set of {SMALL.steps}; convert both with"
    with pytest.raises(UsageError, match=problem):
        check_lengths(first, first, second)
