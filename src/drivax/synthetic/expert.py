"""The expert who drives ego: the same stack as everyone, driven smoothly, and judged before it is accepted."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from drivax.geometry.boxes import corners, overlap
from drivax.synthetic.drivers import Drivers
from drivax.synthetic.paths import LaneChange, Path, Sway, lane_path, random_lanes
from drivax.synthetic.roads import RoadNetwork
from drivax.synthetic.signals import Colour

#: Added to ego's length and width before overlap is tested, m: replay in float32 must not touch either.
_SKIN_M = 0.2
#: Experts that brake harder than this are not shown, m/s2: comfort (-4.05) in common driving, the end of the
#: common law's range where an event leaves no choice.
HARDEST_MPS2, HARDEST_IN_EVENT_MPS2 = 4.0, 6.0


def drawn_expert(rng: np.random.Generator) -> Drivers:
    """Draws ego's car and its driver: never above the limit, and well inside the limits of comfort."""

    def one(low: float, high: float) -> Float64[np.ndarray, " 1"]:
        return rng.uniform(low, high, size=1)

    size = np.array([[rng.uniform(4.5, 5.0), rng.uniform(1.85, 2.05), rng.uniform(1.5, 1.8)]])
    return Drivers(
        size_m=size,
        speed_factor=one(0.85, 0.98),
        lateral_mps2=one(1.8, 2.4),
        slowing_mps2=one(1.1, 1.5),
        yellow_mps2=one(2.2, 2.6),
        jerk_mps3=one(2.0, 2.6),
        headway_s=one(1.3, 1.8),
        acceleration_mps2=one(1.3, 1.8),
        braking_mps2=one(1.8, 2.2),
    )


def expert_lanes(
    network: RoadNetwork, lane: int, change_share: float, rng: np.random.Generator
) -> tuple[tuple[int, ...], LaneChange | None]:
    """Draws ego's lanes from the lane on which it begins, and sometimes a lane change on the third or fourth lane.

    The lane before the first one is part of the way, so that a route has room behind ego.
    """
    lanes = random_lanes(network, lane, rng)
    before = network.lanes[lane].predecessors
    if before:
        lanes = (before[0], *lanes)
    sections = [k for k in range(2, min(4, len(lanes))) if _neighbours(network, lanes[k])]
    if not sections or rng.random() >= change_share:
        return lanes, None
    section = int(rng.choice(sections))
    beside = int(rng.choice(_neighbours(network, lanes[section])))
    change = LaneChange(section, float(rng.uniform(1.0, 12.0)), float(rng.uniform(52.0, 64.0)))
    return (*lanes[: section + 1], *random_lanes(network, beside, rng)), change


def _neighbours(network: RoadNetwork, lane: int) -> list[int]:
    """Lanes beside this one that are about as long and long enough to change to."""
    this = network.lanes[lane]
    beside = [other for other in (this.left, this.right) if other >= 0]
    return [] if this.connector or not 70.0 < this.length_m < 100.0 else beside


def expert_path(
    network: RoadNetwork, lanes: tuple[int, ...], change: LaneChange | None, rng: np.random.Generator
) -> Path:
    """Ego's path: close to the centre of its lanes."""
    return lane_path(network, lanes, Sway.drawn(rng, 0.12), change)


def boxes(
    xy: Float64[np.ndarray, "*n 2"], heading: Float64[np.ndarray, "*n"], size: Float64[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 6"]:
    """Boxes in the order of :mod:`drivax.geometry.boxes`."""
    return np.concatenate(
        [xy, np.cos(heading)[..., None], np.sin(heading)[..., None], size[..., :2]], axis=-1
    )


def touching(
    box: Float64[np.ndarray, "vehicle time 6"], valid: Bool[np.ndarray, "vehicle time"]
) -> Bool[np.ndarray, "vehicle vehicle"]:
    """Which pairs of vehicles ever overlap; row 0 (ego) is tested with a skin of 10 cm around it."""
    box = box.copy()
    box[0, :, 4:] += _SKIN_M
    one, other = np.triu_indices(len(box), 1)
    reach = np.hypot(box[:, 0, 4], box[:, 0, 5]) / 2
    gap = np.hypot(*np.moveaxis(box[one, :, :2] - box[other, :, :2], -1, 0))
    pair, time = np.nonzero((gap < (reach[one] + reach[other])[:, None]) & valid[one] & valid[other])
    hit = overlap(box[one[pair], time], box[other[pair], time])
    result = np.zeros((len(box), len(box)), bool)
    result[one[pair[hit]], other[pair[hit]]] = True
    return result | result.T


def inside(
    points: Float64[np.ndarray, "point 2"], rings: tuple[Float64[np.ndarray, "_ 2"], ...]
) -> Bool[np.ndarray, " point"]:
    """Whether points lie in the area that closed rings bound, islands left out (even-odd rule, exact)."""
    crossings = np.zeros(len(points), int)
    x, y = points[:, 0, None], points[:, 1, None]
    for ring in rings:
        a, b = ring, np.roll(ring, -1, axis=0)
        near = (np.minimum(a, b) <= points.max(axis=0)) & (np.maximum(a, b) >= points.min(axis=0))
        # A ray to the right meets only sides at the points' heights that do not end left of them all.
        keep = near[:, 1] & (np.maximum(a, b)[:, 0] >= points[:, 0].min())
        (ax, ay), (bx, by) = a[keep].T, b[keep].T
        across = (ay > y) != (by > y)
        side = (bx - ax) * (y - ay) - (x - ax) * (by - ay)
        crossings += np.sum(across & ((side > 0) == (by > ay)), axis=1)
    return crossings % 2 == 1


def leaves_road(network: RoadNetwork, box: Float64[np.ndarray, "time 6"]) -> bool:
    """Whether a corner of the box is ever outside the edges."""
    points = corners(box).reshape(-1, 2)
    return not bool(inside(points, tuple(edge.xy for edge in network.edges)).all())


def runs_red(
    network: RoadNetwork,
    path: Path,
    front_m: Float64[np.ndarray, " time"],
    times_s: Float64[np.ndarray, " time"],
) -> bool:
    """Whether the front bumper passes a stop line while its light is red before and after."""
    if network.signals is None:
        return False
    colour, _ = network.signals.colours(times_s, len(network.lanes))
    for span in path.spans:
        if network.lanes[span.lane].connector:
            red = colour[:, span.lane] == Colour.RED
            passed = (front_m[:-1] <= span.begin_m) & (front_m[1:] > span.begin_m)
            if bool(np.any(passed & red[:-1] & red[1:])):
                return True
    return False
