"""``drivax export``: selection, files, and clean failures."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from drivax import cli
from drivax.datasets.export import writer as exports
from drivax.datasets.export.writer import NOTE, Export, export
from drivax.datasets.formats import survey
from drivax.errors import DataError, UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CAPACITIES
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from scenario.recordings import driving, make_recording, make_tracks


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Five scenarios of two data sets; two share an id; speeds 4, 5, ... 8 m/s."""
    path = tmp_path_factory.mktemp("sets") / "five"
    names = [("a", "one"), ("b", "one"), ("c", "one"), ("a", "two"), ("d", "two")]
    with ScenarioWriter(path, CAPACITIES["default"], {"command": "test"}, shard_size=2) as writer:
        for number, (scenario_id, dataset) in enumerate(names):
            recording = make_recording(
                tracks=make_tracks([driving(4.0 + number)]), scenario_id=scenario_id, dataset=dataset
            )
            scenario = assemble(recording)
            writer.add(replace(scenario, audit={"distance_m": 8.0 * (4 + number), "clean": number != 1}))
    return path


def ids(path) -> list[tuple[str, str]]:
    return [(entry["dataset"], entry["scenario_id"]) for entry in ScenarioSet.open(path).entries]


def listing(path) -> list[str]:
    return sorted(inside.name for inside in path.iterdir())


def test_exported_set_is_equal_bit_for_bit(stored, tmp_path):
    whole, part = ScenarioSet.open(stored), tmp_path / "part"
    done = export(stored, part, Export(filters=("audit.clean=true", "dataset=one")))
    again = ScenarioSet.open(part)
    again.check()
    assert (done.scenarios, done.files, done.lost) == (2, 1, {})
    assert ids(part) == [("one", "a"), ("one", "c")]
    for new, old in ((0, 0), (1, 2)):
        assert again.records([new]).tobytes() == whole.records([old]).tobytes()
        assert again.entries[new] == whole.entries[old]
    assert again.manifest["source"]["part_of"] == {"set": "five", "hash": whole.hash}
    assert listing(tmp_path) == ["part"]


def test_export_of_all_scenarios_keeps_the_data(stored, tmp_path):
    export(stored, tmp_path / "all")
    np.testing.assert_array_equal(
        ScenarioSet.open(tmp_path / "all").records(range(5)), ScenarioSet.open(stored).records(range(5))
    )


@pytest.mark.parametrize(
    ("text", "expected_ids"),
    [
        ("d\nb\n", [("one", "b"), ("two", "d")]),  # in the order of the set
        ("a\n", [("one", "a"), ("two", "a")]),
        ("two\ta\r\n\n  \n", [("two", "a")]),
        ("a\ntwo\ta\n", [("one", "a"), ("two", "a")]),
    ],
)
def test_ids_file_selects_scenarios(stored, tmp_path, text, expected_ids):
    (tmp_path / "ids.txt").write_text(text)
    export(stored, tmp_path / "part", Export(ids=tmp_path / "ids.txt"))
    assert ids(tmp_path / "part") == expected_ids


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a\nzz\nyy\n", "'zz' (line 2), 'yy' are"),
        ("two\tb\n", "'two / b' (line 1) is"),
        (b"\xff\xfe", "is not text"),
    ],
)
def test_ids_that_are_unknown(stored, tmp_path, text, said):
    file = tmp_path / "ids.txt"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DataError, match=re.escape(said)) as raised:
        export(stored, tmp_path / "part", Export(ids=file))
    assert raised.value.file == file and raised.value.cure
    assert listing(tmp_path) == ["ids.txt"]
    with pytest.raises(DataError, match="file not found"):
        export(stored, tmp_path / "part", Export(ids=tmp_path / "none"))


def test_filters_ids_and_limit_together(stored, tmp_path):
    (tmp_path / "ids.txt").write_text("a\nc\nd\n")
    options = Export(filters=("audit.distance_m>32",), ids=tmp_path / "ids.txt", limit=2)
    export(stored, tmp_path / "part", options)
    assert ids(tmp_path / "part") == [("one", "c"), ("two", "a")]


def test_export_without_selected_scenarios_is_refused(stored, tmp_path):
    for name in ("set", "tfexample", "gpudrive"):
        with pytest.raises(DataError, match="no scenario is selected"):
            export(stored, tmp_path / "part", Export(format=name, filters=("audit.distance_m>1000",)))
    assert listing(tmp_path) == []


def test_tfrecord_shards_have_the_names_and_sizes_of_womd(stored, tmp_path):
    calls = []
    options = Export(format="tfexample", shard_size=2)
    done = export(stored, tmp_path / "turns", options, lambda *call: calls.append(call))
    shards = [f"turns.tfrecord-{number:05d}-of-00003" for number in range(3)]
    assert listing(tmp_path / "turns") == [NOTE, *shards]
    assert (done.scenarios, done.files) == (5, 3) and calls == [(number, 5) for number in range(1, 6)]
    found = survey(tmp_path / "turns")
    assert found.formats == {"womd-example": 3} and (found.ignored, found.companions) == (0, 1)
    note = json.loads((tmp_path / "turns" / NOTE).read_text())
    assert note["format"] == "tfexample" and note["set"]["hash"] == ScenarioSet.open(stored).hash
    assert [(row["scenario_id"], row["file"]) for row in note["scenarios"]] == list(
        zip("abcad", np.repeat(shards, 2)[:5].tolist(), strict=True)
    )
    assert note["scenarios"][4] == {
        "scenario_id": "d", "dataset": "two", "segment": "hand-made", "file": shards[2]
    }  # fmt: skip


def test_gpudrive_export_writes_a_file_per_scenario(stored, tmp_path):
    done = export(stored, tmp_path / "json", Export(format="gpudrive", limit=2))
    names = ["tfrecord-00000-of-00001_0.json", "tfrecord-00000-of-00001_1.json"]
    assert listing(tmp_path / "json") == [NOTE, *names] and done.files == 2
    assert survey(tmp_path / "json").formats == {"gpudrive": 2}
    assert json.loads((tmp_path / "json" / names[1]).read_text())["name"] == names[1]


def test_export_is_deterministic(stored, tmp_path):
    for name in ("set", "tfexample", "gpudrive"):
        digests = []
        for folder in ("x", "y"):
            out = tmp_path / folder / name
            export(stored, out, Export(format=name, limit=1))
            digests.append({f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in out.iterdir()})
        assert digests[0] == digests[1]


@pytest.mark.parametrize("name", ["tfexample", "gpudrive", "set"])
def test_only_exports_are_overwritten_and_only_on_request(stored, tmp_path, name):
    options = Export(format=name, limit=1)
    export(stored, tmp_path / "out", options)
    before = listing(tmp_path / "out")
    with pytest.raises(UsageError, match="already exists"):
        export(stored, tmp_path / "out", options)
    export(stored, tmp_path / "out", replace(options, overwrite=True))
    assert listing(tmp_path / "out") == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("three years")
    with pytest.raises(UsageError, match="exists and is no"):
        export(stored, tmp_path / "mine", replace(options, overwrite=True))
    assert listing(tmp_path) == ["mine", "out"]


def test_a_set_cannot_replace_itself(stored):
    with pytest.raises(UsageError, match="is the input set"):
        export(stored, stored, Export(overwrite=True))
    assert len(ScenarioSet.open(stored)) == 5


@pytest.mark.parametrize("name", ["tfexample", "gpudrive", "set"])
def test_failed_export_leaves_nothing(stored, tmp_path, name):
    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(stored, tmp_path / "out", Export(format=name), stop)
    assert listing(tmp_path) == []


def test_damaged_record_is_reported(stored, tmp_path):
    export(stored, tmp_path / "copy")
    shard = tmp_path / "copy" / "shard-00000.npy"
    data = bytearray(shard.read_bytes())
    data[-100] ^= 1
    shard.write_bytes(data)
    # In a process of its own: checks of types at run time read a scenario of every set that they see.
    command = [
        sys.executable,
        "-m",
        "drivax",
        "export",
        tmp_path / "copy",
        tmp_path / "out",
        "--format",
        "gpudrive",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stdout == ""
    assert "shard-00000.npy: record 4: checksum mismatch" in done.stderr.splitlines()[-1]
    assert listing(tmp_path) == ["copy"]


@pytest.mark.parametrize("options", [Export(limit=0), Export(shard_size=0)])
def test_invalid_options_are_refused(stored, tmp_path, options):
    with pytest.raises(UsageError, match="is 0"):
        export(stored, tmp_path / "out", options)


@pytest.mark.parametrize("name", ["format", "paths"])
def test_unknown_choices_are_refused(stored, tmp_path, name):
    options = Export("tfexample")
    object.__setattr__(options, name, "json")  # the type checker of the tests would refuse it first
    with pytest.raises(UsageError, match="use one of"):
        export(stored, tmp_path / "out", options)


def test_command_exports_selected_scenarios(stored, tmp_path, capsys):
    (tmp_path / "ids.txt").write_text("one\ta\nb\nc\nd\n")
    command = ["export", str(stored), str(tmp_path / "out"), "--ids", str(tmp_path / "ids.txt")]
    more = ["--filter", "dataset=one", "--filter", "audit.clean=true"]
    assert cli.main([*command, *more]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'out'}: 2 scenarios in 1 file\n"
    assert ids(tmp_path / "out") == [("one", "a"), ("one", "c")]
    assert cli.main([*command, *more]) == 2
    assert "--overwrite" in capsys.readouterr().err
    command[2] = str(tmp_path / "ex")
    assert cli.main([*command, "--format", "tfexample", "--paths", "published", "--shard-size", "1"]) == 0
    assert "4 scenarios in 4 files" in capsys.readouterr().out


def test_command_reports_losses(stored, tmp_path, capsys, monkeypatch):
    def crowded(scenario, paths):
        features, lost = real(scenario, paths)
        return features, lost + type(lost)(agents=3)

    real = exports.tf_example
    monkeypatch.setattr(exports, "tf_example", crowded)
    assert (
        cli.main(["export", str(stored), str(tmp_path / "out"), "--format", "tfexample", "--limit", "2"]) == 0
    )
    assert "no room for 6 agents" in capsys.readouterr().out
    assert json.loads((tmp_path / "out" / NOTE).read_text())["lost"] == {"agents": 6}
