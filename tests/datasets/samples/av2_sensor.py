"""A small Argoverse 2 sensor log: the road of the forecasting sample turned by half a radian, 96 frames."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather
from scipy.spatial.transform import Rotation

from datasets.samples import av2_motion

LOG = "3b3570b4-0000-3268-a571-00000000cbf4"
FRAMES = 96
TURN = 0.5
START_NS = 315_971_916_960_141_000
SPEED_MPS = 6.0
#: The car's nose points a little down, so that frames matter in three dimensions.
PITCH = 0.02
AXLE_M = 0.33
#: Boxes: uuid, category, size, x at the first frame, y, speed along the road, frames.
BOXES = (
    ("2f28de2e-car", "REGULAR_VEHICLE", (4.5, 1.9, 1.6), 30.0, 1.75, 6.0, range(FRAMES)),
    ("8f1f6bc5-bus", "BUS", (12.0, 2.9, 3.1), 110.0, 8.75, -7.0, range(FRAMES)),
    ("77a1c0de-man", "PEDESTRIAN", (0.6, 0.7, 1.8), 32.0, -4.0, 0.0, range(5, 60)),
    ("12ab34cd-cone", "CONSTRUCTION_CONE", (0.3, 0.3, 0.8), 50.0, -1.8, 0.0, (*range(20), *range(40, 60))),
)


def stamps() -> np.ndarray:
    """Time stamps of the frames: 10 Hz with up to 0.4 ms of jitter."""
    jitter = np.random.default_rng(4).integers(-400_000, 400_000, FRAMES)
    return START_NS + 100_000_000 * np.arange(FRAMES) + jitter


def axle_pose(stamps_ns: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Poses of the rear axle: constant speed in the slow lane."""
    x = 5.0 + SPEED_MPS * (stamps_ns - START_NS) * 1e-9
    xyz = av2_motion.place(x, 1.75, TURN)
    xyz[:, 2] += AXLE_M
    return Rotation.from_euler("ZY", [[TURN, PITCH]] * len(x)), xyz


def annotations(ego_rows: bool = True) -> dict[str, list]:
    """Boxes in the car's frame, row by row; the car's own box lies on its rear axle, as in real logs."""
    rows = []
    times = stamps()
    rotation, axle = axle_pose(times)
    for frame, stamp in enumerate(times):
        inverse = rotation[frame].inv()
        for uuid, category, size, x, y, speed, seen in BOXES:
            if frame not in seen:
                continue
            centre = av2_motion.place(x + speed * (stamp - START_NS) * 1e-9, y, TURN)
            centre[2] += size[2] / 2
            facing = Rotation.from_euler("Z", TURN if speed >= 0 else TURN + np.pi)
            quaternion = (inverse * facing).as_quat(scalar_first=True)
            rows.append(
                (int(stamp), uuid, category, *size, *quaternion, *inverse.apply(centre - axle[frame]), 40)
            )
        if ego_rows:
            own = (4.877, 2.0, 1.473, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            rows.append((int(stamp), "0000-ego", "EGO_VEHICLE", *own, 1))
    names = (
        "timestamp_ns", "track_uuid", "category", "length_m", "width_m", "height_m", "qw", "qx", "qy", "qz", "tx_m",
        "ty_m", "tz_m", "num_interior_pts",
    )  # fmt: skip
    return {name: [value(row[i]) for row in rows] for i, name in enumerate(names)}


def value(cell):
    """A cell as a plain Python value."""
    return float(cell) if isinstance(cell, np.floating) else cell


def poses() -> dict[str, np.ndarray]:
    """Poses at the frames and every 20 ms between them."""
    between = START_NS + 20_000_000 * np.arange(-2, 5 * FRAMES) + 7
    times = np.unique(np.concatenate((stamps(), between)))
    rotation, xyz = axle_pose(times)
    quaternion = rotation.as_quat(scalar_first=True)
    columns = np.concatenate((quaternion, xyz), axis=1).T
    return {"timestamp_ns": times} | dict(
        zip(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), columns, strict=True)
    )


def write(folder: Path) -> Path:
    """Writes a log with its poses and map; returns the path of its annotations."""
    log = folder / LOG
    (log / "map").mkdir(parents=True)
    pa.feather.write_feather(pa.table(annotations()), log / "annotations.feather", compression="lz4")
    pa.feather.write_feather(
        pa.table(poses()), log / "city_SE3_egovehicle.feather", compression="uncompressed"
    )
    content = json.dumps(av2_motion.local_map(centrelines=False, turn=TURN))
    (log / "map" / f"log_map_archive_{LOG}____PIT_city_31415.json").write_text(content)
    return log / "annotations.feather"
