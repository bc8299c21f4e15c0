"""A tiny nuScenes: one scene of 20 s on a road of two lanes with a left turn, written as plain JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path

#: Microseconds of the first keyframe.
BEGIN = 1_532_402_927_647_951
CITY = "boston-seaport"
#: The ego's rear axle: 8 m/s along y = 100.
START, SPEED = (600.0, 100.0), 8.0
LANE_M = 3.6
RADIUS = 12.0


def quaternion(yaw: float) -> list[float]:
    return [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def _box(token, sample, instance, xy, size, yaw=0.0) -> dict:
    return {
        "token": token,
        "sample_token": f"sample{sample}",
        "instance_token": instance,
        "translation": [*xy, 1.0],
        "size": size,
        "rotation": quaternion(yaw),
    }


def annotations() -> list[dict]:
    """A car 20 m ahead, a pedestrian who is not seen at keyframes 10 and 11, a cone, and a car that turns around."""
    rows = []
    for k in range(40):
        t = 0.5 * k
        rows.append(_box(f"a{k}", k, "car", (START[0] + 20 + SPEED * t, START[1]), [1.9, 4.5, 1.6]))
        if k not in (10, 11):
            rows.append(_box(f"b{k}", k, "walker", (650.0, 110.0 - 0.5 * t), [0.6, 0.7, 1.8], -math.pi / 2))
        rows.append(_box(f"c{k}", k, "cone", (640.0, 97.5), [0.4, 0.4, 0.8]))
        # Its heading passes through pi between keyframes.
        rows.append(_box(f"d{k}", k, "turner", (700.0, 112.0), [1.8, 4.2, 1.5], math.pi - 0.2 + 0.02 * k))
    return rows


def tables() -> dict[str, list[dict]]:
    keyframes = [BEGIN + 500_000 * k for k in range(40)]
    frames = [BEGIN + 50_000 * k for k in range(391)]
    return {
        "log": [{"token": "log", "logfile": "n008-2018-08-01", "location": CITY, "vehicle": "n008"}],
        "scene": [
            {"token": "scene", "name": "scene-0001", "log_token": "log", "nbr_samples": 40, "description": ""}
        ],
        "sample": [
            {"token": f"sample{k}", "scene_token": "scene", "timestamp": t} for k, t in enumerate(keyframes)
        ],
        "sample_data": [
            {
                "token": f"data{i}",
                "sample_token": f"sample{min(i // 10, 39)}",
                "ego_pose_token": f"pose{i}",
                "timestamp": t,
                "filename": f"{'samples' if i % 10 == 0 else 'sweeps'}/LIDAR_TOP/{t}.pcd.bin",
            }
            for i, t in enumerate(frames)
        ]
        + [
            {
                "token": "camera",
                "sample_token": "sample0",
                "ego_pose_token": "nowhere",
                "timestamp": BEGIN + 7,
                "filename": "samples/CAM_FRONT/x.jpg",
            }
        ],
        "ego_pose": [
            {
                "token": f"pose{i}",
                "timestamp": t,
                "translation": [START[0] + SPEED * 0.05 * i, START[1], 0.0],
                "rotation": quaternion(0.0),
            }
            for i, t in enumerate(frames)
        ],
        "category": [
            {"token": "c1", "name": "vehicle.car"},
            {"token": "c2", "name": "human.pedestrian.adult"},
            {"token": "c3", "name": "movable_object.trafficcone"},
        ],
        "instance": [
            {"token": "car", "category_token": "c1"},
            {"token": "walker", "category_token": "c2"},
            {"token": "cone", "category_token": "c3"},
            {"token": "turner", "category_token": "c1"},
        ],
        "sample_annotation": annotations(),
    }


def arc(start, lengths, shape, radius=999.9) -> dict:
    return {"start_pose": list(start), "shape": shape, "radius": radius, "segment_length": lengths}


def city() -> dict:
    """Two lanes to the east from x = 550 to 700; the left one goes on as a left turn into a lane to the north."""
    nodes, lines, polygons = [], [], []

    def node(x: float, y: float) -> str:
        nodes.append({"token": f"n{len(nodes)}", "x": x, "y": y})
        return nodes[-1]["token"]

    def polygon(corners, holes=()) -> str:
        polygons.append(
            {
                "token": f"p{len(polygons)}",
                "exterior_node_tokens": [node(*corner) for corner in corners],
                "holes": [{"node_tokens": [node(*corner) for corner in hole]} for hole in holes],
            }
        )
        return polygons[-1]["token"]

    def rectangle(x0, y0, x1, y1):
        return [(x0, y0), (x0, y1), (x1, y1), (x1, y0)]  # clockwise

    left = 100.0 + LANE_M
    turn = (700.0, left, 0.0), (700.0 + RADIUS, left + RADIUS, math.pi / 2)
    lines.append(
        {"token": "l0", "node_tokens": [node(550.0, left + LANE_M / 2), node(700.0, left + LANE_M / 2)]}
    )
    segments = [
        {"node_token": node(550.0, 100 + LANE_M / 2), "segment_type": "DASHED_WHITE"},
        {"node_token": node(650.0, 100 + LANE_M / 2), "segment_type": "SINGLE_SOLID_WHITE"},
        {"node_token": node(700.0, 100 + LANE_M / 2), "segment_type": "NIL"},
    ]
    return {
        "version": "1.3",
        "node": nodes,
        "line": lines,
        "polygon": polygons,
        "drivable_area": [
            {
                "token": "d0",
                "polygon_tokens": [
                    polygon(rectangle(540.0, 97.0, 1000.0, 107.0), [rectangle(800.0, 101.0, 820.0, 103.0)]),
                    polygon(rectangle(708.0, 106.0, 716.0, 250.0)),
                ],
            }
        ],
        "lane": [
            {
                "token": "right",
                "polygon_token": polygon(rectangle(550, 100 - LANE_M / 2, 700, 100 + LANE_M / 2)),
            },
            {
                "token": "left",
                "polygon_token": polygon(rectangle(550, 100 + LANE_M / 2, 700, left + LANE_M / 2)),
            },
            {
                "token": "on",
                "polygon_token": polygon(rectangle(700, 100 - LANE_M / 2, 1000, 100 + LANE_M / 2)),
            },
            {"token": "north", "polygon_token": polygon(rectangle(710, left + RADIUS, 714, 250))},
        ],
        "lane_connector": [
            {"token": "turn", "polygon_token": polygon(rectangle(700, left, 712, left + RADIUS))}
        ],
        "arcline_path_3": {
            "right": [arc((550.0, 100.0, 0.0), [0.0, 150.0, 0.0], "LSR")],
            "left": [arc((550.0, left, 0.0), [50.0, 50.0, 50.0], "SSS")],
            "on": [arc((700.0, 100.0, 0.0), [0.0, 300.0, 0.0], "RSL")],
            "turn": [arc(turn[0], [RADIUS * math.pi / 2, 0.0, 0.0], "LSL", RADIUS)],
            "north": [arc(turn[1], [0.0, 250.0 - turn[1][1], 0.0], "LSL")],
        },
        "connectivity": {
            "right": {"incoming": [], "outgoing": ["on"]},
            "left": {"incoming": ["gone"], "outgoing": ["turn"]},
            "turn": {"incoming": ["left"], "outgoing": ["north"]},
            "on": {"incoming": ["right"], "outgoing": []},
            "north": {"incoming": ["turn"], "outgoing": []},
        },
        "lane_divider": [{"token": "ld", "line_token": "l0", "lane_divider_segments": segments}],
        "road_divider": [{"token": "rd", "line_token": "l0"}],
        "ped_crossing": [{"token": "pc", "polygon_token": polygon(rectangle(645.0, 97.0, 649.0, 107.0))}],
        "stop_line": [
            {
                "token": "sl",
                "stop_line_type": "STOP_SIGN",
                "polygon_token": polygon(rectangle(697.0, left - 1.5, 700.5, left + 1.5)),
            },
            {
                "token": "sl2",
                "stop_line_type": "YIELD",
                "polygon_token": polygon(rectangle(697.0, 98.5, 700.5, 101.5)),
            },
        ],
        "traffic_light": [],
    }


def write(folder: Path) -> Path:
    """Writes the data set; the path of the file that a reader is given."""
    version, expansion = folder / "v1.0-mini", folder / "maps" / "expansion"
    version.mkdir(parents=True)
    expansion.mkdir(parents=True)
    for name, rows in tables().items():
        (version / f"{name}.json").write_text(json.dumps(rows, indent=0))
    (expansion / f"{CITY}.json").write_text(json.dumps(city()))
    return version / "scene.json"
