"""JSON tables that are too large to hold: an array of objects, read one object at a time."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from drivax.errors import DataError

_CHUNK = 1 << 20
#: No row of a table is longer; a longer one is damage.
_LONGEST = 1 << 24
_BETWEEN = re.compile(r"[ \t\r\n,]*")


def rows(path: Path) -> Iterator[dict[str, Any]]:
    """The objects of a file that holds one array of objects.

    Args:
        path: The file; it is never held in memory as a whole.

    Raises:
        DataError: The file is missing or empty, is no such array, or ends early.
    """
    decoder = json.JSONDecoder()
    number = 0
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_CHUNK).lstrip()
            if not text.startswith("["):
                raise DataError("is not a table (an array of objects)", file=path, cure="download it again")
            place = 1
            while True:
                # Only places move: cutting the text after every row would copy a chunk thousands of times.
                between = _BETWEEN.match(text, place)
                place = place if between is None else between.end()
                if text.startswith("]", place):
                    return
                try:
                    row, end = decoder.raw_decode(text, place)
                except ValueError:
                    more = file.read(_CHUNK)
                    if not more or len(text) - place > _LONGEST:
                        raise
                    text, place = text[place:] + more, 0
                    continue
                if not isinstance(row, dict):
                    raise DataError("is no object", file=path, record=number, cure="download it again")
                yield row
                place, number = end, number + 1
    except FileNotFoundError as error:
        raise DataError("is missing", file=path, cure="unpack the metadata archive again") from error
    except (ValueError, RecursionError) as error:
        problem = f"is damaged after {number} rows ({error})"
        raise DataError(problem, file=path, cure="unpack the metadata archive again") from error
