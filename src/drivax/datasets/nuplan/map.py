"""The GeoPackage maps of nuPlan: found on disk, indexed once per city, decoded and projected around a drive.

Feature ids of the layers overlap, so a feature is (layer, fid); both are packed into one number.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from drivax.datasets import parsing
from drivax.datasets.nuplan.sqlite import Database, Layer, geometries, open_database, read_layer
from drivax.datasets.road_edges import Area, road_edges
from drivax.errors import DataError, import_extra
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind

Array = np.ndarray[Any, Any]

_DRIVABLE = ("road_segments", "intersections", "generic_drivable_areas", "carpark_areas")
#: Layers that are read and their columns. The order gives the numbers of the layers in feature ids.
LAYERS: Mapping[str, tuple[str, ...]] = {
    "lanes_polygons": (
        "lane_fid", "lane_group_fid", "lane_index", "left_boundary_fid", "right_boundary_fid", "speed_limit_mps",
    ),
    "lane_connectors": ("exit_lane_fid", "entry_lane_fid", "lane_group_connector_fid", "speed_limit_mps"),
    "boundaries": ("boundary_type_fid",),
    "crosswalks": (),
    "stop_polygons": ("stop_polygon_type_fid",),
    "baseline_paths": ("lane_fid", "lane_connector_fid"),
    "gen_lane_connectors_scaled_width_polygons": ("lane_connector_fid", "left_boundary_fid", "right_boundary_fid"),
    **dict.fromkeys(_DRIVABLE, ()),
}  # fmt: skip
#: Known layers that are not read.
_UNUSED_LAYERS = frozenset((
    "lane_groups_polygons", "lane_group_connectors", "walkways", "traffic_lights", "dubins_nodes",
))  # fmt: skip
_BASE_LAYERS = ("baseline_paths", "lanes_polygons", "lane_connectors")
NUMBERS = {name: number for number, name in enumerate((*LAYERS, "road_edges"), start=1)}
#: Folder in the archive of the maps, which the documentation renames to ``maps``.
_ARCHIVE, _LISTING = "nuplan-maps-v*", "nuplan-maps-*.json"
_FASTEST_MPS = 60.0
CURE = "download the nuPlan maps again"
#: Margin around ego's drive within which the map is decoded: 100 m that are kept, and space for longer routes.
MARGIN_M = 250.0
#: A feature near the drive that reaches further than this from it is damaged.
_FARTHEST_M = 20_000.0
#: Plausible distances between boundaries, metres, and the fractions of a lane's length at which they are measured.
_WIDTHS_M = (1.5, 10.0)
_WIDTH_FRACTIONS = (0.1, 0.3, 0.5, 0.7, 0.9)
#: Boundary types that are painted, as far as public readers of the format agree; 1 and 3 are not painted.
_LINES: Mapping[int | None, RoadKind] = {
    0: RoadKind.LINE_BROKEN_SINGLE_WHITE,
    2: RoadKind.LINE_SOLID_SINGLE_WHITE,
}
_NO_PAINT = (1, 3)
_STOP_SIGN = 1


def feature_id(layer: str, fid: int) -> int:
    """Pack layer and fid of a feature into one number."""
    return NUMBERS[layer] << 32 | fid


def find_map(log: Path, name: str) -> Path:
    """Return the GeoPackage of a named map.

    Looks in ``maps``, or in ``nuplan-maps-v1.0`` as the archive unpacks it, next to the log or next to any folder
    above it, then in the nuPlan devkit's ``NUPLAN_MAPS_ROOT``.
    """
    listing = _listing(log)
    maps = parsing.load_json(listing)
    entry = maps.get(name) if isinstance(maps, dict) else None
    version = entry.get("version") if isinstance(entry, dict) else None
    # Both become folders of a path, so neither may hold a separator.
    if not isinstance(version, str) or not all(re.fullmatch(r"[\w.-]+", word) for word in (version, name)):
        raise DataError(f"lists no map {name[:80]!r}", file=listing, cure=CURE)
    path = listing.parent / name / version / "map.gpkg"
    if not path.is_file():
        raise DataError("is missing", file=path, cure="download the nuPlan maps")
    return path


def map_files(log: Path) -> tuple[Path, ...]:
    """Return the file that lists the maps, and the GeoPackages of all maps; nothing without maps."""
    try:
        listing = _listing(log)
    except DataError:
        return ()
    return (listing, *sorted(listing.parent.glob("*/*/map.gpkg")))


def _listing(log: Path) -> Path:
    """Find the file that lists the maps and their versions."""
    roots = [root for folder in log.resolve().parents for root in (folder / "maps", folder)]
    if os.environ.get("NUPLAN_MAPS_ROOT"):
        roots.append(Path(os.environ["NUPLAN_MAPS_ROOT"]))
    for root in roots:
        for pattern in (_LISTING, f"{_ARCHIVE}/{_LISTING}"):
            if listings := sorted(root.glob(pattern)):
                return listings[-1]
    raise DataError(
        "no nuPlan maps next to it (maps/nuplan-maps-v1.0.json)",
        file=log,
        cure="put the folder maps next to or above it, or set NUPLAN_MAPS_ROOT",
    )


@dataclass(frozen=True)
class Lane:
    """A lane or connector without geometry: links are packed feature ids, boundaries fids, ``baseline`` is a row."""

    baseline: int
    roadblock: tuple[str, int] | None
    limit_mps: float | None
    boundaries: tuple[int | None, int | None]
    left: int | None = None
    right: int | None = None
    successors: list[int] = field(default_factory=list)
    predecessors: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class City:
    """A map without its geometries.

    Attributes:
        path: The GeoPackage.
        epsg: EPSG code of the projected coordinate system of the logs.
        layers: The layers by name.
        lanes: Lanes and connectors by packed id.
        roadblocks: Packed ids of the lanes of each roadblock, by (``lane`` or ``connector``, fid).
        boundary_rows: Row in the layer of boundaries by fid.
        unknown_layers: Number of layers with unknown names.
    """

    path: Path
    epsg: int
    layers: Mapping[str, Layer]
    lanes: Mapping[int, Lane]
    roadblocks: Mapping[tuple[str, int], list[int]]
    boundary_rows: Mapping[int | None, int]
    unknown_layers: int


def city_map(path: Path) -> City:
    """Return the index of a map, cached until the file changes."""
    state = path.stat()
    return _city(path, state.st_mtime_ns, state.st_size)


@functools.lru_cache(maxsize=2)
def _city(path: Path, mtime_ns: int, size: int) -> City:
    """Index a map; the time and size of the file are keys of the cache only."""
    with open_database(path) as database:
        layers = {name: layer for name in LAYERS if (layer := read_layer(database, name, LAYERS[name]))}
        if missing := [name for name in _BASE_LAYERS if name not in layers]:
            raise DataError(f"has no layer {missing[0]}", file=path, cure=CURE)
        epsg = _read_epsg(database)
        names = {name for (name,) in database.rows("SELECT table_name FROM gpkg_geometry_columns")}
    lanes = _lanes(layers)
    blocks: dict[tuple[str, int], list[int]] = {}
    for lane_id, lane in lanes.items():
        if lane.roadblock is not None:
            blocks.setdefault(lane.roadblock, []).append(lane_id)
    boundaries = layers.get("boundaries")
    fids = () if boundaries is None else boundaries.fid.tolist()
    rows: dict[int | None, int] = {fid: row for row, fid in enumerate(fids)}
    return City(path, epsg, layers, lanes, blocks, rows, len(names - LAYERS.keys() - _UNUSED_LAYERS))


def _read_epsg(database: Database) -> int:
    """Read the EPSG code of the logs' coordinate system from the table ``meta``."""
    database.require("meta", "key", "value")
    rows = database.rows("SELECT value FROM meta WHERE key = 'projectedCoordSystem'")
    match = re.fullmatch(r"(?:epsg:)?(\d{4,6})", str(rows[0][0]).strip().lower()) if rows else None
    if match is None:
        raise DataError("names no projected coordinate system", file=database.path, cure=CURE)
    return int(match[1])


def as_integer(value: Any) -> int | None:
    """Return a feature id or enumeration from an integer, float or text; None for anything else."""
    if isinstance(value, str) and value.isascii() and value.isdigit() and len(value) < 11:
        value = int(value)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if isinstance(value, int) and 0 <= value < 2**32 else None


def _limit(value: Any) -> float | None:
    """Return a speed limit in m/s from a number or text; None for a missing or implausible one."""
    if isinstance(value, str) and re.fullmatch(r"\d{1,3}(\.\d{1,20})?", value):
        value = float(value)
    return float(value) if isinstance(value, int | float) and 0.0 < value <= _FASTEST_MPS else None


def _lane_id(layer: str, value: Any) -> int | None:
    """Return the packed id of a feature from its fid in a file; None without one."""
    fid = as_integer(value)
    return None if fid is None else feature_id(layer, fid)


def _table(layer: Layer | None, *columns: str) -> Iterator[tuple[Any, ...]]:
    """Yield the fid and some columns of every row; nothing without a layer."""
    if layer is None:
        return iter(())
    return zip(layer.fid.tolist(), *(layer.columns[name] for name in columns), strict=True)


def _lanes(layers: Mapping[str, Layer]) -> dict[int, Lane]:
    """Return lanes and connectors that have a baseline, with their links, which may dangle."""
    baselines: dict[int, int] = {}
    for row, (_, lane, connector) in enumerate(_table(layers["baseline_paths"], *LAYERS["baseline_paths"])):
        lane_id = _lane_id("lanes_polygons", lane) or _lane_id("lane_connectors", connector)
        if lane_id is not None:
            baselines.setdefault(lane_id, row)
    lanes = _plain_lanes(layers["lanes_polygons"], baselines)
    for lane_id, connector in _connectors(layers, baselines):
        lanes[lane_id] = connector
        for lane in lanes.keys() & connector.predecessors:
            lanes[lane].successors.append(lane_id)
        for lane in lanes.keys() & connector.successors:
            lanes[lane].predecessors.append(lane_id)
    return lanes


def _plain_lanes(layer: Layer, baselines: Mapping[int, int]) -> dict[int, Lane]:
    """Return lanes without connectors; left and right neighbours have the index before and after in the group."""
    lanes: dict[int, Lane] = {}
    lane_at: dict[tuple[int, int], int] = {}
    slots: dict[int, tuple[int, int]] = {}
    for fid, lane, group, index, left, right, limit in _table(layer, *LAYERS["lanes_polygons"]):
        lane_id = _lane_id("lanes_polygons", fid if lane is None else lane)
        if lane_id is None or lane_id not in baselines or lane_id in lanes:
            continue
        block, slot = as_integer(group), as_integer(index)
        lanes[lane_id] = Lane(
            baseline=baselines[lane_id],
            roadblock=None if block is None else ("lane", block),
            limit_mps=_limit(limit),
            boundaries=(as_integer(left), as_integer(right)),
        )
        if block is not None and slot is not None:
            lane_at.setdefault((block, slot), lane_id)
            slots[lane_id] = block, slot
    for lane_id, (block, slot) in slots.items():
        neighbours = {"left": lane_at.get((block, slot - 1)), "right": lane_at.get((block, slot + 1))}
        lanes[lane_id] = replace(lanes[lane_id], **neighbours)
    return lanes


def _connectors(layers: Mapping[str, Layer], baselines: Mapping[int, int]) -> Iterator[tuple[int, Lane]]:
    """Yield connectors with packed ids; each leads from the lane ``exit_lane_fid`` to the lane ``entry_lane_fid``."""
    name = "gen_lane_connectors_scaled_width_polygons"
    sides = {
        as_integer(connector): (as_integer(left), as_integer(right))
        for _, connector, left, right in _table(layers.get(name), *LAYERS[name])
    }
    for fid, exit_fid, entry_fid, group, limit in _table(
        layers["lane_connectors"], *LAYERS["lane_connectors"]
    ):
        lane_id, block = _lane_id("lane_connectors", fid), as_integer(group)
        if lane_id is None or lane_id not in baselines:
            continue
        predecessor, successor = (_lane_id("lanes_polygons", lane) for lane in (exit_fid, entry_fid))
        lane = Lane(
            baseline=baselines[lane_id],
            roadblock=None if block is None else ("connector", block),
            limit_mps=_limit(limit),
            boundaries=sides.get(as_integer(fid), (None, None)),
            successors=[] if successor is None else [successor],
            predecessors=[] if predecessor is None else [predecessor],
        )
        yield lane_id, lane


def corridor(city: City, ids: Sequence[int]) -> tuple[tuple[int, ...], int]:
    """Return lanes and connectors of a route's roadblocks, and the number of roadblocks that the map lacks.

    A roadblock is a group of lanes or of connectors; an id of both means the lanes, as in the devkit.
    """
    blocks = city.roadblocks
    groups = [blocks.get(("lane", number)) or blocks.get(("connector", number)) for number in ids]
    lanes = dict.fromkeys(lane for group in groups for lane in group or ())
    return tuple(lanes), sum(group is None for group in groups)


def features_around(
    city: City, xy: Float64[np.ndarray, "point 2"]
) -> tuple[tuple[MapFeature, ...], dict[str, int]]:
    """Return map features within ``MARGIN_M`` of the bounding box of a drive, and counts of lost ones by name.

    Coordinates are in the system of the logs, z = 0. Damaged geometries and baselines without a direction are lost.
    """
    shapely = import_extra("shapely")
    try:
        with open_database(city.path) as database:
            decoder = _MapDecoder(city, database, (*xy.min(axis=0), *xy.max(axis=0)))
            features = [*_lane_features(decoder), *_line_features(decoder), *_polygon_features(decoder)]
            areas = list(_areas(decoder))
    except shapely.errors.ShapelyError as error:
        raise DataError(f"shapely cannot use a geometry ({error})", file=city.path, cure=CURE) from error
    if not any(feature.kind == RoadKind.LANE_SURFACE for feature in features):
        problem = f"no lane of the map {city.path} lies within {MARGIN_M:.0f} m of the drive"
        raise DataError(problem, cure=CURE)
    features += road_edges(areas, feature_id("road_edges", 0))
    return tuple(features), parsing.nonzero(map_geometries=len(decoder.damaged), lanes=decoder.lost_lanes)


class _MapDecoder:
    """Decodes the map around ``drive``, a box (west, south, east, north) in the system of the logs.

    ``damaged`` holds layer and row of unusable geometries; ``lost_lanes`` counts baselines without a direction.
    """

    def __init__(self, city: City, database: Database, drive: tuple[float, ...]) -> None:
        self.city = city
        self.lost_lanes = 0
        self.damaged: set[tuple[str, int]] = set()
        self._database = database
        west, south, east, north = drive
        self._box = west - MARGIN_M, south - MARGIN_M, east + MARGIN_M, north + MARGIN_M
        self._middle = np.array([(west + east) / 2, (south + north) / 2])
        self._reach = _FARTHEST_M + max(east - west, north - south)

    def box_rows(self, name: str) -> list[int]:
        """Return the rows of a layer whose bounds touch the box."""
        layer = self.city.layers.get(name)
        if layer is None:
            return []
        forward = _transformer(layer.epsg, self.city.epsg, self.city.path)
        return layer.query_box(forward.transform_bounds(*self._box, direction="INVERSE")).tolist()

    def types(self, name: str) -> dict[int, int | None]:
        """Return the type of each feature around the drive by row, from the only column of the layer."""
        (column,) = LAYERS[name]
        return {row: as_integer(self.city.layers[name].columns[column][row]) for row in self.box_rows(name)}

    @functools.cached_property
    def baselines(self) -> tuple[list[int], Array]:
        """Packed ids of the lanes around the drive, and their baselines."""
        lane_ids = {lane.baseline: lane_id for lane_id, lane in self.city.lanes.items()}
        rows = [row for row in self.box_rows("baseline_paths") if row in lane_ids]
        return [lane_ids[row] for row in rows], self.shapes("baseline_paths", rows)

    def shapes(self, name: str, rows: Sequence[int]) -> Array:
        """Return projected geometries of rows; None for one that is damaged, empty or too far away."""
        shapely = import_extra("shapely")
        if not len(rows):
            return np.zeros(0, dtype=object)
        layer = self.city.layers[name]
        with np.errstate(invalid="ignore"):  # coordinates that are NaN
            shapes = shapely.force_2d(geometries(self._database, layer, np.array(rows, np.int64)))
            xy, owner = shapely.get_coordinates(shapes, return_index=True)
        forward = _transformer(layer.epsg, self.city.epsg, self.city.path)
        xy = np.column_stack(forward.transform(xy[:, 0], xy[:, 1]))
        is_far = ~(np.abs(xy - self._middle) <= self._reach).all(axis=1)  # NaN compares false
        is_damaged = np.bincount(owner[is_far], minlength=len(shapes)) > 0
        is_damaged |= np.bincount(owner, minlength=len(shapes)) == 0
        self.damaged.update((name, rows[i]) for i in np.flatnonzero(is_damaged).tolist())
        shapes = np.asarray(shapes).copy()
        shapes[is_damaged] = None
        return shapely.set_coordinates(shapes, xy[~is_damaged[owner]])

    def outlines(
        self, name: str, rows: Sequence[int], outline: Callable[[Any], Array | None]
    ) -> Iterator[tuple[int, int, Array]]:
        """Yield row, packed id and points of the geometries that have an outline."""
        for row, shape in zip(rows, self.shapes(name, rows), strict=True):
            points, fid = outline(shape), as_integer(int(self.city.layers[name].fid[row]))
            if points is not None and fid is not None:
                yield row, feature_id(name, fid), points


@functools.lru_cache(maxsize=8)
def _transformer(source: int, target: int, file: Path) -> Any:
    """Return the projection between two EPSG systems that a map names, x (east) first."""
    pyproj = import_extra("pyproj")
    try:
        systems = pyproj.CRS.from_epsg(source), pyproj.CRS.from_epsg(target)
        if not systems[1].is_projected:
            raise DataError(f"EPSG:{target} is not a projected coordinate system", file=file, cure=CURE)
        return pyproj.Transformer.from_crs(*systems, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        problem = f"a coordinate system (EPSG:{source}, EPSG:{target}) is unknown"
        raise DataError(problem, file=file, cure=CURE) from error


def _line(shape: Any) -> Float64[np.ndarray, "point 3"] | None:
    """Return points of a line, z = 0, without repeated ones; None for fewer than two points or several parts."""
    shapely = import_extra("shapely")
    if shape is not None and shape.geom_type == "MultiLineString":
        shape = shapely.line_merge(shape)
    if shape is None or shape.geom_type != "LineString":
        return None
    return _distinct(shapely.get_coordinates(shape))


def _ring(shape: Any) -> Float64[np.ndarray, "point 3"] | None:
    """Return the outline of a polygon's largest part, its first point not repeated; None for any other shape."""
    shapely = import_extra("shapely")
    parts = _polygons(shape)
    if not parts:
        return None
    points = _distinct(shapely.get_coordinates(max(parts, key=shapely.area).exterior)[:-1])
    return points if points is not None and len(points) >= 3 else None


def _distinct(xy: Float64[np.ndarray, "point 2"]) -> Float64[np.ndarray, "distinct 3"] | None:
    """Return the points that differ from the previous one, z = 0; None for fewer than two."""
    xy = xy[np.append(True, (np.diff(xy, axis=0) != 0.0).any(axis=1))]
    return np.pad(xy, ((0, 0), (0, 1))) if len(xy) >= 2 else None


def _polygons(shape: Any) -> list[Any]:
    parts = () if shape is None else import_extra("shapely").get_parts(shape)
    return [part for part in parts if part.geom_type == "Polygon"]


def _lane_features(decoder: _MapDecoder) -> Iterator[MapFeature]:
    """Yield lanes and connectors with their links, limits and widths."""
    city = decoder.city
    lane_ids, shapes = decoder.baselines
    widths = _widths(decoder, [city.lanes[lane_id] for lane_id in lane_ids], shapes)
    for lane_id, shape, width in zip(lane_ids, shapes, widths, strict=True):
        points, lane = _line(shape), city.lanes[lane_id]
        if points is None:
            decoder.lost_lanes += shape is not None
            continue
        yield MapFeature(
            feature_id=lane_id,
            kind=RoadKind.LANE_SURFACE,
            points=points,
            limit_mps=lane.limit_mps,
            width_m=width,
            successors=tuple(lane.successors),
            predecessors=tuple(lane.predecessors),
            left_neighbours=() if lane.left is None else (lane.left,),
            right_neighbours=() if lane.right is None else (lane.right,),
            interpolating=lane_id >> 32 == NUMBERS["lane_connectors"],
        )


def _widths(decoder: _MapDecoder, lanes: Sequence[Lane], shapes: Array) -> list[float | None]:
    """Return the width of each lane: the median sum of the distances to both boundaries at five points along it.

    None for a lane that lacks a boundary, has a baseline in parts, or an implausible width.
    """
    shapely = import_extra("shapely")
    row_of = decoder.city.boundary_rows
    pairs = [[row_of.get(fid, -1) for fid in lane.boundaries] for lane in lanes]
    rows = np.array(pairs, np.int64).reshape(-1, 2)
    boundary_rows = np.unique(rows[rows >= 0])
    # Row -1 is a missing boundary and selects the last line, None: distances to it, and so the width, are NaN.
    missing = np.array(None, dtype=object)
    lines = np.append(decoder.shapes("boundaries", boundary_rows.tolist()), missing)
    boundaries = lines[np.where(rows >= 0, np.searchsorted(boundary_rows, rows), -1)]
    baselines = np.where(shapely.get_type_id(shapes) == shapely.GeometryType.LINESTRING, shapes, missing)
    points = shapely.line_interpolate_point(baselines[:, None], _WIDTH_FRACTIONS, normalized=True)
    distances = shapely.distance(points[:, None], boundaries[:, :, None])
    low, high = _WIDTHS_M
    widths = np.median(distances.sum(axis=1), axis=1)
    return [float(width) if low <= width <= high else None for width in widths]


def _line_features(decoder: _MapDecoder) -> Iterator[MapFeature]:
    """Yield painted boundaries of lanes."""
    types = {row: kind for row, kind in decoder.types("boundaries").items() if kind not in _NO_PAINT}
    for row, packed_id, points in decoder.outlines("boundaries", list(types), _line):
        yield MapFeature(packed_id, _LINES.get(types[row], RoadKind.LINE_UNKNOWN), points)


def _polygon_features(decoder: _MapDecoder) -> Iterator[MapFeature]:
    """Yield crosswalks, and stop signs with the lanes (else connectors) whose baselines cross their stop polygons."""
    shapely = import_extra("shapely")
    for _, packed_id, points in decoder.outlines("crosswalks", decoder.box_rows("crosswalks"), _ring):
        yield MapFeature(packed_id, RoadKind.CROSSWALK, points)
    lane_ids, baselines = decoder.baselines
    tree = shapely.STRtree(baselines)
    stops = [row for row, kind in decoder.types("stop_polygons").items() if kind == _STOP_SIGN]
    for _, packed_id, points in decoder.outlines("stop_polygons", stops, _ring):
        polygon = shapely.Polygon(points[:, :2])
        crossing_lanes = [lane_ids[i] for i in sorted(tree.query(polygon, predicate="intersects").tolist())]
        lanes = [lane for lane in crossing_lanes if lane >> 32 == NUMBERS["lanes_polygons"]] or crossing_lanes
        middle = np.append(shapely.get_coordinates(polygon.centroid)[0], 0.0)[None]
        yield MapFeature(packed_id, RoadKind.STOP_SIGN, middle, lanes=tuple(lanes))


def _areas(decoder: _MapDecoder) -> Iterator[Area]:
    """Yield drivable polygons."""
    shapely = import_extra("shapely")
    shapes = (shape for name in _DRIVABLE for shape in decoder.shapes(name, decoder.box_rows(name)))
    for part in (part for shape in shapes for part in _polygons(shape)):
        if not part.is_empty:
            holes = [shapely.get_coordinates(hole) for hole in part.interiors]
            yield shapely.get_coordinates(part.exterior), holes
