"""Visibility of other users from ego, and measurement noise of recorded tracks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.errors import UsageError
from drivax.geometry.boxes import LENGTH, WIDTH, corners, passage
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import Tracks
from drivax.scenario.schema import AgentKind, nonzero

#: Speed below which noise decreases, m/s, and share of the noise that remains at standstill.
_FULL_NOISE_MPS, _STANDING_SHARE = 2.0, 0.25
#: Limit of errors in standard deviations: noise must not make a user overlap ego.
_MAX_SIGMA = 3.0
#: Lines of sight per batch.
_BATCH_SIZE = 512


def _check_numbers(section: str, settings: Any) -> None:
    for name, value in vars(settings).items():
        if not 0.0 <= value < math.inf:
            raise UsageError(f"{section}.{name} is {value}", cure="use a finite number that is not negative")


@dataclass(frozen=True)
class SensorConfig:
    """A sensor on the middle of ego's roof that looks in all directions.

    Attributes:
        range_m: Largest distance to the centre of a visible box.
        above_roof_m: Height above the roof.
    """

    range_m: float = 80.0
    above_roof_m: float = 0.2

    def check(self) -> None:
        """Raise a UsageError for the first invalid setting."""
        _check_numbers("sensor", self)


@dataclass(frozen=True)
class NoiseConfig:
    """Errors of recorded poses and speeds of all users but ego: standard deviations, and correlations over one step.

    Deviations hold from 2 m/s on; slower users have smaller errors. The defaults are the level of vehicle tracks in
    WOMD recordings, measured by ``experiments/world/perception_noise.py``.

    Attributes:
        level: Factor on all standard deviations; 0 switches noise off.
        along_m, across_m: Position along and across the heading.
        heading_rad: Heading.
        speed_mps: Speed along the heading.
        position_correlation, heading_correlation, speed_correlation: Correlations of an error with that 0.1 s before.
    """

    level: float = 1.0
    along_m: float = 0.020
    across_m: float = 0.007
    heading_rad: float = 0.002
    speed_mps: float = 0.2
    position_correlation: float = 0.4
    heading_correlation: float = 0.2
    speed_correlation: float = 0.0

    def check(self) -> None:
        """Raise a UsageError for the first invalid setting."""
        _check_numbers("noise", self)
        for name, value in vars(self).items():
            if name.endswith("_correlation") and value >= 1.0:
                raise UsageError(f"noise.{name} is {value}", cure="use a number from 0 to below 1")


_Boxes = Float64[np.ndarray, "user time 6"]
_PerUser = Float64[np.ndarray, " user"]
_Visible = Bool[np.ndarray, "user time"]
_Rays = Int64[np.ndarray, " ray"]
_Pairs = Int64[np.ndarray, " pair"]


def sight(tracks: Tracks, ego: int, config: SensorConfig) -> Bool[np.ndarray, "track time"]:
    """Return the visibility mask of tracks (:func:`find_visible`); vehicles occlude other users."""
    order = np.concatenate(([ego], np.delete(np.arange(len(tracks.kind)), ego)))
    heading, size = tracks.heading[order], tracks.size[order]
    box = np.concatenate(
        [tracks.xy[order], np.cos(heading)[..., None], np.sin(heading)[..., None], size[..., :2]], axis=-1
    )
    blocks = tracks.kind[order] == AgentKind.VEHICLE
    is_visible = np.empty(tracks.valid.shape, bool)
    is_visible[order] = find_visible(box, size[..., 2].max(axis=1), tracks.valid[order], blocks, config)
    return is_visible


def find_visible(
    box: _Boxes, height_m: _PerUser, valid: _Visible, blocks: Bool[np.ndarray, " user"], config: SensorConfig
) -> _Visible:
    """Mask of users in the sensor's range with a clear line of sight to the centre or a corner; ego sees itself.

    A ray from the sensor to half the height of a user is blocked by every other box that it does not pass above.

    ``box`` holds the boxes of all users (:mod:`drivax.geometry.boxes`), ego first; ``blocks`` is a mask of those that
    occlude others.
    """
    offset = box[..., :2] - box[:1, :, :2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    in_range = valid & valid[:1] & (distance <= config.range_m)
    in_range[0] = False
    target, step = nonzero(in_range)
    is_visible = np.zeros(valid.shape, bool)
    is_visible[0] = valid[0]
    if not len(target):
        return is_visible
    points = np.concatenate((corners(box[target, step]), box[target, step, None, :2]), axis=1)
    is_hidden = np.zeros(points.shape[:2], bool)
    ray, occluder = _occluders(box, valid & blocks[:, None], target, step)
    eye = height_m[0] + config.above_roof_m
    heights, steps = (eye, height_m[target[ray]] / 2), step[ray]
    is_cut = _cuts(box[0, steps, :2], points[ray], heights, box[occluder, steps], height_m[occluder])
    np.logical_or.at(is_hidden, ray, is_cut)
    is_visible[target, step] = ~is_hidden.all(axis=1)
    return is_visible


def _occluders(box: _Boxes, blocking: _Visible, target: _Rays, step: _Rays) -> tuple[_Pairs, _Pairs]:
    """Return pairs of an index into ``target`` and a user whose circumscribed circle may cut a ray to the target."""
    offset = box[..., :2] - box[:1, :, :2]
    x, y = (np.ascontiguousarray(offset[..., k]) for k in (0, 1))
    ray_x, ray_y = x[target, step], y[target, step]
    length = np.maximum(np.hypot(ray_x, ray_y), 1e-9)
    ray_x, ray_y = ray_x / length, ray_y / length
    radius = np.hypot(box[..., LENGTH], box[..., WIDTH]).max(axis=1) / 2
    # Users far from all rays cannot occlude.
    farthest = length.max() + 2.0 * (radius.max() + radius)
    is_near = (blocking & (x**2 + y**2 < farthest[:, None] ** 2)).any(axis=1)
    is_near[0] = False
    near_rows = np.flatnonzero(is_near)
    pairs = []
    # Batches keep the arrays in the processor's cache.
    for first in range(0, len(target), _BATCH_SIZE):
        batch = slice(first, first + _BATCH_SIZE)
        steps, targets, cos, sin = step[batch], target[batch], ray_x[batch], ray_y[batch]
        dx, lateral = x[near_rows].take(steps, axis=1), y[near_rows].take(steps, axis=1)
        ahead = dx * cos + lateral * sin
        lateral *= cos
        dx *= sin
        lateral -= dx
        reach = radius[near_rows, None] + radius[targets]
        may_cut = blocking[near_rows].take(steps, axis=1) & (np.abs(lateral, out=lateral) < reach)
        may_cut &= ahead > -radius[near_rows, None]
        reach += length[batch]
        may_cut &= ahead < reach
        may_cut &= near_rows[:, None] != targets
        occluder, ray = nonzero(may_cut)
        pairs.append((ray + first, near_rows[occluder]))
    ray, occluder = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return ray, occluder


def _cuts(
    eye: Float64[np.ndarray, "pair 2"], points: Float64[np.ndarray, "pair point 2"],
    heights_m: tuple[float, Float64[np.ndarray, " pair"]], box: Float64[np.ndarray, "pair 6"],
    top_m: Float64[np.ndarray, " pair"],
) -> Bool[np.ndarray, "pair point"]:  # fmt: skip
    """Mask of rays from an eye to points, at two heights, that pass through upright boxes (slab test)."""
    enters, leaves = passage(eye[:, None], points, box[:, None])
    high, low = heights_m[0], heights_m[1][:, None]
    lowest = np.minimum(high + (low - high) * enters, high + (low - high) * leaves)
    return (enters < leaves) & (lowest < top_m[:, None])


def largest_shift_m(config: NoiseConfig, length_m: float, width_m: float) -> float:
    """Return the largest shift of a box corner by :func:`add_perception_noise`, m (for small heading errors)."""
    maximum = _MAX_SIGMA * config.level
    turn = maximum * config.heading_rad
    along = maximum * config.along_m + turn * width_m / 2
    return float(np.hypot(along, maximum * config.across_m + turn * length_m / 2))


def add_perception_noise(tracks: Tracks, ego: int, rng: np.random.Generator, config: NoiseConfig) -> Tracks:
    """Add perception noise to all tracks but ego's.

    Errors are zero-mean AR(1) processes, clipped at three standard deviations. Below 2 m/s they shrink linearly, to a
    quarter at standstill; standing users keep speed 0. Sizes are exact.
    """
    cos, sin = np.cos(tracks.heading), np.sin(tracks.heading)
    speed = tracks.velocity[..., 0] * cos + tracks.velocity[..., 1] * sin
    share = np.clip(np.abs(speed) / _FULL_NOISE_MPS, 0.0, 1.0)
    share = (_STANDING_SHARE + (1.0 - _STANDING_SHARE) * share) * tracks.valid
    share[ego] = 0.0
    deviations = (config.along_m, config.across_m, config.heading_rad, config.speed_mps)
    correlations = (config.position_correlation,) * 2 + (config.heading_correlation, config.speed_correlation)
    along, across, turn, speed_error = (
        config.level * sigma * share * jitter
        for sigma, jitter in zip(deviations, _jitter(tracks.valid.shape, correlations, rng), strict=True)
    )
    heading = np.where(tracks.valid, wrap(tracks.heading + turn), 0.0)
    # Standing users stay at speed 0, and moving ones do not reverse.
    speed = np.sign(speed) * np.maximum(np.abs(speed) + np.where(np.abs(speed) > 0.0, speed_error, 0.0), 0.0)
    velocity = speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    heading[ego], velocity[ego] = tracks.heading[ego], tracks.velocity[ego]
    return replace(
        tracks,
        xy=tracks.xy + np.stack([along * cos - across * sin, along * sin + across * cos], axis=-1),
        heading=heading,
        velocity=velocity,
    )


def _jitter(
    shape: tuple[int, ...], correlations: tuple[float, ...], rng: np.random.Generator
) -> Float64[np.ndarray, "correlation track time"]:
    """Draw unit-variance AR(1) noise x(t+1) = c x(t) + sqrt(1 - c^2) e(t), stationary from the first step on."""
    noise = np.ascontiguousarray(np.moveaxis(rng.normal(size=(len(correlations), *shape)), -1, 0))
    noise[1:] *= np.array([math.sqrt(1.0 - c**2) for c in correlations])[:, None]
    factor = np.array(correlations)[:, None]
    # scipy.signal computes the same, but takes longer to import than to generate several scenarios.
    for before, now in pairwise(noise):
        now += factor * before
    return np.clip(np.ascontiguousarray(np.moveaxis(noise, 0, -1)), -_MAX_SIGMA, _MAX_SIGMA)
