"""Tags of scenarios, for filters and strata.

Every scenario gets the tags of :data:`TAGS` when it is assembled; readers and the built-in world add tags of their own
(``place``, ``family``, ...). Tags describe log and map; planners do not observe them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax.geometry.polylines import arc_lengths
from drivax.geometry.vectors import wrap
from drivax.scenario.build.lanes import LaneGraph, Lights, end_headings
from drivax.scenario.build.routes import STEP_M, RouteSet
from drivax.scenario.build.segments import space_out
from drivax.scenario.build.tracks import LocalTracks
from drivax.scenario.recording import Recording
from drivax.scenario.schema import DT_S, AgentKind, Flag, among

Array = np.ndarray[Any, Any]

#: Computed tags and their values.
TAGS: Mapping[str, tuple[str, ...]] = {
    "type": ("straight", "lane_follow", "junction", "merge", "turn_left", "turn_right", "u_turn"),
    "difficulty": ("easy", "medium", "hard"),
    "density": ("low", "medium", "high"),
    "moves": ("yes", "no"),
    "lights": ("yes", "no"),
    "limits": ("measured", "default", "none"),
    "lane_graph": ("given", "chained", "none"),
    "routes": ("graph", "published"),
}
#: Least distance that a log drives if it moves.
MOVES_M = 5.0
#: Least heading change of a turn and of a U-turn within ``TURN_WITHIN_M`` of driving.
TURN_RAD, U_TURN_RAD, TURN_WITHIN_M = np.deg2rad(45.0), np.deg2rad(135.0), 40.0
#: Largest range of headings of a straight log.
STRAIGHT_RAD = np.deg2rad(10.0)
#: Lanes that fork or join at angles that differ by more than the first belong to a junction, unless they
#: are longer than the second (ramps).
FORK_RAD, JUNCTION_LANE_M = np.deg2rad(30.0), 60.0
#: Density is low below the first number of agents within ``NEAR_M`` at the current step, high from the second on.
NEAR_M, DENSITY = 50.0, (5, 20)
#: Difficulty is medium from the first number of demands on, hard from the second on.
DIFFICULTY = (2, 3)
VULNERABLE_M = 15.0
#: Crossing traffic: largest distance, least speed, and range of angles to the heading of the ego.
CROSSING_M, CROSSING_MPS, CROSSING_RAD = 20.0, 1.0, (np.deg2rad(45.0), np.deg2rad(135.0))
#: Braking: least loss of speed from a step to one second later.
BRAKING_MPS = 2.0


@dataclass(frozen=True)
class EgoPath:
    """Log of the ego as poses at least half a metre apart: distance driven, unwrapped headings.

    ``lane`` is the dense index of the lane under every metre of the log, -1 without one.
    """

    arc: Float[Array, " pose"]
    heading: Float[Array, " pose"]
    lane: Int[Array, " metre"]

    @classmethod
    def of(cls, tracks: LocalTracks, routes: RouteSet) -> EgoPath:
        """Build from the track of the ego and the route of its log (row 1, if stored)."""
        valid = tracks.valid[tracks.ego]
        xy, heading = tracks.xyz[tracks.ego, valid, :2], tracks.heading[tracks.ego, valid]
        keep = space_out(xy, STEP_M)
        arc = arc_lengths(xy[keep])
        lane = routes.routes[1].lane if len(routes.routes) > 1 else np.zeros(0, dtype=np.int64)
        # The route has a point per metre and goes on beyond the end of the log.
        return cls(arc, np.unwrap(heading[keep]), lane[: int(arc[-1]) + 1])


def scenario_tags(
    recording: Recording, tracks: LocalTracks, graph: LaneGraph, routes: RouteSet, lights: Lights,
    flags: Flag, style: str,
) -> dict[str, str]:  # fmt: skip
    """Return all tags of a scenario; ``style`` names the source of its candidate routes."""
    path = EgoPath.of(tracks, routes)
    kind = type_of(path, graph)
    density = density_of(tracks, recording.current_step)
    limits = "measured" if Flag.SPEED_LIMITS in flags else "none"
    links = "chained" if Flag.CHAINED_GRAPH in flags else "given"
    return {
        **recording.tags,
        "dataset": recording.dataset,
        "type": kind,
        "difficulty": difficulty_of(tracks, kind, density),
        "density": density,
        "moves": "yes" if path.arc[-1] >= MOVES_M else "no",
        "lights": "yes" if len(lights.z) else "no",
        "limits": "default" if Flag.DEFAULT_LIMITS in flags else limits,
        "lane_graph": links if Flag.LANE_GRAPH in flags else "none",
        "routes": style,
    }


def type_of(path: EgoPath, graph: LaneGraph) -> str:
    """Return the most specific manoeuvre of the ego.

    - ``u_turn``, ``turn_left``, ``turn_right``: the heading changes by 135 or 45 degrees within 40 m of driving, and
      the log is somewhere on a lane of a junction or off all lanes (otherwise the road bends).
    - ``merge``: the log continues on a lane that another lane enters, outside junctions.
    - ``junction``: the log is on a lane of a junction.
    - ``lane_follow``, ``straight``: the headings differ by 10 degrees or more, or by less.

    A log that drives less than 5 m is ``straight``.
    """
    if path.arc[-1] < MOVES_M:
        return "straight"
    junction = junction_lanes(graph)
    lanes = path.lane[path.lane >= 0]
    is_in_junction = bool(junction[lanes].any())
    turn = _sharpest_turn(path)
    if abs(turn) >= TURN_RAD and (is_in_junction or len(lanes) < len(path.lane)):
        if abs(turn) >= U_TURN_RAD:
            return "u_turn"
        return "turn_left" if turn > 0 else "turn_right"
    if _merges(lanes, graph, junction):
        return "merge"
    if is_in_junction:
        return "junction"
    return "straight" if np.ptp(path.heading) < STRAIGHT_RAD else "lane_follow"


def _sharpest_turn(path: EgoPath) -> float:
    """Largest change of heading within 40 m of driving, left positive, radians."""
    is_within = np.abs(path.arc[:, None] - path.arc) <= TURN_WITHIN_M
    turn = np.where(np.triu(is_within), path.heading - path.heading[:, None], 0.0)
    return float(turn.flat[np.abs(turn).argmax()])


def junction_lanes(graph: LaneGraph) -> Bool[Array, " lane"]:
    """Mask of lanes inside junctions: turn paths of the source, and short lanes that fork or join at an angle."""
    result = graph.interpolating.copy()
    if graph.count == 0:
        return result
    begin, end = end_headings(graph.lines)
    for links, heading in ((graph.successor, end), (graph.predecessor, begin)):
        angle = wrap(heading[links][:, :, None] - heading[links][:, None])
        # A missing link (-1) reads the heading of the last lane; pairs with it do not count.
        both_exist = (links >= 0)[:, :, None] & (links >= 0)[:, None]
        is_fork = (both_exist & (np.abs(angle) > FORK_RAD)).any(axis=2)
        result[links[is_fork]] = True
    return result & ((graph.lines.length <= JUNCTION_LANE_M) | graph.interpolating)


def _merges(lane: Int[Array, " metre"], graph: LaneGraph, junction: Bool[Array, " lane"]) -> bool:
    """Return whether the log passes to a successor that other lanes enter too, and none of them is in a junction."""
    for change in np.flatnonzero(lane[1:] != lane[:-1]):
        entering = graph.predecessor[lane[change + 1]]
        entering = entering[entering >= 0]
        if lane[change] in entering and len(entering) > 1 and not junction[entering].any():
            return True
    return False


def density_of(tracks: LocalTracks, current_step: int) -> str:
    """Return the density of road users within 50 m at the current step: below 5, 5 to 19, 20 or more."""
    is_user = among(tracks.kind, (AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST))
    is_user[tracks.ego] = False
    distance = _ego_distance(tracks, np.flatnonzero(is_user))[:, current_step]
    return TAGS["density"][int(np.searchsorted(DENSITY, (distance <= NEAR_M).sum(), side="right"))]


def difficulty_of(tracks: LocalTracks, kind: str, density: str) -> str:
    """Return the difficulty by the number of demands on the ego: 2 are medium, 3 or more hard.

    The demands: a manoeuvre (any type but ``straight`` and ``lane_follow``); high density; a pedestrian or cyclist
    within 15 m; a vehicle at 1 m/s or more within 20 m that crosses ego's heading at 45 to 135 degrees; and braking, by
    2 m/s from some step to one second later. Distances are between centres at the same step, at any step of the log.
    """
    vulnerable = np.flatnonzero(among(tracks.kind, (AgentKind.PEDESTRIAN, AgentKind.CYCLIST)))
    demands = (
        kind not in ("straight", "lane_follow"),
        density == "high",
        bool((_ego_distance(tracks, vulnerable) <= VULNERABLE_M).any()),
        _meets_crossing(tracks),
        _brakes(tracks),
    )
    return TAGS["difficulty"][int(np.searchsorted(DIFFICULTY, sum(demands), side="right"))]


def _ego_distance(tracks: LocalTracks, rows: Int[Array, " row"]) -> Float[Array, "row time"]:
    """Distance of tracks from the ego at every step, infinite if either is invalid."""
    offset = tracks.xyz[rows, :, :2] - tracks.xyz[tracks.ego, :, :2]
    both_valid = tracks.valid[rows] & tracks.valid[tracks.ego]
    return np.where(both_valid, np.hypot(offset[..., 0], offset[..., 1]), np.inf)


def _meets_crossing(tracks: LocalTracks) -> bool:
    """Return whether a vehicle crosses ego's heading nearby at some step (:func:`difficulty_of`)."""
    rows = np.flatnonzero(tracks.kind == AgentKind.VEHICLE)
    rows = rows[rows != tracks.ego]
    angle = np.abs(wrap(tracks.heading[rows] - tracks.heading[tracks.ego]))
    is_crossing = (angle >= CROSSING_RAD[0]) & (angle <= CROSSING_RAD[1])
    speed = np.hypot(tracks.velocity[rows, :, 0], tracks.velocity[rows, :, 1])
    return bool((is_crossing & (speed >= CROSSING_MPS) & (_ego_distance(tracks, rows) <= CROSSING_M)).any())


def _brakes(tracks: LocalTracks) -> bool:
    """Return whether the logged ego is slower by 2 m/s or more one second after some step."""
    speed = np.hypot(*tracks.velocity[tracks.ego].T)
    valid, steps = tracks.valid[tracks.ego], round(1.0 / DT_S)
    both_valid = valid[steps:] & valid[:-steps]
    return bool((both_valid & (speed[:-steps] - speed[steps:] >= BRAKING_MPS)).any())
