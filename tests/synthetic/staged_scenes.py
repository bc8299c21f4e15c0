"""Hand-made roads, egos and users, by default on two lanes one way and one the other way; shared by tests."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from drivax.scenario.schema import AgentKind, RoadKind
from drivax.synthetic.expert.driver import draw_expert
from drivax.synthetic.roads.curves import Pose, straight
from drivax.synthetic.roads.network import Lane, Line, RoadNetwork
from drivax.synthetic.traffic.paths import Sway, lane_path
from drivax.synthetic.traffic.roles import EgoPlan, Motion, Roles

WIDTH, LENGTH, LIMIT = 3.5, 400.0, 14.0
CAR = (4.6, 1.9, 1.5)
TIMES = np.arange(91) * 0.1


def road(lanes=(1, 1, -1), turn=None, length_m=LENGTH, limit=LIMIT):
    """A road along +x; lane 0 is the rightmost at y = 0, the next ones are to its left; -1 leads back.

    ``turn`` replaces the centre of lane 0; the edges stay those of the straight road.
    """
    built = []
    for k, direction in enumerate(lanes):
        begin = Pose(0.0, k * WIDTH, 0.0) if direction > 0 else Pose(length_m, k * WIDTH, math.pi)
        curve = straight(begin, length_m)
        if k == 0 and turn is not None:
            curve = turn
        left = k + 1 if direction > 0 and lanes[k + 1 : k + 2] == (1,) else -1
        built.append(Lane(curve, WIDTH, limit, left=left, right=k - 1 if direction > 0 and k else -1))
    low, high = -WIDTH / 2 - 0.8, (len(lanes) - 0.5) * WIDTH + 0.8
    ring = np.array([[-20.0, low], [length_m + 20.0, low], [length_m + 20.0, high], [-20.0, high]])
    return RoadNetwork("by_hand", tuple(built), (Line(RoadKind.EDGE_BOUNDARY, ring),))


def crossed(lines_at, control, network=None):
    """A straight road of one lane in three pieces; the middle one is a connector with a rule at its entry."""
    a = straight(Pose(0.0, 0.0, 0.0), lines_at)
    b = straight(a.end, 20.0)
    c = straight(b.end, LENGTH - lines_at - 20.0)
    lanes = (
        Lane(a, WIDTH, LIMIT, successors=(1,)),
        Lane(b, WIDTH, LIMIT, successors=(2,), predecessors=(0,), connector=True, control=control),
        Lane(c, WIDTH, LIMIT, predecessors=(1,)),
    )
    return replace(network or road((1,)), lanes=lanes)


def user(xy, heading=0.0, size=CAR, kind=AgentKind.VEHICLE, velocity=(0.0, 0.0), from_s=0.0):
    """A user that moves at constant velocity from a time on: (kind, size, xy, heading, speed)."""
    moved = np.maximum(TIMES - from_s, 0.0)[:, None] * np.array(velocity)
    speed = np.where(from_s <= TIMES, math.hypot(*velocity), 0.0)
    return kind, size, np.array(xy) + moved, np.full(len(TIMES), float(heading)), speed


def scene(network, speed, users=(), at=30.0, lanes=(0,)):
    """Roles and motion of ego on a lane at constant speed, among users that do not react."""
    driver = replace(draw_expert(np.random.default_rng(0)), size_m=np.array([CAR]))
    path = lane_path(network, lanes, Sway())
    roles = Roles(network, [path], driver, np.array([at]), np.array([speed]), lanes)
    distance = at + speed * TIMES
    grid = path.step_m * np.arange(len(path.curve.xy))
    xy = np.stack([np.interp(distance, grid, path.curve.xy[:, k]) for k in (0, 1)], axis=-1)
    heading = np.interp(distance, grid, path.curve.heading)
    ego = (AgentKind.VEHICLE, CAR, xy, heading, np.full(len(TIMES), speed))
    kinds, sizes, positions, headings, speeds = zip(ego, *users, strict=True)
    motion = Motion(
        kind=np.array(kinds, np.int8),
        size_m=np.array(sizes, float),
        xy=np.stack(positions),
        heading=np.stack(headings),
        speed=np.stack(speeds),
        valid=np.ones((len(kinds), len(TIMES)), bool),
        distance_m=distance[None],
        acceleration=np.zeros((1, len(TIMES))),
        paths=[path],
    )
    return roles, motion


def driven(motion, plan: EgoPlan):
    """The motion with ego on its plan; no other user reacts."""
    xy, heading, speed = motion.xy.copy(), motion.heading.copy(), motion.speed.copy()
    xy[0, plan.first_step :], heading[0, plan.first_step :] = plan.xy, plan.heading
    speed[0, plan.first_step :] = plan.speed
    return replace(motion, xy=xy, heading=heading, speed=speed)


__all__ = ["CAR", "LENGTH", "LIMIT", "TIMES", "WIDTH", "crossed", "driven", "road", "scene", "user"]
