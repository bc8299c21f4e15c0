"""What readers and the built-in world produce: a log as its source tells it, before it is assembled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from drivax.scenario.schema import Flag, RoadKind


@dataclass(frozen=True)
class Tracks:
    """Everything that moves (or could), one row per track, in the source's map frame.

    Invalid entries hold zeros. ``size`` is per step where the source measures it per step.
    """

    xy: Float64[np.ndarray, "track time 2"]
    z: Float64[np.ndarray, "track time"]
    heading: Float64[np.ndarray, "track time"]
    velocity: Float64[np.ndarray, "track time 2"]
    size: Float64[np.ndarray, "track time 3"]
    valid: Bool[np.ndarray, "track time"]
    kind: Int8[np.ndarray, " track"]
    track_id: Int64[np.ndarray, " track"]


@dataclass(frozen=True)
class MapFeature:
    """One element of the map: a lane centre, a marking, an edge, a polygon or a stop sign.

    ``points`` are (x, y, z) in metres; polygons are implicitly closed; a stop sign has one point. Road edges have
    the drivable side on their left. Links name other features by ``feature_id`` and may dangle.
    """

    feature_id: int
    kind: RoadKind
    points: Float64[np.ndarray, "point 3"]
    limit_mps: float | None = None
    width_m: float | None = None
    successors: tuple[int, ...] = ()
    predecessors: tuple[int, ...] = ()
    left_neighbours: tuple[int, ...] = ()
    right_neighbours: tuple[int, ...] = ()
    interpolating: bool = False
    #: For a stop sign: the lanes that it controls.
    lanes: tuple[int, ...] = ()


@dataclass(frozen=True)
class Light:
    """A traffic light as it concerns one lane."""

    lane_id: int
    stop_point: Float64[np.ndarray, " 3"]
    states: Int8[np.ndarray, " time"]


@dataclass(frozen=True)
class Event:
    """A labelled rare event of the built-in world. ``actors`` are track ids, steps are inclusive."""

    kind: int
    start: int
    end: int
    actors: tuple[int, ...]


@dataclass(frozen=True)
class Recording:
    """A log as its source tells it: ragged arrays, float64, the source's frame; what readers produce.

    Attributes:
        ego: Row of ``tracks`` that is the ego vehicle.
        timestamps_s: Seconds, one per step, starting anywhere.
        current_step: Step at which the future begins (10 in WOMD).
        to_predict, of_interest: Rows of ``tracks``.
        route_lanes: Feature ids of the lanes of the intended route in order, where the source knows it.
        route_corridor: Feature ids of all lanes that the intended route may use, where the source knows only that
            (nuPlan's roadblocks).
        seen: Which valid steps of which tracks ego's sensors would have seen, where the source holds the truth and
            knows the difference; None: everything that was recorded was seen.
        tags: What the source says in words: ``place`` (city), ``source_format``, the world's ``family``, ...
        lost: What the reader left out, by name and number.
        flags: Facts that only the reader knows (defaulted sizes, truncated map, ...).
        split_gap_m: Polylines are cut where neighbouring points are further apart (clipping jumps); None: never.
    """

    scenario_id: str
    dataset: str
    segment: str
    timestamps_s: Float64[np.ndarray, " time"]
    current_step: int
    ego: int
    tracks: Tracks
    features: tuple[MapFeature, ...]
    lights: tuple[Light, ...] = ()
    to_predict: tuple[int, ...] = ()
    of_interest: tuple[int, ...] = ()
    route_lanes: tuple[int, ...] = ()
    route_corridor: tuple[int, ...] = ()
    seen: Bool[np.ndarray, "track time"] | None = None
    events: tuple[Event, ...] = ()
    tags: Mapping[str, str] = field(default_factory=dict)
    lost: Mapping[str, int] = field(default_factory=dict)
    flags: Flag = Flag.NONE
    split_gap_m: float | None = None
