"""Ego's drive planned with knowledge of what everybody will do: the best of a few ways, each at its best speeds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from drivax.geometry.boxes import corners
from drivax.geometry.vectors import wrap
from drivax.scenario.schema import DT_S, AgentKind
from drivax.synthetic.expert.reservations import Meetings, Wall, arrivals, meetings, walls
from drivax.synthetic.expert.smoothing import Bounds, Drive, smoothed
from drivax.synthetic.expert.speed_search import TOUCH, Claims, SpeedPlan, search
from drivax.synthetic.expert.trajectories import SPACING_M, Shift, Way, shifted_way, way_corners
from drivax.synthetic.expert.violations import against_traffic, inside, user_boxes
from drivax.synthetic.roads.curves import Pose
from drivax.synthetic.traffic.lateral import located
from drivax.synthetic.traffic.paths import Path
from drivax.synthetic.traffic.roles import Cast, EgoPlan, Motion

#: A drive keeps to the first of these bounds that it can keep to: acceleration (m/s2) and jerk (m/s3).
_BOUNDS: tuple[tuple[tuple[float, float], float], ...] = (
    ((-3.4, 2.0), 2.6),
    ((-4.0, 2.3), 4.1),
    ((-5.9, 2.3), 25.0),
)
#: A plan along the path that costs less than this needs no other way.
_CHEAP = 12.0
#: What a way beside the path costs: any, per m aside, per second against traffic.
_LEAVING, _ASIDE, _AGAINST = 8.0, 2.0, 6.0
#: How much a light that is about to turn red, or a duty to give way, keeps ego from passing a line.
_LATE = 30.0
#: How much worse it is to be close to somebody on foot or on a bicycle.
_PEOPLE = 12.0
#: Others are expected to go on like this after the last step, so that ego does not end in trouble.
_BEYOND_STEPS = 20
#: Room left between ego and what it passes, m, and the lateral acceleration of the quintic step aside, m/s2: as
#: liked, and when there is neither room nor time.
_ROOM_M, _STEP_MPS2 = (0.8, 0.4), (1.6, 3.8)
#: Distance over which what is left of the difference between ego and its way disappears, m.
_FADE_M = 10.0
#: Furthest that ego goes aside, m.
_FURTHEST_M = 4.5
#: Exceeding a bound by this (m, m/s or m/s2) is rounding.
_TOLERANCE = 0.03


@dataclass(frozen=True)
class _Scene:
    """What does not depend on the way, all from the first step of the plan on.

    Attributes:
        path: Ego's path.
        pose, from_m: Where ego is now, and where on the path that is.
        speed, acceleration: Ego's now; the acceleration is that of the step before.
        size_m: Ego's size.
        others, valid: Boxes of everybody else, and when they exist.
        passed_m: How far along the way ego came at each step in the last run.
        lines: Stop lines ahead.
        people: Rows of ``others`` on foot or on a bicycle.
        minded: Rows of ``others`` who do not react to ego.
    """

    cast: Cast
    path: Path
    pose: Pose
    from_m: float
    speed: float
    acceleration: float
    size_m: Float64[np.ndarray, " 3"]
    others: Float64[np.ndarray, "user time 6"]
    valid: Bool[np.ndarray, "user time"]
    passed_m: Float64[np.ndarray, " time"]
    lines: list[Wall]
    people: Bool[np.ndarray, " user"]
    minded: Bool[np.ndarray, " user"]

    @property
    def reach_m(self) -> float:
        """How far ego can come at most."""
        top = max(self.speed, 1.05 * float(np.max(self.path.limit_mps)))
        return top * DT_S * self.others.shape[1] + 15.0

    def way(self, shift: Shift) -> Way:
        """Ego's way with a shift."""
        return shifted_way(self.path, self.cast.drivers, self.pose, (self.from_m, self.reach_m), shift)


@dataclass(frozen=True)
class _Option:
    """A way, what is taken on it, the best speeds on it, and what all that costs."""

    way: Way
    claims: Claims
    speeds: SpeedPlan
    cost: float


def plan_ego(
    cast: Cast,
    motion: Motion,
    times_s: Float64[np.ndarray, " time"],
    first_step: int,
    minded: frozenset[int] = frozenset(),
) -> EgoPlan:
    """Plans ego's drive.

    Args:
        cast: Everybody.
        motion: What they did in the last run; row 0 is ego's drive then.
        times_s: Times of the motion's steps, on the clock of the lights.
        first_step: Step from which ego drives as planned.
        minded: Users who must not be expected to react: those that ran into ego in an earlier run.
    """
    scene = _scene(cast, motion, times_s, first_step, minded)
    way, drive = _driven(scene)
    steps = motion.xy.shape[1] - first_step
    xy, heading = way.pose(drive.at_m[:steps])
    # The way begins within millimetres of the present pose; the rest fades over the first metres.
    fade = np.clip(1.0 - drive.at_m[:steps] / _FADE_M, 0.0, 1.0)
    xy += fade[:, None] * (motion.xy[0, first_step] - xy[0])
    heading += fade * wrap(scene.pose.heading - heading[0])
    heading = heading[0] + np.concatenate([[0.0], np.cumsum(wrap(np.diff(heading)))])
    return EgoPlan(first_step, xy, heading, drive.speed[:steps])


def _scene(
    cast: Cast,
    motion: Motion,
    times_s: Float64[np.ndarray, " time"],
    first_step: int,
    minded: frozenset[int],
) -> _Scene:
    x, y = motion.xy[0, first_step]
    pose = Pose(float(x), float(y), float(motion.heading[0, first_step]))
    paths = motion.paths or cast.paths
    from_m = located(paths[0], motion.xy[0, first_step], float(motion.distance_m[0, first_step]))[0]
    boxes, valid = _continued(motion, first_step)
    deaf = np.arange(1, len(motion.kind)) >= motion.vehicles
    deaf |= np.isin(np.arange(1, len(motion.kind)), sorted(minded))
    scene = _Scene(
        cast=cast,
        path=paths[0],
        pose=pose,
        from_m=from_m,
        speed=max(0.0, float(motion.speed[0, first_step])),
        acceleration=float(motion.acceleration[0, max(0, first_step - 1)]),
        size_m=motion.size_m[0],
        others=boxes,
        valid=valid,
        passed_m=np.zeros(boxes.shape[1]),
        lines=[],
        people=np.isin(motion.kind[1:], (AgentKind.PEDESTRIAN, AgentKind.CYCLIST)),
        minded=deaf,
    )
    way = scene.way(Shift())
    gap = way.xy[:, None] - motion.xy[0, first_step:]
    passed_m = way.base_m[np.argmin(np.sum(gap**2, axis=-1), axis=0)]
    passed_m = np.append(passed_m, np.full(_BEYOND_STEPS, passed_m[-1]))
    return replace(
        scene, passed_m=passed_m, lines=_lines(cast, motion, times_s[first_step:], scene, passed_m)
    )


def _continued(
    motion: Motion, first_step: int
) -> tuple[Float64[np.ndarray, "user time 6"], Bool[np.ndarray, "user time"]]:
    """Boxes of the others from a step on, and a while longer at constant velocity."""
    box, valid = user_boxes(motion)[1:, first_step:], motion.valid[1:, first_step:]
    longer = np.repeat(box[:, -1:], _BEYOND_STEPS, axis=1)
    travelled = motion.speed[1:, -1:] * DT_S * np.arange(1, _BEYOND_STEPS + 1)
    longer[..., :2] += travelled[..., None] * longer[..., 2:4]
    more = np.repeat(valid[:, -1:], _BEYOND_STEPS, axis=1)
    return np.concatenate([box, longer], axis=1), np.concatenate([valid, more], axis=1)


def _lines(
    cast: Cast,
    motion: Motion,
    times_s: Float64[np.ndarray, " time"],
    scene: _Scene,
    passed_m: Float64[np.ndarray, " longer"],
) -> list[Wall]:
    """Stop lines ahead, as they are during the plan and after it."""
    steps, half = len(times_s), motion.size_m[: motion.vehicles, 0] / 2
    paths = motion.paths or cast.paths
    distance, valid = motion.distance_m[:, -steps:], motion.valid[: motion.vehicles, -steps:]
    first = {
        lane: np.append(taken, np.repeat(taken[-1:], _BEYOND_STEPS))
        for lane, taken in arrivals(cast.network, paths, distance, valid, half).items()
    }
    longer = np.append(times_s, times_s[-1] + DT_S * np.arange(1, _BEYOND_STEPS + 1))
    ego = (scene.from_m, float(half[0]))
    return walls(cast.network, scene.path, ego, longer, scene.from_m + passed_m, first)


def _driven(scene: _Scene) -> tuple[Way, Drive]:
    """The cheapest way that can be driven smoothly without touching anything, or what comes nearest to it."""
    way = scene.way(Shift())
    met = _meetings(scene, way)
    options = [_option(scene, way, met)]
    drives: list[tuple[float, Way, Drive]] = []
    if options[0].cost < _CHEAP:
        drive = _smooth(scene, options[0])
        if drive.excess <= _TOLERANCE:
            return way, drive
    options += _beside(scene, way, met)
    for option in sorted(options, key=lambda option: option.cost):
        drive = _smooth(scene, option)
        if drive.excess <= _TOLERANCE and not option.speeds.touches:
            return option.way, drive
        drives.append((drive.excess + 100.0 * option.speeds.touches, option.way, drive))
    _, way, drive = min(drives, key=lambda one: one[0])
    return way, drive


def _meetings(scene: _Scene, way: Way) -> Meetings:
    """Whom ego could meet on a way, without those who follow it and will react."""
    met = meetings(way, scene.size_m, scene.others, scene.valid, scene.people)
    follows = np.zeros(len(scene.others), bool)
    order = np.lexsort((-met.point, met.step, met.user))
    users, first = np.unique(met.user[order], return_index=True)
    step, point = met.step[order][first], met.point[order][first]
    box = scene.others[users, step]
    along = box[:, 2] * np.cos(way.heading[point]) + box[:, 3] * np.sin(way.heading[point])
    behind = way.base_m[point] < scene.passed_m[step]
    follows[users] = behind & (along > 0.7) & ~scene.minded[users]
    return met.only(~follows[met.user])


def _option(scene: _Scene, way: Way, met: Meetings) -> _Option:
    claims = _claims(scene, way, met)
    speeds = search(claims, way.fastest_mps, way.bound_mps, scene.speed)
    cost = speeds.cost
    if way.shift.aside_m:
        wrong = against_traffic(scene.cast.network, way.xy[::4], way.heading[::4]).sum() * 4 * SPACING_M
        cost += _LEAVING + _ASIDE * abs(way.shift.aside_m) + _AGAINST * float(wrong) / max(scene.speed, 4.0)
    return _Option(way, claims, speeds, cost)


def _claims(scene: _Scene, way: Way, met: Meetings) -> Claims:
    """What is taken on a way by others, by lines that must not be passed, and by the end of the map."""
    shape = (scene.others.shape[1], len(way.xy))
    hard, near = np.zeros(shape, bool), np.zeros(shape)
    np.maximum.at(near, (met.step, met.point), np.where(scene.people[met.user], _PEOPLE, 1.0))
    hard[met.step[met.hard], met.point[met.hard]] = True
    thick = int(np.ceil((0.1 * (float(way.fastest_mps.max()) + scene.speed) + 0.5) / SPACING_M))
    for line in scene.lines:
        if line.base_m < way.base_m[-1]:
            place = int(np.searchsorted(way.base_m, line.base_m))
            hard[line.closed, place : place + thick] = True
            near[line.late, place : place + thick] = _LATE
    room = scene.path.length_m - scene.from_m - scene.size_m[0] / 2 - 0.5
    hard[:, way.base_m > room] = True
    return Claims(SPACING_M, hard, near)


def _smooth(scene: _Scene, option: _Option) -> Drive:
    """The option's drive, gentle if that is possible."""
    at, speed = option.speeds.fine(scene.others.shape[1])
    speed[0] = scene.speed
    hard = option.claims.hard[1:]
    place = np.arange(hard.shape[1])
    own = np.clip(np.rint(at[1:] / SPACING_M).astype(int), 0, len(place) - 1)
    below = np.where(hard & (place < own[:, None]), place, -1).max(axis=1)
    above = np.where(hard & (place > own[:, None]), place, len(place)).min(axis=1)
    # Where even the best speeds touch something there is nothing to keep to.
    lost = hard[np.arange(len(hard)), own]
    low = np.where((below >= 0) & ~lost, (below + 1) * SPACING_M, -np.inf)
    high = np.where(lost, np.inf, (above - 1) * SPACING_M)
    around = np.clip(own[:, None] + np.arange(-4, 5), 0, len(place) - 1)
    top = np.maximum(option.way.bound_mps[around].min(axis=1), speed[1:])
    drive = None
    for acceleration, jerk in _BOUNDS:
        bounds = Bounds(low, np.maximum(high, low), top, acceleration, jerk)
        drive = smoothed(at, speed, scene.acceleration, bounds)
        if drive.excess <= _TOLERANCE:
            break
    assert drive is not None
    return drive


def _beside(scene: _Scene, way: Way, met: Meetings) -> list[_Option]:
    """Ways that pass what is in the way of a drive at liked speed; none when nothing is."""
    hit = _first_hit(scene, way, met)
    if hit is None:
        return []
    rings = tuple(edge.xy for edge in scene.cast.network.edges)
    result = []
    for side in (1.0, -1.0):
        for room, step_mps2 in zip(_ROOM_M, _STEP_MPS2, strict=True):
            shift = _shift(scene, way, met, hit, side, room, step_mps2)
            if shift is None:
                continue
            beside = scene.way(shift)
            if not bool(inside(way_corners(beside, scene.size_m + 0.2), rings).all()):
                continue
            option = _option(scene, beside, _meetings(scene, beside))
            result.append(option)
            if option.cost < TOUCH:
                break
    return result


def _first_hit(scene: _Scene, way: Way, met: Meetings) -> tuple[int, int, int] | None:
    """User, step and sample of the way of the first touch of a drive that heeds nobody."""
    at, speed, places = 0.0, scene.speed, []
    for _ in range(scene.others.shape[1]):
        places.append(at)
        index = min(int(at / SPACING_M), len(way.xy) - 1)
        speed = min(speed + 1.5 * DT_S, max(float(way.fastest_mps[index]), speed - 2.0 * DT_S))
        at += speed * DT_S
    touch = met.hard & (np.abs(met.point * SPACING_M - np.array(places)[met.step]) < 0.3 + 0.05 * scene.speed)
    if not touch.any():
        return None
    first = int(np.flatnonzero(touch)[np.argmin(met.step[touch])])
    return int(met.user[first]), int(met.step[first]), int(met.point[first])


def _shift(
    scene: _Scene,
    way: Way,
    met: Meetings,
    hit: tuple[int, int, int],
    side: float,
    room_m: float,
    step_mps2: float,
) -> Shift | None:
    """How to pass a user on one side, and whoever stands close behind it."""
    begin, end, edge = _extent(scene, way, hit, side)
    half_l, half_w = scene.size_m[0] / 2 + 1.0, scene.size_m[1] / 2
    seen = {hit[0]}
    standing = [int(u) for u in np.unique(met.user[met.hard]) if _stands(scene, int(u))]
    for user in sorted(standing, key=lambda u: int(met.point[met.user == u].min())):
        mine = met.hard & (met.user == user)
        place = int(met.point[mine].min())
        if user not in seen and begin < place * SPACING_M < end + 20.0:
            more = _extent(scene, way, (user, int(met.step[mine].min()), place), side)
            end, edge = max(end, more[1]), max(edge, more[2])
            seen.add(user)
    aside = edge + half_w + room_m
    if not 0.15 < aside < _FURTHEST_M:
        return None
    speed = max(scene.speed, float(way.fastest_mps[hit[2]]) * 0.7)
    length = max(speed * float(np.sqrt(5.77 * aside / step_mps2)), 3.0 * aside, 8.0)
    gentle = max(length, speed * float(np.sqrt(5.77 * aside / _STEP_MPS2[0])))
    out = max(0.0, begin - half_l - length)
    there = out + length
    back = max(end + half_l, there)
    return Shift(side * aside, out, there, back, back + gentle)


def _stands(scene: _Scene, user: int) -> bool:
    """Whether a user hardly moves while it is there."""
    xy = scene.others[user, scene.valid[user], :2]
    return bool(np.ptp(xy, axis=0).max() < 0.5)


def _extent(scene: _Scene, way: Way, hit: tuple[int, int, int], side: float) -> tuple[float, float, float]:
    """From where to where along the way a user is when it is met, and how far it reaches to one side of the path."""
    user, step, point = hit
    box = scene.others[user, step]
    c, s = float(np.cos(way.heading[point])), float(np.sin(way.heading[point]))
    offset = corners(box) - way.xy[point]
    along, left = offset @ np.array([c, s]), offset @ np.array([-s, c])
    # Who goes along with ego, or against it, is passed over a longer stretch.
    later = min(step + 10, len(scene.others[user]) - 1)
    moved = (scene.others[user, later, :2] - box[:2]) @ np.array([c, s]) / max((later - step) * DT_S, DT_S)
    at = point * SPACING_M
    ahead, behind = max(3.0 * moved, 0.7 * -moved, 0.0), max(0.7 * abs(moved), 0.0)
    return at + float(along.min()) - behind, at + float(along.max()) + ahead, float((side * left).max())
