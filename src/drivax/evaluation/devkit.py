"""nuPlan's closed-loop score as its devkit computes it, from stored motions, in float64.

The functions reproduce metrics of nuplan-devkit 1.2 (``planning/metrics/evaluation_metrics``), including their
quirks: the first sample counts, agents that overlap ego from the start count as collisions, and comfort has no logged
past. ``nuplan_score`` is our own definition of the same score (docs/guide/metrics.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
import shapely
from jaxtyping import Bool, Float64, Int

from drivax.geometry.boxes import corners
from drivax.metrics.catalogue import NUPLAN_WEIGHTS
from drivax.metrics.comfort import (
    JERK,
    JERK_MAGNITUDE_MPS3,
    JERK_MPS3,
    LATERAL_MPS2,
    LONGITUDINAL_MPS2,
    SMOOTH,
    YAW_ACCELERATION,
    YAW_ACCELERATION_RPS2,
    YAW_RATE,
    YAW_RATE_RPS,
    savgol_matrix,
)
from drivax.scenario.schema import DT_S, AgentKind

#: Distance from rear axle to centre of nuPlan's car (Chrysler Pacifica), m.
REAR_AXLE_M = 1.461
#: Corners of ``geometry.boxes`` in the devkit's order: front left, rear left, rear right, front right.
_DEVKIT_ORDER = (0, 3, 2, 1)
#: Thresholds and horizons of the devkit's metrics.
_STOPPED_MPS, _TTC_STOPPED_MPS = 0.05, 0.005
_AHEAD_DEG, _BEHIND_DEG = 30.0, 150.0
_TTC_STEP_S, _TTC_HORIZON_S, _MIN_TTC_S = 0.1, 3.0, 0.95
_OUTSIDE_M, _OVERSPEED_MPS, _MIN_PROGRESS_M, _MIN_PROGRESS_RATIO = 0.3, 2.23, 2.0, 0.2
_WRONG_WAY_M, _FAR_WRONG_WAY_M, _DIRECTION_S = 2.0, 6.0, 1.0
#: Largest distance at which ego is still assigned to the connector that it has left, m.
_MAX_EXIT_M = 5.0
_EGO_STOPPED, _TRACK_STOPPED, _FRONT, _REAR, _LATERAL = range(5)


@dataclass(frozen=True)
class EgoMotion:
    """Motion of ego's box, one row per sample.

    Attributes:
        xy: Centre, m.
        heading: Heading, rad.
        speed: Speed, m/s, at least 0.
        acceleration: Acceleration of the rear axle along the heading, m/s2.
        yaw_rate: Yaw rate, rad/s.
        yaw_acceleration: Yaw acceleration, rad/s2.
        size_m: Length and width, m.
        rear_axle_m: Distance of the rear axle behind the centre, m.
        dt_s: Time between samples, s.
    """

    xy: Float64[np.ndarray, "t 2"]
    heading: Float64[np.ndarray, " t"]
    speed: Float64[np.ndarray, " t"]
    acceleration: Float64[np.ndarray, " t"]
    yaw_rate: Float64[np.ndarray, " t"]
    yaw_acceleration: Float64[np.ndarray, " t"]
    size_m: tuple[float, float]
    rear_axle_m: float = REAR_AXLE_M
    dt_s: float = DT_S

    @cached_property
    def boxes(self) -> Float64[np.ndarray, "t 6"]:
        """The box in the format of ``geometry.boxes``."""
        return _boxes(self.xy, self.heading, np.array(self.size_m))

    @cached_property
    def corners(self) -> Float64[np.ndarray, "t 4 2"]:
        """Corners of the box."""
        return corners(self.boxes)

    @cached_property
    def rear_axle(self) -> Float64[np.ndarray, "t 2"]:
        """Centre of the rear axle."""
        return self.xy - self.rear_axle_m * _directions(self.heading)


@dataclass(frozen=True)
class Tracks:
    """Motion of the other agents.

    Attributes:
        xy: Centres, m.
        heading: Headings, rad.
        speed: Speeds, m/s; 0 for static objects.
        present: Whether an agent is in a sample.
        size_m: Length and width of each agent, m.
        kind: :class:`~drivax.scenario.schema.AgentKind` of each agent.
    """

    xy: Float64[np.ndarray, "t a 2"]
    heading: Float64[np.ndarray, "t a"]
    speed: Float64[np.ndarray, "t a"]
    present: Bool[np.ndarray, "t a"]
    size_m: Float64[np.ndarray, "a 2"]
    kind: Int[np.ndarray, " a"]

    @cached_property
    def corners(self) -> Float64[np.ndarray, "t a 4 2"]:
        """Corners of the boxes."""
        return corners(_boxes(self.xy, self.heading, self.size_m))


@dataclass(frozen=True)
class RoadObject:
    """A lane or a lane connector.

    Attributes:
        polygon: Area (shapely polygon).
        line: Centre line (shapely line string).
        block: Roadblock.
        limit_mps: Speed limit, m/s; None if unknown.
        connector: Whether the object is a connector.
        successors: Indices of the successors.
        predecessors: Indices of the predecessors.
    """

    polygon: Any
    line: Any
    block: int
    limit_mps: float | None = None
    connector: bool = False
    successors: tuple[int, ...] = ()
    predecessors: tuple[int, ...] = ()


Points = Float64[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Road:
    """The map.

    Attributes:
        objects: Lanes and connectors.
        outside_m: Function that returns how far ego's corners are outside the drivable area, m (at most 0 inside).
        intersection: Function that returns whether points are in an intersection.
    """

    objects: Sequence[RoadObject]
    outside_m: Callable[[EgoMotion], Float64[np.ndarray, "t 4"]]
    intersection: Callable[[Points], Bool[np.ndarray, " n"]] = lambda points: np.zeros(len(points), bool)

    def contains(self, points: Points) -> Bool[np.ndarray, "n o"]:
        """Return a mask of the objects that contain each point."""
        inside = [shapely.contains_xy(lane.polygon, points[:, 0], points[:, 1]) for lane in self.objects]
        return np.stack(inside, axis=1) if inside else np.zeros((len(points), 0), bool)

    @cached_property
    def blocks(self) -> Mapping[int, Any]:
        """Area of each roadblock."""
        polygons: dict[int, list[Any]] = {}
        for lane in self.objects:
            polygons.setdefault(lane.block, []).append(lane.polygon)
        return {block: shapely.unary_union(areas) for block, areas in polygons.items()}


@dataclass(frozen=True)
class Collision:
    """First contact with an agent.

    Attributes:
        sample: Sample of the contact.
        agent: Index of the agent in :class:`Tracks`.
        type: 0 ego stopped, 1 agent stopped, 2 front, 3 rear, 4 lateral.
        at_fault: Whether ego is at fault.
    """

    sample: int
    agent: int
    type: int
    at_fault: bool


@dataclass(frozen=True)
class Comfort:
    """Six filtered series of an episode by name: ``lon``, ``lat``, ``lonjerk``, ``jerk``, ``yaw``, ``yawacc``.

    Attributes:
        series: Values of each sample.
        within: Whether all samples of a series are within its limits.
    """

    series: Mapping[str, Float64[np.ndarray, " t"]]
    within: Mapping[str, bool]


@dataclass(frozen=True)
class DevkitVerdict:
    """Terms of the devkit's score.

    Attributes:
        score: The closed-loop score.
        fault_score: 1 without at-fault collisions, 0.5 after a single one with a static object, else 0.
        drivable: 1 if no corner is 0.3 m or more outside the drivable area and ego's lanes.
        direction: 1, 0.5 or 0: less than 2 m, less than 6 m, or more against traffic within a second.
        making_progress: 1 if the progress ratio is at least 0.2.
        ttc_ok: 1 if the time to collision is always at least 0.95 s.
        progress: Progress ratio along the expert's route; 1 without a route.
        speed: Speed-limit compliance.
        comfortable: 1 if all six comfort series are within their limits.
        collisions: First contacts.
        ttc_s: Time to collision of each sample, 0 to 2.9 s; inf if there is none.
        in_lane: Whether all corners are in one lane or in connected lanes, per sample.
        backward_m: Minus the largest distance against traffic within a second, m.
        progress_m: Progress of the expert and of ego, m; 0 without a route.
        comfort: Comfort series.
    """

    score: float
    fault_score: float
    drivable: float
    direction: float
    making_progress: float
    ttc_ok: float
    progress: float
    speed: float
    comfortable: float
    collisions: tuple[Collision, ...] = field(repr=False)
    ttc_s: Float64[np.ndarray, " t"] = field(repr=False)
    in_lane: Bool[np.ndarray, " t"] = field(repr=False)
    backward_m: float
    progress_m: tuple[float, float]
    comfort: Comfort = field(repr=False)


def devkit_verdict(ego: EgoMotion, tracks: Tracks, road: Road, expert_xy: Points) -> DevkitVerdict:
    """Evaluate an episode.

    Args:
        ego: Motion of ego.
        tracks: Motion of the other agents in the same samples.
        road: The map.
        expert_xy: Centres of the logged ego.
    """
    in_lane = _in_one_lane(ego, road)
    collisions = _collisions(ego, tracks, in_lane)
    ttc_s = _time_to_collision(ego, tracks, road, in_lane, collisions)
    ego_route = _route(road, ego.xy)
    backward_m = _wrong_way_distance(road, ego_route, ego)
    progress_m = _progress(road, expert_xy, ego.xy)
    comfort = comfort_series(ego)
    terms = {
        "fault_score": _fault_score(collisions, tracks),
        "drivable": float(_stays_on_road(ego, road, ego_route)),
        "direction": _direction_score(-backward_m),
        "ttc_ok": float(ttc_s.min() >= _MIN_TTC_S),
        "progress": 1.0 if progress_m is None else _progress_ratio(*progress_m),
        "speed": _speed_compliance(road, ego_route, ego.speed),
        "comfortable": float(all(comfort.within.values())),
    }
    terms["making_progress"] = float(terms["progress"] >= _MIN_PROGRESS_RATIO)
    term_names = {"progress_ratio": "progress", "speed_compliance": "speed"}
    weighted_sum = sum(weight * terms[term_names.get(name, name)] for name, weight in NUPLAN_WEIGHTS.items())
    mean = weighted_sum / sum(NUPLAN_WEIGHTS.values())
    gates = ("fault_score", "drivable", "direction", "making_progress")
    return DevkitVerdict(
        score=mean * float(np.prod([terms[name] for name in gates])),
        collisions=collisions, ttc_s=ttc_s, in_lane=in_lane, backward_m=backward_m,
        progress_m=progress_m or (0.0, 0.0), comfort=comfort, **terms,
    )  # fmt: skip


def comfort_series(ego: EgoMotion) -> Comfort:
    """Return the six comfort series (``ego_is_comfortable``).

    As in the devkit, values are rounded to 8 decimals, and the acceleration of the centre adds both terms of the yawing
    frame to the longitudinal component, so that the lateral one is always 0. Jerk magnitude is that of the rear axle.
    The filter windows of yaw rate and yaw acceleration have 5 samples.
    """
    samples = len(ego.heading)

    def apply_filter(values: Float64[np.ndarray, " t"], window: tuple[int, int, int]) -> Any:
        width, order, derivative = window
        matrix = savgol_matrix(samples, min(width, samples), order, derivative)
        return np.round(matrix @ values / ego.dt_s**derivative, 8)

    longitudinal = ego.acceleration + ego.rear_axle_m * (ego.yaw_rate**2 + ego.yaw_acceleration)
    heading, acceleration = np.unwrap(ego.heading), apply_filter(longitudinal, SMOOTH)
    series = {
        "lon": acceleration,
        "lat": np.zeros(samples),
        "lonjerk": apply_filter(acceleration, JERK),
        "jerk": apply_filter(apply_filter(np.abs(ego.acceleration), SMOOTH), JERK),
        "yaw": apply_filter(heading, YAW_RATE),
        "yawacc": apply_filter(heading, YAW_ACCELERATION),
    }
    limits = (LATERAL_MPS2, JERK_MPS3, JERK_MAGNITUDE_MPS3, YAW_RATE_RPS, YAW_ACCELERATION_RPS2)
    bounds = (LONGITUDINAL_MPS2, *((-limit, limit) for limit in limits))
    within = {
        name: bool((low < values).all() and (values < high).all())
        for (name, values), (low, high) in zip(series.items(), bounds, strict=True)
    }
    return Comfort(series, within)


def _direction_score(backward_m: float) -> float:
    if backward_m < _WRONG_WAY_M:
        return 1.0
    return 0.5 if backward_m < _FAR_WRONG_WAY_M else 0.0


def _directions(heading: Any) -> Float64[np.ndarray, "*n 2"]:
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def _boxes(
    xy: Float64[np.ndarray, "*n 2"], heading: Float64[np.ndarray, "*n"], size: Float64[np.ndarray, "*a 2"]
) -> Float64[np.ndarray, "*n 6"]:
    return np.concatenate([xy, _directions(heading), np.broadcast_to(size, xy.shape)], axis=-1)


def _angle_deg(
    origin: Float64[np.ndarray, " 2"], heading: float, xy: Float64[np.ndarray, "a 2"]
) -> Float64[np.ndarray, " a"]:
    """Return the angle (degrees) between a heading and the direction from ``origin`` to each point."""
    offset = xy - origin
    distance = np.maximum(np.hypot(*offset.T), 1e-12)
    return np.degrees(np.arccos(np.clip(offset @ _directions(heading) / distance, -1.0, 1.0)))


def _in_one_lane(ego: EgoMotion, road: Road) -> Bool[np.ndarray, " t"]:
    """Return whether all corners are in one lane, or in lanes that follow each other (``ego_lane_change``)."""
    inside = road.contains(ego.corners[:, _DEVKIT_ORDER].reshape(-1, 2)).reshape(len(ego.xy), 4, -1)
    result, candidates = np.zeros(len(ego.xy), bool), set[int]()
    for sample, inside_by_corner in enumerate(inside):
        lanes_by_corner: list[set[int]] = []
        for corner_inside in inside_by_corner:
            continuing = _candidates(road, corner_inside, candidates)
            lanes_by_corner.append(continuing or _current_objects(road, corner_inside))
            # As in the devkit: only in the second sample a corner's lanes become candidates of the next corners.
            if sample == 1 and not continuing:
                candidates |= lanes_by_corner[-1]
        result[sample] = all(lanes_by_corner) and _common_or_connected(road, lanes_by_corner)
        candidates = set().union(*lanes_by_corner)
    return result


def _current_objects(road: Road, inside: Bool[np.ndarray, " o"]) -> set[int]:
    """Return the first lane that contains a point, or else the connectors (``get_current_route_objects``)."""
    containing = np.flatnonzero(inside).tolist()
    lanes = [index for index in containing if not road.objects[index].connector]
    return set(lanes[:1] or containing)


def _candidates(road: Road, inside: Bool[np.ndarray, " o"], candidates: set[int]) -> set[int]:
    """Return the candidates that contain a point; if a single candidate does not, its successors that do."""
    matching = {index for index in candidates if inside[index]}
    if not matching and len(candidates) == 1:
        (candidate,) = candidates
        matching = {index for index in road.objects[candidate].successors if inside[index]}
    return matching


def _common_or_connected(road: Road, lanes_by_corner: Sequence[set[int]]) -> bool:
    """Return whether all corners share a lane, or lanes of the rear corners continue into those of the front ones."""
    if set.intersection(*lanes_by_corner):
        return True
    front_left, rear_left, rear_right, front_right = lanes_by_corner
    before_left, before_right = (_extend(road, lanes, "predecessors") for lanes in (front_left, front_right))
    after_left, after_right = (_extend(road, lanes, "successors") for lanes in (rear_left, rear_right))
    rears = rear_left & after_right or rear_right & after_left
    return bool(rears and before_left & after_right & before_right & after_left)


def _extend(road: Road, lanes: set[int], links: Literal["successors", "predecessors"]) -> set[int]:
    """Return lanes and their successors or predecessors."""
    return lanes.union(*(getattr(road.objects[index], links) for index in lanes))


def _collisions(ego: EgoMotion, tracks: Tracks, in_lane: Bool[np.ndarray, " t"]) -> tuple[Collision, ...]:
    """Return the first contact with each agent, and its type (``no_ego_at_fault_collisions``)."""
    ego_boxes: Any = shapely.polygons(ego.corners)
    boxes: Any = shapely.polygons(tracks.corners)
    touches = shapely.intersects(ego_boxes[:, None], boxes) & tracks.present
    fronts: Any = shapely.linestrings(ego.corners[:, :2])
    collisions = []
    for agent in np.flatnonzero(touches.any(axis=0)).tolist():
        sample = int(touches[:, agent].argmax())
        angle = _angle_deg(ego.rear_axle[sample], ego.heading[sample], tracks.xy[sample, agent][None])[0]
        if ego.speed[sample] <= _STOPPED_MPS:
            kind = _EGO_STOPPED
        elif tracks.speed[sample, agent] <= _STOPPED_MPS:
            kind = _TRACK_STOPPED
        elif angle > _BEHIND_DEG:
            kind = _REAR
        elif shapely.intersects(fronts[sample], boxes[sample, agent]):
            kind = _FRONT
        else:
            kind = _LATERAL
        at_fault = kind in (_TRACK_STOPPED, _FRONT) or (kind == _LATERAL and not in_lane[sample])
        collisions.append(Collision(sample, agent, kind, at_fault))
    return tuple(sorted(collisions, key=lambda collision: collision.sample))


def _fault_score(collisions: Sequence[Collision], tracks: Tracks) -> float:
    """Return 1 - n/2, at least 0, for n at-fault collisions; 0 if one of them is with a road user."""
    at_fault = [tracks.kind[collision.agent] for collision in collisions if collision.at_fault]
    if not all(kind in (AgentKind.STATIC, AgentKind.OTHER) for kind in at_fault):
        return 0.0
    return max(0.0, 1.0 - len(at_fault) / 2)


def _time_to_collision(
    ego: EgoMotion, tracks: Tracks, road: Road, in_lane: Bool[np.ndarray, " t"],
    collisions: Sequence[Collision],
) -> Float64[np.ndarray, " t"]:  # fmt: skip
    """Return the time to collision (s) of every sample at constant velocities (``time_to_collision_within_bound``)."""
    times = np.full(len(ego.xy), np.inf)
    fault_samples = {collision.sample for collision in collisions if collision.at_fault}
    first_contact = np.full(len(tracks.kind), len(ego.xy))
    for collision in collisions:
        first_contact[collision.agent] = collision.sample
    includes_sides = ~in_lane | road.intersection(ego.rear_axle)
    ahead_s = np.arange(_TTC_STEP_S, _TTC_HORIZON_S, _TTC_STEP_S)
    for sample in range(len(ego.xy)):
        if sample in fault_samples:
            times[sample] = 0.0
            continue
        angle = _angle_deg(ego.rear_axle[sample], ego.heading[sample], tracks.xy[sample])
        relevant = (angle < _AHEAD_DEG) | (includes_sides[sample] & (angle <= _BEHIND_DEG))
        agents = np.flatnonzero(relevant & tracks.present[sample] & (first_contact > sample))
        if not len(agents) or ego.speed[sample] <= _TTC_STOPPED_MPS:
            continue
        ego_boxes = _sweep(ego.corners[sample], ego.heading[sample], ego.speed[sample], ahead_s)
        motion = (values[sample, agents] for values in (tracks.corners, tracks.heading, tracks.speed))
        overlaps = shapely.intersects(ego_boxes, _sweep(*motion, ahead_s)).any(axis=0)
        if overlaps.any():
            times[sample] = ahead_s[overlaps.argmax()]
    return times


def _sweep(
    boxes: Float64[np.ndarray, "*a 4 2"], heading: Any, speed: Any, times: Float64[np.ndarray, " k"]
) -> Any:
    """Return the boxes at every time (s), moved along their headings at constant speed."""
    direction = _directions(heading) * np.asarray(speed)[..., None]
    return shapely.polygons(boxes[..., None, :, :] + times[:, None, None] * direction[..., None, None, :])


def _stays_on_road(ego: EgoMotion, road: Road, route: Sequence[Sequence[int]]) -> bool:
    """Return whether all corners are less than 0.3 m outside the drivable area (``drivable_area_compliance``).

    A corner in a lane, or within 0.3 m of a lane of ego's centre, counts as inside.
    """
    for sample, corner in np.argwhere(road.outside_m(ego) >= _OUTSIDE_M):
        if road.contains(ego.corners[sample, corner][None]).any():
            continue
        point = shapely.points(ego.corners[sample, corner])
        lanes = [road.objects[index].polygon for index in route[sample]]
        if not any(shapely.distance(lane, point) < _OUTSIDE_M for lane in lanes):
            return False
    return True


def _route(road: Road, points: Points) -> list[list[int]]:
    """Return the lane or the connectors of each point, given the previous points (``get_route``)."""
    containing, in_intersection = road.contains(points), road.intersection(points)
    route: list[list[int]] = []
    current: list[int] = []
    for sample, inside in enumerate(containing):
        current = sorted(_candidates(road, inside, set(current))) if current else []
        if not current:
            current = sorted(_current_objects(road, inside))
            on_connector = bool(current) and road.objects[current[0]].connector
            may_stay = on_connector or (not current and in_intersection[sample])
            # As in the devkit: the second sample cannot stay on the connector of the first.
            last = route[-1] if sample > 1 else []
            if last and road.objects[last[0]].connector and may_stay:
                point = shapely.points(points[sample])
                distances = [shapely.distance(road.objects[index].polygon, point) for index in last]
                nearby = [i for i, distance in zip(last, distances, strict=True) if distance < _MAX_EXIT_M]
                current = nearby or current
        route.append(current)
    return _drop_extra_connectors(road, route)


def _drop_extra_connectors(road: Road, route: list[list[int]]) -> list[list[int]]:
    """Keep only those of overlapping connectors on which the route continues."""
    result = list(route)
    for sample in range(len(result) - 2, -1, -1):
        objects, next_objects = result[sample], result[sample + 1]
        if len(objects) <= 1:
            continue
        if len(objects) > len(next_objects) and set(next_objects) <= set(objects):
            result[sample] = next_objects
        if next_objects and not road.objects[next_objects[0]].connector:
            connecting = [index for index in objects if index in road.objects[next_objects[0]].predecessors]
            result[sample] = connecting or result[sample]
    return result


def _wrong_way_distance(road: Road, route: Sequence[Sequence[int]], ego: EgoMotion) -> float:
    """Return minus the largest distance (m) against traffic in a second (``driving_direction_compliance``)."""
    progress = np.zeros(len(ego.xy))
    last_object, last_position = (route[0][0] if route[0] else None), None
    for sample, objects in enumerate(route):
        if not objects:
            continue
        if objects[0] == last_object:
            position = _locate(road.objects[objects[0]].line, ego.xy[sample])
            # As in the devkit: a position at the very start of a line counts as no progress.
            progress[sample] = position - last_position if last_position is not None and position else 0.0
            last_position = position
        else:
            last_object, last_position = objects[0], None
    # As in the devkit: a window has one difference more than a second contains.
    samples = round(_DIRECTION_S / ego.dt_s)
    sums = [progress[max(0, end - samples) : end + 1].sum() for end in range(len(progress))]
    return -abs(float(min(sums)))


def _locate(line: Any, point: Float64[np.ndarray, " 2"]) -> float:
    return float(shapely.line_locate_point(line, shapely.points(point)))


def _progress(road: Road, expert_xy: Points, ego_xy: Points) -> tuple[float, float] | None:
    """Return the progress (m) of expert and ego along the expert's roadblocks; None if the expert has no route."""
    blocks: list[tuple[int, Any]] = []
    for objects in _route(road, expert_xy):
        if objects and (not blocks or road.objects[objects[0]].block != blocks[-1][0]):
            blocks.append((road.objects[objects[0]].block, road.objects[objects[0]].line))
    if not blocks:
        return None
    return _block_progress(road, blocks, expert_xy), _block_progress(road, blocks, ego_xy)


def _block_progress(road: Road, blocks: Sequence[tuple[int, Any]], points: Points) -> float:
    """Return the progress along a chain of roadblocks and their centre lines (``ego_progress_along_expert_route``)."""
    current, total = 0, 0.0
    last_m = _locate(blocks[0][1], points[0])
    for x, y in points[1:]:
        candidate, skipped_m = current, 0.0
        while candidate < len(blocks) and not shapely.contains_xy(road.blocks[blocks[candidate][0]], x, y):
            candidate += 1
            if current + 1 < candidate < len(blocks):
                (_, previous), (_, line), (_, following) = blocks[candidate - 2 : candidate + 1]
                skipped_m += _locate(line, _end(following, 0)) - _locate(line, _end(previous, -1))
        if candidate == len(blocks):
            continue
        line, last_line = blocks[candidate][1], blocks[current][1]
        position_m = _locate(line, np.array([x, y]))
        if candidate == current:
            total += position_m - last_m
        else:
            rest_m = shapely.length(last_line) - last_m
            total += rest_m + skipped_m + position_m - _locate(line, _end(last_line, -1))
        current, last_m = candidate, position_m
    return float(total)


def _end(line: Any, index: int) -> Float64[np.ndarray, " 2"]:
    return shapely.get_coordinates(line)[index]


def _progress_ratio(expert_m: float, ego_m: float) -> float:
    if ego_m < -_MIN_PROGRESS_M:
        return 0.0
    return min(1.0, max(ego_m, _MIN_PROGRESS_M) / max(expert_m, _MIN_PROGRESS_M))


def _speed_compliance(road: Road, route: Sequence[Sequence[int]], speed: Float64[np.ndarray, " t"]) -> float:
    """Return ``1 - mean speeding / 2.23 m/s``, at least 0 (``speed_limit_compliance``).

    The mean is the sum over the samples divided by the number of steps between them. The limit of a connector is the
    highest limit of the lanes that it joins. Speeding is 0 in samples without a lane or with an unknown limit.
    """
    speeding = np.zeros(len(speed))
    for sample, objects in enumerate(route):
        lanes = [road.objects[index] for index in objects]
        if lanes and lanes[0].connector:
            indices = (index for lane in lanes for index in (*lane.successors, *lane.predecessors))
            lanes = [road.objects[index] for index in indices]
        limits = [lane.limit_mps or 0.0 for lane in lanes]
        if limits and all(limits):
            speeding[sample] = max(0.0, speed[sample] - max(limits))
    return max(0.0, 1.0 - speeding.sum() / (_OVERSPEED_MPS * max(len(speed) - 1, 1)))
