"""Tables of messages against protobuf, message by message."""

from __future__ import annotations

import random

import numpy as np
import pytest

from drivax.datasets.womd.messages import POINTS, STATES, read_one, read_table
from drivax.errors import DataError


def full(wire, rng) -> list[bytes]:
    """The ten fields of a state, one by one."""
    doubles = [wire.double(n, rng.uniform(-1e4, 1e4)) for n in (2, 3, 4)]
    singles = [wire.single(n, rng.uniform(-10, 10)) for n in (5, 6, 7, 8, 9, 10)]
    return [*doubles, *singles, wire.whole(11, 1)]


def shapes(wire, rng) -> list[bytes]:
    """States of every shape: in order, reversed, shuffled, invalid, partial, with unknown or repeated fields."""
    fields = full(wire, rng)
    shuffled = rng.sample(fields, len(fields))
    invalid = [wire.double(4, 30.0), wire.whole(11, 0)]
    return [
        b"".join(fields),
        b"".join(fields[::-1]),
        b"".join(shuffled),
        b"".join(invalid),
        b"".join(invalid[::-1]),
        b"".join([*fields[:-1], wire.whole(11, 0)]),
        b"",
        b"".join([*fields, wire.double(2, 5.0)]),  # the last of two counts
        b"".join([*fields[2:], wire.double(15, 1.0), wire.double(14, 2.0)]),  # 59 bytes as well
        b"".join(fields[:-1]) + b"\x58\x81\x00",  # a bool may be written longer
        b"".join(fields[:-1]) + b"\x58\x02",
    ]


def test_table_equals_protobuf(wire):
    rng = random.Random(3)
    blobs = [blob for _ in range(40) for blob in shapes(wire, rng)]
    rng.shuffle(blobs)
    expected = np.array([read_one(blob, STATES) for blob in blobs])
    np.testing.assert_array_equal(read_table(blobs, STATES), expected)
    assert set(expected[:, 9]) == {0.0, 1.0}


def test_values_and_columns(wire):
    state = wire.state(1.5, -2.5, 3.5, 4.5, 1.75, 1.25, -0.5, 6.5, -7.5)
    np.testing.assert_array_equal(
        read_table([state], STATES), [[1.5, -2.5, 3.5, 4.5, 1.75, 1.25, -0.5, 6.5, -7.5, 1.0]]
    )
    points = [wire.point(1.0, 2.0, 3.0), wire.double(3, 7.0) + wire.double(2, 6.0) + wire.double(1, 5.0)]
    flat = wire.double(1, 8.0) + wire.double(2, 9.0)
    np.testing.assert_array_equal(read_table([*points, flat], POINTS), [[1, 2, 3], [5, 6, 7], [8, 9, 0]])


def test_no_messages_give_an_empty_table():
    assert read_table([], POINTS).shape == (0, 3) and read_table([], STATES).shape == (0, 10)


@pytest.mark.parametrize("blob", [b"\x09", b"\x0a\xff", b"\x09" * 26, b"\xff" * 27])
def test_damage_is_refused(blob, wire):
    with pytest.raises(DataError, match="MapPoint is damaged"):
        read_table([wire.point(1, 2, 3), blob], POINTS)


def test_usual_messages_never_reach_protobuf(wire, monkeypatch):
    """What makes it fast: states and points as WOMD writes them are read as records."""
    monkeypatch.setattr("drivax.datasets.womd.messages.read_one", lambda *_: pytest.fail("read one by one"))
    states = [wire.state(1, 2, 3, 4, 5, 6, 7, 8, 9, valid=v) for v in (True, False, True)]
    assert read_table(states, STATES)[:, 9].tolist() == [1, 0, 1]
