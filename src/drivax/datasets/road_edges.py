"""Road edges from drivable areas: sources that draw where one may drive, not where the road ends."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.datasets.parsing import import_extra
from drivax.errors import DataError
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind

Array = np.ndarray[Any, Any]

#: A drivable polygon: its exterior and its holes, points in metres, two or three columns, rings in any orientation,
#: with or without the first point repeated at the end.
Area = tuple[Float[Array, "_ _"], Sequence[Float[Array, "_ _"]]]

#: Gaps up to this width between areas are errors of drawing, not islands. Areas of Argoverse 2 touch exactly; those
#: that were projected or rounded to centimetres leave a few millimetres between them.
GAP_M = 0.1
#: Smaller pieces of drivable space are leftovers of drawing, smaller holes nothing that a car could miss.
LEAST_PIECE_M2 = 1.0
LEAST_HOLE_M2 = 0.05
#: No map frame reaches further; beyond it lie damaged numbers.
_FARTHEST_M = 1e8


def road_edges(areas: Sequence[Area], first_id: int) -> list[MapFeature]:
    """The boundary of all drivable areas together, as closed rings with the drivable side on the left.

    Self-intersecting polygons are repaired, overlapping and touching ones joined, gaps of up to 10 cm between them
    closed (morphological closing). Exteriors come out anticlockwise, holes clockwise. Heights are interpolated along
    the nearest edge of the input, 0 where it has two columns.

    Args:
        areas: Drivable polygons; rings of fewer than three different points are left out.
        first_id: Feature id of the first ring; the others count up from it.

    Returns:
        One EDGE_BOUNDARY per ring, its first point repeated at the end.
    """
    shapely = import_extra("shapely")
    rings = [ring for exterior, holes in areas for ring in (exterior, *holes)]
    if not all((np.abs(ring) < _FARTHEST_M).all() for ring in rings):  # NaN compares false
        raise DataError("a drivable area has a point that is nowhere", cure="download the map again")
    try:
        joined = _close(shapely.union_all([p for area in areas for p in _polygons(shapely, area)]))
        outlines = [ring for polygon in _parts(shapely, joined) for ring in _outlines(shapely, polygon)]
    except shapely.errors.GEOSException as error:
        raise DataError(
            f"drivable areas cannot be joined ({error})", cure="download the map again"
        ) from error
    heights = _heights(shapely, rings, np.concatenate(outlines) if outlines else np.zeros((0, 2)))
    split = np.cumsum([len(outline) for outline in outlines])[:-1]
    return [
        MapFeature(first_id + number, RoadKind.EDGE_BOUNDARY, np.column_stack((outline, z)))
        for number, (outline, z) in enumerate(zip(outlines, np.split(heights, split), strict=False))
    ]


def _polygons(shapely: Any, area: Area) -> list[Any]:
    """An area as valid polygons."""
    exterior, holes = area
    if len(np.unique(exterior[:, :2], axis=0)) < 3:
        return []
    holes = [hole[:, :2] for hole in holes if len(np.unique(hole[:, :2], axis=0)) >= 3]
    polygon = shapely.Polygon(exterior[:, :2], holes)
    if not polygon.is_valid:
        # Loops of a self-intersecting ring are drivable, whichever way round they run.
        polygon = shapely.make_valid(polygon, method="structure", keep_collapsed=False)
    return [part for part in shapely.get_parts(polygon) if part.geom_type == "Polygon"]


def _close(union: Any) -> Any:
    """The union without gaps: widened by half a gap, then narrowed again. Mitred corners return to their place."""
    return union.buffer(GAP_M / 2, join_style="mitre").buffer(-GAP_M / 2, join_style="mitre")


def _parts(shapely: Any, joined: Any) -> list[Any]:
    """Polygons worth keeping, exteriors anticlockwise and holes clockwise."""
    parts = shapely.get_parts(shapely.orient_polygons(joined))
    return [part for part in parts if part.geom_type == "Polygon" and part.area >= LEAST_PIECE_M2]


def _outlines(shapely: Any, polygon: Any) -> Iterator[Float[Array, "_ 2"]]:
    """The rings of a polygon as points."""
    yield shapely.get_coordinates(polygon.exterior)
    for hole in polygon.interiors:
        if shapely.Polygon(hole).area >= LEAST_HOLE_M2:
            yield shapely.get_coordinates(hole)


def _heights(
    shapely: Any, rings: Sequence[Float[Array, "_ _"]], xy: Float[Array, "query 2"]
) -> Float[Array, " query"]:
    """Height of each point, interpolated along the nearest edge of the input rings."""
    solid = [ring for ring in rings if ring.shape[1] > 2 and len(ring)]
    if not solid or not len(xy):
        return np.zeros(len(xy))
    a = np.concatenate(solid)
    b = np.concatenate([np.roll(ring, -1, axis=0) for ring in solid])
    edges = shapely.linestrings(np.stack((a[:, :2], b[:, :2]), axis=1))
    points = shapely.points(xy)
    nearest = shapely.STRtree(edges).nearest(points)
    along = shapely.line_locate_point(edges[nearest], points, normalized=True)
    along = np.nan_to_num(along)  # an edge of no length
    return a[nearest, 2] + along * (b[nearest, 2] - a[nearest, 2])
