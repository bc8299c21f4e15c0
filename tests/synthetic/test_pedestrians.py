from __future__ import annotations

import math

import numpy as np
import pytest

from drivax.synthetic.roads.curves import Pose, straight
from drivax.synthetic.roads.network import Control, Crossing, Draft, RoadNetwork
from drivax.synthetic.roads.signals import Colour, LightGroup, SignalPlan
from drivax.synthetic.traffic.obstacles import Boxes
from drivax.synthetic.traffic.path_arrays import Worlds
from drivax.synthetic.traffic.pedestrians import Pedestrians, place_pedestrians
from drivax.synthetic.traffic.roles import Pedestrian

TIMES = (np.arange(151) - 60) * 0.1
CAR = np.array([[4.6, 1.9, 1.6]])


def street(marked=True, green_s=None):
    """One lane each way along x, crossed at x = 50, with lights if ``green_s``; sidewalks 2 m from the kerbs."""
    draft = Draft()
    lanes = []
    for start in (Pose(0.0, -1.75, 0.0), Pose(100.0, 1.75, math.pi)):
        first = draft.lane(straight(start, 45.0), 3.5, 12.0)
        control = Control.NONE if green_s is None else Control.SIGNAL
        connector = draft.lane(straight(start.ahead(45.0), 10.0), 3.5, 12.0, connector=True, control=control)
        last = draft.lane(straight(start.ahead(55.0), 45.0), 3.5, 12.0)
        draft.link(first, connector)
        draft.link(connector, last)
        lanes.append(connector)
    crossing = Crossing(np.array([[50.0, -4.0], [50.0, 4.0]]), 3.0, tuple((i, 5.0) for i in lanes), marked)
    signals = None
    if green_s is not None:
        groups = (LightGroup(tuple(lanes), False), LightGroup((), False))
        signals = SignalPlan(groups, ((0,), (1,)), (green_s, 20.0), offset_s=-6.0)
    sidewalks = (straight(Pose(0.0, -6.0, 0.0), 100.0), straight(Pose(0.0, 6.0, 0.0), 100.0))
    return RoadNetwork(
        "test", tuple(draft.lanes), (), crossings=(crossing,), sidewalks=sidewalks, signals=signals
    )


def over(speed=1.4, before=6.0):
    """A pedestrian from 10 m south of the road straight over it, with kerbs at 6 m and 14 m."""
    return Pedestrian(straight(Pose(50.0, -10.0, math.pi / 2), 20.0), 6.0 - before, speed, 0, 6.0, 14.0)


def play(network, pedestrians, cars=None, times=TIMES):
    """Return positions, headings and speeds of the pedestrians and the occupied crossings at all steps.

    ``cars`` returns positions, headings and speeds of cars at a step.
    """
    pedestrians = Pedestrians(Worlds([network], [len(cars(0)[1]) if cars else 0]), [pedestrians], [times])
    out = []
    for t in range(len(times)):
        xy, heading, speed = cars(t) if cars else (np.zeros((0, 2)), np.zeros(0), np.zeros(0))
        vehicles = Boxes(xy, heading, speed, np.tile(CAR[:, :2], (len(xy), 1)))
        boxes, occupied = pedestrians.step(t, vehicles, np.ones(len(xy), bool))
        out.append((boxes.xy, boxes.heading, boxes.speed, occupied))
    return [np.stack(column) for column in zip(*out, strict=True)]


def car_at(x0, speed):
    return lambda t: (np.array([[x0 + speed * t * 0.1, -1.75]]), np.zeros(1), np.array([float(speed)]))


def test_pedestrians_cross_a_free_road_at_their_speed():
    xy, heading, speed, occupied = play(street(), (over(),))
    y = -10.0 + 1.4 * 0.1 * np.arange(len(xy))
    assert xy[:, 0, 1] == pytest.approx(np.minimum(y, 10.0), abs=0.35)
    assert np.all(xy[:, 0, 0] == 50.0) and heading[:, 0] == pytest.approx(math.pi / 2)
    assert speed[:100, 0] == pytest.approx(1.4)
    on = (xy[:, 0, 1] > -4.0) & (xy[:, 0, 1] < 4.0)
    near = (xy[:, 0, 1] > -5.0) & (xy[:, 0, 1] < 4.0)
    assert np.all(occupied[on, 0]) and not np.any(occupied[~near, 0])
    # Pedestrians stop at the end of their path.
    assert xy[-1, 0, 1] <= 10.0 and speed[-1, 0] < 0.2


@pytest.mark.parametrize("marked", [True, False])
def test_pedestrians_wait_for_cars_that_cannot_stop(marked):
    # The pedestrian reaches the kerb after 4.3 s; the car is then 9 m before the crossing at 10 m/s.
    xy, _, speed, occupied = play(street(marked), (over(),), car_at(-2.0, 10.0))
    car = -2.0 + np.arange(len(xy))
    passing = (car > 40.0) & (car < 52.0)
    assert np.all(xy[passing, 0, 1] < -4.0)
    assert speed[passing, 0].min() < 0.5
    assert xy[-1, 0, 1] > 4.0
    gap = np.hypot(car - xy[:, 0, 0], -1.75 - xy[:, 0, 1])
    assert gap.min() > 2.0
    assert np.any(occupied[passing]) == marked


def test_pedestrians_take_priority_only_at_marked_crossings():
    # At 4 s the pedestrian is near the kerb, and the car is 40 m away at 10 m/s: it could stop with 1.3 m/s2, or would
    # arrive 4 s later, when the pedestrian, who needs 6 s, is still on the road.
    def braking(t):
        since = max(0.0, 0.1 * t - 4.0)
        v = max(0.0, 10.0 - 1.6 * since)
        x = -30.0 + 10.0 * min(0.1 * t, 4.0) + (100.0 - v * v) / 3.2
        return np.array([[x, -1.75]]), np.zeros(1), np.array([v])

    marked = play(street(True), (over(),), braking)
    assert marked[2][:, 0].min() > 1.0 or marked[0][75, 0, 1] > -2.0
    unmarked = play(street(False), (over(),), braking)
    assert unmarked[0][75, 0, 1] < -4.0


def test_pedestrians_wait_for_enough_red_at_lights():
    # From step 0 on green for 5.4 s, yellow for 3 s, then red for 26 s.
    network = street(green_s=5.4)
    xy, _, _, occupied = play(network, (over(),))
    colour, _ = network.signals.colours(TIMES, len(network.lanes))
    on = (xy[:, 0, 1] > -4.0) & (xy[:, 0, 1] < 4.0)
    assert on.any() and np.all(colour[on, 1] == Colour.RED)
    assert not occupied[colour[:, 1] != Colour.RED].any()
    # When this one starts to look for a gap, 1.4 s of red are left.
    late = SignalPlan(network.signals.groups, ((0,), (1,)), (6.0, 3.1), offset_s=-20.0 + 0.3)
    waits = RoadNetwork("test", network.lanes, (), crossings=network.crossings, signals=late)
    xy = play(waits, (over(),))[0]
    colour, _ = late.colours(TIMES, len(network.lanes))
    on = (xy[:, 0, 1] > -4.0) & (xy[:, 0, 1] < 4.0)
    assert np.all(colour[on, 1] == Colour.RED)


def test_no_pedestrian_enters_a_standing_queue():
    standing = lambda t: (np.array([[50.0, -1.75]]), np.zeros(1), np.zeros(1))  # noqa: E731
    xy, _, speed, _ = play(street(), (over(),), standing)
    assert xy[:, 0, 1].max() < -4.0 and speed[-1, 0] == pytest.approx(0.0, abs=0.05)
    # Pedestrians stop before a vehicle off crossings, too.
    along = Pedestrian(straight(Pose(50.0, -10.0, math.pi / 2), 20.0), 0.0, 1.4)
    xy = play(street(), (along,), standing)[0]
    assert xy[:, 0, 1].max() < -1.75 - 0.95


def test_pedestrians_move_independently():
    pedestrians = (
        over(1.1),
        over(1.7, before=3.0),
        Pedestrian(straight(Pose(0.0, -6.0, 0.0), 100.0), 5.0, 1.3),
    )
    together = play(street(), pedestrians, car_at(-20.0, 8.0))
    for i, pedestrian in enumerate(pedestrians):
        alone = play(street(), (pedestrian,), car_at(-20.0, 8.0))
        for a, b in zip(together[:3], alone[:3], strict=True):
            assert np.array_equal(a[:, i], b[:, 0])


@pytest.mark.slow
def test_placed_pedestrians_are_on_their_paths_and_some_cross_during_the_recording():
    network = street()
    crossing, count = 0, 0
    for seed in range(40):
        pedestrians = place_pedestrians(network, 3.0, np.random.default_rng(seed), TIMES)
        count += len(pedestrians)
        for pedestrian in pedestrians:
            length = float(pedestrian.curve.arc_m[-1])
            assert 0.0 <= pedestrian.start_m <= length
            assert 0.7 <= pedestrian.speed_mps <= 2.0
            if pedestrian.crossing >= 0:
                (kerb, opposite), _ = pedestrian.curve.at(np.array([pedestrian.kerb_m, pedestrian.across_m]))
                assert abs(kerb[1]) == pytest.approx(4.0, abs=0.3) and kerb[0] == pytest.approx(50.0, abs=1.2)
                assert opposite[1] == pytest.approx(-kerb[1], abs=0.5)
            else:
                assert np.abs(pedestrian.curve.xy[:, 1]).min() > 4.5
        xy = play(network, pedestrians)[0] if pedestrians else np.zeros((151, 0, 2))
        crossing += int(np.sum((np.abs(xy[60:, :, 1]) < 3.0).any(axis=0)))
    # Poisson means: 3 per 100 m of two sidewalks of 100 m, and 1.5 at the crossing.
    assert count / 40 == pytest.approx(7.5, abs=1.5)
    assert crossing / 40 > 0.7
    again = place_pedestrians(network, 3.0, np.random.default_rng(7), TIMES)
    same = place_pedestrians(network, 3.0, np.random.default_rng(7), TIMES)
    assert [(w.start_m, w.speed_mps) for w in again] == [(w.start_m, w.speed_mps) for w in same]


def test_no_pedestrians_without_crossings():
    network = RoadNetwork("test", street().lanes, ())
    xy, _, _, occupied = play(network, ())
    assert xy.shape == (151, 0, 2) and occupied.shape == (151, 0)
