"""Candidate paths for ego: its own path, or a shifted one that passes an obstacle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from drivax.geometry.boxes import corners
from drivax.geometry.vectors import wrap
from drivax.synthetic.roads.curves import Curve, Pose
from drivax.synthetic.traffic.drivers import Drivers
from drivax.synthetic.traffic.lateral import located, quintic_step
from drivax.synthetic.traffic.path_arrays import speed_profile
from drivax.synthetic.traffic.paths import Path, smoothed_curvature

#: Distance between the samples of a path, m.
SPACING_M = 0.5
#: Lateral acceleration and yaw rate beyond which no plan goes: nuPlan's limits of comfort with a reserve.
_LATERAL_MPS2, _YAW_RATE_RPS = 4.2, 0.8
#: A difference from the path at the beginning is driven off over this distance, m.
_RETURN_M = 30.0


@dataclass(frozen=True)
class Shift:
    """Lateral offset with quintic transitions.

    Attributes:
        aside_m: How far to the left (right where negative).
        begin_m, there_m: From where to where the way out takes, m ahead of ego.
        back_m, end_m: The same of the way back.
    """

    aside_m: float = 0.0
    begin_m: float = 0.0
    there_m: float = 1.0
    back_m: float = 2.0
    end_m: float = 3.0


@dataclass(frozen=True)
class CandidatePath:
    """A curve that begins at ego's centre.

    Attributes:
        xy, heading: Samples every ``SPACING_M``.
        base_m: Position of each sample along the original path, m ahead of ego.
        preferred_mps: The speed that the driver likes.
        limit_mps: The speed that bends allow at most.
    """

    xy: Float64[np.ndarray, "point 2"]
    heading: Float64[np.ndarray, " point"]
    base_m: Float64[np.ndarray, " point"]
    preferred_mps: Float64[np.ndarray, " point"]
    limit_mps: Float64[np.ndarray, " point"]
    shift: Shift = Shift()

    @property
    def length_m(self) -> float:
        """Length, m."""
        return SPACING_M * (len(self.xy) - 1)

    @property
    def arc_m(self) -> Float64[np.ndarray, " point"]:
        """Distance of each sample from ego, m."""
        return SPACING_M * np.arange(len(self.xy))

    def pose(
        self, at_m: Float64[np.ndarray, " n"]
    ) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, " n"]]:
        """Position and heading at distances from ego."""
        arc = self.arc_m
        xy = np.stack([np.interp(at_m, arc, self.xy[:, k]) for k in (0, 1)], axis=-1)
        return xy, np.interp(at_m, arc, self.heading)


def shifted_path(
    path: Path, drivers: Drivers, pose: Pose, span_m: tuple[float, float], shift: Shift
) -> CandidatePath:
    """Return a path that leaves the original one and returns to it.

    Args:
        path: Ego's path.
        drivers: Row 0 is ego's driver.
        pose: Where ego is now.
        span_m: About where on the path ego is, and how far the path reaches, m; it ends where the path does.
        shift: How it leaves the path.
    """
    begin, left, direction = located(path, np.array([pose.x, pose.y]), span_m[0])
    ahead = np.arange(0.0, min(span_m[1], path.length_m - begin - 1e-6), SPACING_M)
    grid = path.step_m * np.arange(len(path.curve.xy))
    base = np.stack([np.interp(begin + ahead, grid, path.curve.xy[:, k]) for k in (0, 1)], axis=-1)
    heading = np.interp(begin + ahead, grid, path.curve.heading)
    aside = quintic_step(ahead, (0.0, left, math.tan(wrap(pose.heading - direction))), _RETURN_M)
    there, back = shift.there_m - shift.begin_m, shift.end_m - shift.back_m
    aside += shift.aside_m * quintic_step(ahead, (shift.back_m, 1.0, 0.0), back)
    aside -= shift.aside_m * quintic_step(ahead, (shift.begin_m, 1.0, 0.0), there)
    normal = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    stretch = np.maximum(1.0 - aside * np.interp(begin + ahead, grid, path.curvature), 0.2)
    curve = Curve(
        base + aside[:, None] * normal, heading + np.arctan2(np.gradient(aside, SPACING_M), stretch)
    )
    arc = curve.arc_m
    at = np.arange(0.0, float(arc[-1]), SPACING_M)
    xy = np.stack([np.interp(at, arc, curve.xy[:, k]) for k in (0, 1)], axis=-1)
    driven = Curve(xy, np.interp(at, arc, curve.heading))
    base_m = np.interp(at, arc, ahead)
    return _with_speeds(path, drivers, driven, (begin, base_m), shift)


def _with_speeds(
    path: Path,
    drivers: Drivers,
    curve: Curve,
    base_m: tuple[float, Float64[np.ndarray, " point"]],
    shift: Shift,
) -> CandidatePath:
    """Add the speeds that limits and bends allow."""
    curvature = smoothed_curvature(curve, SPACING_M)
    grid = path.step_m * np.arange(len(path.curve.xy))
    limit = np.interp(base_m[0] + base_m[1], grid, path.limit_mps)
    none = np.full((len(limit), 1), -1)
    driver = drivers.speed_factor[0], drivers.lateral_mps2[0], drivers.slowing_mps2[0]
    driven = Path(curve, SPACING_M, curvature, limit, (), none, np.zeros((len(limit), 1)))
    fastest = speed_profile(driven, *map(float, driver))
    bend = np.maximum(np.abs(curvature), 1e-6)
    bound = np.minimum(np.sqrt(_LATERAL_MPS2 / bend), _YAW_RATE_RPS / bend)
    return CandidatePath(curve.xy, curve.heading, base_m[1], fastest, bound, shift)


def candidate_boxes(
    candidate: CandidatePath, size_m: Float64[np.ndarray, " 3"], every: int = 1
) -> Float64[np.ndarray, "point 6"]:
    """Return ego's box at the samples of a path."""
    heading = candidate.heading[::every]
    size = np.broadcast_to(size_m[:2], (len(heading), 2))
    return np.concatenate(
        [candidate.xy[::every], np.cos(heading)[:, None], np.sin(heading)[:, None], size], axis=-1
    )


def candidate_corners(
    candidate: CandidatePath, size_m: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, "corner 2"]:
    """Return corners of ego's box every metre where a candidate leaves the original path."""
    away = (candidate.base_m >= candidate.shift.begin_m - 2.0) & (
        candidate.base_m <= candidate.shift.end_m + 2.0
    )
    return corners(candidate_boxes(candidate, size_m)[away][::2]).reshape(-1, 2)
