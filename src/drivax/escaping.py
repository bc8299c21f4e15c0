"""Escape text from files: CSV cells that a spreadsheet would run as formulas, and control characters of terminals."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

#: Characters that begin a formula, full-width ones included, and blanks before them, which some spreadsheets strip.
_BEGIN, _BLANKS = r"[=+\-@\uff1d\uff0b\uff0d\uff20]", r"[ \xa0]*"
#: Matches before a formula, or before a tab or line break that may hide one, but not before a number.
_FORMULA = rf"(?=[\t\r\n]|{_BLANKS}{_BEGIN})(?![+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?\Z)"
#: A separator of cells in some locale or program, and the beginning of a formula after it.
_AFTER, _SEPARATED = r"(?<=[;,|\t\r\n])", rf"[\" \xa0]*{_BEGIN}"
#: Where :func:`csv_text` inserts apostrophes, and the inserted apostrophes.
_ACTIVE = rf"\A(?='*{_FORMULA})|{_AFTER}(?='*{_SEPARATED})"
_NEUTRAL = rf"\A'(?='*{_FORMULA})|{_AFTER}'(?='*{_SEPARATED})"
_QUOTED = re.compile(r'[,"\r\n]')
#: Controls (C0, DEL, C1), marks and overrides of direction, line separators, and undecodable bytes of file names.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def escape_controls(text: Any) -> str:
    r"""Return text for a terminal: control characters as ``\x1b``, ``\n`` or ``\u202e``."""
    return _CONTROL.sub(lambda match: match[0].encode("unicode_escape").decode(), str(text))


def show(text: object = "", file: Any = None) -> None:
    """Print lines of text, each escaped by :func:`escape_controls`, and flush."""
    print("\n".join(map(escape_controls, str(text).split("\n"))), file=file, flush=True)


def csv_text(rows: Iterable[Sequence[Any]]) -> str:
    """Return rows as CSV; an apostrophe precedes text that a spreadsheet would run as a formula (:func:`csv_rows`).

    This includes text after a separator in a cell, such as ``;=1``: some spreadsheets begin a cell there.
    """
    active = re.compile(_ACTIVE)  # not at import: most commands write no CSV
    return "".join(",".join(_csv_cell(str(cell), active) for cell in row) + "\n" for row in rows)


def csv_rows(lines: Iterable[str]) -> Iterator[list[str]]:
    """Parse lines of CSV, and remove the apostrophes that :func:`csv_text` added."""
    neutral = re.compile(_NEUTRAL)
    for row in csv.reader(lines):
        yield [neutral.sub("", cell) if "'" in cell else cell for cell in row]


def _csv_cell(cell: str, active: re.Pattern[str]) -> str:
    cell = active.sub("'", cell)
    return '"' + cell.replace('"', '""') + '"' if _QUOTED.search(cell) else cell
