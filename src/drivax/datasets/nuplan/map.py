"""The GeoPackage maps of nuPlan: found on disk, and indexed once per city: all but the geometries.

Feature ids of the layers overlap, so a feature is (layer, fid); both are packed into one number.
"""

from __future__ import annotations

import functools
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from drivax.datasets import parsing
from drivax.datasets.nuplan.sqlite import Database, Layer, open_database, read_layer
from drivax.errors import DataError

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
    "road_segments": (),
    "intersections": (),
    "generic_drivable_areas": (),
    "carpark_areas": (),
}  # fmt: skip
_NEEDED = ("baseline_paths", "lanes_polygons", "lane_connectors")
NUMBERS = {name: number for number, name in enumerate((*LAYERS, "road_edges"), start=1)}
#: Folder in the archive of the maps, which the documentation renames to ``maps``.
_UNPACKED, _LISTING = "nuplan-maps-v*", "nuplan-maps-*.json"
_FASTEST_MPS = 60.0
CURE = "download the nuPlan maps again"


def feature_id(layer: str, fid: int) -> int:
    """One number for a feature of a layer; distinct for all layers and fids."""
    return NUMBERS[layer] << 32 | fid


def find_map(log: Path, name: str) -> Path:
    """The GeoPackage of a named map.

    Looked for in ``maps``, or in ``nuplan-maps-v1.0`` as the archive unpacks it, next to the log or next to any folder
    above it, then where the environment variable ``NUPLAN_MAPS_ROOT`` of the nuPlan devkit points.
    """
    listing = _listing(log)
    known = parsing.load_json(listing)
    entry = known.get(name) if isinstance(known, dict) else None
    version = entry.get("version") if isinstance(entry, dict) else None
    if (
        not isinstance(version, str)
        or not re.fullmatch(r"[\w.-]+", version)
        or not re.fullmatch(r"[\w.-]+", name)
    ):
        raise DataError(f"lists no map {name[:80]!r}", file=listing, cure=CURE)
    path = listing.parent / name / version / "map.gpkg"
    if not path.is_file():
        raise DataError("is missing", file=path, cure="download the nuPlan maps")
    return path


def _listing(log: Path) -> Path:
    """The file that lists the maps and their versions."""
    roots = [root for folder in log.resolve().parents for root in (folder / "maps", folder)]
    if os.environ.get("NUPLAN_MAPS_ROOT"):
        roots.append(Path(os.environ["NUPLAN_MAPS_ROOT"]))
    for root in roots:
        for pattern in (_LISTING, f"{_UNPACKED}/{_LISTING}"):
            if listings := sorted(root.glob(pattern)):
                return listings[-1]
    raise DataError(
        "no nuPlan maps next to it (maps/nuplan-maps-v1.0.json)",
        file=log,
        cure="put the folder maps next to or above it, or set NUPLAN_MAPS_ROOT",
    )


@dataclass(frozen=True)
class Lane:
    """A lane or a lane connector, its geometry aside. Ids are packed feature ids; boundaries are fids."""

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
    """The index of one map: everything but geometries.

    Attributes:
        path: The GeoPackage.
        epsg: The projected system that logs use.
        layers: The layers that the file has.
        lanes: Lanes and connectors by packed id.
        roadblocks: Packed ids of the lanes of each roadblock, by (``lane`` or ``connector``, fid).
        boundary_rows: Row in the layer of boundaries by fid.
    """

    path: Path
    epsg: int
    layers: Mapping[str, Layer]
    lanes: Mapping[int, Lane]
    roadblocks: Mapping[tuple[str, int], list[int]]
    boundary_rows: Mapping[int | None, int]


def city_map(path: Path) -> City:
    """The index of a map, kept between calls as long as the file does not change."""
    state = path.stat()
    return _city(path, state.st_mtime_ns, state.st_size)


@functools.lru_cache(maxsize=2)
def _city(path: Path, mtime_ns: int, size: int) -> City:
    with open_database(path) as database:
        layers = {name: layer for name in LAYERS if (layer := read_layer(database, name, LAYERS[name]))}
        if missing := [name for name in _NEEDED if name not in layers]:
            raise DataError(f"has no layer {missing[0]}", file=path, cure=CURE)
        epsg = _projected(database)
    lanes = _lanes(layers)
    blocks: dict[tuple[str, int], list[int]] = {}
    for lane_id, lane in lanes.items():
        if lane.roadblock is not None:
            blocks.setdefault(lane.roadblock, []).append(lane_id)
    boundaries = layers.get("boundaries")
    fids = () if boundaries is None else boundaries.fid.tolist()
    return City(path, epsg, layers, lanes, blocks, {fid: row for row, fid in enumerate(fids)})


def _projected(database: Database) -> int:
    """EPSG number of the system of the logs, from the table ``meta``."""
    database.require("meta", "key", "value")
    rows = database.rows("SELECT value FROM meta WHERE key = 'projectedCoordSystem'")
    match = re.fullmatch(r"(?:epsg:)?(\d{4,6})", str(rows[0][0]).strip().lower()) if rows else None
    if match is None:
        raise DataError("names no projected coordinate system", file=database.path, cure=CURE)
    return int(match[1])


def whole(value: Any) -> int | None:
    """A feature id or an enumeration: files hold them as integers, floats and texts. None where it is none."""
    if isinstance(value, str) and value.isascii() and value.isdigit() and len(value) < 11:
        value = int(value)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return value if isinstance(value, int) and 0 <= value < 2**32 else None


def _limit(value: Any) -> float | None:
    """A limit in m/s; files may hold it as a text, like ids. None where it is missing or no limit of a road."""
    if isinstance(value, str) and re.fullmatch(r"\d{1,3}(\.\d{1,20})?", value):
        value = float(value)
    good = isinstance(value, int | float) and math.isfinite(value) and 0.0 < value <= _FASTEST_MPS
    return float(value) if good else None


def _table(layer: Layer | None, *columns: str) -> Iterator[tuple[Any, ...]]:
    """The fid and some columns of every row."""
    if layer is None:
        return iter(())
    return zip(layer.fid.tolist(), *(layer.columns[name] for name in columns), strict=True)


def _lanes(layers: Mapping[str, Layer]) -> dict[int, Lane]:
    """Lanes and connectors that have a baseline, linked; links may dangle."""
    baselines: dict[int, int] = {}
    for row, (_, lane, connector) in enumerate(_table(layers["baseline_paths"], *LAYERS["baseline_paths"])):
        if (number := whole(lane)) is not None:
            baselines.setdefault(feature_id("lanes_polygons", number), row)
        elif (number := whole(connector)) is not None:
            baselines.setdefault(feature_id("lane_connectors", number), row)
    lanes = _plain_lanes(layers["lanes_polygons"], baselines)
    for number, before, after, connector in _connectors(layers, baselines):
        lanes[number] = connector
        if before is not None:
            connector.predecessors.append(before)
            if before in lanes:
                lanes[before].successors.append(number)
        if after is not None:
            connector.successors.append(after)
            if after in lanes:
                lanes[after].predecessors.append(number)
    return lanes


def _plain_lanes(layer: Layer, baselines: Mapping[int, int]) -> dict[int, Lane]:
    """Lanes with their neighbours: the next and the last index of the same group, counted from the left."""
    lanes: dict[int, Lane] = {}
    places: dict[tuple[int, int], int] = {}
    slots: dict[int, tuple[int, int]] = {}
    for fid, lane, group, index, left, right, limit in _table(layer, *LAYERS["lanes_polygons"]):
        own = whole(fid if lane is None else lane)
        number = -1 if own is None else feature_id("lanes_polygons", own)
        if number not in baselines or number in lanes:
            continue
        block, slot = whole(group), whole(index)
        lanes[number] = Lane(
            baseline=baselines[number],
            roadblock=None if block is None else ("lane", block),
            limit_mps=_limit(limit),
            boundaries=(whole(left), whole(right)),
        )
        if block is not None and slot is not None:
            places.setdefault((block, slot), number)
            slots[number] = block, slot
    for number, (block, slot) in slots.items():
        neighbours = {"left": places.get((block, slot - 1)), "right": places.get((block, slot + 1))}
        lanes[number] = replace(lanes[number], **neighbours)
    return lanes


def _connectors(
    layers: Mapping[str, Layer], baselines: Mapping[int, int]
) -> Iterator[tuple[int, int | None, int | None, Lane]]:
    """Connectors: id, the lane before (``exit_lane_fid``: where one leaves it) and the lane after."""
    shapes = layers.get("gen_lane_connectors_scaled_width_polygons")
    sides = {
        whole(connector): (whole(left), whole(right))
        for _, connector, left, right in _table(
            shapes, "lane_connector_fid", "left_boundary_fid", "right_boundary_fid"
        )
    }
    for fid, leave, enter, group, limit in _table(layers["lane_connectors"], *LAYERS["lane_connectors"]):
        own, before, after, block = whole(fid), whole(leave), whole(enter), whole(group)
        number = -1 if own is None else feature_id("lane_connectors", own)
        if number not in baselines:
            continue
        lane = Lane(
            baseline=baselines[number],
            roadblock=None if block is None else ("connector", block),
            limit_mps=_limit(limit),
            boundaries=sides.get(own, (None, None)),
        )
        yield (
            number,
            None if before is None else feature_id("lanes_polygons", before),
            None if after is None else feature_id("lanes_polygons", after),
            lane,
        )


def corridor(city: City, ids: Sequence[int]) -> tuple[tuple[int, ...], int]:
    """Lanes and connectors of a route's roadblocks, and how many of the roadblocks the map does not know.

    Groups of lanes and of connectors share the list; an id that both have means the lanes, as in the devkit.
    """
    lane_ids: dict[int, None] = {}
    unknown = 0
    for number in ids:
        lanes = city.roadblocks.get(("lane", number)) or city.roadblocks.get(("connector", number))
        unknown += lanes is None
        lane_ids.update(dict.fromkeys(lanes or ()))
    return tuple(lane_ids), unknown
