"""Many small protobuf messages of numbers read as one table.

A 9 s scenario holds some 10,000 states and 20,000 points. Written as WOMD writes them, all fields in the order of
their numbers (or, by other writers, in reverse), they are records of fixed size, which numpy reads at once; the tags
of every record are compared, and whatever differs is left to protobuf.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float64

from drivax.datasets.womd.messages import MESSAGES, parse, scenario_class
from drivax.errors import DataError

_Array = np.ndarray[Any, Any]
#: Wire types of protocol buffers and what numpy reads there; a bool is a varint of one byte.
_WIRE = {"double": (1, "<f8"), "float": (5, "<f4"), "bool": (0, "u1")}


@dataclass(frozen=True)
class Numbers:
    """A message of numbers.

    Attributes:
        name: Its name.
        fields: Name, number and type (``double``, ``float``, ``bool``) of every field, in the order of columns.
        forms: Which fields (by column) may be there together and are read fast, in order of their numbers.
    """

    name: str
    fields: tuple[tuple[str, int, str], ...]
    forms: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, name: str, forms: Sequence[Sequence[str]]) -> Numbers:
        """The message of this name, with forms by the names of their fields."""
        fields = MESSAGES[name]
        columns = {field: column for column, (field, _, _) in enumerate(fields)}
        return cls(name, fields, tuple(tuple(columns[field] for field in form) for form in forms))


@cache
def _layouts(numbers: Numbers) -> tuple[tuple[np.dtype[Any], tuple[int, ...]], ...]:
    """Packed record types of every form in both orders, with its columns."""
    found = []
    for form in numbers.forms:
        for order in (form, form[::-1]):
            parts = []
            for column in order:
                _, number, kind = numbers.fields[column]
                parts += [(f"tag{column}", "u1"), (str(column), _WIRE[kind][1])]
                assert number << 3 | _WIRE[kind][0] < 128, "a tag of one byte"
            found.append((np.dtype(parts), order))
    return tuple(found)


def read_table(blobs: Sequence[bytes], numbers: Numbers) -> Float64[np.ndarray, "message field"]:
    """One row per message, one column per field, 0 where a field is not there.

    Raises:
        DataError: One of them is damaged.
    """
    out = np.zeros((len(blobs), len(numbers.fields)))
    todo = np.ones(len(blobs), dtype=bool)
    sizes = np.fromiter(map(len, blobs), np.int64, len(blobs))
    for layout, columns in _layouts(numbers):
        rows = np.flatnonzero(todo & (sizes == layout.itemsize))
        if not rows.size:
            continue
        whole = rows.size == len(blobs)
        records = np.frombuffer(b"".join(blobs if whole else [blobs[row] for row in rows.tolist()]), layout)
        same = np.ones(len(rows), dtype=bool)
        for column in columns:
            _, number, kind = numbers.fields[column]
            same &= records[f"tag{column}"] == number << 3 | _WIRE[kind][0]
            if kind == "bool":
                same &= records[str(column)] < 2
        with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
            for column in columns:
                out[rows[same], column] = records[str(column)][same]
        todo[rows[same]] = False
    for row in np.flatnonzero(todo).tolist():
        out[row] = read_one(blobs[row], numbers)
    return out


def read_one(blob: bytes, numbers: Numbers) -> list[float]:
    """One row as protobuf reads it.

    Raises:
        DataError: The message is damaged.
    """
    message = parse(scenario_class(numbers.name), blob)
    if message is None:
        raise DataError(
            f"a message {numbers.name} is damaged", cure="skip this record, or download the file again"
        )
    return [float(getattr(message, name)) for name, _, _ in numbers.fields]


STATES = Numbers.of("ObjectState", [[name for name, _, _ in MESSAGES["ObjectState"]], ["center_z", "valid"]])
POINTS = Numbers.of("MapPoint", ["xyz"])
