"""Reader of nuPlan: SQLite logs and GeoPackage maps, version 1.1, without GDAL and without the devkit.

A log is cut at its scenes into recordings. BLOBs that hold pickles (calibrations) are not read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from drivax.datasets import parsing
from drivax.datasets.nuplan.map import (
    City,
    city_map,
    corridor,
    feature_id,
    features_around,
    find_map,
    map_files,
)
from drivax.datasets.nuplan.sqlite import Database, open_database
from drivax.datasets.parsing import flatten
from drivax.datasets.reader import BadRecord, Description, attempt
from drivax.errors import DataError, DrivaxError
from drivax.geometry.vectors import rotate, wrap
from drivax.scenario.recording import Light, MapFeature, Recording, Tracks
from drivax.scenario.schema import CURRENT_STEP, STEPS, AgentKind, LightState

_NAME = "nuplan"
#: Tables by which a nuPlan log is recognised among SQLite files.
_SIGNATURE = ("lidar_pc", "lidar_box", "ego_pose", "scenario_tag")
#: Tables and columns that are read; a log that lacks one is refused.
TABLES: Mapping[str, tuple[str, ...]] = {
    "log": ("logfile", "map_version"),
    "lidar_pc": ("token", "ego_pose_token", "scene_token", "timestamp"),
    "ego_pose": ("token", "x", "y", "qw", "qx", "qy", "qz", "vx", "vy", "angular_rate_z"),
    "lidar_box": (
        "lidar_pc_token", "track_token", "x", "y", "z", "yaw", "length", "width", "height", "vx", "vy",
    ),
    "track": ("token", "category_token"),
    "category": ("token", "name"),
    "scene": ("token", "roadblock_ids"),
    "scenario_tag": ("lidar_pc_token", "type"),
    "traffic_light_status": ("lidar_pc_token", "lane_connector_id", "status"),
}  # fmt: skip
#: Known tables and columns of ``TABLES`` that are not read, in one set because few names occur as both.
_UNUSED = frozenset((
    "lidar", "camera", "image", "token", "vehicle_name", "date", "timestamp", "location", "log_token", "lidar_token",
    "next_token", "prev_token", "filename", "z", "vz", "acceleration_x", "acceleration_y", "acceleration_z",
    "angular_rate_x", "angular_rate_y", "epsg", "confidence", "width", "length", "height", "description", "name",
    "goal_ego_pose_token", "agent_track_token",
))  # fmt: skip
#: Length, width and height of the ego (Chrysler Pacifica), metres.
EGO_SIZE_M = (5.176, 2.297, 1.777)
#: From the rear axle, where ego poses are, to the middle of the box: (front 4.049 m - rear 1.127 m) / 2.
REAR_AXLE_TO_CENTRE_M = 1.461
EGO_TRACK_ID = 0
#: Two missing lidar sweeps at 20 Hz, or one at 10 Hz, are a gap; no recording spans a gap.
_GAP_US = 120_000
#: Longer scenes are read in pieces of this many steps, a multiple of the usual stride of windows.
_LONGEST_PIECE = 400
#: Largest plausible UTM coordinates (m), speeds (m/s), sizes of boxes (m), distances of ego between two steps (m).
_FARTHEST_M, _FASTEST_MPS, _LONGEST_M, _LONGEST_STEP_M = 2e7, 300.0, 200.0, 20.0
_LARGEST_YAW_RAD = 1e4
#: Maximum number of entries of an array of tracks by steps; real scenes have up to a thousand tracks.
_MOST_CELLS = 2_000_000
_CURE = "skip this record, or download the file again"
_KINDS = {
    "vehicle": AgentKind.VEHICLE,
    "bicycle": AgentKind.CYCLIST,
    "pedestrian": AgentKind.PEDESTRIAN,
    **dict.fromkeys(("traffic_cone", "barrier", "czone_sign", "generic_object"), AgentKind.STATIC),
}
_LIGHT_STATES = {"green": LightState.GO, "yellow": LightState.CAUTION, "red": LightState.STOP}


@dataclass(frozen=True)
class NuPlan:
    """Reader of nuPlan logs: one recording per scene (several if it is long) at 10 Hz; a log is one segment."""

    name: str = _NAME
    patterns: tuple[str, ...] = ("*_veh-*.db",)
    companions: tuple[str, ...] = ("map.gpkg", "nuplan-maps-*.json")
    #: Steps of a scenario; recordings extend beyond their scene, so that its last steps have a whole future.
    steps: int = STEPS

    def recognise(self, path: Path) -> bool:
        """Return whether the file is SQLite and has the tables of a nuPlan log."""
        try:
            with open_database(path) as database:
                return all(database.columns(table) for table in _SIGNATURE)
        except (OSError, DrivaxError):
            return False

    def describe(self, path: Path) -> Description:
        """Describe the content of the log, and whether its map is present."""
        with open_database(path) as database:
            log = _open_log(database, path)
        parts, times = pieces(log.line, self.steps), log.line.time_us
        scenes = len({piece.scene for piece in parts})
        notes = [
            f"map {log.map_name}",
            f"{(times[-1] - times[0]) * 1e-6:.0f} s of driving in {scenes} scenes",
        ]
        missing: tuple[str, ...] = ()
        try:
            find_map(path, log.map_name)
        except DataError as error:
            missing = (f"maps/{log.map_name}/<version>/map.gpkg",)
            notes.append(str(error))
        return Description("nuPlan", "SQLite log", None, len(parts), tuple(notes), missing)

    def count(self, path: Path) -> int:
        """Return the number of windows of 91 steps at the usual stride; 0 if the log is unreadable."""
        try:
            with open_database(path) as database:
                return sum(
                    parsing.windows_of(len(piece.sweeps)) for piece in pieces(time_line(database), self.steps)
                )
        except DataError:
            return 0

    def companion_files(self, path: Path) -> tuple[Path, ...]:
        """Return all maps, and the file that lists them."""
        return map_files(path)

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """Yield the recording of each :class:`Piece` in order of time, or a bad record in its place."""
        try:
            with open_database(path) as database:
                log = _open_log(database, path)
                city = city_map(find_map(path, log.map_name))
                agents_by_token = agents(database)
                for piece in pieces(log.line, self.steps):
                    yield attempt(_recording, log, piece, agents_by_token, city, file=path, record=piece.name)
        except DataError as error:
            yield BadRecord.of(error, path)


@dataclass(frozen=True)
class TimeLine:
    """Tokens, times and scene tokens (None without a scene) of the lidar sweeps of a log, in order of time."""

    tokens: tuple[Any, ...]
    time_us: Int64[np.ndarray, " sweep"]
    scenes: tuple[Any, ...]


@dataclass(frozen=True)
class Piece:
    """The steps of one recording: a scene or a part of it, with up to 10 steps before and a scenario's future after it.

    Therefore the current steps of its windows lie in the scene, while windows may cross the borders of scenes.

    Attributes:
        name: Token of the scene in hexadecimal digits (else ``no-scene``), with a number where it occurs again.
        scene: Token of the scene.
        sweeps: Rows of the time line, one per step of 0.1 s.
        scene_sweeps: Rows of the scene or its part alone, first and one past the last (at 20 Hz perhaps one too many).
    """

    name: str
    scene: Any
    sweeps: Int64[np.ndarray, " step"]
    scene_sweeps: tuple[int, int]


#: Number and kind of every track of a log by token.
_Agents = Mapping[Any, tuple[int, AgentKind]]


@dataclass(frozen=True)
class Log:
    """An open log: its name (else the file's), the name of its map, its time line, the number of unknown fields."""

    database: Database
    name: str
    map_name: str
    line: TimeLine
    unknown_fields: int


def _open_log(database: Database, path: Path) -> Log:
    """Check the tables of a log, and read its names and its time line."""
    for table, columns in TABLES.items():
        database.require(table, *columns)
    rows = database.rows("SELECT logfile, map_version FROM log")
    if not rows or not isinstance(rows[0][1], str) or not rows[0][1]:
        raise DataError("its table log names no map", file=path, cure="download the file again")
    name, map_name = rows[0]
    name = name if isinstance(name, str) and name else path.stem
    return Log(database, name, map_name.removesuffix(".gpkg"), time_line(database), _unknown_fields(database))


def _unknown_fields(database: Database) -> int:
    """Count unknown tables, and unknown columns of the tables that are read."""
    columns = sum(len(database.columns(table) - _UNUSED.union(names)) for table, names in TABLES.items())
    return len(database.tables() - TABLES.keys() - _UNUSED) + columns


def time_line(database: Database) -> TimeLine:
    """Return all lidar sweeps in order of time."""
    rows = database.rows("SELECT token, timestamp, scene_token FROM lidar_pc")
    if not rows:
        raise DataError("has no lidar sweep", file=database.path, cure="download the file again")
    if not all(isinstance(time, int) for _, time, _ in rows):
        raise DataError("a lidar sweep has no timestamp", file=database.path, cure="download the file again")
    tokens, times, scenes = zip(*sorted(rows, key=itemgetter(1)), strict=True)
    return TimeLine(tokens, np.array(times, np.int64), scenes)


def pieces(line: TimeLine, steps: int = STEPS) -> list[Piece]:
    """Cut a time line at gaps and scenes, and long scenes, into pieces of 10 Hz for scenarios of ``steps`` steps.

    Of sweeps at 20 Hz every second one is taken, counted from the last gap. A piece that is too short for a window is
    dropped: its steps are in the future of the previous piece, or in the past of the next one. If the time between two
    gaps is too short for a window, its first piece is kept.
    """
    recordings: list[Piece] = []
    counts: dict[str, int] = {}
    step = _sweeps_per_step(line.time_us)
    ends = np.flatnonzero(np.diff(line.time_us) > _GAP_US) + 1
    for first, last in zip((0, *ends), (*ends, len(line.tokens)), strict=True):
        sweeps = np.arange(first, last, step)
        for begin, end in _scenes(line, sweeps):
            span = slice(max(begin - CURRENT_STEP, 0), min(end + steps - CURRENT_STEP - 1, len(sweeps)))
            if span.stop - span.start < steps and (begin > 0 or len(sweeps) >= steps):
                continue
            scene = line.scenes[sweeps[begin]]
            name = scene.hex() if isinstance(scene, bytes) and 0 < len(scene) <= 16 else "no-scene"
            number = counts[name] = counts.get(name, 0) + 1
            name += f".{number}" if number > 1 else ""
            scene_sweeps = int(sweeps[begin]), int(sweeps[end - 1]) + step
            recordings.append(Piece(name, scene, sweeps[span], scene_sweeps))
    return recordings


def _sweeps_per_step(time_us: Int64[np.ndarray, " sweep"]) -> int:
    """Return the number of sweeps per step of 10 Hz: 2 at 20 Hz, 1 at 10 Hz, within 10 ms."""
    median_us = float(np.median(np.diff(time_us))) if len(time_us) > 1 else 1e5
    if 40_000 <= median_us <= 60_000:
        return 2
    if 90_000 <= median_us <= 110_000:
        return 1
    problem = f"lidar sweeps come every {median_us / 1e3:.0f} ms, not every 50 or 100 ms"
    raise DataError(problem, cure="use an unaltered log")


def _scenes(line: TimeLine, sweeps: Int64[np.ndarray, " step"]) -> list[tuple[int, int]]:
    """Return the steps of each scene, first and one past the last; long scenes in pieces."""
    scenes = [line.scenes[sweep] for sweep in sweeps]
    begins = [step for step in range(len(scenes)) if step == 0 or scenes[step] != scenes[step - 1]]
    return [
        (start, min(start + _LONGEST_PIECE, end))
        for begin, end in zip(begins, (*begins[1:], len(scenes)), strict=True)
        for start in range(begin, end, _LONGEST_PIECE)
    ]


def _numbers(rows: Sequence[Sequence[Any]], width: int, what: str) -> Float64[np.ndarray, "row column"]:
    """Return rows of numbers; NaN where a cell is NULL."""
    try:
        return np.array(rows, dtype=np.float64).reshape(len(rows), width)
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{what} contains a value that is not a number", cure=_CURE) from error


def _check(values: Float64[np.ndarray, "*shape"], most: float, what: str) -> None:
    """Refuse numbers that are not finite or too large."""
    if not (np.abs(values) <= most).all():  # NaN compares false
        raise DataError(f"{what} is missing or implausible", cure=_CURE)


def agents(database: Database) -> _Agents:
    """Return numbers (from 1 in order of the table) and kinds of a log's tracks by token."""
    names = dict(database.rows("SELECT token, name FROM category"))
    rows = database.rows("SELECT token, category_token FROM track ORDER BY rowid")
    kinds = {token: _KINDS.get(names.get(category, ""), AgentKind.OTHER) for token, category in rows}
    return {token: (number, kind) for number, (token, kind) in enumerate(kinds.items(), start=1)}


def tracks(log: Log, piece: Piece, agents_by_token: _Agents) -> tuple[Tracks, dict[str, int]]:
    """Return the tracks of a piece, ego in row 0, and counts of boxes without a track and of repeated boxes.

    Of several boxes of a track in a sweep, the last one counts.
    """
    steps = len(piece.sweeps)
    boxes, box_keys, lost = _boxes(log, piece, agents_by_token)
    tokens = sorted({token for _, token in box_keys}, key=lambda token: agents_by_token[token][0])
    if (len(tokens) + 1) * steps > _MOST_CELLS:
        raise DataError(f"{len(tokens)} tracks in {steps} steps", cure=_CURE)
    rows = {token: row for row, token in enumerate(tokens, start=1)}
    shape = (len(tokens) + 1, steps)
    table, valid = np.zeros((*shape, 9)), np.zeros(shape, dtype=bool)
    table[0], valid[0] = _ego(log, piece), True
    if box_keys:
        row, step = np.array([(rows[token], step) for step, token in box_keys]).T
        table[row, step], valid[row, step] = boxes, True
    entries = [(EGO_TRACK_ID, AgentKind.VEHICLE), *(agents_by_token[token] for token in tokens)]
    states = Tracks(
        xy=table[..., 0:2].copy(),
        z=table[..., 2].copy(),
        heading=table[..., 3].copy(),
        size=table[..., 4:7].copy(),
        velocity=table[..., 7:9].copy(),
        valid=valid,
        kind=np.array([kind for _, kind in entries], np.int8),
        track_id=np.array([number for number, _ in entries], np.int64),
    )
    return states, {"boxes_without_track": lost, "repeated_boxes": len(box_keys) - len(set(box_keys))}


def _ego(log: Log, piece: Piece) -> Float64[np.ndarray, "step 9"]:
    """Return box centre, z (0), heading, size and velocity of ego.

    Poses are of the rear axle and velocities in ego's frame; in a turn the box centre moves sideways too:
    v_centre = R(yaw) (vx, vy + yaw rate x 1.461 m).
    """
    tokens = [log.line.tokens[sweep] for sweep in piece.sweeps]
    sweeps = dict(log.database.rows_in("SELECT token, ego_pose_token FROM lidar_pc WHERE token IN", tokens))
    query = "SELECT token, x, y, qw, qx, qy, qz, vx, vy, angular_rate_z FROM ego_pose WHERE token IN"
    poses = {token: pose for token, *pose in log.database.rows_in(query, list(sweeps.values()))}
    pose_of = {token: poses[pose] for token, pose in sweeps.items() if pose in poses}
    if missing := [token for token in tokens if token not in pose_of]:
        raise DataError(f"{len(missing)} sweeps have no ego pose", cure=_CURE)
    pose = _numbers([pose_of[token] for token in tokens], 9, "ego_pose")
    _check(pose[:, 0:2], _FARTHEST_M, "an ego position")
    _check(pose[:, 6:9], _FASTEST_MPS, "an ego velocity")
    if (np.hypot(*np.diff(pose[:, 0:2], axis=0).T) > _LONGEST_STEP_M).any():
        raise DataError("the ego jumps", cure=_CURE)
    heading = yaw_of(pose[:, 2:6])
    cos, sin = np.cos(heading), np.sin(heading)
    centre = parsing.box_centre(pose[:, 0:2], heading, REAR_AXLE_TO_CENTRE_M)
    velocity = np.stack((pose[:, 6], pose[:, 7] + REAR_AXLE_TO_CENTRE_M * pose[:, 8]), axis=-1)
    size = np.broadcast_to(EGO_SIZE_M, (len(pose), 3))
    return np.column_stack((centre, np.zeros(len(pose)), heading, size, rotate(velocity, cos, sin)))


def yaw_of(quaternion: Float64[np.ndarray, "pose 4"]) -> Float64[np.ndarray, " pose"]:
    """Return the yaw of quaternions (w, x, y, z), radians."""
    w, x, y, z = quaternion.T
    if not (np.abs(np.linalg.norm(np.clip(quaternion, -2.0, 2.0), axis=1) - 1.0) < 0.01).all():
        raise DataError("an ego orientation is not a unit quaternion", cure=_CURE)
    return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _read_observations(log: Log, piece: Piece, table: str, columns: str) -> list[tuple[Any, ...]]:
    """Read step and columns of all rows of a table that belong to sweeps of a piece, in order of steps."""
    step_of = {log.line.tokens[sweep]: step for step, sweep in enumerate(piece.sweeps)}
    query = f"SELECT lidar_pc_token, {columns} FROM {table} WHERE lidar_pc_token IN"
    rows = log.database.rows_in(query, list(step_of))
    # A damaged index may return rows of other sweeps.
    observations = [(step_of[row[0]], *row[1:]) for row in rows if row[0] in step_of]
    return sorted(observations, key=lambda row: row[0])


def _boxes(
    log: Log, piece: Piece, agents_by_token: _Agents
) -> tuple[Float64[np.ndarray, "box 9"], list[tuple[int, Any]], int]:
    """Read boxes (x, y, z, heading, length, width, height, vx, vy), their (step, track); count those without track."""
    columns = "track_token, x, y, z, yaw, length, width, height, vx, vy"
    rows = _read_observations(log, piece, "lidar_box", columns)
    with_track = [row for row in rows if row[1] in agents_by_token]
    boxes = _numbers([row[2:] for row in with_track], 9, "lidar_box")
    # Static objects have no velocity, and the size of a few is unknown.
    boxes[:, 4:9] = np.where(np.isnan(boxes[:, 4:9]), 0.0, boxes[:, 4:9])
    _check(boxes[:, 0:3], _FARTHEST_M, "the position of a box")
    _check(boxes[:, 3], _LARGEST_YAW_RAD, "the yaw of a box")
    _check(boxes[:, 4:7], _LONGEST_M, "the size of a box")
    _check(boxes[:, 7:9], _FASTEST_MPS, "the velocity of a box")
    boxes[:, 3] = wrap(boxes[:, 3])
    return boxes, [row[:2] for row in with_track], len(rows) - len(with_track)


def _scenario_types(log: Log, piece: Piece) -> list[str]:
    """Read the types of the scenario tags on any of the ``scene_sweeps``, sorted."""
    tokens = log.line.tokens[slice(*piece.scene_sweeps)]
    rows = log.database.rows_in("SELECT type FROM scenario_tag WHERE lidar_pc_token IN", tokens)
    return sorted({kind for (kind,) in rows if isinstance(kind, str) and kind})


def _roadblocks(log: Log, piece: Piece) -> list[int]:
    """Read ids of the roadblocks on the scene's route, separated by spaces (in nuPlan's documentation by commas)."""
    rows = log.database.rows("SELECT roadblock_ids FROM scene WHERE token = ?", (piece.scene,))
    text = rows[0][0] if rows else None
    words = text.replace(",", " ").split() if isinstance(text, str) else ()
    return [int(word) for word in words if word.isascii() and word.isdigit() and len(word) < 19]


def _recording(log: Log, piece: Piece, agents_by_token: _Agents, city: City) -> Recording:
    """Read the recording of a piece, with the map around it."""
    if len(piece.sweeps) <= CURRENT_STEP:
        problem = f"{len(piece.sweeps)} steps without a gap, fewer than {CURRENT_STEP + 1}"
        raise DataError(problem, cure="skip this record")
    states, lost_boxes = tracks(log, piece, agents_by_token)
    features, lost = features_around(city, states.xy[0])
    states, features = flatten(states, features)
    lights, lost_lights = _lights(log, piece, city, features)
    lanes = {feature.feature_id for feature in features}
    route, lost_roadblocks = corridor(city, _roadblocks(log, piece))
    scenario_types, time_us = _scenario_types(log, piece), log.line.time_us
    tags = {"source_format": _NAME} | parsing.place_tags(log.map_name)
    return Recording(
        scenario_id=piece.name,
        dataset=_NAME,
        segment=log.name,
        timestamps_s=(time_us[piece.sweeps] - time_us[0]) * 1e-6,
        current_step=CURRENT_STEP,
        ego=0,
        tracks=states,
        features=features,
        lights=lights,
        route_corridor=tuple(lane for lane in route if lane in lanes),
        tags=tags | ({"scenario_types": "|".join(scenario_types)} if scenario_types else {}),
        lost=parsing.nonzero(
            lost,
            **lost_boxes,
            lights=lost_lights,
            roadblocks=lost_roadblocks,
            unknown_fields=log.unknown_fields + city.unknown_layers,
        ),
    )


def _lights(
    log: Log, piece: Piece, city: City, features: tuple[MapFeature, ...]
) -> tuple[tuple[Light, ...], int]:
    """Read lights of connectors around the drive, with stop points at their starts; count unknown connectors."""
    starts = {feature.feature_id: feature.points[0].tolist() for feature in features}
    lights = parsing.Lights(len(piece.sweeps))
    unknown = set()
    rows = _read_observations(log, piece, "traffic_light_status", "lane_connector_id, status")
    for step, connector, status in rows:
        is_fid = isinstance(connector, int) and 0 <= connector < 2**32
        lane = feature_id("lane_connectors", connector) if is_fid else -1
        if lane in starts:
            lights.observe(step, lane, _LIGHT_STATES.get(status, LightState.UNKNOWN), starts[lane])
        elif lane not in city.lanes:
            unknown.add(connector)
    return lights.collect(features)[0], len(unknown)
