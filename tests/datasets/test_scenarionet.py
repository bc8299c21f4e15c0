"""The ScenarioNet reader against hand-made dictionaries with known answers, damage, and four real files."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets.samples import scenarionet as sample
from drivax.datasets import parsing
from drivax.datasets.reader import BadRecord, Reader
from drivax.datasets.scenarionet import pickles
from drivax.datasets.scenarionet.map import (
    has_headings,
    in_ring,
    orient_edges,
    orient_outlines,
)
from drivax.datasets.scenarionet.reader import ScenarioNet, decode
from drivax.errors import DataError
from drivax.geometry.polylines import point_to_segment
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import MapFeature, Recording, windows
from drivax.scenario.schema import EDGE_KINDS, LANE_KINDS, AgentKind, Flag, LightState, RoadKind


@pytest.fixture
def tree() -> dict[str, Any]:
    return sample.scenario()


def by_id(recording: Recording) -> dict[int, MapFeature]:
    return {feature.feature_id: feature for feature in recording.features}


# --- WOMD's flavour.


def test_recording_has_id_data_set_and_ego(tree):
    recording = decode(tree)
    assert (recording.scenario_id, recording.segment) == ("0123456789abcdef",) * 2
    assert (recording.dataset, recording.current_step, recording.ego) == ("womd", 10, 2)
    assert recording.tags == {"source_format": "scenarionet"}
    assert recording.split_gap_m == 1.0 and recording.flags == Flag.NONE
    np.testing.assert_allclose(recording.timestamps_s, np.arange(91) * 0.1, atol=1e-6)


def test_22_whole_number_ids_are_kept(tree):
    recording = decode(tree)
    assert recording.tracks.track_id.tolist() == [17, 23, 2406]
    assert [f.feature_id for f in recording.features] == [1, 2, 4, 5, 7, 8, 9, 10, 11]
    tree["map_features"][str(2**40 + 1)] = tree["map_features"].pop(
        "2"
    )  # more than a float32 or an int32 holds
    assert decode(tree).features[-1].feature_id == 2**40 + 1


def test_11_other_ids_become_dense_numbers_of_the_file(tree):
    """nuScenes and nuPlan have tokens: numbered in order, none hashed, shortened or lost."""
    tokens = {name: f"{i:x}fc8a39b-2fd9-{'ab'[i % 2] * 18}" for i, name in enumerate(tree["map_features"])}
    tree["map_features"] = {tokens[name]: body for name, body in tree["map_features"].items()}
    for body in tree["map_features"].values():
        body["exit_lanes"] = [tokens[str(link)] for link in body.get("exit_lanes", []) if str(link) in tokens]
        body["entry_lanes"] = []
    tree["tracks"] = {f"token-{name}": body for name, body in tree["tracks"].items()}
    tree["metadata"] |= {"sdc_id": "token-2406", "objects_of_interest": ["token-23", "gone"]}
    recording = decode(tree)
    assert recording.tracks.track_id.tolist() == [0, 1, 2] and recording.ego == 2
    assert recording.of_interest == (1,)
    # Sidewalks are left out, their number is not given away.
    assert [f.feature_id for f in recording.features] == list(range(9))
    assert by_id(recording)[0].successors == (1, 2)


def test_19_ids_of_agents_become_rows(tree):
    recording = decode(tree)
    assert recording.to_predict == (1,) and recording.of_interest == (0,)


def test_links_are_numbers_texts_and_neighbours(tree):
    lanes = by_id(decode(tree))
    assert lanes[1].successors == (2, 4) and lanes[2].predecessors == (1,)
    assert lanes[1].left_neighbours == (5,) and lanes[5].right_neighbours == (1,)
    assert lanes[4].successors == () and lanes[4].interpolating
    assert decode(tree).lost["dangling_links"] == 1
    assert lanes[9].lanes == (4,)


def test_12_units_of_speed_limits(tree):
    lanes = tree["map_features"]
    lanes["4"] |= {"speed_limit_mph": None, "speed_limit_kmh": 36.0}
    lanes["5"] |= {"speed_limit_mph": 0.0, "speed_limit_kmh": 1000.0}  # MetaDrive's word for none
    found = by_id(decode(tree))
    assert found[1].limit_mps == pytest.approx(25 * 1609.344 / 3600)
    assert found[2].limit_mps is None  # 0 means unknown
    assert found[4].limit_mps == pytest.approx(10.0)
    assert found[5].limit_mps is None


@pytest.mark.parametrize("dataset", ["nuscenes", "nuplan", "av2"])
def test_invented_limits_are_unknown(tree, dataset):
    tree["metadata"]["dataset"] = dataset
    recording = decode(tree)
    assert all(f.limit_mps is None for f in recording.features)
    assert recording.lost["made_up_speed_limits"] == 3


def test_widths_are_the_sum_of_both_sides_where_both_are_known(tree):
    lanes = tree["map_features"]
    lanes["2"]["width"] = np.full((201, 2), 1.7, np.float32)  # one side copied to the other
    lanes["4"]["width"] = np.tile(np.array([[12.0, 13.0]]), (81, 1))  # matched to the wrong place
    lanes["5"]["width"] = np.zeros((361, 2), np.float32)
    found = by_id(decode(tree))
    assert found[1].width_m == pytest.approx(3.5, abs=1e-6)
    assert [found[i].width_m for i in (2, 4, 5)] == [None, None, None]


def test_kinds_of_features(tree):
    kinds = {number: feature.kind for number, feature in by_id(decode(tree)).items()}
    assert kinds == {
        1: RoadKind.LANE_SURFACE, 2: RoadKind.LANE_SURFACE, 4: RoadKind.LANE_SURFACE, 5: RoadKind.LANE_SURFACE,
        7: RoadKind.EDGE_BOUNDARY, 8: RoadKind.LINE_BROKEN_SINGLE_WHITE, 9: RoadKind.STOP_SIGN,
        10: RoadKind.CROSSWALK, 11: RoadKind.SPEED_BUMP,
    }  # fmt: skip
    assert decode(tree).lost["features_of_other_types"] == 1  # the sidewalk


def test_10_lights_are_by_lane_with_minus_one_where_unobserved(tree):
    (light,) = decode(tree).lights
    assert light.lane_id == 2
    assert light.states.tolist() == [LightState.STOP] * 30 + [-1] * 10 + [LightState.GO] * 51
    np.testing.assert_array_equal(light.stop_point, [sample.X + 20, sample.Y, sample.Z])


def test_10_yellow_is_mapped_and_nuplan_lights_stand_at_the_line(tree):
    """nuPlan's converter writes colours and a stop point 8 m behind the line."""
    words = ["RED", "YELLOW", "GREEN", "UNKNOWN", "PURPLE"]
    states = [f"TRAFFIC_LIGHT_{word}" for word in words] + [None] * (sample.STEPS - 5)
    tree["dynamic_map_states"]["2"] |= {
        "state": {"object_state": states},
        "lane": "2",
        "stop_point": [1.0, 2.0],
    }
    tree["dynamic_map_states"]["77"] = copy.deepcopy(tree["dynamic_map_states"]["2"]) | {"lane": "77"}
    tree["metadata"]["dataset"] = "nuplan"
    recording = decode(tree)
    (light,) = recording.lights
    assert light.states[:6].tolist() == [4, 5, 6, 0, 0, -1]
    np.testing.assert_array_equal(light.stop_point, by_id(recording)[2].points[0])
    assert recording.lost["lights_without_lane"] == 1


def test_1_headings_are_wrapped_and_4_invalid_states_are_zero(tree):
    state = tree["tracks"]["17"]["state"]
    state["valid"][50:] = False
    state["heading"][:] = 7.0
    tracks = decode(tree).tracks
    assert tracks.heading[0, 0] == pytest.approx(7.0 - 2 * math.pi, abs=1e-6)
    for values in (tracks.xy, tracks.z, tracks.heading, tracks.velocity, tracks.size):
        assert not values[0, 50:].any() and values[0, :50].any()


def test_shapes_and_types_of_other_converters(tree):
    """nuScenes: float64, valid as floats, sizes [time, 1]; lists instead of arrays read the same."""
    wanted = decode(copy.deepcopy(tree)).tracks
    for track in tree["tracks"].values():
        state = track["state"]
        state["valid"] = state["valid"].astype(np.float64)
        for name in ("length", "width", "height"):
            state[name] = state[name].astype(np.float64)[:, None]
        state["heading"] = state["heading"].tolist()
        state["position"] = [tuple(row) for row in state["position"].tolist()]
    found = decode(tree).tracks
    for name in ("xy", "z", "heading", "velocity", "size", "valid", "kind"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_kinds_of_agents(tree):
    for name, kind in {"17": "TRAFFIC_CONE", "23": "HORSE"}.items():
        tree["tracks"][name]["type"] = kind
    assert decode(tree).tracks.kind.tolist() == [AgentKind.STATIC, AgentKind.OTHER, AgentKind.VEHICLE]


def test_first_form_reads_as_the_present_one(tree):
    present, first = decode(copy.deepcopy(tree)), decode(sample.first_form(tree))
    for name in ("xy", "z", "heading", "velocity", "size", "valid"):
        np.testing.assert_array_equal(getattr(first.tracks, name), getattr(present.tracks, name))
    kinds = [f.kind for f in present.features if f.kind != RoadKind.STOP_SIGN]
    assert [f.kind for f in first.features if f.kind != RoadKind.STOP_SIGN] == kinds
    for a, b in zip(first.features, present.features, strict=True):
        np.testing.assert_array_equal(a.points, b.points)
    (a,), (b,) = first.lights, present.lights
    np.testing.assert_array_equal(a.states, b.states)
    np.testing.assert_allclose(a.stop_point, b.stop_point)
    assert dict(first.lost) == dict(present.lost)


def test_unknown_and_unobserved_lights_of_the_first_form_differ(tree):
    """State 0 with a stop point is unknown; without one nothing was observed."""
    state = sample.first_form(tree)["dynamic_map_states"]["2"]["state"]
    state["object_state"][0], state["object_state"][1] = 0, 9
    recording = decode(tree)
    assert recording.lights[0].states[[0, 1, 2, 30]].tolist() == [0, 0, 4, -1]
    assert recording.lost["unknown_light_states"] == 1


def test_stop_points_of_zeros_are_none(tree):
    tree["dynamic_map_states"]["2"]["stop_point"] = np.zeros(3, np.float32)
    (light,) = decode(tree).lights
    np.testing.assert_array_equal(light.stop_point, by_id(decode(tree))[2].points[0])


def test_stop_points_without_height_lie_on_their_lane(tree):
    tree["dynamic_map_states"]["2"]["stop_point"] = (sample.X + 19.0, sample.Y)
    (light,) = decode(tree).lights
    np.testing.assert_allclose(light.stop_point, [sample.X + 19.0, sample.Y, sample.Z])


def test_round_objects_of_metadrive_have_a_radius(tree):
    state = tree["tracks"]["17"]["state"]
    del state["length"], state["width"]
    state["radius"] = np.full((sample.STEPS, 1), 0.25)
    height = decode(tree).tracks.size[0, 0, 2]
    np.testing.assert_allclose(decode(tree).tracks.size[0, 0], [0.5, 0.5, height])


def test_fields_of_unknown_names_are_counted(tree):
    tree["tracks"]["17"]["state"] |= {"bbox": np.zeros(sample.STEPS), "steering": np.zeros(sample.STEPS)}
    tree["map_features"]["1"] |= {"slope": 3.0, "left_boundaries": []}
    tree["map_features"]["2"] |= {"slope": 3.0}
    lost = decode(tree).lost
    assert lost["unknown_fields"] == 2 and "unknown_fields" not in decode(sample.scenario()).lost


# --- The frame.


def assert_same_places(found: Recording, expected: Recording) -> None:
    np.testing.assert_allclose(found.tracks.xy, expected.tracks.xy, atol=1e-6)
    for a, b in zip((*found.features, *found.lights), (*expected.features, *expected.lights), strict=True):
        name = "points" if isinstance(a, MapFeature) else "stop_point"
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-6)


def test_origin_that_metadrive_moved_is_moved_back(tree):
    expected = decode(copy.deepcopy(tree))
    sample.recentred(tree, (8300.0, 8900.0))["metadata"]["old_origin_in_current_coordinate"] = np.array(
        [-8300.0, -8900.0]
    )
    assert_same_places(decode(tree), expected)


@pytest.mark.parametrize("name", ["old_origin_in_current_coordinate", "map_center"])
@pytest.mark.parametrize("value", [[np.nan, 0.0], [1e9, 0.0], [0.0], "here", {}])
def test_origins_that_are_no_position_are_refused(tree, name, value):
    tree["metadata"][name] = value
    with pytest.raises(DataError, match=name):
        decode(tree)


def test_origin_of_nuscenes_shows_in_its_invalid_states(tree):
    """They were zeros before the converter took the first position of the ego from all positions."""
    state = tree["tracks"]["17"]["state"]
    state["valid"][50:], state["position"][50:] = False, 0.0
    expected = decode(copy.deepcopy(sample.nuscenes(copy.deepcopy(tree))))
    moved = sample.recentred(sample.nuscenes(tree), (8300.0, 8900.0))
    assert_same_places(decode(moved), expected)
    moved["tracks"]["17"]["state"]["position"][60] += 1.0  # they disagree: the file's frame stays
    np.testing.assert_allclose(
        decode(moved).tracks.xy[1], expected.tracks.xy[1] - [8300.0, 8900.0], atol=1e-6
    )


# --- nuScenes' flavour.


@pytest.mark.parametrize(
    ("identity", "segment"),
    [
        ("scene-0103", "scene-0103"),
        ("scene-0103" + sample.TOKENS[:33], "scene-0103"),
        ("scene-0103" + sample.TOKENS, "scene-0103"),
        ("scene-0103_0", "scene-0103_0"),
        ("a" + sample.TOKENS, "a" + sample.TOKENS),
    ],
)
def test_windows_of_a_nuscenes_scene_share_its_segment(tree, identity, segment):
    sample.nuscenes(tree)["id"] = identity
    assert (decode(tree).scenario_id, decode(tree).segment) == (identity, segment)


def test_14_yaw_in_the_third_column_is_not_a_height(tree):
    recording = decode(sample.nuscenes(tree))
    assert all((f.points[:, 2] == 0).all() for f in recording.features)
    # Agents stand on the plane, whatever heights they had.
    np.testing.assert_allclose(recording.tracks.z[:, 0], [0.8, 0.9, 1.0], atol=1e-6)


def test_14_heights_are_no_yaw():
    course = np.linspace(0.0, 2.0, 50)
    arc = np.stack((np.sin(course) * 20, 20 - np.cos(course) * 20), axis=1)
    slope = np.linspace(0.0, 2.0, 50)
    assert has_headings([np.column_stack((arc, course))])
    assert has_headings([np.column_stack((arc, course - 2 * math.pi))])
    assert not has_headings([np.column_stack((arc, 30.0 + slope))])
    assert not has_headings([np.column_stack((arc[::-1], course[::-1]))])  # driven the other way
    assert not has_headings([])


def test_17_velocity_is_recomputed_where_it_was_zeroed(tree):
    recording = decode(sample.nuscenes(tree))
    assert Flag.DIFFERENTIATED_VELOCITY in recording.flags
    np.testing.assert_allclose(recording.tracks.velocity[0], [[9.0, 0.0]] * sample.STEPS, atol=0.01)
    np.testing.assert_allclose(recording.tracks.velocity[2], [[10.0, 0.0]] * sample.STEPS, atol=0.01)


def test_17_measured_velocity_is_kept(tree):
    tree["tracks"]["17"]["state"]["velocity"][:] = (8.5, 0.25)
    recording = decode(tree)
    assert Flag.DIFFERENTIATED_VELOCITY not in recording.flags
    np.testing.assert_array_equal(recording.tracks.velocity[0, 40], [8.5, 0.25])


def test_ego_of_nuscenes_has_a_cars_size_and_box_centre(tree):
    """The converter swaps its length and width, and its poses are of the rear axle, 1.385 m behind the centre."""
    state = sample.nuscenes(tree)["tracks"]["ego"]["state"]
    axle = state["position"][:, :2].astype(np.float64)
    recording = decode(tree)
    np.testing.assert_allclose(recording.tracks.size[2, 0], [5.3, 2.3, 2.0], atol=1e-6)
    np.testing.assert_allclose(recording.tracks.xy[2] - axle, [[1.385, 0.0]] * sample.STEPS, atol=1e-9)


def test_7_outlines_of_nuscenes_become_edges_with_the_road_on_the_left(tree):
    recording = decode(sample.nuscenes(tree))
    edges = [f for f in recording.features if f.kind in EDGE_KINDS]
    assert len(edges) == 2 and {f.kind for f in edges} == {RoadKind.EDGE_BOUNDARY}
    assert on_left(np.array([[sample.X, sample.Y], [sample.X + 55, sample.Y]]), edges).tolist() == [
        True,
        True,
    ]
    assert on_left(
        np.array([[sample.X, sample.Y - 5], [sample.X + 55, sample.Y + 1.75]]), edges
    ).tolist() == [False, False]
    scenario = assemble(recording)
    assert Flag.CHAINED_GRAPH in scenario.has and Flag.CLOSED_EDGES in scenario.has


def test_place_and_current_step(tree):
    recording = decode(sample.nuscenes(tree))
    assert recording.tags["place"] == "boston" and recording.current_step == 10
    tree["metadata"] |= {"map": "sg-one-north", "log_name": "2021.08.17.log"}
    assert decode(tree).tags["location"] == "sg-one-north"
    assert decode(tree).tags["place"] == "singapore" and decode(tree).segment == "2021.08.17.log"


def test_argoverse_files_have_class_sizes_and_no_heights_of_agents(tree):
    tree["metadata"]["dataset"] = "av2"
    for track in tree["tracks"].values():
        track["state"]["position"][:, 2] = 0.0
    recording = decode(tree)
    assert Flag.DEFAULT_SIZES in recording.flags
    np.testing.assert_allclose(recording.tracks.z[:, 0], sample.Z + np.array([0.8, 0.9, 1.0]), atol=1e-6)
    assert not any(f.interpolating for f in recording.features)


# --- Which side of an edge is drivable.


def on_left(xy: np.ndarray, edges: list[MapFeature]) -> np.ndarray:
    """Whether points are left of their nearest edge segment; at a vertex the more perpendicular one decides."""
    a = np.concatenate([f.points[:-1, :2] for f in edges])
    b = np.concatenate([f.points[1:, :2] for f in edges])
    long = np.hypot(*(b - a).T) > 1e-9
    a, b = a[long], b[long]
    distance, _ = point_to_segment(xy[:, None], a[None], b[None])
    unit = (b - a) / np.hypot(*(b - a).T)[:, None]
    offset = xy[:, None] - a[None]
    side = unit[None, :, 0] * offset[..., 1] - unit[None, :, 1] * offset[..., 0]
    near = distance <= distance.min(axis=1, keepdims=True) + 1e-6
    return np.where(near, side, 0.0).max(axis=1) > np.where(near, -side, 0.0).max(axis=1)


def ring(x: float, y: float, half: float, clockwise: bool) -> np.ndarray:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], dtype=np.float64) * half
    points = np.pad(corners + (x, y), ((0, 0), (0, 1)))  # noqa: RUF005
    return points[::-1].copy() if clockwise else points


@pytest.mark.parametrize("clockwise", [False, True])
def test_7_rings_in_rings_alternate(clockwise):
    """Area, hole, area inside the hole, and a second area, for any original orientation."""
    rings = [ring(0, 0, half, clockwise) for half in (50.0, 30.0, 10.0)] + [ring(200, 0, 5.0, clockwise)]
    shapely = pytest.importorskip("shapely")
    turned = orient_outlines(rings)
    assert [shapely.LinearRing(points).is_ccw for points in turned] == [True, False, True, True]


def test_7_outlines_agree_with_shapely():
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(3)
    circles = [
        shapely.Point(*xy).buffer(r)
        for xy, r in zip(rng.uniform(0, 100, (60, 2)), rng.uniform(4, 14, 60), strict=True)
    ]
    area = shapely.union_all(circles)
    polygons = [area] if area.geom_type == "Polygon" else list(area.geoms)
    outlines = [line for part in polygons for line in (part.exterior, *part.interiors)]
    lines = [np.pad(np.array(line.coords), ((0, 0), (0, 1))) for line in outlines]
    mixed = [points[:: rng.choice((-1, 1))].copy() for points in lines]
    exterior = [line.equals(p.exterior) for p in polygons for line in (p.exterior, *p.interiors)]
    assert not all(exterior)
    assert [shapely.LinearRing(points).is_ccw for points in orient_outlines(mixed)] == exterior


def test_inside_agrees_with_shapely():
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(4)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 40))
    star = np.stack((np.cos(angle), np.sin(angle)), axis=1) * rng.uniform(1, 10, (40, 1))
    star = np.concatenate((star, star[:1]))
    points = rng.uniform(-10, 10, (500, 2))
    wanted = shapely.contains_xy(shapely.Polygon(star), points)
    np.testing.assert_array_equal(in_ring(points, star), wanted)


def test_7_edges_of_metadrive_turn_to_their_lanes():
    """MetaDrive draws both borders along the lane: the left one has the road on its right."""
    x = np.arange(0.0, 50.0)
    lane = np.stack((x, np.zeros(50), np.zeros(50)), axis=1)
    right, left, far = lane - (0, 2, 0), lane + (0, 2, 0), lane + (0, 500, 0)  # noqa: RUF005
    turned = orient_edges([right, left, far, left[:1]], [lane])
    np.testing.assert_array_equal(turned[0], right)
    np.testing.assert_array_equal(turned[1], left[::-1])
    np.testing.assert_array_equal(turned[2], far)
    np.testing.assert_array_equal(turned[3], left[:1])


def test_7_edges_of_womd_are_not_turned(tree):
    points = tree["map_features"]["7"]["polyline"]
    tree["map_features"]["7"]["polyline"] = points[::-1]
    np.testing.assert_array_equal(by_id(decode(tree))[7].points, points[::-1])
    tree["metadata"]["dataset"] = "metadrive"
    np.testing.assert_array_equal(by_id(decode(tree))[7].points, points)


# --- Files.


def written(tree: Any, folder: Path, name: str = "sd_a.pkl") -> Path:
    path = folder / name
    path.write_bytes(pickle.dumps(tree))
    return path


def test_reader_recognises_counts_reads_and_describes(tree, tmp_path):
    path = sample.write(tmp_path)
    reader = ScenarioNet()
    assert isinstance(reader, Reader) and reader.recognise(path) and reader.count(path) == 1
    (recording,) = reader.read(path)
    assert isinstance(recording, Recording) and recording.scenario_id == "0123456789abcdef"
    described = reader.describe(path)
    assert described.dataset == "Waymo Open Motion Dataset, by ScenarioNet"
    assert (described.version, described.recordings, described.notes) == ("v1.2", 1, ())
    scenario = assemble(recording)
    assert {Flag.LIGHTS, Flag.LANE_GRAPH, Flag.SPEED_LIMITS} <= set(scenario.has)
    assert not scenario.has & (Flag.CHAINED_GRAPH | Flag.NO_FUTURE)


def test_description_names_what_is_missing(tree, tmp_path):
    described = ScenarioNet().describe(written(sample.nuscenes(tree), tmp_path))
    assert described.dataset == "nuScenes, by ScenarioNet"
    assert [note.split(":")[0] for note in described.notes] == [
        "no lane graph", "no traffic lights", "velocities are taken from the positions"
    ]  # fmt: skip


def test_description_and_windows_tell_of_frames_off_their_time(tree, tmp_path):
    tree["metadata"]["ts"][50:] += 0.1  # frame 50 was dropped
    path = written(tree, tmp_path)
    assert ScenarioNet().describe(path).notes == (parsing.UNEVEN,)
    (window,) = windows(decode(tree))
    assert assemble(window).source.lost["interpolated_steps"] == 1


def test_long_files_are_counted_by_their_windows(tmp_path):
    path = written({"id": "a", "version": "v", "length": 199, "metadata": {}, "tracks": {}}, tmp_path)
    assert ScenarioNet().count(path) == 3
    assert ScenarioNet().count(tmp_path / "gone.pkl") == 0


@pytest.mark.parametrize("content", [b"", b"\x80\x04N.", b"PK\x03\x04version length tracks", b"\x89PNG"])
def test_other_files_are_not_recognised(tmp_path, content):
    path = tmp_path / "sd_x.pkl"
    path.write_bytes(content)
    assert not ScenarioNet().recognise(path) and not ScenarioNet().recognise(tmp_path)
    summary = written({"sd_a.pkl": {"id": "a", "object_summary": {}}}, tmp_path, "dataset_summary.pkl")
    assert not ScenarioNet().recognise(summary)


def _without(name: str) -> Callable[[dict[str, Any]], Any]:
    return lambda tree: tree.pop(name)


BROKEN: dict[str, Callable[[dict[str, Any]], Any]] = {
    "the file has no dictionary 'metadata'": _without("metadata"),
    "the file has no dictionary 'tracks'": _without("tracks"),
    "the file has no dictionary 'map_features'": _without("map_features"),
    "the file has no dictionary 'dynamic_map_states'": _without("dynamic_map_states"),
    "the ego 'gone' is not one of 3 tracks": lambda tree: tree["metadata"].update(sdc_id="gone"),
    "the ego 'ego' is not one": lambda tree: tree["metadata"].pop("sdc_id"),
    "has 40 values of heading for 91 steps": lambda tree: tree["tracks"]["17"]["state"].update(heading=np.zeros(40)),
    "has a velocity of shape (91, 1)": lambda tree: tree["tracks"]["17"]["state"].update(velocity=np.zeros(91)),
    "has no position": lambda tree: tree["tracks"]["17"]["state"].pop("position"),
    "position are not rows of numbers": lambda tree: tree["tracks"]["17"]["state"].update(position=["x"] * 91),
    "not finite or beyond 1e+07": lambda tree: tree["tracks"]["17"]["state"]["position"].fill(np.nan),
    "not finite or beyond 1000": lambda tree: tree["tracks"]["17"]["state"]["velocity"].fill(1e30),
    "position are not numbers": lambda tree: tree["tracks"]["17"]["state"].update(position=np.zeros((91, 9))),
    "0 steps": lambda tree: tree["tracks"]["2406"]["state"].update(position=np.zeros((0, 3))),
    "3 tracks of 2000000 steps": lambda tree: tree["tracks"]["2406"]["state"].update(
        position=np.zeros((2_000_000, 3), np.int8)
    ),
    "timestamps of shape (90,)": lambda tree: tree["metadata"].update(ts=np.arange(90)),
    "timestamps do not increase": lambda tree: tree["metadata"].update(ts=np.zeros(91)),
    "current_time_index is 91 of 91": lambda tree: tree["metadata"].update(current_time_index=91),
    "light '2' has 3 states for 91 steps": lambda tree: tree["dynamic_map_states"]["2"].update(
        state={"object_state": ["LANE_STATE_GO"] * 3}
    ),
    "the scenario has no id": lambda tree: (tree.pop("id"), tree["metadata"].pop("id")),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_contradictions_are_reported_in_one_line(case, tree, tmp_path):
    BROKEN[case](tree)
    path = written(tree, tmp_path)
    (bad,) = ScenarioNet().read(path)
    assert isinstance(bad, BadRecord) and bad.cure and case in bad.problem
    line = str(bad.error())
    assert line.startswith(f"{path}: ") and "\n" not in line


@pytest.mark.parametrize("value", [None, [], "x", 3, {"a": 1}, np.zeros(3)])
def test_other_files_are_reported_in_one_line(value, tmp_path):
    (bad,) = ScenarioNet().read(written(value, tmp_path))
    assert isinstance(bad, BadRecord) and "no dictionary" in bad.problem


def test_18_large_files_are_not_opened(tmp_path, monkeypatch):
    path = sample.write(tmp_path)
    monkeypatch.setattr(pickles, "MOST_BYTES", 1000)
    (bad,) = ScenarioNet().read(path)
    assert isinstance(bad, BadRecord) and "more than the" in bad.problem


def test_broken_features_are_left_out_and_counted(tree):
    tree["map_features"]["1"]["polyline"] = np.full((5, 3), np.nan)
    tree["map_features"]["8"]["polyline"] = np.array([[0.0, 0, 0], [1e6, 0, 0]])  # 1000 km away
    del tree["map_features"]["2"]["polyline"]
    recording = decode(tree)
    assert recording.lost["broken_features"] == 3
    assert {1, 2, 8}.isdisjoint(by_id(recording))


def test_18_repeated_arrays_are_refused(tree):
    """A pickle holds it once; reading it for every lane would take forever."""
    wide = np.zeros(4_000_000, np.int8)
    for number in range(3000, 3020):
        tree["map_features"][str(number)] = {**tree["map_features"]["2"], "width": wide}
    with pytest.raises(DataError, match="a map of"):
        decode(tree)


def test_huge_maps_are_refused(tree):
    zigzag = np.zeros((1000, 3))
    zigzag[::2, 0], zigzag[:, 1] = 9e4, sample.Y
    tree["map_features"]["8"]["polyline"] = zigzag
    with pytest.raises(DataError, match="km of lines"):
        decode(tree)


def test_texts_without_utf8_encoding_are_no_ids(tree):
    tree["id"] = "\ud800"
    tree["metadata"]["id"] = "plain"
    assert decode(tree).scenario_id == "plain"


# --- The real files (shared/data/README.md counts them by an independent reader).

REAL = {
    "sd_waymo_v1.2_eb4b91b10ca94ff2.pkl": (199, 45, 14, 209, 107),
    "sd_nuscenes_v1.0-mini_scene-0553.pkl": (201, 57, 0, 577, 421),
    "0.pkl": (201, 30, 0, 192, 151),
    "sd_nuscenes_v1.0-mini_scene-1100.pkl": (196, 33, 0, 233, 153),
}


def test_real_first_form(real_data):
    (recording,) = ScenarioNet().read(real_data / "scenarionet_first" / "0.pkl")
    assert isinstance(recording, Recording)
    tracks, kinds = recording.tracks, [f.kind for f in recording.features]
    assert tracks.valid.shape == (75, 197)
    own = tracks.size[recording.ego][tracks.valid[recording.ego]]
    np.testing.assert_allclose(own, [[5.286, 2.332, 2.33]] * len(own), atol=1e-6)
    assert (tracks.size[tracks.valid] > 0).all()
    assert (kinds.count(RoadKind.CROSSWALK), kinds.count(RoadKind.SPEED_BUMP)) == (7, 4)
    # Observed at one step of 197 only: 7 green, 8 red, 4 red arrows.
    states = np.stack([light.states for light in recording.lights])
    assert [(states == state).sum() for state in (-1, 0, 1, 4, 6)] == [19 * 196, 0, 4, 8, 7]
    starts = {f.feature_id: f.points[0] for f in recording.features}
    for light in recording.lights:
        np.testing.assert_allclose(light.stop_point, starts[light.lane_id], atol=1e-3)


def test_real_windows_of_one_scene_share_segment_and_frame(real_data):
    """Map features are compared by their positions: files number them each in its own order."""
    first, second, other = (
        next(iter(ScenarioNet().read(path)))
        for path in sorted((real_data / "scenarionet_unitraj").glob("*.pkl"))
    )
    assert len(first.scenario_id) == 76 and first.segment == second.segment == "scene-0103"
    assert other.segment == "scene-0916"
    crossings = [
        {tuple(np.round(f.points.ravel(), 3)) for f in r.features if f.kind == RoadKind.CROSSWALK}
        for r in (first, second)
    ]
    assert crossings[0] == crossings[1] and len(crossings[0]) == 9
    # The ego of one window drives where the other window's ego does, at some other step.
    apart = np.hypot(*np.moveaxis(first.tracks.xy[first.ego][:, None] - second.tracks.xy[second.ego], -1, 0))
    assert np.median(apart.min(axis=1)) < 0.2


@pytest.fixture(scope="module", params=list(REAL))
def real(request, real_data) -> tuple[str, Recording]:
    path = real_data / "scenarionet" / request.param
    assert ScenarioNet().recognise(path) and ScenarioNet().count(path) == 3
    (recording,) = ScenarioNet().read(path)
    assert isinstance(recording, Recording)
    return request.param, recording


def test_real_files_have_the_counted_content(real):
    name, recording = real
    lanes = sum(f.kind in LANE_KINDS for f in recording.features)
    found = (*recording.tracks.valid.T.shape, len(recording.lights), len(recording.features), lanes)
    assert found == REAL[name]


def test_real_ego_is_on_the_drivable_side_at_every_step(real):
    """Centre and all corners; edges of another level (3 m) do not count."""
    _, recording = real
    tracks, ego = recording.tracks, recording.ego
    edges = [
        f
        for f in recording.features
        if f.kind in EDGE_KINDS and abs(np.median(f.points[:, 2] - tracks.z[ego, 0])) < 3
    ]
    length, width, _ = np.median(tracks.size[ego], axis=0)
    assert length > width
    cos, sin = np.cos(tracks.heading[ego]), np.sin(tracks.heading[ego])
    for x, y in ((0, 0), (0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)):
        offset = np.stack((cos * x * length - sin * y * width, sin * x * length + cos * y * width), axis=1)
        assert on_left((tracks.xy[ego] + offset)[::5], edges).mean() >= 0.99


def test_real_velocities_are_those_of_the_motion(real):
    _, recording = real
    tracks = recording.tracks
    run = tracks.valid[:, :-2] & tracks.valid[:, 1:-1] & tracks.valid[:, 2:]
    slope = (tracks.xy[:, 2:] - tracks.xy[:, :-2]) / 0.2
    error = np.hypot(*np.moveaxis(slope - tracks.velocity[:, 1:-1], -1, 0))[run]
    assert np.quantile(error, 0.95) < 1.0
    fast = tracks.valid & (np.hypot(*np.moveaxis(tracks.velocity, -1, 0)) > 3) & (tracks.kind == 1)[:, None]
    course = np.arctan2(tracks.velocity[..., 1], tracks.velocity[..., 0])
    assert np.median(np.cos(course - tracks.heading)[fast]) > 0.99


def test_real_lanes_follow_the_heading_in_their_third_column(real):
    name, recording = real
    flat = all((f.points[:, 2] == 0).all() for f in recording.features)
    assert flat == (recording.dataset == "nuscenes") == ("waymo" not in name)


def test_real_windows_replay_without_collision_and_off_road_step(real):
    """The overpass as well: a road above or below is no obstacle and no edge."""
    from drivax.evaluation.audit import audit

    scenarios = [assemble(window) for window in windows(real[1])]
    assert len(scenarios) == 3
    for finding in audit(scenarios):
        assert finding["log_collides"] is False and finding["log_offroad_fraction"] == 0.0
