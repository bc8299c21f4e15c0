"""Text from files made inert: cells that a spreadsheet would compute, and characters that a terminal would obey."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

#: What begins a formula in spreadsheets, in full width, too, and blanks before it, which some remove.
_BEGIN, _BLANKS = r"[=+\-@\uff1d\uff0b\uff0d\uff20]", r"[ \xa0]*"
#: Begins a formula, or hides the character that does; numbers are safe.
_FORMULA = rf"(?=[\t\r\n]|{_BLANKS}{_BEGIN})(?![+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?\Z)"
#: Where a spreadsheet may begin a cell: at the beginning, and after what separates cells in some country or program.
_AFTER, _SEPARATED = r"(?<=[;,|\t\r\n])", rf"[\" \xa0]*{_BEGIN}"
_ACTIVE = rf"\A(?='*{_FORMULA})|{_AFTER}(?='*{_SEPARATED})"
_NEUTRAL = rf"\A'(?='*{_FORMULA})|{_AFTER}'(?='*{_SEPARATED})"
_QUOTED = re.compile(r'[,"\r\n]')
#: Controls (C0, DEL, C1), marks and overrides of direction, line separators, and undecodable bytes of file names.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def escape_controls(text: Any) -> str:
    r"""Return text for a terminal: control characters as ``\x1b``, ``\n`` or ``\u202e``."""
    return _CONTROL.sub(lambda match: match[0].encode("unicode_escape").decode(), str(text))


def show(text: object = "", file: Any = None) -> None:
    """Print lines with :func:`escape_controls`, and flush."""
    print("\n".join(map(escape_controls, str(text).split("\n"))), file=file, flush=True)


def csv_text(rows: Iterable[Sequence[Any]]) -> str:
    """Return rows as CSV; an apostrophe precedes each text that a spreadsheet would compute (:func:`csv_rows`).

    This includes text after a separator in a cell, such as ``;=1``: some spreadsheets begin a cell there.
    """
    active = re.compile(_ACTIVE)  # not at import: most commands write no CSV
    return "".join(",".join(_csv_cell(str(cell), active) for cell in row) + "\n" for row in rows)


def csv_rows(lines: Iterable[str]) -> Iterator[list[str]]:
    """Yield the rows of :func:`csv_text` from its lines, with the cells as they were."""
    neutral = re.compile(_NEUTRAL)
    for row in csv.reader(lines):
        yield [neutral.sub("", cell) if "'" in cell else cell for cell in row]


def _csv_cell(cell: str, active: re.Pattern[str]) -> str:
    cell = active.sub("'", cell)
    return '"' + cell.replace('"', '""') + '"' if _QUOTED.search(cell) else cell
