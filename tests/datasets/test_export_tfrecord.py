"""Bytes of tf.Examples and TFRecords, against encoders and decoders that are not drivax's."""

from __future__ import annotations

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datasets.samples import womd_example, womd_scenario
from drivax.datasets.womd.messages import message_class
from drivax.datasets.womd.tfrecord import example, read_records, shard_name, varints, write_record


@given(arrays.arrays(np.int64, st.integers(0, 40)))
def test_varints_are_those_of_the_wire_format(values):
    assert varints(values) == b"".join(womd_scenario.varint(int(value)) for value in values)


@pytest.mark.parametrize("value", [0, 127, 128, 300, 2**31, 2**63 - 1, -1, -(2**63)])
def test_varints_at_size_limits_equal_the_reference(value):
    assert varints(np.array([value])) == womd_scenario.varint(value)


def test_an_example_byte_by_byte():
    written = example({"b": np.array([[1.5, -2.0]]), "a": np.array([3, -1]), "c": b"id"})
    by_hand = womd_example.blob(
        1,
        b"".join(
            womd_example.entry(name, value)
            for name, value in (
                ("a", womd_example.integers([3, -1])),
                ("b", womd_example.floats([1.5, -2.0])),
                ("c", womd_example.blob(1, womd_example.blob(1, b"id"))),
            )
        ),
    )
    assert written == by_hand


def test_the_order_of_the_dictionary_does_not_matter():
    features = {"b": np.zeros(2), "a": np.zeros(3, np.int64)}
    assert example(features) == example(dict(reversed(features.items())))


def test_protobuf_reads_it():
    values = {
        "f": np.linspace(0, 1, 200).reshape(2, 100),
        "i": np.arange(-5, 2000),
        "s": b"\x00\xff",
        "n": np.zeros(0),
    }
    read = message_class("Example").FromString(example(values))
    table = {entry.key: entry.value for entry in read.features.feature}
    np.testing.assert_array_equal(table["f"].float_list.value, values["f"].ravel().astype(np.float32))
    np.testing.assert_array_equal(table["i"].int64_list.value, values["i"])
    assert list(table["s"].bytes_list.value) == [b"\x00\xff"]
    assert list(table["n"].float_list.value) == []


def test_records_are_framed_with_both_checksums(tmp_path):
    path, payloads = tmp_path / "x.tfrecord", (b"one", b"", b"three" * 1000)
    with path.open("wb") as file:
        for payload in payloads:
            write_record(file, payload)
    assert path.read_bytes() == b"".join(womd_scenario.frame(payload) for payload in payloads)
    assert [payload for _, payload in read_records(path)] == list(payloads)


def test_shards_are_named_as_the_public_ones():
    assert shard_name("turns", 3, 150) == "turns.tfrecord-00003-of-00150"
