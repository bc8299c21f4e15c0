"""Roads and destinations that events need, and the deceleration that they require of ego."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from drivax.scenario.schema import AgentKind
from drivax.synthetic.events import (
    SEVERITY_MPS2,
    EgoView,
    EventKind,
    StagedEvent,
    destinations_for,
    draw_severity,
    endangers_ego,
    possible,
)
from drivax.synthetic.events.adversary import required_deceleration, vehicles_that_cross, waiting_room
from drivax.synthetic.events.leading import cut_in_gap, required_by_leader
from drivax.synthetic.traffic.roles import ScriptedUser, Staging

from .event_scenes import FIRST, STEPS, junction, road, scene


def least_on_a_grid(speed, blocked, times):
    """Least deceleration on a grid that keeps ego behind all blocked places at their times."""
    for a in np.arange(0.0, 20.0, 0.001):
        t = np.minimum(times, speed / a) if a else times
        if np.all(speed * t - a * t**2 / 2 <= blocked + 1e-9):
            return a
    return math.inf


@pytest.mark.parametrize("speed", [4.0, 9.0, 15.0])
def test_required_deceleration_is_the_least_that_avoids_overlap(speed):
    rng = np.random.default_rng(0)
    for _ in range(10):
        times = np.sort(rng.uniform(0.2, 5.0, 4))
        blocked = rng.uniform(5.0, 40.0, 4)
        assert required_deceleration(speed, blocked, times) == pytest.approx(
            least_on_a_grid(speed, blocked, times), abs=2e-3
        )
    assert required_deceleration(speed, np.array([0.0]), np.array([1.0])) == math.inf


def test_rooms_and_gaps_match_hand_calculations():
    # 10 m/s, 20 m, blocked for good: 100 / 40. Clear again after 3 s: 2 (30 - 20) / 9.
    assert required_deceleration(10.0, np.array([20.0]), np.array([60.0])) == pytest.approx(2.5)
    assert required_deceleration(10.0, np.array([20.0]), np.array([3.0])) == pytest.approx(20 / 9)
    assert waiting_room(10.0, 20 / 9, 3.0) == pytest.approx(20.0)
    assert waiting_room(10.0, 2.5, 60.0) == pytest.approx(20.0)
    # Leader at 10 m/s brakes at 5: 10 m; with a gap of 10 m ego has 20 m.
    assert required_by_leader(10.0, 10.0, 10.0, 5.0) == pytest.approx(2.5)
    # 12 -> 4 m/s behind a leader that slows from 10 to 4 at 3 m/s2: 64 / (2 a) = g + 6.
    assert cut_in_gap(12.0, 10.0, 4.0, 3.0, 3.2) == pytest.approx(4.0)


def test_events_need_features_of_the_road():
    plain, ending = road(lanes=1), road(ends=True)
    (lights, _), (yielding, _) = junction(False), junction(True)
    assert possible(EventKind.LATE_MERGE, ending) and not possible(EventKind.LATE_MERGE, road())
    assert possible(EventKind.CUT_IN, road()) or possible(EventKind.CUT_IN, ending)
    assert not possible(EventKind.CUT_IN, plain) and not possible(EventKind.FROM_BEHIND_PARKED, plain)
    assert possible(EventKind.RED_LIGHT_RUNNER, lights) and not possible(EventKind.RED_LIGHT_RUNNER, yielding)
    assert possible(EventKind.TURN_CONFLICT, yielding) and not possible(EventKind.TURN_CONFLICT, plain)
    assert possible(EventKind.JAYWALKER, plain) and not possible(EventKind.JAYWALKER, road(limit=27.0))
    assert not possible(EventKind.LEAD_BRAKES, road(limit=8.0))
    assert all(possible(kind, plain) for kind in (EventKind.LEAD_BRAKES, EventKind.LANE_BLOCKED))


def test_destinations_are_lane_ends_stop_lines_and_open_roads():
    (end,) = destinations_for(EventKind.LATE_MERGE, road(ends=True))
    assert end.lane == 0 and end.along_m == (250.0, 250.0) and end.alone
    network, (_, through, _) = junction(True)
    (line,) = destinations_for(EventKind.TURN_CONFLICT, network)
    assert line.lane == through and line.along_m == (0.0, 0.0)
    # A vehicle that crosses from a side road does not turn left across ego's path.
    crossing, _ = junction(False)
    lanes = [dataclasses.replace(lane, yields_to=(1,)) for lane in crossing.lanes]
    assert destinations_for(EventKind.TURN_CONFLICT, dataclasses.replace(crossing, lanes=tuple(lanes))) == ()
    assert destinations_for(EventKind.JAYWALKER, road()) == ()
    assert len(destinations_for(EventKind.JAYWALKER, road(), again=True)) == 2
    assert all(place.followed for place in destinations_for(EventKind.TAILGATER, road()))


def approach(side_m, speed=10.0):
    """Ego at ``speed`` towards the actor: a car that stands 40 m ahead, ``side_m`` to the left of its path."""
    roles, motion = scene(road(), [(0,), (0,)], [60.0, 60.0 + (FIRST + 20) + 40.0], [10.0, 0.0])
    motion = dataclasses.replace(motion, xy=motion.xy + np.array([[[0.0, 0.0]], [[0.0, side_m]]]))
    staged = StagedEvent(EventKind.STALLED_VEHICLE, Staging(), (1,), FIRST + 20, FIRST + 70, 3.0)
    slower = dataclasses.replace(motion, speed=motion.speed * np.array([[speed / 10.0], [1.0]]))
    return EgoView(roles, motion, FIRST), slower, staged


def test_events_endanger_an_ego_that_keeps_its_speed():
    assert endangers_ego(*approach(0.0)) and endangers_ego(*approach(1.5))
    # Boxes are 2 m wide: at 2.1 m they pass, and at 1.9 m they overlap less than the margin.
    assert not endangers_ego(*approach(2.1)) and not endangers_ego(*approach(1.9))
    # 40 m less a length of 4.8 m in 7 s: at 4.4 m/s ego stays more than 0.8 s away, at 5.2 m/s it does not.
    assert not endangers_ego(*approach(0.0, 4.4)) and endangers_ego(*approach(0.0, 5.2))


def test_only_vehicles_that_would_hit_a_crossing_actor_cross_it():
    roles, motion = scene(road(), [(0,), (1,), (1,), (0,)], [60.0, 40.0, 200.0, 20.0], [10.0] * 4)
    t = np.arange(STEPS) * 0.1
    # A pedestrian crosses at x = 160 from 8 s on: the first car on lane 1 (y = 3.5) is there after 12 s.
    y = np.clip(-2.0 + 1.5 * (t - 8.0), -2.0, 6.0)
    xy = np.stack([np.full(STEPS, 160.0), y], axis=-1)
    speed = np.gradient(y, 0.1)
    pedestrian = ScriptedUser(
        AgentKind.PEDESTRIAN, (0.5, 0.6, 1.7), xy, np.full(STEPS, math.pi / 2), speed, t >= 0.0
    )
    assert vehicles_that_cross(EgoView(roles, motion, FIRST), pedestrian) == (1,)
    along = dataclasses.replace(pedestrian, heading=np.zeros(STEPS))
    assert vehicles_that_cross(EgoView(roles, motion, FIRST), along) == ()


def test_hard_events_are_drawn_more_often():
    rng = np.random.default_rng(0)
    drawn = np.array([draw_severity(rng) for _ in range(2000)])
    low, high = SEVERITY_MPS2
    assert low <= drawn.min() and drawn.max() <= high
    # u^0.7 > 2/3 where u > (2/3)^(1/0.7) = 0.56.
    assert np.mean(drawn > low + (high - low) * 2 / 3) == pytest.approx(0.44, abs=0.04)
