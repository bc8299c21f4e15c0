"""The path of a vehicle: a sequence of lanes as one smooth curve, and the position of each lane on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise

import numpy as np
from jaxtyping import Float64, Int32

from drivax.geometry.vectors import wrap
from drivax.synthetic.roads.curves import STEP_M, Curve, interpolate, join_curves, resample, smooth_step
from drivax.synthetic.roads.network import RoadNetwork, per_roads

#: Largest number of lanes that a vehicle occupies: its own, and those that share space with it.
SLOTS = 3
#: Length over which curvature is averaged before it limits the speed, m.
_CURVATURE_WINDOW_M = 3.0

#: Positions of samples; lanes that a vehicle occupies at samples, and positions on them.
_Positions = Float64[np.ndarray, " point"]
_Slots = Int32[np.ndarray, "point slot"]
_SlotPositions = Float64[np.ndarray, "point slot"]


@dataclass(frozen=True)
class LaneSpan:
    """Stretch of a path on a lane.

    Attributes:
        lane: Index of the lane.
        begin_m, end_m: Path positions of the lane's start and end, m; the start may be negative.
        scale: Path metres per lane metre.
        from_m, until_m: Range of positions of the vehicle's centre in which it occupies the lane.
    """

    lane: int
    begin_m: float
    scale: float
    from_m: float = -math.inf
    until_m: float = math.inf
    end_m: float = math.inf

    def stretch(self, factor: float) -> LaneSpan:
        """Return the span on a path that is longer by a factor."""
        begin_m, end_m = self.begin_m * factor, self.end_m * factor
        limits_m = self.from_m * factor, self.until_m * factor
        return LaneSpan(self.lane, begin_m, self.scale * factor, *limits_m, end_m)


@dataclass(frozen=True)
class Path:
    """A curve to drive along, sampled at equal steps of about ``STEP_M``.

    Attributes:
        curve: Pose of the vehicle's centre.
        step_m: Distance between samples, m.
        curvature: Curvature, 1/m, averaged over 3 m.
        limit_mps: Speed limit.
        spans: The lanes in order of travel.
        lane, lane_m: Lanes that the vehicle occupies with its centre at a sample (-1: none), and positions on them, m.
    """

    curve: Curve
    step_m: float
    curvature: Float64[np.ndarray, " point"]
    limit_mps: Float64[np.ndarray, " point"]
    spans: tuple[LaneSpan, ...]
    lane: Int32[np.ndarray, "point slot"]
    lane_m: Float64[np.ndarray, "point slot"]

    @property
    def length_m(self) -> float:
        """Length of the curve."""
        return self.step_m * (len(self.curve.xy) - 1)

    @cached_property
    def profiles(self) -> dict[tuple[float, ...], Float64[np.ndarray, " point"]]:
        """Cache of speed profiles by properties of the driver."""
        return {}


@dataclass(frozen=True)
class LaneChange:
    """A planned change between adjacent lanes of a sequence.

    Attributes:
        section: Index of the old lane in the sequence; the new one follows.
        begin_m, length_m: Position on the old lane, and length of the change.
    """

    section: int
    begin_m: float
    length_m: float


def next_lanes(network: RoadNetwork, lanes: list[int]) -> list[int]:
    """Return successors that keep a path free of repeated lanes and full roundabout turns."""
    visited = set(lanes)
    return [
        lane
        for lane in network.lanes[lanes[-1]].successors
        if lane not in visited and not visited.issuperset(network.lanes[lane].successors or (-1,))
    ]


def random_lanes(
    network: RoadNetwork, first: int, rng: np.random.Generator, preferred: frozenset[int] = frozenset()
) -> tuple[int, ...]:
    """Draw lanes to the end of the map, uniformly at forks, among preferred successors if there are any."""
    lanes = [first]
    while network.lanes[lanes[-1]].successors:
        options = next_lanes(network, lanes)
        options = [lane for lane in options if lane in preferred] or options
        # The same draw as rng.choice, several times as fast.
        lanes.append(options[int(rng.integers(len(options)))])
    return tuple(lanes)


def lane_path(
    network: RoadNetwork, lanes: tuple[int, ...], sway: Sway, change: LaneChange | None = None
) -> Path:
    """Build the path along consecutive lanes; with a lane change the new lane comes after the old one."""
    if change is not None:
        return _lane_change_path(network, lanes, sway, change)
    ends = accumulate((network.lanes[lane].length_m for lane in lanes), initial=0.0)
    spans = [LaneSpan(lane, a, 1.0, end_m=b) for lane, (a, b) in zip(lanes, pairwise(ends), strict=True)]
    return _build_path(network, sway.apply(_lane_curve(network, lanes)), spans[-1].end_m, spans)


def _lane_change_path(network: RoadNetwork, lanes: tuple[int, ...], sway: Sway, change: LaneChange) -> Path:
    """Build the path along consecutive lanes with a lane change."""
    pieces, spans, position = [], [], 0.0
    for index, lane in enumerate(lanes):
        if index == change.section + 1:
            continue
        curve = network.lanes[lane].curve
        if index == change.section:
            new_lane = lanes[index + 1]
            curve, (entry_m, exit_m) = _lane_change_curve(curve, network.lanes[new_lane].curve, change)
            length = float(curve.arc_m[-1])
            spans += [
                _span(network, lane, position, length, until_m=position + exit_m),
                _span(network, new_lane, position, length, from_m=position + entry_m),
            ]
        else:
            length = network.lanes[lane].length_m
            spans.append(LaneSpan(lane, position, 1.0, end_m=position + length))
        pieces.append(curve)
        position += length
    return _build_path(network, sway.apply(join_curves(*pieces)), position, spans)


def _lane_curve(network: RoadNetwork, lanes: tuple[int, ...]) -> Curve:
    """Return the centre of consecutive lanes; vehicles that take the same lanes share it."""
    curves = _lane_curves(network)
    if lanes not in curves:
        curves[lanes] = join_curves(*(network.lanes[lane].curve for lane in lanes))
    return curves[lanes]


@per_roads
def _lane_curves(network: RoadNetwork) -> dict[tuple[int, ...], Curve]:
    """Cache of :func:`_lane_curve`."""
    return {}


def _span(network: RoadNetwork, lane: int, begin_m: float, length_m: float, **limits_m: float) -> LaneSpan:
    """Return the span of a lane that is stretched to a length."""
    scale = length_m / network.lanes[lane].length_m
    return LaneSpan(lane, begin_m, scale, end_m=begin_m + length_m, **limits_m)


def _lane_change_curve(a: Curve, b: Curve, change: LaneChange) -> tuple[Curve, tuple[float, float]]:
    """Change from curve ``a`` to the parallel ``b``.

    Returns:
        The curve, and the positions on it of the entry to the new lane and of the exit from the old one, m.
    """
    count = max(len(a.xy), len(b.xy))
    a, b = (resample(c, float(c.arc_m[-1]) / (count - 1)) for c in (a, b))
    arc = a.arc_m
    weight = smooth_step((arc - change.begin_m) / change.length_m)[:, None]
    xy = a.xy + weight * (b.xy - a.xy)
    rate = np.gradient(xy, axis=0)
    heading = a.heading + wrap(np.arctan2(rate[:, 1], rate[:, 0]) - a.heading)
    # The ends are exactly those of the lanes: a one-sided difference would bend the joint.
    whole_turns = round((a.heading[-1] - b.heading[-1]) / (2 * math.pi))
    heading[0], heading[-1] = a.heading[0], b.heading[-1] + 2 * math.pi * whole_turns
    end = change.begin_m + change.length_m
    # The vehicle occupies the new lane from 15 m before the change on, and the old one for 70 % of the change.
    return Curve(xy, heading), (max(0.0, change.begin_m - 15.0), end - 0.3 * change.length_m)


def _build_path(network: RoadNetwork, curve: Curve, length_m: float, spans: list[LaneSpan]) -> Path:
    """Resample a curve and add curvature, limits and lanes; spans of total length ``length_m`` are stretched to it."""
    curve = resample(curve, STEP_M)
    stretch = float(curve.arc_m[-1]) / length_m
    step = float(curve.arc_m[-1]) / (len(curve.xy) - 1)
    spans = [span.stretch(stretch) for span in spans]
    position = step * np.arange(len(curve.xy))
    lane, lane_m = np.full((len(position), SLOTS), -1, np.int32), np.zeros((len(position), SLOTS))
    limit = np.full(len(position), math.inf)
    lengths = [span.scale * network.lanes[span.lane].length_m for span in spans]
    begins = position.searchsorted([span.begin_m - 1e-6 for span in spans]).tolist()
    ends = position.searchsorted([s.begin_m + m - 1e-6 for s, m in zip(spans, lengths, strict=True)])
    # Samples beyond the last lane's end by rounding still belong to it.
    ends[-1] = len(position)
    shared, end = _shared_lanes(network), 0
    for span, first, last in zip(spans, begins, ends.tolist(), strict=True):
        samples = slice(first, last)
        np.minimum(limit[samples], network.lanes[span.lane].limit_mps, out=limit[samples])
        current = position[samples]
        along = np.maximum(current - span.begin_m, 0.0) / span.scale
        is_limited = span.from_m > -math.inf or span.until_m < math.inf
        if is_limited:
            along[(current < span.from_m) | (current > span.until_m)] = math.inf
        for shared_lane, until_m in shared[span.lane]:
            if until_m == math.inf and first >= end and not is_limited:
                lane[samples, 0], lane_m[samples, 0] = shared_lane, along
            else:
                # Positions along the lane increase unless the span is limited.
                count = len(along) if is_limited else int(along.searchsorted(until_m))
                shared_samples = slice(first, first + count)
                _occupy(lane[shared_samples], lane_m[shared_samples], shared_lane, along[:count], until_m)
        end = max(end, last)
    return Path(curve, step, mean_curvature(curve, step), limit, tuple(spans), lane, lane_m)


def _occupy(lane: _Slots, lane_m: _SlotPositions, number: int, along: _Positions, until_m: float) -> None:
    """Enter a lane into the first free slot of the samples whose position on it is less than ``until_m``."""
    used = (lane >= 0).sum(axis=1)
    samples = ((along < until_m) & (used < SLOTS)).nonzero()[0]
    lane[samples, used[samples]], lane_m[samples, used[samples]] = number, along[samples]


def interpolate_curve(
    curve: Curve, arc_m: Float64[np.ndarray, " point"], at_m: Float64[np.ndarray, " n"]
) -> Curve:
    """Interpolate a curve whose samples lie at ``arc_m`` linearly at positions ``at_m``."""
    return Curve(interpolate(at_m, arc_m, curve.xy), np.interp(at_m, arc_m, curve.heading))


def mean_curvature(curve: Curve, step_m: float) -> Float64[np.ndarray, " point"]:
    """Curvature of an equally sampled curve, 1/m, averaged over 3 m."""
    window = max(1, round(_CURVATURE_WINDOW_M / step_m))
    before, heading = window // 2, curve.heading
    padded = np.empty(len(heading) + window - 1)
    # The differences of np.gradient, without its checks.
    rate = padded[before : before + len(heading)]
    np.divide(heading[2:] - heading[:-2], 2.0 * step_m, out=rate[1:-1])
    padded[: before + 1] = (heading[1] - heading[0]) / step_m
    padded[before + len(heading) - 1 :] = (heading[-1] - heading[-2]) / step_m
    return np.convolve(padded, np.full(window, 1.0 / window), mode="valid")


@per_roads
def _shared_lanes(network: RoadNetwork) -> list[list[tuple[int, float]]]:
    """List the lanes that a vehicle on each lane occupies, and the positions up to which it does, m.

    These are the lane itself and those that branch off the same predecessor.
    """
    result = [[(lane, math.inf)] for lane in range(len(network.lanes))]
    for lane, shared in enumerate(result):
        for before in network.lanes[lane].predecessors:
            for other in network.lanes[before].successors:
                if other != lane:
                    # The rear of a car of 5 m leaves 2.5 m later than its centre.
                    shared.append((other, network.shared_m[lane, other] + 2.5))
    return result


@dataclass(frozen=True)
class Sway:
    """Lateral deviation of a driver from the lane's centre, a sum of sine waves along the path."""

    amplitude_m: tuple[float, ...] = ()
    wave_per_m: tuple[float, ...] = ()
    phase: tuple[float, ...] = ()

    @classmethod
    def draw(cls, rng: np.random.Generator, largest_m: float, aside_m: float = 0.0) -> Sway:
        """Draw two waves 60 to 160 m long, whose amplitudes add up to at most ``largest_m``, and add an offset."""
        amplitude = rng.uniform(0.2, 0.5, size=2) * largest_m
        wave = 2 * math.pi / rng.uniform(60.0, 160.0, size=2)
        phase = rng.uniform(0.0, 2 * math.pi, size=2)
        # A sine of wave number 0 is a constant.
        constant = ((aside_m,), (0.0,), (math.pi / 2,)) if aside_m else ((), (), ())
        waves = (amplitude.tolist(), wave.tolist(), phase.tolist())
        return cls(*((*values, *last) for values, last in zip(waves, constant, strict=True)))

    def apply(self, curve: Curve) -> Curve:
        """Return the curve with the deviation; its heading is its tangent (to first order in the deviation)."""
        if not self.amplitude_m:
            return curve
        amplitude, wave, phase = np.array([self.amplitude_m, self.wave_per_m, self.phase])[..., None]
        angle = wave * curve.arc_m + phase
        lateral = (amplitude * np.sin(angle)).sum(axis=0)
        slope = (amplitude * wave * np.cos(angle)).sum(axis=0)
        stretch = 1.0 - lateral * curve.bend
        return Curve(curve.xy + lateral[:, None] * curve.normal, curve.heading + np.arctan2(slope, stretch))
