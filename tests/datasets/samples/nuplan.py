"""A hand-made nuPlan log with its map, written with sqlite3, shapely (WKB) and pyproj (degrees): no code of drivax.

A junction of four arms in UTM zone 11. Arm ``w`` has two lanes towards the junction, the others one; each arm has one
lane away from it. The ego comes from the west and turns left to the north. Fids of different layers overlap on
purpose, and the fid of a lane's polygon is not its ``lane_fid``.
"""

from __future__ import annotations

import json
import math
import pickle
import sqlite3
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely

LOG = "2021.05.12.22.00.38_veh-35_01008_01518"
CITY, VERSION = "us-nv-las-vegas-strip", "9.15.1915"
#: Middle of the junction, UTM zone 11 north, metres.
X0, Y0 = 664_430.25, 3_997_650.5
EPSG = 32611
RADIUS, LENGTH, WIDTH = 12.0, 150.0, 3.5
SPEED = 8.0
ARMS = {"e": (1.0, 0.0), "n": (0.0, 1.0), "w": (-1.0, 0.0), "s": (0.0, -1.0)}
#: Lane numbers: towards the junction 1 to 4, away from it 5 to 8, the second one of the west arm 9.
IN = {"e": 1, "n": 2, "w": 3, "s": 4}
OUT = {"e": 5, "n": 6, "w": 7, "s": 8}
SECOND = 9
#: Connectors: (arm from, arm to) -> fid 1 to 12, in the order of the compass.
CONNECTORS = {pair: i for i, pair in enumerate(((a, b) for a in ARMS for b in ARMS if a != b), start=1)}
#: The ego turns from west to north.
TURN = CONNECTORS["w", "n"]
DASHED, SOLID, NONE, ODD = 0, 2, 3, 7


# --- Geometry in metres around the middle of the junction.


def right_of(direction: Sequence[float]) -> np.ndarray:
    return np.array([direction[1], -direction[0]])


def lane_line(arm: str, outward: bool, offset: float) -> np.ndarray:
    """From end to end of an arm, ``offset`` to the right of the middle line in driving direction."""
    away = np.array(ARMS[arm])
    ends = np.array([RADIUS, RADIUS + LENGTH]) if outward else np.array([RADIUS + LENGTH, RADIUS])
    return ends[:, None] * away + offset * right_of(away if outward else -away)


def lane_lines() -> dict[int, np.ndarray]:
    lanes = {IN[arm]: lane_line(arm, False, WIDTH / 2) for arm in ARMS}
    lanes |= {OUT[arm]: lane_line(arm, True, WIDTH / 2) for arm in ARMS}
    return lanes | {SECOND: lane_line("w", False, 1.5 * WIDTH)}


def connector_ends(pair: tuple[str, str]) -> tuple[int, int]:
    """Lanes before and after a connector; the right turn from the west starts on the second lane."""
    before, after = pair
    return (SECOND if pair == ("w", "s") else IN[before]), OUT[after]


def connector_line(pair: tuple[str, str], points: int = 13) -> np.ndarray:
    """A straight line, or a quarter of an ellipse that leaves along the first lane and arrives along the second."""
    before, after = connector_ends(pair)
    lanes = lane_lines()
    begin, end = lanes[before][-1], lanes[after][0]
    ahead = -np.array(ARMS[pair[0]])
    if abs(ahead @ np.array(ARMS[pair[1]])) > 0.5:
        return np.array([begin, end])
    angle = np.linspace(0.0, math.pi / 2, points)[:, None]
    along = (end - begin) @ ahead
    aside = (end - begin) - along * ahead
    return begin + np.sin(angle) * along * ahead + (1.0 - np.cos(angle)) * aside


def shifted(line: np.ndarray, left: float) -> np.ndarray:
    return shapely.get_coordinates(shapely.offset_curve(shapely.LineString(line), left, join_style="mitre"))


def ego_rear_axle(s: float) -> tuple[float, float, float, float]:
    """x, y, heading and curvature of the rear axle after ``s`` metres: 60 m straight on, a quarter circle, straight."""
    turn_radius, approach = RADIUS + WIDTH / 2, 60.0
    arc = turn_radius * math.pi / 2
    if s <= approach:
        return -RADIUS - approach + s, -WIDTH / 2, 0.0, 0.0
    if s <= approach + arc:
        angle = (s - approach) / turn_radius
        x, y = turn_radius * math.sin(angle), turn_radius * (1.0 - math.cos(angle))
        return -RADIUS + x, -WIDTH / 2 + y, angle, 1.0 / turn_radius
    return WIDTH / 2, RADIUS + s - approach - arc, math.pi / 2, 0.0


# --- The map.


def degrees(xy: np.ndarray) -> np.ndarray:
    back = pyproj.Transformer.from_crs(EPSG, 4326, always_xy=True)
    return np.column_stack(back.transform(xy[:, 0] + X0, xy[:, 1] + Y0))


def blob(shape: Any, envelope: bool = True, little: bool = True) -> bytes:
    """A GeoPackage geometry: header, envelope, WKB."""
    order = "<" if little else ">"
    head = b"GP\0" + bytes([(2 if envelope else 0) | int(little)]) + struct.pack(order + "i", 4326)
    west, south, east, north = shape.bounds
    bounds = struct.pack(order + "4d", west, east, south, north) if envelope else b""
    return head + bounds + shapely.to_wkb(shape, byte_order=int(little))


def line(xy: np.ndarray) -> Any:
    return shapely.LineString(degrees(np.asarray(xy)))


def polygon(xy: Any) -> Any:
    return shapely.Polygon(degrees(np.asarray(xy)))


def rectangle(arm: str, near: float, far: float, left: float, right: float) -> np.ndarray:
    """Between two distances from the middle, and between two offsets to the right of the arm's way out."""
    away = np.array(ARMS[arm])
    corners = ((near, left), (far, left), (far, right), (near, right))
    return np.array([along * away + aside * right_of(away) for along, aside in corners])


@dataclass
class Layer:
    """Rows of a layer: fid -> (geometry, values)."""

    columns: tuple[str, ...] = ()
    rows: dict[int, tuple[Any, tuple[Any, ...]]] = field(default_factory=dict)

    def add(self, fid: int, shape: Any, *values: Any) -> None:
        self.rows[fid] = shape, values


def map_layers() -> dict[str, Layer]:
    layers = {
        "lanes_polygons": Layer(
            ("lane_fid", "lane_group_fid", "lane_index", "left_boundary_fid", "right_boundary_fid", "speed_limit_mps")
        ),
        "lane_connectors": Layer(
            ("exit_lane_fid", "entry_lane_fid", "lane_group_connector_fid", "speed_limit_mps",
             "traffic_light_stop_line_fids")
        ),
        "gen_lane_connectors_scaled_width_polygons": Layer(
            ("lane_connector_fid", "left_boundary_fid", "right_boundary_fid")
        ),
        "baseline_paths": Layer(("lane_fid", "lane_connector_fid")),
        "boundaries": Layer(("boundary_type_fid",)),
        "stop_polygons": Layer(("stop_polygon_type_fid",)),
        "crosswalks": Layer(), "road_segments": Layer(), "intersections": Layer(),
        "generic_drivable_areas": Layer(), "carpark_areas": Layer(), "walkways": Layer(),
    }  # fmt: skip
    add_lanes(layers)
    add_connectors(layers)
    for fid, arm in enumerate(ARMS, start=1):
        right = 2 * WIDTH if arm == "s" else WIDTH
        left = 2 * WIDTH if arm == "w" else WIDTH
        layers["road_segments"].add(fid, polygon(rectangle(arm, RADIUS, RADIUS + LENGTH, -left, WIDTH)))
        layers["crosswalks"].add(fid, polygon(rectangle(arm, RADIUS + 1.0, RADIUS + 4.0, -left, WIDTH)))
        layers["walkways"].add(fid, polygon(rectangle(arm, RADIUS, RADIUS + LENGTH, WIDTH, WIDTH + right)))
    layers["intersections"].add(1, polygon(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * RADIUS))
    layers["carpark_areas"].add(1, polygon(rectangle("e", 60.0, 90.0, WIDTH, WIDTH + 20.0)))
    stop = rectangle("s", RADIUS + 0.5, RADIUS + 1.5, -WIDTH, 0.0)
    layers["stop_polygons"].add(1, polygon(stop), 1)
    layers["stop_polygons"].add(2, polygon(rectangle("w", RADIUS + 0.5, RADIUS + 1.5, -2 * WIDTH, 0.0)), 2)
    layers["stop_polygons"].add(3, polygon(rectangle("e", RADIUS + 1.0, RADIUS + 4.0, -WIDTH, WIDTH)), 0)
    return layers


def add_lanes(layers: Mapping[str, Layer]) -> None:
    for number, xy in lane_lines().items():
        left, right = 2 * number - 1, 2 * number
        if number == SECOND:
            left = 2 * IN["w"]  # shared with the lane next to it
        else:
            layers["boundaries"].add(left, line(shifted(xy, WIDTH / 2)), SOLID)
        kind = {IN["w"]: DASHED, OUT["e"]: ODD}.get(number, SOLID)
        layers["boundaries"].add(right, line(shifted(xy, -WIDTH / 2)), kind)
        limit = {1: None, 2: math.nan}.get(number, 11.176)
        outline = np.concatenate((shifted(xy, WIDTH / 2), shifted(xy, -WIDTH / 2)[::-1]))
        index = 1 if number == SECOND else 0
        values = (number, group_of(number), index, left, right, limit)
        layers["lanes_polygons"].add(50 + number, polygon(outline), *values)
        layers["baseline_paths"].add(number, line(xy), number, None)


def group_of(number: int) -> int:
    """Lane group: one per arm and direction; the second lane shares that of the first."""
    return 100 + (IN["w"] if number == SECOND else number)


def add_connectors(layers: Mapping[str, Layer]) -> None:
    for pair, number in CONNECTORS.items():
        before, after = connector_ends(pair)
        xy = connector_line(pair)
        left, right = 40 + 2 * number, 41 + 2 * number
        for fid, side in ((left, WIDTH / 2), (right, -WIDTH / 2)):
            layers["boundaries"].add(fid, line(shifted(xy, side)), NONE)
        stop = "2" if pair[0] == "w" else None
        layers["lane_connectors"].add(number, line(xy), before, after, 200 + number, 6.7, stop)
        outline = np.concatenate((shifted(xy, WIDTH / 2), shifted(xy, -WIDTH / 2)[::-1]))
        layers["gen_lane_connectors_scaled_width_polygons"].add(
            number + 7, polygon(outline), number, left, right
        )
        # Public files hold the ids of baselines as floats, because the other column is empty.
        layers["baseline_paths"].add(30 + number, line(xy), None, float(number))


def write_map(path: Path, layers: Mapping[str, Layer], encode: Callable[[Any], bytes] = blob) -> None:
    """A GeoPackage of these layers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    wgs84 = pyproj.CRS(4326).to_wkt("WKT1_GDAL")
    with closing(sqlite3.connect(path)) as db, db:
        db.executescript(
            """
            PRAGMA application_id = 1196444487;
            PRAGMA user_version = 10200;
            CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
                organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
                description TEXT);
            CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
                identifier TEXT UNIQUE, description TEXT DEFAULT '',
                last_change DATETIME NOT NULL DEFAULT '2021-05-12T22:00:38.000Z',
                min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER);
            CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL PRIMARY KEY, column_name TEXT NOT NULL,
                geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL);
            CREATE TABLE meta (fid INTEGER PRIMARY KEY, key TEXT, value TEXT);
            """
        )
        db.executemany(
            "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)",
            [("Undefined", -1, "NONE", -1, "undefined"), ("Undefined", 0, "NONE", 0, "undefined"),
             ("WGS 84", 4326, "EPSG", 4326, wgs84)],
        )  # fmt: skip
        db.executemany(
            "INSERT INTO meta (key, value) VALUES (?, ?)",
            [("geographicCoordSystem", "epsg:4326"), ("projectedCoordSystem", f"epsg:{EPSG}")],
        )
        db.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES ('meta', 'attributes', 'meta')"
        )
        for name, layer in layers.items():
            write_layer(db, name, layer, encode)


def write_layer(db: sqlite3.Connection, name: str, layer: Layer, encode: Callable[[Any], bytes]) -> None:
    columns = "".join(f", {column}" for column in layer.columns)
    db.execute(
        f"CREATE TABLE {name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom GEOMETRY{columns})"
    )
    db.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id) VALUES (?, 'features', ?, 4326)",
        (name, name),
    )
    db.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', 'GEOMETRY', 4326, 0, 0)", (name,))
    marks = ", ?" * len(layer.columns)
    db.executemany(
        f"INSERT INTO {name} VALUES (?, ?{marks})",
        [(fid, encode(shape), *values) for fid, (shape, values) in layer.rows.items()],
    )


# --- The log.


def token(table: str, number: int) -> bytes:
    return struct.pack(">HIH", sum(table.encode()), number, len(table))


@dataclass(frozen=True)
class Box:
    """One thing: its category, size, pose at time t (None: not seen), and velocity."""

    category: str
    size: tuple[float, float, float]  # length, width, height
    pose: Callable[[float], tuple[float, float, float] | None]
    velocity: tuple[float, float] | None = (0.0, 0.0)


def still(x: float, y: float, yaw: float = 0.0) -> Callable[[float], tuple[float, float, float]]:
    return lambda t: (x, y, yaw)


def walker(t: float) -> tuple[float, float, float] | None:
    """Crosses the east arm; unobserved between 3 s and 4 s."""
    return None if 3.0 <= t < 4.0 else (RADIUS + 2.5, -6.0 + 1.2 * t, math.pi / 2)


BOXES = (
    Box("vehicle", (4.6, 1.9, 1.6), lambda t: (40.0 - 6.0 * t, WIDTH / 2, math.pi), (-6.0, 0.0)),
    Box("vehicle", (4.4, 1.8, 1.5), lambda t: (WIDTH / 2, 30.0 + 5.0 * t, math.pi / 2), (0.0, 5.0)),
    Box("vehicle", (12.0, 2.6, 3.1), still(-40.0, -1.5 * WIDTH)),
    Box("vehicle", (4.5, 1.8, 1.5), still(70.0, -10.0, 1.0)),
    Box("bicycle", (1.8, 0.6, 1.6), lambda t: (-WIDTH / 2, 60.0 - 4.0 * t, -math.pi / 2), (0.0, -4.0)),
    Box("pedestrian", (0.7, 0.7, 1.75), walker, (0.0, 1.2)),
    Box("pedestrian", (0.6, 0.7, 1.7), still(15.0, 15.0)),
    Box("traffic_cone", (0.4, 0.4, 0.9), still(20.0, 2 * WIDTH), None),
    Box("traffic_cone", (0.4, 0.4, 0.9), still(24.0, 2 * WIDTH), None),
    Box("barrier", (2.0, 0.5, 1.1), still(30.0, 2 * WIDTH), None),
    Box("czone_sign", (0.5, 0.5, 1.5), still(18.0, 2 * WIDTH), None),
    Box("generic_object", (1.0, 0.8, 0.7), still(-20.0, 2 * WIDTH), None),
)
CATEGORIES = ("vehicle", "bicycle", "pedestrian", "traffic_cone", "barrier", "czone_sign", "generic_object")
SCHEMA = """
    CREATE TABLE log (token BLOB NOT NULL PRIMARY KEY, vehicle_name TEXT, date TEXT, timestamp INTEGER, logfile TEXT,
        location TEXT, map_version TEXT);
    CREATE TABLE ego_pose (token BLOB NOT NULL PRIMARY KEY, timestamp INTEGER, x FLOAT, y FLOAT, z FLOAT, qw FLOAT,
        qx FLOAT, qy FLOAT, qz FLOAT, vx FLOAT, vy FLOAT, vz FLOAT, acceleration_x FLOAT, acceleration_y FLOAT,
        acceleration_z FLOAT, angular_rate_x FLOAT, angular_rate_y FLOAT, angular_rate_z FLOAT, epsg INTEGER,
        log_token BLOB);
    CREATE TABLE lidar (token BLOB NOT NULL PRIMARY KEY, log_token BLOB, channel TEXT, model TEXT, translation BLOB,
        rotation BLOB);
    CREATE TABLE lidar_pc (token BLOB NOT NULL PRIMARY KEY, next_token BLOB, prev_token BLOB, ego_pose_token BLOB,
        lidar_token BLOB, scene_token BLOB, filename TEXT, timestamp INTEGER);
    CREATE TABLE lidar_box (token BLOB NOT NULL PRIMARY KEY, lidar_pc_token BLOB, track_token BLOB, next_token BLOB,
        prev_token BLOB, x FLOAT, y FLOAT, z FLOAT, width FLOAT, length FLOAT, height FLOAT, vx FLOAT, vy FLOAT,
        vz FLOAT, yaw FLOAT, confidence FLOAT);
    CREATE TABLE track (token BLOB NOT NULL PRIMARY KEY, category_token BLOB, width FLOAT, length FLOAT, height FLOAT);
    CREATE TABLE category (token BLOB NOT NULL PRIMARY KEY, name TEXT, description TEXT);
    CREATE TABLE scene (token BLOB NOT NULL PRIMARY KEY, log_token BLOB, name TEXT, goal_ego_pose_token BLOB,
        roadblock_ids TEXT);
    CREATE TABLE scenario_tag (token BLOB NOT NULL PRIMARY KEY, lidar_pc_token BLOB, type TEXT, agent_track_token BLOB);
    CREATE TABLE traffic_light_status (token BLOB NOT NULL PRIMARY KEY, lidar_pc_token BLOB, lane_connector_id INTEGER,
        status TEXT);
"""
INDEX = "CREATE INDEX box_of_sweep ON lidar_box (lidar_pc_token)"


@dataclass(frozen=True)
class Drive:
    """Content of the log; change parts of it for a test.

    Attributes:
        sweeps: Number of lidar sweeps, 50 ms apart.
        scene_of: Number of the scene of a sweep.
        missing: Sweeps that the log lacks.
        routes: Text of ``roadblock_ids`` per scene.
        goals: Whether each scene has a goal.
        tags: (sweep, type).
        boxes: The things around.
    """

    sweeps: int = 500
    scene_of: Callable[[int], int] = lambda sweep: sweep // 200
    missing: frozenset[int] = frozenset()
    routes: tuple[str | None, ...] = ()
    goals: bool = True
    tags: tuple[tuple[int, str], ...] = (
        (30, "starting_left_turn"), (150, "high_magnitude_speed"), (320, "near_construction_zone_sign"),
    )  # fmt: skip
    boxes: tuple[Box, ...] = BOXES


def route() -> str:
    """The ego's roadblocks: lane group, group of connectors, lane group."""
    return f"{group_of(IN['w'])} {200 + TURN} {group_of(OUT['n'])}"


def status(sweep: int, pair: tuple[str, str]) -> str | None:
    """Lights: from the west red, yellow from sweep 40, green from 60; from the north red, at every 50th sweep unknown,
    unobserved from sweep 100; from the others never observed.
    """
    if pair[0] == "w":
        return "red" if sweep < 40 else "yellow" if sweep < 60 else "green"
    if pair[0] == "n" and sweep < 100:
        return "red" if sweep % 50 else "unknown"
    return None


class Bomb:
    """What the BLOBs of calibrations must not become: unpickling it raises."""

    def __reduce__(self) -> tuple[Any, ...]:
        return eval, ("1 / 0",)


def time_us(sweep: int) -> int:
    """Sweeps come every 50 ms, give or take 0.4 ms."""
    return 1_620_857_889_000_000 + 50_000 * sweep + (sweep * 37) % 800 - 400


def pose_row(sweep: int) -> tuple[Any, ...]:
    x, y, yaw, curvature = ego_rear_axle(SPEED * (time_us(sweep) - time_us(0)) * 1e-6)
    pitch = 0.02
    half = math.cos(yaw / 2), math.sin(yaw / 2)
    quaternion = (  # yaw about z after pitch about y
        half[0] * math.cos(pitch / 2), -half[1] * math.sin(pitch / 2),
        half[0] * math.sin(pitch / 2), half[1] * math.cos(pitch / 2),
    )  # fmt: skip
    return (
        token("ego_pose", sweep), time_us(sweep) + 17_000, X0 + x, Y0 + y, 606.0, *quaternion,
        SPEED, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, SPEED * curvature, EPSG, token("log", 0),
    )  # fmt: skip


def box_rows(sweep: int, boxes: Iterable[Box]) -> Iterable[tuple[Any, ...]]:
    t = (time_us(sweep) - time_us(0)) * 1e-6
    for number, box in enumerate(boxes):
        if (pose := box.pose(t)) is not None:
            length, width, height = box.size
            yield (
                token("lidar_box", 1000 * sweep + number), token("lidar_pc", sweep), token("track", number), None, None,
                X0 + pose[0], Y0 + pose[1], 607.0, width, length, height,
                *(box.velocity or (None, None)), 0.0, pose[2], 0.9,
            )  # fmt: skip


def write_log(path: Path, drive: Drive) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = [sweep for sweep in range(drive.sweeps) if sweep not in drive.missing]
    scenes = sorted({drive.scene_of(sweep) for sweep in kept})
    calibration = pickle.dumps(Bomb())
    with closing(sqlite3.connect(path)) as db, db:
        db.executescript(SCHEMA)

        def insert(table: str, rows: Iterable[tuple[Any, ...]]) -> None:
            for row in rows:
                db.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(row))})", row)

        insert("log", [(token("log", 0), "g1p-veh-2035", "2021-05-12", time_us(0), LOG, "las_vegas", CITY)])
        insert(
            "lidar", [(token("lidar", 0), token("log", 0), "MergedPointCloud", "x", calibration, calibration)]
        )
        insert("ego_pose", map(pose_row, reversed(kept)))
        insert("category", [(token("category", i), name, "") for i, name in enumerate(CATEGORIES)])
        insert(
            "track",
            [(token("track", i), token("category", CATEGORIES.index(b.category)), b.size[1], b.size[0], b.size[2])
             for i, b in enumerate(drive.boxes)],
        )  # fmt: skip
        for sweep in reversed(kept):  # tables have no order
            times = time_us(sweep), drive.scene_of(sweep)
            insert(
                "lidar_pc",
                [(token("lidar_pc", sweep), None, None, token("ego_pose", sweep), token("lidar", 0),
                  token("scene", times[1]), f"{sweep}.pcd", times[0])],
            )  # fmt: skip
            insert("lidar_box", box_rows(sweep, drive.boxes))
            seen = [(n, s) for pair, n in CONNECTORS.items() if (s := status(sweep, pair)) is not None]
            insert(
                "traffic_light_status",
                [(token("light", 100 * sweep + n), token("lidar_pc", sweep), n, s) for n, s in seen],
            )
        for i, scene in enumerate(scenes):
            text = drive.routes[i] if i < len(drive.routes) else route()
            goal = token("ego_pose", kept[-1]) if drive.goals else None
            insert("scene", [(token("scene", scene), token("log", 0), f"scene-{scene:03d}", goal, text)])
        insert(
            "scenario_tag",
            [
                (token("tag", i), token("lidar_pc", sweep), kind, None)
                for i, (sweep, kind) in enumerate(drive.tags)
            ],
        )
        db.execute(INDEX)


def write_all(folder: Path, drive: Drive, layers: Mapping[str, Layer] | None = None) -> Path:
    """A data set as one downloads it: ``maps`` next to ``nuplan-v1.1``. Returns the path of the log."""
    maps = folder / "maps"
    write_map(maps / CITY / VERSION / "map.gpkg", map_layers() if layers is None else layers)
    (maps / "nuplan-maps-v1.0.json").write_text(json.dumps({CITY: {"version": VERSION, "layers": {}}}))
    log = folder / "nuplan-v1.1" / "splits" / "mini" / f"{LOG}.db"
    write_log(log, drive)
    return log


#: The small log: 9.6 s in one scene.
SMALL = Drive(sweeps=192, scene_of=lambda sweep: 0, tags=((30, "starting_left_turn"),))


def write(folder: Path) -> Path:
    """A small log: one scene of 96 steps."""
    return write_all(folder, SMALL)


def write_full(folder: Path, **changes: Any) -> Path:
    """The whole log: 25 s, 500 sweeps, three scenes; ``changes`` replace fields of :class:`Drive`."""
    return write_all(folder, replace(Drive(), **changes))


#: The small log without single sweeps, and one of 6 s with a gap.
FORMS = (
    lambda folder: write_all(folder, replace(SMALL, missing=frozenset({40, 81, 122}))),
    lambda folder: write_all(folder, replace(SMALL, sweeps=120, missing=frozenset(range(90, 96)))),
)
