"""Values of ScenarioNet dictionaries, checked: nothing in a file is of the type that it should be until it was seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drivax.errors import DataError

Array = np.ndarray[Any, Any]

SKIP = "skip this file, or generate it again"
#: Numbers in one value, and in all values of one kind of one file.
MOST_NUMBERS = 4_000_000
_NUMBER = (int, float)


def mapping(parent: Any, name: str, what: str = "the file") -> Mapping[Any, Any]:
    """The dictionary under a name."""
    value = parent.get(name) if isinstance(parent, dict) else None
    if not isinstance(value, dict):
        raise DataError(f"{what} has no dictionary {name!r}", cure=SKIP)
    return value


def text(value: Any) -> str | None:
    """A text that can be written as UTF-8, also of a number; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, str | int):
        return None
    try:
        written = str(value)
        written.encode()
    except ValueError:  # a lone surrogate, or an integer of thousands of digits
        return None
    return written


def whole(value: Any) -> int | None:
    """A whole number, also as text; None for anything else."""
    written = text(value)
    return int(written) if written and written.isascii() and written.isdigit() and len(written) < 19 else None


def number(value: Any) -> float | None:
    """A finite number; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, _NUMBER) or abs(value) > 1e15 or value != value:
        return None
    return float(value)


def items(value: Any) -> Sequence[Any]:
    """The items of a list, tuple or one-dimensional array; none for anything else."""
    if isinstance(value, np.ndarray):
        return value.tolist() if value.ndim == 1 else []
    return list(value) if isinstance(value, list | tuple | set) else []


def count_rows(value: Any) -> int:
    """How many rows a value has, without looking into them."""
    return (
        len(value) if isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim) else 0
    )


def extent(value: Any) -> int:
    """How much work a value is: the numbers of an array, the items of a list; one value may stand in many places."""
    return value.size if isinstance(value, np.ndarray) else count_rows(value)


def floats(value: Any, what: str) -> Array:
    """Numbers or rows of up to three numbers as float64; the file may hold arrays, lists or tuples."""
    if isinstance(value, np.ndarray):
        narrow = value.ndim == 1 or (value.ndim == 2 and value.shape[1] <= 3)
        if value.dtype.kind in "biuf" and narrow and len(value) <= MOST_NUMBERS:
            with np.errstate(invalid="ignore"):  # damaged numbers may be signalling NaNs
                return value.astype(np.float64)
    elif isinstance(value, list | tuple) and len(value) <= MOST_NUMBERS:
        try:
            return np.array([_row(row) for row in value], dtype=np.float64)
        except (ValueError, OverflowError, TypeError) as error:
            raise DataError(f"{what} are not rows of numbers", cure=SKIP) from error
    raise DataError(f"{what} are not numbers", cure=SKIP)


def _row(row: Any) -> Any:
    if isinstance(row, _NUMBER):
        return row
    if isinstance(row, np.ndarray) and row.dtype.kind in "biuf" and row.size <= 3:
        return row
    if isinstance(row, list | tuple) and len(row) <= 3 and all(isinstance(part, _NUMBER) for part in row):
        return row
    raise ValueError("no row of numbers")


class Names:
    """Dense integers for the names of one file: its own where all are whole numbers, else their order in the file.

    Never a hash and never a shortened name: two names never share a number.

    Args:
        names: All names, as texts.
        bits: Own numbers must be below two to the power of this.
    """

    def __init__(self, names: Sequence[str], bits: int) -> None:
        own = [whole(name) for name in names]
        kept = [number for number in own if number is not None and number < 1 << bits]
        numbers = kept if len(kept) == len(names) and len(set(kept)) == len(kept) else range(len(names))
        self._numbers = dict(zip(names, numbers, strict=True))

    def get(self, value: Any) -> int | None:
        """The number of a name; None where the file has no such name."""
        name = text(value)
        return None if name is None else self._numbers.get(name)
