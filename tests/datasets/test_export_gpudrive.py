"""Exported GPUDrive JSON, and round trips through drivax's own reader."""

from __future__ import annotations

import json

import numpy as np
import pytest

from datasets.samples import womd_scenario
from datasets.test_export_recording import assert_same_map
from drivax.datasets import gpudrive
from drivax.datasets.export.recording import restore
from drivax.datasets.gpudrive import file_name, gpudrive_content
from drivax.datasets.womd import scenario_reader as protos
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import AgentKind, Flag, RoadKind
from scenario.recordings import FAR, driving, light, make_recording, make_tracks, moved


@pytest.fixture(scope="module")
def source():
    return protos.WomdScenario().decode(womd_scenario.scenario())


@pytest.fixture(scope="module")
def content(source):
    """The content of the file after a round trip through strict JSON text."""
    text = json.dumps(gpudrive_content(assemble(source), "x.json"), allow_nan=False)
    return json.loads(text)


def test_keys_are_those_of_the_published_files(content):
    assert list(content) == ["name", "scenario_id", "objects", "roads", "tl_states", "metadata"]
    assert set(content["metadata"]) == {"sdc_track_index", "objects_of_interest", "tracks_to_predict"}
    for thing in content["objects"]:
        assert set(thing) == {
            "position", "width", "length", "height", "heading", "velocity", "valid", "goalPosition", "type", "id",
            "mark_as_expert",
        }  # fmt: skip
    for road in content["roads"]:
        assert set(road) == {"geometry", "type", "map_element_id", "id"}
    assert (content["name"], content["scenario_id"]) == ("x.json", "0123456789abcdef")


def test_objects_end_with_ego_and_keep_their_states(content, source):
    assert [thing["id"] for thing in content["objects"]] == [17, 900, 2406]  # the ego last
    assert [thing["type"] for thing in content["objects"]] == ["cyclist", "pedestrian", "vehicle"]
    assert content["metadata"] == {
        "sdc_track_index": 2,
        "objects_of_interest": [2406, 17],
        "tracks_to_predict": [{"track_index": 0, "difficulty": 0}],
    }
    bike, track = content["objects"][0], source.tracks
    assert bike["valid"] == track.valid[1].tolist()
    for step in (0, 1, 2, 59, 60):
        x, y = track.xy[1, step] if track.valid[1, step] else (-10_000.0, -10_000.0)
        assert bike["position"][step]["x"] == pytest.approx(x, abs=1e-4)
        assert bike["position"][step]["y"] == pytest.approx(y, abs=1e-4)
    assert bike["heading"][1] == -10_000.0 and bike["velocity"][1] == {"x": -10_000.0, "y": -10_000.0}
    assert bike["velocity"][0] == {"x": 4.0, "y": 0.25}
    assert (bike["length"], bike["width"]) == (pytest.approx(1.8), pytest.approx(0.7))
    last = np.flatnonzero(track.valid[1])[-1]
    assert bike["goalPosition"]["x"] == pytest.approx(track.xy[1, last, 0], abs=1e-4)


def test_roads_and_lights(content):
    codes = {road["id"]: (road["type"], road["map_element_id"]) for road in content["roads"]}
    assert codes[1] == ("lane", 2) and codes[4] == ("lane", 1) and codes[5] == ("road_line", 6)
    assert codes[7] == ("road_edge", 15) and codes[8] == ("road_edge", 16)
    assert (
        codes[10] == ("crosswalk", 18) and codes[11] == ("speed_bump", 19) and codes[12] == ("driveway", 20)
    )
    assert len(codes) == len(content["roads"]) == 11  # ids are unique
    assert content["tl_states"].keys() == {"2", "4"}
    states = content["tl_states"]["4"]
    assert states["time_index"] == list(range(20, 91)) and set(states["state"]) == {"arrow_stop"}
    assert states["x"] == [pytest.approx(womd_scenario.X0 - 60, abs=1e-3)] * 71
    assert content["tl_states"]["2"]["state"] == ["stop"] * 50 + ["go"] * 41


def test_of_two_lights_of_a_lane_the_nearest_to_the_log_is_written():
    lights = light(1, 120.0, 0.0, [6] * 91), light(1, 50.0, 0.0, [4] * 91)
    stored = assemble(make_recording(lights=lights))
    assert [one.lane_id for one in restore(stored).lights] == [1, 1]
    assert gpudrive_content(stored, "x.json")["tl_states"]["1"]["state"] == ["stop"] * 91


def test_file_names_have_the_prefix_that_the_loader_expects():
    assert file_name(12) == "tfrecord-00000-of-00001_12.json"


def round_trip(recording):
    stored = assemble(recording)
    back = gpudrive.decode(json.loads(json.dumps(gpudrive_content(stored, "x.json"))))
    kept = restore(stored)
    rows = [kept.tracks.track_id.tolist().index(number) for number in back.tracks.track_id]
    assert sorted(rows) == list(range(len(kept.tracks.kind)))
    assert rows[back.ego] == 0 and back.scenario_id == recording.scenario_id
    assert sorted(rows[row] for row in back.to_predict) == sorted(kept.to_predict)
    assert sorted(rows[row] for row in back.of_interest) == sorted(kept.of_interest)
    np.testing.assert_array_equal(back.tracks.valid, kept.tracks.valid[rows])
    for name in ("xy", "z", "heading", "velocity", "size"):
        np.testing.assert_allclose(
            getattr(back.tracks, name), getattr(kept.tracks, name)[rows], atol=1e-4, rtol=0
        )
    assert {one.lane_id: one.states.tolist() for one in back.lights} == {
        one.lane_id: one.states.tolist() for one in kept.lights
    }
    assert_same_map(back, kept, 0.001)
    assert {f.feature_id: f.kind for f in back.features} == {f.feature_id: f.kind for f in kept.features}
    return stored, back


def test_map_and_valid_steps_survive_a_round_trip(source):
    stored, back = round_trip(source)
    assert_same_map(back, source, 0.1)
    again = assemble(back)
    np.testing.assert_array_equal(again.agent_valid, stored.agent_valid)
    assert Flag.CHAINED_GRAPH in again.has


def test_far_from_the_origin_and_cones():
    tracks = make_tracks(
        [driving(), np.tile((20.0, 2.0), (91, 1))], kind=[AgentKind.VEHICLE, AgentKind.STATIC]
    )
    recording = moved(make_recording(tracks=tracks), FAR)
    _, back = round_trip(recording)  # float64 all the way
    assert back.tracks.kind.tolist() == [AgentKind.OTHER, AgentKind.VEHICLE]


def test_round_trip_of_real_files(real_data):
    for path in sorted((real_data / "gpudrive").glob("*.json")):
        (source,) = gpudrive.GpuDrive().read(path)
        _, back = round_trip(source)
        assert_same_map(back, source, 0.1)
    (source,) = protos.WomdScenario().read(real_data / "womd" / "motion_data_one_scenario.tfrecord")
    _, back = round_trip(source)
    assert len(back.tracks.kind) == 83 and len(back.lights) == 12
    assert sum(feature.kind == RoadKind.STOP_SIGN for feature in back.features) == 8
