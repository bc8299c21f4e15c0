from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivax.scenario.schema import AgentKind
from drivax.synthetic.expert.plan import plan_ego
from drivax.synthetic.expert.violations import discomfort, find_violation
from drivax.synthetic.roads.curves import Pose, join_curves, resample, straight, turn
from drivax.synthetic.roads.network import Control
from drivax.synthetic.roads.signals import LightGroup, SignalPlan
from drivax.synthetic.traffic.roles import Override, Staging

from .staged_scenes import CAR, TIMES, WIDTH, crossed, driven, road, scene, user

PEDESTRIAN = (0.6, 0.6, 1.75)
#: As wide as the whole road: ego cannot go around it.
BARRIER = (1.0, 20.0, 1.5)


def planned(network, speed, users=(), lanes=(0,)):
    """The plan, and the violation of ego's motion on it (an event excuses the wrong side of the road)."""
    roles, motion = scene(network, speed, users, lanes=lanes)
    plan = plan_ego(roles, motion, TIMES, 0)
    result = driven(motion, plan)
    excuse = Staging(overrides=(Override(0, 0, 0, 9.0),))
    return plan, find_violation(roles, result, TIMES, 0, excuse, 6.0).cause


def braking(plan):
    return -float(np.diff(plan.speed).min()) / 0.1


def pedestrian(ahead_m, side_m, speed, from_s=0.0):
    """A pedestrian that crosses the road ``ahead_m`` ahead of ego's front bumper."""
    x = 30.0 + CAR[0] / 2 + ahead_m + PEDESTRIAN[0] / 2
    return user((x, side_m), np.pi / 2, PEDESTRIAN, AgentKind.PEDESTRIAN, (0.0, speed), from_s)


def test_free_road_is_driven_at_constant_speed():
    plan, cause = planned(road(), 12.0)
    assert cause == ""
    assert np.allclose(plan.speed, 12.0, atol=0.01)
    assert np.allclose(plan.xy[:, 0], 30.0 + 12.0 * TIMES, atol=0.01)
    assert plan.speed.shape == plan.heading.shape == (91,)


def test_positions_are_the_integral_of_speed_along_the_heading():
    plan, cause = planned(road(), 12.0, [user((80.0, 0.0))])
    assert cause == ""
    assert plan.xy[:, 1].max() > 1.0
    middle = (plan.heading[1:] + plan.heading[:-1]) / 2
    length = (plan.speed[1:] + plan.speed[:-1]) * 0.05
    step = length[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    assert np.abs(np.diff(plan.xy, axis=0) - step).max() < 0.01


def test_standing_car_is_passed_in_a_free_lane():
    plan, cause = planned(road(), 12.0, [user((80.0, 0.0))])
    assert cause == ""
    assert plan.speed.min() > 9.0
    assert discomfort(plan.heading, plan.speed) == ""
    beside = np.abs(plan.xy[:, 0] - 80.0) < 4.0
    assert plan.xy[beside, 1].min() > 1.9 + 0.4
    assert abs(plan.xy[-1, 1]) < 0.1


def test_ego_stops_behind_a_standing_car_without_a_free_lane():
    plan, cause = planned(road((1,)), 12.0, [user((80.0, 0.0))])
    assert cause == ""
    assert np.abs(plan.xy[:, 1]).max() < 0.01
    assert plan.speed[-1] < 2.5
    assert plan.xy[-1, 0] + 4.6 < 80.0
    assert discomfort(plan.heading, plan.speed) == ""


def test_oncoming_lane_is_used_only_when_free():
    ahead = user((80.0, 0.0))
    oncoming = [user((x, WIDTH), np.pi, velocity=(-12.0, 0.0)) for x in (150.0, 172.0, 195.0, 218.0)]
    plan, cause = planned(road((1, -1)), 12.0, [ahead])
    assert cause == ""
    assert plan.xy[-1, 0] > 90.0
    plan, cause = planned(road((1, -1)), 12.0, [ahead, *oncoming])
    assert cause == ""
    assert plan.xy[TIMES < 6.0, 1].max() < 1.0


def test_cut_in_requires_some_braking():
    other = user((44.0, WIDTH), -0.12, velocity=(9.0, -1.0))
    plan, cause = planned(road((1, 1)), 13.0, [other])
    assert cause == ""
    assert braking(plan) < 4.0


@pytest.mark.parametrize("ahead_m", [30.0, 22.0])
def test_ego_lets_a_pedestrian_cross(ahead_m):
    plan, cause = planned(road((1,)), 12.0, [pedestrian(ahead_m, -3.0, 1.0)])
    assert cause == ""
    assert np.abs(plan.xy[:, 1]).max() < 1.0
    assert plan.speed.min() < 9.0


@pytest.mark.parametrize(("required", "possible"), [(3.0, True), (5.0, True), (9.0, False)])
def test_plan_stops_before_a_barrier_within_the_braking_limit(required, possible):
    """A barrier across the whole road is v^2 / (2 a) ahead of the bumper for the required a, and 1 m more."""
    ahead = 12.0**2 / (2 * required) + 1.0
    barrier = user((30.0 + CAR[0] / 2 + ahead + 0.5, 0.0), size=BARRIER)
    plan, cause = planned(road((1,)), 12.0, [barrier])
    assert cause == ("" if possible else "ego_collides")
    assert (required - 0.6 if possible else 5.0) < braking(plan) <= 6.02


def with_lights(green_s, offset_s):
    plan = SignalPlan((LightGroup((1,), False),), ((0,),), (green_s,), offset_s=offset_s)
    return replace(crossed(100.0, Control.SIGNAL), signals=plan)


@pytest.mark.parametrize("turns_red_s", np.arange(1.0, 9.0, 0.5))
def test_ego_stops_at_red(turns_red_s):
    # 20 s green, 3 s yellow, 1.5 s red: short, so that anticipation pays; then 24.5 s again.
    network = with_lights(20.0, turns_red_s - 23.0)
    plan, cause = planned(network, 12.0, lanes=(0, 1, 2))
    assert cause == ""
    assert braking(plan) < 4.0


def test_ego_waits_at_a_long_red():
    network = with_lights(5.0, -6.0)
    network = replace(network, signals=replace(network.signals, all_red_s=30.0))
    plan, cause = planned(network, 12.0, lanes=(0, 1, 2))
    assert cause == ""
    room = 100.0 - plan.xy[-1, 0] - CAR[0] / 2
    assert room > 0.0
    # It can still stop gently before the line.
    assert plan.speed[-1] ** 2 / (2 * room) < 3.0


def test_bends_are_driven_within_comfort():
    first = straight(Pose(0.0, 0.0, 0.0), 60.0)
    arc = turn(first.end, np.pi / 2, 14.0)
    curve = resample(join_curves(first, arc, straight(arc.end, 100.0)), 0.5)
    roles, motion = scene(road(turn=curve), 12.0)
    plan = plan_ego(roles, motion, TIMES, 0)
    assert discomfort(plan.heading, plan.speed) == ""
    rate = np.diff(plan.heading) / 0.1
    lateral = rate * (plan.speed[1:] + plan.speed[:-1]) / 2
    assert np.abs(lateral).max() < 4.4
    assert plan.heading[-1] == pytest.approx(np.pi / 2, abs=0.05)


def test_followers_are_expected_to_brake_unless_they_ran_into_ego():
    barrier = user((80.0, 0.0), size=BARRIER)
    # It drives on for 2.2 s and then stops behind ego with 3 m/s2: 4.6 m from its centre to ego's.
    slow = np.clip(TIMES - 2.2, 0.0, 4.0)
    at = 18.0 + 12.0 * np.minimum(TIMES, 2.2) + 12.0 * slow - 1.5 * slow**2
    behind = user((0.0, 0.0), velocity=(1.0, 0.0))
    behind[2][:] = np.stack([at, 0 * at], axis=-1)
    roles, motion = scene(road((1,)), 12.0, [behind, barrier])
    # The follower is a vehicle on a path of its own.
    motion = replace(
        motion, distance_m=np.stack([motion.distance_m[0], at]), paths=motion.paths * 2,
        acceleration=np.zeros((2, 91)),
    )  # fmt: skip
    plan = plan_ego(roles, motion, TIMES, 0)
    assert plan.xy[-1, 0] < 80.0 - 2.3 - 0.5
    assert braking(plan) < 3.5
    assert (plan.xy[:, 0] - at).min() < 4.6
    wary = plan_ego(roles, motion, TIMES, 0, frozenset({1}))
    assert (wary.xy[:, 0] - at).min() > 4.6 + 0.1
    assert wary.xy[-1, 0] < 80.0 - 2.3 - 0.5


def test_plan_starts_with_the_pose_of_its_first_step():
    roles, motion = scene(road(), 12.0, [user((120.0, 0.0))])
    plan = plan_ego(roles, motion, TIMES, 30)
    assert plan.first_step == 30
    assert len(plan.speed) == 61
    assert np.allclose(plan.xy[0], motion.xy[0, 30])
    assert plan.speed[0] == motion.speed[0, 30]


def test_plans_start_at_the_offset_of_ego_from_its_path():
    roles, motion = scene(road(), 12.0)
    xy, heading = motion.xy.copy(), motion.heading.copy()
    xy[0, :, 1] += 0.7
    heading[0] += 0.03
    plan = plan_ego(roles, replace(motion, xy=xy, heading=heading), TIMES, 5)
    assert np.allclose(plan.xy[0], xy[0, 5])
    assert plan.heading[0] == pytest.approx(0.03)
    assert np.abs(np.diff(np.hypot(*np.diff(plan.xy, axis=0).T))).max() < 0.01
    assert abs(plan.xy[40, 1]) < 0.02
