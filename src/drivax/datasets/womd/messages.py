"""Protocol-buffer messages of the Waymo Open Motion Dataset and of tf.Example, built when first used.

The declarations have the fields of ``waymo_open_dataset/protos/{scenario,map}.proto`` and ``tensorflow/core/example``;
inner messages that drivax does not need, such as camera tokens and compressed lidar, are bytes. Undeclared fields are
dropped and counted (:func:`unknown_fields`). Enums are declared as int32, which is the same on the wire, so that values
of later versions are kept. The messages live in a descriptor pool of their own and so never clash with an installed
``waymo-open-dataset`` package.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64

from drivax.errors import DataError, import_extra

#: Feature of examples that drivax wrote: the origin of their coordinates in the source's map frame.
ORIGIN = "scenario/origin"
_STATE = "x|y|z|bbox_yaw|length|width|height|speed|vel_yaw|velocity_x|velocity_y|valid|timestamp_micros"
_MARK = "id|type|is_sdc|is_context|tracks_to_predict|objects_of_interest|difficulty_level"
#: Names of features, also of those that are not needed.
_KNOWN = re.compile(
    rf"scenario/(id|origin)|state/({_MARK})|state/(past|current|future)/({_STATE})|"
    r"traffic_light_state/(past|current|future)/(state|id|valid|x|y|z|timestamp_micros)|"
    r"roadgraph_samples/(xyz|dir|id|type|valid|speed_limit)|path_samples/(xyz|id|valid|arc_length|on_route)"
)
SKIP = "skip this record, or download the file again"
_Array = np.ndarray[Any, Any]
_FARTHEST_M = 1e8
#: (name, number, type): ``*`` marks a repeated field, ``?`` a member of the message's one-of ``kind``.
_Field = tuple[str, int, str]


def _fields(text: str) -> tuple[_Field, ...]:
    """Parse fields written as ``name number type``, separated by commas."""
    parts = (field.split() for field in text.split(","))
    return tuple((name, int(number), kind) for name, number, kind in parts)


_MESSAGES: dict[str, tuple[_Field, ...]] = {
    # The Scenario proto; states and points of polylines are kept as bytes (:func:`read_table` reads them).
    "Scenario": _fields(
        "timestamps_seconds 1 double*, tracks 2 Track*, objects_of_interest 4 int32*, scenario_id 5 string,"
        "sdc_track_index 6 int32, dynamic_map_states 7 DynamicMapState*, map_features 8 MapFeature*,"
        "current_time_index 10 int32, tracks_to_predict 11 RequiredPrediction*, compressed_frame_laser_data 12 bytes*,"
        "frame_camera_tokens 13 bytes*"
    ),
    "RequiredPrediction": _fields("track_index 1 int32, difficulty 2 int32"),
    "Track": _fields("id 1 int32, object_type 2 int32, states 3 bytes*"),
    "ObjectState": _fields(
        "center_x 2 double, center_y 3 double, center_z 4 double, length 5 float, width 6 float, height 7 float,"
        "heading 8 float, velocity_x 9 float, velocity_y 10 float, valid 11 bool"
    ),
    "DynamicMapState": _fields("lane_states 1 LaneState*"),
    "LaneState": _fields("lane 1 int64, state 2 int32, stop_point 3 MapPoint"),
    "MapPoint": _fields("x 1 double, y 2 double, z 3 double"),
    "MapFeature": _fields(
        "id 1 int64, lane 3 Lane?, road_line 4 Polyline?, road_edge 5 Polyline?, stop_sign 7 StopSign?,"
        "crosswalk 8 Polygon?, speed_bump 9 Polygon?, driveway 10 Polygon?"
    ),
    "Lane": _fields(
        "speed_limit_mph 1 double, type 2 int32, interpolating 3 bool, polyline 8 bytes*, entry_lanes 9 int64*,"
        "exit_lanes 10 int64*, left_neighbors 11 LaneNeighbor*, right_neighbors 12 LaneNeighbor*,"
        "left_boundaries 13 bytes*, right_boundaries 14 bytes*"
    ),
    "LaneNeighbor": _fields(
        "feature_id 1 int64, self_start_index 2 int32, self_end_index 3 int32, neighbor_start_index 4 int32,"
        "neighbor_end_index 5 int32, boundaries 6 bytes*"
    ),
    "Polyline": _fields("type 1 int32, polyline 2 bytes*"),
    "StopSign": _fields("lane 1 int64*, position 2 bytes"),
    "Polygon": _fields("polygon 1 bytes*"),
    # tf.Example; a map field is on the wire a repeated message of key and value. Parsers take lists packed or not.
    "Example": _fields("features 1 Features"),
    "Features": _fields("feature 1 Entry*"),
    "Entry": _fields("key 1 string, value 2 Feature"),
    "Feature": _fields("bytes_list 1 BytesList?, float_list 2 FloatList?, int64_list 3 Int64List?"),
    "BytesList": _fields("value 1 bytes*"),
    "FloatList": _fields("value 1 float*"),
    "Int64List": _fields("value 1 int64*"),
    # Messages of the Waymo perception and end-to-end driving data sets, to tell them from motion data.
    "Context": _fields("name 1 bytes"),
    "Frame": _fields(
        "context 1 Context, timestamp_micros 2 int64, pose 3 bytes, images 4 bytes*, lasers 5 bytes*"
    ),
    "E2EDFrame": _fields("frame 1 Frame, future_states 2 bytes, past_states 3 bytes"),
}

_PACKAGE = "drivax"


def parse(name: str, payload: bytes) -> Any | None:
    """Parse a payload as the message of this name; None for anything else."""
    message = message_class(name)
    from google.protobuf.message import DecodeError

    try:
        return message.FromString(payload)
    except DecodeError:
        return None


def unknown_fields(message: Any, payload: bytes) -> set[tuple[str, int]]:
    """Drop the undeclared fields of a message, nested ones too; return message and number of each in ``payload``."""
    size = message.ByteSize()
    message.DiscardUnknownFields()
    return set() if message.ByteSize() == size else set(_undeclared_fields(message.FromString(payload)))


def _undeclared_fields(message: Any) -> Iterator[tuple[str, int]]:
    """Yield message and number of each undeclared field of a message and of the messages inside it."""
    fields = import_extra("google.protobuf.unknown_fields").UnknownFieldSet(message)
    yield from ((message.DESCRIPTOR.name, field.field_number) for field in fields)
    for field, value in message.ListFields():
        if field.message_type is not None:
            for inner in (value,) if hasattr(value, "ListFields") else value:
                yield from _undeclared_fields(inner)


@cache
def message_class(name: str) -> Any:
    """Return the class of a message: ``Scenario``, ``Example`` (its map of features as repeated entries), ..."""
    descriptor = _pool().FindMessageTypeByName(f"{_PACKAGE}.{name}")
    return import_extra("google.protobuf.message_factory").GetMessageClass(descriptor)


@cache
def _pool() -> Any:
    """Return a descriptor pool with all declared messages."""
    descriptor_pb2 = import_extra("google.protobuf.descriptor_pb2")
    file = descriptor_pb2.FileDescriptorProto(name="drivax.proto", package=_PACKAGE, syntax="proto2")
    for name, fields in _MESSAGES.items():
        _declare(file.message_type.add(name=name), fields)
    pool = import_extra("google.protobuf.descriptor_pool").DescriptorPool()
    pool.Add(file)
    return pool


def _declare(message: Any, fields: tuple[_Field, ...]) -> None:
    """Add fields to the descriptor of a message."""
    if any(kind.endswith("?") for _, _, kind in fields):
        message.oneof_decl.add(name="kind")
    for name, number, kind in fields:
        field = message.field.add(name=name, number=number)
        field.label = field.LABEL_REPEATED if kind.endswith("*") else field.LABEL_OPTIONAL
        if kind.endswith("?"):
            field.oneof_index = 0
        plain = kind.rstrip("*?")
        if plain[0].isupper():
            field.type, field.type_name = field.TYPE_MESSAGE, f".{_PACKAGE}.{plain}"
        else:
            field.type = getattr(field, f"TYPE_{plain.upper()}")


#: Wire types of protocol buffers and what numpy reads there; a bool is a varint of one byte.
_WIRE = {"double": (1, "<f8"), "float": (5, "<f4"), "bool": (0, "u1")}


@dataclass(frozen=True)
class Numbers:
    """A message of numbers: its name, and sets of its fields that occur together, which NumPy reads at once."""

    name: str
    forms: tuple[tuple[str, ...], ...]

    @property
    def fields(self) -> tuple[_Field, ...]:
        """Every field, in the order of columns."""
        return _MESSAGES[self.name]


@cache
def _layouts(numbers: Numbers) -> tuple[np.dtype[Any], ...]:
    """Return packed record types of every form in both orders: each field after its tag of one byte, ``#name``."""
    types = {name: _WIRE[kind][1] for name, _, kind in numbers.fields}
    orders = [order for form in numbers.forms for order in (form, form[::-1])]
    return tuple(
        np.dtype([column for name in order for column in ((f"#{name}", "u1"), (name, types[name]))])
        for order in orders
    )


def read_table(blobs: Sequence[bytes], numbers: Numbers) -> Float64[np.ndarray, "message field"]:
    """Read one row per message, one column per field, 0 for a field that a message lacks.

    Messages of a usual layout are read together, by size and tags; protobuf reads the others.
    """
    out = np.zeros((len(blobs), len(numbers.fields)))
    unread = np.ones(len(blobs), dtype=bool)
    sizes = np.fromiter(map(len, blobs), np.int64, len(blobs))
    for layout in _layouts(numbers):
        rows = np.flatnonzero(unread & (sizes == layout.itemsize))
        if not rows.size:
            continue
        content = blobs if rows.size == len(blobs) else [blobs[row] for row in rows.tolist()]
        records = np.frombuffer(b"".join(content), layout)
        fields = [(i, *field) for i, field in enumerate(numbers.fields) if field[0] in (layout.names or ())]
        fits = np.ones(len(rows), dtype=bool)
        for _, name, number, kind in fields:
            fits &= records[f"#{name}"] == number << 3 | _WIRE[kind][0]
            if kind == "bool":
                fits &= records[name] < 2
        with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
            for column, name, *_ in fields:
                out[rows[fits], column] = records[name][fits]
        unread[rows[fits]] = False
    for row in np.flatnonzero(unread).tolist():
        out[row] = read_one(blobs[row], numbers)
    return out


def read_one(blob: bytes, numbers: Numbers) -> list[float]:
    """Read one row with protobuf."""
    message = parse(numbers.name, blob)
    if message is None:
        raise DataError(f"a message {numbers.name} is damaged", cure=SKIP)
    return [float(getattr(message, name)) for name, _, _ in numbers.fields]


STATES = Numbers(
    "ObjectState", (tuple(name for name, _, _ in _MESSAGES["ObjectState"]), ("center_z", "valid"))
)
POINTS = Numbers("MapPoint", (("x", "y", "z"),))


def features_of(payload: bytes) -> ExampleFeatures:
    """Return the features in a serialised tf.Example."""
    message = parse("Example", payload)
    if message is None or not message.features.feature:
        raise DataError("the payload is not a tf.Example", cure=SKIP)
    return ExampleFeatures(message)


class ExampleFeatures:
    """The features of one tf.Example by name; float lists (float32 in the file) become float64, int64 lists int64."""

    def __init__(self, message: Any) -> None:
        self._values: Mapping[str, Any] = {entry.key: entry.value for entry in message.features.feature}

    def _list(self, name: str) -> tuple[str | None, Sequence[Any]]:
        """Return the kind of list of a feature, and its values."""
        value = self._values.get(name)
        kind = None if value is None else value.WhichOneof("kind")
        return kind, () if kind is None else getattr(value, kind).value

    def has(self, name: str) -> bool:
        """Return whether the feature exists and is not empty."""
        return len(self._list(name)[1]) > 0

    def numbers(self, name: str, shape: tuple[int, ...] | None = None) -> _Array:
        """Return a numeric feature in a shape that its size must match."""
        kind, items = self._list(name)
        if kind not in ("float_list", "int64_list"):
            raise DataError(f"numeric feature {name} is missing", cure=SKIP)
        dtype = np.float64 if kind == "float_list" else np.int64
        with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
            values = np.array(items, dtype)
        if shape is None:
            return values
        count = int(np.prod(shape))
        if values.size != count:
            raise DataError(f"feature {name} has {values.size} values, not {count}", cure=SKIP)
        return values.reshape(shape)

    def integers(self, name: str, shape: tuple[int, ...] | None = None) -> _Array:
        """Return a feature that must be stored as integers: floats would round the ids of lanes."""
        values = self.numbers(name, shape)
        if values.dtype != np.int64:
            raise DataError(f"feature {name} contains floats, not integers", cure=SKIP)
        return values

    def find_flagged(self, name: str, rows: _Array) -> tuple[int, ...]:
        """Return the positions within ``rows`` of the tracks whose feature is 1; none if the file lacks it."""
        if not self.has(name):
            return ()
        values = self.numbers(name, (self.numbers("state/id").size,))[rows]
        return tuple(np.flatnonzero(values == 1).tolist())

    def scenario_id(self, payload: bytes) -> str:
        """Return the scenario's id, or the first 16 digits of the payload's SHA-256 if it has none."""
        value = self._values.get("scenario/id")
        text = "" if value is None else b"".join(value.bytes_list.value[:1]).decode("ascii", "replace")
        return text or hashlib.sha256(payload).hexdigest()[:16]

    def count_unknown(self) -> int:
        """Count features with names that neither the data set nor ScenarioMax uses."""
        return sum(_KNOWN.fullmatch(str(name)) is None for name in self._values)

    def origin(self) -> Float64[np.ndarray, "3"]:
        """Return the origin of the coordinates in the source's map frame; zeros without :data:`ORIGIN`."""
        if ORIGIN not in self._values:
            return np.zeros(3)
        try:
            origin = np.array(b"".join(self._values[ORIGIN].bytes_list.value[:1]).split(), np.float64)
        except ValueError:
            origin = np.zeros(0)
        if origin.shape != (3,) or not (np.abs(origin) < _FARTHEST_M).all():
            raise DataError(f"{ORIGIN} is not a position", cure=SKIP)
        return origin

    @cached_property
    def spans(self) -> dict[str, int]:
        """Steps of past, current and future; 0 for a future without a valid state, as in the test split."""
        tracks = max(self.numbers("state/id").size, 1)
        steps = {}
        for span in ("past", "current", "future"):
            name = f"state/{span}/valid"
            present = self.has(name) and (span != "future" or bool((self.numbers(name) == 1).any()))
            steps[span] = self.numbers(name).size // tracks if present else 0
        if steps["current"] != 1:
            raise DataError(f"state/current has {steps['current']} steps, not 1", cure=SKIP)
        return steps

    def over_time(self, name: str, rows: _Array) -> _Array:
        """Return ``state/{past,current,future}/<name>`` of some rows over all steps, ``[track, time]``."""
        count = self.numbers("state/id").size
        spans = [(span, steps) for span, steps in self.spans.items() if steps]
        return np.concatenate(
            [self.numbers(f"state/{span}/{name}", (count, steps))[rows] for span, steps in spans], axis=1
        )
