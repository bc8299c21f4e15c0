"""Pieces of road to observe: lanes, edges and crosswalks in pieces of at most 10 m, in order of rank."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from drivax.geometry.polylines import cut_counts
from drivax.geometry.vectors import wrap
from drivax.scenario.build.lanes import known_limit
from drivax.scenario.build.segments import RoadLines, inside_box, path_distance
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import EDGE_KINDS, LANE_KINDS, RoadKind, among

Array = np.ndarray[Any, Any]

PIECE_M = 10.0
#: A closed ring is cut into at least this many pieces, so that each has a direction.
RING_PIECES = 4
#: Pieces rank by rings of this width around the log of the ego.
RING_M = 50.0


@dataclass(frozen=True)
class RoadRows:
    """Pieces of road in the local frame, in order of rank.

    Attributes:
        xy: Midpoint by arc length.
        direction: Unit vector from the first to the last point.
        length: Arc length, metres.
        limit: Speed limit in m/s, -1 unknown or no lane.
        curvature: Heading change per metre, 1/m, left positive.
        overflow: Rows that did not fit, by name.
    """

    xy: Float[Array, "row 2"]
    direction: Float[Array, "row 2"]
    length: Float[Array, " row"]
    kind: Int[Array, " row"]
    limit: Float[Array, " row"]
    curvature: Float[Array, " row"]
    overflow: dict[str, int]


def road_rows(
    roads: RoadLines, features: Sequence[MapFeature], path: Float[Array, "step 2"], margin_m: float, most: int
) -> RoadRows:
    """Cut lanes, road edges and crosswalks into pieces and keep the ``most`` highest ranks.

    Pieces whose midpoint lies more than ``margin_m`` outside the box of ``path``, the log of the ego, are left out.
    """
    line = np.flatnonzero(np.isin(roads.kind, (*LANE_KINDS, *EDGE_KINDS, RoadKind.CROSSWALK)))
    length = roads.lines.length[line]
    pieces = np.maximum(cut_counts(length, PIECE_M), np.where(roads.closed[line], RING_PIECES, 1))
    owner = np.repeat(line, pieces)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    span = np.repeat(length / pieces, pieces)
    begin = number * span
    middle = roads.lines.at(owner, begin + span / 2)[..., :2]
    near = np.flatnonzero(inside_box(middle, path, margin_m)) if len(owner) else np.zeros(0, dtype=np.int64)
    owner, begin, span, middle = owner[near], begin[near], span[near], middle[near]
    kind = roads.kind[owner]
    order = rank(_class_of(kind), path_distance(middle, path))[:most]
    lost = len(owner) - len(order)
    owner, begin, span, middle, kind = owner[order], begin[order], span[order], middle[order], kind[order]
    direction = _direction(roads, owner, begin, begin + span)
    turn = wrap(
        _angle(roads, owner, begin + span * 2 / 3, begin + span)
        - _angle(roads, owner, begin, begin + span / 3)
    )
    limits = [known_limit(feature) for feature in features]
    return RoadRows(
        xy=middle,
        direction=direction,
        length=span,
        kind=kind,
        limit=np.array(limits, dtype=np.float64)[roads.feature[owner]] if len(owner) else np.zeros(0),
        # Rounded: the last bits of angles depend on the processor.
        curvature=np.round(turn / (span * 2 / 3), 6) + 0.0,
        overflow={"road_rows": lost} if lost else {},
    )


def _class_of(kind: Int[Array, " row"]) -> Int[Array, " row"]:
    """Class of road kinds: 0 lane, 1 edge, 2 crosswalk."""
    return np.where(among(kind, LANE_KINDS), 0, np.where(among(kind, EDGE_KINDS), 1, 2))


def _chord(roads: RoadLines, line: Array, begin: Array, end: Array) -> Float[Array, "row 2"]:
    return (roads.lines.at(line, end) - roads.lines.at(line, begin))[..., :2]


def _angle(roads: RoadLines, line: Array, begin: Array, end: Array) -> Float[Array, " row"]:
    chord = _chord(roads, line, begin, end)
    return np.arctan2(chord[..., 1], chord[..., 0])


def _direction(roads: RoadLines, line: Array, begin: Array, end: Array) -> Float[Array, "row 2"]:
    angle = _angle(roads, line, begin, end)
    return np.stack((np.cos(angle), np.sin(angle)), axis=-1)


def rank(group: Int[Array, " row"], far: Float[Array, " row"]) -> Int[Array, " row"]:
    """Order pieces so that every prefix spreads evenly over each group, nearer rings first.

    Within a ring of 50 m around the log, the rows of a group (in order along the map) are taken in bit-reversed
    order (van der Corput's sequence), and the groups are interleaved in proportion to their sizes.
    """
    ring = np.floor(far / RING_M).astype(np.int64)
    place = np.zeros(len(group))
    for members in _members(ring * 3 + group):
        place[members] = (_bit_reversed_place(len(members)) + 0.5) / len(members)
    return np.lexsort((np.arange(len(group)), place, ring))


def _members(label: Int[Array, " row"]) -> list[Int[Array, " member"]]:
    """Rows of each label, in order."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(label) else []


def _bit_reversed_place(count: int) -> Int[Array, " count"]:
    """Rank of each of ``count`` items in the order of their bit-reversed indices."""
    bits = max(int(count - 1).bit_length(), 1)
    index = np.arange(count)
    reverse = np.zeros(count, dtype=np.int64)
    for bit in range(bits):
        reverse |= ((index >> bit) & 1) << (bits - 1 - bit)
    place = np.empty(count, dtype=np.int64)
    place[np.argsort(reverse, kind="stable")] = index
    return place
