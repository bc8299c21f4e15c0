"""From real files to a set and its counts, through the program as a user starts it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from drivax.scenario.schema import Flag
from drivax.scenario.store import ScenarioSet

#: Counted by an independent reader (shared/data/README.md).
COUNTS = {
    "637f20cafde22ff8": {
        "steps": 91, "tracks": 83, "tracks_valid_now": 50, "map_points": 19_636, "lights": 12,
        "map_features": {
            "lane": 199, "road_line": 59, "road_edge": 28, "crosswalk": 4, "speed_bump": 3, "stop_sign": 8,
            "driveway": 0,
        },
    },
    "a3bb37c25ce56418": {"steps": 91, "tracks": 128, "tracks_valid_now": 73, "map_points": 20_000, "lights": 21},
}  # fmt: skip


def drivax(*arguments) -> str:
    command = [sys.executable, "-m", "drivax", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def converted(real_data, tmp_path_factory):
    out = tmp_path_factory.mktemp("real") / "set"
    said = drivax("convert", real_data / "womd", out)
    assert ": 2 scenarios from 2 files" in said and "0 records skipped" in said
    return out


def test_counts_are_those_of_the_source(converted):
    scenarios = {s["scenario_id"]: s for s in json.loads(drivax("inspect", converted, "--json"))["scenarios"]}
    assert set(scenarios) == set(COUNTS)
    for name, counts in COUNTS.items():
        assert {key: scenarios[name][key] for key in counts} == counts
    assert sum(scenarios["a3bb37c25ce56418"]["map_features"].values()) == 254


def test_flags_tell_what_the_format_lacks(converted):
    by_id = {scenario.id: scenario for scenario in ScenarioSet.open(converted)}
    proto, example = by_id["637f20cafde22ff8"].has, by_id["a3bb37c25ce56418"].has
    assert Flag.SPEED_LIMITS in proto and Flag.LANE_GRAPH in proto and Flag.CHAINED_GRAPH not in proto
    assert Flag.TRUNCATED_MAP in example and Flag.SPEED_LIMITS not in example
    assert Flag.LIGHTS in proto & example and Flag.NO_FUTURE not in proto | example


def test_every_track_of_the_proto_file_is_placed(converted):
    scenario = next(s for s in ScenarioSet.open(converted) if s.id == "637f20cafde22ff8")
    placed = int(scenario.agent_valid.any(axis=0).sum() + scenario.parked_valid.any(axis=0).sum())
    assert placed == 83
    now = int(scenario.agent_valid[10].sum() + scenario.parked_valid[10].sum())
    assert now == 50


#: Files by format, and the scenarios that they become (windows of 91 steps every 40).
FORMATS = {
    "av2-motion": (1, 1), "av2-sensor": (1, 2), "gpudrive": (2, 2), "scenarionet": (8, 18), "womd-example": (1, 1),
    "womd-scenario": (1, 1),
}  # fmt: skip


#: The folders of real files that ``FORMATS`` counts.
FOLDERS = (
    "av2", "av2_sensor", "gpudrive", "scenarionet", "scenarionet_first", "scenarionet_unitraj", "womd",
)  # fmt: skip


@pytest.fixture(scope="module")
def files(real_data, tmp_path_factory):
    """A folder with links to the files of ``FOLDERS``."""
    links = tmp_path_factory.mktemp("files")
    for name in FOLDERS:
        shutil.copytree(
            real_data / name, links / name, copy_function=lambda file, link: Path(link).symlink_to(file)
        )
    return links


@pytest.fixture(scope="module")
def everything(files, tmp_path_factory):
    out = tmp_path_factory.mktemp("real") / "set"
    return out, drivax("convert", files, out, "--split", "60/20/20")


def test_folder_of_all_real_files(everything):
    out, said = everything
    found = ", ".join(
        f"{name} ({files} file{'s'[: files > 1]})" for name, (files, _) in sorted(FORMATS.items())
    )
    assert said.startswith(f"found {found}: about 25 scenarios, 1")
    assert ": 25 scenarios from 14 files in " in said and "0 records skipped" in said
    entries = ScenarioSet.open(out).entries
    assert Counter(entry["tags"]["source_format"] for entry in entries) == {
        name: scenarios for name, (_, scenarios) in FORMATS.items()
    }
    ScenarioSet.open(out).check()


def test_windows_of_a_recording_share_a_split(everything):
    out, _ = everything
    entries = {
        (entry["dataset"], entry["scenario_id"]): entry["segment"] for entry in ScenarioSet.open(out).entries
    }
    splits = {}
    for name in ("train", "validation", "test"):
        for line in (out / "splits" / f"{name}.txt").read_text().splitlines():
            segment = entries.pop(tuple(line.split("\t")))
            assert splits.setdefault(segment, name) == name
    assert not entries and len(splits) == 13


def test_egos_of_all_files_are_clean(everything):
    """No recorded ego collides, leaves the road or runs a red light."""
    judged = [e for e in ScenarioSet.open(everything[0]).entries if "NO_FUTURE" not in e["flags"]]
    assert len(judged) >= 22
    assert [e["scenario_id"] for e in judged if e["audit"]["clean"] is not True] == []


#: Windows of two scenes of nuScenes: tokens of an agent and of a keyframe follow the scene's name.
WINDOWS = {
    "scene-0103_045cd82a77a1472499e8c15100cb5ff3_0a0d6b8c2e884134a3b48df43d54c36a": "scene-0103",
    "scene-0103_045cd82a77a1472499e8c15100cb5ff3_0af0feb5b1394b928dd13d648de898f5": "scene-0103",
    "scene-0916_8a26f7d33ff04b1a8c8679f8c4a7da91_048a45dd2cf54aa5808d8ccc85731d44": "scene-0916",
}


def test_ids_of_76_bytes_are_shown_selected_and_exported(everything, tmp_path):
    out, _ = everything
    shown = json.loads(
        drivax("inspect", out, "--json", "--no-check", "--filter", "segment=scene-0103|scene-0916")
    )
    assert {s["scenario_id"]: s["segment"] for s in shown["scenarios"]} == WINDOWS
    # Their origins are positions in the maps of Boston and Singapore, not near zero as in the files.
    assert all(min(s["origin"][:2]) > 600 for s in shown["scenarios"])
    name = next(iter(WINDOWS))
    drivax("export", out, tmp_path / "json", "--format", "gpudrive", "--filter", f"scenario_id={name}")
    (file,) = (tmp_path / "json").glob("tfrecord-*.json")
    scene = json.loads(file.read_text())
    assert scene["scenario_id"] == name
    ego, (origin,) = (
        scene["objects"][-1],
        [s["origin"] for s in shown["scenarios"] if s["scenario_id"] == name],
    )
    assert [ego["position"][10][axis] for axis in "xyz"] == pytest.approx(origin, abs=1e-3)


def test_first_form_has_its_crossings_and_bumps(everything):
    entries = [e for e in ScenarioSet.open(everything[0]).entries if e["segment"] == "6f85f27e0243fc10"]
    assert len(entries) == 3
    for entry in entries:
        kinds = entry["source"]["map_features"]
        assert (kinds["crosswalk"], kinds["speed_bump"], kinds["stop_sign"]) == (7, 4, 7)
        assert entry["source"]["tracks"] == 75 and entry["audit"]["default_sizes"] is False


def test_doctor_agrees_with_conversion(files):
    said = " ".join(drivax("doctor", files).split())
    assert "about 25 scenarios" in said and "missing" not in said
    for name, (count, _) in FORMATS.items():
        assert f"format {name}: " in said and count


@pytest.mark.slow
def test_filters_of_the_command_line(real_data, tmp_path):
    said = drivax(
        "convert", real_data / "scenarionet", tmp_path / "set", "--filter", "dataset=nuscenes", "--limit", "2"
    )
    assert ": 2 scenarios from " in said
    assert {entry["dataset"] for entry in ScenarioSet.open(tmp_path / "set").entries} == {"nuscenes"}
