"""Helpers of readers: city names, ids of windows, lights by lane, checks, counts of losses, heights."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from drivax.errors import DataError
from drivax.geometry.polylines import Polylines, cut_counts
from drivax.reading import read_json
from drivax.scenario.build.tracks import DEFAULT_SIZES
from drivax.scenario.recording import STRIDE, Light, MapFeature, Recording, Tracks
from drivax.scenario.schema import LANE_KINDS, POLYGON_KINDS, STEPS, AgentKind, LightState, RoadKind

Array = np.ndarray[Any, Any]

#: Cities (the tag ``place``), and their other names: those of nuScenes' and nuPlan's maps, which may cover a part of a
#: city, and the three-letter codes of Argoverse 2's sensor maps.
PLACES: Mapping[str, tuple[str, ...]] = {
    "austin": ("atx",),
    "boston": ("boston-seaport", "us-ma-boston"),
    "dearborn": ("dtw",),
    "las-vegas": ("us-nv-las-vegas-strip",),
    "miami": ("mia",),
    "palo-alto": ("pao",),
    "pittsburgh": ("pit", "us-pa-pittsburgh-hazelwood"),
    "singapore": ("sg-one-north", "singapore-hollandvillage", "singapore-onenorth", "singapore-queenstown"),
    "washington-dc": ("wdc",),
}
_CITY_OF = {name: city for city, names in PLACES.items() for name in (city, *names)}
#: Characters of a source's name for a place that are kept.
_LONGEST = 64
#: Metres per second in a mile per hour.
MPS_PER_MPH = 0.44704
_UNOBSERVED, _UNKNOWN = int(LightState.UNOBSERVED), int(LightState.UNKNOWN)
_LAST_STATE = int(max(LightState))
#: Ids of windows: in nuScenes ``scene-0001_<token>``, with one or two tokens; in drivax ``<id>@<first step>`` or, with
#: another ego, ``<id>@<first step>#<track>``.
_WINDOW = re.compile(r"(scene-\d+)(?:_[0-9a-f]{32}){1,2}|(.+)@\d+(?:#\d+)?")
#: Note of ``drivax doctor`` on recordings whose frames are not evenly spaced.
UNEVEN = "frames are missing or unevenly spaced: steps are interpolated by time, and cut at gaps"
#: Spacing of samples of map lines for nearest-point queries, m; wider if there would be too many samples.
_SPACING_M = 1.0
_MOST_SAMPLES = 1_000_000


def place_tags(location: str | None) -> dict[str, str]:
    """Return the tags ``place`` (the city, if it is a known one) and ``location`` (the name in the source)."""
    if not location:
        return {}
    city = _CITY_OF.get(location.lower().replace("_", "-"))
    return ({} if city is None else {"place": city}) | {"location": location[:_LONGEST]}


def segment_of(scenario_id: str) -> str:
    """Return the id of the recording that a window is part of, or the id itself if it is not that of a window."""
    window = _WINDOW.fullmatch(scenario_id)
    return scenario_id if window is None else segment_of(window[1] or window[2])


class Lights:
    """Collects light states by lane over some steps; a source's slots may hold different lanes at different steps."""

    def __init__(self, steps: int) -> None:
        self._steps = steps
        # Lists: a scenario has a thousand observations, and arrays are slow one by one.
        self._lights: dict[int, tuple[tuple[float, ...], list[int]]] = {}

    def observe(self, step: int, lane: int, state: int, stop_point: Sequence[float]) -> None:
        """Add one observation; of several for the same lane and step, the first that is not UNKNOWN counts.

        The stop point of a lane is the first that is not zero; states that WOMD lacks count as UNKNOWN.
        """
        point, states = self._lights.get(lane, ((), [_UNOBSERVED] * self._steps))
        self._lights[lane] = point if any(point) else tuple(stop_point), states
        if states[step] <= _UNKNOWN:
            states[step] = state if _UNKNOWN <= state <= _LAST_STATE else _UNKNOWN

    def collect(self, features: Sequence[MapFeature]) -> tuple[tuple[Light, ...], int]:
        """Return the lights in order of first observation, and the number of lights dropped for lack of a position.

        States are -1 where a light is not observed. A light whose stop point is all zeros stands where its lane begins.
        """
        starts = {f.feature_id: f.points[0] for f in features if f.kind in LANE_KINDS}
        entries = [(lane, p if any(p) else starts.get(lane), s) for lane, (p, s) in self._lights.items()]
        lights = tuple(
            Light(lane, np.array(point, np.float64), np.array(states, np.int8))
            for lane, point, states in entries
            if point is not None
        )
        return lights, len(entries) - len(lights)


def rows_within(rows: Sequence[int], count: int, what: str, rows_of: str = "track") -> tuple[int, ...]:
    """Return row numbers as ints; refuse those outside 0 to ``count - 1`` by an error that names ``rows_of``."""
    for row in rows:
        if not 0 <= row < count:
            raise DataError(f"{what} names {rows_of} {row}, there are {count}", cure="skip this record")
    return tuple(int(row) for row in rows)


def check_finite(*arrays: np.ndarray[Any, Any]) -> None:
    """Refuse NaN and infinities in valid states."""
    if not all(np.isfinite(values).all() for values in arrays):
        raise DataError("valid states contain numbers that are not finite", cure="skip this record")


def shift(recording: Recording, offset: Float[np.ndarray, "3"]) -> Recording:
    """Move a recording by ``offset`` (x, y, z), metres."""
    if not offset.any():
        return recording
    tracks = recording.tracks
    xy = np.where(tracks.valid[..., None], tracks.xy + offset[:2], 0.0)
    z = np.where(tracks.valid, tracks.z + offset[2], 0.0)
    return replace(
        recording,
        tracks=replace(tracks, xy=xy, z=z),
        lights=tuple(replace(light, stop_point=light.stop_point + offset) for light in recording.lights),
        features=tuple(replace(feature, points=feature.points + offset) for feature in recording.features),
    )


def box_centre(
    rear_axle: Float[np.ndarray, "step 2"], heading: Float[np.ndarray, " step"], ahead_m: float
) -> Float[np.ndarray, "step 2"]:
    """Return positions of the box centre, which lies ``ahead_m`` ahead of the rear axle."""
    return rear_axle + ahead_m * np.stack((np.cos(heading), np.sin(heading)), axis=-1)


def spacing_m(features: Sequence[MapFeature]) -> float | None:
    """Return the median distance of neighbouring points of map lines (not of polygons), metres; None without any."""
    gaps = [
        np.hypot(*np.diff(feature.points[:, :2], axis=0).T)
        for feature in features
        if feature.kind not in POLYGON_KINDS and len(feature.points) > 1
    ]
    return float(np.median(np.concatenate(gaps))) if gaps else None


def load_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    return read_json(path, "download it again")


def windows_of(steps: int) -> int:
    """Return the number of windows of the usual length and stride that a recording of ``steps`` steps becomes."""
    return 1 if steps <= STEPS else (steps - STEPS) // STRIDE + 1


def nonzero(*lost: Mapping[str, int], **counts: int) -> dict[str, int]:
    """Add up counts by name for ``Recording.lost``; drop zeros."""
    return {name: int(count) for name, count in sum(map(Counter, lost), Counter(counts)).items() if count}


def one_point_features(features: Sequence[MapFeature]) -> int:
    """Count lines and polygons of one point, which have neither direction nor extent."""
    return sum(len(f.points) < 2 and f.kind != RoadKind.STOP_SIGN for f in features)


def check_within(most: float, *arrays: np.ndarray[Any, Any]) -> None:
    """Refuse NaN, infinities, and numbers further from 0 than ``most``."""
    if not all((np.abs(values) <= most).all() for values in arrays):  # NaN compares false
        raise DataError(f"contains numbers that are not finite or beyond {most:g}", cure="skip this record")


def lift(tracks: Tracks, features: Sequence[MapFeature]) -> Tracks:
    """Place agents of a source without heights on its 3-D map: at the nearest map line, plus half their height.

    The line is the nearest in the plane, so where roads cross at different levels it may be of the wrong one. Without a
    map the ground is at 0.
    """
    z = np.where(tracks.valid, _half_heights(tracks), 0.0)
    ground = _samples(features)
    if len(ground):
        from scipy.spatial import KDTree

        _, nearest = KDTree(ground[:, :2]).query(tracks.xy[tracks.valid])
        z[tracks.valid] += ground[nearest, 2]
    return replace(tracks, z=z)


def flatten(tracks: Tracks, features: Sequence[MapFeature]) -> tuple[Tracks, tuple[MapFeature, ...]]:
    """Place agents and map of a source with a 2-D map on the plane z = 0, box centres at half the agent's height."""
    flat = tuple(replace(f, points=np.pad(f.points[:, :2], ((0, 0), (0, 1)))) for f in features)
    return replace(tracks, z=np.where(tracks.valid, _half_heights(tracks), 0.0)), flat


def _half_heights(tracks: Tracks) -> Float[Array, "track time"]:
    """Return half the height of every track at every step; the default of the class where it was not measured."""
    default = np.array([DEFAULT_SIZES[AgentKind(kind)][2] for kind in tracks.kind]).reshape(-1, 1)
    return np.where(tracks.size[..., 2] > 0.0, tracks.size[..., 2], default) / 2


def _samples(features: Sequence[MapFeature]) -> Float[Array, "sample 3"]:
    """Sample all map lines about every ``_SPACING_M``, without the closing edges of polygons."""
    lines = Polylines.of([np.asarray(f.points, np.float64) for f in features if len(f.points)])
    if len(lines.points) == 0:
        return np.zeros((0, 3))
    inner = np.append(lines.row[1:] == lines.row[:-1], False)
    a, b = lines.points[inner], lines.points[np.flatnonzero(inner) + 1]
    length = np.hypot(*(b - a)[:, :2].T)
    pieces = cut_counts(length, max(_SPACING_M, float(length.sum()) / _MOST_SAMPLES))
    return np.concatenate((subdivide(a, b - a, pieces), lines.points[~inner]))


def subdivide(
    start: Float[Array, "segment 3"], step: Float[Array, "segment 3"], counts: Int[Array, " segment"]
) -> Float[Array, "piece 3"]:
    """Cut each segment into ``counts`` equal pieces; return the first point of each piece."""
    segment = np.repeat(np.arange(len(start)), counts)
    piece = np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)
    return start[segment] + (piece / counts[segment])[:, None] * step[segment]
