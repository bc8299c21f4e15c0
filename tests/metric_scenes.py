"""Hand-made scenes with the expected value of each metric. Ego starts at the origin and drives 80 steps.

Unless a scene differs, ego is 4.8 m x 2 m, drives 10 m/s along y = 0 (as does its log, 80 m), and lanes are 3.7 m
wide with a limit of 13.4 m/s.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import STEPS, AgentKind, Flag, LightState, RoadKind
from scenes import GREEN, LANE_M, RED, car, line, straight_road


@dataclass(frozen=True)
class Scene:
    """A recording, ego's motion in it (None: as logged), and the expected metrics."""

    recording: Any
    drive: Any = None
    expected: dict[str, Any] = field(default_factory=dict)


def driven(speed, heading=0.0, **options):
    """A car along a path of given speed and heading at every step (or one for all), at the origin at step 10."""
    v, psi = (np.broadcast_to(np.asarray(part, float), (STEPS,)) for part in (speed, heading))
    middle = (psi[1:] + psi[:-1]) / 2
    step = (v[1:] + v[:-1])[:, None] / 2 * 0.1 * np.stack([np.cos(middle), np.sin(middle)], -1)
    xy = np.concatenate([np.zeros((1, 2)), step.cumsum(axis=0)])
    agent = car(**options)
    along = np.stack([np.cos(psi), np.sin(psi)], -1)
    return agent | {
        "xy": xy - xy[10],
        "heading": (psi + np.pi) % (2 * np.pi) - np.pi,
        "velocity": v[:, None] * along,
    }


T = (np.arange(STEPS) - 10) * 0.1


def two_way_road(cars, begin=-150.0, end=350.0):
    """Lane 1 along +x on y = 0, lane 2 along -x on y = 3.7, one edge around both."""
    road = straight_road(cars, begin=begin, end=end)
    oncoming = MapFeature(2, RoadKind.LANE_SURFACE, line((end, LANE_M), (begin, LANE_M)), 13.4, LANE_M)
    features = [oncoming if f.feature_id == 2 else replace(f, left_neighbours=()) for f in road.features]
    return replace(road, features=tuple(features))


def ring_road(cars, radius):
    """Two lanes on end around (0, radius), counter-clockwise through the origin, without edges."""

    def arc(begin, end):
        angle = np.linspace(begin, end, 100)
        return np.stack([radius * np.sin(angle), radius - radius * np.cos(angle), 0 * angle], -1)

    first = MapFeature(1, RoadKind.LANE_SURFACE, arc(-0.6, 2.0), 13.4, LANE_M, (2,))
    second = MapFeature(2, RoadKind.LANE_SURFACE, arc(2.0, 5.0), 13.4, LANE_M, (), (1,))
    return replace(straight_road(cars), features=(first, second), route_lanes=(1, 2))


def lanes_only(recording, *more, keep=(1, 3)):
    """The lanes of the ids ``keep`` without edges, and further features."""
    kept = [f for f in recording.features if f.feature_id in keep]
    kept = [replace(f, left_neighbours=(), right_neighbours=()) for f in kept]
    return replace(recording, features=(*kept, *more))


def fork(cars, limit=4.0, connector=False, route=(1, 3)):
    """At the origin, a lane that turns right (12 m) onto a street of 8 m/s begins where lane 1 goes on as lane 3."""
    road = lanes_only(straight_road(cars, light_x=0.0))
    arc = np.linspace(0.0, np.pi / 2, 20)
    bend = np.stack([12 * np.sin(arc), 12 * (np.cos(arc) - 1), 0 * arc], -1)
    turn = MapFeature(5, RoadKind.LANE_SURFACE, bend, limit, LANE_M, (6,), (1,), interpolating=connector)
    street = MapFeature(6, RoadKind.LANE_SURFACE, line((12, -12), (12, -150)), 8.0, LANE_M, (), (5,))
    first, second = (replace(f, successors=(3, 5)) if f.feature_id == 1 else f for f in road.features)
    return replace(road, features=(first, second, turn, street), route_lanes=route)


def turning_right(start, speed):
    """A car that comes along y = 0 from ``start``, and turns right at the origin on the lane of :func:`fork`."""
    s = start + speed * T
    angle = -np.clip(s / 12.0, 0.0, np.pi / 2)
    beyond = np.maximum(s - 6 * np.pi, 0.0)
    x = np.where(s < 0, s, -12 * np.sin(angle))
    return car(speed=speed) | {
        "xy": np.stack([x, 12 * (np.cos(angle) - 1) - beyond], -1),
        "heading": angle,
        "velocity": speed * np.stack([np.cos(angle), np.sin(angle)], -1),
    }


def crossing_street(angle, limit=13.4, x=0.0):
    """A lane that crosses y = 0 at ``x`` under an angle (rad)."""
    along = 80 * np.array([np.cos(angle), np.sin(angle)])
    return MapFeature(
        7, RoadKind.LANE_SURFACE, line((x - along[0], -along[1]), (x + along[0], along[1])), limit, LANE_M
    )


def faster_road(cars, limit):
    return straight_road(cars, limit=limit)


def shifted_left(offset, steps=None):
    """The log, shifted by ``offset`` metres to the left for the first ``steps`` steps (None: all)."""

    def drive(log):
        step = np.arange(STEPS) - 10
        shift = np.where((step >= 1) & (step <= (steps or STEPS)), offset, 0.0)
        return log + np.stack([0 * shift, shift, 0 * shift, 0 * shift], -1)

    return drive


def at_rest(log):
    """Ego stays at its pose of step 10, at a speed of zero."""
    return np.concatenate([log[:11], np.tile(log[10] * [1, 1, 1, 0], (80, 1))])


EGO = car(speed=10.0)
SAFE = {
    "collision": 0,
    "at_fault_collision": 0,
    "collision_type": 0,
    "offroad": 0,
    "left_map": 0,
    "red_light": 0,
}
FREE = {"min_ttc": 5, "average_ttc": 5, "ttc_ok": 1}
SMOOTH = {"comfort": 1, "comfortable": 1, "max_jerk": 0, "max_lateral_acceleration": 0}
LAWFUL = {
    "speeding_mean": 0, "speeding_max": 0, "speed_compliance": 1, "wrong_way": 0, "wrong_way_worst": 0, "direction": 1,
    "lane_straddle": 0, "lane_keeping": 1,
}  # fmt: skip
AHEAD = {
    "progress": 80, "progress_ratio": 1, "making_progress": 1, "route_deviation_mean": 0, "route_deviation_max": 0,
    "off_route": 0, "ade": 0, "fde": 0, "goal_distance": 0, "reached_goal": 1, "distance": 80, "log_lead": 0,
}  # fmt: skip
WON = {
    "accuracy": 1, "accuracy_at_fault": 1, "success": 1, "success_moving": 1, "vmax_score": 1, "nuplan_score": 1,
    "vmax_score_partial": None, "nuplan_score_partial": None, "ignored_overlaps": 0, "steps": 80, "last_step": 90,
}  # fmt: skip
PERFECT = SAFE | FREE | SMOOTH | LAWFUL | AHEAD | WON
CRASHED = {"collision": 1, "accuracy": 0, "success": 0, "success_moving": 0}
LOST = {"vmax_score": 0, "nuplan_score": 0}
NO_ROUTE = {
    "progress": None, "progress_ratio": None, "making_progress": None, "route_deviation_mean": None,
    "route_deviation_max": None, "off_route": None, "goal_distance": None, "reached_goal": None, "success": None,
    "success_moving": None, "vmax_score": None, "nuplan_score": None, "log_lead": None,
}  # fmt: skip


def closing(gap, closing_speed, length=None):
    """Minimum and mean time to collision over 80 steps in which a gap closes steadily.

    Ego drives through an agent of ``length`` metres, which no longer counts behind ego's rear axle.
    """
    closed = closing_speed * 0.1 * np.arange(1, 81)
    ttc = np.clip((gap - closed) / closing_speed, 0.0, 5.0)
    if length is not None:
        ttc = np.where(closed > gap + 2.4 + length + 4.8 * 1.461 / 5.176, 5.0, ttc)
    return {"min_ttc": ttc.min(), "average_ttc": ttc.mean(), "ttc_ok": float(ttc.min() >= 0.95)}


def _collisions():
    yield "into a slower car", Scene(
        straight_road([car(speed=12.0), car(29.8, speed=5.0)]), None,
        SAFE | CRASHED | LOST | SMOOTH | closing(25.0, 7.0, 4.8)
        | {"at_fault_collision": 1, "collision_type": 1, "collision_step": 46, "accuracy_at_fault": 0},
    )  # fmt: skip
    # A gap of 25.2 m at 10 m/s. A car alongside changes nothing.
    stopped = (
        SAFE | CRASHED | LOST | closing(25.2, 10.0, 4.8) | {"at_fault_collision": 1, "collision_type": 6}
    )
    yield "into a stopped car", Scene(straight_road([EGO, car(30)]), None, stopped | {"collision_step": 36})
    yield (
        "into a stopped car, another alongside",
        Scene(straight_road([EGO, car(30), car(0, LANE_M, speed=10.0)]), None, stopped),
    )
    # 17.6 m to the tail of a lorry whose centre is 30 m ahead.
    yield "into a long lorry", Scene(
        straight_road([EGO, car(30, length=20.0)]), None,
        SAFE | CRASHED | LOST | {"at_fault_collision": 1, "collision_type": 6, "collision_step": 28},
    )  # fmt: skip
    yield "rear-ended", Scene(
        straight_road([car(speed=5.0), car(-15, speed=12.0)]), None,
        PERFECT | CRASHED
        | {"collision_type": 2, "collision_step": 25, "progress": 40, "distance": 40},
    )  # fmt: skip
    yield "rear-ended at a standstill", Scene(
        straight_road([car(), car(-15, speed=5.0)]), None,
        SAFE | CRASHED | SMOOTH | LAWFUL
        | {"collision_type": 2, "accuracy_at_fault": 1, "min_ttc": None, "average_ttc": None, "ttc_ok": 1,
           "collision_step": 31, "nuplan_score": 1, "vmax_score": 1, "success_moving": None},
    )  # fmt: skip
    # Alongside and a little behind, so that no front touches first.
    swerve = car(-1.0, LANE_M, -0.05, 10.0)
    yield "swiped in the own lane", Scene(
        straight_road([EGO, swerve]), None,
        SAFE | CRASHED | SMOOTH | LAWFUL | {"collision_type": 3, "accuracy_at_fault": 1},
    )  # fmt: skip
    yield "swiping while leaving the lane", Scene(
        straight_road([driven(10.0, 0.05), car(-1.0, LANE_M, speed=10.0)]), None,
        CRASHED | LOST | {"at_fault_collision": 1, "collision_type": 3, "accuracy_at_fault": 0},
    )  # fmt: skip
    yield "head-on", Scene(
        straight_road([car(speed=5.0), car(19.95, 0.5, np.pi, 5.0, length=4.5)]), None,
        SAFE | CRASHED | LOST | closing(15.3, 10.0, 4.5)
        | {"at_fault_collision": 1, "collision_type": 4, "collision_step": 26},
    )  # fmt: skip
    yield "a pedestrian who stands", Scene(
        straight_road([EGO, car(30, 0.5, 0, 0, 0.6, 0.6, AgentKind.PEDESTRIAN)]), None,
        SAFE | CRASHED | LOST | closing(27.3, 10.0, 0.6) | {"at_fault_collision": 1, "collision_type": 5},
    )  # fmt: skip
    yield "a pedestrian walks into ego that stands", Scene(
        straight_road([car(), car(1.0, 6.05, -np.pi / 2, 1.5, 0.6, 0.6, AgentKind.PEDESTRIAN)]), None,
        SAFE | CRASHED | SMOOTH | {"collision_type": 5, "accuracy_at_fault": 1, "min_ttc": None, "collision_step": 42,
           "success_moving": None},
    )  # fmt: skip
    yield "crossing traffic hits the side", Scene(
        straight_road([EGO, car(37.5, 40.05, -np.pi / 2, 10.0, length=4.6)]), None,
        SAFE | CRASHED | {"collision_type": 3},
    )  # fmt: skip
    yield (
        "overlap from the start",
        Scene(straight_road([EGO, car(1.0, 0.5, speed=10.0)]), None, PERFECT | {"ignored_overlaps": 1}),
    )
    yield (
        "appears on top of ego",
        Scene(
            straight_road([EGO, car(1.0, 0.5, speed=10.0, steps=range(40, 91))]),
            None,
            PERFECT | {"ignored_overlaps": 1},
        ),
    )
    yield "two appear on top of ego", Scene(
        straight_road([EGO, *[car(x, 0.5, speed=10.0, steps=range(40, 91)) for x in (-1.0, 1.0)]]), None,
        PERFECT | {"ignored_overlaps": 2},
    )  # fmt: skip


def _traffic():
    yield "oncoming in its own lane", Scene(two_way_road([EGO, car(100, LANE_M, np.pi, 10.0)]), None, PERFECT)
    yield "following without closing in", Scene(straight_road([EGO, car(20, speed=10.0)]), None, PERFECT)
    yield (
        "closing in, never there",
        Scene(straight_road([EGO, car(30, speed=8.0)]), None, PERFECT | closing(25.2, 2.0)),
    )
    yield "closing in to 1.9 s", Scene(
        straight_road([EGO, car(14.7, speed=9.0)]), None,
        PERFECT | closing(9.9, 1.0) | {"min_ttc": 1.9, "ttc_ok": 1},
    )  # fmt: skip
    yield "closing in to 0.9 s", Scene(
        straight_road([EGO, car(13.7, speed=9.0)]), None,
        PERFECT | closing(8.9, 1.0)
        | {"min_ttc": 0.9, "ttc_ok": 0, "vmax_score": 14 / 19, "nuplan_score": 11 / 16},
    )  # fmt: skip
    yield "a follower that closes in", Scene(straight_road([EGO, car(-20, speed=11.0)]), None, PERFECT)


def _roads():
    leaving = int(np.ceil((1.85 + 0.3 - np.cos(0.05) - 2.4 * np.sin(0.05)) / (10 * np.sin(0.05)) / 0.1))
    yield "off the road", Scene(
        straight_road([driven(10.0, -0.05)]), None,
        LOST | {"offroad": 1, "offroad_step": 10 + leaving, "accuracy": 0, "accuracy_at_fault": 0, "success": 0,
                "collision": 0, "route_deviation_max": 80 * np.sin(0.05), "off_route": 1, "fde": 0, "distance": 80},
    )  # fmt: skip
    yield "0.25 m over the edge", Scene(
        straight_road([EGO]), shifted_left(-1.1),
        PERFECT | {"lane_straddle": 8.0, "lane_keeping": 0, "vmax_score": 16 / 19, "route_deviation_mean": 1.1,
                   "route_deviation_max": 1.1, "ade": 1.1, "fde": 1.1, "goal_distance": 1.1,
                   "distance": 79 + np.hypot(1, 1.1), "offroad": 0},
    )  # fmt: skip
    yield (
        "0.35 m over the edge",
        Scene(
            straight_road([EGO]),
            shifted_left(-1.2),
            LOST | {"offroad": 1, "offroad_step": 11, "lane_straddle": 8.0},
        ),
    )
    # The edge that closes the road is at x = 60: the front bumper is 0.3 m beyond it after 57.9 m.
    yield "off the end of the map", Scene(
        straight_road([EGO], end=60.0), None,
        {"offroad": 1, "offroad_step": 10 + 58, "left_map": 1, "accuracy": 0, "accuracy_at_fault": 0},
    )  # fmt: skip
    yield "past the end by a step", Scene(straight_road([EGO], end=80.5), None, {"offroad": 1, "left_map": 0})
    yield "in the other lane of the corridor", Scene(
        straight_road([EGO]), shifted_left(LANE_M),
        PERFECT | {"route_deviation_mean": LANE_M, "route_deviation_max": LANE_M, "ade": LANE_M, "fde": LANE_M,
                   "goal_distance": LANE_M, "distance": 79 + np.hypot(1, LANE_M)},
    )  # fmt: skip
    yield "between two lanes of one direction", Scene(
        straight_road([EGO]), shifted_left(LANE_M / 2),
        PERFECT | {"route_deviation_mean": LANE_M / 2, "route_deviation_max": LANE_M / 2, "ade": LANE_M / 2,
                   "fde": LANE_M / 2, "goal_distance": LANE_M / 2, "distance": 79 + np.hypot(1, LANE_M / 2)},
    )  # fmt: skip
    yield "aside for half the log", Scene(
        straight_road([EGO]), shifted_left(0.8, 40),
        PERFECT | {"route_deviation_mean": 0.4, "route_deviation_max": 0.8, "ade": 0.4, "fde": 0,
                   "distance": 78 + 2 * np.hypot(1, 0.8)},
    )  # fmt: skip
    for steps, keeping in ((30, 1), (31, 1), (32, 1), (34, 1), (35, 0.5), (57, 0.5), (58, 0)):
        yield f"straddling for {steps} steps", Scene(
            two_way_road([EGO]), shifted_left(1.2, steps),
            SAFE | {"lane_straddle": steps / 10, "lane_keeping": keeping, "wrong_way": 0, "direction": 1,
                    "vmax_score": (16 + 3 * keeping) / 19, "nuplan_score": 1, "off_route": 0},
        )  # fmt: skip
    against = {"off_route": 1, "lane_straddle": 8, "lane_keeping": 0}  # no lane of its own direction is near
    for speed, grade in ((1.9, 0.5), (2.1, 0.5), (2.5, 0.5), (2.6, 0), (10.0, 0)):
        # The first step goes sideways too: 3.7 m at once.
        first = np.hypot(speed / 10, LANE_M)
        total, worst = first + 7.9 * speed, first + 0.9 * speed
        yield f"against traffic at {speed} m/s", Scene(
            two_way_road([car(speed=speed)]), shifted_left(LANE_M),
            SAFE | against | {"wrong_way": total, "wrong_way_worst": worst, "direction": grade, "nuplan_score": grade},
        )  # fmt: skip
    yield "against traffic for three steps", Scene(
        two_way_road([car(speed=1.0)]), lambda log: shifted_left(LANE_M, 23)(shifted_left(-LANE_M, 20)(log)),
        SAFE | {"wrong_way": 0.2 + np.hypot(0.1, LANE_M), "wrong_way_worst": 0.2 + np.hypot(0.1, LANE_M)},
    )  # fmt: skip


def _lights():
    def lit(state, speed=10.0, **more):
        return straight_road([car(speed=speed)], light=state, **more)

    # The bumper, 2.4 m before the centre, crosses x = 40 after 3.76 s.
    ran = {"red_light": 1, "red_light_step": 48, "accuracy": 0, "accuracy_at_fault": 0, "success": 0,
           "success_moving": 0, "vmax_score": 0, "nuplan_score": 1, "vmax_score_partial": None}  # fmt: skip
    yield "through red", Scene(lit(RED), None, PERFECT | ran)
    yield "through a red arrow", Scene(lit(LightState.ARROW_STOP), None, PERFECT | ran)
    for name in ("CAUTION", "FLASHING_STOP", "UNKNOWN"):
        yield f"through {name}", Scene(lit(LightState[name]), None, PERFECT)
    yield "through green", Scene(lit(GREEN), None, PERFECT)
    turning = np.full(STEPS, int(RED))
    turning[47:] = int(GREEN)
    yield "green just before the line", Scene(lit(turning), None, PERFECT)
    late = np.full(STEPS, int(GREEN))
    late[48:] = int(RED)
    yield "red just after the line", Scene(lit(late), None, PERFECT)
    # 10 m/s to rest at 2.5 m/s2 takes 20 m: the bumper comes to rest at 22.4 m, 0.6 m before the line.
    brake = np.clip(10 - 2.5 * np.maximum(T, 0), 0, None)
    yield "braking to the line", Scene(
        straight_road([driven(brake)], light=RED, light_x=23.0), None,
        SAFE | LAWFUL | {"accuracy": 1, "distance": 20, "progress": 20, "success": 1},
    )  # fmt: skip
    unlit = lit(GREEN)
    yield "without lights in the data", Scene(
        replace(unlit, lights=(), flags=unlit.flags & ~Flag.LIGHTS), None,
        PERFECT | {"red_light": None, "vmax_score": None, "vmax_score_partial": 1},
    )  # fmt: skip


def _speeds():
    def limited(speed, limit=13.4):
        return straight_road([driven(speed)], limit=limit)

    yield "2.23 m/s too fast", Scene(
        limited(13.4 + 2.23), None,
        {"speeding_mean": 2.23, "speeding_max": 2.23, "speed_compliance": 0, "nuplan_score": 12 / 16},
    )  # fmt: skip
    yield "half of that", Scene(
        limited(13.4 + 1.115), None,
        {"speeding_mean": 1.115, "speeding_max": 1.115, "speed_compliance": 0.5, "nuplan_score": 14 / 16,
         "vmax_score": 17 / 19},
    )  # fmt: skip
    yield (
        "far too fast",
        Scene(limited(20.0), None, {"speeding_mean": 6.6, "speeding_max": 6.6, "speed_compliance": 0}),
    )
    # From 12.4 m/s at 0.25 m/s2: 13.4 at 4 s and 14.4 at 8 s; the mean of 0.025 k, k = 1..40, over 80 steps.
    yield "too fast in the end", Scene(
        limited(12.4 + 0.25 * T), None,
        {"speeding_mean": 0.025 * 820 / 80, "speeding_max": 1.0, "speed_compliance": 1 - 0.025 * 820 / 80 / 2.23,
         "comfort": 1},
    )  # fmt: skip
    yield (
        "no limit in the data",
        Scene(limited(14.4, 0.0), None, {"speeding_mean": 1.0, "speed_compliance": 1 - 1 / 2.23}),
    )
    bare = straight_road([EGO])
    yield "no map", Scene(
        replace(bare, features=(), route_lanes=()), None,
        NO_ROUTE
        | {"speeding_mean": None, "speeding_max": None, "speed_compliance": None, "offroad": None, "left_map": None,
           "wrong_way": None, "wrong_way_worst": None, "direction": None, "lane_straddle": None, "lane_keeping": None,
           "accuracy": None, "accuracy_at_fault": None, "collision": 0, "min_ttc": 5, "comfort": 1, "ade": 0,
           "distance": 80, "nuplan_score_partial": 1, "vmax_score_partial": 1},
    )  # fmt: skip


def _junctions():
    """Lanes that overlap: the one that is driven has the limit, and holds ego."""
    free = {"speeding_mean": 0, "speeding_max": 0, "speed_compliance": 1}
    for aside in (-0.3, -0.6):
        yield f"{-aside} m towards a slow turn lane", Scene(
            fork([car(-30.0, speed=13.0)]), shifted_left(aside), free | {"nuplan_score": 1}
        )  # fmt: skip
    # The slow lane is 6 pi m long; within 0.5 m of its ends the faster lane before or after it holds ego, too.
    log = turning_right(-10.0, 6.0)
    way = (-10.0 + 6.0 * T)[11:]
    slow = np.count_nonzero((way > 0.5) & (way < 6 * np.pi - 0.5))
    turn = {"speeding_mean": 2.0 * slow / 80, "speeding_max": 2, "off_route": 0}
    yield "turning on the slow lane", Scene(fork([log], route=(1, 5, 6)), None, turn)
    yield "turning on a slow connector", Scene(
        fork([log], connector=True, route=(1, 5, 6)), None, free | {"off_route": 0}
    )  # fmt: skip
    # Off the route both lanes hold ego until it is 1.85 m off lane 3, whose limit holds.
    apart = np.count_nonzero((log["xy"][11:, 1] < -1.85) & (way < 6 * np.pi - 0.5))
    straight_on = car(-10.0, speed=6.0)

    def right(_):
        return np.column_stack([log["xy"] - log["xy"][10], log["heading"], 0 * T + 6.0])

    yield "turning against the route", Scene(
        fork([straight_on]), right, {"speeding_mean": 2.0 * apart / 80, "speeding_max": 2, "off_route": 1}
    )  # fmt: skip
    for degrees in (25, 60, 120):
        street = crossing_street(np.deg2rad(degrees), 5.0, x=40.2)
        yield f"a slow street crosses at {degrees} deg", Scene(
            lanes_only(straight_road([EGO]), street), shifted_left(0.3), free | {"nuplan_score": 1}
        )  # fmt: skip
    # Side impact after 4 s, ego's centre 0.3 m off its lane's and nearer to that of the street.
    hit = np.deg2rad(60.0)
    along = 8.0 * (T - 4.0)
    other = car(0, 0, hit, 8.0) | {
        "xy": np.stack([40.0 + (along - 3.4) * np.cos(hit), (along - 3.4) * np.sin(hit)], -1)
    }
    for name, lanes in (("in a junction", (crossing_street(hit, x=39.6),)), ("without the street", ())):
        yield f"hit in the side {name}", Scene(
            lanes_only(straight_road([EGO, other]), *lanes), shifted_left(0.3),
            CRASHED | {"at_fault_collision": 0, "collision_type": 3, "accuracy_at_fault": 1, "lane_straddle": 0},
        )  # fmt: skip


def _ends_of_the_map():
    """Lanes along the scenario's axis without edges: the box around them has no area."""
    thin = lanes_only(straight_road([EGO]))
    for aside, off, left in ((-0.2, 0, 0), (0.2, 0, 0), (2.5, 0, 0), (-3.5, 1, 0), (-4.5, 1, 1)):
        yield f"{aside} m from the only lane", Scene(
            thin, shifted_left(aside), {"offroad": off, "left_map": left, "accuracy": 1 - off, "steps": 80}
        )  # fmt: skip
    # 4 m beyond its last point the road leaves the map, not ego the road.
    for end, left in ((77.0, 0), (75.0, 1), (30.0, 1)):
        short = lanes_only(straight_road([EGO], light_x=20.0, end=end))
        yield f"a road that is mapped for {end} m", Scene(
            short, None, {"offroad": 0, "left_map": left, "accuracy": 1}
        )  # fmt: skip
    short = straight_road([EGO], light_x=20.0, end=30.0)
    right = MapFeature(8, RoadKind.EDGE_BOUNDARY, line((-150, -2), (30, -2)))
    left = MapFeature(9, RoadKind.EDGE_BOUNDARY, line((30, 2), (-150, 2)))
    yield "edges that end", Scene(
        lanes_only(short, right, left), None, {"offroad": 0, "left_map": 1, "accuracy": 1}
    )  # fmt: skip
    # Never on the road, and 1 m outside the widened box.
    yield "off the map from the start", Scene(
        lanes_only(straight_road([EGO]), right), shifted_left(-7.0),
        {"offroad": 1, "offroad_step": 11, "left_map": 1, "accuracy": 0},
    )  # fmt: skip


def _comforts():
    fast = 40.0
    yield "gentle acceleration", Scene(
        faster_road([driven(5 + 2.0 * (T + 1))], fast), None,
        WON | {"comfort": 1, "comfortable": 1, "max_jerk": 0, "progress_ratio": 1},
    )  # fmt: skip
    yield "accelerating at 2.5 m/s2", Scene(
        faster_road([driven(5 + 2.5 * (T + 1))], fast), None,
        {"comfort": 0, "comfortable": 0, "max_jerk": 0, "nuplan_score": 14 / 16, "vmax_score": 17 / 19, "accuracy": 1},
    )  # fmt: skip
    yield "braking at 4 m/s2", Scene(
        faster_road([driven(38 - 4.0 * (T + 1))], fast), None,
        {"comfort": 1, "comfortable": 1, "max_jerk": 0, "distance": 34 * 8 - 2 * 64, "progress": 144},
    )  # fmt: skip
    yield (
        "braking at 4.1 m/s2",
        Scene(
            faster_road([driven(38 - 4.1 * (T + 1))], fast),
            None,
            {"comfort": 0, "comfortable": 0, "max_jerk": 0},
        ),
    )
    yield "a jerk of 0.25 m/s3", Scene(
        faster_road([driven(5 + 0.125 * (T + 1) ** 2)], fast), None,
        {"comfort": 1, "comfortable": 1, "max_jerk": 0.25, "max_lateral_acceleration": 0},
    )  # fmt: skip
    # On a circle heading and speed are exact; lateral acceleration is v^2 / r.
    for speed, rate, comfort in ((10.0, 0.48, 1), (10.0, 0.5, 0), (4.0, 0.9, 1), (4.0, 1.0, 0)):
        yield f"a circle at {speed} m/s and {rate} rad/s", Scene(
            ring_road([driven(speed, rate * T)], speed / rate), None,
            {"max_lateral_acceleration": speed * rate, "max_jerk": 0, "comfort": comfort, "comfortable": comfort,
             "collision": 0, "min_ttc": 5},
        )  # fmt: skip
    # 64 m of a ring of 20 m radius: 3.2 rad, so the path ends 40 m from its start.
    yield "round a bend", Scene(
        ring_road([driven(8.0, 0.4 * T)], 20.0), None,
        {"progress": 64, "progress_ratio": 1, "distance": 64, "off_route": 0, "offroad": 0,
         "lane_straddle": 0, "wrong_way": 0, "reached_goal": 1, "success": 1, "success_moving": 1},
    )  # fmt: skip


def _journeys():
    yield "alone", Scene(straight_road([EGO]), None, PERFECT)
    yield "standing, as logged", Scene(
        straight_road([car()]), None,
        PERFECT | {"min_ttc": None, "average_ttc": None, "progress": 0, "distance": 0, "success_moving": None,
                   "log_lead": None},
    )  # fmt: skip
    yield "standing where the log drives", Scene(
        straight_road([EGO]), at_rest,
        SAFE | LOST
        | {"min_ttc": None, "average_ttc": None, "ttc_ok": 1, "progress": 0, "progress_ratio": 0, "making_progress": 0,
           "goal_distance": 80, "reached_goal": 0, "distance": 0, "ade": 40.5, "fde": 80, "accuracy": 1, "success": 0,
           "success_moving": 0, "log_lead": -4.05},
    )  # fmt: skip

    def slower(share):
        def drive(log):
            result = log.copy()
            result[10:, 0] = log[10, 0] + share * (log[10:, 0] - log[10, 0])
            return result

        return drive

    # Times to collision and comfort see the speeds, which are the log's.
    for share, far in ((0.5, 0), (0.21, 0), (0.19, 0), (0.94, 0), (0.97, 1)):
        moving = float(share >= 0.2)
        yield f"{share:.0%} of the log", Scene(
            straight_road([EGO]), slower(share),
            SAFE | FREE
            | {"progress": 80 * share, "progress_ratio": share, "making_progress": moving, "reached_goal": far,
               "goal_distance": 80 * (1 - share), "distance": 80 * share, "ade": 40.5 * (1 - share),
               "fde": 80 * (1 - share), "log_lead": -4.05 * (1 - share), "accuracy": 1,
               "success": far, "success_moving": far,
               "nuplan_score": moving * (11 + 5 * share) / 16, "vmax_score": moving * (14 + 5 * share) / 19},
        )  # fmt: skip
    # Beyond the goal the ratio stays at 1.
    yield (
        "further than the log",
        Scene(
            straight_road([EGO]),
            slower(1.1),
            {"progress": 88, "progress_ratio": 1, "goal_distance": 8, "reached_goal": 1, "log_lead": 0.405},
        ),
    )
    # The log drives 39.5 m in 4 s and waits; at half its speed ego passes the metre p about p / 10 seconds later.
    early = driven(np.where(T < 4.0 - 1e-6, 10.0, 0.0))
    behind = 39.5 / 80 * 80 * 81 / 2 - (39 * 40 / 2 + 41 * 39.5)
    yield "a log that waits", Scene(
        straight_road([early]), lambda log: np.stack([39.5 / 8 * T, 0 * T, 0 * T, 0 * T + 39.5 / 8], -1),
        {"progress": 39.5, "progress_ratio": 1, "reached_goal": 1, "log_lead": 0.1 * behind / 39.5},
    )  # fmt: skip
    short = straight_road([driven(np.where(T <= 0.4, 10.0, np.clip(10 - 10 * (T - 0.4), 0, None)))])
    yield "a log that stops", Scene(short, None, {"progress_ratio": 1, "reached_goal": 1, "goal_distance": 0})
    yield (
        "a log of 4 m",
        Scene(
            straight_road([car(speed=0.5)]),
            None,
            PERFECT | {"progress": 4, "distance": 4, "success_moving": None},
        ),
    )
    gap = car(speed=10.0, steps=[*range(40), *range(50, 91)])
    straight_on = np.stack([10 * T, 0 * T, 0 * T, 0 * T + 10], -1)
    yield (
        "a gap in the log",
        Scene(
            straight_road([gap]),
            lambda log: straight_on,
            {"ade": 0, "fde": 0, "distance": 80, "accuracy": 1, "steps": 80},
        ),
    )


def scenes():
    """All scenes by name."""
    by_name = {}
    for group in (
        _journeys,
        _collisions,
        _traffic,
        _roads,
        _ends_of_the_map,
        _lights,
        _speeds,
        _junctions,
        _comforts,
    ):
        for name, scene in group():
            assert name not in by_name, name
            by_name[name] = scene
    return by_name
