"""A tiny GPUDrive file, written with the standard library from the published description of the format."""

from __future__ import annotations

import json
import math
from pathlib import Path

STEPS, CURRENT = 91, 10
X0, Y0, Z0 = -8330.25, 8096.5, -38.5
MISSING = -10_000.0


def point(x: float, y: float, z: float = 0.0) -> dict[str, float]:
    return {"x": X0 + x, "y": Y0 + y, "z": Z0 + z}


def straight(y: float, start: float, stop: float, spacing: float = 0.5) -> list[dict[str, float]]:
    count = round(abs(stop - start) / spacing)
    return [point(start + i * (stop - start) / count, y) for i in range(count + 1)]


def road(number: int, kind: str, code: int, geometry: list[dict[str, float]]) -> dict:
    return {"geometry": geometry, "type": kind, "map_element_id": code, "id": number}


def square(x: float, y: float, half: float = 2.0) -> list[dict[str, float]]:
    return [point(x + a * half, y + b * half) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]


def roads() -> list[dict]:
    """Two lanes east that meet at x = 20, one lane west, edges with the drivable side on their left."""
    return [
        road(1, "lane", 2, straight(0.0, -20.0, 20.0)),
        road(2, "lane", 2, straight(0.0, 20.0, 60.0)),
        road(5, "lane", 1, straight(4.0, 60.0, -20.0)),
        road(7, "road_line", 11, straight(2.0, -20.0, 60.0)),
        road(8, "road_edge", 15, straight(-2.5, -20.0, 60.0)),
        road(9, "road_edge", 16, straight(6.5, 60.0, -20.0)),
        road(11, "crosswalk", 18, square(30.0, 0.0)),
        road(12, "speed_bump", 19, square(40.0, 0.0)),
        road(13, "driveway", 20, square(10.0, -4.0)),
        road(14, "stop_sign", 17, [point(20.0, -3.0, 1.0)]),
    ]


def agent(number: int, kind: str, size: tuple[float, float, float], pose, velocity) -> dict:
    """``pose`` maps a step to (x, y, heading), or to None where nothing was seen."""
    poses = [pose(t) for t in range(STEPS)]
    nowhere = {"x": MISSING, "y": MISSING, "z": MISSING}
    still = {"x": MISSING, "y": MISSING}
    last = next(p for p in reversed(poses) if p is not None)
    length, width, height = size
    return {
        "position": [nowhere if p is None else point(p[0], p[1], height / 2) for p in poses],
        "width": width,
        "length": length,
        "height": height,
        "heading": [MISSING if p is None else p[2] for p in poses],
        "velocity": [still if p is None else {"x": velocity[0], "y": velocity[1]} for p in poses],
        "valid": [p is not None for p in poses],
        "goalPosition": point(last[0], last[1], height / 2),
        "type": kind,
        "id": number,
        "mark_as_expert": False,
    }


def objects() -> list[dict]:
    """An oncoming car with a gap, a pedestrian who waits, a cyclist who leaves; the ego last, as in real files."""
    return [
        agent(
            78,
            "vehicle",
            (4.6, 2.0, 1.6),
            lambda t: None if 30 <= t < 36 else (50 - 0.4 * t, 4.0, math.pi),
            (-4, 0),
        ),
        agent(3, "pedestrian", (0.8, 0.8, 1.8), lambda t: (25.0, -5.0, 1.5), (0, 0)),
        agent(41, "cyclist", (1.8, 0.7, 1.7), lambda t: (5 + 0.3 * t, -1.5, 0.0) if t < 60 else None, (3, 0)),
        agent(2406, "vehicle", (5.286, 2.332, 2.33), lambda t: (0.5 * (t - CURRENT), 0.0, 0.0), (5, 0)),
    ]


def content(**changes) -> dict:
    """The content of the JSON file; ``changes`` replace top-level entries."""
    return {
        "name": "tfrecord-00000-of-01000_1.json",
        "scenario_id": "ef3a8f65142f41ac",
        "objects": objects(),
        "roads": roads(),
        "tl_states": {},
        "metadata": {
            "sdc_track_index": 3,
            "objects_of_interest": [41, 2406],
            "tracks_to_predict": [{"track_index": 0, "difficulty": 0}],
        },
    } | changes


def write(folder: Path, **changes) -> Path:
    path = folder / "tfrecord-00000-of-01000_1.json"
    path.write_text(json.dumps(content(**changes)))
    return path


def _write_flat(folder: Path) -> Path:
    """A file without heights, with a light whose stop point is missing."""
    agents, elements = objects(), roads()
    for row in agents:
        del row["height"]
    for point in (p for row in (*agents, *elements) for p in row.get("position", row.get("geometry"))):
        point.pop("z", None)
    lane = next(row["id"] for row in elements if row["type"] == "lane")
    light = {"state": ["stop"], "time_index": [0], **{axis: [0.0] for axis in "xyz"}}
    return write(folder, objects=agents, roads=elements, tl_states={str(lane): light})


FORMS = (_write_flat,)
