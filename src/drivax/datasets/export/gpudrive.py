"""Scenarios as GPUDrive JSON: one file per scenario, readable by its scene loader."""

from __future__ import annotations

from typing import Any

import numpy as np

from drivax.datasets.export.recording import restore
from drivax.scenario.recording import Light, MapFeature, Recording
from drivax.scenario.schema import (
    EDGE_KINDS,
    LANE_KINDS,
    LINE_KINDS,
    AgentKind,
    LightState,
    RoadKind,
    Scenario,
)

_Array = np.ndarray[Any, Any]

_INVALID = -10_000.0
#: A tenth of a millimetre, or of a milliradian.
_DIGITS = 4
_AGENTS = {AgentKind.VEHICLE: "vehicle", AgentKind.PEDESTRIAN: "pedestrian", AgentKind.CYCLIST: "cyclist"}
_ROADS = {
    **dict.fromkeys(LANE_KINDS, "lane"),
    **dict.fromkeys(LINE_KINDS, "road_line"),
    **dict.fromkeys(EDGE_KINDS, "road_edge"),
    RoadKind.STOP_SIGN: "stop_sign",
    RoadKind.CROSSWALK: "crosswalk",
    RoadKind.SPEED_BUMP: "speed_bump",
    RoadKind.DRIVEWAY: "driveway",
}


def file_name(row: int) -> str:
    """File name of a scenario: as the published files are called, which the loader's default prefix asks for."""
    return f"tfrecord-00000-of-00001_{row}.json"


def gpudrive_scene(scenario: Scenario, name: str) -> dict[str, Any]:
    """The scene of one scenario as plain JSON values.

    Positions are the source's own, to a tenth of a millimetre; invalid steps are -10000. The ego is the last object, as
    in the published files; ``mark_as_expert`` is false for all.

    Args:
        scenario: Any stored scenario.
        name: Name of the file.
    """
    recording = restore(scenario)
    count = len(recording.tracks.kind)
    rows = [*(row for row in range(count) if row != recording.ego), recording.ego]
    place = {row: number for number, row in enumerate(rows)}
    ids = recording.tracks.track_id
    return {
        "name": name,
        "scenario_id": recording.scenario_id,
        "objects": [_object(recording, row) for row in rows],
        "roads": [_road(feature) for feature in recording.features],
        "tl_states": {str(light.lane_id): _light(light) for light in recording.lights},
        "metadata": {
            "sdc_track_index": place[recording.ego],
            "objects_of_interest": [int(ids[row]) for row in recording.of_interest],
            "tracks_to_predict": [
                {"track_index": place[row], "difficulty": 0} for row in recording.to_predict
            ],
        },
    }


def _points(points: _Array) -> list[dict[str, float]]:
    return [dict(zip("xyz", point, strict=False)) for point in np.round(points, _DIGITS).tolist()]


def _object(recording: Recording, row: int) -> dict[str, Any]:
    tracks = recording.tracks
    valid = tracks.valid[row]
    last = np.flatnonzero(valid)[-1]
    position = np.column_stack((tracks.xy[row], tracks.z[row]))
    length, width, height = tracks.size[row, last].tolist()
    return {
        "position": _points(np.where(valid[:, None], position, _INVALID)),
        "width": width,
        "length": length,
        "height": height,
        "heading": np.round(np.where(valid, tracks.heading[row], _INVALID), _DIGITS + 2).tolist(),
        "velocity": _points(np.where(valid[:, None], tracks.velocity[row], _INVALID)),
        "valid": valid.tolist(),
        "goalPosition": _points(position[last : last + 1])[0],
        "type": _AGENTS.get(AgentKind(int(tracks.kind[row])), "other"),
        "id": int(tracks.track_id[row]),
        "mark_as_expert": False,
    }


def _road(feature: MapFeature) -> dict[str, Any]:
    return {
        "geometry": _points(feature.points),
        "type": _ROADS[feature.kind],
        "map_element_id": int(feature.kind),
        "id": feature.feature_id,
    }


def _light(light: Light) -> dict[str, list[Any]]:
    """One entry per observation, as GPUDrive's converter writes them."""
    seen = np.flatnonzero(light.states >= 0)
    place = _points(light.stop_point[None])[0]
    states = [LightState(int(light.states[step])).name.lower() for step in seen]
    return {
        "state": states,
        **{axis: [place[axis]] * len(seen) for axis in "xyz"},
        "time_index": seen.tolist(),
    }
