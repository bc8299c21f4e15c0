"""Ways around things that stand in a lane: out of the lane's centre, past them, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from drivax.geometry.vectors import wrap
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.lateral import Occupied, around
from drivax.synthetic.traffic.obstacles import Boxes, Extents, extents
from drivax.synthetic.traffic.path_arrays import PathTables
from drivax.synthetic.traffic.paths import Path

#: Drivers begin to look for a way around this far before a thing, m; they pass it with this room, m.
LOOK_M, _ROOM_M = 45.0, 0.55
#: What comes so near to the side of a vehicle on its path is in its way, m.
DETOUR_MARGIN_M = 0.3
#: Nobody swings out further than this, m, nor more steeply than one metre in this many.
_FURTHEST_M, _STEEPEST = 4.3, 2.2
#: So far ahead a swerver takes up the lanes beside, m.
_BESIDE_M = 60.0
#: Room kept to the road's edge, m, and speed at which things are passed, m/s.
_EDGE_M, _PASS_MPS = 0.2, 6.0


@dataclass(frozen=True)
class Swerver:
    """Who wants to pass: where it is on its path, how fast, how long and how wide, and lanes of its direction."""

    path: Path
    at_m: float
    speed: float
    size_m: tuple[float, float]
    beside: tuple[Occupied, ...] = ()


def swerver(
    network: RoadNetwork, tables: PathTables, row: int, now: tuple[float, float], size_m: tuple[float, float]
) -> Swerver:
    """A vehicle (at a path position with a speed) with the lanes of its own direction beside it."""
    at = float(now[0])
    lane, along = tables.on(np.array([at]), np.array([row]))
    beside = []
    if lane[0, 0] >= 0:
        here = network.lanes[lane[0, 0]]
        for other in (here.left, here.right):
            if other >= 0:
                scale = here.length_m / network.lanes[other].length_m
                beside.append(Occupied(other, at - float(along[0, 0]), scale, at, at + _BESIDE_M))
    return Swerver(tables.paths[row], at, float(now[1]), size_m, tuple(beside))


class Detours:
    """Finds ways around standing things.

    Args:
        network: The roads.
    """

    def __init__(self, network: RoadNetwork) -> None:
        points = [_dense(edge.xy) for edge in network.edges]
        xy = np.concatenate(points) if points else np.zeros((0, 2))
        self._edge = Boxes(xy, np.zeros(len(xy)), np.zeros(len(xy)), np.zeros((len(xy), 2)))

    def find(self, who: Swerver, standing: Boxes, moving: Boxes) -> tuple[Path, float] | None:
        """A path around what stands ahead, and where it is back on the old one (m); None where there is none."""
        path, half_width, half_length = who.path, who.size_m[1] / 2, who.size_m[0] / 2
        near = standing.chosen(_close(standing, path, who.at_m, LOOK_M + 40.0))
        seen, _ = extents(path, near)
        front = who.at_m + half_length
        blocks = (
            (seen.right_m < half_width + DETOUR_MARGIN_M)
            & (seen.left_m > -half_width - DETOUR_MARGIN_M)
            & (seen.near_m > front - 0.5)
        )
        if not blocks.any():
            return None
        first = float(seen.near_m[blocks].min())
        if not 2.0 < first - front < LOOK_M:
            return None
        last = first
        for k in np.argsort(seen.near_m, kind="stable"):
            if blocks[k] and seen.near_m[k] < last + 2 * half_length + 14.0:
                last = max(last, float(seen.far_m[k]))
        group = blocks & (seen.near_m <= last)
        sides = [
            float(seen.left_m[group].max()) + half_width + _ROOM_M,
            float(seen.right_m[group].min()) - half_width - _ROOM_M,
        ]
        for aside in sorted(sides, key=abs):
            plan = self._plan(who, first, last, aside)
            if plan is not None and self._is_free(who, plan, aside, seen, moving):
                return around(path, plan, aside, who.beside), plan[3]
        return None

    @staticmethod
    def _plan(
        who: Swerver, first: float, last: float, aside: float
    ) -> tuple[float, float, float, float] | None:
        half = who.size_m[0] / 2
        out = first - half - 0.3
        begin = max(who.at_m, out - max(_STEEPEST * 2 * abs(aside), 2.4 * who.speed))
        back = last + half + 0.5
        end = back + max(_STEEPEST * 1.6 * abs(aside), 2.0 * min(who.speed, _PASS_MPS))
        if abs(aside) > _FURTHEST_M or out - begin < _STEEPEST * abs(aside) or end > who.path.length_m - 5.0:
            return None
        return begin, out, back, end

    def _is_free(
        self,
        who: Swerver,
        plan: tuple[float, float, float, float],
        aside: float,
        seen: Extents,
        moving: Boxes,
    ) -> bool:
        """Whether the band that is driven through holds no edge, nothing that stands, and nobody who comes."""
        begin, out, back, end = plan
        half = who.size_m[1] / 2
        low, high = aside - half - _EDGE_M, aside + half + _EDGE_M
        beside = (seen.near_m < back) & (seen.far_m > out) & (seen.right_m < high) & (seen.left_m > low)
        if beside.any():
            return False
        edge = self._edge.chosen(_close(self._edge, who.path, (out + back) / 2, (end - begin) / 2 + 15.0))
        edges, _ = extents(who.path, edge)
        sweep = (edges.near_m > out) & (edges.near_m < back)
        sweep &= (edges.left_m > min(low, -half)) & (edges.right_m < max(high, half))
        if sweep.any():
            return False
        lasts = (end - who.at_m) / max(who.speed, _PASS_MPS) + 1.0
        near = moving.chosen(_close(moving, who.path, (who.at_m + end) / 2, end - who.at_m + 90.0))
        others, which = extents(who.path, near, within_m=6.0)
        place = np.rint(np.clip((others.near_m + others.far_m) / 2, 0, who.path.length_m) / who.path.step_m)
        turned = wrap(near.heading[which] - who.path.curve.heading[place.astype(int)])
        speed = near.speed[which] * np.cos(turned)
        meets = (others.right_m < high + 0.3) & (others.left_m > low - 0.3)
        ahead = (others.far_m > who.at_m) & (others.near_m + np.minimum(speed, 0.0) * lasts < end + 5.0)
        behind = (others.far_m <= who.at_m) & (others.far_m + speed * 3.0 > who.at_m - 6.0)
        # Who drives ahead of the swerver in its own lane is met by nobody: it is a leader.
        ahead &= ~((speed > 1.0) & (others.near_m > back))
        return not bool(np.any(meets & (ahead | behind)))


def _dense(ring: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "dense 2"]:
    """A closed ring with points at most a metre apart."""
    closed = np.concatenate([ring, ring[:1]])
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    at = np.linspace(0.0, arc[-1], int(arc[-1]) + 2)
    return np.stack([np.interp(at, arc, closed[:, k]) for k in (0, 1)], axis=-1)


def _close(boxes: Boxes, path: Path, at_m: float, within_m: float) -> np.ndarray:
    centre = path.curve.xy[min(int(max(at_m, 0.0) / path.step_m), len(path.curve.xy) - 1)]
    return np.sum((boxes.xy - centre) ** 2, axis=1) < within_m**2
