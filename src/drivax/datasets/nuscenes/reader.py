"""Reader of nuScenes as its makers ship it: JSON tables of 2 Hz keyframes and one map file per city."""

from __future__ import annotations

import json
import math
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from drivax.datasets.nuscenes.map import city
from drivax.datasets.parsing import box_centre, check_finite, flatten, nonzero, place_tags, windows_of
from drivax.datasets.reader import BadRecord, Description, attempt
from drivax.errors import DataError
from drivax.geometry.vectors import wrap
from drivax.reading import check_regular
from drivax.scenario.recording import Recording, Tracks
from drivax.scenario.schema import CURRENT_STEP, DT_S, AgentKind, Flag

Array = np.ndarray[Any, Any]

_TABLES = (
    "category", "ego_pose", "instance", "log", "sample", "sample_annotation", "sample_data", "scene",
)  # fmt: skip
_UNUSED_TABLES = ("attribute", "calibrated_sensor", "map", "sensor", "visibility", "lidarseg", "panoptic")
#: Known fields of ``_TABLES``; some are not read.
_FIELDS = frozenset((
    "token", "name", "description", "index", "translation", "rotation", "timestamp", "category_token",
    "nbr_annotations", "first_annotation_token", "last_annotation_token", "logfile", "vehicle", "date_captured",
    "location", "scene_token", "prev", "next", "sample_token", "instance_token", "visibility_token",
    "attribute_tokens", "size", "num_lidar_pts", "num_radar_pts", "ego_pose_token", "calibrated_sensor_token",
    "fileformat", "is_key_frame", "height", "width", "filename", "log_token", "nbr_samples", "first_sample_token",
    "last_sample_token",
))  # fmt: skip
#: Keyframes are 0.5 s apart; the gap of a missing one is not interpolated.
LONGEST_GAP_S = 0.75
#: Steps of a usual scene (40 keyframes), and longest plausible duration of a scene, s.
_SCENE_STEPS, _LONGEST_S = 196, 120.0
#: Margin around the ego's log within which the map is used.
MARGIN_M = 150.0
#: The ego is a Renault Zoe: length, width, height, and how far its centre lies ahead of the rear axle (half the length
#: less the rear overhang), from the maker's data sheet; poses are of the rear axle (nuscenes-devkit, issue 108).
EGO_SIZE_M, CENTRE_AHEAD_M = (4.084, 1.730, 1.562), 1.385
#: Characters that are read at a time, and limits of a table: characters of a row, rows, characters of a text. All of
#: nuScenes has 2.6 million rows in a table, of 700 characters, and tokens of 32.
_CHUNK, _LONGEST_ROW, _MOST_ROWS, _LONGEST_TEXT = 1 << 20, 1 << 20, 8_000_000, 256
_SEPARATOR = re.compile(r"[ \t\r\n,]*")
_AGAIN = "unpack the metadata archive again"
#: Kind by the beginning of a category's name; the first match counts.
_KINDS = (
    ("vehicle.bicycle", AgentKind.CYCLIST),
    ("vehicle.motorcycle", AgentKind.CYCLIST),
    ("vehicle.", AgentKind.VEHICLE),
    ("human.", AgentKind.PEDESTRIAN),
    ("movable_object.", AgentKind.STATIC),
    ("static_object.", AgentKind.STATIC),
)
#: Sensor whose frames (20 Hz) give the ego's poses; frames of other sensors lie between them.
_POSE_SENSOR = "LIDAR_TOP"


@dataclass(frozen=True)
class NuScenes:
    """Reader of the tables of one version (``v1.0-mini``, ``v1.0-trainval``); each scene is a recording."""

    name: str = "nuscenes"
    patterns: tuple[str, ...] = ("v1.0-*/scene.json",)
    companions: tuple[str, ...] = (
        *(f"v1.0-*/{table}.json" for table in (*_TABLES, *_UNUSED_TABLES) if table != "scene"),
        "maps/*.json", "expansion/*.json", "maps/*/*.json",
    )  # fmt: skip

    def recognise(self, path: Path) -> bool:
        """Return whether the file is ``scene.json`` with the table of samples next to it."""
        return path.name == "scene.json" and (path.parent / "sample.json").is_file()

    def describe(self, path: Path) -> Description:
        """Describe version, number of scenes, missing tables and maps."""
        folder = path.parent
        absent = (table for table in _TABLES if not (folder / f"{table}.json").is_file())
        missing = [f"{folder.name}/{table}.json" for table in absent]
        expansion = sorted(path.name for path in _maps(path).glob("*.json"))
        if not expansion:
            missing.append("maps/expansion/*.json (the map expansion pack)")
        notes = [
            f"maps: {', '.join(expansion) or 'none'}",
            "no lights, no speed limits; states between keyframes are interpolated",
        ]
        if not has_annotations(folder):
            notes.append("no annotations (as in the test split): there is nothing to convert")
            missing.append(f"{folder.name}/sample_annotation.json with annotations")
        flavour, scenes = "tables of 2 Hz keyframes", len(scene_rows(folder))
        return Description("nuScenes", flavour, folder.name, scenes, tuple(notes), tuple(missing))

    def count(self, path: Path) -> int:
        """Return the number of scenes times the windows of a usual one; 0 if unreadable or without annotations."""
        try:
            if not has_annotations(path.parent):
                return 0
            return len(scene_rows(path.parent)) * windows_of(_SCENE_STEPS)
        except DataError:
            return 0

    def companion_files(self, path: Path) -> tuple[Path, ...]:
        """Return the tables and the maps."""
        return (*sorted(path.parent.glob("*.json")), *sorted(_maps(path).glob("*.json")))

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """Yield the scenes in file order, and a bad record in place of each that cannot be read."""
        tables = attempt(Tables.read, path.parent, file=path)
        if isinstance(tables, BadRecord):
            yield tables
            return
        for row, entry in enumerate(tables.scenes):
            yield attempt(_recording, tables, row, _maps(path), file=path, record=entry["name"])


def _maps(path: Path) -> Path:
    """Return the folder of city maps: where the devkit expects it, or where the archive unpacks them."""
    root = path.parent.parent
    expansion = root / "maps" / "expansion"
    folders = (expansion, root / "maps", root / "expansion")
    return next((folder for folder in folders if any(folder.glob("*.json"))), expansion)


def _recording(tables: Tables, row: int, maps: Path) -> Recording:
    """Return the recording of the scene in a row of ``scenes``: at 10 Hz, in the city's frame.

    Raises:
        DataError: The scene has no log, fewer than two keyframes or poses, no pose between its first and last keyframe,
            or an implausible duration.
    """
    scene, samples = tables.scenes[row], np.flatnonzero(tables.sample_scene == row)
    location, logfile = tables.logs.get(scene["log_token"], ("", ""))
    poses = tables.poses[tables.poses[:, 0] == row, 1:]
    if len(samples) < 2 or len(poses) < 2 or not location:
        problem = f"{len(samples)} keyframes, {len(poses)} ego poses, log {location or 'unknown'}"
        raise DataError(f"the scene cannot be used: {problem}", cure=_AGAIN)
    begin, end = tables.sample_time[samples].min(), tables.sample_time[samples].max()
    duration = float(end - begin)
    if not duration <= _LONGEST_S:
        raise DataError(f"the scene lasts {duration:.0f} s", cure=_AGAIN)
    times = np.arange(int(round(duration / DT_S, 6)) + 1) * DT_S
    tracks = _tracks(_sort_by_time(poses), *tables.observations(samples), begin + times)
    if not tracks.valid[0].any():
        raise DataError("the ego has no pose during the scene", cure=_AGAIN)
    city_map = city(maps / f"{Path(location).name}.json")
    tracks, features = flatten(tracks, city_map.around(tracks.xy[0][tracks.valid[0]], MARGIN_M))
    return Recording(
        scenario_id=scene["name"],
        dataset="nuscenes",
        segment=logfile or scene["name"],
        timestamps_s=times,
        current_step=min(CURRENT_STEP, len(times) - 1),
        ego=0,
        tracks=tracks,
        features=features,
        tags={"source_format": "nuscenes"} | place_tags(location),
        lost=nonzero(city_map.lost, unknown_fields=tables.unknown_fields),
        flags=Flag.DIFFERENTIATED_VELOCITY,
    )


def _tracks(
    poses: Float64[Array, "pose 4"],
    observations: Sequence[Float64[Array, "_ 7"]],
    kinds: Sequence[AgentKind],
    times: Float64[Array, " time"],
) -> Tracks:
    """Return the tracks of the ego (row 0) and every instance at some times; the size of an instance is its median."""
    centres = poses[:, 1:].copy()
    centres[:, :2] = box_centre(centres[:, :2], centres[:, 2], CENTRE_AHEAD_M)
    check_finite(centres, *observations)
    motions = [interpolate(poses[:, 0], centres, times)]
    motions += [interpolate(table[:, 0], table[:, 1:4], times) for table in observations]
    sizes = np.array([EGO_SIZE_M, *(np.median(table[:, 4:7], axis=0) for table in observations)])
    state, valid = (np.stack(arrays) for arrays in zip(*motions, strict=True))
    return Tracks(
        xy=state[..., 0:2],
        z=np.zeros(valid.shape),
        heading=state[..., 2],
        velocity=state[..., 3:5],
        size=np.where(valid[..., None], sizes[:, None], 0.0),
        valid=valid,
        kind=np.array([AgentKind.VEHICLE, *kinds], np.int8),
        track_id=np.arange(len(motions), dtype=np.int64),
    )


def interpolate(
    knots_s: Float64[Array, " row"], pose: Float64[Array, "row 3"], times: Float64[Array, " time"]
) -> tuple[Float64[Array, "time 5"], Bool[Array, " time"]]:
    """Interpolate position, heading and velocity between observations.

    Positions follow a cubic Hermite spline whose tangents are central differences (one-sided at the ends), velocities
    are its derivative, headings are linear after unwrapping. Steps that are more than half a step before the first or
    after the last observation, or inside a gap of more than 0.75 s, are not valid; an observation between two gaps
    counts, with velocity 0, at the steps within half a step.

    Args:
        knots_s: Times of the observations, increasing, seconds.
        pose: x, y [m] and heading [rad] at each.
        times: Where to interpolate, evenly spaced, seconds.

    Returns:
        x, y, heading, velocity x and y (zeros if not valid), and whether each step is valid.
    """
    from scipy.interpolate import CubicHermiteSpline

    state, valid = np.zeros((len(times), 5)), np.zeros(len(times), bool)
    runs = np.split(np.arange(len(knots_s)), np.flatnonzero(np.diff(knots_s) > LONGEST_GAP_S) + 1)
    for run in (run for run in runs if len(run)):
        knots, xy = knots_s[run], pose[run, :2]
        # Half a step of tolerance: the ends of a run fall between steps.
        steps = (times >= knots[0] - DT_S / 2) & (times <= knots[-1] + DT_S / 2)
        time = np.clip(times[steps], knots[0], knots[-1])
        if len(run) == 1:
            state[steps, :3] = pose[run[0]]
        else:
            spline = CubicHermiteSpline(knots, xy, np.gradient(xy, knots, axis=0))
            state[steps, :2], state[steps, 3:] = spline(time), spline(time, 1)
            state[steps, 2] = np.interp(time, knots, np.unwrap(pose[run, 2]))
        valid |= steps
    state[:, 2] = np.where(valid, wrap(state[:, 2]), 0.0)
    return state, valid


@dataclass
class Tables:
    """Content of a version's tables, in arrays of numbers.

    Attributes:
        scenes: Rows of ``scene.json``.
        logs: Location and logfile of each log by token.
        sample_scene: Row of the scene of every sample; ``sample_time`` is its time in seconds.
        poses: Scene row, time [s], x, y [m], heading [rad] of every lidar frame's pose.
        annotations: Sample row, instance row, x, y [m], heading [rad], length, width, height [m].
        kinds: Class of every instance.
        unknown_fields: Number of tables and fields of unknown names.
    """

    scenes: list[dict[str, str]]
    logs: Mapping[str, tuple[str, str]]
    sample_scene: Int64[Array, " sample"]
    sample_time: Float64[Array, " sample"]
    poses: Float64[Array, "pose 5"]
    annotations: Float64[Array, "annotation 8"]
    kinds: list[AgentKind]
    unknown_fields: int

    @classmethod
    def read(cls, folder: Path) -> Tables:
        """Read the tables of one version (``v1.0-mini``, ...), the large ones row by row."""
        if not has_annotations(folder):
            raise DataError(
                "contains no annotations: the ego would be the only agent",
                file=folder / "sample_annotation.json",
                cure="convert v1.0-trainval or v1.0-mini; the test split has none",
            )
        scenes = scene_rows(folder)
        scene_index = {row["token"]: i for i, row in enumerate(scenes)}
        logs = {
            row.text("token"): (row.text("location"), row.text("logfile")) for row in _table(folder, "log")
        }
        samples = [
            (row.text("token"), scene_index.get(row.text("scene_token"), -1), row.number("timestamp") * 1e-6)
            for row in _table(folder, "sample")
        ]
        sample_index = {token: i for i, (token, *_) in enumerate(samples)}
        sample_scene = np.array([scene for _, scene, _ in samples], np.int64)
        sample_time = np.array([seconds for *_, seconds in samples], np.float64)
        names = {row.text("token"): row.text("name") for row in _table(folder, "category")}
        instances = [
            (row.text("token"), kind_of(names.get(row.text("category_token"), "")))
            for row in _table(folder, "instance")
        ]
        instance_index = {token: i for i, (token, _) in enumerate(instances)}
        poses = _poses(folder, sample_index, sample_scene)
        annotations = _annotations(folder, sample_index, instance_index)
        kinds = [kind for _, kind in instances]
        unknown = _unknown_fields(folder)
        return cls(scenes, logs, sample_scene, sample_time, poses, annotations, kinds, unknown)

    def observations(
        self, samples: Int64[Array, " sample"]
    ) -> tuple[list[Float64[Array, "_ 7"]], list[AgentKind]]:
        """Return the observations of each instance at some samples, and its class.

        Columns are time [s], x, y [m], heading [rad], length, width and height [m].
        """
        annotations = self.annotations[np.isin(self.annotations[:, 0], samples)]
        times = self.sample_time[annotations[:, 0].astype(np.int64)]
        table = np.column_stack((times, annotations[:, 2:]))
        instances = np.unique(annotations[:, 1]).astype(np.int64).tolist()
        series = [_sort_by_time(table[annotations[:, 1] == instance]) for instance in instances]
        return series, [self.kinds[instance] for instance in instances]


def _unknown_fields(folder: Path) -> int:
    """Count unknown tables, and unknown fields in the first rows of those that are read."""
    fields = {name for table in _TABLES for name in next(rows(folder / f"{table}.json"), {})}
    tables = {path.stem for path in folder.glob("*.json")}
    return len(fields - _FIELDS) + len(tables.difference(_TABLES, _UNUSED_TABLES))


def _sort_by_time(table: Float64[Array, "row column"]) -> Float64[Array, "kept column"]:
    """Sort rows by time, the first column; keep the first of several at one time."""
    _, first = np.unique(table[:, 0], return_index=True)
    return table[first]


def _poses(folder: Path, sample_index: Mapping[str, int], sample_scene: Array) -> Float64[Array, "pose 5"]:
    """Read ego poses of the lidar's frames: scene row, time, x, y, heading."""
    scene_of_pose: dict[str, int] = {}
    for row in _table(folder, "sample_data"):
        sample = sample_index.get(row.text("sample_token"), -1)
        if sample >= 0 and _POSE_SENSOR in str(row.values.get("filename", "")):
            scene_of_pose[row.text("ego_pose_token")] = int(sample_scene[sample])
    table = array("d")
    for row in _table(folder, "ego_pose"):
        scene = scene_of_pose.get(row.text("token"))
        if scene is not None:
            x, y, _ = row.vector("translation", 3)
            seconds = row.number("timestamp") * 1e-6
            table.extend((scene, seconds, x, y, yaw(*row.vector("rotation", 4))))
    return np.array(table, np.float64).reshape(-1, 5)


def _annotations(
    folder: Path, sample_index: Mapping[str, int], instance_index: Mapping[str, int]
) -> Float64[Array, "annotation 8"]:
    """Read annotations: sample row, instance row, x, y, heading, length, width, height."""
    table = array("d")
    for row in _table(folder, "sample_annotation"):
        sample = sample_index.get(row.text("sample_token"), -1)
        instance = instance_index.get(row.text("instance_token"), -1)
        if sample < 0 or instance < 0:
            continue
        x, y, _ = row.vector("translation", 3)
        width, length, height = row.vector("size", 3)  # in this order
        heading = yaw(*row.vector("rotation", 4))
        table.extend((sample, instance, x, y, heading, length, width, height))
    return np.array(table, np.float64).reshape(-1, 8)


def scene_rows(folder: Path) -> list[dict[str, str]]:
    """Read token, name and log_token of each row of ``scene.json``."""
    names = ("token", "name", "log_token")
    return [{name: row.text(name) for name in names} for row in _table(folder, "scene")]


def has_annotations(folder: Path) -> bool:
    """Return whether a version has annotations, unlike the test split; True if the table cannot be read."""
    try:
        return next(rows(folder / "sample_annotation.json"), None) is not None
    except DataError:
        return True


def kind_of(category: str) -> AgentKind:
    """Return the class of a nuScenes category (``vehicle.car``, ``human.pedestrian.adult``, ...)."""
    return next((kind for start, kind in _KINDS if category.startswith(start)), AgentKind.OTHER)


def yaw(w: float, x: float, y: float, z: float) -> float:
    """Return the heading of a unit quaternion (w, x, y, z): the direction of its x axis in the plane, radians."""
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


class _Row:
    """A row of a table; its methods return a value by name, and refuse one of another type."""

    def __init__(self, values: Mapping[str, Any], file: Path) -> None:
        self.values, self._file = values, file

    def text(self, name: str) -> str:
        value = self.values.get(name)
        if not isinstance(value, str) or len(value) > _LONGEST_TEXT:
            problem = "whose {} is too long" if isinstance(value, str) else "without {}"
            raise DataError(f"a row {problem.format(name)}", file=self._file, cure=_AGAIN)
        return value

    def number(self, name: str) -> float:
        value = self.values.get(name)
        if not _is_number(value):
            raise DataError(f"a row whose {name} is not a number", file=self._file, cure=_AGAIN)
        return float(value)  # type: ignore[arg-type]

    def vector(self, name: str, size: int) -> list[float]:
        value = self.values.get(name)
        if not isinstance(value, list) or len(value) != size or not all(map(_is_number, value)):
            raise DataError(f"a row whose {name} is not {size} numbers", file=self._file, cure=_AGAIN)
        return [float(item) for item in value]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e18


def _table(folder: Path, name: str) -> Iterator[_Row]:
    """Yield the rows of a table of a version."""
    file = folder / f"{name}.json"
    return (_Row(row, file) for row in rows(file))


def _too_long() -> ValueError:
    return ValueError(f"a row of more than {_LONGEST_ROW:,} characters")


def rows(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the objects of a file that holds one array of objects, which is never in memory as a whole."""
    check_regular(path, _AGAIN)
    decoder = json.JSONDecoder()
    number = 0
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_CHUNK).lstrip()
            if not text.startswith("["):
                raise DataError("is not a table (an array of objects)", file=path, cure="download it again")
            position = 1
            while True:
                # Only ``position`` moves: cutting the text after every row would copy it thousands of times.
                if separator := _SEPARATOR.match(text, position):
                    position = separator.end()
                if text.startswith("]", position):
                    return
                try:
                    row, end = decoder.raw_decode(text, position)
                except ValueError:  # The row goes on in the next chunk, unless the file is damaged.
                    chunk = file.read(_CHUNK)
                    if not chunk:
                        raise
                    if len(text) - position > _LONGEST_ROW:
                        raise _too_long() from None
                    text, position = text[position:] + chunk, 0
                    continue
                if end - position > _LONGEST_ROW:
                    raise _too_long()
                if not isinstance(row, dict):
                    raise DataError("is not an object", file=path, record=number, cure="download it again")
                if number >= _MOST_ROWS:
                    raise DataError(f"has more than {_MOST_ROWS:,} rows", file=path, cure="download it again")
                yield row
                position, number = end, number + 1
    except FileNotFoundError as error:
        raise DataError("is missing", file=path, cure=_AGAIN) from error
    except (ValueError, RecursionError) as error:
        problem = f"is damaged after {number} rows ({error})"
        raise DataError(problem, file=path, cure=_AGAIN) from error
