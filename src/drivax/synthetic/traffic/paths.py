"""The path of a vehicle: a sequence of lanes as one smooth curve, and where on it each lane lies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from drivax.synthetic.roads.curves import STEP_M, Curve, join_curves, resample
from drivax.synthetic.roads.network import RoadNetwork

#: Lanes that a vehicle can be on at once: its own, and those that need the same space at this place.
SLOTS = 3
_NOWHERE = -1
#: Length over which curvature is averaged before it limits the speed, m.
_CURVATURE_WINDOW_M = 3.0


@dataclass(frozen=True)
class LaneSpan:
    """A lane on a path.

    Attributes:
        lane: Its index.
        begin_m: Path position of the lane's start, m; below zero where the path begins inside the lane.
        scale: Path metres per lane metre.
        from_m, until_m: The range of path positions of the driver's centre in which others on this lane matter.
        end_m: Path position of the lane's end, m.
    """

    lane: int
    begin_m: float
    scale: float
    from_m: float = -math.inf
    until_m: float = math.inf
    end_m: float = math.inf

    def stretched(self, by: float) -> LaneSpan:
        """The same on a path that is longer by a factor."""
        begin_m, from_m, until_m, end_m = (
            m * by for m in (self.begin_m, self.from_m, self.until_m, self.end_m)
        )
        return LaneSpan(self.lane, begin_m, self.scale * by, from_m, until_m, end_m)


@dataclass(frozen=True)
class Path:
    """A curve to drive along, sampled every ``STEP_M`` (nearly: equal steps that end at the end).

    Attributes:
        curve: Where the vehicle's centre goes; its heading is the vehicle's.
        step_m: Distance between samples, m.
        curvature: Curvature, 1/m, averaged over 3 m.
        limit_mps: Speed limit of the lane there.
        spans: The lanes in order of travel.
        lane, lane_m: Which lanes the vehicle is on when its centre is at a sample (-1: no more), and where, m.
    """

    curve: Curve
    step_m: float
    curvature: Float64[np.ndarray, " point"]
    limit_mps: Float64[np.ndarray, " point"]
    spans: tuple[LaneSpan, ...]
    lane: Int64[np.ndarray, "point slot"]
    lane_m: Float64[np.ndarray, "point slot"]

    @property
    def length_m(self) -> float:
        """Length, m."""
        return self.step_m * (len(self.curve.xy) - 1)


@dataclass(frozen=True)
class LaneChange:
    """A planned change from one lane to its neighbour, both in sections that run side by side.

    Attributes:
        section: Index in the lane sequence of the lane that is left; the next one in the sequence is adjacent.
        begin_m: Where on that lane the change begins, m.
        length_m: Distance over which it is carried out, m.
    """

    section: int
    begin_m: float
    length_m: float


def onward(network: RoadNetwork, lanes: list[int]) -> list[int]:
    """Return successors that keep a path free of repeated lanes and full roundabout turns."""
    seen = set(lanes)
    return [
        lane
        for lane in network.lanes[lanes[-1]].successors
        if lane not in seen and not seen.issuperset(network.lanes[lane].successors or (-1,))
    ]


def random_lanes(
    network: RoadNetwork, first: int, rng: np.random.Generator, preferred: frozenset[int] = frozenset()
) -> tuple[int, ...]:
    """Draw lanes to the end of the map, uniformly at forks, among preferred successors if there are any."""
    lanes = [first]
    while network.lanes[lanes[-1]].successors:
        options = onward(network, lanes)
        lanes.append(int(rng.choice([lane for lane in options if lane in preferred] or options)))
    return tuple(lanes)


def lane_path(
    network: RoadNetwork, lanes: tuple[int, ...], sway: Sway, change: LaneChange | None = None
) -> Path:
    """The path along a sequence of lanes, each of which follows the one before.

    Args:
        network: The roads.
        lanes: Lane indices in order; with a lane change the lane that is left is followed by its neighbour.
        sway: How the driver strays from the centre.
        change: The lane change, if there is one.
    """
    pieces, spans, at = [], [], 0.0
    for place, lane in enumerate(lanes):
        if change is not None and place == change.section + 1:
            continue
        curve = network.lanes[lane].curve
        if change is not None and place == change.section:
            curve, crossing = _changed(curve, network.lanes[lanes[place + 1]].curve, change)
            length = float(curve.arc_m[-1])
            spans += [
                _span(network, lane, at, length, until_m=at + crossing[1]),
                _span(network, lanes[place + 1], at, length, from_m=at + crossing[0]),
            ]
        else:
            length = network.lanes[lane].length_m
            spans.append(LaneSpan(lane, at, 1.0, end_m=at + length))
        pieces.append(curve)
        at += length
    middle = join_curves(*pieces) if len(pieces) > 1 else pieces[0]
    return _finished(network, resample(sway.applied(middle), STEP_M), at, spans)


def _span(network: RoadNetwork, lane: int, at: float, length: float, **when: float) -> LaneSpan:
    return LaneSpan(lane, at, length / network.lanes[lane].length_m, end_m=at + length, **when)


def _changed(a: Curve, b: Curve, change: LaneChange) -> tuple[Curve, tuple[float, float]]:
    """From curve ``a`` to the parallel ``b`` by a quintic step; also where both lanes begin and cease to matter."""
    count = max(len(a.xy), len(b.xy))
    a, b = (resample(c, float(c.arc_m[-1]) / (count - 1)) for c in (a, b))
    arc = a.arc_m
    t = np.clip((arc - change.begin_m) / change.length_m, 0.0, 1.0)[:, None]
    weight = t**3 * (10 - 15 * t + 6 * t**2)
    xy = a.xy + weight * (b.xy - a.xy)
    rate = np.gradient(xy, axis=0)
    heading = a.heading + _turned(np.arctan2(rate[:, 1], rate[:, 0]) - a.heading)
    # The ends are exactly those of the lanes: a one-sided difference would bend the joint.
    heading[0], heading[-1] = (
        a.heading[0],
        b.heading[-1] + 2 * math.pi * round((a.heading[-1] - b.heading[-1]) / (2 * math.pi)),
    )
    end = change.begin_m + change.length_m
    return Curve(xy, heading), (max(0.0, change.begin_m - 15.0), end - 0.3 * change.length_m)


def _turned(angle: Float64[np.ndarray, " point"]) -> Float64[np.ndarray, " point"]:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _finished(network: RoadNetwork, curve: Curve, length: float, spans: list[LaneSpan]) -> Path:
    """Add curvature, limits and the lane slots; straying makes the curve longer, so spans are stretched."""
    stretch = float(curve.arc_m[-1]) / length
    step = float(curve.arc_m[-1]) / (len(curve.xy) - 1)
    spans = [span.stretched(stretch) for span in spans]
    at = step * np.arange(len(curve.xy))
    lane = np.full((len(at), SLOTS), _NOWHERE)
    lane_m = np.zeros((len(at), SLOTS))
    used = np.zeros(len(at), int)
    limit = np.full(len(at), math.inf)
    for span in spans:
        size = span.scale * network.lanes[span.lane].length_m
        # Samples beyond the last lane's end by rounding still belong to it.
        first, last = np.searchsorted(at, [span.begin_m - 1e-6, span.begin_m + size - 1e-6])
        part = slice(int(first), len(at) if span is spans[-1] else int(last))
        limit[part] = np.minimum(limit[part], network.lanes[span.lane].limit_mps)
        here = at[part]
        inside = (here >= span.from_m) & (here <= span.until_m)
        along = np.maximum(here - span.begin_m, 0.0) / span.scale
        for shared_lane, shared in _sharing(network, span.lane, along):
            chosen = np.flatnonzero(inside & shared & (used[part] < SLOTS))
            slot = used[part][chosen]
            lane[part][chosen, slot] = shared_lane
            lane_m[part][chosen, slot] = along[chosen]
            used[part][chosen] += 1
    return Path(curve, step, smoothed_curvature(curve, step), limit, tuple(spans), lane, lane_m)


def interpolated(
    curve: Curve, arc_m: Float64[np.ndarray, " point"], at_m: Float64[np.ndarray, " n"]
) -> Curve:
    """Interpolate a curve, whose samples lie at ``arc_m``, linearly at positions."""
    xy = np.stack([np.interp(at_m, arc_m, curve.xy[:, k]) for k in (0, 1)], axis=-1)
    return Curve(xy, np.interp(at_m, arc_m, curve.heading))


def smoothed_curvature(curve: Curve, step_m: float) -> Float64[np.ndarray, " point"]:
    """Curvature of an equally sampled curve, 1/m, averaged over 3 m."""
    window = max(1, round(_CURVATURE_WINDOW_M / step_m))
    rate = np.gradient(curve.heading, step_m)
    before, after = window // 2, window - 1 - window // 2
    padded = np.concatenate([np.full(before, rate[0]), rate, np.full(after, rate[-1])])
    return np.convolve(padded, np.full(window, 1.0 / window), mode="valid")


def _sharing(
    network: RoadNetwork, lane: int, along: Float64[np.ndarray, " point"]
) -> list[tuple[int, np.ndarray]]:
    """The lanes that a vehicle on ``lane`` occupies too: those that leave the same lane, while still close."""
    result = [(lane, np.ones(len(along), bool))]
    for before in network.lanes[lane].predecessors:
        for other in network.lanes[before].successors:
            if other != lane:
                # Half a vehicle's length longer: its tail is in the way after its centre has left.
                result.append((other, along < network.shared_m[lane, other] + 2.5))
    return result


@dataclass(frozen=True)
class Sway:
    """How a driver strays from the lane's centre: a few slow waves, m, 1/m and rad."""

    amplitude_m: tuple[float, ...] = ()
    wave_per_m: tuple[float, ...] = ()
    phase: tuple[float, ...] = ()

    @classmethod
    def drawn(cls, rng: np.random.Generator, largest_m: float, aside_m: float = 0.0) -> Sway:
        """Two waves 60 to 160 m long whose amplitudes add up to at most ``largest_m``, about a line aside."""
        share = rng.uniform(0.2, 0.5, size=2) * largest_m
        waves = 2 * math.pi / rng.uniform(60.0, 160.0, size=2)
        phases = rng.uniform(0.0, 2 * math.pi, size=2)
        result = cls(tuple(share.tolist()), tuple(waves.tolist()), tuple(phases.tolist()))
        if not aside_m:
            return result
        # A wave without end is a constant.
        return cls((*result.amplitude_m, aside_m), (*result.wave_per_m, 0.0), (*result.phase, math.pi / 2))

    def applied(self, curve: Curve) -> Curve:
        """The curve that is really driven; its heading is its own tangent (to first order in the straying)."""
        if not self.amplitude_m:
            return curve
        aside, slope = np.zeros((2, len(curve.xy)))
        for amplitude, wave, phase in zip(self.amplitude_m, self.wave_per_m, self.phase, strict=True):
            angle = wave * curve.arc_m + phase
            aside += amplitude * np.sin(angle)
            slope += amplitude * wave * np.cos(angle)
        normal = np.stack([-np.sin(curve.heading), np.cos(curve.heading)], axis=-1)
        stretch = 1.0 - aside * np.gradient(curve.heading, np.maximum(curve.arc_m, 1e-9))
        return Curve(curve.xy + aside[:, None] * normal, curve.heading + np.arctan2(slope, stretch))
