"""The scenario without an event in coordinates of ego's path: input of the scripts that stage events."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64

from drivax.geometry.polylines import left_normals
from drivax.scenario.schema import CURRENT_STEP, DT_S, STEPS
from drivax.simulator.idm import idm_acceleration
from drivax.synthetic.roads.curves import STEP_M, Curve, interpolate
from drivax.synthetic.traffic.roles import Motion, Roles

#: Earliest and latest first step of an event, and step before which its actor must block ego's path, counted from the
#: recording's first step.
EARLIEST, LATEST, FULL_SWING = CURRENT_STEP + 2, CURRENT_STEP + 50, 78
#: Steps from an event's first one until the actor's behaviour is visible, and the time, s.
NOTICED = 4
NOTICED_S = NOTICED * DT_S
#: Ego's path continues this far beyond its last position, m.
_BEYOND_M = 160.0
#: Least speed of ego at the beginning of an event, m/s.
SLOWEST_MPS = 4.0
#: Lowest and highest acceleration of ego behind an added leader, m/s2.
_MIN_ACCELERATION_MPS2, _MAX_ACCELERATION_MPS2 = -6.0, 2.0


@dataclass(frozen=True)
class Track:
    """Ego's trace and the rest of its path, sampled every half metre.

    ``at`` is ego's station (distance along the track) at each step, m.
    """

    xy: Float64[np.ndarray, "point 2"]
    heading: Float64[np.ndarray, " point"]
    at: Float64[np.ndarray, " time"]

    @property
    def length_m(self) -> float:
        """Length, m."""
        return STEP_M * (len(self.xy) - 1)

    def pose(
        self, station: Float64[np.ndarray, "*n"], left_m: Float64[np.ndarray, "*n"] | float = 0.0
    ) -> tuple[Float64[np.ndarray, "*n 2"], Float64[np.ndarray, "*n"]]:
        """Positions at stations and lateral offsets, and the path's headings there; beyond an end, those of the end."""
        sample = np.clip(station / STEP_M, 0.0, len(self.xy) - 1.001)
        index = sample.astype(int)
        share = sample - index
        heading = self.heading[index] + share * (self.heading[index + 1] - self.heading[index])
        xy = self.xy[index] + share[..., None] * (self.xy[index + 1] - self.xy[index])
        return xy + np.asarray(left_m)[..., None] * left_normals(heading), heading

    def place(self, station: float) -> tuple[Float64[np.ndarray, " 2"], float]:
        """Position and heading at one station."""
        xy, heading = self.pose(np.array([station]))
        return xy[0], float(heading[0])

    def project(
        self, xy: Float64[np.ndarray, "n 2"]
    ) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Stations and lateral offsets (left positive) of points, m."""
        x, y = (np.subtract.outer(xy[:, axis], self.xy[:, axis]) for axis in (0, 1))
        index = np.argmin(x**2 + y**2, axis=1)
        nearest = np.arange(len(xy)), index
        x, y = x[nearest], y[nearest]
        cos, sin = np.cos(self.heading[index]), np.sin(self.heading[index])
        return STEP_M * index + x * cos + y * sin, y * cos - x * sin


def ego_track(motion: Motion) -> Track:
    """Return the track of row 0: its trace, the rest of its path, and a straight continuation."""
    xy, heading = motion.xy[0], np.unwrap(motion.heading[0])
    arc = Curve(xy, heading).arc_m
    # Skip steps of at most 1 mm: rounding must not move an ego at rest.
    distinct = np.concatenate([[True], np.diff(arc) > 1e-3])
    points, headings, along = xy[distinct], heading[distinct], arc[distinct]
    if motion.paths:
        curve = motion.paths[0].curve
        # The second sample after the nearest one is ahead of ego.
        index = int(np.argmin(np.hypot(*(curve.xy - xy[-1]).T))) + 2
        remainder, turn = curve.xy[index:], curve.heading[index:]
        gaps = np.hypot(*np.diff(np.concatenate([points[-1:], remainder]), axis=0).T)
        points = np.concatenate([points, remainder])
        shift = 2 * math.pi * np.round((headings[-1] - turn[:1]) / (2 * math.pi))
        headings = np.concatenate([headings, turn + shift])
        along = np.concatenate([along, along[-1] + np.cumsum(gaps)])
    ahead = np.array([np.cos(headings[-1]), np.sin(headings[-1])])
    # 300 m exceed ``_BEYOND_M``: the samples below never reach the end.
    points = np.concatenate([points, [points[-1] + 300.0 * ahead]])
    headings, along = np.append(headings, headings[-1]), np.append(along, along[-1] + 300.0)
    station = np.arange(0.0, arc[-1] + _BEYOND_M, STEP_M)
    return Track(interpolate(station, along, points), np.interp(station, along, headings), arc)


@dataclass(frozen=True)
class EgoView:
    """The scenario without the event; the recording begins at ``first_step`` of the motion, whose row 0 is ego."""

    roles: Roles
    motion: Motion
    first_step: int

    @cached_property
    def track(self) -> Track:
        """Ego's trace and path."""
        return ego_track(self.motion)

    @property
    def steps(self) -> int:
        """Number of time steps."""
        return self.motion.xy.shape[1]

    @property
    def last_step(self) -> int:
        """Last step of the recording, at most its 91st: events ignore later steps."""
        return min(self.first_step + STEPS, self.steps) - 1

    @property
    def ego_size_m(self) -> Float64[np.ndarray, " 3"]:
        """Ego's length, width, height."""
        return self.motion.size_m[0]

    def at_step(self, step: int) -> tuple[float, float]:
        """Station, m, and speed, m/s, of ego at a step."""
        return float(self.track.at[step]), float(self.motion.speed[0, step])

    def draw_step(self, rng: np.random.Generator) -> int | None:
        """Draw a step at which an event may begin and ego is not slow, or return None without one."""
        steps = np.arange(self.first_step + EARLIEST, self.first_step + LATEST + 1)
        steps = steps[self.motion.speed[0, steps] > SLOWEST_MPS]
        return int(rng.choice(steps)) if len(steps) else None

    @cached_property
    def _lane_points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Every second sample of all lanes: position, heading, lane."""
        lanes = self.roles.network.lanes
        return (
            np.concatenate([lane.curve.xy[::2] for lane in lanes]),
            np.concatenate([lane.curve.heading[::2] for lane in lanes]),
            np.concatenate([np.full(len(lane.curve.xy[::2]), i) for i, lane in enumerate(lanes)]),
        )

    def lane_at(self, station: float) -> int:
        """Lane of ego at a station (-1: none); where several coincide, the route's."""
        xy, heading = self.track.place(station)
        points, headings, lane = self._lane_points
        dx, dy = (points - xy).T
        rows = np.flatnonzero(dx * dx + dy * dy < 4.1)
        distance_m = np.hypot(dx[rows], dy[rows])
        is_near = (distance_m < 2.0) & (np.cos(headings[rows] - heading) > 0.8)
        if not is_near.any():
            return -1
        lane = lane[rows]
        is_on_route = is_near & np.isin(lane, self.roles.route)
        is_candidate = is_on_route if is_on_route.any() else is_near
        return int(lane[is_candidate][np.argmin(distance_m[is_candidate])])

    def neighbour(self, station: float, side: int) -> int:
        """Return the neighbour of ego's lane at a station, left (1) or right (-1); -1 without one."""
        lane = self.lane_at(station)
        if lane < 0:
            return -1
        current = self.roles.network.lanes[lane]
        return current.left if side > 0 else current.right

    @cached_property
    def lane_ends(self) -> list[tuple[float, int]]:
        """Ends of adjacent lanes: station, and side of ego's path (1 left, -1 right).

        These are lanes that end, and all sections of lanes that lead off the road.
        """
        result = []
        for lane in self.roles.network.lanes:
            if lane.ends or lane.exit_only:
                (station,), (lateral,) = self.track.project(lane.curve.xy[-1:])
                if 2.0 < abs(lateral) < 5.5 and station > 0:
                    result.append((float(station), 1 if lateral > 0 else -1))
        return result

    def edge_m(self, station: float, side: int) -> float:
        """Distance of the nearest road edge from ego's path at a station, left (1) or right (-1), m (inf: none)."""
        origin, heading = self.track.place(station)
        outward = side * np.array([-np.sin(heading), np.cos(heading)])
        best = math.inf
        for edge in self.roles.network.edges:
            a = edge.xy - origin
            b = np.roll(a, -1, axis=0)
            # Intersections of the edge's sides with the ray, in the frame (outward, along).
            ay, by = a @ [-outward[1], outward[0]], b @ [-outward[1], outward[0]]
            is_crossed = (ay > 0) != (by > 0)
            if is_crossed.any():
                ax, bx = (a @ outward)[is_crossed], (b @ outward)[is_crossed]
                position = ax + (bx - ax) * ay[is_crossed] / (ay[is_crossed] - by[is_crossed])
                best = min(best, float(np.min(position[position > 0.0], initial=math.inf)))
        return best

    def plain_road(self, station: float) -> bool:
        """Return whether a station is on a lane outside of junctions, over 14 m from the middle of any crossing."""
        lane, network = self.lane_at(station), self.roles.network
        if lane < 0 or network.lanes[lane].connector:
            return False
        xy, _ = self.track.place(station)
        return all(np.hypot(*(c.axis.mean(axis=0) - xy)) > 14.0 for c in network.crossings)

    @cached_property
    def connectors(self) -> list[int]:
        """Connectors on ego's path from the earliest event to 30 m beyond the recording."""
        begin, end = self.track.at[self.first_step + EARLIEST], self.track.at[self.last_step] + 30.0
        return self._connectors_between(begin, end, 3.0)

    def meets_junction(self, low_m: float, high_m: float) -> bool:
        """Return whether ego's path has a junction between two stations; scripted actors do not obey its rules."""
        return bool(self._connectors_between(low_m, high_m + 4.0, 4.0))

    def _connectors_between(self, low_m: float, high_m: float, step_m: float) -> list[int]:
        lanes = {self.lane_at(station) for station in np.arange(low_m, high_m, step_m).tolist()}
        return sorted(i for i in lanes if i >= 0 and self.roles.network.lanes[i].connector)

    def on_path(self, step: int) -> tuple[Float64[np.ndarray, " v"], Bool[np.ndarray, " v"]]:
        """Stations of all vehicles at a step, m, and whether they drive on ego's path (False for ego itself)."""
        count = self.motion.vehicles
        station, lateral = self.track.project(self.motion.xy[:count, step])
        _, heading = self.track.pose(station)
        is_parallel = np.cos(self.motion.heading[:count, step] - heading) > 0.8
        is_on_path = self.motion.valid[:count, step] & (np.abs(lateral) < 1.0) & is_parallel
        is_on_path[0] = False
        return station, is_on_path

    def behind(self, rear_m: Float64[np.ndarray, " time"], since: int) -> EgoView:
        """Return the scenario with ego slowed by IDM behind a leader with its rear bumper at ``rear_m`` from a step on.

        The scenario does not contain the leader.
        """
        idm, at, speed = self.roles.drivers.idm(slice(1)), self.track.at, self.motion.speed[0]
        leader_speed, fastest = np.gradient(rear_m, DT_S), np.maximum(speed.max(keepdims=True), 1.0)
        stations, speeds = at.copy(), speed.copy()
        for t in range(since, self.steps - 1):
            v = speeds[t : t + 1]
            gap = rear_m[t : t + 1] - stations[t] - self.ego_size_m[0] / 2
            a = idm_acceleration(v, fastest, gap, leader_speed[t : t + 1], idm)
            acceleration = np.clip(a[0], _MIN_ACCELERATION_MPS2, _MAX_ACCELERATION_MPS2)
            after = max(0.0, float(v[0] + acceleration * DT_S))
            distance = (float(v[0]) + after) / 2 * DT_S
            # Ego never gets ahead of its motion without the leader: bends, lights and other agents still hold it back.
            stations[t + 1] = min(stations[t] + distance, at[t + 1])
            if stations[t + 1] == at[t + 1]:
                after = min(after, (stations[t + 1] - stations[t]) / DT_S)
            speeds[t + 1] = after
        xy, heading = self.track.pose(stations)
        ego = {"xy": xy, "heading": heading, "speed": speeds}
        arrays = {k: np.concatenate([values[None], getattr(self.motion, k)[1:]]) for k, values in ego.items()}
        result = replace(self, motion=replace(self.motion, **arrays))
        # The track stays the same: only ego's stations on it change.
        result.__dict__["track"] = replace(self.track, at=stations)
        return result
