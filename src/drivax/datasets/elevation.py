"""Heights where a source has only half of them: agents without z on a 3-D map, or a flat map under 3-D agents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.geometry.polylines import Polylines, cut_counts
from drivax.scenario.build.tracks import DEFAULT_SIZES
from drivax.scenario.recording import MapFeature, Tracks
from drivax.scenario.schema import AgentKind

Array = np.ndarray[Any, Any]

#: Map lines are sampled at least this densely before the nearest point is looked up, unless that took too many.
SPACING_M = 1.0
MOST_SAMPLES = 1_000_000


def lift(tracks: Tracks, features: Sequence[MapFeature]) -> Tracks:
    """Sets the box centres of agents on the map: height of the nearest map line plus half the agent's height.

    For sources with a 3-D map and agents in the plane. Where roads lie above each other the nearest line in the
    plane decides, which may be of the other level.

    Args:
        tracks: Any tracks; their ``z`` is not used.
        features: The map, 3-D; without any point of a map the ground is at 0.

    Returns:
        The tracks with ``z``, zeros where not valid.
    """
    z = np.where(tracks.valid, _half_heights(tracks), 0.0)
    ground = _samples(features)
    if len(ground):
        from scipy.spatial import KDTree

        _, nearest = KDTree(ground[:, :2]).query(tracks.xy[tracks.valid])
        z[tracks.valid] += ground[nearest, 2]
    return replace(tracks, z=z)


def flatten(tracks: Tracks, features: Sequence[MapFeature]) -> tuple[Tracks, tuple[MapFeature, ...]]:
    """Puts everything on one plane, z = 0: for sources whose map is 2-D, whatever heights their agents have.

    Returns:
        Tracks with box centres at half their height, zeros where not valid, and the features with z = 0.
    """
    flat = tuple(replace(f, points=np.pad(f.points[:, :2], ((0, 0), (0, 1)))) for f in features)
    return replace(tracks, z=np.where(tracks.valid, _half_heights(tracks), 0.0)), flat


def _half_heights(tracks: Tracks) -> Float[Array, "track time"]:
    """Half the height of every track and step; of its class where it was not measured."""
    default = np.array([DEFAULT_SIZES[AgentKind(kind)][2] for kind in tracks.kind]).reshape(-1, 1)
    return np.where(tracks.size[..., 2] > 0.0, tracks.size[..., 2], default) / 2


def _samples(features: Sequence[MapFeature]) -> Float[Array, "sample 3"]:
    """Points of all map lines, about ``SPACING_M`` apart along them; closing edges of polygons are left out."""
    lines = Polylines.of([np.asarray(f.points, np.float64) for f in features if len(f.points)])
    if len(lines.points) == 0:
        return np.zeros((0, 3))
    inner = np.append(lines.row[1:] == lines.row[:-1], False)
    a, b = lines.points[inner], lines.points[np.flatnonzero(inner) + 1]
    length = np.hypot(*(b - a)[:, :2].T)
    pieces = cut_counts(length, max(SPACING_M, float(length.sum()) / MOST_SAMPLES))
    owner = np.repeat(np.arange(len(a)), pieces)
    part = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    between = a[owner] + (part / pieces[owner])[:, None] * (b - a)[owner]
    return np.concatenate((between, lines.points[~inner]))
