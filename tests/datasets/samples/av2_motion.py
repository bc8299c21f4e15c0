"""A small Argoverse 2 motion forecasting scenario: a sloping road of four lanes, five tracks, 110 steps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

SCENARIO = "0a1e6f0a-0000-4a98-b02e-00000000d151"
ORIGIN = (-440.0, 1310.0)
STEPS = 110
SPEED_MPS = 8.0
#: Lanes by name, seen eastwards: y of the right and the left boundary, type, marks of the right and the left one.
LANES = {
    "bike": (-1.5, 0.0, "BIKE", "NONE", "SOLID_WHITE"),
    "slow": (0.0, 3.5, "VEHICLE", "SOLID_WHITE", "DASHED_WHITE"),
    "fast": (3.5, 7.0, "VEHICLE", "DASHED_WHITE", "DOUBLE_SOLID_YELLOW"),
    "oncoming": (7.0, 10.5, "VEHICLE", "DOUBLE_SOLID_YELLOW", "NONE"),
}
#: Ids of the west (1) and the east (2) half of each lane.
IDS = {
    name + half: 205_119_000 + 10 * row + int(half) for row, name in enumerate(LANES) for half in ("1", "2")
}
OUTSIDE = 299_000_000


def height(x):
    """Height of the road."""
    return 22.0 + 0.02 * np.asarray(x, np.float64)


def place(x, y, turn=0.0):
    """City coordinates of road coordinates, the road turned about its origin."""
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    return np.stack(
        (
            ORIGIN[0] + np.cos(turn) * x - np.sin(turn) * y,
            ORIGIN[1] + np.sin(turn) * x + np.cos(turn) * y,
            height(x),
        ),
        axis=-1,
    )


def dots(x, y, turn=0.0, flat=False) -> list[dict[str, float]]:
    """Points as a map file has them."""
    return [
        {"x": round(float(a), 2), "y": round(float(b), 2), "z": 0.0 if flat else round(float(c), 2)}
        for a, b, c in place(x, y, turn)
    ]


def local_map(centrelines: bool = True, turn: float = 0.0) -> dict:
    """The map: 60 m + 60 m of road, cut at a tile border; drivable areas are clockwise, as in the real files."""
    segments = {}
    for name, (right, left, kind, right_mark, left_mark) in LANES.items():
        for half, (x0, x1) in (("1", (0.0, 60.0)), ("2", (60.0, 120.0))):
            back = name == "oncoming"
            x = np.array([x1, x0] if back else [x0, (x0 + x1) / 2, x1])
            if back:  # its left is our right
                right, left, right_mark, left_mark = left, right, left_mark, right_mark
            lane = {
                "id": IDS[name + half],
                "is_intersection": half == "2",
                "lane_type": kind,
                "left_lane_boundary": dots(x, left, turn),
                "left_lane_mark_type": left_mark,
                "left_neighbor_id": {"slow": IDS["fast" + half], "fast": IDS["oncoming" + half]}.get(
                    name, IDS["fast" + half] if back else None
                ),
                "right_lane_boundary": dots(x[[0, -1]], right, turn),
                "right_lane_mark_type": right_mark,
                "right_neighbor_id": IDS["slow" + half] if name == "fast" else None,
                "predecessors": _links(name, half, back),
                "successors": _links(name, half, not back),
            }
            if centrelines:
                x = np.linspace(x[0], x[-1], 31)
                lane["centerline"] = dots(x, (left + right) / 2, turn, flat=True)
            segments[str(lane["id"])] = lane
            if back:
                right, left, right_mark, left_mark = left, right, left_mark, right_mark
    outlines = {"11055391": (0, 60), "11055392": (60, 120)}
    areas = {
        name: {"area_boundary": dots([x0, x0, x1, x1], [-2, 11, 11, -2], turn), "id": int(name)}
        for name, (x0, x1) in outlines.items()
    }
    walk = {"edge1": dots([30, 30], [-2, 11], turn), "edge2": dots([34, 34], [-2, 11], turn), "id": 13294505}
    return {"drivable_areas": areas, "lane_segments": segments, "pedestrian_crossings": {"13294505": walk}}


def _links(name: str, half: str, ahead_is_east: bool) -> list[int]:
    """The lane in the next half, one outside the map beyond the east end, none beyond the west end."""
    if ahead_is_east:
        return [IDS[name + "2"]] if half == "1" else [OUTSIDE]
    return [IDS[name + "1"]] if half == "2" else []


def tracks() -> list[tuple]:
    """Id, type, category, first step, x of every step, y, heading, speed of every track."""
    along = SPEED_MPS * 0.1 * np.arange(STEPS)
    return [
        ("138902", "vehicle", 0, 0, 30.0 + along, 1.75, 0.0, SPEED_MPS),
        ("138951", "pedestrian", 3, 3, np.full(70, 32.0), -4.0, 7.0, 0.0),
        ("139084", "bus", 2, 0, 115.0 - along, 8.75, np.pi, -SPEED_MPS),
        ("139085", "riderless_bicycle", 1, 20, np.full(9, 50.0), -3.0, 1.0, 0.0),
        ("AV", "vehicle", 1, 0, 4.0 + along, 1.75, 0.0, SPEED_MPS),
    ]


def columns() -> dict[str, list]:
    """The table as columns of Python values."""
    rows = []
    for name, kind, category, first, xs, y, heading, speed in tracks():
        for step, x in enumerate(xs, start=first):
            px, py, _ = place(x, y)
            state = (float(px), float(py), float(heading), float(speed), 0.0)
            rows.append((step < 50, name, kind, category, step, *state))
    names = (
        "observed", "track_id", "object_type", "object_category", "timestep", "position_x", "position_y", "heading",
        "velocity_x", "velocity_y",
    )  # fmt: skip
    table = {name: [row[i] for row in rows] for i, name in enumerate(names)}
    once = {
        "scenario_id": SCENARIO,
        "start_timestamp": 3.15986559459579e17,
        "end_timestamp": 3.15986570359579e17,
        "num_timestamps": STEPS,
        "focal_track_id": "138951",
        "city": "austin",
        "map_id": 74806,
        "slice_id": "7bef7e1f-0000-4ba5-b39e-00000000aa5b",
    }
    return table | {name: [value] * len(rows) for name, value in once.items()}


def write(folder: Path) -> Path:
    """Writes a scenario and its map; returns the scenario's path."""
    path = folder / f"scenario_{SCENARIO}.parquet"
    pq.write_table(pa.table(columns()), path, compression="snappy")
    (folder / f"log_map_archive_{SCENARIO}.json").write_text(json.dumps(local_map()))
    return path


def _write_without_slice(folder: Path) -> Path:
    """A scenario of the public serializer, which leaves columns out where they are unknown."""
    path = write(folder)
    kept = {name: values for name, values in columns().items() if name not in ("map_id", "slice_id")}
    pq.write_table(pa.table(kept), path, compression="snappy")
    return path


FORMS = (_write_without_slice,)
