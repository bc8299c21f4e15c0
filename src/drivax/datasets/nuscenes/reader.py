"""Reader of nuScenes as its makers ship it: JSON tables of 2 Hz keyframes and one map file per city."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from drivax.datasets.nuscenes.map import city
from drivax.datasets.nuscenes.tables import Scene, Tables, has_annotations, scene_rows
from drivax.datasets.parsing import box_centre, check_finite, flatten, place_tags, windows_of
from drivax.datasets.reader import BadRecord, Description
from drivax.errors import DataError
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import Recording, Tracks
from drivax.scenario.schema import CURRENT_STEP, DT_S, AgentKind, Flag

Array = np.ndarray[Any, Any]

_TABLES = (
    "category", "ego_pose", "instance", "log", "sample", "sample_annotation", "sample_data", "scene",
)  # fmt: skip
_OTHERS = ("attribute", "calibrated_sensor", "map", "sensor", "visibility", "lidarseg", "panoptic")
#: Keyframes are 0.5 s apart; nothing is made up over a missing one.
LONGEST_GAP_S = 0.75
#: Scenes last 20 s; a longer one is damage.
_LONGEST_S = 120.0
#: Map around the ego's log.
MARGIN_M = 150.0
#: The ego is a Renault Zoe: length, width, height, and how far its centre lies ahead of the rear axle (half the length
#: less the rear overhang), from the maker's data sheet; poses are of the rear axle (nuscenes-devkit, issue 108).
EGO_SIZE_M, CENTRE_AHEAD_M = (4.084, 1.730, 1.562), 1.385


@dataclass(frozen=True)
class NuScenes:
    """Reads the tables of one version (``v1.0-mini``, ``v1.0-trainval``); each scene is a recording."""

    name: str = "nuscenes"
    patterns: tuple[str, ...] = ("v1.0-*/scene.json",)
    companions: tuple[str, ...] = (
        *(f"v1.0-*/{table}.json" for table in (*_TABLES[:-1], *_OTHERS)),
        "maps/*.png",
        "maps/*.json",
        "expansion/*.json",
        "maps/*/*.json",
        "maps/*/*.png",
    )

    def recognise(self, path: Path) -> bool:
        """Whether it is ``scene.json`` with the other tables next to it."""
        return path.name == "scene.json" and (path.parent / "sample.json").is_file()

    def describe(self, path: Path) -> Description:
        """Version, number of scenes, and what of the tables and maps is missing."""
        folder = path.parent
        missing = [
            f"{folder.name}/{table}.json" for table in _TABLES if not (folder / f"{table}.json").is_file()
        ]
        expansion = sorted(path.name for path in _maps(path).glob("*.json"))
        if not expansion:
            missing.append("maps/expansion/*.json (the map expansion pack)")
        notes = [
            f"maps: {', '.join(expansion) or 'none'}",
            "no lights, no speed limits; states between keyframes are interpolated",
        ]
        if not has_annotations(folder):
            notes.append("no annotations (as in the test split): there is nothing to convert")
        return Description(
            dataset="nuScenes",
            flavour="tables of 2 Hz keyframes",
            version=folder.name,
            recordings=len(scene_rows(folder)),
            notes=tuple(notes),
            missing=tuple(missing),
        )

    def count(self, path: Path) -> int:
        """Scenes times the windows of 20 s."""
        try:
            return len(scene_rows(path.parent)) * windows_of(196)
        except DataError:
            return 0

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """The scenes in the order of the file, and in their place those that cannot be read."""
        try:
            tables = Tables.read(path.parent)
        except DataError as error:
            yield BadRecord.of(error, path)
            return
        for row, about in enumerate(tables.scenes):
            try:
                scene = tables.scene(row)
                yield recording(scene, _maps(path) / f"{Path(scene.location).name}.json", path.parent.name)
            except DataError as error:
                yield BadRecord.of(error, path, about["name"])


def _maps(path: Path) -> Path:
    """The folder of city maps: where the devkit wants it, or where people unpack the pack, which brings a folder."""
    root = path.parent.parent
    expansion = root / "maps" / "expansion"
    return next(
        (f for f in (expansion, root / "maps", root / "expansion") if any(f.glob("*.json"))), expansion
    )


def recording(scene: Scene, map_file: Path, version: str) -> Recording:
    """One scene at 10 Hz in the city's frame."""
    begin = scene.keyframes_s[0]
    duration = float(scene.keyframes_s[-1] - begin)
    if not duration <= _LONGEST_S:
        raise DataError(f"the scene lasts {duration:.0f} s", cure="unpack the metadata archive again")
    times = np.arange(int(round(duration / DT_S, 6)) + 1) * DT_S
    tracks = _tracks(scene, begin + times)
    if not tracks.valid[0].any():
        raise DataError("the ego has no pose during the scene", cure="unpack the metadata archive again")
    whole = city(map_file)
    tracks, features = flatten(tracks, whole.around(tracks.xy[0][tracks.valid[0]], MARGIN_M))
    return Recording(
        scenario_id=scene.name,
        dataset="nuscenes",
        segment=scene.logfile or scene.name,
        timestamps_s=times,
        current_step=min(CURRENT_STEP, len(times) - 1),
        ego=0,
        tracks=tracks,
        features=features,
        tags={"source_format": "nuscenes"} | place_tags(scene.location),
        lost=whole.lost,
        flags=Flag.DIFFERENTIATED_VELOCITY,
    )


def _tracks(scene: Scene, times: Float64[Array, " time"]) -> Tracks:
    """The ego in row 0 and every instance, at the given times."""
    poses = scene.poses[:, 1:].copy()
    poses[:, :2] = box_centre(poses[:, :2], poses[:, 2], CENTRE_AHEAD_M)
    check_finite(poses, *scene.observations.values())
    moved = [interpolate(scene.poses[:, 0], poses, times)]
    moved += [interpolate(table[:, 0], table[:, 1:4], times) for table in scene.observations.values()]
    sizes = [EGO_SIZE_M, *(np.median(table[:, 4:7], axis=0) for table in scene.observations.values())]
    state = np.stack([states for states, _ in moved])
    valid = np.stack([seen for _, seen in moved])
    return Tracks(
        xy=state[..., 0:2],
        z=np.zeros(valid.shape),
        heading=state[..., 2],
        velocity=state[..., 3:5],
        size=np.where(valid[..., None], np.array(sizes)[:, None], 0.0),
        valid=valid,
        kind=np.array([AgentKind.VEHICLE, *scene.kinds.values()], np.int8),
        track_id=np.arange(len(moved), dtype=np.int64),
    )


def interpolate(
    seen_s: Float64[Array, " row"], pose: Float64[Array, "row 3"], times: Float64[Array, " time"]
) -> tuple[Float64[Array, "time 5"], Bool[Array, " time"]]:
    """Position, heading and velocity between observations.

    Positions follow a cubic Hermite spline through the observations whose tangents are central differences
    (one-sided at the ends), velocities are its derivative, headings are linear after unwrapping. Nothing is made up
    before the first and after the last observation or over a gap of more than 0.75 s; an observation without
    neighbours counts at the nearest step alone.

    Args:
        seen_s: Times of the observations, increasing, seconds.
        pose: x, y [m] and heading [rad] at each.
        times: Where to interpolate, evenly spaced, seconds.

    Returns:
        x, y, heading, velocity x and y (zeros where not valid), and whether each step is valid.
    """
    from scipy.interpolate import CubicHermiteSpline

    state, valid = np.zeros((len(times), 5)), np.zeros(len(times), bool)
    runs = np.split(np.arange(len(seen_s)), np.flatnonzero(np.diff(seen_s) > LONGEST_GAP_S) + 1)
    for run in (run for run in runs if len(run)):
        at, xy = seen_s[run], pose[run, :2]
        inside = (times >= at[0] - DT_S / 2) & (times <= at[-1] + DT_S / 2)
        when = np.clip(times[inside], at[0], at[-1])
        if len(run) == 1:
            state[inside, :3] = pose[run[0]]
        else:
            spline = CubicHermiteSpline(at, xy, np.gradient(xy, at, axis=0))
            state[inside, :2], state[inside, 3:] = spline(when), spline(when, 1)
            state[inside, 2] = np.interp(when, at, np.unwrap(pose[run, 2]))
        valid |= inside
    state[:, 2] = np.where(valid, wrap(state[:, 2]), 0.0)
    return state, valid
