"""A hand-made WOMD Scenario proto, encoded byte by byte from the wire format: no protobuf, no code of drivax."""

from __future__ import annotations

import math
import struct
from pathlib import Path


def varint(number: int) -> bytes:
    number &= 2**64 - 1
    out = bytearray()
    while True:
        out.append((number & 0x7F) | (0x80 if number > 0x7F else 0))
        number >>= 7
        if not number:
            return bytes(out)


def tag(number: int, wire_type: int) -> bytes:
    return varint(number << 3 | wire_type)


def whole(number: int, value: int) -> bytes:
    return tag(number, 0) + varint(value)


def double(number: int, value: float) -> bytes:
    return tag(number, 1) + struct.pack("<d", value)


def single(number: int, value: float) -> bytes:
    return tag(number, 5) + struct.pack("<f", value)


def blob(number: int, value: bytes) -> bytes:
    return tag(number, 2) + varint(len(value)) + value


def point(x: float, y: float, z: float = 0.0) -> bytes:
    return double(1, x) + double(2, y) + double(3, z)


def polyline(number: int, points) -> bytes:
    return b"".join(blob(number, point(*p)) for p in points)


# --- TFRecord framing, with a CRC-32C (Castagnoli, reflected polynomial 0x82F63B78) from its definition.


def _crc_of_byte(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0x82F63B78 if byte & 1 else 0)
    return byte


_CRC_TABLE = [_crc_of_byte(byte) for byte in range(256)]


def crc32c(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFFFFFF


def masked_crc(data: bytes) -> bytes:
    crc = crc32c(data)
    rotated = (crc >> 15 | crc << 17) & 0xFFFFFFFF
    return struct.pack("<I", (rotated + 0xA282EAD8) % 2**32)


def frame(payload: bytes) -> bytes:
    length = struct.pack("<Q", len(payload))
    return length + masked_crc(length) + payload + masked_crc(payload)


# --- A small scenario: ego drives east at 10 m/s on lane 1, a pedestrian waits, a cyclist comes and goes.

STEPS, CURRENT = 91, 10
X0, Y0 = 5000.25, -3000.5


def state(x, y, z, length, width, height, heading, vx, vy, valid=True) -> bytes:
    if not valid:
        return double(4, z) + whole(11, 0)  # as in the real files: a z and nothing else
    sizes = single(5, length) + single(6, width) + single(7, height)
    motion = single(8, heading) + single(9, vx) + single(10, vy)
    return double(2, x) + double(3, y) + double(4, z) + sizes + motion + whole(11, 1)


def track(track_id: int, kind: int, states) -> bytes:
    return whole(1, track_id) + whole(2, kind) + b"".join(blob(3, s) for s in states)


def line(y: float, backwards: bool = False, start: float = -60.0, stop: float = 160.0, step: float = 0.5):
    count = round((stop - start) / step)
    points = [(X0 + start + i * step, Y0 + y, 30.0) for i in range(count + 1)]
    return points[::-1] if backwards else points


def lane(points, limit=None, kind=2, exits=(), entries=(), left=(), right=(), packed=True) -> bytes:
    out = b"" if limit is None else double(1, limit)
    out += whole(2, kind) + whole(3, 0) + polyline(8, points)
    for number, links in ((9, entries), (10, exits)):
        if packed:
            out += blob(number, b"".join(map(varint, links))) if links else b""
        else:
            out += b"".join(whole(number, link) for link in links)
    for number, links in ((11, left), (12, right)):
        out += b"".join(blob(number, whole(1, link) + whole(2, 0) + whole(3, 9)) for link in links)
    return out


def feature(feature_id: int, number: int, body: bytes) -> bytes:
    return whole(1, feature_id) + blob(number, body)


def square(x: float, y: float, half: float = 2.0):
    return [(X0 + x + a * half, Y0 + y + b * half, 30.0) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]


def features() -> list[bytes]:
    first, second = line(0.0, stop=40.0), line(0.0, start=40.0)
    return [
        feature(1, 3, lane(first, limit=25.0, exits=(2, 99), left=(4,))),
        feature(2, 3, lane(second, limit=0.0, entries=(1,), packed=False)),
        feature(4, 3, lane(line(3.7, stop=40.0), limit=45.0, kind=1, right=(1,))),
        feature(5, 4, whole(1, 1) + polyline(2, line(1.85))),
        feature(6, 4, whole(1, 8) + polyline(2, line(-1.0))),
        feature(7, 5, whole(1, 1) + polyline(2, line(-4.0))),
        feature(8, 5, whole(1, 2) + polyline(2, line(7.0, backwards=True))),
        feature(9, 7, blob(1, varint(1) + varint(4)) + blob(2, point(X0 + 40, Y0 - 3, 31.0))),
        feature(10, 8, polyline(1, square(45.0, 0.0))),
        feature(11, 9, polyline(1, square(60.0, 0.0))),
        feature(12, 10, polyline(1, square(70.0, -6.0))),
        whole(1, 13),  # a kind of feature that a later version may add
        feature(14, 3, whole(2, 2)),  # a lane without points
    ]


def light(lane_id: int, value: int, x: float, y: float) -> bytes:
    return whole(1, lane_id) + whole(2, value) + blob(3, point(x, y, 30.0))


def light_steps(steps: int = STEPS) -> list[bytes]:
    """Lane 2 is red, then green from step 50; lane 4 is seen from step 20 on, in the first place of the list."""
    out = []
    for step in range(steps):
        one = blob(1, light(2, 4 if step < 50 else 6, X0 + 40.0, Y0))
        other = blob(1, light(4, 1, X0 - 60.0, Y0 + 3.7)) if step >= 20 else b""
        out.append(other + one)
    return out


def tracks(steps: int = STEPS) -> list[bytes]:
    walker = [state(X0 + 12, Y0 - 6, 31.0, 0.8, 0.8, 1.8, 7.0, 0.0, 0.0) for _ in range(steps)]
    bike = [
        state(X0 + 5 + t, Y0 + 3.7, 30.0, 1.8, 0.7, 1.6, -9.5, 4.0, 0.25, valid=t % 3 != 1 and t < 60)
        for t in range(steps)
    ]
    ego = [
        state(X0 + t - CURRENT, Y0, 30.5, 5.0 + 0.01 * (t % 3), 2.0, 1.7, 2 * math.pi, 10.0, 0.0)
        for t in range(steps)
    ]
    return [track(900, 2, walker), track(17, 3, bike), track(2406, 1, ego)]


def scenario(scenario_id: str = "0123456789abcdef", steps: int = STEPS, **changes) -> bytes:
    """A Scenario proto; ``changes`` replace parts by their bytes."""
    parts = {
        "times": b"".join(double(1, 0.1 * t) for t in range(steps)),
        "tracks": b"".join(blob(2, t) for t in tracks(steps)),
        "interest": whole(4, 17) + whole(4, 2406),
        "id": blob(5, scenario_id.encode()),
        "sdc": whole(6, 2),
        "lights": b"".join(blob(7, s) for s in light_steps(steps)),
        "map": b"".join(blob(8, f) for f in features()),
        "now": whole(10, CURRENT),
        "predict": blob(11, whole(1, 1) + whole(2, 2)),
        "laser": blob(12, b"\x0a\x03abc"),  # compressed lidar, which is not needed
    }
    return b"".join({**parts, **changes}.values())


def _write(folder: Path, payload: bytes) -> Path:
    path = folder / "sample.tfrecord"
    path.write_bytes(frame(payload))
    return path


def write(folder: Path) -> Path:
    """One TFRecord with one record."""
    return _write(folder, scenario())


def _write_short(folder: Path) -> Path:
    """A log of 4 s, in which a frame is dropped after step 20."""
    times = b"".join(double(1, 0.1 * (t + (t > 20))) for t in range(40))
    return _write(folder, scenario(steps=40, times=times))


FORMS = (_write_short,)
