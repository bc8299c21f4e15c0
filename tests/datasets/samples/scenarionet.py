"""A ScenarioNet pickle, written from the description of its dictionaries: a T-junction with a light, as from WOMD."""

from __future__ import annotations

import pickle
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

STEPS = 91
X, Y, Z = 8312.0, 8904.0, -24.0  # map frames lie far from their origin


def line(*corners: tuple[float, float], step: float = 0.5) -> np.ndarray:
    """Points every half metre through corners, at the height of the map."""
    corner = np.array(corners, dtype=np.float64)
    reach = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corner, axis=0).T))))
    s = np.linspace(0.0, reach[-1], max(round(reach[-1] / step), 1) + 1)
    xy = np.stack([np.interp(s, reach, corner[:, axis]) for axis in (0, 1)], axis=1)
    return np.concatenate((xy + np.array([X, Y]), np.full((len(s), 1), Z)), axis=1).astype(np.float32)


def track(x: float, y: float, speed: float, size: tuple[float, float, float], kind: str) -> dict[str, Any]:
    """Something that moves east at constant speed; at ``x`` at step 10."""
    along = x + (np.arange(STEPS) - 10) * 0.1 * speed
    length, width, height = (np.full(STEPS, part, np.float32) for part in size)
    position = np.stack((X + along, np.full(STEPS, Y + y), np.full(STEPS, Z + size[2] / 2)), axis=1)
    return {
        "type": kind,
        "state": {
            "position": position.astype(np.float32),
            "length": length,
            "width": width,
            "height": height,
            "heading": np.zeros(STEPS, np.float32),
            "velocity": np.tile(np.array([speed, 0.0], np.float32), (STEPS, 1)),
            "valid": np.ones(STEPS, bool),
        },
        "metadata": {"track_length": STEPS, "type": kind, "object_id": "0", "dataset": "waymo"},
    }


def lane(points: np.ndarray, entry: list[int], leave: list[int], **more: Any) -> dict[str, Any]:
    """A lane; ids of links are whole numbers, ids of neighbours and boundaries texts."""
    return {
        "type": "LANE_SURFACE_STREET", "polyline": points, "speed_limit_mph": 25.0, "speed_limit_kmh": 40.2336,
        "interpolating": False, "entry_lanes": entry, "exit_lanes": leave, "left_boundaries": [],
        "right_boundaries": [], "left_neighbor": [], "right_neighbor": [],
        "width": np.tile(np.array([[1.7, 1.8]], np.float32), (len(points), 1)), **more,
    }  # fmt: skip


def neighbour(name: str) -> dict[str, Any]:
    return {"feature_id": name, "self_start_index": "0", "self_end_index": "10", "boundaries": []}


def features() -> dict[str, Any]:
    ring = line((-60, -2), (20, -2), (20, -40), (28, -40), (28, -2), (120, -2), (120, 6), (-60, 6), (-60, -2))
    cross = line((18, -2), (19, -2), (19, 6), (18, 6), step=9.0)
    return {
        "1": lane(line((-60, 0), (20, 0)), [], [2, 4], left_neighbor=[neighbour("5")]),
        "2": lane(
            line((20, 0), (120, 0)), [1], [], left_neighbor=[], speed_limit_mph=0.0, speed_limit_kmh=0.0
        ),
        "4": lane(line((20, 0), (24, -6), (24, -40)), [1], [99], interpolating=True),
        "5": lane(line((-60, 3.6), (120, 3.6)), [], [], right_neighbor=[neighbour("1")]),
        "7": {"type": "ROAD_EDGE_BOUNDARY", "polyline": ring},
        "8": {"type": "ROAD_LINE_BROKEN_SINGLE_WHITE", "polyline": line((-60, 1.8), (120, 1.8))},
        "9": {"type": "STOP_SIGN", "lane": [4], "position": np.array([X + 22, Y - 3, Z], np.float32)},
        "10": {"type": "CROSSWALK", "polygon": cross},
        "11": {"type": "SPEED_BUMP", "polygon": cross + np.array([10, 0, 0])},
        "12": {"type": "ROAD_EDGE_SIDEWALK", "polygon": cross},
    }


def scenario() -> dict[str, Any]:
    """The dictionary as ScenarioNet's converter of WOMD makes it."""
    states = ["LANE_STATE_STOP"] * 30 + [None] * 10 + ["LANE_STATE_GO"] * (STEPS - 40)
    light = {
        "type": "TRAFFIC_LIGHT", "state": {"object_state": states}, "lane": 2,
        "stop_point": np.array([X + 20, Y, Z], np.float32), "metadata": {"track_length": STEPS},
    }  # fmt: skip
    tracks = {
        "17": track(-20.0, 3.6, 9.0, (4.5, 1.9, 1.6), "VEHICLE"),
        "23": track(30.0, 9.0, 1.0, (0.7, 0.8, 1.8), "PEDESTRIAN"),
        "2406": track(-40.0, 0.0, 10.0, (5.3, 2.3, 2.0), "VEHICLE"),
    }
    return {
        "id": "0123456789abcdef",
        "version": "v1.2",
        "length": STEPS,
        "tracks": tracks,
        "dynamic_map_states": {"2": light},
        "map_features": features(),
        "metadata": {
            "id": "0123456789abcdef", "coordinate": "waymo", "metadrive_processed": False, "sdc_id": "2406",
            "ts": (np.arange(STEPS) * 0.1).astype(np.float32), "dataset": "waymo", "current_time_index": 10,
            "sdc_track_index": 2, "objects_of_interest": ["17"],
            "tracks_to_predict": {"23": {"track_index": 1, "track_id": "23", "difficulty": 0}},
            "number_summary": {"types": {"VEHICLE"}, "num_moving_objects_each_type": defaultdict(int, VEHICLE=2)},
        },
    }  # fmt: skip


#: What nuScenes' prediction samples add to the name of a scene: tokens of an agent and a keyframe.
TOKENS = "_" + "0123456789abcdef" * 2 + "_" + "fedcba9876543210" * 2


def first_form(tree: dict[str, Any]) -> dict[str, Any]:
    """The scene as MetaDrive 0.3.0.1 wrote it: sizes in one field, outlines as polylines, lights in numbers."""
    for track in tree["tracks"].values():
        state = track["state"]
        state["size"] = np.stack([state.pop(name) for name in ("length", "width", "height")], axis=1)
        state["valid"] = state["valid"].astype(np.uint8)
    for body in tree["map_features"].values():
        if "polygon" in body:
            body["polyline"] = body.pop("polygon")
            body["type"] = body["type"].replace("CROSSWALK", "CROSS_WALK")
    words = {None: 0, "LANE_STATE_STOP": 4, "LANE_STATE_GO": 6}
    for key, body in tree["dynamic_map_states"].items():
        seen = np.array([state is not None for state in body["state"]["object_state"]])
        body["state"] = {
            "object_state": np.array([words[state] for state in body["state"]["object_state"]], np.int32),
            "lane": np.where(seen, int(key), 0),
            "stop_point": np.where(seen[:, None], body.pop("stop_point"), 0.0).astype(np.float32),
        }
        del body["lane"]
    return tree


def nuscenes(tree: dict[str, Any]) -> dict[str, Any]:
    """The scene as ScenarioNet's converter of nuScenes writes it: flat, yaw as height, outlines as markings."""
    tree["version"] = "nuscenesv1.0-mini"
    tree["metadata"] |= {"dataset": "nuscenes", "map": "boston-seaport", "sdc_id": "ego"}
    del tree["metadata"]["current_time_index"]
    tree["tracks"]["ego"] = tree["tracks"].pop("2406")
    tree["tracks"]["ego"]["state"]["position"][:, 2] = 0.0
    state = tree["tracks"]["ego"]["state"]
    state["length"], state["width"] = state["width"], state["length"]
    for track in tree["tracks"].values():
        track["state"]["velocity"][-1] = 0.0
    tree["dynamic_map_states"] = {}
    features = tree["map_features"]
    for name in ("9", "10", "11", "12"):
        del features[name]
    for body in features.values():
        if "LANE" in body["type"]:
            step = np.diff(body["polyline"][:, :2].astype(np.float64), axis=0)
            yaw = np.arctan2(step[:, 1], step[:, 0])
            body["polyline"] = [
                (*xy, a) for xy, a in zip(body["polyline"][:, :2].tolist(), [*yaw, yaw[-1]], strict=True)
            ]
            body["entry_lanes"], body["exit_lanes"] = [], []
        else:
            body["polyline"] = body["polyline"][:, :2].astype(np.float64)
    ring = features.pop("7")["polyline"]
    island = line((50, 1.5), (60, 1.5), (60, 2), (50, 2), (50, 1.5))[:, :2].astype(np.float64)
    features["boundary_0"] = {"type": "ROAD_LINE_SOLID_SINGLE_WHITE", "polyline": ring[::-1]}
    features["boundary_1"] = {"type": "ROAD_LINE_SOLID_SINGLE_WHITE", "polyline": island}
    return tree


def recentred(tree: dict[str, Any], origin: tuple[float, float]) -> dict[str, Any]:
    """The scene with another origin, as converters and MetaDrive move it: zeros of invalid states move too."""
    shift = np.array([*origin, 0.0])
    for track in tree["tracks"].values():
        track["state"]["position"] = track["state"]["position"].astype(np.float64) - shift
    for body in tree["map_features"].values():
        for name in {"polyline", "polygon", "position"} & body.keys():
            points = np.asarray(body[name], np.float64)
            body[name] = points - shift[: points.shape[-1]]
    for body in tree["dynamic_map_states"].values():
        body["stop_point"] = np.asarray(body["stop_point"]) - shift
    return tree


def window() -> dict[str, Any]:
    """One of several windows of a nuScenes scene, with its origin where the ego begins."""
    tree = scenario() | {"id": "scene-0103" + TOKENS}
    tree["tracks"]["17"]["state"]["valid"][50:] = False
    tree["tracks"]["17"]["state"]["position"][50:] = 0.0
    return recentred(nuscenes(tree), (X - 50.0, Y))


def _dump(folder: Path, tree: dict[str, Any]) -> Path:
    path = folder / "sd_waymo_v1.2_0123456789abcdef.pkl"
    path.write_bytes(pickle.dumps(tree, protocol=4))
    return path


def write(folder: Path) -> Path:
    """Writes one scenario file and returns its path."""
    return _dump(folder, scenario())


def at_steps(tree: dict[str, Any], steps: np.ndarray) -> dict[str, Any]:
    """The scene with these frames only, each at its own time: short logs, dropped frames."""
    for track in tree["tracks"].values():
        track["state"] = {name: values[steps] for name, values in track["state"].items()}
    for body in tree["dynamic_map_states"].values():
        states = body["state"]["object_state"]
        body["state"]["object_state"] = [states[step] for step in steps.tolist()]
    tree["metadata"]["ts"] = tree["metadata"]["ts"][steps]
    return tree | {"length": len(steps)}


def backwards(tree: dict[str, Any]) -> dict[str, Any]:
    """The scene with the heading of every track off by pi."""
    for track in tree["tracks"].values():
        track["state"]["heading"] = track["state"]["heading"] + np.float32(np.pi)
    return tree


#: Steps of a log of 3.4 s with two dropped frames and a gap.
SHORT = np.delete(np.arange(34), [15, 22, 28, 29, 30])
#: Scenes in further forms, which are damaged in turn (fuzz.run).
FORMS = tuple(
    lambda folder, form=form: _dump(folder, form())
    for form in (
        lambda: first_form(scenario()),
        window,
        lambda: at_steps(scenario(), SHORT),
        lambda: backwards(scenario()),
    )
)
