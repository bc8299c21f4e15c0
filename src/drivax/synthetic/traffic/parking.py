"""Parked cars: in the bays beside the lanes and, now and then, double-parked in a lane."""

from __future__ import annotations

import math

import numpy as np

from drivax.scenario.schema import AgentKind
from drivax.synthetic.roads.curves import Pose
from drivax.synthetic.roads.network import Bay, Lane, RoadNetwork
from drivax.synthetic.traffic.roles import Scripted

#: Who passes a double-parked car without leaving the road needs this width, m.
_PASSAGE_M = 2.3
#: Room that is left in a bay before and behind the car, m.
_MANOEUVRE_M = 0.6
#: Double-parked cars keep so far from the ends of lanes, m.
_FROM_ENDS_M = 15.0


def parked_cars(
    network: RoadNetwork, share: float, double_share: float, rng: np.random.Generator, steps: int
) -> tuple[Scripted, ...]:
    """Draws which bays are taken, and whether somebody stands beside one.

    Args:
        network: The roads.
        share: Share of bays that are taken.
        double_share: Chance that somebody stands in the lane beside a bay, where others can pass: on a lane of the
            same direction, on the oncoming lane, or because 2.3 m are left.
        rng: Source of chance.
        steps: Length of the result, time steps.
    """
    result = []
    for bay in network.bays:
        # Everything is drawn for every bay: a change of one share moves nobody else.
        size = _size(rng, bay.length_m)
        along, aside = rng.normal(0.0, 0.15), rng.normal(0.0, 0.07)
        turn = math.pi * (rng.random() < 0.03) + rng.normal(0.0, math.radians(1.2))
        taken = rng.random() < share
        if taken and size[0] < bay.length_m:
            play = (bay.length_m - size[0]) / 2
            pose = _moved(bay.pose, float(np.clip(along, -play, play)), float(np.clip(aside, -0.15, 0.15)))
            pose = Pose(pose.x, pose.y, pose.heading + turn)
            result.append(Scripted.standing(AgentKind.VEHICLE, size, pose, steps))
    doubled, beside_m = rng.random() < double_share, float(rng.uniform(0.0, 0.25))
    for place in rng.permutation(len(network.bays)).tolist() if doubled else ():
        bay, size = network.bays[place], _size(rng, network.bays[place].length_m)
        if _passable(network, bay, size[1], beside_m):
            pose = _beside(network, bay, size[1], beside_m)
            return (*result, Scripted.standing(AgentKind.VEHICLE, size, pose, steps))
    return tuple(result)


def _size(rng: np.random.Generator, room_m: float) -> tuple[float, float, float]:
    """A car or, in one case of eight, a van, that fits the bay."""
    length = float(np.clip(rng.normal(4.5, 0.35), 3.6, 5.2))
    van = rng.random() < 0.125 and room_m > 6.2
    if van:
        return min(length + 0.8, room_m - _MANOEUVRE_M), 2.0, 2.3
    return min(length, room_m - _MANOEUVRE_M), float(np.clip(rng.normal(1.82, 0.06), 1.65, 1.95)), 1.55


def _moved(pose: Pose, ahead_m: float, left_m: float) -> Pose:
    cos, sin = math.cos(pose.heading), math.sin(pose.heading)
    return Pose(pose.x + ahead_m * cos - left_m * sin, pose.y + ahead_m * sin + left_m * cos, pose.heading)


def _beside(network: RoadNetwork, bay: Bay, width_m: float, gap_m: float) -> Pose:
    """In the lane beside the bay, as near to it as the lane's border allows."""
    lane = network.lanes[bay.lane]
    centre = _pose_at(lane, bay.along_m)
    dx, dy = bay.pose.x - centre.x, bay.pose.y - centre.y
    side = math.copysign(1.0, dy * math.cos(centre.heading) - dx * math.sin(centre.heading))
    return _moved(centre, 0.0, side * ((lane.width_m - width_m) / 2 - gap_m))


def _passable(network: RoadNetwork, bay: Bay, width_m: float, gap_m: float) -> bool:
    lane = network.lanes[bay.lane]
    if lane.connector or not _FROM_ENDS_M < bay.along_m < lane.length_m - _FROM_ENDS_M:
        return False
    if lane.left >= 0 or lane.right >= 0 or lane.width_m - width_m - gap_m >= _PASSAGE_M:
        return True
    return _oncoming(network, lane, bay.along_m)


def _oncoming(network: RoadNetwork, lane: Lane, along_m: float) -> bool:
    """Whether a lane of the other direction lies right beside this place."""
    here = _pose_at(lane, along_m)
    for other in network.lanes:
        gap = np.hypot(other.curve.xy[:, 0] - here.x, other.curve.xy[:, 1] - here.y)
        place = int(np.argmin(gap))
        apart = (lane.width_m + other.width_m) / 2 + 0.5
        if gap[place] < apart and math.cos(other.curve.heading[place] - here.heading) < -0.9:
            return True
    return False


def _pose_at(lane: Lane, along_m: float) -> Pose:
    arc = lane.curve.arc_m
    x, y = (float(np.interp(along_m, arc, lane.curve.xy[:, axis])) for axis in (0, 1))
    return Pose(x, y, float(np.interp(along_m, arc, lane.curve.heading)))
