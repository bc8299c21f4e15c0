"""The nuScenes tables as arrays per scene: who was where at which keyframe, and where the ego was in between."""

from __future__ import annotations

import json
import math
import re
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from drivax.errors import DataError
from drivax.scenario.schema import AgentKind

_CHUNK = 1 << 20
#: No row of a table is longer; a longer one is damage.
_LONGEST = 1 << 24
_BETWEEN = re.compile(r"[ \t\r\n,]*")


def rows(path: Path) -> Iterator[dict[str, Any]]:
    """The objects of a file that holds one array of objects.

    Args:
        path: The file; it is never held in memory as a whole.
    """
    decoder = json.JSONDecoder()
    number = 0
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_CHUNK).lstrip()
            if not text.startswith("["):
                raise DataError("is not a table (an array of objects)", file=path, cure="download it again")
            place = 1
            while True:
                # Only places move: cutting the text after every row would copy a chunk thousands of times.
                between = _BETWEEN.match(text, place)
                place = place if between is None else between.end()
                if text.startswith("]", place):
                    return
                try:
                    row, end = decoder.raw_decode(text, place)
                except ValueError:
                    more = file.read(_CHUNK)
                    if not more or len(text) - place > _LONGEST:
                        raise
                    text, place = text[place:] + more, 0
                    continue
                if not isinstance(row, dict):
                    raise DataError("is no object", file=path, record=number, cure="download it again")
                yield row
                place, number = end, number + 1
    except FileNotFoundError as error:
        raise DataError("is missing", file=path, cure="unpack the metadata archive again") from error
    except (ValueError, RecursionError) as error:
        problem = f"is damaged after {number} rows ({error})"
        raise DataError(problem, file=path, cure="unpack the metadata archive again") from error


_AGAIN = "unpack the metadata archive again"
#: Categories by the beginning of their names; the first that fits counts.
_KINDS = (
    ("vehicle.bicycle", AgentKind.CYCLIST),
    ("vehicle.motorcycle", AgentKind.CYCLIST),
    ("vehicle.", AgentKind.VEHICLE),
    ("human.", AgentKind.PEDESTRIAN),
    ("movable_object.", AgentKind.STATIC),
    ("static_object.", AgentKind.STATIC),
)
#: Columns of an observation: time [s], x, y, heading [rad], length, width, height [m].
COLUMNS = 7
#: Poses are taken from the lidar's frames (20 Hz); the other sensors' frames lie in between.
_CLOCK = "LIDAR_TOP"


@dataclass
class Scene:
    """One scene of the tables.

    Attributes:
        token: Its token in ``scene.json``.
        name: As people call it (``scene-0061``).
        location: Name of the city map.
        logfile: The recording that the scene was cut from.
        keyframes_s: Times of the keyframes, seconds since the epoch, increasing.
        poses: Ego poses: time [s], x, y, heading; of the centre of the rear axle.
        observations: Per instance the rows ``COLUMNS`` of its annotations, in time.
        kinds: Class of every instance.
    """

    token: str
    name: str
    location: str
    logfile: str
    keyframes_s: Float64[np.ndarray, " keyframe"]
    poses: Float64[np.ndarray, "pose 4"]
    observations: dict[int, Float64[np.ndarray, "row 7"]]
    kinds: dict[int, AgentKind]


def scene_rows(folder: Path) -> list[dict[str, str]]:
    """The rows of ``scene.json`` as text, each checked to have what is needed."""
    names = ("token", "name", "log_token")
    return [
        {name: _text(row, name, folder / "scene.json") for name in names}
        for row in rows(folder / "scene.json")
    ]


def has_annotations(folder: Path) -> bool:
    """Whether a version's table of annotations has a row; the test split's is empty. True where it cannot be read."""
    try:
        return next(rows(folder / "sample_annotation.json"), None) is not None
    except DataError:
        return True


@dataclass
class Tables:
    """Everything that is needed of a version's tables, in arrays of numbers.

    Attributes:
        scenes: Rows of ``scene.json``.
        logs: ``log.json`` by token: (location, logfile).
        sample_scene: Row of the scene of every sample.
        sample_time: Time of every sample, seconds.
        poses: Scene row, time [s], x, y, heading of every lidar frame's pose.
        annotations: Sample row, instance row, x, y, heading, length, width, height.
        kinds: Class of every instance.
    """

    scenes: list[dict[str, str]]
    logs: Mapping[str, tuple[str, str]]
    sample_scene: Int64[np.ndarray, " sample"]
    sample_time: Float64[np.ndarray, " sample"]
    poses: Float64[np.ndarray, "pose 5"]
    annotations: Float64[np.ndarray, "annotation 8"]
    kinds: list[AgentKind] = field(default_factory=list)

    @classmethod
    def read(cls, folder: Path) -> Tables:
        """Reads the tables of one version (``v1.0-mini``, ...), the large ones row by row."""
        if not has_annotations(folder):
            raise DataError(
                "holds no annotations: the ego would be the only agent",
                file=folder / "sample_annotation.json",
                cure="convert v1.0-trainval or v1.0-mini; the test split has none",
            )
        scenes = scene_rows(folder)
        scene_index = {row["token"]: i for i, row in enumerate(scenes)}
        logs = {
            _text(row, "token", folder / "log.json"): (
                _text(row, "location", folder / "log.json"),
                _text(row, "logfile", folder / "log.json"),
            )
            for row in rows(folder / "log.json")
        }
        sample_index: dict[str, int] = {}
        sample_scene, sample_time = array("q"), array("d")
        file = folder / "sample.json"
        for row in rows(file):
            sample_index[_text(row, "token", file)] = len(sample_scene)
            sample_scene.append(scene_index.get(_text(row, "scene_token", file), -1))
            sample_time.append(_number(row, "timestamp", file) * 1e-6)
        kinds, instances = _instances(folder)
        scene_of = np.array(sample_scene, np.int64)
        return cls(
            scenes,
            logs,
            scene_of,
            np.array(sample_time, np.float64),
            _poses(folder, sample_index, scene_of),
            _annotations(folder, sample_index, instances),
            kinds,
        )

    def scene(self, row: int) -> Scene:
        """One scene."""
        about = self.scenes[row]
        location, logfile = self.logs.get(about["log_token"], ("", ""))
        samples = np.flatnonzero(self.sample_scene == row)
        poses = self.poses[self.poses[:, 0] == row, 1:]
        if len(samples) < 2 or len(poses) < 2 or not location:
            problem = f"{len(samples)} keyframes, {len(poses)} ego poses, log {location or 'unknown'}"
            raise DataError(f"the scene cannot be used: {problem}", record=about["name"], cure=_AGAIN)
        mine = self.annotations[np.isin(self.annotations[:, 0], samples)]
        observations: dict[int, Any] = {}
        for instance in np.unique(mine[:, 1]).astype(np.int64).tolist():
            of = mine[mine[:, 1] == instance]
            table = np.column_stack((self.sample_time[of[:, 0].astype(np.int64)], of[:, 2:]))
            observations[instance] = in_time(table)
        return Scene(
            token=about["token"],
            name=about["name"],
            location=location,
            logfile=logfile,
            keyframes_s=np.unique(self.sample_time[samples]),
            poses=in_time(poses),
            observations=observations,
            kinds={instance: self.kinds[instance] for instance in observations},
        )


def in_time(table: Float64[np.ndarray, "row column"]) -> Float64[np.ndarray, "kept column"]:
    """Rows in the order of their first column, the first of several at one time."""
    _, first = np.unique(table[:, 0], return_index=True)
    return table[first]


def _instances(folder: Path) -> tuple[list[AgentKind], dict[str, int]]:
    """Classes of the instances in file order, and their rows by token."""
    file = folder / "category.json"
    names = {_text(row, "token", file): _text(row, "name", file) for row in rows(file)}
    file = folder / "instance.json"
    kinds: list[AgentKind] = []
    index: dict[str, int] = {}
    for row in rows(file):
        index[_text(row, "token", file)] = len(kinds)
        kinds.append(kind_of(names.get(_text(row, "category_token", file), "")))
    return kinds, index


def kind_of(category: str) -> AgentKind:
    """The class of a nuScenes category (``vehicle.car``, ``human.pedestrian.adult``, ...)."""
    return next((kind for start, kind in _KINDS if category.startswith(start)), AgentKind.OTHER)


def _poses(folder: Path, samples: Mapping[str, int], scene_of: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Ego poses of the lidar's frames: scene row, time, x, y, heading."""
    file = folder / "sample_data.json"
    scene_of_pose: dict[str, int] = {}
    for row in rows(file):
        sample = samples.get(_text(row, "sample_token", file), -1)
        if sample >= 0 and _CLOCK in str(row.get("filename", "")):
            scene_of_pose[_text(row, "ego_pose_token", file)] = int(scene_of[sample])
    file = folder / "ego_pose.json"
    table = array("d")
    for row in rows(file):
        scene = scene_of_pose.get(_text(row, "token", file))
        if scene is not None:
            x, y, _ = _vector(row, "translation", 3, file)
            seconds = _number(row, "timestamp", file) * 1e-6
            table.extend((scene, seconds, x, y, yaw(*_vector(row, "rotation", 4, file))))
    return np.array(table, np.float64).reshape(-1, 5)


def _annotations(
    folder: Path, samples: Mapping[str, int], instances: Mapping[str, int]
) -> np.ndarray[Any, Any]:
    """Annotations: sample row, instance row, x, y, heading, length, width, height."""
    file = folder / "sample_annotation.json"
    table = array("d")
    for row in rows(file):
        sample = samples.get(_text(row, "sample_token", file), -1)
        instance = instances.get(_text(row, "instance_token", file), -1)
        if sample < 0 or instance < 0:
            continue
        x, y, _ = _vector(row, "translation", 3, file)
        width, length, height = _vector(row, "size", 3, file)  # in this order
        heading = yaw(*_vector(row, "rotation", 4, file))
        table.extend((sample, instance, x, y, heading, length, width, height))
    return np.array(table, np.float64).reshape(-1, 8)


def yaw(w: float, x: float, y: float, z: float) -> float:
    """Heading of a unit quaternion (w, x, y, z): the direction of its x axis in the plane, radians."""
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _text(row: Mapping[str, Any], name: str, file: Path) -> str:
    value = row.get(name)
    if not isinstance(value, str):
        raise DataError(f"a row without {name}", file=file, cure=_AGAIN)
    return value


def _number(row: Mapping[str, Any], name: str, file: Path) -> float:
    value = row.get(name)
    if not _is_number(value):
        raise DataError(f"a row whose {name} is no number", file=file, cure=_AGAIN)
    return float(value)  # type: ignore[arg-type]


def _vector(row: Mapping[str, Any], name: str, size: int, file: Path) -> Iterator[float]:
    value = row.get(name)
    if not isinstance(value, list) or len(value) != size or not all(_is_number(item) for item in value):
        raise DataError(f"a row whose {name} is not {size} numbers", file=file, cure=_AGAIN)
    return (float(item) for item in value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e18
