"""From a stored scenario back to a recording: what exporters write, and what tests compare.

The way back is not complete. Stored polylines are simplified to 5 cm, cropped to 100 m around the ego's log and cut
into pieces there; boxes have one size; parked agents have one pose and no marks; stop signs have lost their ids and
heights, lights whose lane the map lacks their lane's id. ``scenario.build.assemble`` says what is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax.scenario.build.assemble import MEASURED
from drivax.scenario.build.tracks import INTEREST_BIT, PREDICT_BIT
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks
from drivax.scenario.schema import LANE_KINDS, POLYGON_KINDS, Flag, RoadKind, Scenario

_Array = np.ndarray[Any, Any]
#: Flags that a reader would have set; all others are measured again.
_READERS_FLAGS = ~MEASURED & ~(Flag.NO_FUTURE | Flag.JITTERED_TIME)


def restore(scenario: Scenario) -> Recording:
    """The recording that a stored scenario describes, in the source's map frame (float64).

    Agents come in stored order, the ego first, then moving, then parked ones. Every piece of a polyline is a feature
    of its own: the first one of a source feature keeps its id, the lane graph's links and its stop signs; pieces that
    the crop has cut off, stop signs and unnumbered features get ids above all others.
    """
    fresh = _Fresh(scenario)
    features = (*_features(scenario, fresh), *_stop_signs(scenario, fresh))
    marks = scenario.agent_flags
    return Recording(
        scenario_id=scenario.id,
        dataset=scenario.text("dataset"),
        segment=scenario.text("segment"),
        timestamps_s=np.arange(int(scenario.steps)) * round(float(scenario.dt_s), 6),
        current_step=int(scenario.current_step),
        ego=0,
        tracks=_tracks(scenario),
        features=features,
        seen=_seen(scenario),
        lights=_lights(scenario, fresh),
        to_predict=tuple(np.flatnonzero(marks[_moving(scenario)] & PREDICT_BIT).tolist()),
        of_interest=tuple(np.flatnonzero(marks[_moving(scenario)] & INTEREST_BIT).tolist()),
        tags=scenario.tags,
        flags=Flag(scenario.has & _READERS_FLAGS),
    )


class _Fresh:
    """Numbers features that have none of their own, above all ids of the scenario."""

    def __init__(self, scenario: Scenario) -> None:
        self._next = 1 + max(int(scenario.feature_id.max(initial=0)), int(scenario.lane_id.max(initial=0)))

    def __call__(self) -> int:
        self._next += 1
        return self._next - 1


def _moving(scenario: Scenario) -> Int[_Array, " slot"]:
    """Slots of the moving block that are used."""
    return np.flatnonzero(scenario.agent_valid.any(axis=0))


def _tracks(scenario: Scenario) -> Tracks:
    steps, moving = int(scenario.steps), _moving(scenario)
    parked = np.flatnonzero(scenario.parked_valid.any(axis=0))
    still = np.zeros((steps, len(parked), 1))
    valid = np.concatenate(
        (scenario.agent_valid[:steps, moving], scenario.parked_valid[:steps, parked]), axis=1
    )
    mask = valid[..., None]

    def timed(moves: _Array, stands: _Array) -> _Array:
        """[track, time, number], zero where not valid."""
        both = np.concatenate((moves[:steps, moving].reshape(steps, len(moving), -1), stands + still), axis=1)
        return np.swapaxes(np.where(mask, both, 0.0), 0, 1).astype(np.float64)

    def block(moves: _Array, stands: _Array) -> _Array:
        return np.concatenate((moves[moving], stands[parked]))

    size = block(scenario.agent_size, scenario.parked_size).astype(np.float64)
    origin = np.where(mask, scenario.origin, 0.0).swapaxes(0, 1)
    return Tracks(
        xy=timed(scenario.agent_xy, scenario.parked_xy[parked]) + origin[..., :2],
        z=timed(scenario.agent_z, scenario.parked_z[parked, None])[..., 0] + origin[..., 2],
        heading=timed(scenario.agent_heading, scenario.parked_heading[parked, None])[..., 0],
        velocity=timed(scenario.agent_velocity, np.zeros((len(parked), 2))),
        size=np.where(valid.T[..., None], size[:, None], 0.0),
        valid=valid.T.copy(),
        kind=block(scenario.agent_kind, scenario.parked_kind).astype(np.int8),
        track_id=block(scenario.agent_id, scenario.parked_id).astype(np.int64),
    )


def _seen(scenario: Scenario) -> Bool[_Array, "track time"] | None:
    """What ego's sensors saw, in the order of :func:`_tracks`; None where that is everything."""
    steps, moving = int(scenario.steps), _moving(scenario)
    parked = np.flatnonzero(scenario.parked_valid.any(axis=0))

    def both(name: str) -> Bool[_Array, "track time"]:
        blocks = scenario.record["agent_" + name], scenario.record["parked_" + name]
        return np.concatenate((blocks[0][:steps, moving], blocks[1][:steps, parked]), axis=1).T

    seen = both("seen")
    return None if np.array_equal(seen, both("valid")) else seen.copy()


@dataclass(frozen=True)
class _Piece:
    """Segments that follow one another.

    Attributes:
        points: Their ends, local frame, metres.
        row: Any row of the segment table that belongs to it.
    """

    points: Float[_Array, "point 3"]
    row: int


def pieces(scenario: Scenario) -> list[_Piece]:
    """The stored segments joined to polylines again, ordered by feature and by arc length along it."""
    count = int(scenario.segment_blocks[3])
    begin, end = scenario.segment_a[:count], scenario.segment_b[:count]
    feature, lane, kind = (
        getattr(scenario, f"segment_{name}")[:count].astype(np.int64) for name in ("feature", "lane", "kind")
    )
    # Without a row in the feature table only kind and lane tell features apart; their ends do the rest.
    group = np.where(feature >= 0, feature, np.iinfo(np.int16).max + (kind + 1) * 2**16 + lane + 1)
    chains: list[list[int]] = []
    open_ends: dict[tuple[int, bytes], list[int]] = {}
    for row in np.lexsort((scenario.segment_start_m[:count], group)).tolist():
        chain = open_ends.pop((int(group[row]), begin[row].tobytes()), None)
        if chain is None:
            chain = []
            chains.append(chain)
        chain.append(row)
        open_ends[int(group[row]), end[row].tobytes()] = chain
    return [
        _Piece(np.concatenate((begin[chain[:1]], end[chain])).astype(np.float64), chain[0])
        for chain in chains
    ]


def _features(scenario: Scenario, fresh: _Fresh) -> list[MapFeature]:
    features, named = [], set()
    for piece in pieces(scenario):
        kind = RoadKind(int(scenario.segment_kind[piece.row]))
        row, lane = int(scenario.segment_feature[piece.row]), int(scenario.segment_lane[piece.row])
        number = int(scenario.lane_id[lane] if lane >= 0 else scenario.feature_id[row] if row >= 0 else -1)
        first = number >= 0 and number not in named
        named.add(number)
        points = piece.points + scenario.origin
        if kind in POLYGON_KINDS and np.array_equal(points[0], points[-1]):
            points = points[:-1]
        links = _links(scenario, lane) if first and kind in LANE_KINDS and lane >= 0 else {}
        features.append(MapFeature(number if first else fresh(), kind, points, **links))
    return features


def _links(scenario: Scenario, lane: int) -> dict[str, Any]:
    """What the lane graph says about a lane, in ids of the source."""

    def ids(rows: _Array) -> tuple[int, ...]:
        return tuple(int(scenario.lane_id[row]) for row in rows if row >= 0)

    # Links that were made from geometry are not the source's; they are made again.
    given = Flag.CHAINED_GRAPH not in scenario.has
    limit, width = float(scenario.lane_limit[lane]), float(scenario.lane_width[lane])
    return {
        "limit_mps": limit if limit > 0 else None,
        "width_m": width if width > 0 else None,
        "successors": ids(scenario.lane_successor[lane]) if given else (),
        "predecessors": ids(scenario.lane_predecessor[lane]) if given else (),
        "left_neighbours": ids(scenario.lane_left[lane : lane + 1]),
        "right_neighbours": ids(scenario.lane_right[lane : lane + 1]),
        "interpolating": bool(scenario.lane_interpolating[lane]),
    }


def _stop_signs(scenario: Scenario, fresh: _Fresh) -> list[MapFeature]:
    """Stop signs, at the height of the nearest piece of map."""
    used = np.flatnonzero((scenario.stop_xy != 0).any(axis=1) | (scenario.stop_lane >= 0).any(axis=1))
    near = scenario.segment_a[: int(scenario.segment_blocks[3])].astype(np.float64)
    signs = []
    for row in used:
        xy = scenario.stop_xy[row].astype(np.float64)
        z = near[np.hypot(*(near[:, :2] - xy).T).argmin(), 2] if len(near) else 0.0
        lanes = tuple(int(scenario.lane_id[lane]) for lane in scenario.stop_lane[row] if lane >= 0)
        point = np.append(xy, z) + scenario.origin
        signs.append(MapFeature(fresh(), RoadKind.STOP_SIGN, point[None], lanes=lanes))
    return signs


def _lights(scenario: Scenario, fresh: _Fresh) -> tuple[Light, ...]:
    lights = []
    for row in np.flatnonzero((scenario.light_state >= 0).any(axis=0)):
        line, lane = scenario.light_line[row].astype(np.float64), int(scenario.light_lane[row])
        middle = np.array([*(line[:2] + line[2:]) / 2, scenario.light_z[row]]) + scenario.origin
        states = scenario.light_state[: int(scenario.steps), row].copy()
        lights.append(Light(int(scenario.lane_id[lane]) if lane >= 0 else fresh(), middle, states))
    return tuple(lights)
