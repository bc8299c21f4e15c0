"""The data-only reader of pickles against Python's own, and against pickles that name more than data."""

from __future__ import annotations

import os
import pickle
import re
import struct
import tracemalloc
from collections import OrderedDict, defaultdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivax.datasets.scenarionet import pickles
from drivax.errors import DataError


def same(found: Any, wanted: Any) -> bool:
    if isinstance(wanted, np.ndarray) and wanted.dtype.kind != "O":
        return isinstance(found, np.ndarray) and found.shape == wanted.shape and bool((found == wanted).all())
    if isinstance(wanted, np.ndarray):
        return found == wanted.tolist()
    if isinstance(wanted, dict):
        return (
            type(found) is dict
            and list(found) == list(wanted)
            and all(same(found[k], wanted[k]) for k in wanted)
        )
    if isinstance(wanted, list | tuple):
        return type(found) is type(wanted) and len(found) == len(wanted) and all(map(same, found, wanted))
    return found == wanted


SHARED = np.arange(6, dtype=np.float32)
VALUES = {
    "arrays": [
        np.arange(12.0).reshape(3, 4),
        np.arange(5, dtype=np.int16),
        np.array([True, False]),
        np.zeros((0, 3)),
    ],
    "order": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "big endian": np.arange(4, dtype=">f8"),
    "texts": np.array(["a", "lane"]),
    "objects": np.array([None, "LANE_STATE_GO", 3], dtype=object),
    "scalars": [np.float32(1.5), np.int64(-7), np.bool_(True)],
    "twice": [SHARED, SHARED],
    "numbers": [0, 1, 255, 256, 65536, -1, 2**31, 2**70, 1.5, -0.0, True, None],
    "containers": ((), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4), [], {}, set(), {1, "a"}, frozenset({3})),
    "default": defaultdict(int, a=1),
    "ordered": OrderedDict([("b", 1), ("a", 2)]),
    "bytes": [b"", b"x" * 300, bytearray(b"abc")],
    "ä" * 300: "long text",
    (1, "key"): "flat tuple",
}


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_every_protocol_reads_as_python_reads_it(protocol):
    assert same(pickles.load(pickle.dumps(VALUES, protocol)), VALUES)


def test_names_of_older_numpy_and_python_2():
    """Files written before NumPy 2 name numpy.core."""
    new = pickle.dumps([np.arange(3.0), np.float32(2.5)], 2)
    old = new.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert b"numpy.core" in old and same(pickles.load(old), [np.arange(3.0), 2.5])


PLAIN = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary()
NESTED = st.recursive(
    PLAIN, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.tuples(inner)
)


@given(NESTED, st.integers(0, pickle.HIGHEST_PROTOCOL))
def test_any_plain_data(value, protocol):
    assert same(pickles.load(pickle.dumps(value, protocol)), value)


class Runs:
    """What an attacker would pickle."""

    def __init__(self, called, *arguments):
        self.call = called, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    ("called", "name"),
    [(os.system, f"{os.name}.system"), (eval, "builtins.eval"), (getattr, "builtins.getattr"), (open, "io.open"),
     (np.load, "numpy.load")],
)  # fmt: skip
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_18_any_other_global_is_refused_with_its_name(called, name, protocol, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match="which is not data") as error:
        pickles.load(pickle.dumps({"a": Runs(called, "touch trace")}, protocol))
    known_as = {"io.open": ("io.open", "_io.open"), f"{os.name}.system": ("posix.system", "nt.system")}
    assert any(word in error.value.problem for word in known_as.get(name, (name,)))
    assert list(tmp_path.iterdir()) == []


def test_a_constructor_with_odd_arguments_is_refused_with_its_name():
    with pytest.raises(DataError, match=r"invalid arguments for builtins\.set"):
        pickles.load(pickle.dumps(Runs(set, [1], [2]), 2))


def test_objects_of_classes_are_refused():
    class_instance = pickle.dumps(pytest.approx(1.0))
    with pytest.raises(DataError, match="names "):
        pickles.load(class_instance)
    for operation in (b"P0\n.", b"\x82\x01.", b"(ios\nsystem\n."):  # persistent id, extension code, instance
        with pytest.raises(DataError, match=r"operation|names"):
            pickles.load(operation)


def array_pickle(shape: tuple[int, ...], content: bytes) -> bytes:
    """An array that claims a shape, over some bytes."""
    return pickle.dumps(_Array(shape, content), 2)


class _Array:
    def __init__(self, shape, content):
        self.shape, self.content = shape, content

    def __reduce__(self):
        make, arguments, state = np.zeros(3).__reduce__()[:3]
        return make, arguments, (state[0], self.shape, state[2], False, self.content)


HUGE = {
    "array of 8 EB": lambda: array_pickle((2**60,), b"\0" * 24),
    "array of 80 GB, two axes": lambda: array_pickle((100_000, 100_000), b"\0" * 24),
    "array of negative shape": lambda: array_pickle((-3,), b"\0" * 24),
    "array without bytes": lambda: pickle.dumps(_Array((3,), None), 2),
    "text of 4 GB": lambda: b"\x80\x04X\xff\xff\xff\xffabc.",
    "bytes of 2^60": lambda: b"\x80\x04\x8e" + struct.pack("<Q", 2**60) + b"abc.",
    "bytearray of 2^40": lambda: b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b"abc.",
    "whole number of 2 GB": lambda: b"\x80\x02\x8b\xff\xff\xff\x7fabc.",
    "digits": lambda: b"I" + b"9" * 100_000 + b"\n.",
    "nothing": lambda: b"",
    "no stop": lambda: b"\x80\x04N",
    "empty stack": lambda: b"\x80\x04.",
    "two results": lambda: b"\x80\x04NN.",
    "unknown memo": lambda: b"\x80\x04j\xff\xff\xff\xff.",
    "append to nothing": lambda: b"\x80\x04]N\x85Na.",
    "odd number of items": lambda: b"\x80\x04}(Nu.",
    "state of a number": lambda: b"\x80\x04K\x01}b.",
    "call of a number": lambda: b"\x80\x04K\x01)R.",
    "list as a key": lambda: b"\x80\x04}]Ns.",
}


@pytest.mark.parametrize("case", HUGE)
def test_18_damage_is_one_error_and_takes_little_memory(case):
    data = HUGE[case]()
    tracemalloc.start()
    try:
        with pytest.raises(
            DataError, match=r"^is a damaged pickle \(.+\); copy or generate the file again$"
        ) as error:
            pickles.load(data)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()
    assert "\n" not in str(error.value)


def test_18_deep_keys_do_not_end_the_process():
    """Hashing a tuple that is nested deeper than the stack crashes Python."""
    with pytest.raises(DataError, match="a key of type tuple"):
        pickles.load(b"\x80\x04})" + b"\x85" * 50_000 + b"Ns.")


def test_18_memo_index_of_four_billion_takes_no_memory():
    """The index of a memo is any 32-bit number; Python's unpickler makes room for all before it."""
    tracemalloc.start()
    assert pickles.load(b"\x80\x02Nr\xff\xff\xff\xffj\xff\xff\xff\xff\x86.") == (None, None)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_18_repeated_calls_on_one_long_text_are_refused():
    """Each call copies: 10 MB, encoded a thousand times from one text in the memo, would be 10 GB."""
    text = b"X" + struct.pack("<I", 10_000_000) + b"a" * 10_000_000 + b"q\x000"
    again = b"c_codecs\nencode\nh\x00X\x06\x00\x00\x00latin1\x86R"
    with pytest.raises(DataError, match="more than the file contains"):
        pickles.load(b"\x80\x02" + text + b"(" + again * 1000 + b"t.")


def test_18_sizes_have_limits(monkeypatch):
    monkeypatch.setattr(pickles, "MOST_BYTES", 10)
    with pytest.raises(DataError, match="a pickle of"):
        pickles.load(pickle.dumps(list(range(100))))
    monkeypatch.setattr(pickles, "MOST_BYTES", 10_000)
    monkeypatch.setattr(pickles, "MOST_OPERATIONS", 50)
    with pytest.raises(DataError, match="too many parts"):
        pickles.load(pickle.dumps(list(range(100))))
    monkeypatch.setattr(pickles, "MOST_NUMBERS", 3)
    for value in ([0, 1, 2, 3], np.zeros((4, 2))):
        with pytest.raises(DataError, match="heading: 4 rows, more than 3"):
            pickles.floats(value, "heading")


@given(st.data())
def test_damaged_bytes_raise_only_data_errors(data):
    good = bytearray(pickle.dumps(VALUES, data.draw(st.integers(0, 5))))
    for _ in range(data.draw(st.integers(1, 4))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    try:
        pickles.load(bytes(good[: data.draw(st.integers(0, len(good)))]))
    except DataError as error:
        assert re.search("pickle|names |not data|more than", error.problem), error
        assert error.cure and "\n" not in str(error)
