from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.scenario.build.lanes import LaneSegments, lane_graph
from drivax.scenario.build.segments import cut, road_lines
from drivax.scenario.build.tracks import (
    DEFAULT_EGO_SIZE,
    DEFAULT_SIZES,
    extend,
    local_tracks,
    masked_median,
    median_pose,
    place,
)
from drivax.scenario.schema import AgentKind

from .recordings import FAR, arc, driving, lane, line, make_tracks

ZERO = np.zeros(3)


def standing(x, y, steps=91):
    return np.broadcast_to([float(x), float(y)], (steps, 2)).copy()


@given(st.integers(0, 10_000))
def test_masked_median_equals_numpy(seed):
    rng = np.random.default_rng(seed)
    values, valid = rng.normal(size=(6, 9)), rng.random((6, 9)) < 0.5
    expected = [np.median(row[mask]) if mask.any() else 0.0 for row, mask in zip(values, valid, strict=True)]
    assert masked_median(values, valid) == pytest.approx(expected)


def test_tracks_move_to_the_local_frame_with_zeros_where_not_valid():
    plain = make_tracks([driving(), standing(5, 5)], valid=np.ones((2, 91)) * [[1], [0]])
    plain = replace(plain, xy=plain.xy + FAR[:2], z=plain.z + FAR[2], heading=plain.heading + 9.0)
    plain.z[1] = np.nan
    local = local_tracks(plain, 0, FAR)
    assert local.xyz[0, :, :2] == pytest.approx(driving(), abs=1e-8)
    assert local.heading[0] == pytest.approx(np.full(91, 9.0 - 2 * np.pi), abs=1e-9)
    assert not local.xyz[1].any()
    assert not local.velocity[1].any()


def test_sizes_are_medians_and_defaults_are_counted():
    kinds = [AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.VEHICLE, AgentKind.CYCLIST]
    tracks = make_tracks([driving(y=y) for y in (0, 5, 9, 12)], kind=kinds)
    tracks.size[0] = np.nan
    tracks.size[1] = 0.0
    tracks.size[1, :, 1] = 1e-300  # 0 as float32
    tracks.size[2, :50, 0] = 9.9  # more than half of the steps
    tracks.size[3, :, 2] = -1.0
    local = local_tracks(tracks, 0, ZERO)
    assert local.size[0].tolist() == list(DEFAULT_EGO_SIZE)
    assert local.size[1].tolist() == list(DEFAULT_SIZES[AgentKind.PEDESTRIAN])
    assert local.size[2].tolist() == [9.9, 1.9, 1.5]
    assert local.size[3].tolist() == [4.6, 1.9, 1.7]
    assert local.has_default_size.tolist() == [True, True, False, True]


def test_parked_means_within_thirty_centimetres_and_a_tenth_of_a_radian():
    rng = np.random.default_rng(0)
    noisy = standing(20, 4) + rng.uniform(-0.15, 0.15, (91, 2))
    creeping, turning = standing(30, 4), standing(40, 4)
    creeping[80:, 0] += 0.35
    heading = np.zeros((6, 91))
    heading[3, 70:] = 0.15
    heading[1] = np.where(np.arange(91) % 2, 3.1, -3.12)  # wraps around pi
    rare = np.ones((6, 91), dtype=bool)
    rare[5, 3:] = False
    tracks = make_tracks(
        [standing(0, 0), noisy, creeping, turning, driving(y=8), standing(9, 9)], heading=heading, valid=rare
    )
    placement = place(local_tracks(tracks, 0, ZERO), (), 80, 256)
    assert placement.moving[0] == 0  # the ego stays in the moving block even when parked
    assert sorted(placement.moving) == [0, 2, 3, 4]
    assert sorted(placement.parked) == [1, 5]
    assert placement.pose[1, :3] == pytest.approx([20, 4, 0], abs=0.1)
    assert abs(abs(placement.pose[1, 3]) - np.pi) < 0.05
    assert placement.overflow == {}


def test_jumping_detections_do_not_spoil_the_pose_of_a_parked_car():
    path = standing(7, 7)
    path[:5] += 50.0
    pose = median_pose(local_tracks(make_tracks([driving(), path], heading=np.full((2, 91), 0.5)), 0, ZERO))
    assert pose[1] == pytest.approx([7, 7, 0, 0.5])


def test_rank_is_ego_then_marked_then_distance_with_a_bonus_for_movers():
    paths = [
        driving(speed=1.0),
        driving(speed=1.0, y=30),  # moves 9 m: counts as at -20
        driving(speed=0.1, y=8),  # creeps 0.9 m: no bonus
        driving(speed=1.0, y=45),  # counts as at -5
        driving(speed=1.0, y=400),
        driving(speed=1.0, y=3),
    ]
    valid = np.ones((6, 91), dtype=bool)
    valid[5] = False
    tracks = local_tracks(make_tracks(paths, valid=valid), 0, ZERO)
    assert place(tracks, (4,), 80, 8).moving.tolist() == [0, 4, 1, 3, 2]  # never valid: left out
    full = place(tracks, (4,), 3, 8)
    assert full.moving.tolist() == [0, 4, 1]
    assert full.overflow == {"agents": 2}
    many = local_tracks(make_tracks([driving(), *(standing(x, 9) for x in (300, 30, 200))]), 0, ZERO)
    crowd = place(many, (), 3, 2)
    assert crowd.parked.tolist() == [2, 3]
    assert crowd.overflow == {"parked": 1}


def test_extensions_follow_the_lane_or_go_straight():
    features = (
        lane(1, line((-50, 0), (10, 0)), successors=(2,)),
        lane(2, arc((10, 40), 40.0, -np.pi / 2, 0.0, step=0.05)),
    )
    graph = lane_graph(features, ZERO)
    on = LaneSegments.of(cut(road_lines(features, ZERO, None)), graph)
    paths = [driving(speed=1.0, x=-8.0, y=1.0), driving(speed=1.0, x=-8.0, y=1.0), driving(y=30, heading=1.0)]
    kinds = [AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.VEHICLE]
    valid = np.ones((3, 91), dtype=bool)
    valid[2, 40:] = False
    tracks = local_tracks(make_tracks(paths, kind=kinds, valid=valid), 0, ZERO)
    points = extend(tracks, np.arange(3), on, 16)
    s = 4.0 * np.arange(1, 17)  # the car ends at (0, 1)
    fade = np.maximum(1 - s / 20, 0)
    angle = np.maximum(s - 10, 0) / 40
    assert points[0, :, 0] == pytest.approx(np.where(s < 10, s, 10 + (40 - fade) * np.sin(angle)), abs=0.05)
    assert points[0, :, 1] == pytest.approx(
        np.where(s < 10, fade, 40 - (40 - fade) * np.cos(angle)), abs=0.05
    )
    assert points[1] == pytest.approx(np.stack((s, np.ones(16)), axis=-1))
    last = np.array([29.0 * np.cos(1.0), 30 + 29.0 * np.sin(1.0)])  # step 39, 2.9 s after step 10
    assert points[2] == pytest.approx(last + s[:, None] * [np.cos(1.0), np.sin(1.0)])
