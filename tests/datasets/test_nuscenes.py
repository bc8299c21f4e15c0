"""nuScenes tables and maps: keyframes to 10 Hz, arc lines, lanes, edges; items 13 and 16 of the check-list."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from datasets.samples import nuscenes as sample
from drivax.datasets.nuscenes import map as nuscenes_map
from drivax.datasets.nuscenes import reader as nuscenes_reader
from drivax.datasets.nuscenes.map import Box
from drivax.datasets.nuscenes.reader import (
    CENTRE_AHEAD_M,
    EGO_SIZE_M,
    NuScenes,
    interpolate,
    kind_of,
    rows,
    scene_rows,
    yaw,
)
from drivax.datasets.reader import BadRecord, Reader
from drivax.errors import DataError, UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import windows
from drivax.scenario.schema import AgentKind, Flag, RoadKind


@pytest.fixture(autouse=True)
def _forget_cities():
    nuscenes_map.city.cache_clear()


@pytest.fixture
def scene(tmp_path):
    (found,) = NuScenes().read(sample.write(tmp_path))
    assert not isinstance(found, BadRecord), found
    return found


def test_nuscenes_is_a_reader(tmp_path):
    reader = NuScenes()
    assert isinstance(reader, Reader)
    path = sample.write(tmp_path)
    assert reader.recognise(path)
    assert not reader.recognise(path.with_name("sample.json"))
    assert reader.count(path) == 3
    about = reader.describe(path)
    assert (about.version, about.recordings, about.missing) == ("v1.0-mini", 1, ())


def test_missing_files_are_reported(tmp_path):
    path = sample.write(tmp_path)
    path.with_name("ego_pose.json").unlink()
    (tmp_path / "maps" / "expansion" / f"{sample.CITY}.json").unlink()
    missing = NuScenes().describe(path).missing
    assert missing == ("v1.0-mini/ego_pose.json", "maps/expansion/*.json (the map expansion pack)")
    (bad,) = NuScenes().read(path)
    assert isinstance(bad, BadRecord)
    assert "is missing" in str(bad.error())


def test_missing_shapely_names_the_extra(tmp_path, hide_packages):
    path = sample.write(tmp_path)
    hide_packages("shapely")
    with pytest.raises(UsageError, match=r"pip install 'drivax\[maps\]'"):
        list(NuScenes().read(path))


@pytest.mark.parametrize("folder", ["maps", "expansion"])
def test_maps_are_read_from_where_they_are_unpacked(tmp_path, folder):
    """The archive of the map expansion holds a folder ``expansion``; its older versions held none."""
    path = sample.write(tmp_path)
    file = tmp_path / "maps" / "expansion" / f"{sample.CITY}.json"
    (tmp_path / folder).mkdir(exist_ok=True)
    file.rename(tmp_path / folder / file.name)
    assert NuScenes().describe(path).missing == ()
    (found,) = NuScenes().read(path)
    assert not isinstance(found, BadRecord) and len(found.features) > 5
    assert (tmp_path / folder / file.name).match(f"{folder}/*.json")
    assert f"{folder}/*.json" in NuScenes().companions


@pytest.mark.parametrize("name", ["arcline_path_3", "connectivity"])
def test_old_maps_without_centre_lines_name_the_version_to_download(tmp_path, name):
    path = sample.write(tmp_path)
    file = tmp_path / "maps" / "expansion" / f"{sample.CITY}.json"
    content = json.loads(file.read_text())
    del content[name]
    file.write_text(json.dumps(content))
    (bad,) = NuScenes().read(path)
    assert isinstance(bad, BadRecord)
    assert f"{file}" in str(bad.error()) and "map expansion v1.3" in str(bad.error())


def test_the_test_split_has_no_annotations_and_is_refused(tmp_path):
    """Its tables are there, but empty: a scenario of the ego alone would look sound."""
    path = sample.write(tmp_path)
    for table in ("instance", "sample_annotation"):
        path.with_name(f"{table}.json").write_text("[]")
    assert any("no annotations" in note for note in NuScenes().describe(path).notes)
    (bad,) = NuScenes().read(path)
    assert isinstance(bad, BadRecord)
    assert bad.file.name == "sample_annotation.json" and "the test split has none" in str(bad.error())


def test_keyframes_at_2_hz_become_10_hz(scene):
    assert len(scene.timestamps_s) == 196
    np.testing.assert_allclose(np.diff(scene.timestamps_s), 0.1, atol=1e-9)
    car, t = scene.tracks.xy[1], scene.timestamps_s
    np.testing.assert_allclose(car[:, 0], 620.0 + 8.0 * t, atol=1e-6)  # straight motion is met exactly
    np.testing.assert_allclose(scene.tracks.velocity[1], [[8.0, 0.0]] * 196, atol=1e-6)


def test_heading_is_unwrapped_before_interpolation(scene):
    heading = scene.tracks.heading[4]
    expected = math.pi - 0.2 + 0.02 * scene.timestamps_s / 0.5
    np.testing.assert_allclose(np.exp(1j * heading), np.exp(1j * expected), atol=1e-9)
    assert np.abs(heading).max() <= math.pi


def test_long_gaps_are_not_interpolated(scene):
    seen = scene.tracks.valid[2]
    # Keyframes 9 and 12 are 1.5 s apart: steps 45 and 60 are observed, nothing in between.
    assert seen[:46].all()
    assert not seen[46:60].any()
    assert seen[60:].all()
    assert not scene.tracks.xy[2][46:60].any()


def test_ego_is_a_box_around_its_centre_not_its_rear_axle(scene):
    np.testing.assert_allclose(scene.tracks.xy[0, 0], [sample.START[0] + CENTRE_AHEAD_M, 100.0], atol=1e-6)
    np.testing.assert_allclose(scene.tracks.size[0, 0], EGO_SIZE_M)
    np.testing.assert_allclose(scene.tracks.velocity[0], [[8.0, 0.0]] * 196, atol=1e-4)


def test_sizes_are_stored_width_first(scene):
    np.testing.assert_allclose(scene.tracks.size[1, 0], [4.5, 1.9, 1.6])


def test_kinds_and_names(scene):
    assert scene.tracks.kind.tolist() == [
        AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.STATIC, AgentKind.VEHICLE
    ]  # fmt: skip
    assert kind_of("vehicle.motorcycle") is AgentKind.CYCLIST
    assert kind_of("animal") is AgentKind.OTHER
    assert (scene.scenario_id, scene.segment, scene.dataset) == ("scene-0001", "n008-2018-08-01", "nuscenes")
    assert scene.tags == {"source_format": "nuscenes", "place": "boston", "location": sample.CITY}
    assert Flag.DIFFERENTIATED_VELOCITY in scene.flags


def test_tables_and_fields_of_unknown_names_are_counted(tmp_path):
    path = sample.write(tmp_path)
    for name, field in (("ego_pose", "speed"), ("sample_annotation", "speed")):
        file = path.with_name(f"{name}.json")
        file.write_text(json.dumps([row | {field: 1.0} for row in json.loads(file.read_text())]))
    path.with_name("weather.json").write_text("[]")
    path.with_name("attribute.json").write_text("[]")  # known, and not needed
    (map_file,) = tmp_path.rglob(f"{sample.CITY}.json")
    content = sample.city() | {"parking_meter": []}
    content["lane"][0]["speed_limit"] = 13.4
    map_file.write_text(json.dumps(content))
    (scene,) = NuScenes().read(path)
    assert scene.lost == {"dangling_links": 1, "unknown_fields": 4}


def test_lanes_have_links_neighbours_and_widths(scene):
    lanes = {f.feature_id: f for f in scene.features if f.kind is RoadKind.LANE_SURFACE}
    right, left, on, north, turn = (lanes[i] for i in range(5))
    assert (right.successors, left.successors, turn.successors) == ((2,), (4,), (3,))
    assert turn.predecessors == (1,)
    assert scene.lost == {"dangling_links": 1}  # "left" comes from a lane that is gone
    assert turn.interpolating
    assert not on.interpolating
    assert right.left_neighbours == (1,)
    assert left.right_neighbours == (0,)
    assert left.left_neighbours == right.right_neighbours == north.left_neighbours == ()
    assert right.width_m == pytest.approx(sample.LANE_M)
    np.testing.assert_allclose(turn.points[-1, :2], [712.0, 115.6], atol=1e-9)


def test_edges_have_the_road_on_their_left(scene):
    """Item 7, by brute force: half a metre left of every edge one may drive, right of it one may not."""
    from shapely import Point, Polygon, union_all

    outline = Polygon(
        [(540, 97), (540, 107), (1000, 107), (1000, 97)], [[(800, 101), (800, 103), (820, 103), (820, 101)]]
    )
    area = union_all([outline, Polygon([(708, 106), (708, 250), (716, 250), (716, 106)])])
    edges = [f for f in scene.features if f.kind is RoadKind.EDGE_BOUNDARY]
    assert len(edges) >= 2
    for edge in edges:
        for a, b in zip(edge.points[:-1, :2], edge.points[1:, :2], strict=True):
            normal = np.array([-(b - a)[1], (b - a)[0]]) / np.hypot(*(b - a))
            middle = (a + b) / 2
            assert area.contains(Point(middle + 0.5 * normal))
            assert not area.contains(Point(middle - 0.5 * normal))


def test_markings_stops_and_crossings(scene):
    kinds = [feature.kind for feature in scene.features]
    assert (
        kinds.count(RoadKind.LINE_BROKEN_SINGLE_WHITE) == kinds.count(RoadKind.LINE_SOLID_SINGLE_WHITE) == 1
    )
    assert kinds.count(RoadKind.LINE_UNKNOWN) == kinds.count(RoadKind.CROSSWALK) == 1
    (stop,) = (f for f in scene.features if f.kind is RoadKind.STOP_SIGN)
    assert stop.lanes == (1,)  # the yield line of the other lane is no stop sign


def test_scene_becomes_windows_with_routes(scene):
    scenarios = [assemble(window) for window in windows(scene)]
    assert [scenario.id for scenario in scenarios] == [f"scene-0001@{start}" for start in (0, 40, 80)]
    for scenario in scenarios:
        assert Flag.LANE_GRAPH in scenario.has
        assert Flag.ROUTE in scenario.has
        assert Flag.CHAINED_GRAPH not in scenario.has


@pytest.mark.parametrize(("shape", "radius"), [("LSR", 20.0), ("RLR", 15.0), ("SSS", 1e6), ("RSL", 999.9)])
def test_arc_lines_follow_an_integrated_unicycle(shape, radius):
    lengths = [10.0, 25.0, 17.3]
    path = [sample.arc((5.0, -3.0, 0.7), lengths, shape, radius)]
    line = nuscenes_map.arc_line(path)
    turn = {"L": 1 / radius, "S": 0.0, "R": -1 / radius}
    pose = np.array([5.0, -3.0, 0.7])
    for letter, length in zip(shape, lengths, strict=True):
        solved = solve_ivp(
            lambda _, p, k=turn[letter]: [np.cos(p[2]), np.sin(p[2]), k],
            (0, length),
            pose,
            rtol=1e-10,
            atol=1e-10,
        )
        pose = solved.y[:, -1]
        assert np.hypot(*(line - pose[:2]).T).min() < 1e-6
    np.testing.assert_allclose(line[-1], pose[:2], atol=1e-6)
    assert np.hypot(*np.diff(line, axis=0).T).max() <= nuscenes_map.SPACING_M + 1e-9


@pytest.mark.parametrize(
    "broken",
    [{"radius": 0.0}, {"segment_length": [1e9, 0, 0]}, {"start_pose": [math.nan, 0, 0]}, {"shape": "LS"}],
)
def test_invalid_arc_lines_are_refused(broken):
    with pytest.raises(ValueError, match=r"arc line|argument"):
        nuscenes_map.arc_line([sample.arc((0, 0, 0), [1.0, 2.0, 3.0], "LSR") | broken])


def test_interpolation_is_the_parabola_of_constant_acceleration():
    """Between inner keyframes a Hermite spline with central differences is exact for a parabola."""
    at = np.arange(0.0, 5.01, 0.5)
    pose = np.stack((2.0 * at + at**2, -at, 0.0 * at), axis=-1)
    times = np.arange(0.5, 4.51, 0.1)
    state, valid = interpolate(at, pose, times)
    assert valid.all()
    np.testing.assert_allclose(state[:, 0], 2.0 * times + times**2, atol=1e-9)
    np.testing.assert_allclose(state[:, 3], 2.0 + 2.0 * times, atol=1e-9)


def test_interpolation_of_one_observation_holds_at_its_step_alone():
    state, valid = interpolate(np.array([0.52]), np.array([[3.0, 4.0, 0.1]]), np.arange(0, 1.01, 0.1))
    assert np.flatnonzero(valid).tolist() == [5]
    np.testing.assert_allclose(state[5], [3.0, 4.0, 0.1, 0.0, 0.0])


def test_yaw_of_quaternions_equals_rotation_matrices():
    from scipy.spatial.transform import Rotation

    for rotation in Rotation.random(50, rng=np.random.default_rng(0)):
        x, y, z, w = rotation.as_quat()
        ahead = rotation.apply([1.0, 0.0, 0.0])
        assert yaw(w, x, y, z) == pytest.approx(math.atan2(ahead[1], ahead[0]), abs=1e-9)


def test_names_of_dividers_become_kinds_of_lines():
    assert nuscenes_map.marking("NIL") is None
    assert nuscenes_map.marking("DOUBLE_SOLID_WHITE") is RoadKind.LINE_SOLID_DOUBLE_WHITE
    assert nuscenes_map.marking("SINGLE_ZIGZAG_WHITE") is RoadKind.LINE_SOLID_SINGLE_WHITE
    assert nuscenes_map.marking("SINGLE_SOLID_YELLOW") is RoadKind.LINE_SOLID_SINGLE_YELLOW


def test_large_tables_are_read_in_pieces(tmp_path):
    path = tmp_path / "table.json"
    table = [{"token": "é" * 50, "number": i, "list": [[1, {"a": "]},{"}]]} for i in range(30_000)]
    path.write_text(json.dumps(table, indent=0, ensure_ascii=False), encoding="utf-8")
    assert path.stat().st_size > 3 << 20
    assert list(rows(path)) == table


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("{}", "not a table"),
        ("", "not a table"),
        ('[{"a": 1}, {"b": ', "damaged after 1 rows"),
        ("[1]", "is not an object"),
    ],
)
def test_damaged_tables_are_refused(tmp_path, content, problem):
    path = tmp_path / "table.json"
    path.write_text(content)
    with pytest.raises(DataError, match=problem):
        list(rows(path))


def test_tables_of_too_many_or_too_long_rows_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps([{"token": "b" * 300}]))
    with pytest.raises(DataError, match="a row whose token is too long"):
        scene_rows(tmp_path)
    path.write_text(json.dumps([{"a": "b" * (3 << 20)}]))
    with pytest.raises(DataError, match="damaged after 0 rows"):
        list(rows(path))
    path.write_text(json.dumps([{"a": "b" * 1_050_000}]))  # in a chunk of 1 MiB and the next one
    with pytest.raises(DataError, match=r"damaged after 0 rows \(a row of more than 1,048,576 characters"):
        list(rows(path))
    path.write_text("[" + '{"a": 0},' * 101)
    monkeypatch.setattr(nuscenes_reader, "_MOST_ROWS", 100)
    with pytest.raises(DataError, match="more than 100 rows"):
        list(rows(path))


def test_a_scene_without_poses_does_not_stop_the_others(tmp_path):
    path = sample.write(tmp_path)
    scenes = json.loads(path.read_text())
    path.write_text(json.dumps([{**scenes[0], "token": "other", "name": "scene-0000"}, *scenes]))
    bad, good = NuScenes().read(path)
    assert isinstance(bad, BadRecord)
    assert (bad.record, good.scenario_id) == ("scene-0000", "scene-0001")
    assert "0 keyframes" in bad.problem


def test_lines_are_cut_where_they_leave_the_box():
    line = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [20.0, 50.0], [0.0, 50.0], [0.0, 1.0]])
    box = Box(np.array([-1.0, -1.0]), np.array([12.0, 5.0]))
    first, second = box.pieces(line)
    np.testing.assert_array_equal(first, line[:3])
    np.testing.assert_array_equal(second, line[4:])
    (whole,) = Box(np.array([-1.0, -1.0]), np.array([30.0, 60.0])).pieces(line)
    np.testing.assert_array_equal(whole, line)
    assert not list(Box(np.array([100.0, 100.0]), np.array([101.0, 101.0])).pieces(line))
