"""From a stored scenario back to a recording: fields kept exactly, kept within tolerance, or recomputed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely

from datasets.samples import gpudrive as sample
from drivax.datasets.export.recording import restore
from drivax.datasets.gpudrive import GpuDrive
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import CAPACITIES, POLYGON_KINDS, AgentKind, Flag, RoadKind
from scenario.recordings import (
    FAR,
    driving,
    edge,
    lane,
    light,
    line,
    make_recording,
    make_tracks,
    moved,
    straight_road,
)

#: The map is cropped to 100 m around the ego's log, whole segments of up to 4 m at a time.
CROPPED_M = 95.0


def lines_of(features, kind):
    closed = kind in POLYGON_KINDS
    lines = [
        np.concatenate((f.points, f.points[:1])) if closed else f.points for f in features if f.kind == kind
    ]
    return [shapely.LineString(points[:, :2]) for points in lines if len(points) > 1]


def farthest_m(lines, others, inside) -> float:
    """Largest distance of a point of some lines from others."""
    points = shapely.points(shapely.get_coordinates(shapely.segmentize(lines, 0.5)))
    points = points[shapely.contains(inside, points)]
    ends = np.concatenate([np.stack((c[:-1], c[1:]), 1) for c in map(shapely.get_coordinates, others)])
    tree = shapely.STRtree(shapely.linestrings(ends))
    _, distance = tree.query_nearest(points, all_matches=False, return_distance=True)
    return float(distance.max(initial=0.0))


def assert_same_map(kept, source, tolerance_m: float = 0.06):
    """Near ego's log the lines of each kind cover those of the source and nothing else."""
    tracks = source.tracks
    path = tracks.xy[source.ego, tracks.valid[source.ego]]
    near = shapely.box(*(path.min(axis=0) - CROPPED_M), *(path.max(axis=0) + CROPPED_M))
    for kind in {feature.kind for feature in source.features} - {RoadKind.STOP_SIGN}:
        mine, theirs = lines_of(kept.features, kind), lines_of(source.features, kind)
        assert farthest_m(mine, theirs, near) < tolerance_m, kind
        assert farthest_m(theirs, mine, near) < tolerance_m, kind


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    (recording,) = GpuDrive().read(sample.write(tmp_path_factory.mktemp("sample")))
    return recording


def test_agents_come_back_exactly(recording):
    stored = assemble(recording)
    back = restore(stored)
    order = [recording.tracks.track_id.tolist().index(number) for number in back.tracks.track_id]
    assert back.tracks.track_id[0] == 2406 and len(order) == 4
    np.testing.assert_array_equal(back.tracks.valid, recording.tracks.valid[order])
    np.testing.assert_array_equal(back.tracks.kind, recording.tracks.kind[order])
    for name, tolerance in (("xy", 1e-5), ("z", 1e-5), ("heading", 1e-6), ("velocity", 1e-6), ("size", 1e-6)):
        np.testing.assert_allclose(
            getattr(back.tracks, name), getattr(recording.tracks, name)[order], atol=tolerance, rtol=0
        )
    assert (back.scenario_id, back.dataset, back.segment) == (
        recording.scenario_id,
        "womd",
        recording.segment,
    )
    np.testing.assert_allclose(back.timestamps_s, recording.timestamps_s)


def test_map_comes_back_within_the_tolerance_of_storage(recording):
    back = restore(assemble(recording))
    assert_same_map(back, recording)
    signs = [feature for feature in back.features if feature.kind == RoadKind.STOP_SIGN]
    (sign,) = signs
    np.testing.assert_allclose(sign.points[0, :2], (sample.X0 + 20.0, sample.Y0 - 3.0), atol=1e-5)
    np.testing.assert_allclose(sign.points[0, 2], sample.Z0, atol=1e-5)  # of the map next to it
    ids = [feature.feature_id for feature in back.features]
    assert len(set(ids)) == len(ids) and {1, 2, 5, 7, 8, 9, 11, 12, 13} < set(ids)


def test_edges_keep_their_direction(recording):
    kept = {feature.feature_id: feature.points for feature in restore(assemble(recording)).features}
    source = {feature.feature_id: feature.points for feature in recording.features}
    for number in (1, 2, 5, 8, 9):
        np.testing.assert_allclose(kept[number][[0, -1]], source[number][[0, -1]], atol=1e-4)


def test_far_from_the_origin_in_float64():
    recording = moved(make_recording(), FAR)
    back = restore(assemble(recording))
    np.testing.assert_allclose(back.tracks.xy, recording.tracks.xy, atol=2e-6, rtol=0)
    assert_same_map(back, recording)


def test_reassembled_scenario_is_the_same():
    """Lane graph, limits, lights, stop signs and marks survive; only values measured from simplified lines change."""
    rows = np.array([[*driving(8.0)], [*driving(5.0, y=3.5)], [*np.tile((30.0, 0.0), (91, 1))]])
    recording = make_recording(
        features=(
            lane(
                1, line((-60, 0), (50, 0)), limit_mps=13.4, left_neighbours=(2,), successors=(4,), width_m=3.1
            ),
            lane(2, line((-60, 3.5), (150, 3.5)), limit_mps=9.0, right_neighbours=(1,)),
            lane(4, line((50, 0), (150, 0)), predecessors=(1,), interpolating=True),
            edge(3, line((-60, -2), (150, -2), (150, 6), (-60, 6), (-60, -2), step=0.5)),
            MapFeature(9, RoadKind.STOP_SIGN, np.array([[50.0, -3.0, 0.0]]), lanes=(1,)),
        ),
        tracks=make_tracks(rows, heading=np.zeros((3, 91))),
        lights=(light(4, 50.0, 0.0, np.repeat((4, 6, -1), (30, 30, 31))),),
        to_predict=(1,),
        of_interest=(0,),
    )
    first = assemble(recording)
    again = assemble(restore(first))
    for name in (
        "origin", "flags", "agent_xy", "agent_valid", "agent_heading", "agent_velocity", "agent_size", "agent_id",
        "agent_kind", "agent_flags", "parked_xy", "parked_valid", "parked_id", "lane_id", "lane_kind", "lane_limit",
        "lane_width", "lane_interpolating", "lane_successor", "lane_predecessor", "lane_left", "lane_right",
        "lane_stop", "light_state", "light_lane", "stop_lane", "feature_kind", "feature_closed",
    ):  # fmt: skip
        np.testing.assert_array_equal(again.record[name], first.record[name], err_msg=name)
    for name in ("light_line", "stop_xy", "route_xy", "goal_xy", "log_progress"):
        np.testing.assert_allclose(again.record[name], first.record[name], atol=1e-4, err_msg=name)


def test_links_made_from_geometry_are_left_out(recording):
    stored = assemble(recording)
    assert Flag.CHAINED_GRAPH in stored.has
    back = restore(stored)
    assert not any(feature.successors or feature.predecessors for feature in back.features)
    assert Flag.CHAINED_GRAPH in assemble(back).has


def test_pieces_of_a_cropped_feature_have_own_ids():
    loop = line((-80, -3), (80, -3), (80, -150), (90, -150), (90, -3), (95, -3), step=1.0)
    recording = make_recording((*straight_road(end=180.0), edge(7, loop)))
    stored = assemble(recording)
    back = restore(stored)
    far = [f for f in back.features if f.kind == RoadKind.EDGE_BOUNDARY and f.feature_id != 3]
    assert len(far) == 2 and far[0].feature_id == 7
    assert far[1].feature_id > 7
    for piece in far:
        gaps = np.hypot(*np.diff(piece.points[:, :2], axis=0).T)
        assert gaps.max() < 4.0


def test_features_without_a_row_in_the_table_are_joined_too():
    capacity = replace(CAPACITIES["default"], features=2)
    recording = make_recording(straight_road(end=150.0))
    stored = assemble(recording, capacity)
    assert stored.overflow["features"] == 1
    back = restore(stored)
    assert len(back.features) == 3
    assert_same_map(back, recording)


def test_light_without_a_lane_gets_an_own_id():
    recording = make_recording(
        lights=(light(77, 30.0, 0.0, np.full(91, 4)), light(1, 40.0, 0.0, np.full(91, 6)))
    )
    back = restore(assemble(recording))
    lanes = [one.lane_id for one in back.lights]
    assert 1 in lanes and len(set(lanes)) == 2
    assert not {one for one in lanes if one != 1} & {feature.feature_id for feature in back.features}


def test_short_recordings_and_cones():
    tracks = make_tracks(
        [driving(steps=11), np.tile((20.0, 2.0), (11, 1))], kind=[AgentKind.VEHICLE, AgentKind.STATIC]
    )
    back = restore(assemble(make_recording(tracks=tracks)))
    assert back.tracks.valid.shape == (2, 11) and back.current_step == 10
    assert back.tracks.kind.tolist() == [AgentKind.VEHICLE, AgentKind.STATIC]
    assert len(back.timestamps_s) == 11


def test_real_recording_is_restored_up_to_parked_poses(real_data):
    """A real recording and its restored form agree."""
    (recording,) = GpuDrive().read(real_data / "gpudrive" / "tfrecord-00000-of-01000_325.json")
    stored = assemble(recording)
    back = restore(stored)
    order = [recording.tracks.track_id.tolist().index(number) for number in back.tracks.track_id]
    assert sorted(order) == list(range(62))
    moving = int(stored.agent_valid.any(axis=0).sum())
    mine, theirs = back.tracks, recording.tracks
    np.testing.assert_array_equal(mine.valid, theirs.valid[order])
    np.testing.assert_allclose(mine.xy[:moving], theirs.xy[order[:moving]], atol=1e-4, rtol=0)
    parked = np.abs(mine.xy[moving:] - theirs.xy[order[moving:]]).max()
    assert 0 < parked <= 0.3 + 1e-6  # one pose for all of its steps
