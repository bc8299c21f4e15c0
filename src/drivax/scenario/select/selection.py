"""Selections of scenarios by filters on the manifest, by name, and by number.

A filter is ``NAME=VALUE`` or ``NAME!=VALUE``, with alternatives ``VALUE|VALUE``, or a comparison with a number (``<``,
``<=``, ``>``, ``>=``). A selected scenario satisfies all filters. An unknown value satisfies no filter, neither ``=``
nor ``!=``; :meth:`Selection.unknown` counts such scenarios.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from drivax.errors import DataError, DrivaxError, UsageError, did_you_mean
from drivax.reading import read_text
from drivax.scenario.schema import Flag
from drivax.scenario.select.tags import TAGS
from drivax.seal import check_seal

#: Largest number of missing names in an error message.
_MOST_NAMES = 3
#: Largest number of lines in a file of names; each takes 200 bytes of memory.
_MOST_LINES = 4_000_000
_NAME_FILE = "give a file with one scenario id per line"
_Kind = Literal["number", "truth", "word"]
#: Counters of overflow; zeros are not stored.
OVERFLOWS = (
    "agents", "parked", "segments", "edge_run", "lane_run", "features", "lanes", "lane_links", "lights",
    "lights_without_lane", "stops", "stop_lanes", "road_rows", "events", "event_actors",
)  # fmt: skip
_NAMES = ("dataset", "segment", "scenario_id")
#: Tags that take any words of the source; several words are joined by ``|``.
_OPEN_TAGS = ("place", "location", "scenario_types", "source_format", "domain", "family", "event")
_MAP_FEATURES = ("lane", "road_line", "road_edge", "crosswalk", "speed_bump", "stop_sign", "driveway")
#: Path of each count in a manifest entry: counts of the source before capping, and stored segments.
_COUNTS: Mapping[str, tuple[str, ...]] = {
    "agents": ("source", "tracks_valid_now"),
    **{name: ("source", name) for name in ("steps", "tracks", "tracks_valid_now", "map_points", "lights")},
    **{f"map_features.{name}": ("source", "map_features", name) for name in _MAP_FEATURES},
    "segments": ("segments",),
}
_FILTER = re.compile(r"\s*([A-Za-z_][\w.]*)\s*(>=|<=|!=|=|>|<)\s*(.*?)\s*", re.DOTALL)
_COMPARISONS: Mapping[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
}  # fmt: skip
_TRUTHS = {"true": True, "false": False}


@dataclass(frozen=True)
class Quantity:
    """A quantity that filters compare; ``words`` lists the possible words, empty for any."""

    kind: _Kind
    meaning: str
    words: tuple[str, ...] = ()


_EXCEEDS = "share of steps at which following the log exceeds the limits of"
#: Findings of the audit (``evaluation.audit``); filters write ``audit.NAME``.
FINDINGS: Mapping[str, Quantity] = {
    "log_collides": Quantity("truth", "the logged ego overlaps an agent that it did not overlap at first"),
    "first_collision_step": Quantity(
        "number", "step at which the first such overlap (`log_collides`) begins"
    ),
    "log_offroad_fraction": Quantity("number", "share of the evaluated steps with a corner off the road"),
    "first_offroad_step": Quantity("number", "first evaluated step with a corner off the road"),
    "first_onroad_step": Quantity("number", "first step, from the current one on, that is on the road"),
    "log_left_map": Quantity("truth", "the log leaves the mapped area"),
    "log_runs_red": Quantity("truth", "the log runs a red light"),
    "distance_m": Quantity("number", "distance that the log drives after the current step"),
    "reverse_m": Quantity("number", "distance that the log drives backwards after the current step"),
    "log_reverses": Quantity(
        "truth", "`reverse_m` exceeds 20 m, or 5 m and 90 % of the distance: its headings are wrong by pi"
    ),
    "agents_reversing": Quantity("number", "other vehicles and cyclists that reverse as in `log_reverses`"),
    "route_deviation_mean_m": Quantity("number", "mean distance of the log to the route"),
    "route_deviation_max_m": Quantity("number", "largest distance of the log to the route"),
    "route_reaches_goal": Quantity("truth", "the route passes within 3 m of where the log ends"),
    "lights_seen": Quantity("number", "lights with an observed state"),
    "ignored_overlaps": Quantity(
        "number", "most agents at a step that have overlapped ego since they appeared"
    ),
    "clipped_physical": Quantity("number", f"{_EXCEEDS} `physical` and `discrete`"),
    "clipped_published": Quantity("number", f"{_EXCEEDS} `published`"),
    "default_sizes": Quantity("truth", "some box has a default length, width or height"),
    "velocity": Quantity("word", "where velocities come from", ("measured", "differentiated")),
    "dt_jitter": Quantity("truth", "some step differs from the median step by more than 2 ms"),
    "clean": Quantity("truth", "no collision, never off the road, no red light run, not `log_reverses`"),
}


def tag_words(entry: Mapping[str, Any], name: str) -> frozenset[str]:
    """Return the words of a tag: one, none, or several (``scenario_types``)."""
    return frozenset(entry["tags"].get(name, "").split("|")) - {""}


def vocabulary() -> dict[str, Quantity]:
    """Return all quantities of filters by name, except user tags (``tag.NAME``)."""
    known = {name: Quantity("word", "") for name in (*_NAMES, *_OPEN_TAGS)}
    known |= {name: Quantity("word", "", words) for name, words in TAGS.items()}
    # Where a tag has the name of a count (lights), a number compares the count and a word the tag.
    known |= {name: Quantity("number", "", TAGS.get(name, ())) for name in _COUNTS}
    known |= {f"overflow.{name}": Quantity("number", "") for name in OVERFLOWS}
    known |= {f"audit.{name}": finding for name, finding in FINDINGS.items()}
    known["flag"] = Quantity("word", "", tuple(str(flag.name) for flag in Flag if flag))
    return known


@dataclass(frozen=True)
class Filter:
    """One condition on a quantity: ``text`` as written by the user, and its parts.

    ``values`` are alternatives (words, numbers or Booleans); a comparison has one number.
    """

    text: str
    name: str
    operator: str
    values: tuple[str | float | bool, ...]

    @classmethod
    def parse(cls, text: str) -> Filter:
        """Parse ``NAME=VALUE|VALUE``, ``NAME!=VALUE`` or a comparison."""
        match = _FILTER.fullmatch(text)
        if match is None or match[3].startswith("="):
            raise _filter_error(text, "is not a filter", "write NAME=VALUE, NAME!=VALUE or NAME>=NUMBER")
        name, sign, words = match[1], match[2], tuple(word.strip() for word in match[3].split("|"))
        quantity = _find_quantity(text, name)
        if not all(words):
            raise _filter_error(text, "names no value", "write NAME=VALUE or NAME=VALUE|VALUE")
        if sign in _COMPARISONS and quantity.kind != "number":
            raise _filter_error(text, f"{name} cannot be compared by {sign}", "use = or !=")
        if sign in _COMPARISONS and len(words) > 1:
            raise _filter_error(text, f"a list cannot be compared by {sign}", f"give one number after {sign}")
        if name == "flag":
            words = tuple(word.upper() for word in words)
        values = tuple(_value(text, name, quantity, word) for word in words)
        if len({isinstance(value, str) for value in values}) > 1:
            raise _filter_error(text, "mixes words and numbers", "write two filters or ask for one of them")
        if sign in _COMPARISONS and isinstance(values[0], str):
            raise _filter_error(text, f"{values[0]!r} is not a number", f"give a number after {sign}")
        return cls(text, name, sign, values)

    def matches(self, entry: Mapping[str, Any]) -> bool:
        """Return whether a manifest entry satisfies the filter; false for unknown values."""
        value = self.find(entry)
        if value is None:
            return False
        if self.operator in _COMPARISONS:
            return _COMPARISONS[self.operator](value, self.values[0])
        values = value if isinstance(value, frozenset) else {value}
        is_match = not values.isdisjoint(self.values)
        return is_match if self.operator == "=" else not is_match

    def find(self, entry: Mapping[str, Any]) -> Any:
        """Return the value in a manifest entry: a number, a word, a Boolean or a set of words; None if unknown."""
        group, _, name = self.name.partition(".")
        if group == "flag":
            return frozenset(entry["flags"])
        if group == "audit":
            return entry["audit"].get(name)
        if group == "overflow":
            return entry["overflow"].get(name, 0)
        if group in _NAMES:
            return entry[group]
        if self.name in _COUNTS and not isinstance(self.values[0], str):
            return functools.reduce(lambda value, key: value.get(key, 0), _COUNTS[self.name], entry)
        return tag_words(entry, self.name.removeprefix("tag.")) or None


@dataclass(frozen=True)
class Selection:
    """Filters that must all hold; without filters every scenario is selected."""

    filters: tuple[Filter, ...] = ()

    @classmethod
    def parse(cls, filters: Sequence[str]) -> Selection:
        """Parse filters such as ``type=turn_left|turn_right`` or ``audit.distance_m>5``."""
        _refuse_text(filters, "filters")
        return cls(tuple(Filter.parse(text) for text in filters))

    def matches(self, entry: Mapping[str, Any]) -> bool:
        """Return whether a scenario is selected, by its manifest entry."""
        return all(condition.matches(entry) for condition in self.filters)

    def rows(self, entries: Iterable[Mapping[str, Any]]) -> list[int]:
        """Return the indices of the selected scenarios, in order."""
        return [row for row, entry in enumerate(entries) if self.matches(entry)]

    def unknown(self, entries: Iterable[Mapping[str, Any]]) -> dict[str, int]:
        """Return the nonzero numbers of scenarios without the value of a filter, by filter."""
        all_entries = list(entries)
        counts = {
            condition.text: sum(condition.find(entry) is None for entry in all_entries)
            for condition in self.filters
        }
        return {text: count for text, count in counts.items() if count}


@runtime_checkable
class Listing(Protocol):
    """The part of a scenario set that selections read."""

    @property
    def path(self) -> Path:
        """Folder of the set."""
        ...

    @property
    def entries(self) -> Sequence[Mapping[str, Any]]:
        """Manifest entries."""
        ...


@dataclass(frozen=True)
class _Name:
    """A scenario id, or data set, tab and id, with its place in a file."""

    text: str
    file: Path | None = None
    line: int = 0

    @property
    def label(self) -> str:
        """The id for messages, after its data set if one was given."""
        return repr(self.text.replace("\t", " / "))


def select_scenarios(
    data: Listing, filters: Sequence[str] = (), names: Sequence[str | Path] = (), limit: int | None = None
) -> list[int]:
    """Return the indices of the first ``limit`` scenarios that meet all filters, in order of the set.

    ``names`` are ids, or data set, tab and id, or paths of files with one name per line; empty selects all.

    Raises:
        DataError: A name is not in the set, a file cannot be read, or no scenario is selected.
        UsageError: A filter or the limit is invalid.
    """
    if limit is not None and limit < 1:
        raise UsageError(f"--limit {limit} leaves no scenario", cure="use 1 or more")
    selection = Selection.parse(filters)
    _refuse_text(names, "scenario names")
    by_name = _rows_by_name(data, names) if names else None
    rows = [row for row in selection.rows(data.entries) if by_name is None or row in by_name]
    if not rows:
        raise _empty_error(data, selection)
    return rows[:limit]


def read_names(file: Path) -> list[_Name]:
    """Read names from a text file, one per line; empty lines are skipped.

    Raises:
        DataError: The file was changed, is not text, or has too many lines.
    """
    check_seal(file)
    content = read_text(file, _NAME_FILE)
    if content.count("\n") > _MOST_LINES:
        raise DataError(f"has more than {_MOST_LINES:,} lines", file=file, cure=_NAME_FILE)
    # Not splitlines(): ids may contain other line breaks of Unicode.
    lines = content.split("\n")
    return [_Name(text, file, number) for number, line in enumerate(lines, start=1) if (text := line.strip())]


def _rows_by_name(data: Listing, names: Sequence[str | Path]) -> set[int]:
    """Return the indices of named scenarios (an id alone: in all data sets); unknown names may be paths of files."""
    rows: dict[str, set[int]] = {}
    for row, entry in enumerate(data.entries):
        for text in (entry["scenario_id"], f"{entry['dataset']}\t{entry['scenario_id']}"):
            rows.setdefault(text, set()).add(row)
    requests: list[_Name] = []
    for name in names:
        is_id = isinstance(name, str) and (name in rows or not _exists(name))
        requests += [_Name(str(name))] if is_id else read_names(Path(name))
    missing = [name for name in requests if name.text not in rows]
    if missing:
        raise _missing_error(data, missing)
    return set[int]().union(*(rows[name.text] for name in requests))


def _exists(path: str) -> bool:
    try:
        return Path(path).exists()
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:  # an id may be longer than any path
            return False
        raise


def _missing_error(data: Listing, missing: Sequence[_Name]) -> DataError:
    """Return the error for one or more names that are not in the set; it lists the first three."""
    first, others = missing[0], missing[1:]
    scenario_id = first.text.rpartition("\t")[2]
    datasets = sorted(
        {str(entry["dataset"]) for entry in data.entries if entry["scenario_id"] == scenario_id}
    )
    cure = "use ids that drivax inspect --json lists"
    if datasets and not others:
        cure = f"the set has this id in data set {', '.join(datasets)}"
    elif not others:
        ids = (str(entry["scenario_id"]) for entry in data.entries)
        cure = did_you_mean(scenario_id, ids, otherwise=cure)
    more = "".join(f", {name.label}" for name in others[: _MOST_NAMES - 1])
    more += f" and {len(others) - _MOST_NAMES + 1} more" if len(others) >= _MOST_NAMES else ""
    which = "are" if others else "is"
    if first.file is None:
        return DataError(f"{first.label}{more} {which} not in the set", file=data.path, cure=cure)
    problem = f"{first.label} (line {first.line}){more} {which} not in the set {data.path}"
    return DataError(problem, file=first.file, cure=cure)


def _empty_error(data: Listing, selection: Selection) -> DrivaxError:
    """Return the error for an empty selection; it names the first ``=`` filter that no scenario satisfies, if any."""
    for condition in selection.filters:
        if condition.operator == "=" and not any(condition.matches(entry) for entry in data.entries):
            tag, has_word = condition.name.removeprefix("tag."), isinstance(condition.values[0], str)
            words = {word for entry in data.entries for word in tag_words(entry, tag) if has_word}
            cure = did_you_mean(str(condition.values[0]), sorted(words)) if words else "drop this filter"
            return DataError(f"no scenario is selected by {condition.text!r}", file=data.path, cure=cure)
    return DataError("no scenario is selected", file=data.path, cure="use fewer filters or other names")


def _find_quantity(text: str, name: str) -> Quantity:
    """Return the quantity that the filter ``text`` names."""
    if name.startswith("tag.") and len(name) > len("tag."):
        return Quantity("word", "a user's tag")
    known = vocabulary()
    if name in known:
        return known[name]
    # Match names without their group too: log_collides suggests audit.log_collides.
    by_end = {full.rpartition(".")[2]: full for full in known}
    otherwise = f"write tag.{name} for a tag of your own"
    cure = did_you_mean(name, known, otherwise=otherwise, aliases=by_end, cutoff=0.7)
    raise _filter_error(text, f"unknown quantity {name!r}", cure)


def _value(text: str, name: str, quantity: Quantity, word: str) -> str | float | bool:
    """Parse a word of a filter as a value of its quantity."""
    if quantity.kind == "truth":
        if word.lower() not in _TRUTHS:
            raise _filter_error(
                text, f"{word!r} is neither true nor false", f"write {name}=true or {name}=false"
            )
        return _TRUTHS[word.lower()]
    if quantity.kind == "number":
        with contextlib.suppress(ValueError):
            if math.isfinite(number := float(word)):
                return number
        if word not in quantity.words:
            raise _filter_error(text, f"{word!r} is not a number", f"write, for example, {name}>=10")
    if quantity.words and word not in quantity.words:
        raise _filter_error(text, f"{name} is never {word!r}", did_you_mean(word, quantity.words))
    return word


def _refuse_text(items: Sequence[Any], what: str) -> None:
    if isinstance(items, str):
        raise UsageError(f"{what} are the text {items!r}", cure=f"give a list: [{items!r}]")


def _filter_error(text: str, problem: str, cure: str) -> UsageError:
    return UsageError(f"filter {text!r}: {problem}", cure=cure)
