"""The map features of nuPlan around a drive: decoded, projected to the system of the logs, flat."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from drivax.datasets.nuplan.map import CURE, NUMBERS, City, Lane, feature_id, whole
from drivax.datasets.nuplan.sqlite import Database, geometries, open_database
from drivax.datasets.parsing import import_extra
from drivax.datasets.road_edges import Area, road_edges
from drivax.errors import DataError
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind

Array = np.ndarray[Any, Any]

_DRIVABLE = ("road_segments", "intersections", "generic_drivable_areas", "carpark_areas")
#: Decoded around the ego's drive: 100 m that are kept, and room for routes that run on.
MARGIN_M = 250.0
#: A feature near the drive that reaches further than this from it is damaged.
_FARTHEST_M = 20_000.0
#: Widths between boundaries that are believed, metres.
_WIDTHS_M = (1.5, 10.0)
_WIDTH_PLACES = (0.1, 0.3, 0.5, 0.7, 0.9)
#: Boundary types that are painted, as far as public readers of the format agree; 1 and 3 are not painted.
_LINES: Mapping[int | None, RoadKind] = {
    0: RoadKind.LINE_BROKEN_SINGLE_WHITE,
    2: RoadKind.LINE_SOLID_SINGLE_WHITE,
}
_UNPAINTED = (1, 3)
_STOP_SIGN = 1


def features_around(
    city: City, xy: Float64[np.ndarray, "point 2"]
) -> tuple[tuple[MapFeature, ...], dict[str, int]]:
    """Map features within ``MARGIN_M`` of the box of a drive, in the system of the logs, z = 0; and what was lost."""
    shapely = import_extra("shapely")
    try:
        with open_database(city.path) as database:
            around = _Around(city, database, (*xy.min(axis=0), *xy.max(axis=0)))
            features = [*_lane_features(around), *_line_features(around), *_polygon_features(around)]
            areas = list(_areas(around))
    except shapely.errors.ShapelyError as error:
        raise DataError(f"shapely cannot use a geometry ({error})", file=city.path, cure=CURE) from error
    if not any(feature.kind == RoadKind.LANE_SURFACE for feature in features):
        raise DataError(
            f"no lane of the map {city.path} lies within {MARGIN_M:.0f} m of the drive", cure=CURE
        )
    features += road_edges(areas, feature_id("road_edges", 0))
    return tuple(features), around.lost


class _Around:
    """Decodes what lies around a drive; geometries that are no geometry are counted."""

    def __init__(self, city: City, database: Database, drive: tuple[float, ...]) -> None:
        self.city = city
        self.pointless = 0
        self._damaged: set[tuple[str, int]] = set()
        self._database = database
        west, south, east, north = drive
        self._box = west - MARGIN_M, south - MARGIN_M, east + MARGIN_M, north + MARGIN_M
        self._middle = np.array([(west + east) / 2, (south + north) / 2])
        self._reach = _FARTHEST_M + max(east - west, north - south)

    def near(self, name: str) -> Int64[np.ndarray, " row"]:
        """Rows of a layer whose bounds touch the box."""
        layer = self.city.layers.get(name)
        if layer is None:
            return np.zeros(0, np.int64)
        forward = _transformer(layer.epsg, self.city.epsg)
        box = forward.transform_bounds(*self._box, direction="INVERSE")
        return layer.touching(box)

    @property
    def lost(self) -> dict[str, int]:
        """What could not be used so far, by name: geometries that are none, and baselines without a direction."""
        counts = {"map_geometries": len(self._damaged), "lanes": self.pointless}
        return {name: count for name, count in counts.items() if count}

    @functools.cached_property
    def baselines(self) -> tuple[list[int], Array]:
        """Packed ids of the lanes around the drive, and their baselines."""
        owners = {lane.baseline: number for number, lane in self.city.lanes.items()}
        rows = [int(row) for row in self.near("baseline_paths") if int(row) in owners]
        return [owners[row] for row in rows], self.shapes("baseline_paths", np.array(rows, np.int64))

    def shapes(self, name: str, rows: Int64[np.ndarray, " row"]) -> Array:
        """Projected geometries of rows; None where one is damaged, empty or absurd."""
        import shapely

        if not len(rows):
            return np.zeros(0, dtype=object)
        layer = self.city.layers[name]
        with np.errstate(invalid="ignore"):  # coordinates that are NaN
            shapes = shapely.force_2d(geometries(self._database, layer, rows))
            xy, owner = shapely.get_coordinates(shapes, return_index=True)
        forward = _transformer(layer.epsg, self.city.epsg)
        xy = np.column_stack(forward.transform(xy[:, 0], xy[:, 1]))
        far = ~(np.abs(xy - self._middle) <= self._reach).all(axis=1)  # NaN compares false
        bad = np.bincount(owner[far], minlength=len(shapes)) > 0
        bad |= np.bincount(owner, minlength=len(shapes)) == 0
        self._damaged.update((name, int(row)) for row in rows[bad])
        kept = np.asarray(shapes).copy()
        kept[bad] = None
        shapely.set_coordinates(kept, xy[~bad[owner]])
        return kept


@functools.lru_cache(maxsize=8)
def _transformer(source: int, target: int) -> Any:
    """Projection between two EPSG systems, x (east) first."""
    pyproj = import_extra("pyproj")
    try:
        systems = pyproj.CRS.from_epsg(source), pyproj.CRS.from_epsg(target)
        if not systems[1].is_projected:
            raise DataError(f"EPSG:{target} is no projected coordinate system", cure=CURE)
        return pyproj.Transformer.from_crs(*systems, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise DataError(
            f"a coordinate system (EPSG:{source}, EPSG:{target}) is unknown", cure=CURE
        ) from error


def _line(shape: Any) -> Float64[np.ndarray, "point 3"] | None:
    """Points of a line, z = 0, without repeated ones; None where there are fewer than two or the line is in parts."""
    import shapely

    if shape is not None and shape.geom_type == "MultiLineString":
        shape = shapely.line_merge(shape)
    if shape is None or shape.geom_type != "LineString":
        return None
    return _distinct(shapely.get_coordinates(shape))


def _distinct(xy: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "kept 3"] | None:
    moved = np.append(True, (np.diff(xy, axis=0) != 0.0).any(axis=1))
    return np.pad(xy[moved], ((0, 0), (0, 1))) if moved.sum() >= 2 else None


def _lane_features(around: _Around) -> Iterator[MapFeature]:
    """Lanes and connectors with their links, limits and widths."""
    city = around.city
    numbers, shapes = around.baselines
    widths = _widths(around, [city.lanes[number] for number in numbers], shapes)
    for number, shape, width in zip(numbers, shapes, widths, strict=True):
        points, lane = _line(shape), city.lanes[number]
        if points is None:
            around.pointless += shape is not None
            continue
        yield MapFeature(
            feature_id=number,
            kind=RoadKind.LANE_SURFACE,
            points=points,
            limit_mps=lane.limit_mps,
            width_m=width,
            successors=tuple(lane.successors),
            predecessors=tuple(lane.predecessors),
            left_neighbours=() if lane.left is None else (lane.left,),
            right_neighbours=() if lane.right is None else (lane.right,),
            interpolating=number >> 32 == NUMBERS["lane_connectors"],
        )


def _widths(around: _Around, lanes: Sequence[Lane], shapes: Array) -> list[float | None]:
    """Width of each lane: the median of the distance to its left plus to its right boundary at five places."""
    import shapely

    rows = [[around.city.boundary_rows.get(fid, -1) for fid in lane.boundaries] for lane in lanes]
    used = sorted({row for pair in rows for row in pair if row >= 0})
    lines = dict(zip(used, around.shapes("boundaries", np.array(used, np.int64)), strict=True))
    sides = np.full((len(lanes), 2), None, dtype=object)
    along = np.full(len(lanes), None, dtype=object)
    for i, (pair, shape) in enumerate(zip(rows, shapes, strict=True)):
        sides[i] = [lines.get(row) for row in pair]
        along[i] = shape if shape is not None and shape.geom_type == "LineString" else None
    places = shapely.line_interpolate_point(along[:, None], _WIDTH_PLACES, normalized=True)
    gaps = shapely.distance(places[:, None], sides[:, :, None])
    low, high = _WIDTHS_M
    widths = np.median(gaps.sum(axis=1), axis=1)
    return [float(width) if low <= width <= high else None for width in widths]


def _line_features(around: _Around) -> Iterator[MapFeature]:
    """Painted boundaries of lanes."""
    rows = around.near("boundaries")
    layer = around.city.layers.get("boundaries")
    if layer is None:
        return
    values = layer.columns["boundary_type_fid"]
    types = {row: kind for row in rows.tolist() if (kind := whole(values[row])) not in _UNPAINTED}
    rows = np.array(list(types), np.int64)
    for row, shape in zip(rows, around.shapes("boundaries", rows), strict=True):
        points, fid = _line(shape), whole(int(layer.fid[row]))
        if points is not None and fid is not None:
            kind = _LINES.get(types[row], RoadKind.LINE_UNKNOWN)
            yield MapFeature(feature_id("boundaries", fid), kind, points)


def _ring(shape: Any) -> Float64[np.ndarray, "point 3"] | None:
    """Outline of a polygon (of the largest part), its first point not repeated."""
    import shapely

    parts = (
        [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon"]
        if shape is not None
        else []
    )
    if not parts:
        return None
    points = _distinct(shapely.get_coordinates(max(parts, key=shapely.area).exterior)[:-1])
    return points if points is not None and len(points) >= 3 else None


def _polygon_features(around: _Around) -> Iterator[MapFeature]:
    """Crosswalks, and stop signs with the lanes whose baselines cross their stop polygons."""
    import shapely

    layers = around.city.layers
    rows = around.near("crosswalks")
    for row, shape in zip(rows, around.shapes("crosswalks", rows), strict=True):
        points, fid = _ring(shape), whole(int(layers["crosswalks"].fid[row]))
        if points is not None and fid is not None:
            yield MapFeature(feature_id("crosswalks", fid), RoadKind.CROSSWALK, points)
    stops = layers.get("stop_polygons")
    if stops is None:
        return
    kinds = stops.columns["stop_polygon_type_fid"]
    rows = np.array(
        [row for row in around.near("stop_polygons") if whole(kinds[row]) == _STOP_SIGN], np.int64
    )
    if not len(rows):
        return
    owners, baselines = around.baselines
    tree = shapely.STRtree(baselines)
    for row, shape in zip(rows, around.shapes("stop_polygons", rows), strict=True):
        points, fid = _ring(shape), whole(int(stops.fid[row]))
        if points is None or fid is None:
            continue
        polygon = shapely.Polygon(points[:, :2])
        crossing = [owners[i] for i in sorted(tree.query(polygon, predicate="intersects").tolist())]
        lanes = [n for n in crossing if n >> 32 == NUMBERS["lanes_polygons"]] or crossing
        middle = np.append(shapely.get_coordinates(polygon.centroid)[0], 0.0)[None]
        yield MapFeature(feature_id("stop_polygons", fid), RoadKind.STOP_SIGN, middle, lanes=tuple(lanes))


def _areas(around: _Around) -> Iterator[Area]:
    """Drivable polygons."""
    import shapely

    for name in _DRIVABLE:
        for shape in around.shapes(name, around.near(name)):
            for part in shapely.get_parts(shape) if shape is not None else ():
                if part.geom_type == "Polygon" and not part.is_empty:
                    holes = [shapely.get_coordinates(hole) for hole in part.interiors]
                    yield shapely.get_coordinates(part.exterior), holes
