"""A tf.Example with agents like those of ``womd_scenario``, encoded byte by byte: no protobuf, no code of drivax."""

from __future__ import annotations

import struct
from pathlib import Path

from datasets.samples.womd_scenario import CURRENT, blob, frame, varint


def floats(values) -> bytes:
    return blob(2, blob(1, b"".join(struct.pack("<f", v) for v in values)))


def integers(values) -> bytes:
    return blob(3, blob(1, b"".join(varint(v) for v in values)))


def entry(name: str, value: bytes) -> bytes:
    return blob(1, blob(1, name.encode()) + blob(2, value))


ROWS, SLOTS = 6, 2
SPANS = {"past": (0, 10), "current": (10, 11), "future": (11, 91)}


def row_state(row: int, t: int) -> dict[str, float] | None:
    """Row 0 the bike, row 2 the ego, row 3 the pedestrian; row 1 never valid, the rest padding."""
    names = ("x", "y", "z", "length", "width", "height", "bbox_yaw", "velocity_x", "velocity_y")
    if row == 0 and t % 3 != 1 and t < 60:
        return dict(zip(names, (5 + t, 3.7, 30, 1.8, 0.7, 1.6, -9.5, 4, 0.25), strict=True))
    if row == 2:
        return dict(zip(names, (t - CURRENT, 0, 30.5, 5, 2, 1.7, 7, 10, 0), strict=True))
    if row == 3:
        return dict(zip(names, (12, -6, 31, 0.8, 0.8, 1.8, 7, 0, 0), strict=True))
    return None


def example_points(spacing: float = 1.0):
    """(id, code, points): features interleaved on purpose, the polygon closed as the official writer does."""
    first = [(x * spacing, 0.0, 30.0) for x in range(-20, 60)]
    edge = [(x * spacing, -4.0, 30.0) for x in range(-20, 60)]
    ring = [(40.0, -2.0, 30.0), (44.0, -2.0, 30.0), (44.0, 2.0, 30.0), (40.0, 2.0, 30.0), (40.0, -2.0, 30.0)]
    out = [(70, 2, p) for p in first[:40]] + [(71, 15, p) for p in edge] + [(70, 2, p) for p in first[40:]]
    return out + [(72, 18, p) for p in ring] + [(73, 17, (30.0, -5.0, 30.0))]


def example(
    scenario_id: str | None = "fedcba9876543210", full: bool = False, spacing: float = 1.0, **changes
) -> bytes:
    """A tf.Example; ``changes`` replace features (``name -> bytes``, or None to leave one out)."""
    entries = {
        "state/id": floats([17, 33, 2406, 900, -1, -1]),
        "state/type": floats([3, 1, 1, 2, -1, -1]),
        "state/is_sdc": integers([0, 0, 1, 0, -1, -1]),
        "state/tracks_to_predict": integers([1, 0, 0, 0, -1, -1]),
        "state/objects_of_interest": integers([0, 0, 1, 1, -1, -1]),
        "state/difficulty_level": integers([2, 0, 0, 0, -1, -1]),
        **example_paths(),
    }
    if scenario_id is not None:
        entries["scenario/id"] = blob(1, blob(1, scenario_id.encode()))
    names = ("x", "y", "z", "length", "width", "height", "bbox_yaw", "velocity_x", "velocity_y")
    for span, (start, stop) in SPANS.items():
        cells = [(t, row_state(row, t)) for row in range(ROWS) for t in range(start, stop)]
        entries[f"state/{span}/valid"] = integers(int(s is not None) for _, s in cells)
        entries[f"state/{span}/timestamp_micros"] = integers(
            -1 if s is None else 100_000 * t for t, s in cells
        )
        for name in names:
            entries[f"state/{span}/{name}"] = floats(-1.0 if s is None else s[name] for _, s in cells)
        entries |= example_lights(span, start, stop)
    points = example_points(spacing)
    padding = 0 if full else 7
    entries["roadgraph_samples/xyz"] = floats([v for _, _, p in points for v in p] + [-1.0] * 3 * padding)
    entries["roadgraph_samples/id"] = integers([i for i, _, _ in points] + [-1] * padding)
    entries["roadgraph_samples/type"] = integers([c for _, c, _ in points] + [-1] * padding)
    entries["roadgraph_samples/valid"] = integers([1] * len(points) + [0] * padding)
    entries |= changes
    return blob(1, b"".join(entry(name, value) for name, value in entries.items() if value is not None))


def example_paths() -> dict[str, bytes]:
    """Three places for paths of four points: two paths along lane 70, and padding."""
    xyz = [(i, 0.0, 30.0) for i in range(4)] * 2 + [(-1.0,) * 3] * 4
    return {
        "path_samples/xyz": floats(v for p in xyz for v in p),
        "path_samples/valid": integers([1] * 4 + [1, 1, 0, 0] + [0] * 4),
        "path_samples/id": integers([70] * 4 + [70, 70, -1, -1] + [-1] * 4),
        "path_samples/arc_length": floats([0, 1, 2, 3, 0, 1, -1, -1] + [-1] * 4),
        "path_samples/on_route": integers([1, 0, 0]),
    }


def example_lights(span: str, start: int, stop: int) -> dict[str, bytes]:
    """Slot 0 holds lane 70 before step 30 and lane 75 after; slot 1 holds lane 70 from step 30 on."""
    base = f"traffic_light_state/{span}/"
    ids = [lane_id for t in range(start, stop) for lane_id in ((70, -1) if t < 30 else (75, 70))]
    return {
        base + "id": integers(ids),
        base + "valid": integers(int(i != -1) for i in ids),
        base + "state": integers({70: 4, 75: 6, -1: -1}[i] for i in ids),
        base + "x": floats({70: 20.0, 75: 25.0, -1: -1.0}[i] for i in ids),
        base + "y": floats(-1.0 if i == -1 else 0.5 for i in ids),
        base + "z": floats(-1.0 if i == -1 else 30.0 for i in ids),
    }


def write(folder: Path) -> Path:
    """One TFRecord with one record."""
    path = folder / "sample.tfrecord"
    path.write_bytes(frame(example()))
    return path


def _write_local(folder: Path) -> Path:
    """One record of drivax' own, whose coordinates are relative to the ego."""
    path = folder / "sample.tfrecord"
    path.write_bytes(
        frame(example("drive@40", **{"scenario/origin": blob(1, blob(1, b"664430.1 3996721.9 12.5"))}))
    )
    return path


FORMS = (_write_local,)
