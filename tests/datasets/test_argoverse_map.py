"""Argoverse 2 maps against the hand-made sample, damage, and two real ones."""

from __future__ import annotations

import copy
import json
import math
from collections import Counter

import numpy as np
import pytest

from datasets.samples import av2_motion
from datasets.samples.av2_motion import IDS, OUTSIDE, height, place
from drivax.datasets.argoverse.map import read_map
from drivax.errors import DataError
from drivax.geometry.polylines import project
from drivax.scenario.build.lanes import lane_graph
from drivax.scenario.schema import LANE_KINDS, RoadKind


@pytest.fixture
def read(tmp_path):
    def _read(content, name="log_map_archive_x.json"):
        path = tmp_path / name
        path.write_text(json.dumps(content))
        return read_map(path)

    return _read


def lanes(found):
    return {f.feature_id: f for f in found.features if f.kind in LANE_KINDS}


def of_kind(found, kind):
    return [f for f in found.features if f.kind == kind]


@pytest.mark.parametrize("centrelines", [True, False])
def test_centre_lines_are_given_or_in_the_middle_of_boundaries(read, centrelines):
    """Centre lines as given in forecasting maps (their z = 0 is replaced), else the middle of the boundaries."""
    found = lanes(read(av2_motion.local_map(centrelines)))
    assert set(found) == set(IDS.values())
    slow = found[IDS["slow1"]]
    assert (slow.kind, slow.interpolating) == (RoadKind.LANE_SURFACE, False)
    assert found[IDS["slow2"]].interpolating and found[IDS["bike1"]].kind == RoadKind.LANE_BIKE
    assert slow.width_m == pytest.approx(3.5, abs=0.02)
    np.testing.assert_allclose(slow.points[[0, -1]], place([0.0, 60.0], 1.75), atol=0.011)
    x = slow.points[:, 0] - av2_motion.ORIGIN[0]
    np.testing.assert_allclose(slow.points[:, 2], height(x), atol=0.011)
    assert np.diff(x).max() <= 2.05 and (np.diff(x) > 0).all()
    back = found[IDS["oncoming1"]]
    assert back.points[0, 0] > back.points[-1, 0]


def test_centre_is_the_middle_of_curved_boundaries_of_unequal_point_counts(read):
    """Quarter circles of 20 and 24 m radius, with 5 and 60 points: the centre has a radius of 22 m."""
    content = av2_motion.local_map(centrelines=False)
    segment = content["lane_segments"][str(IDS["slow1"])]
    for side, radius, count in (("left", 20.0, 60), ("right", 24.0, 60)):
        angle = np.linspace(0, math.pi / 2, count)
        segment[f"{side}_lane_boundary"] = av2_motion.dots(radius * np.cos(angle), radius * np.sin(angle))
    segment["left_lane_boundary"] = segment["left_lane_boundary"][::6]
    segment["left_lane_boundary"].append(av2_motion.dots([0.0], [20.0])[0])
    centre = lanes(read(content))[IDS["slow1"]]
    radius = np.hypot(*(centre.points[:, :2] - av2_motion.ORIGIN).T)
    np.testing.assert_allclose(radius, 22.0, atol=0.05)
    assert centre.width_m == pytest.approx(4.0, abs=0.05)


def test_a_bus_lane_is_for_cars_and_an_unknown_one_is_undefined(read):
    content = av2_motion.local_map()
    content["lane_segments"][str(IDS["slow1"])]["lane_type"] = "BUS"
    content["lane_segments"][str(IDS["fast1"])]["lane_type"] = "TRAM"
    found = lanes(read(content))
    assert found[IDS["slow1"]].kind == RoadKind.LANE_SURFACE
    assert found[IDS["fast1"]].kind == RoadKind.LANE_UNDEFINED


def test_check_list_11_dangling_links_are_kept_here_and_dropped_from_the_graph(read):
    found = read(av2_motion.local_map())
    slow = lanes(found)[IDS["slow2"]]
    assert slow.successors == (OUTSIDE,) and slow.predecessors == (IDS["slow1"],)
    graph = lane_graph(found.features, np.zeros(3))
    index = graph.index()
    assert graph.successor[index[IDS["slow1"]]].tolist() == [index[IDS["slow2"]], -1, -1, -1]
    assert (graph.successor[index[IDS["slow2"]]] == -1).all()
    assert not graph.chained


def test_check_list_13_oncoming_neighbours_are_given_but_no_lane_changes(read):
    """Neighbour direction test: left_neighbor_id is an oncoming lane in most real cases."""
    found = read(av2_motion.local_map())
    fast, back = lanes(found)[IDS["fast1"]], lanes(found)[IDS["oncoming1"]]
    assert fast.left_neighbours == (back.feature_id,) and back.left_neighbours == (fast.feature_id,)
    graph = lane_graph(found.features, np.zeros(3))
    index = graph.index()
    fast, back, slow = (index[IDS[name]] for name in ("fast1", "oncoming1", "slow1"))
    assert graph.left[fast] == -1 and graph.left[back] == -1
    assert graph.left[slow] == fast and graph.right[fast] == slow


def test_check_list_22_ids_of_nine_digits_survive(read):
    """Integer lane ids never pass through float32."""
    content = av2_motion.local_map()
    segment = content["lane_segments"].pop(str(IDS["bike1"]))
    content["lane_segments"]["205119121"] = segment | {"id": 205_119_121}
    assert 205_119_121 in lanes(read(content)) and int(np.float32(205_119_121)) != 205_119_121


def test_names_of_unknown_elements_and_fields_are_counted(read):
    content = av2_motion.local_map() | {"traffic_lights": {}}
    for segment in content["lane_segments"].values():
        segment["speed_limit"] = 13.4
    assert read(content).lost == {"unknown_fields": 2}


def test_painted_lines_are_read_once_and_unpainted_ones_left_out(read):
    """Both lanes next to a line name it; the oncoming ones from the other end and with other points between."""
    found = read(av2_motion.local_map())
    counts = Counter(f.kind for f in found.features if 5 <= f.kind <= 13)
    assert counts[RoadKind.LINE_SOLID_SINGLE_WHITE] == 2 * 2  # bike|slow is drawn with 3 and with 2 points
    assert RoadKind.LINE_UNKNOWN not in counts
    content = av2_motion.local_map()
    for name in ("slow1", "fast1"):
        for side, y in (("left", 3.5), ("right", 3.5)):
            if content["lane_segments"][str(IDS[name])][f"{side}_lane_mark_type"] == "DASHED_WHITE":
                content["lane_segments"][str(IDS[name])][f"{side}_lane_boundary"] = av2_motion.dots(
                    [0, 60], y
                )
    lines = of_kind(read(content), RoadKind.LINE_BROKEN_SINGLE_WHITE)
    west = [line for line in lines if line.points[:, 0].max() <= av2_motion.ORIGIN[0] + 60.01]
    assert len(west) == 1
    for segment in content["lane_segments"].values():
        segment["left_lane_boundary"] = segment["left_lane_boundary"][::-1]
    assert len(of_kind(read(content), RoadKind.LINE_BROKEN_SINGLE_WHITE)) == len(lines)


@pytest.mark.parametrize(
    ("mark", "kind"),
    [
        ("SOLID_YELLOW", RoadKind.LINE_SOLID_SINGLE_YELLOW),
        ("DOUBLE_DASH_YELLOW", RoadKind.LINE_BROKEN_DOUBLE_YELLOW),
        ("SOLID_DASH_YELLOW", RoadKind.LINE_PASSING_DOUBLE_YELLOW),
        ("DASH_SOLID_YELLOW", RoadKind.LINE_PASSING_DOUBLE_YELLOW),
        ("DOUBLE_SOLID_WHITE", RoadKind.LINE_SOLID_DOUBLE_WHITE),
        ("SOLID_BLUE", RoadKind.LINE_UNKNOWN),
        ("UNKNOWN", RoadKind.LINE_UNKNOWN),
    ],
)
def test_marks_become_kinds_of_lines(read, mark, kind):
    content = av2_motion.local_map()
    content["lane_segments"][str(IDS["bike1"])]["right_lane_mark_type"] = mark
    outermost = [
        f for f in of_kind(read(content), kind) if abs(f.points[0, 1] - av2_motion.ORIGIN[1] + 1.5) < 0.02
    ]
    assert len(outermost) == 1


def test_check_list_7_edges_of_joined_areas_have_the_road_on_their_left(read):
    """The areas are clockwise and cut at a tile border; the edge is one anticlockwise ring around both."""
    (edge,) = of_kind(read(av2_motion.local_map()), RoadKind.EDGE_BOUNDARY)
    x, y = edge.points[:, 0], edge.points[:, 1]
    assert 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) == pytest.approx(120 * 13, rel=1e-3)
    np.testing.assert_allclose(edge.points[:, 2], height(x - av2_motion.ORIGIN[0]), atol=0.02)
    np.testing.assert_array_equal(edge.points[0], edge.points[-1])


def test_crossings_are_polygons(read):
    (walk,) = of_kind(read(av2_motion.local_map()), RoadKind.CROSSWALK)
    np.testing.assert_allclose(walk.points, place([30, 30, 34, 34], [-2, 11, 11, -2]), atol=0.011)


def test_every_feature_has_an_id_of_its_own(read):
    found = read(av2_motion.local_map())
    ids = [f.feature_id for f in found.features]
    assert len(set(ids)) == len(ids) and min(ids) > 0


def test_lanes_without_length_are_counted(read):
    content = av2_motion.local_map()
    segment = content["lane_segments"][str(IDS["bike1"])]
    segment["left_lane_boundary"] = segment["left_lane_boundary"][:1]
    found = read(content)
    assert found.lost == {"lanes_without_length": 1} and IDS["bike1"] not in lanes(found)


def _set(path, value):
    def change(content):
        for key in path[:-1]:
            content = content[key]
        if value is KeyError:
            del content[path[-1]]
        else:
            content[path[-1]] = value

    return change


SLOW = ("lane_segments", str(IDS["slow1"]))
BROKEN = {
    "is not an Argoverse 2 map": _set(("drivable_areas",), KeyError),
    "left_lane_boundary is not a list of points": _set((*SLOW, "left_lane_boundary"), [{"x": 1.0}]),
    "right_lane_boundary is not a list": _set((*SLOW, "right_lane_boundary"), None),
    "area_boundary is not a list": _set(("drivable_areas", "11055391", "area_boundary"), "x"),
    "edge2 is not a list": _set(("pedestrian_crossings", "13294505", "edge2"), KeyError),
    "successors is not a list": _set((*SLOW, "successors"), 17),
    "is not an id": _set((*SLOW, "id"), 10**30),
    "'x' is not an id": _set((*SLOW, "left_neighbor_id"), "x"),
    "not finite": _set((*SLOW, "centerline", 3, "x"), math.nan),
    "beyond 1e+06": _set((*SLOW, "left_lane_boundary", 1, "y"), 1e300),
    "km away from the others": _set((*SLOW, "left_lane_boundary", 1, "y"), 9e5),
}  # fmt: skip


@pytest.mark.parametrize("problem", BROKEN)
def test_damage_is_refused_in_one_line(read, tmp_path, problem):
    content = copy.deepcopy(av2_motion.local_map())
    BROKEN[problem](content)
    with pytest.raises(DataError) as caught:
        read(content)
    line = str(caught.value)
    assert line.startswith(str(tmp_path / "log_map_archive_x.json")) and problem in line and "\n" not in line
    assert caught.value.cure


def test_other_json_and_missing_files_are_refused(read, tmp_path):
    for content in ([], 3, {}, {"lane_segments": [], "drivable_areas": {}, "pedestrian_crossings": {}}):
        with pytest.raises(DataError, match="is not an Argoverse 2 map"):
            read(content)
    with pytest.raises(DataError, match="file not found"):
        read_map(tmp_path / "log_map_archive_y.json")
    empty = {"lane_segments": {}, "drivable_areas": {}, "pedestrian_crossings": {}}
    assert read(empty).features == ()


# --- Real maps (shared/data/README.md counts them by an independent reader).


@pytest.fixture(scope="module", params=["forecasting", "sensor"])
def real(request, real_data):
    folder = {"forecasting": "av2", "sensor": "av2_sensor"}[request.param]
    (path,) = (real_data / folder).rglob("log_map_archive_*.json")
    return request.param, read_map(path), json.loads(path.read_bytes())


def test_real_maps_have_the_published_numbers_of_elements(real):
    name, found, content = real
    kinds = Counter(lane.kind for lane in lanes(found).values())
    wanted = {
        "forecasting": {RoadKind.LANE_SURFACE: 34, RoadKind.LANE_BIKE: 37},
        "sensor": {RoadKind.LANE_SURFACE: 150},
    }
    assert kinds == wanted[name] and found.lost == {}
    assert len(of_kind(found, RoadKind.CROSSWALK)) == 6
    assert len(of_kind(found, RoadKind.EDGE_BOUNDARY)) == 2  # one outline, one island
    assert len(lanes(found)) == len(content["lane_segments"])


def test_real_lanes_meet_their_successors_and_lie_between_their_boundaries(real):
    _, found, content = real
    by_id = lanes(found)
    for lane in by_id.values():
        for link in lane.successors:
            if link in by_id:
                np.testing.assert_allclose(lane.points[-1], by_id[link].points[0], atol=0.05)
        segment = content["lane_segments"][str(lane.feature_id)]
        sides = {}
        for side in ("left", "right"):
            line = np.array([(p["x"], p["y"]) for p in segment[f"{side}_lane_boundary"]])
            _, sides[side] = project(line, lane.points[:, :2])
        assert np.abs(sides["left"] - sides["right"]).max() < 0.45 * lane.width_m
        assert 1.2 < lane.width_m < 8.0


def test_real_edges_agree_with_the_drivable_areas(real):
    """Half a metre left of every edge is in a drivable area, half a metre right of it is not."""
    import shapely

    _, found, content = real
    areas = [
        shapely.Polygon([(p["x"], p["y"]) for p in area["area_boundary"]])
        for area in content["drivable_areas"].values()
    ]
    for edge in of_kind(found, RoadKind.EDGE_BOUNDARY):
        a, b = edge.points[:-1, :2], edge.points[1:, :2]
        length = np.hypot(*(b - a).T)
        a, b, length = a[length > 1.5], b[length > 1.5], length[length > 1.5]
        off = 0.5 * np.column_stack((a[:, 1] - b[:, 1], b[:, 0] - a[:, 0])) / length[:, None]
        middle = (a + b) / 2
        left, right = ([area.contains(shapely.points(middle + s * off)) for area in areas] for s in (1, -1))
        assert np.any(left, axis=0).all() and not np.any(right, axis=0).any()
