"""The nuPlan reader against a hand-made log with known answers."""

from __future__ import annotations

import math
import re
import sqlite3
from collections import Counter
from contextlib import closing
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from datasets.samples import nuplan as sample
from drivax.datasets.nuplan import reader as nuplan_reader
from drivax.datasets.nuplan.map import feature_id
from drivax.datasets.nuplan.reader import NuPlan, TimeLine, pieces, yaw_of
from drivax.datasets.reader import BadRecord, Reader
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Recording, windows
from drivax.scenario.schema import STEPS, AgentKind, Flag, LightState, RoadKind

ORIGIN = np.array([sample.X0, sample.Y0])


@pytest.fixture(autouse=True)
def no_other_maps(monkeypatch):
    monkeypatch.delenv("NUPLAN_MAPS_ROOT", raising=False)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return sample.write_full(tmp_path_factory.mktemp("nuplan"))


@pytest.fixture(scope="module")
def recordings(log) -> list[Recording]:
    return read(log)


def read(path) -> list[Recording]:
    found = list(NuPlan().read(path))
    bad = [str(item.error()) for item in found if isinstance(item, BadRecord)]
    assert bad == []
    return found  # pyright: ignore[reportReturnType]


def change(path, statement: str, *values) -> None:
    with closing(sqlite3.connect(path)) as db, db:
        db.execute(statement, values)


def sweeps_of(recording: Recording) -> np.ndarray:
    """Numbers of the sweeps that became the steps of a recording, from the sample's own clock."""
    clock = {sample.time_us(sweep) - sample.time_us(0): sweep for sweep in range(500)}
    return np.array([clock[round(time * 1e6)] for time in recording.timestamps_s])


# --- The file.


def test_reader_recognises_only_logs(log, tmp_path):
    reader = NuPlan()
    assert isinstance(reader, Reader)
    assert reader.recognise(log)
    assert log.match(reader.patterns[0])
    city = next(log.parents[3].rglob("*.gpkg"))
    assert not reader.recognise(city) and any(city.match(pattern) for pattern in reader.companions)
    for name, content in (("empty.db", b""), ("text.db", b"hello"), ("short.db", b"SQLite format 3\0")):
        (tmp_path / name).write_bytes(content)
        assert not reader.recognise(tmp_path / name)
    assert not reader.recognise(tmp_path / "missing.db")
    assert not reader.recognise(tmp_path)


def test_description_names_the_missing_map(log, tmp_path):
    found = NuPlan().describe(log)
    assert (found.dataset, found.recordings, found.missing) == ("nuPlan", 2, ())
    assert "map us-nv-las-vegas-strip" in found.notes
    alone = tmp_path / log.name
    alone.write_bytes(log.read_bytes())
    found = NuPlan().describe(alone)
    assert found.missing == ("maps/us-nv-las-vegas-strip/<version>/map.gpkg",)
    assert any("NUPLAN_MAPS_ROOT" in note for note in found.notes)


def test_count_is_the_number_of_windows(log, recordings, tmp_path):
    assert NuPlan().count(log) == sum(len(list(windows(recording))) for recording in recordings) == 5
    (tmp_path / "no.db").write_bytes(b"no")
    assert NuPlan().count(tmp_path / "no.db") == 0


# --- Identity and time.


def test_recordings_have_scene_tokens_and_place(recordings):
    scenes = [sample.token("scene", number).hex() for number in (0, 1)]
    assert [recording.scenario_id for recording in recordings] == scenes
    for recording in recordings:
        assert recording.segment == sample.LOG
        assert (recording.dataset, recording.ego, recording.current_step) == ("nuplan", 0, 10)
        assert recording.tags["source_format"] == "nuplan"
        assert recording.tags["place"] == "las-vegas"
        assert recording.tags["location"] == "us-nv-las-vegas-strip"
        assert recording.lost == {}


def test_every_second_sweep_is_read_with_the_time_of_the_lidar(recordings):
    """Item 16: 20 to 10 Hz by index. Item 23: times are those of the lidar, jitter included, not of ego poses."""
    for recording in recordings:
        sweeps = sweeps_of(recording)
        assert set(np.diff(sweeps)) == {2}
        steps = np.diff(recording.timestamps_s)
        assert 0.0 < np.abs(steps - 0.1).max() < 1e-3
    assert [sweeps_of(r)[[0, -1]].tolist() for r in recordings] == [[0, 358], [180, 498]]


def test_recordings_extend_scenes_by_history_and_future(recordings):
    """A recording is a scene with 10 steps before and 80 after it; its current steps are the scene's own."""
    first, second = (sweeps_of(recording) for recording in recordings)
    assert first[0] == 0 and first[-1] == 398 + 2 * 80 - 200  # scene 0 ends with sweep 198 at 10 Hz
    assert second[0] == 200 - 2 * 10
    assert second[10] == 200


# --- Ego.


def test_ego_is_the_box_centre_not_the_rear_axle(recordings):
    """Item 15: 1.461 m ahead of the rear axle. Item 2: UTM coordinates in float64."""
    for recording in recordings:
        for step, sweep in enumerate(sweeps_of(recording)):
            x, y, yaw, _ = sample.ego_rear_axle(
                sample.SPEED * (sample.time_us(sweep) - sample.time_us(0)) * 1e-6
            )
            centre = ORIGIN + np.array([x + 1.461 * math.cos(yaw), y + 1.461 * math.sin(yaw)])
            np.testing.assert_allclose(recording.tracks.xy[0, step], centre, rtol=0.0, atol=2e-9)
            assert recording.tracks.heading[0, step] == pytest.approx(yaw, abs=1e-12)
    assert recordings[0].tracks.size[0, 7].tolist() == [5.176, 2.297, 1.777]
    assert recordings[0].tracks.valid[0].all()


def test_ego_velocity_is_that_of_the_centre_in_the_map_frame(recordings):
    """Item 15: the file's velocity is in the ego's frame. Against central differences of the centre."""
    for recording in recordings:
        t, xy = recording.timestamps_s, recording.tracks.xy[0]
        measured = (xy[2:] - xy[:-2]) / (t[2:] - t[:-2])[:, None]
        curvature = [sample.ego_rear_axle(sample.SPEED * time)[3] for time in t]
        smooth = [len(set(curvature[i - 1 : i + 2])) == 1 for i in range(1, len(t) - 1)]
        assert sum(smooth) > 100
        np.testing.assert_allclose(recording.tracks.velocity[0, 1:-1][smooth], measured[smooth], atol=5e-3)
    # In the turn the centre is faster than the rear axle: v sqrt(1 + (1.461 / 13.75)^2).
    turning = np.hypot(*recordings[0].tracks.velocity[0].T).max()
    assert turning == pytest.approx(sample.SPEED * math.hypot(1.0, 1.461 / 13.75), rel=1e-9)


@given(st.floats(-3.1, 3.1), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.booleans())
def test_yaw_against_scipy(yaw, pitch, roll, flip):
    rotation = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    x, y, z, w = rotation.as_quat() * (-1.0 if flip else 1.0)
    expected = rotation.apply([1.0, 0.0, 0.0])
    assert yaw_of(np.array([[w, x, y, z]]))[0] == pytest.approx(
        math.atan2(expected[1], expected[0]), abs=1e-9
    )


# --- Agents.


def test_agents_follow_the_boxes_of_the_log(recordings):
    kinds = Counter(AgentKind(kind) for kind in recordings[0].tracks.kind)
    assert kinds == {
        AgentKind.VEHICLE: 1 + 4, AgentKind.CYCLIST: 1, AgentKind.PEDESTRIAN: 2, AgentKind.STATIC: 5,
    }  # fmt: skip
    for recording in recordings:
        tracks = recording.tracks
        for row, number in enumerate(tracks.track_id.tolist()[1:], start=1):
            box = sample.BOXES[number - 1]
            for step in range(0, len(recording.timestamps_s), 7):
                pose = box.pose(float(recording.timestamps_s[step]))
                assert tracks.valid[row, step] == (pose is not None)
                if pose is not None:
                    np.testing.assert_allclose(tracks.xy[row, step], ORIGIN + pose[:2], atol=2e-9)
                    assert math.cos(tracks.heading[row, step] - pose[2]) == pytest.approx(1.0)
                    assert tuple(tracks.size[row, step]) == box.size
                    assert tuple(tracks.velocity[row, step]) == (box.velocity or (0.0, 0.0))


def test_numbers_of_tracks_hold_for_the_whole_log(recordings):
    def places(recording):
        tracks = recording.tracks
        return {int(i): box for i, box in zip(tracks.track_id, tracks.size.max(axis=1).tolist(), strict=True)}

    first, second = (places(recording) for recording in recordings)
    assert all(first[number] == size for number, size in second.items())
    assert len(second) == 13


def test_gaps_of_tracks_stay_gaps(recordings):
    """Item 4: the pedestrian is unobserved between 3 s and 4 s; nothing is filled in."""
    recording = recordings[0]
    row = recording.tracks.track_id.tolist().index(6)
    seen = np.array([sample.walker(t) is not None for t in recording.timestamps_s])
    np.testing.assert_array_equal(recording.tracks.valid[row], seen)
    assert 0 < (~seen).sum() < 15
    for name in ("xy", "z", "heading", "velocity", "size"):
        assert not getattr(recording.tracks, name)[row][~seen].any()


def test_map_and_agents_are_flat(recordings):
    """The map has no heights: boxes stand on z = 0 whatever the log says (607 m above the sea)."""
    tracks = recordings[0].tracks
    np.testing.assert_allclose(tracks.z[tracks.valid], tracks.size[..., 2][tracks.valid] / 2)


def test_boxes_without_a_track_are_counted(tmp_path):
    path = sample.write(tmp_path)
    change(path, "DELETE FROM track WHERE token = ?", sample.token("track", 0))
    (recording,) = read(path)
    assert recording.lost == {"boxes_without_track": 96}
    assert recording.tracks.track_id.tolist() == list(range(12))


def test_repeated_boxes_of_a_track_are_counted(tmp_path):
    """A copy of each box of a track, 1 m to the east: the later rows count."""
    path = sample.write(tmp_path)
    (before,) = read(path)
    copy = (
        "INSERT INTO lidar_box SELECT randomblob(8), lidar_pc_token, track_token, next_token, prev_token, x + 1, y, z, "
        "width, length, height, vx, vy, vz, yaw, confidence FROM lidar_box WHERE track_token = ?"
    )
    change(path, copy, sample.token("track", 0))
    (recording,) = read(path)
    assert recording.lost == {"repeated_boxes": 96}
    shift = recording.tracks.xy - before.tracks.xy
    np.testing.assert_allclose(shift[recording.tracks.track_id == 1, :, 0].max(), 1.0)


def test_tables_columns_and_layers_of_unknown_names_are_counted(tmp_path):
    path = sample.write(tmp_path)
    change(path, "CREATE TABLE lidar_pc_annotation (token BLOB, type TEXT)")
    change(path, "ALTER TABLE lidar_box ADD COLUMN roll FLOAT")
    change(
        next(tmp_path.rglob("*.gpkg")),
        "INSERT INTO gpkg_geometry_columns VALUES ('trees', 'g', 'POINT', 4326, 0, 0)",
    )
    (recording,) = read(path)
    assert recording.lost == {"unknown_fields": 3}


def test_unknown_sizes_and_velocities(tmp_path):
    path = sample.write(tmp_path)
    change(
        path, "UPDATE lidar_box SET length = NULL, vx = NULL WHERE track_token = ?", sample.token("track", 3)
    )
    change(path, "UPDATE category SET name = 'unicycle' WHERE name = 'bicycle'")
    (recording,) = read(path)
    row = recording.tracks.track_id.tolist().index(4)
    assert not recording.tracks.size[row, :, 0].any() and recording.tracks.size[row, 0, 1] == 1.8
    assert AgentKind.OTHER in recording.tracks.kind and AgentKind.CYCLIST not in recording.tracks.kind
    assert assemble(next(windows(recording))).has & Flag.DEFAULT_SIZES


# --- Lights, tags, routes.


def test_lights_by_connector(recordings):
    """Item 10: keyed by the connector that they control, yellow mapped, -1 where the light is unobserved."""
    states = {"red": LightState.STOP, "yellow": LightState.CAUTION, "green": LightState.GO}
    for recording in recordings:
        lights = {light.lane_id: light for light in recording.lights}
        sweeps = sweeps_of(recording)
        for pair, number in sample.CONNECTORS.items():
            told = [sample.status(sweep, pair) for sweep in sweeps]
            lane = feature_id("lane_connectors", number)
            assert (lane in lights) == any(told)
            if any(told):
                expected = [-1 if s is None else states.get(s, LightState.UNKNOWN) for s in told]
                assert lights[lane].states.tolist() == expected
                stop = ORIGIN + sample.connector_line(pair)[0]
                np.testing.assert_allclose(lights[lane].stop_point, [*stop, 0.0], atol=1e-5)
    assert {int(s) for light in recordings[0].lights for s in light.states} == {-1, 0, 4, 5, 6}


def test_lights_of_connectors_that_the_map_lacks_are_counted(tmp_path):
    path = sample.write(tmp_path)
    change(
        path,
        "UPDATE traffic_light_status SET lane_connector_id = 777 WHERE lane_connector_id = ?",
        sample.TURN,
    )
    (recording,) = read(path)
    assert recording.lost == {"lights": 1}
    assert feature_id("lane_connectors", sample.TURN) not in {light.lane_id for light in recording.lights}


def test_scenario_types_come_from_the_scene_itself(recordings):
    assert recordings[0].tags["scenario_types"] == "high_magnitude_speed|starting_left_turn"
    assert recordings[1].tags["scenario_types"] == "near_construction_zone_sign"


def test_route_corridor_lists_the_lanes_of_the_roadblocks(recordings):
    expected = (
        feature_id("lanes_polygons", sample.IN["w"]), feature_id("lanes_polygons", sample.SECOND),
        feature_id("lane_connectors", sample.TURN), feature_id("lanes_polygons", sample.OUT["n"]),
    )  # fmt: skip
    assert all(recording.route_corridor == expected for recording in recordings)


@pytest.mark.parametrize(
    ("text", "count", "unknown"),
    [(None, 0, 0), ("", 0, 0), ("COMMAS", 4, 0), ("12345 x -3 " + "9" * 40, 0, 1)],
)
def test_routes_that_are_missing_odd_or_separated_by_commas(tmp_path, text, count, unknown):
    text = sample.route().replace(" ", ",") if text == "COMMAS" else text
    (recording,) = read(sample.write_all(tmp_path, replace(sample.SMALL, routes=(text,))))
    assert len(recording.route_corridor) == count
    assert recording.lost.get("roadblocks", 0) == unknown


def test_scenes_without_a_goal_or_without_a_table_row(tmp_path):
    path = sample.write_all(tmp_path, replace(sample.SMALL, goals=False))
    (recording,) = read(path)
    assert len(recording.route_corridor) == 4
    change(path, "DELETE FROM scene")
    (recording,) = read(path)
    assert recording.route_corridor == ()


# --- How a log is cut: against every window there could be.


def time_line(scenes, gaps=()) -> TimeLine:
    """A log with a scene number per sweep, and a pause of a second before some sweeps."""
    step = np.full(len(scenes), 50_000)
    step[list(gaps)] += 1_000_000
    return TimeLine(tuple(range(len(scenes))), np.cumsum(step), tuple(bytes([s]) for s in scenes))


def current_sweeps(line: TimeLine, future: int) -> list[tuple[bytes, int]]:
    """(scene, current sweep) of all windows of this future at a stride of one step."""
    return [
        (piece.scene, int(sweep))
        for piece in pieces(line, future + 11)
        for sweep in piece.sweeps[10 : max(len(piece.sweeps) - future, 0)]
    ]


@given(
    st.lists(st.integers(1, 900), min_size=1, max_size=6),
    st.lists(st.integers(1, 2000), max_size=2, unique=True),
    st.sampled_from([80, 150]),
)
def test_every_window_belongs_to_one_scene(lengths, gaps, future):
    """Every sweep at 10 Hz with 1 s before and a future after it is the current step of one window of its scene."""
    scenes = [number for number, length in enumerate(lengths) for _ in range(length)]
    gaps = sorted(gap for gap in gaps if gap < len(scenes))
    # A log that consists of pauses has no frequency.
    assume(len(scenes) > 2 * len(gaps) + 1)
    line = time_line(scenes, gaps)
    runs = [range(a, b, 2) for a, b in pairwise([0, *gaps, len(scenes)])]
    expected = [(bytes([scenes[s]]), s) for run in runs for s in run[10 : max(len(run) - future, 0)]]
    assert sorted(current_sweeps(line, future), key=lambda found: found[1]) == expected
    cut = pieces(line, future + 11)
    assert len({piece.name for piece in cut}) == len(cut)
    for piece in cut:
        assert len(piece.sweeps) <= 400 + future + 10
        assert np.isin(line.time_us[piece.sweeps[1:]] - line.time_us[piece.sweeps[:-1]], 100_000).all()


def test_scenes_without_a_token_have_different_names():
    line = time_line([0] * 300 + [1] * 300)
    line = replace(line, scenes=tuple(str(scene) for scene in line.scenes))
    assert [piece.name for piece in pieces(line)] == ["no-scene", "no-scene.2"]


def test_short_logs_are_one_recording_without_a_future(tmp_path):
    path = sample.write_all(tmp_path, replace(sample.SMALL, sweeps=60))
    (recording,) = read(path)
    assert len(recording.timestamps_s) == 30
    assert assemble(recording).has & Flag.NO_FUTURE
    (bad,) = NuPlan().read(sample.write_all(tmp_path / "b", replace(sample.SMALL, sweeps=18)))
    assert isinstance(bad, BadRecord) and "9 steps without a gap" in bad.problem


def test_gaps_in_time_are_never_bridged(tmp_path):
    """More than one missing sweep cuts; a single one leaves a step of 0.15 s, which is resampled by time."""
    path = sample.write_full(tmp_path, missing=frozenset({201, *range(230, 240)}))
    recordings = read(path)
    assert all(np.diff(recording.timestamps_s).max() < 0.2 for recording in recordings)
    assert [len(recording.timestamps_s) for recording in recordings] == [115, 130]
    assert np.diff(recordings[0].timestamps_s).max() == pytest.approx(0.15, abs=2e-3)
    # Sweep 200, before the missing one, is step 75; later steps are half-way between the sweeps that were taken.
    *_, last = windows(recordings[0], stride=10)
    assert last.scenario_id.endswith("@20") and last.lost["interpolated_steps"] == 110 - 75
    assert np.diff(last.timestamps_s) == pytest.approx(0.1, abs=1e-4)
    assert not assemble(last).has & Flag.JITTERED_TIME


def test_ten_hertz_logs_are_not_subsampled(tmp_path):
    path = sample.write_full(tmp_path, missing=frozenset(range(1, 500, 2)))
    assert set(np.diff(sweeps_of(read(path)[0]))) == {2}
    other = sample.write_full(tmp_path / "b", missing=frozenset(s for s in range(500) if s % 10))
    (bad,) = NuPlan().read(other)
    assert isinstance(bad, BadRecord) and "every 500 ms" in bad.problem


def test_recordings_are_read_lazily(log, monkeypatch):
    """A log is never in memory as a whole: the second scene is read on request."""
    asked = []
    whole = nuplan_reader.tracks
    monkeypatch.setattr(nuplan_reader, "tracks", lambda *given: asked.append(given[1].name) or whole(*given))
    reading = NuPlan().read(log)
    next(reading)
    assert len(asked) == 1


# --- Damage.


@pytest.mark.parametrize(
    ("statement", "problem"),
    [
        ("UPDATE lidar_box SET x = 'east'", "lidar_box contains a value that is not a number"),
        ("UPDATE lidar_box SET y = NULL", "position of a box is missing or implausible"),
        ("UPDATE lidar_box SET x = 1e300", "position of a box is missing or implausible"),
        ("UPDATE lidar_box SET width = 9e9", "size of a box is missing or implausible"),
        ("UPDATE lidar_box SET vx = -1e9", "velocity of a box is missing or implausible"),
        ("UPDATE lidar_box SET yaw = 9e999", "yaw of a box is missing or implausible"),
        ("UPDATE ego_pose SET x = NULL", "ego position is missing or implausible"),
        ("UPDATE ego_pose SET vx = 1e6", "ego velocity is missing or implausible"),
        ("UPDATE ego_pose SET qw = 7", "not a unit quaternion"),
        ("UPDATE ego_pose SET qz = NULL", "not a unit quaternion"),
        ("UPDATE ego_pose SET x = x + (rowid % 4 / 2) * 500", "the ego jumps"),
        ("UPDATE ego_pose SET y = y + 90000", "no lane of the map"),
        ("DELETE FROM ego_pose", "96 sweeps have no ego pose"),
        ("UPDATE log SET map_version = NULL", "names no map"),
        ("UPDATE log SET map_version = '../../x'", "lists no map"),
        ("DELETE FROM log", "names no map"),
        ("DELETE FROM lidar_pc", "has no lidar sweep"),
        ("UPDATE lidar_pc SET timestamp = 'now'", "no timestamp"),
        ("UPDATE lidar_pc SET timestamp = 5", "every 0 ms"),
        ("DROP TABLE traffic_light_status", "has no table traffic_light_status"),
        ("ALTER TABLE lidar_box RENAME COLUMN yaw TO heading", "lidar_box has no column yaw"),
    ],
)
def test_damage_is_reported_in_one_line(tmp_path, statement, problem):
    path = sample.write(tmp_path)
    change(path, statement)
    (bad,) = NuPlan().read(path)
    assert isinstance(bad, BadRecord)
    line = str(bad.error())
    assert problem in line and bad.cure and "\n" not in line


def test_other_scenes_survive_a_damaged_one(tmp_path):
    path = sample.write_full(tmp_path)
    change(path, "UPDATE lidar_box SET x = 'x' WHERE lidar_pc_token = ?", sample.token("lidar_pc", 400))
    first, second = NuPlan().read(path)
    assert isinstance(first, Recording)
    assert isinstance(second, BadRecord)
    assert (second.file, second.record) == (path, sample.token("scene", 1).hex())


def test_too_many_tracks_are_refused_before_they_take_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(nuplan_reader, "_MOST_CELLS", 1000)
    (bad,) = NuPlan().read(sample.write(tmp_path))
    assert isinstance(bad, BadRecord) and "12 tracks in 96 steps" in bad.problem


def test_damaged_index_adds_no_boxes_of_other_sweeps(tmp_path):
    """Entries of an index out of order make SQLite return rows outside the query; they are left out."""
    path = sample.write(tmp_path)
    (whole,) = read(path)
    data = path.read_bytes()
    asked, other = sample.token("lidar_pc", 100), sample.token("lidar_pc", 99)
    # A record of an index: its header (3 bytes: a BLOB of 8 bytes and an integer), the token, the row.
    entries = [match.start() + 3 for match in re.finditer(rb"\x03\x1c[\x01-\x06]" + re.escape(asked), data)]
    assert len(entries) >= 12
    valid = []
    for place in entries:
        path.write_bytes(data[:place] + other + data[place + 8 :])
        for found in NuPlan().read(path):
            assert isinstance(found, Recording | BadRecord)
            valid += [int(found.tracks.valid.sum())] if isinstance(found, Recording) else []
    assert whole.tracks.valid.sum() - 1 in valid


def test_missing_map_is_one_error_with_a_cure(log, tmp_path):
    alone = tmp_path / log.name
    alone.write_bytes(log.read_bytes())
    (bad,) = NuPlan().read(alone)
    assert isinstance(bad, BadRecord)
    assert "no nuPlan maps" in bad.problem and "NUPLAN_MAPS_ROOT" in str(bad.cure)


def test_no_blob_is_unpickled(log):
    """Item 18: the calibrations of the sample are pickles that raise when they are loaded."""
    import pickle

    with closing(sqlite3.connect(log)) as db:
        (blob,) = db.execute("SELECT rotation FROM lidar").fetchone()
    with pytest.raises(ZeroDivisionError):
        pickle.loads(blob)
    assert len(read(log)) == 2


def test_recordings_do_not_depend_on_an_index(log, recordings, tmp_path):
    path = sample.write_full(tmp_path)
    change(path, "DROP INDEX box_of_sweep")
    for a, b in zip(read(path), recordings, strict=True):
        np.testing.assert_array_equal(a.tracks.xy, b.tracks.xy)
        assert [light.lane_id for light in a.lights] == [light.lane_id for light in b.lights]


# --- What becomes of it.


@pytest.fixture(scope="module")
def scenario(recordings):
    return assemble(next(windows(recordings[0])))


def test_assembled_flags_lanes_and_routes(scenario):
    assert scenario.id == sample.token("scene", 0).hex() + "@0"
    for flag in (Flag.LANE_GRAPH, Flag.SPEED_LIMITS, Flag.LIGHTS, Flag.ROUTE, Flag.CLOSED_EDGES):
        assert scenario.has & flag, flag
    for flag in (Flag.CHAINED_GRAPH, Flag.ELEVATION, Flag.NO_FUTURE, Flag.JITTERED_TIME, Flag.DEFAULT_SIZES):
        assert not scenario.has & flag, flag
    assert scenario.overflow == {}
    assert scenario.source.map_features["lane"] == 21
    assert scenario.source.lights == 6
    assert len(scenario.agent_valid) == STEPS
    assert (scenario.lane_id > 0).sum() == 21
    assert (scenario.light_lane[:6] >= 0).all()


def test_ego_stays_on_the_drivable_side(recordings):
    """Item 7, on the whole drive: every corner of the ego's box lies inside the rings of the road edges."""
    for recording in recordings:
        rings = [f.points[:, :2] - ORIGIN for f in recording.features if f.kind == RoadKind.EDGE_BOUNDARY]
        road = shapely.union_all([shapely.Polygon(ring) for ring in rings])
        tracks = recording.tracks
        ahead = np.stack((np.cos(tracks.heading[0]), np.sin(tracks.heading[0])), axis=-1)
        aside = np.stack((-ahead[:, 1], ahead[:, 0]), axis=-1)
        for along, across in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            corner = tracks.xy[0] - ORIGIN + along * 2.588 * ahead + across * 1.1485 * aside
            assert shapely.contains_xy(road, corner).all()


def test_route_follows_the_log(scenario):
    """The corridor goes west, left, north; the first route stays within 1.5 m of the log."""
    points = int(scenario.route_points[0])
    line = shapely.LineString(scenario.route_xy[0, :points])
    apart = shapely.distance(line, shapely.points(scenario.agent_xy[:, 0]))
    assert np.mean(apart < 1.5) > 0.95
