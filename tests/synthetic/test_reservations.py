from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivax.scenario.schema import AgentKind
from drivax.synthetic.expert.candidates import (
    HARD_M,
    NEAR_M,
    NEAR_VULNERABLE_M,
    SPACING_M,
    Shift,
    arrivals,
    find_conflicts,
    shift_path,
    stop_lines,
)
from drivax.synthetic.expert.violations import user_boxes
from drivax.synthetic.roads.curves import Pose
from drivax.synthetic.roads.network import Control
from drivax.synthetic.roads.signals import Colour, LightGroup, SignalPlan

from .oracles import box_corners, shared_area
from .staged_scenes import CAR, TIMES, crossed, road, scene, user


def candidate_of(roles, shift=None, reach=60.0):
    pose = Pose(30.0, 0.0, 0.0)
    return shift_path(roles.paths[0], roles.drivers, pose, 30.0, reach, shift or Shift())


@pytest.mark.parametrize("seed", range(3))
def test_conflicts_agree_with_clipped_polygons(seed):
    rng = np.random.default_rng(seed)
    others = [
        user(
            rng.uniform([25, -8], [95, 8]), float(rng.uniform(-4, 4)),
            size=(float(rng.uniform(0.6, 9.0)), float(rng.uniform(0.5, 2.5)), 1.5),
            velocity=tuple(rng.uniform(-6, 6, 2)) if k % 3 else (0.0, 0.0),
            kind=AgentKind.PEDESTRIAN if k % 2 else AgentKind.VEHICLE,
        )
        for k in range(6)
    ]  # fmt: skip
    roles, motion = scene(road(), 10.0, others)
    candidate = candidate_of(roles, Shift(2.5, 5.0, 25.0, 35.0, 55.0))
    box = user_boxes(motion)[1:, ::15]
    valid = rng.random(box.shape[:2]) < 0.9
    pedestrians = motion.kind[1:] == AgentKind.PEDESTRIAN
    got = find_conflicts(candidate, motion.size_m[0], box, valid, pedestrians)
    result = dict(zip(zip(got.user, got.step, got.point, strict=True), got.hard, strict=True))
    expected = {}
    for u in range(len(box)):
        near = NEAR_VULNERABLE_M if pedestrians[u] else NEAR_M
        for t in np.flatnonzero(valid[u]):
            box_of_user = box_corners(
                box[u, t, :2], np.arctan2(box[u, t, 3], box[u, t, 2]), box[u, t, 4], box[u, t, 5]
            )
            for p in range(0, len(candidate.xy), 3):
                pose = candidate.xy[p], candidate.heading[p]
                wide, tight = (
                    box_corners(*pose, CAR[0] + 2 * along, CAR[1] + 2 * aside)
                    for along, aside in (near, HARD_M)
                )
                if shared_area(wide, box_of_user) > 1e-9:
                    expected[u, t, p] = shared_area(tight, box_of_user) > 1e-9
    assert {key: hard for key, hard in result.items() if key[2] % 3 == 0} == expected
    assert len(expected) > 20


def test_static_users_conflict_at_all_steps():
    roles, motion = scene(road(), 10.0, [user((60.0, 0.0))])
    others, valid, vulnerable = user_boxes(motion)[1:], motion.valid[1:], np.zeros(1, bool)
    got = find_conflicts(candidate_of(roles), motion.size_m[0], others, valid, vulnerable)
    # Centres closer than a car's length and the room kept: 4.6 + 0.35 m.
    places = 30.0 + np.unique(got.point[got.hard]) * SPACING_M
    assert places.tolist() == np.arange(55.5, 64.6, 0.5).tolist()
    assert (np.bincount(got.step[got.hard]) == len(places)).all()


def test_red_lights_close_the_stop_line_and_late_yellow_is_avoided():
    plan = SignalPlan((LightGroup((1,), False),), ((0,),), (5.0,), offset_s=-3.0)
    network = crossed(100.0, Control.SIGNAL)
    network = replace(network, signals=plan)
    roles, _ = scene(network, 10.0, lanes=(0, 1, 2))
    (line,) = stop_lines(network, roles.paths[0], (30.0, 2.3), TIMES, 30.0 + 10.0 * TIMES, {})
    # Half a metre before the front bumper reaches the line.
    assert line.base_m == pytest.approx(100.0 - 2.3 - 0.5 - 30.0)
    colour = plan.colours(TIMES, 3)[0][:, 1]
    assert line.closed.tolist() == (colour == Colour.RED).tolist()
    # Green ends at 2 s, yellow at 5 s.
    assert TIMES[line.late].min() == pytest.approx(4.1, abs=0.11)
    assert not line.closed[TIMES < 4.95].any()
    assert line.closed[TIMES > 5.05][:10].all()
    assert stop_lines(network, roles.paths[0], (98.0, 2.3), TIMES, 98.0 + TIMES, {}) == []


def test_stop_signs_open_after_stopping_and_yield_signs_after_traffic():
    network = crossed(100.0, Control.STOP)
    roles, _ = scene(network, 10.0, lanes=(0, 1, 2))
    (line,) = stop_lines(network, roles.paths[0], (30.0, 2.3), TIMES, 30.0 + 10.0 * TIMES, {})
    assert line.closed.tolist() == (30.0 + 10.0 * TIMES + 2.3 <= 100.0).tolist()
    lanes = list(crossed(100.0, Control.YIELD).lanes)
    lanes[1] = replace(lanes[1], yields_to=(2,))
    network = replace(network, lanes=tuple(lanes))
    # Another vehicle on the same path is on lane 2 (from 120 m on) from 4.77 s on; it is announced 2 s earlier.
    first = arrivals(
        network, [roles.paths[0]] * 2, np.stack([0 * TIMES, 70.0 + 10.0 * TIMES]),
        np.ones((2, 91), bool), np.full(2, 2.3),
    )  # fmt: skip
    assert TIMES[first[2]].min() == pytest.approx(2.8)
    assert first[2][28:].all()
    (line,) = stop_lines(network, roles.paths[0], (30.0, 2.3), TIMES, 30.0 + 10.0 * TIMES, first)
    assert line.late.tolist() == first[2].tolist()
    assert not line.closed.any()
