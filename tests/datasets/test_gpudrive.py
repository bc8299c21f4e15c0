"""The GPUDrive reader: content, refused files, and real files."""

from __future__ import annotations

import copy
import json
import math

import numpy as np
import pytest

from datasets.samples import gpudrive as sample
from drivax.datasets.gpudrive import GpuDrive, decode
from drivax.datasets.reader import BadRecord, Reader
from drivax.errors import DataError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Recording
from drivax.scenario.schema import AgentKind, Flag, LightState, RoadKind


@pytest.fixture
def content():
    return sample.content()


def read(path) -> Recording:
    (recording,) = GpuDrive().read(path)
    assert isinstance(recording, Recording), recording
    return recording


def test_tracks_equal_the_objects_of_the_file(tmp_path):
    recording = read(sample.write(tmp_path))
    tracks = recording.tracks
    assert isinstance(GpuDrive(), Reader)
    assert (recording.scenario_id, recording.dataset) == ("ef3a8f65142f41ac", "womd")
    assert recording.tags == {"source_format": "gpudrive"}
    assert tracks.track_id.tolist() == [78, 3, 41, 2406]
    assert tracks.kind.tolist() == [
        AgentKind.VEHICLE,
        AgentKind.PEDESTRIAN,
        AgentKind.CYCLIST,
        AgentKind.VEHICLE,
    ]
    np.testing.assert_allclose(tracks.xy[3, 30], (sample.X0 + 10.0, sample.Y0))
    np.testing.assert_allclose(tracks.z[3], sample.Z0 + 2.33 / 2)
    np.testing.assert_allclose(tracks.velocity[0, 0], (-4.0, 0.0))
    np.testing.assert_allclose(tracks.size[3, 5], (5.286, 2.332, 2.33))
    assert tracks.valid[0].sum() == 85 and not tracks.valid[0, 30:36].any() and not tracks.valid[2, 60:].any()
    np.testing.assert_allclose(recording.timestamps_s, np.arange(91) * 0.1)
    assert recording.current_step == 10


def test_headings_are_wrapped(content):
    content["objects"][3]["heading"] = [7 * math.pi / 2] * 91
    np.testing.assert_allclose(decode(content).tracks.heading[3], -math.pi / 2)


def test_invalid_steps_stay_empty(content):
    tracks = decode(content).tracks
    for values in (tracks.xy, tracks.z, tracks.heading, tracks.velocity, tracks.size):
        assert not values[~tracks.valid].any()  # -10000 in the file


def test_steps_without_a_position_are_invalid(content):
    content["objects"][0]["valid"] = [True] * 91
    assert not decode(content).tracks.valid[0, 30:36].any()


def test_prediction_marks_are_rows_and_interest_marks_are_ids(content):
    recording = decode(content)
    assert recording.ego == 3
    assert recording.to_predict == (0,)  # rows in the file
    assert recording.of_interest == (2, 3)  # ids 41 and 2406 in the file
    stored = assemble(recording)
    assert stored.agent_id[0] == 2406


def test_road_elements_become_map_features(content):
    recording = decode(content)
    kinds = {feature.feature_id: feature.kind for feature in recording.features}
    assert kinds == {
        1: RoadKind.LANE_SURFACE, 2: RoadKind.LANE_SURFACE, 5: RoadKind.LANE_FREEWAY,
        7: RoadKind.LINE_SOLID_SINGLE_YELLOW, 8: RoadKind.EDGE_BOUNDARY, 9: RoadKind.EDGE_MEDIAN,
        11: RoadKind.CROSSWALK, 12: RoadKind.SPEED_BUMP, 13: RoadKind.DRIVEWAY, 14: RoadKind.STOP_SIGN,
    }  # fmt: skip
    first = recording.features[0].points
    np.testing.assert_allclose(first[[0, -1]], [(sample.X0 + x, sample.Y0, sample.Z0) for x in (-20, 20)])
    assert all(feature.limit_mps is None for feature in recording.features)


@pytest.mark.parametrize(
    ("code", "word", "kind"),
    [
        (-1, "driveway", RoadKind.DRIVEWAY),  # older files have no code for them
        (None, "lane", RoadKind.LANE_UNDEFINED),
        (4, "road_edge", RoadKind.EDGE_UNKNOWN),
        (13, "road_line", RoadKind.LINE_PASSING_DOUBLE_YELLOW),
        ("2", "road_line", RoadKind.LINE_UNKNOWN),
    ],
)
def test_road_codes_become_feature_kinds(content, code, word, kind):
    content["roads"][0] |= {"map_element_id": code, "type": word}
    assert decode(content).features[0].kind == kind


def test_unknown_and_one_point_roads_are_counted(content):
    content["roads"][0] |= {"map_element_id": 99, "type": "runway"}
    content["roads"][3]["geometry"] = content["roads"][3]["geometry"][:1]
    recording = decode(content)
    assert recording.lost == {"unknown_roads": 1, "one_point_features": 1}
    assert len(recording.features) == 9


def test_lanes_without_links_are_chained_and_flagged(content):
    stored = assemble(decode(content))
    lanes = stored.lane_id.tolist()
    first, second = lanes.index(1), lanes.index(2)
    assert stored.lane_successor[first].tolist() == [second, -1, -1, -1]
    assert {Flag.LANE_GRAPH, Flag.CHAINED_GRAPH, Flag.ROUTE} <= set(stored.has)
    assert Flag.SPEED_LIMITS not in stored.has


def test_jumps_split_dense_polylines_only(content):
    edge = content["roads"][4]["geometry"]
    del edge[40:60]
    assert decode(content).split_gap_m == 1.0
    assert 8 not in assemble(decode(content)).feature_id[assemble(decode(content)).feature_closed]
    assert (assemble(decode(content)).feature_id == 8).sum() == 2
    for road in content["roads"][:6]:
        road["geometry"] = road["geometry"][::8]
    assert decode(content).split_gap_m is None  # points 4 m apart are thinned lines, not jumps
    assert (assemble(decode(content)).feature_id == 8).sum() == 1


def test_only_a_map_with_thinned_lines_is_called_thinned(tmp_path):
    thinned = [dict(road, geometry=road["geometry"][::8]) for road in sample.roads()[:6]]
    for number, (roads, is_thinned) in enumerate(((sample.roads(), False), (thinned, True), ([], False))):
        (tmp_path / str(number)).mkdir()
        notes = GpuDrive().describe(sample.write(tmp_path / str(number), roads=roads)).notes
        assert any("thinned" in note for note in notes) == is_thinned


def test_implausible_sizes_become_those_of_the_class(content):
    content["objects"][0] |= {"length": 0.0, "width": 1e-300, "height": 1e9}
    stored = assemble(decode(content))
    row = stored.agent_id.tolist().index(78)
    np.testing.assert_allclose(stored.agent_size[row], (4.1, 1.9, 1.6))
    assert Flag.DEFAULT_SIZES in stored.has
    assert stored.source.lost["implausible_sizes"] == 1


@pytest.mark.parametrize("value", [0, -4.5, 1e6, 1e-9, math.nan, math.inf])
def test_implausible_sizes_are_counted(content, value):
    assert "implausible_sizes" not in decode(content).lost
    content["objects"][0]["width"] = content["objects"][2]["length"] = value
    recording = decode(content)
    assert recording.lost["implausible_sizes"] == 2
    assert not recording.tracks.size[0, :, 1].any() and not recording.tracks.size[2, :, 0].any()
    for row in content["objects"]:
        del row["height"]  # absent in other converters' files, which is no loss
    assert decode(content).lost["implausible_sizes"] == 2


def test_lights_as_the_converter_writes_them(content):
    place = {"x": [1.0] * 3, "y": [2.0] * 3, "z": [3.0] * 3}
    content["tl_states"] = {"2": {"state": ["stop", "arrow_go", 99], "time_index": [0, 5, 6], **place}}
    (light,) = decode(content).lights
    assert light.lane_id == 2 and light.stop_point.tolist() == [1.0, 2.0, 3.0]
    assert light.states[[0, 1, 5, 6]].tolist() == [
        LightState.STOP, LightState.UNOBSERVED, LightState.ARROW_GO, LightState.UNKNOWN
    ]  # fmt: skip


def test_lights_at_zeros_stand_where_their_lane_begins(content):
    lane = next(road["id"] for road in content["roads"] if road["type"] == "lane")
    seen = {"state": ["stop"], "time_index": [0], **{axis: [0.0] for axis in "xyz"}}
    content["tl_states"] = {str(lane): seen, "99999": seen}
    recording = decode(content)
    (light,) = recording.lights
    (start,) = (f.points[0] for f in recording.features if f.feature_id == lane)
    np.testing.assert_array_equal(light.stop_point, start)
    assert recording.lost["lights_without_place"] == 1


def test_heights_may_be_missing_and_unknown_fields_are_counted(content):
    """Converters of flat data sets leave out z and the height of boxes."""
    before = decode(copy.deepcopy(content))
    for row in content["objects"]:
        del row["height"]
        row["yaw_rate"] = [0.0] * 91
        for point in row["position"]:
            point.pop("z", None)  # points may be shared
    for road in content["roads"]:
        for point in road["geometry"]:
            point.pop("z", None)  # points may be shared
    after = decode(content)
    np.testing.assert_array_equal(after.tracks.xy, before.tracks.xy)
    np.testing.assert_array_equal(after.tracks.size[..., :2], before.tracks.size[..., :2])
    assert not after.tracks.size[..., 2].any() and not after.tracks.z.any()
    assert not any(feature.points[:, 2].any() for feature in after.features)
    assert after.lost == before.lost | {"unknown_fields": 1}


def test_ids_are_numbered_where_the_file_has_none(content):
    for row in (*content["objects"], *content["roads"]):
        del row["id"]
    recording = decode(content)
    assert recording.tracks.track_id.tolist() == [0, 1, 2, 3]
    assert [feature.feature_id for feature in recording.features] == list(range(10))


def broken(content, *path, value):
    *outer, last = path
    place = content
    for key in outer:
        place = place[key]
    place[last] = value


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("metadata",), None, "the ego is unknown"),
        (("metadata",), {}, "the ego is unknown"),
        (("metadata", "sdc_track_index"), 4, "names track 4"),
        (("metadata", "sdc_track_index"), "3", "not an integer"),
        (("metadata", "sdc_track_index"), 1, "not a vehicle"),
        (("metadata", "tracks_to_predict"), [{"track_index": 77}], "names track 77"),
        (("metadata", "tracks_to_predict"), {}, "not a list"),
        (("scenario_id",), None, "no scenario_id"),
        (("scenario_id",), "\ud800", "no scenario_id"),
        (("objects",), [], "has no objects"),
        (("objects",), {"0": 1}, "no list of objects"),
        (("roads",), None, "no list of roads"),
        (("objects", 0, "valid"), [True] * 5, "has 5 steps"),
        (("objects", 1, "heading"), [0.0] * 90, "of one length"),
        (("objects", 1, "position"), None, "object 1 has no lists"),
        (("objects", 1, "position", 4), {"x": 1.0, "y": 2.0}, "not a list of numbers x, y, z"),
        (("objects", 1, "position", 4, "x"), float("nan"), "not finite"),
        (("objects", 1, "position", 4, "x"), 1e300, "implausibly large"),
        (("objects", 1, "position", 4, "x"), 10**400, "not a list of numbers"),
        (("objects", 1, "id"), 78, "not unique"),
        (("objects", 1, "id"), 2**31, "not unique, or not from 0"),
        (("objects", 1, "id"), 1.5, "not an integer"),
        (("roads", 1, "id"), 1, "not unique"),
        (("roads", 0, "geometry"), None, "geometry of road 1"),
        (("roads", 0, "geometry", 3, "y"), [[0]], "geometry of road 1"),
        (("roads", 0, "geometry"), [{"x": [], "y": [], "z": []}], "geometry of road 1"),
        (("roads", 0, "geometry", 3, "y"), float("inf"), "not finite"),
        (("tl_states",), [1], "not a dictionary"),
        (("tl_states",), {"x": {}}, "not an id"),
        (("tl_states",), {"1": {"state": []}}, "no lists"),
        (
            ("tl_states",),
            {"1": {"state": ["go"], "time_index": [91], "x": [0], "y": [0], "z": [0]}},
            "names step 91, there are 91",
        ),
    ],
)
def test_contradictions_are_refused_in_one_line(tmp_path, path, value, said):
    content = sample.content()
    broken(content, *path, value=value)
    file = tmp_path / "tfrecord-00000-of-00001_0.json"
    file.write_text(json.dumps(content))
    (bad,) = GpuDrive().read(file)
    assert isinstance(bad, BadRecord) and said in bad.problem, bad
    assert bad.file == file and bad.cure


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"[[" * 100_000, b"\xff\xfe{}", b'{"a": 1}', b"null"])
def test_other_files_are_refused(tmp_path, content):
    file = tmp_path / "tfrecord-00000-of-00001_0.json"
    file.write_bytes(content)
    (bad,) = GpuDrive().read(file)
    assert isinstance(bad, BadRecord)
    assert not GpuDrive().recognise(file) and GpuDrive().count(file) == 0


def test_missing_and_oversized_files(tmp_path):
    (bad,) = GpuDrive().read(tmp_path / "none.json")
    assert "file not found" in bad.problem
    large = tmp_path / "large.json"
    with large.open("wb") as file:
        file.truncate(300_000_000)  # sparse: takes no space
    (bad,) = GpuDrive().read(large)
    assert "has 300 MB, more than the 67 MB" in bad.problem


def test_recognises_by_content(tmp_path, content):
    assert GpuDrive().recognise(sample.write(tmp_path))
    roads_first = tmp_path / "b.json"
    roads_first.write_text(json.dumps({"roads": content["roads"], **content}))
    assert GpuDrive().recognise(roads_first)
    other = tmp_path / "log_map_archive.json"
    other.write_text(json.dumps({"drivable_areas": {}, "lane_segments": {}, "pedestrian_crossings": {}}))
    assert not GpuDrive().recognise(other) and not GpuDrive().recognise(tmp_path)


def test_description_counts_objects_and_needs_metadata(tmp_path):
    described = GpuDrive().describe(sample.write(tmp_path))
    assert described.recordings == 1 and "4 objects, 10 road elements" in described.notes[0]
    assert any("no traffic lights" in note for note in described.notes)
    with pytest.raises(DataError, match="hand-made"):
        GpuDrive().describe(sample.write(tmp_path, metadata=None))


#: shared/data/README.md
REAL = {"325": ("ef3a8f65142f41ac", 62, 61, 157, 10_527), "4": ("db4edc9bd0c9d18c", 81, 80, 102, 5_388)}


@pytest.mark.parametrize("number", REAL)
def test_real_files_have_the_counted_content_and_headings_along_motion(real_data, number):
    path = real_data / "gpudrive" / f"tfrecord-00000-of-01000_{number}.json"
    recording = read(path)
    stored = assemble(recording)
    counts = len(recording.tracks.kind), recording.ego, len(recording.features), stored.source.map_points
    assert (recording.scenario_id, *counts) == REAL[number]
    np.testing.assert_allclose(stored.agent_size[0], (5.286, 2.332, 2.33), atol=1e-3)
    assert stored.overflow == {} and {Flag.CHAINED_GRAPH, Flag.ROUTE} <= set(stored.has)
    # Headings are those of the motion.
    tracks = recording.tracks
    fast = tracks.valid & (np.hypot(*np.moveaxis(tracks.velocity, -1, 0)) > 3) & (tracks.kind == 1)[:, None]
    course = np.arctan2(tracks.velocity[..., 1], tracks.velocity[..., 0])
    off = np.abs((tracks.heading - course + math.pi) % (2 * math.pi) - math.pi)
    assert fast.sum() > 50 and np.quantile(off[fast], 0.95) < 0.2
