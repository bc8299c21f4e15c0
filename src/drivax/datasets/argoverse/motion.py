"""Reader of Argoverse 2 motion forecasting: one parquet file per scenario, its map as JSON next to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int

from drivax.datasets import parsing
from drivax.datasets.argoverse import tables
from drivax.datasets.argoverse.map import MAP_PATTERN, read_map
from drivax.datasets.argoverse.tables import ArrowTable, Kind, Words, read_table
from drivax.datasets.parsing import lift, place_tags
from drivax.datasets.reader import BadRecord, Description, attempt, read_head
from drivax.errors import DataError
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import Recording, Tracks
from drivax.scenario.schema import CURRENT_STEP, DT_S, AgentKind, Flag

Array = np.ndarray[Any, Any]

EGO = "AV"
#: ``object_category`` of tracks that the data set's benchmark scores in addition to the focal track.
_SCORED = 2
_STATE = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
_COLUMNS: dict[str, Kind] = {
    **dict.fromkeys(("track_id", "object_type", "scenario_id", "focal_track_id", "city", "slice_id"), "text"),
    **dict.fromkeys(("object_category", "timestep", "num_timestamps"), "integer"),
    **dict.fromkeys((*_STATE, "start_timestamp", "end_timestamp"), "number"),
}
#: Known columns that are not read: the split at step 50, and the number of the city.
_UNUSED_COLUMNS = {"observed", "map_id"}
#: Kind and size (length, width, height in metres) of each ``object_type``, because the files hold no sizes. Sizes are
#: medians of boxes of sensor logs; a cyclist has the length of the cycle and the height of a person.
_TYPES: dict[str, tuple[AgentKind, tuple[float, float, float]]] = {
    "vehicle": (AgentKind.VEHICLE, (4.1, 1.9, 1.6)),
    "bus": (AgentKind.VEHICLE, (11.6, 2.9, 3.0)),
    "pedestrian": (AgentKind.PEDESTRIAN, (0.7, 0.7, 1.8)),
    "motorcyclist": (AgentKind.CYCLIST, (1.8, 0.6, 1.7)),
    "cyclist": (AgentKind.CYCLIST, (1.8, 0.6, 1.7)),
    "riderless_bicycle": (AgentKind.OTHER, (1.6, 0.5, 1.2)),
    "static": (AgentKind.STATIC, (0.5, 0.5, 1.0)),
    "background": (AgentKind.STATIC, (0.5, 0.5, 1.0)),
    "construction": (AgentKind.STATIC, (0.4, 0.4, 0.9)),
    "unknown": (AgentKind.OTHER, (0.5, 0.5, 1.0)),
}
_MOST_STEPS, _LATEST_S = 1000, 1e12
_SKIP = "skip this scenario, or download it again"


@dataclass(frozen=True)
class ArgoverseMotion:
    """Reader of motion forecasting scenarios: 110 steps at 10 Hz (50 in the test split), lane graph, no box sizes."""

    name: str = "av2-motion"
    patterns: tuple[str, ...] = ("scenario_*.parquet",)
    companions: tuple[str, ...] = (MAP_PATTERN,)

    def recognise(self, path: Path) -> bool:
        """Return whether the file is parquet and named like a scenario."""
        return path.match(self.patterns[0]) and bool(self.count(path))

    def describe(self, path: Path) -> Description:
        """Describe tracks, steps and city of the scenario, and whether its map is present."""
        table = read_table(path, _COLUMNS, optional=("slice_id",))
        steps = 1 + int(table.numbers["timestep"].max())
        map_path = _map_path(path)
        return Description(
            dataset="Argoverse 2 Motion Forecasting",
            flavour=f"one scenario of {steps} steps in {table.texts['city'].text(0)}",
            recordings=1,
            notes=(
                f"{len(table.texts['track_id'].words)} tracks",
                "box sizes are those of the class; there are no speed limits, lights or stop signs",
            ),
            missing=() if map_path.is_file() else (map_path.name,),
        )

    def count(self, path: Path) -> int:
        """Return 1, because every scenario becomes one window; 0 if the file is not parquet."""
        return int(read_head(path, 4) == tables.PARQUET_MAGIC)

    def companion_files(self, path: Path) -> tuple[Path, ...]:
        """Return the map of the scenario."""
        return (_map_path(path),)

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """Yield the recording of a scenario, or the bad record in its place."""
        yield attempt(decode, path, file=path)


def _map_path(path: Path) -> Path:
    """Return the path of a scenario's map."""
    return path.with_name(f"log_map_archive_{path.stem.removeprefix('scenario_')}.json")


def decode(path: Path) -> Recording:
    """Return the recording in ``scenario_<id>.parquet`` and ``log_map_archive_<id>.json`` next to it.

    Positions are in the city's frame, metres. The ego (track AV) is moved from its rear axle to the middle of its box;
    agents stand on the map. Sizes are those of the class (the ego's is the car's); the source smoothed the velocities.
    """
    table = read_table(path, _COLUMNS, optional=("slice_id",))
    local_map = read_map(_map_path(path))
    try:
        tracks, ego = _tracks(table)
    except DataError as error:
        raise DataError(error.problem, file=path, cure=_SKIP) from error
    steps = tracks.valid.shape[1]
    scenario_id, names = table.texts["scenario_id"].text(0), table.texts["track_id"]
    focal = table.texts["focal_track_id"].text(0)
    categories = _per_track(table.numbers["object_category"], names)
    return Recording(
        scenario_id=scenario_id,
        dataset=tables.DATASET,
        segment=(table.texts["slice_id"].text(0) if "slice_id" in table.texts else "") or scenario_id,
        timestamps_s=_timestamps(table, steps),
        current_step=min(CURRENT_STEP, steps - 1),
        ego=ego,
        tracks=lift(tracks, local_map.features),
        features=local_map.features,
        to_predict=tuple(row for row, name in enumerate(names.words) if name == focal),
        of_interest=tuple(row for row, code in enumerate(categories) if code == _SCORED),
        tags={"source_format": "av2-motion"} | place_tags(table.texts["city"].text(0)),
        lost=parsing.nonzero(
            local_map.lost,
            repeated_rows=table.rows - int(tracks.valid.sum()),
            unknown_fields=len(table.unread - _UNUSED_COLUMNS),
        ),
        flags=Flag.DEFAULT_SIZES,
    )


def _per_track(values: Array, names: Words) -> Array:
    """Return the value of the first row of each track."""
    _, first = np.unique(names.of_row, return_index=True)
    return values[first]


def _tracks(table: ArrowTable) -> tuple[Tracks, int]:
    """Return all tracks in order of appearance, with z = 0, and the row of the ego."""
    names, step = table.texts["track_id"], table.numbers["timestep"]
    if EGO not in names.words:
        raise DataError(f"has no track {EGO}")
    if not 0 <= step.min() <= step.max() < _MOST_STEPS:
        raise DataError(f"timesteps run from {step.min()} to {step.max()}")
    if len(names.words) * (int(step.max()) + 1) > tables.MOST_STATES:
        raise DataError(f"{len(names.words)} tracks of {step.max() + 1} steps are too many")
    ego, row = names.words.index(EGO), names.of_row
    states = np.zeros((len(names.words), int(step.max()) + 1, len(_STATE)))
    valid = np.zeros(states.shape[:2], bool)
    states[row, step], valid[row, step] = table.stack(_STATE), True
    parsing.check_within(tables.FARTHEST_M, states[..., :3])
    parsing.check_within(tables.FASTEST_MPS, states[..., 3:])
    heading = np.where(valid, wrap(states[..., 2]), 0.0)
    xy = states[..., :2].copy()
    ego_steps = ego, valid[ego]
    xy[ego_steps] = parsing.box_centre(xy[ego_steps], heading[ego_steps], tables.CENTRE_AHEAD_M)
    kinds, sizes = _classes(table.texts["object_type"], names, ego)
    return Tracks(
        xy=xy,
        z=np.zeros(valid.shape),
        heading=heading,
        velocity=states[..., 3:].copy(),
        size=np.where(valid[..., None], sizes[:, None], 0.0),
        valid=valid,
        kind=kinds,
        track_id=_track_ids(names.words),
    ), ego


def _classes(types: Words, names: Words, ego: int) -> tuple[Array, Float64[Array, "track 3"]]:
    """Return kinds and sizes (length, width, height, metres) of all tracks."""
    classes = [_TYPES.get(types.words[code], _TYPES["unknown"]) for code in _per_track(types.of_row, names)]
    sizes = np.array([size for _, size in classes], np.float64)
    sizes[ego] = tables.EGO_SIZE
    return np.array([kind for kind, _ in classes], np.int8), sizes


def _track_ids(names: tuple[str, ...]) -> Int[Array, " track"]:
    """Return the ids as numbers, the ego's as 0; row numbers if some id is not a number or not unique."""
    texts = ["0" if name == EGO else name for name in names]
    if all(text.isascii() and text.isdecimal() and len(text) < 10 for text in texts):
        ids = [int(text) for text in texts]
        if len(set(ids)) == len(ids):
            return np.array(ids, np.int64)
    return np.arange(len(names), dtype=np.int64)


def _timestamps(table: ArrowTable, steps: int) -> Float64[Array, " step"]:
    """Return evenly spaced times of all steps, seconds, from the file's first and last time and their number."""
    start, end = (float(table.numbers[f"{name}_timestamp"][0]) * 1e-9 for name in ("start", "end"))
    intervals = int(table.numbers["num_timestamps"][0]) - 1
    step_s = (end - start) / intervals if intervals > 0 else DT_S
    parsing.check_within(_LATEST_S, np.array([start, step_s]))
    return start + step_s * np.arange(steps)
