"""Reader of Argoverse 2 sensor logs: cuboids around the car, its poses and the local map; no images, no lidar."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from drivax.datasets import parsing
from drivax.datasets.argoverse import tables
from drivax.datasets.argoverse.map import MAP_PATTERN, read_map
from drivax.datasets.argoverse.tables import ArrowTable, Kind, read_table
from drivax.datasets.parsing import place_tags
from drivax.datasets.reader import BadRecord, Description, attempt, read_head
from drivax.errors import DataError
from drivax.scenario.recording import Recording, Tracks, differentiate
from drivax.scenario.schema import CURRENT_STEP, AgentKind, Flag

Array = np.ndarray[Any, Any]

EGO = "EGO_VEHICLE"
POSES = "city_SE3_egovehicle.feather"
_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_FORWARD = np.array([1.0, 0.0, 0.0])
_SIZE = ("length_m", "width_m", "height_m")
_POSE_COLUMNS: dict[str, Kind] = {"timestamp_ns": "integer", **dict.fromkeys(_POSE, "number")}
_BOX_COLUMNS: dict[str, Kind] = {
    **_POSE_COLUMNS, **dict.fromkeys(_SIZE, "number"), "track_uuid": "text", "category": "text"
}  # fmt: skip
#: Known columns that are not read.
_UNUSED_COLUMNS = {"num_interior_pts"}
_VEHICLES = (
    EGO, "REGULAR_VEHICLE", "LARGE_VEHICLE", "BUS", "SCHOOL_BUS", "ARTICULATED_BUS", "BOX_TRUCK", "TRUCK",
    "TRUCK_CAB", "VEHICULAR_TRAILER", "RAILED_VEHICLE",
)  # fmt: skip
_PEDESTRIANS = ("PEDESTRIAN", "OFFICIAL_SIGNALER", "STROLLER", "WHEELCHAIR")
_CYCLISTS = ("BICYCLE", "BICYCLIST", "MOTORCYCLE", "MOTORCYCLIST", "WHEELED_DEVICE", "WHEELED_RIDER")
_STATIC_OBJECTS = (
    "BOLLARD", "CONSTRUCTION_BARREL", "CONSTRUCTION_CONE", "SIGN", "STOP_SIGN", "MESSAGE_BOARD_TRAILER",
    "MOBILE_PEDESTRIAN_CROSSING_SIGN", "TRAFFIC_LIGHT_TRAILER",
)  # fmt: skip
#: Kind by category; animals, and categories that later versions may add, are OTHER.
_KINDS = {
    **dict.fromkeys(_VEHICLES, AgentKind.VEHICLE),
    **dict.fromkeys(_PEDESTRIANS, AgentKind.PEDESTRIAN),
    **dict.fromkeys(_CYCLISTS, AgentKind.CYCLIST),
    **dict.fromkeys(_STATIC_OBJECTS, AgentKind.STATIC),
}

_SKIP = "skip this log, or download it again"


@dataclass(frozen=True)
class ArgoverseSensor:
    """Reader of sensor logs: about 157 frames at 10 Hz with measured boxes, heights, and the local map."""

    name: str = "av2-sensor"
    patterns: tuple[str, ...] = ("annotations.feather", "annotations_with_ego.feather")
    companions: tuple[str, ...] = (
        POSES, MAP_PATTERN, "*___img_Sim2_city.json", "*_ground_height_surface_*.npy"
    )  # fmt: skip

    def recognise(self, path: Path) -> bool:
        """Return whether the file is feather and named like the annotations of a log."""
        return path.name in self.patterns and read_head(path, 6) == b"ARROW1"

    def describe(self, path: Path) -> Description:
        """Describe frames, tracks and city of the log, and whether its poses and map are present."""
        table = read_table(path, {"timestamp_ns": "integer", "track_uuid": "text"})
        frames, tracks = len(np.unique(table.numbers["timestamp_ns"])), len(table.texts["track_uuid"].words)
        map_path = _map_path(path)
        files = {POSES: path.with_name(POSES).is_file(), f"map/{MAP_PATTERN}": map_path is not None}
        return Description(
            dataset="Argoverse 2 Sensor",
            flavour=f"one log of {frames} frames in {_place_tags(map_path).get('place', 'an unknown city')}",
            recordings=1,
            notes=(f"{tracks} tracks", "there are no speed limits, lights or stop signs"),
            missing=tuple(name for name, exists in files.items() if not exists),
        )

    def count(self, path: Path) -> int:
        """Return the number of windows of a log; 0 if its annotations cannot be read."""
        try:
            times = read_table(path, {"timestamp_ns": "integer"}).numbers["timestamp_ns"]
        except DataError:
            return 0
        return parsing.windows_of(len(np.unique(times)))

    def companion_files(self, path: Path) -> tuple[Path, ...]:
        """Return the poses and the files of the map."""
        return (path.with_name(POSES), *sorted((path.parent / "map").glob("*")))

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """Yield the recording of a log, or the bad record in its place."""
        yield attempt(decode, path, file=path)


def _map_path(path: Path) -> Path | None:
    """Return the path of a log's map, None for a missing one."""
    return next(iter(sorted((path.parent / "map").glob(MAP_PATTERN))), None)


def _place_tags(map_path: Path | None) -> dict[str, str]:
    """Return the tags of the city in a map's name: ``log_map_archive_<log>____MIA_city_<number>.json``."""
    _, _, ending = ("" if map_path is None else map_path.stem).partition("____")
    return place_tags(ending.split("_")[0])


def decode(path: Path) -> Recording:
    """Return the recording of a log: its annotations, ``city_SE3_egovehicle.feather`` and its map.

    Positions are in the city's frame, metres. Boxes are transformed from the car's frame by the pose of the same
    timestamp, the ego is moved from its rear axle to its box centre; velocities are finite differences of positions.
    """
    boxes = read_table(path, _BOX_COLUMNS)
    poses = read_table(path.with_name(POSES), _POSE_COLUMNS)
    map_path = _map_path(path)
    if map_path is None:
        problem = f"has no map/{MAP_PATTERN} next to it"
        raise DataError(problem, file=path, cure="download the folder map of the log")
    local_map = read_map(map_path)
    log_id = path.resolve().parent.name
    try:
        times_ns, lost_frames = _frame_times(boxes, poses)
        tracks, repeated = _tracks(boxes, poses, times_ns)
    except DataError as error:
        raise DataError(error.problem, file=path, cure=error.cure or _SKIP) from error
    return Recording(
        scenario_id=log_id,
        dataset=tables.DATASET,
        segment=log_id,
        timestamps_s=times_ns * 1e-9,
        current_step=min(CURRENT_STEP, len(times_ns) - 1),
        ego=0,
        tracks=tracks,
        features=local_map.features,
        tags={"source_format": "av2-sensor"} | _place_tags(map_path),
        lost=parsing.nonzero(
            local_map.lost,
            frames_without_pose=lost_frames,
            repeated_rows=repeated,
            unknown_fields=len((boxes.unread - _UNUSED_COLUMNS) | poses.unread),
        ),
        flags=Flag.DIFFERENTIATED_VELOCITY,
    )


def _frame_times(boxes: ArrowTable, poses: ArrowTable) -> tuple[Int[Array, " step"], int]:
    """Return the timestamps of frames that have a pose, and the number of frames without one."""
    frames = np.unique(boxes.numbers["timestamp_ns"])
    has_pose = np.isin(frames, poses.numbers["timestamp_ns"])
    if not has_pose.any():
        raise DataError(f"no frame has a pose in {POSES}")
    return frames[has_pose], int((~has_pose).sum())


def _tracks(boxes: ArrowTable, poses: ArrowTable, times_ns: Int[Array, " step"]) -> tuple[Tracks, int]:
    """Return all tracks, ego in row 0 and valid at every step, and the number of repeated boxes.

    Positions are in the city's frame. Of several boxes of a track at the same time, the last one counts.
    """
    pose = _poses(poses, times_ns)
    stamp, code = boxes.numbers["timestamp_ns"], boxes.texts["track_uuid"].of_row
    category = boxes.texts["category"]
    is_ego = np.array([name == EGO for name in category.words])[category.of_row]
    rows = np.flatnonzero(np.isin(stamp, times_ns) & ~is_ego)
    # ``first`` is the first box of each track, ``row`` the track of each box; both leave the ego out.
    codes, first, row = np.unique(code[rows], return_index=True, return_inverse=True)
    if (1 + len(codes)) * len(times_ns) > tables.MOST_STATES:
        raise DataError(f"{len(codes)} tracks of {len(times_ns)} frames are too many")
    step = np.searchsorted(times_ns, stamp[rows])
    table = _boxes(boxes, rows, pose[step])
    states = np.zeros((1 + len(codes), len(times_ns), table.shape[1]))
    valid = np.zeros(states.shape[:2], bool)
    states[1 + row, step], valid[1 + row, step] = table, True
    states[0], valid[0] = _ego(boxes, np.flatnonzero(is_ego), pose), True
    repeated = len(rows) - int(valid[1:].sum())
    kinds = [_KINDS.get(category.text(int(rows[number])), AgentKind.OTHER) for number in first]
    tracks = Tracks(
        xy=states[..., :2].copy(),
        z=states[..., 2].copy(),
        heading=states[..., 3].copy(),
        velocity=differentiate(states[..., :2], valid, times_ns * 1e-9),
        size=states[..., 4:].copy(),
        valid=valid,
        kind=np.array([AgentKind.VEHICLE, *kinds], np.int8),
        track_id=np.concatenate(([0], 1 + codes)),
    )
    return tracks, repeated


def _poses(poses: ArrowTable, times_ns: Int[Array, " step"]) -> Float[Array, "step 7"]:
    """Return the pose of the car at every frame: quaternion (w, x, y, z) and translation in the city."""
    stamps, rows = np.unique(poses.numbers["timestamp_ns"], return_index=True)
    pose = poses.stack(_POSE)[rows[np.searchsorted(stamps, times_ns)]]
    parsing.check_within(tables.FARTHEST_M, pose[:, 4:])
    pose[:, :4] = _normalise(pose[:, :4])
    return pose


def _boxes(boxes: ArrowTable, rows: Int[Array, " box"], pose: Float[Array, "box 7"]) -> Float[Array, "box 7"]:
    """Return boxes in the city's frame: x, y, z, heading, length, width, height."""
    table = boxes.stack((*_POSE, *_SIZE))[rows]
    parsing.check_within(tables.FARTHEST_M, table[:, 4:7])
    parsing.check_within(tables.LARGEST_M, table[:, 7:])
    forward = rotate(pose[:, :4], rotate(_normalise(table[:, :4]), _FORWARD))
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    return np.column_stack((rotate(pose[:, :4], table[:, 4:7]) + pose[:, 4:], heading, table[:, 7:]))


def _ego(boxes: ArrowTable, rows: Int[Array, " box"], pose: Float[Array, "step 7"]) -> Float[Array, "step 7"]:
    """Return the ego's boxes with the columns of :func:`_boxes`."""
    # Some logs hold boxes of the ego: use only their sizes, because their centres are at the rear axle, too.
    size = np.median(boxes.stack(_SIZE)[rows], axis=0) if len(rows) else np.array(tables.EGO_SIZE)
    parsing.check_within(tables.LARGEST_M, size)
    offset = np.array([tables.CENTRE_AHEAD_M, 0.0, size[2] / 2 - tables.AXLE_HEIGHT_M])
    centre = rotate(pose[:, :4], offset) + pose[:, 4:]
    forward = rotate(pose[:, :4], _FORWARD)
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    return np.column_stack((centre, heading, np.broadcast_to(size, (len(pose), 3))))


def rotate(quaternion: Float[Array, "row 4"], vector: Float[Array, "*rows 3"]) -> Float[Array, "row 3"]:
    """Rotate vectors v by unit quaternions (w, u): v + 2 w (u x v) + 2 u x (u x v)."""
    axis = quaternion[:, 1:]
    normal = 2.0 * np.cross(axis, np.broadcast_to(vector, axis.shape))
    return vector + quaternion[:, :1] * normal + np.cross(axis, normal)


def _normalise(quaternion: Float[Array, "row 4"]) -> Float[Array, "row 4"]:
    """Normalise quaternions; refuse those that are far from unit length."""
    parsing.check_within(2.0, quaternion)
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    if not (length > 0.5).all():
        raise DataError("a rotation is not a quaternion")
    return quaternion / length
