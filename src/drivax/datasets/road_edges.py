"""Road edges from drivable areas, for sources whose maps have no edges."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import DataError, import_extra
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind

Array = np.ndarray[Any, Any]

#: A drivable polygon: exterior and holes, rings of any orientation, closed or not, in metres, two or three columns.
Area = tuple[Float[Array, "_ _"], Sequence[Float[Array, "_ _"]]]

#: Gaps up to this width are drawing errors, not islands: areas that were projected or rounded to centimetres leave a
#: few millimetres between them (those of Argoverse 2 touch exactly).
GAP_M = 0.1
#: Smaller pieces and holes are drawing errors.
LEAST_PIECE_M2 = 1.0
LEAST_HOLE_M2 = 0.05
#: Largest plausible coordinate of a map.
_FARTHEST_M = 1e8
_AGAIN = "download the map again"


def road_edges(areas: Sequence[Area], first_id: int) -> list[MapFeature]:
    """Return the boundary of all drivable areas: one closed EDGE_BOUNDARY per ring, drivable side on the left.

    Rings of fewer than three different points are dropped, self-intersecting polygons repaired, overlapping or touching
    ones joined, gaps of up to 10 cm closed (morphological closing), then pieces below 1 m2 and holes below 0.05 m2
    dropped. Exteriors become anticlockwise, holes clockwise, the first point is repeated at the end. Heights are
    interpolated along the nearest edge of a ring with three columns; without such a ring they are 0. Feature ids count
    up from ``first_id``.
    """
    shapely = import_extra("shapely")
    rings = [ring for exterior, holes in areas for ring in (exterior, *holes)]
    if not all((np.abs(ring) < _FARTHEST_M).all() for ring in rings):  # NaN compares false
        problem = f"a drivable area has a point that is not finite or beyond {_FARTHEST_M:g} m"
        raise DataError(problem, cure=_AGAIN)
    try:
        union = shapely.union_all([polygon for area in areas for polygon in _polygons(shapely, area)])
        # Widening closes the gaps, narrowing restores the outline: mitred corners return to their place.
        union = union.buffer(GAP_M / 2, join_style="mitre").buffer(-GAP_M / 2, join_style="mitre")
        outlines = list(_outlines(shapely, union))
    except shapely.errors.GEOSException as error:
        raise DataError(f"drivable areas cannot be joined ({error})", cure=_AGAIN) from error
    heights = _heights(shapely, rings, np.concatenate(outlines) if outlines else np.zeros((0, 2)))
    split = np.cumsum([len(outline) for outline in outlines])[:-1]
    # Without outlines ``np.split`` still returns one, empty part.
    return [
        MapFeature(first_id + number, RoadKind.EDGE_BOUNDARY, np.column_stack((outline, z)))
        for number, (outline, z) in enumerate(zip(outlines, np.split(heights, split), strict=False))
    ]


def _polygons(shapely: Any, area: Area) -> list[Any]:
    """Return an area as valid polygons."""
    exterior, holes = area
    if len(np.unique(exterior[:, :2], axis=0)) < 3:
        return []
    holes = [hole[:, :2] for hole in holes if len(np.unique(hole[:, :2], axis=0)) >= 3]
    polygon = shapely.Polygon(exterior[:, :2], holes)
    if not polygon.is_valid:
        # All loops of a self-intersecting ring are drivable, whatever their orientation.
        polygon = shapely.make_valid(polygon, method="structure", keep_collapsed=False)
    return [part for part in shapely.get_parts(polygon) if part.geom_type == "Polygon"]


def _outlines(shapely: Any, union: Any) -> Iterator[Float[Array, "_ 2"]]:
    """Yield the rings of large enough pieces and holes as points, exteriors anticlockwise and holes clockwise."""
    for polygon in shapely.get_parts(shapely.orient_polygons(union)):
        if polygon.geom_type != "Polygon" or polygon.area < LEAST_PIECE_M2:
            continue
        yield shapely.get_coordinates(polygon.exterior)
        for hole in polygon.interiors:
            if shapely.Polygon(hole).area >= LEAST_HOLE_M2:
                yield shapely.get_coordinates(hole)


def _heights(
    shapely: Any, rings: Sequence[Float[Array, "_ _"]], xy: Float[Array, "query 2"]
) -> Float[Array, " query"]:
    """Interpolate the height of each point along the nearest edge of the input rings; 0 if they have no heights."""
    rings = [ring for ring in rings if ring.shape[1] > 2 and len(ring)]
    if not rings or not len(xy):
        return np.zeros(len(xy))
    a = np.concatenate(rings)
    b = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    edges = shapely.linestrings(np.stack((a[:, :2], b[:, :2]), axis=1))
    points = shapely.points(xy)
    nearest = shapely.STRtree(edges).nearest(points)
    # The fraction is NaN on an edge without length.
    fraction = np.nan_to_num(shapely.line_locate_point(edges[nearest], points, normalized=True))
    return a[nearest, 2] + fraction * (b[nearest, 2] - a[nearest, 2])
