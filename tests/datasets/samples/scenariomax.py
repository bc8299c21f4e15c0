"""A tf.Example as ScenarioMax writes it, from its published description, encoded byte by byte: no code of drivax."""

from __future__ import annotations

from pathlib import Path

from datasets.samples.womd_example import SPANS, entry, floats, integers
from datasets.samples.womd_scenario import blob, frame

ROWS, SLOTS, POINTS, PATHS, PATH_POINTS = 5, 4, 540, 10, 300
PADDING_ID = -1
NAMES = (
    "x",
    "y",
    "z",
    "length",
    "width",
    "height",
    "bbox_yaw",
    "velocity_x",
    "velocity_y",
    "speed",
    "vel_yaw",
)


def row_state(row: int, t: int) -> dict[str, float] | None:
    """Row 0 the ego, row 1 a walker who is there from step 20 on, row 2 a car; the rest is padding."""
    unknown = (-1.0, -1.0)
    if row == 0:
        return dict(zip(NAMES, (t - 10, 0, 0.9, 5, 2, 1.8, 0, 10, 0, *unknown), strict=True))
    if row == 1 and t >= 20:
        return dict(zip(NAMES, (30, -6 + 0.1 * t, 0.9, 0.8, 0.8, 1.8, 7.5, 0, 1, *unknown), strict=True))
    if row == 2:
        return dict(zip(NAMES, (40 - 0.5 * t, 3.5, 0.8, 4.5, 1.9, 1.6, -3, -5, 0.5, *unknown), strict=True))
    return None


def map_points():
    """(id, code, mph, point): two lanes in line, 25 mph and unknown, an oncoming one, edges, a crosswalk, a sign."""
    first = [(7, 2, 25.0, (1.01 * i - 40, 0.0, 0.0)) for i in range(80)]
    second = [(3, 2, -1.0, (39.79 + 1.01 * i, 0.0, 0.0)) for i in range(80)]
    oncoming = [(4, 1, 55.0, (110 - 1.01 * i, 3.5, 0.0)) for i in range(120)]
    right = [(9, 15, -1.0, (1.01 * i - 40, -1.8, 0.0)) for i in range(120)]
    left = [(8, 15, -1.0, (80 - 1.01 * i, 5.3, 0.0)) for i in range(120)]
    ring = [
        (2, 18, -1.0, p) for p in ((30.0, -8.0, 0.0), (33.0, -8.0, 0.0), (33.0, 8.0, 0.0), (30.0, 8.0, 0.0))
    ]
    return [*first, *second, *oncoming, *right, *left, *ring, (1, 17, -1.0, (29.0, -3.0, 0.0))]


def example(scenario_id: str = "sm_0001", **changes) -> bytes:
    """A tf.Example; ``changes`` replace features (``name -> bytes``, or None to leave one out)."""
    padding = ROWS - 3
    entries = {
        "scenario/id": blob(1, blob(1, scenario_id.encode())),
        "state/id": floats([0, 1, 2, *[PADDING_ID] * padding]),
        "state/type": floats([1, 2, 1, *[-1] * padding]),
        "state/is_sdc": integers([1, 0, 0, *[0] * padding]),
        "state/tracks_to_predict": integers([1, 0, 1, *[0] * padding]),
        "state/objects_of_interest": integers([0] * ROWS),
    }
    for span, (start, stop) in SPANS.items():
        cells = [row_state(row, t) for row in range(ROWS) for t in range(start, stop)]
        entries[f"state/{span}/valid"] = integers(int(cell is not None) for cell in cells)
        entries[f"state/{span}/timestamp_micros"] = integers([-1] * len(cells))
        for name in NAMES:
            entries[f"state/{span}/{name}"] = floats(-1.0 if cell is None else cell[name] for cell in cells)
        entries |= lights(span, start, stop)
    entries |= road_graph() | paths()
    entries |= changes
    return blob(1, b"".join(entry(name, value) for name, value in entries.items() if value is not None))


def lights(span: str, start: int, stop: int) -> dict[str, bytes]:
    """Static slots, all valid: lane 3 turns green at step 40 after nothing was known, lane 4 is never known."""
    base, steps = f"traffic_light_state/{span}/", stop - start
    lanes = [3, 4, -1, -1]
    states = [state for t in range(start, stop) for state in (6 if t >= 40 else 0, 0, 0, 0)]
    return {
        base + "id": integers(lanes * steps),
        base + "state": integers(states),
        base + "valid": integers([1] * SLOTS * steps),
        base + "x": floats([39.79, 110.0, -1.0, -1.0] * steps),
        base + "y": floats([0.0, 3.5, -1.0, -1.0] * steps),
        base + "z": floats([0.0, 0.0, -1.0, -1.0] * steps),
        base + "timestamp_micros": integers([0] * steps),
    }


def road_graph() -> dict[str, bytes]:
    """Points, and padding up to the fixed number (30,000 in real files); all directions are (1, 0, 0)."""
    points = map_points()
    padding = POINTS - len(points)
    directions = [(1.0, 0.0, 0.0)] * len(points)
    base = "roadgraph_samples/"
    return {
        base + "xyz": floats([v for *_, p in points for v in p] + [-1.0] * 3 * padding),
        base + "dir": floats([v for d in directions for v in d] + [-1.0] * 3 * padding),
        base + "id": integers([i for i, *_ in points] + [-1] * padding),
        base + "type": integers([code for _, code, *_ in points] + [-1] * padding),
        base + "valid": integers([1] * len(points) + [0] * padding),
        base + "speed_limit": floats([mph for _, _, mph, _ in points] + [-1.0] * padding),
    }


def paths() -> dict[str, bytes]:
    """Ten places for paths of 300 points; one path, along lanes 7 and 3, is there."""
    along = [(7, 1.01 * i) for i in range(40)] + [(3, 1.01 * i) for i in range(40, 120)]
    rest = PATHS * PATH_POINTS - len(along)
    return {
        "path_samples/xyz": floats([v for _, s in along for v in (s, 0.0, 0.0)] + [-1.0] * 3 * rest),
        "path_samples/id": integers([lane for lane, _ in along] + [-1] * rest),
        "path_samples/valid": integers([1] * len(along) + [0] * rest),
        "path_samples/arc_length": floats([s for _, s in along] + [0.0] * rest),
        "path_samples/on_route": integers([1] + [0] * (PATHS - 1)),
    }


def write(folder: Path) -> Path:
    """One TFRecord with one record."""
    path = folder / "sample.tfrecord"
    path.write_bytes(frame(example()))
    return path
