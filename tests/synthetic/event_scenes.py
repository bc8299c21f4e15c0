"""Hand-made scenarios in which events can be staged; shared by tests."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from drivax.scenario.schema import AgentKind
from drivax.synthetic.events import EventKind
from drivax.synthetic.roads.curves import Pose, straight, turn
from drivax.synthetic.roads.network import Control, Draft, RoadNetwork
from drivax.synthetic.roads.signals import LightGroup, SignalPlan
from drivax.synthetic.traffic.paths import Sway, lane_path
from drivax.synthetic.traffic.roles import Drivers, Motion, Roles, ScriptedUser

from . import staged_scenes

FIRST, STEPS = 60, 151
CURRENT = FIRST + 10


def drivers(count):
    """Identical drivers."""
    values = {f.name: np.full(count, 1.5) for f in dataclasses.fields(Drivers)}
    values["size_m"] = np.tile([4.8, 2.0, 1.6], (count, 1))
    values["kind"] = np.full(count, AgentKind.VEHICLE, np.int8)
    return Drivers(**values)


def scene(network, routes, at, speed, parked=()):
    """Roles and motion of vehicles that follow their routes at constant speed; the first is ego."""
    paths = [lane_path(network, route, Sway()) for route in routes]
    times = np.arange(STEPS) * 0.1
    distance = np.array(at, float)[:, None] + np.array(speed, float)[:, None] * times
    xy, heading = np.zeros((len(at), STEPS, 2)), np.zeros((len(at), STEPS))
    for i, path in enumerate(paths):
        along = np.arange(len(path.curve.xy)) * path.step_m
        for k in (0, 1):
            xy[i, :, k] = np.interp(distance[i], along, path.curve.xy[:, k])
        heading[i] = np.interp(distance[i], along, path.curve.heading)
    table = drivers(len(at))
    users = len(at) + len(parked)
    roles = Roles(network, paths, table, distance[:, 0], np.array(speed, float), routes[0], (), tuple(parked))
    motion = Motion(
        kind=np.full(users, AgentKind.VEHICLE, np.int8),
        size_m=np.concatenate([table.size_m, *(np.array([p.size_m]) for p in parked)]),
        xy=np.concatenate([xy, *(p.xy[None] for p in parked)]),
        heading=np.concatenate([heading, *(p.heading[None] for p in parked)]),
        speed=np.concatenate(
            [np.tile(np.array(speed, float)[:, None], STEPS), np.zeros((len(parked), STEPS))]
        ),
        valid=np.ones((users, STEPS), bool),
        distance_m=distance,
        acceleration=np.zeros_like(distance),
        paths=paths,
    )
    return roles, motion


def road(lanes=2, ends=False, limit=staged_scenes.LIMIT):
    """One-way road along +x, 600 m long: lane 0 at y = 0, others to its left; lane 1 may end at 250 m."""
    network = staged_scenes.road((1,) * lanes, length_m=600.0, limit=limit)
    if not ends:
        return network
    first, second = network.lanes
    second = dataclasses.replace(second, curve=straight(Pose(0.0, second.width_m, 0.0), 250.0), ends=True)
    return dataclasses.replace(network, lanes=(first, second))


def junction(turning):
    """Junction at 160 to 190 m on ego's way east; the conflicting lane comes from the south or turns left."""
    draft = Draft()
    control = Control.NONE if turning else Control.SIGNAL
    arm = draft.lane(straight(Pose(0.0, 0.0, 0.0), 160.0), 3.5, 14.0)
    through = draft.lane(straight(Pose(160.0, 0.0, 0.0), 30.0), 3.5, 14.0, connector=True, control=control)
    out = draft.lane(straight(Pose(190.0, 0.0, 0.0), 300.0), 3.5, 14.0)
    if turning:
        begin = Pose(190.0, 3.5, math.pi)
        other = draft.lane(straight(Pose(390.0, 3.5, math.pi), 200.0), 3.5, 14.0)
        bend = turn(begin, math.pi / 2, 13.0)
    else:
        begin = Pose(175.0, -15.0, math.pi / 2)
        other = draft.lane(straight(Pose(175.0, -215.0, math.pi / 2), 200.0), 3.5, 14.0)
        bend = straight(begin, 30.0)
    cross = draft.lane(bend, 3.5, 14.0, connector=True, control=Control.YIELD if turning else control)
    far = draft.lane(straight(bend.end, 150.0), 3.5, 14.0)
    for a, b in ((arm, through), (through, out), (other, cross), (cross, far)):
        draft.link(a, b)
    lanes = list(draft.lanes)
    if turning:
        lanes[cross] = dataclasses.replace(lanes[cross], yields_to=(through,))
    groups = (LightGroup((through,), False), LightGroup((cross,), False))
    signals = None if turning else SignalPlan(groups, ((0,), (1,)), (60.0, 10.0), offset_s=-20.0)
    return RoadNetwork("test", tuple(lanes), (), signals=signals), (arm, through, out)


def parked_row():
    """Parked cars every 9 m, 2.7 m to the right of ego's path."""
    poses = [Pose(60.0 + 9.0 * k, -2.7, 0.0) for k in range(30)]
    return [ScriptedUser.from_pose(AgentKind.VEHICLE, (4.4, 1.8, 1.5), pose, STEPS) for pose in poses]


def suitable(kind, rng):
    """Roles and motion of a scenario in which a kind of event can be staged."""
    v = float(rng.uniform(9.0, 13.0))
    if kind in (EventKind.LEAD_BRAKES, EventKind.TAILGATER):
        gap = 4.8 + float(rng.uniform(1.0, 1.6)) * v
        return scene(road(), [(0,), (0,), (0,)], [60.0, 60.0 + gap, 60.0 - 25.0], [v] * 3)
    if kind == EventKind.LATE_MERGE:
        return scene(road(ends=True), [(0,)], [240.0 - v * float(rng.uniform(9.0, 10.5))], [v])
    if kind in (EventKind.RED_LIGHT_RUNNER, EventKind.TURN_CONFLICT):
        network, route = junction(kind == EventKind.TURN_CONFLICT)
        return scene(network, [route], [166.0 - v * float(rng.uniform(9.5, 10.5))], [v])
    if kind == EventKind.FROM_BEHIND_PARKED:
        return scene(road(), [(0,)], [60.0], [v], parked_row())
    return scene(road(), [(0,)], [60.0], [v])
