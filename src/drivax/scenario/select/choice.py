"""Which scenarios of a set are meant: those that satisfy all filters and are named, the first so many of them."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from drivax.errors import DataError, DrivaxError, UsageError, did_you_mean
from drivax.scenario.select.filters import Selection, tag_words

#: So many names that are not in a set are told; how many others there are follows.
_TOLD = 3


@runtime_checkable
class Listing(Protocol):
    """A scenario set, as far as its manifest tells."""

    @property
    def path(self) -> Path:
        """The folder."""
        ...

    @property
    def entries(self) -> Sequence[Mapping[str, Any]]:
        """What the manifest says of each scenario."""
        ...


@dataclass(frozen=True)
class _Name:
    """A scenario's id, or data set, tabulator and id; and where it was read, if in a file."""

    text: str
    file: Path | None = None
    line: int = 0

    @property
    def shown(self) -> str:
        """The id, as messages tell it."""
        return repr(self.text.rpartition("\t")[2])


def chosen(
    data: Listing, filters: Sequence[str] = (), names: Sequence[str | Path] = (), limit: int | None = None
) -> list[int]:
    """Rows of the scenarios that are meant, in order of the set.

    Args:
        data: The set.
        filters: Conditions that all must hold (``scenario.select.filters``).
        names: Ids of scenarios, or data set, tabulator and id; a path, or a word that is no id but an existing file, is
            read: one name per line. Nothing named means all.
        limit: At most so many, the first that filters and names leave.

    Raises:
        DataError: A name is not in the set, a file cannot be read, or nothing is left.
        UsageError: A filter or the limit cannot be meant.
    """
    if limit is not None and limit < 1:
        raise UsageError(f"--limit {limit} leaves no scenario", cure="use 1 or more")
    selection = Selection.parse(filters)
    wanted = _rows(data, names) if names else None
    rows = [row for row in selection.rows(data.entries) if wanted is None or row in wanted]
    if not rows:
        raise _nothing_left(data, selection)
    return rows[:limit]


def read_names(file: Path) -> list[_Name]:
    """The names in a file, one per line; empty lines are skipped.

    Raises:
        DataError: It cannot be read, or is no text.
    """
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise DataError(error.strerror or "cannot be read", file=file, cure="check the path") from error
    except UnicodeDecodeError as error:
        raise DataError("is no text", file=file, cure="give one scenario id per line") from error
    return [_Name(text, file, row) for row, line in enumerate(lines, start=1) if (text := line.strip())]


def _rows(data: Listing, names: Sequence[str | Path]) -> set[int]:
    """Rows that are named; an id without a data set names it in all of them."""
    rows: dict[str, set[int]] = {}
    for row, entry in enumerate(data.entries):
        for text in (entry["scenario_id"], f"{entry['dataset']}\t{entry['scenario_id']}"):
            rows.setdefault(text, set()).add(row)
    wanted: list[_Name] = []
    for name in names:
        is_id = isinstance(name, str) and (name in rows or not Path(name).exists())
        wanted += [_Name(str(name))] if is_id else read_names(Path(name))
    missing = [name for name in wanted if name.text not in rows]
    if missing:
        raise _missing(data, missing)
    return set[int]().union(*(rows[name.text] for name in wanted))


def _missing(data: Listing, missing: Sequence[_Name]) -> DataError:
    first, others = missing[0], missing[1:]
    ids = [str(entry["scenario_id"]) for entry in data.entries]
    near = difflib.get_close_matches(first.text.rpartition("\t")[2], ids, n=1)
    cure = f"did you mean {near[0]!r}?" if near and not others else "use ids that drivax inspect --json lists"
    more = "".join(f", {name.shown}" for name in others[: _TOLD - 1])
    more += f" and {len(others) - _TOLD + 1} more" if len(others) >= _TOLD else ""
    which = "are" if others else "is"
    if first.file is None:
        return DataError(f"{first.shown}{more} {which} not in the set", file=data.path, cure=cure)
    problem = f"line {first.line} names {first.shown}{more}, which {which} not in the set {data.path}"
    return DataError(problem, file=first.file, cure=cure)


def _nothing_left(data: Listing, selection: Selection) -> DrivaxError:
    """Says which word no scenario has, where that is why."""
    for one in selection.filters:
        if one.operator == "=" and not any(one.matches(entry) for entry in data.entries):
            words = {
                word for entry in data.entries for word in tag_words(entry, one.name.removeprefix("tag."))
            }
            cure = did_you_mean(str(one.values[0]), sorted(words)) if words else "loosen it"
            return DataError(f"no scenario is selected by {one.text!r}", file=data.path, cure=cure)
    return DataError("no scenario is selected", file=data.path, cure="loosen the filters, or name others")
