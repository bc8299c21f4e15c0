"""Hand-made recordings with known answers."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from drivax.scenario.recording import Light, MapFeature, Recording, Tracks
from drivax.scenario.schema import AgentKind, RoadKind

#: Far from the origin, as real map frames are (UTM): float32 would be half a metre coarse here.
FAR = np.array([661_234.5, 4_012_345.25, 37.0])
SIZE = (4.6, 1.9, 1.5)


def line(*points: tuple[float, ...], step: float = 1.0, z: float = 0.0) -> np.ndarray:
    """A polyline through points, sampled about every ``step`` metres."""
    corner = np.array([(*p, z)[:3] for p in points], dtype=np.float64)
    parts = [corner[:1]]
    for a, b in pairwise(corner):
        count = max(round(float(np.hypot(*(b - a)[:2])) / step), 1)
        parts.append(a + np.arange(1, count + 1)[:, None] / count * (b - a))
    return np.concatenate(parts)


def arc(
    centre: tuple[float, float], radius: float, begin: float, end: float, step: float = 0.5
) -> np.ndarray:
    """A circular arc between two angles, counter-clockwise where ``end > begin``."""
    angle = np.linspace(begin, end, max(int(abs(end - begin) * radius / step), 2) + 1)
    xy = np.array(centre) + radius * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    return np.concatenate((xy, np.zeros((len(xy), 1))), axis=1)


def lane(number: int, points: np.ndarray, **more) -> MapFeature:
    return MapFeature(feature_id=number, kind=more.pop("kind", RoadKind.LANE_SURFACE), points=points, **more)


def edge(number: int, points: np.ndarray) -> MapFeature:
    return MapFeature(feature_id=number, kind=RoadKind.EDGE_BOUNDARY, points=points)


def driving(speed: float = 10.0, x: float = 0.0, y: float = 0.0, steps: int = 91, heading: float = 0.0):
    """Positions of a car at constant speed that is at (x, y) at step 10."""
    s = (np.arange(steps) - min(10, steps - 1)) * 0.1 * speed
    return np.stack((x + s * np.cos(heading), y + s * np.sin(heading)), axis=-1)


def make_tracks(paths, valid=None, kind=None, size=None, heading=None) -> Tracks:
    """Tracks along positions ``[track, time, 2]``; headings and speeds are those of the motion."""
    xy = np.array(paths, dtype=np.float64)
    count, steps = xy.shape[:2]
    velocity = np.gradient(xy, 0.1, axis=1) if steps > 1 else np.zeros_like(xy)
    course = np.arctan2(velocity[..., 1], velocity[..., 0]) if heading is None else np.array(heading, float)
    mask = np.ones((count, steps), dtype=bool) if valid is None else np.array(valid, dtype=bool)
    return Tracks(
        xy=xy,
        z=np.zeros((count, steps)),
        heading=np.broadcast_to(course, (count, steps)).copy(),
        velocity=velocity,
        size=np.broadcast_to(
            SIZE if size is None else np.array(size, dtype=np.float64), (count, steps, 3)
        ).copy(),
        valid=mask,
        kind=np.full(count, AgentKind.VEHICLE, dtype=np.int8)
        if kind is None
        else np.array(kind, dtype=np.int8),
        track_id=np.arange(100, 100 + count, dtype=np.int64),
    )


def straight_road(width: float = 3.5, begin: float = -60.0, end: float = 300.0) -> tuple[MapFeature, ...]:
    """Two lanes to the east (1 below 2) inside a closed ring; drivable inside, so counter-clockwise."""
    low, high = -width / 2, 1.5 * width
    ring = line((begin, low), (end, low), (end, high), (begin, high), (begin, low), step=0.5)
    return (
        lane(1, line((begin, 0.0), (end, 0.0)), limit_mps=13.4, left_neighbours=(2,)),
        lane(2, line((begin, width), (end, width)), limit_mps=13.4, right_neighbours=(1,)),
        edge(3, ring),
    )


def make_recording(features=None, tracks=None, **changes) -> Recording:
    """A car at 10 m/s on the right lane of a straight road."""
    tracks = make_tracks([driving()]) if tracks is None else tracks
    steps = tracks.valid.shape[1]
    plain = Recording(
        scenario_id="hand-made",
        dataset="test",
        segment="hand-made",
        timestamps_s=np.arange(steps) * 0.1,
        current_step=min(10, steps - 1),
        ego=0,
        tracks=tracks,
        features=straight_road() if features is None else tuple(features),
    )
    return replace(plain, **changes)


def moved(recording: Recording, offset: np.ndarray) -> Recording:
    """The same recording in another map frame."""
    tracks = recording.tracks
    return replace(
        recording,
        tracks=replace(tracks, xy=tracks.xy + offset[:2], z=tracks.z + offset[2]),
        features=tuple(replace(f, points=f.points + offset) for f in recording.features),
        lights=tuple(replace(light, stop_point=light.stop_point + offset) for light in recording.lights),
    )


def light(lane_id: int, x: float, y: float, states) -> Light:
    return Light(lane_id, np.array([x, y, 0.0]), np.array(states, dtype=np.int8))
