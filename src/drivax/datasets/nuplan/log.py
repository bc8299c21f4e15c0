"""The SQLite logs of nuPlan: their time line cut at scenes, and what each piece holds.

Tables and columns are those of the public schema, version 1.1. BLOBs that hold pickles (calibrations) are not read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from drivax.datasets.nuplan.sqlite import Database
from drivax.datasets.parsing import box_centre
from drivax.errors import DataError
from drivax.geometry.vectors import rotate, wrap
from drivax.scenario.recording import Tracks
from drivax.scenario.schema import CURRENT_STEP, STEPS, AgentKind, LightState

Array = np.ndarray[Any, Any]

#: Tables and columns that are read; a file with all of these tables is a nuPlan log.
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
#: Length, width and height of the ego (Chrysler Pacifica), metres.
EGO_SIZE_M = (5.176, 2.297, 1.777)
#: From the rear axle, where ego poses are, to the middle of the box: (front 4.049 m - rear 1.127 m) / 2.
REAR_AXLE_TO_CENTRE_M = 1.461
EGO_TRACK_ID = 0
#: More than one missing lidar sweep is a gap: what is before and after it is never one recording.
_GAP_US = 120_000
#: Scenes that last longer are read in pieces of this many steps: a multiple of the usual stride of windows.
_LONGEST_PIECE = 400
_TOKENS_AT_ONCE = 500
#: Beyond these, numbers are damaged: UTM coordinates, m/s, metres of a box, metres of ego between two steps.
_FARTHEST_M, _FASTEST_MPS, _LONGEST_M, _LONGEST_STEP_M = 2e7, 300.0, 200.0, 20.0
#: Cells of one array of tracks by steps; real scenes have up to a thousand tracks.
_MOST_CELLS = 2_000_000
_CURE = "skip this record, or download the file again"
_KINDS = {
    "vehicle": AgentKind.VEHICLE,
    "bicycle": AgentKind.CYCLIST,
    "pedestrian": AgentKind.PEDESTRIAN,
    "traffic_cone": AgentKind.STATIC,
    "barrier": AgentKind.STATIC,
    "czone_sign": AgentKind.STATIC,
    "generic_object": AgentKind.STATIC,
}
_LIGHT_STATES = {"green": LightState.GO, "yellow": LightState.CAUTION, "red": LightState.STOP}


@dataclass(frozen=True)
class TimeLine:
    """The lidar sweeps of a log in order of time.

    Attributes:
        tokens: Token of each sweep.
        time_us: Microseconds.
        scenes: Token of the scene of each sweep, None where it has none.
    """

    tokens: tuple[Any, ...]
    time_us: Int64[np.ndarray, " sweep"]
    scenes: tuple[Any, ...]


@dataclass(frozen=True)
class Piece:
    """What becomes one recording: the steps of a scene, with 10 steps before it and 80 after it where there are.

    So the current steps of its windows are the steps of the scene, and windows run over the borders of scenes
    without any of them being cut twice.

    Attributes:
        name: Token of the scene in hexadecimal digits, and a number where the scene has several pieces.
        scene: Token of the scene.
        sweeps: Rows of the time line, one per step of 0.1 s.
        own: Sweeps of the time line that belong to the scene itself, first and one past the last.
    """

    name: str
    scene: Any
    sweeps: Int64[np.ndarray, " step"]
    own: tuple[int, int]


@dataclass(frozen=True)
class Agents:
    """The kind and number of every track of a log, by token."""

    kinds: Mapping[Any, AgentKind]
    numbers: Mapping[Any, int]


def log_names(database: Database, path: Path) -> tuple[str, str]:
    """Name of the log (of the file, where the table has none) and name of its map."""
    rows = database.rows("SELECT logfile, map_version FROM log")
    if not rows or not isinstance(rows[0][1], str) or not rows[0][1]:
        raise DataError("its table log names no map", file=path, cure="download the file again")
    name, map_name = rows[0]
    return (name if isinstance(name, str) and name else path.stem), map_name.removesuffix(".gpkg")


def time_line(database: Database) -> TimeLine:
    """All lidar sweeps in order of time."""
    rows = database.rows("SELECT token, timestamp, scene_token FROM lidar_pc ORDER BY timestamp")
    if not rows:
        raise DataError("has no lidar sweep", file=database.path, cure="download the file again")
    if not all(isinstance(time, int) for _, time, _ in rows):
        raise DataError("a lidar sweep has no timestamp", file=database.path, cure="download the file again")
    tokens, times, scenes = zip(*rows, strict=True)
    return TimeLine(tokens, np.array(times, np.int64), scenes)


def pieces(line: TimeLine) -> list[Piece]:
    """Cuts a time line at gaps, at scenes, and where scenes are long, into pieces of 10 Hz.

    Of sweeps at 20 Hz every second is taken, counted from the last gap. What remains too short for a window after
    the last scene is left out: it is the future of the windows before.
    """
    recordings: list[Piece] = []
    counts: dict[Any, int] = {}
    step = _every(line.time_us)
    ends = np.flatnonzero(np.diff(line.time_us) > _GAP_US) + 1
    for first, last in zip((0, *ends), (*ends, len(line.tokens)), strict=True):
        sweeps = np.arange(first, last, step)
        for begin, end in _scenes(line, sweeps):
            part = slice(max(begin - CURRENT_STEP, 0), min(end + STEPS - CURRENT_STEP - 1, len(sweeps)))
            if part.stop - part.start < STEPS and (begin > 0 or len(sweeps) >= STEPS):
                continue
            scene = line.scenes[sweeps[begin]]
            number = counts[scene] = counts.get(scene, 0) + 1
            name = _hexadecimal(scene) + (f".{number}" if number > 1 else "")
            own = int(sweeps[begin]), int(sweeps[end - 1]) + step
            recordings.append(Piece(name, scene, sweeps[part], own))
    return recordings


def _every(time_us: Int64[np.ndarray, " sweep"]) -> int:
    """Which sweeps make 10 Hz: 2 for every second, 1 for each."""
    usual = float(np.median(np.diff(time_us))) if len(time_us) > 1 else 1e5
    if 40_000 <= usual <= 60_000:
        return 2
    if 90_000 <= usual <= 110_000:
        return 1
    raise DataError(
        f"lidar sweeps come every {usual / 1e3:.0f} ms, not every 50 or 100 ms", cure="use an unaltered log"
    )


def _scenes(line: TimeLine, sweeps: Int64[np.ndarray, " step"]) -> list[tuple[int, int]]:
    """Steps of each scene, first and one past the last; long ones in parts."""
    scenes = [line.scenes[sweep] for sweep in sweeps]
    begins = [step for step in range(len(scenes)) if step == 0 or scenes[step] != scenes[step - 1]]
    ranges = []
    for begin, end in zip(begins, (*begins[1:], len(scenes)), strict=True):
        starts = range(begin, end, _LONGEST_PIECE)
        ranges += [(start, min(start + _LONGEST_PIECE, end)) for start in starts]
    return ranges


def _hexadecimal(token: Any) -> str:
    return token.hex() if isinstance(token, bytes) and 0 < len(token) <= 16 else "no-scene"


def timestamps(line: TimeLine, piece: Piece) -> Float64[np.ndarray, " step"]:
    """Seconds since the first sweep of the log, by the clock of the lidar."""
    return (line.time_us[piece.sweeps] - line.time_us[0]) * 1e-6


def _rows(database: Database, query: str, tokens: Sequence[Any]) -> list[tuple[Any, ...]]:
    """Rows of a query that ends in ``IN``, for any number of tokens."""
    result = []
    for start in range(0, len(tokens), _TOKENS_AT_ONCE):
        part = tokens[start : start + _TOKENS_AT_ONCE]
        result += database.rows(f"{query} ({', '.join('?' * len(part))})", part)
    return result


def _numbers(rows: Sequence[Sequence[Any]], width: int, what: str) -> Float64[np.ndarray, "row column"]:
    """Rows of numbers; NaN where a cell is NULL."""
    try:
        return np.array(rows, dtype=np.float64).reshape(len(rows), width)
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"{what} holds something that is no number", cure=_CURE) from error


def _check(values: Float64[np.ndarray, "*shape"], most: float, what: str) -> None:
    """Refuse what is not finite or too large to be true."""
    if not (np.abs(values) <= most).all():  # NaN compares false
        raise DataError(f"{what} is missing or absurd", cure=_CURE)


def agents(database: Database) -> Agents:
    """The tracks of a log: their kinds, and numbers counting from 1 in order of the table."""
    rows = database.rows(
        "SELECT t.token, c.name FROM track AS t LEFT JOIN category AS c ON c.token = t.category_token ORDER BY t.rowid"
    )
    kinds = {token: _KINDS.get(name, AgentKind.OTHER) for token, name in rows}
    return Agents(kinds, {token: number for number, token in enumerate(kinds, start=1)})


def tracks(database: Database, line: TimeLine, piece: Piece, known: Agents) -> tuple[Tracks, dict[str, int]]:
    """All tracks of a piece, the ego in row 0, and what was left out."""
    steps = len(piece.sweeps)
    boxes, owners, left_out = _boxes(database, line, piece, known)
    tokens = sorted({owner for _, owner in owners}, key=lambda token: known.numbers[token])
    if (len(tokens) + 1) * steps > _MOST_CELLS:
        raise DataError(f"{len(tokens)} tracks in {steps} steps", cure=_CURE)
    rows = {token: row for row, token in enumerate(tokens, start=1)}
    shape = (len(tokens) + 1, steps)
    table, valid = np.zeros((*shape, 9)), np.zeros(shape, dtype=bool)
    table[0], valid[0] = _ego(database, line, piece), True
    if owners:
        at = np.array([(rows[owner], step) for step, owner in owners]).T
        table[at[0], at[1]], valid[at[0], at[1]] = boxes, True
    states = Tracks(
        xy=table[..., 0:2].copy(),
        z=table[..., 2].copy(),
        heading=table[..., 3].copy(),
        size=table[..., 4:7].copy(),
        velocity=table[..., 7:9].copy(),
        valid=valid,
        kind=np.array([AgentKind.VEHICLE, *(known.kinds[token] for token in tokens)], np.int8),
        track_id=np.array([EGO_TRACK_ID, *(known.numbers[token] for token in tokens)], np.int64),
    )
    return states, left_out


def _ego(database: Database, line: TimeLine, piece: Piece) -> Float64[np.ndarray, "step 9"]:
    """Box centre, z (0), heading, size and velocity of the ego.

    Poses are of the rear axle, velocities are in the ego's frame; the centre of the box moves sideways as well while
    the car turns: v_centre = R(yaw) (vx, vy + yaw rate x 1.461 m).
    """
    tokens = [line.tokens[sweep] for sweep in piece.sweeps]
    rows = _rows(
        database,
        "SELECT p.token, e.x, e.y, e.qw, e.qx, e.qy, e.qz, e.vx, e.vy, e.angular_rate_z "
        "FROM lidar_pc AS p JOIN ego_pose AS e ON e.token = p.ego_pose_token WHERE p.token IN",
        tokens,
    )
    by_token = {row[0]: row[1:] for row in rows}
    if missing := [token for token in tokens if token not in by_token]:
        raise DataError(f"{len(missing)} sweeps have no ego pose", cure=_CURE)
    pose = _numbers([by_token[token] for token in tokens], 9, "ego_pose")
    _check(pose[:, 0:2], _FARTHEST_M, "an ego position")
    _check(pose[:, 6:9], _FASTEST_MPS, "an ego velocity")
    if (np.hypot(*np.diff(pose[:, 0:2], axis=0).T) > _LONGEST_STEP_M).any():
        raise DataError("the ego jumps", cure=_CURE)
    heading = yaw_of(pose[:, 2:6])
    cos, sin = np.cos(heading), np.sin(heading)
    centre = box_centre(pose[:, 0:2], heading, REAR_AXLE_TO_CENTRE_M)
    moving = np.stack((pose[:, 6], pose[:, 7] + REAR_AXLE_TO_CENTRE_M * pose[:, 8]), axis=-1)
    size = np.broadcast_to(EGO_SIZE_M, (len(pose), 3))
    return np.column_stack((centre, np.zeros(len(pose)), heading, size, rotate(moving, cos, sin)))


def yaw_of(quaternion: Float64[np.ndarray, "pose 4"]) -> Float64[np.ndarray, " pose"]:
    """Heading of the x axis after the rotation by quaternions (w, x, y, z), radians."""
    w, x, y, z = quaternion.T
    if not (np.abs(np.linalg.norm(np.clip(quaternion, -2.0, 2.0), axis=1) - 1.0) < 0.01).all():
        raise DataError("an ego orientation is no unit quaternion", cure=_CURE)
    return np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _observed(
    database: Database, line: TimeLine, piece: Piece, table: str, columns: str
) -> list[tuple[Any, ...]]:
    """Step and columns of all rows of a table that belong to sweeps of a piece, in order of steps."""
    steps = {line.tokens[sweep]: step for step, sweep in enumerate(piece.sweeps)}
    query = f"SELECT lidar_pc_token, {columns} FROM {table} WHERE lidar_pc_token IN"
    rows = _rows(database, query, list(steps))
    # A damaged index leads to rows of other sweeps.
    kept = [(steps[row[0]], *row[1:]) for row in rows if row[0] in steps]
    return sorted(kept, key=lambda row: row[0])


def _boxes(
    database: Database, line: TimeLine, piece: Piece, known: Agents
) -> tuple[Float64[np.ndarray, "box 9"], list[tuple[int, Any]], dict[str, int]]:
    """Boxes (x, y, z, heading, length, width, height, vx, vy), their (step, track token), and what was left out."""
    columns = "track_token, x, y, z, yaw, length, width, height, vx, vy"
    rows = _observed(database, line, piece, "lidar_box", columns)
    kept = [row for row in rows if row[1] in known.kinds]
    boxes = _numbers([row[2:] for row in kept], 9, "lidar_box")
    # Static things have no velocity, and the size of a few is unknown.
    boxes[:, 4:9] = np.where(np.isnan(boxes[:, 4:9]), 0.0, boxes[:, 4:9])
    _check(boxes[:, 0:3], _FARTHEST_M, "the position of a box")
    _check(boxes[:, 3], 1e4, "the yaw of a box")
    _check(boxes[:, 4:7], _LONGEST_M, "the size of a box")
    _check(boxes[:, 7:9], _FASTEST_MPS, "the velocity of a box")
    boxes[:, 3] = wrap(boxes[:, 3])
    left_out = {"boxes_without_track": len(rows) - len(kept)} if len(kept) < len(rows) else {}
    return boxes, [row[:2] for row in kept], left_out


def light_states(database: Database, line: TimeLine, piece: Piece) -> list[tuple[int, Any, LightState]]:
    """(step, lane connector, state) of all observed lights, in order of steps."""
    rows = _observed(database, line, piece, "traffic_light_status", "lane_connector_id, status")
    return [
        (step, connector, _LIGHT_STATES.get(status, LightState.UNKNOWN)) for step, connector, status in rows
    ]


def scenario_types(database: Database, line: TimeLine, piece: Piece) -> tuple[str, ...]:
    """Types of the scenario tags on any sweep of the piece's own part of its scene, sorted."""
    tokens = line.tokens[slice(*piece.own)]
    rows = _rows(database, "SELECT DISTINCT type FROM scenario_tag WHERE lidar_pc_token IN", tokens)
    return tuple(sorted({kind for (kind,) in rows if isinstance(kind, str) and kind}))


def roadblocks(database: Database, piece: Piece) -> tuple[int, ...]:
    """Ids of the roadblocks of the scene's route in order; empty where the scene has none.

    They are separated by spaces in the files and by commas in the documentation.
    """
    rows = database.rows("SELECT roadblock_ids FROM scene WHERE token = ?", (piece.scene,))
    text = rows[0][0] if rows else None
    words = text.replace(",", " ").split() if isinstance(text, str) else ()
    return tuple(int(word) for word in words if word.isascii() and word.isdigit() and len(word) < 19)
