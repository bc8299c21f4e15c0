"""Which scenarios of a set are meant: filters over what the manifest says about each.

A filter is ``NAME=VALUE`` or ``NAME!=VALUE``, with alternatives ``VALUE|VALUE``, or a comparison with a number
(``<``, ``<=``, ``>``, ``>=``). A scenario is selected when every filter holds. What a scenario does not know about
itself satisfies no filter, neither ``=`` nor ``!=``; :meth:`Selection.unknown` counts such scenarios.
"""

from __future__ import annotations

import difflib
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from drivax.errors import DataError, DrivaxError, UsageError, did_you_mean
from drivax.scenario.schema import Flag
from drivax.scenario.select.tags import TAGS

#: So many names that are not in a set are told; how many others there are follows.
_TOLD = 3
_Kind = Literal["number", "truth", "word"]
#: What can overflow; what did not is not stored and counts as 0.
OVERFLOWS = (
    "agents", "parked", "segments", "edge_run", "lane_run", "features", "lanes", "lane_links", "lights",
    "lights_without_lane", "stops", "stop_lanes", "road_rows", "events", "event_actors",
)  # fmt: skip
_NAMES = ("dataset", "segment", "scenario_id")
#: Tags whose values are the sources' own words; several words are joined by ``|``.
_OPEN_TAGS = ("place", "location", "scenario_types", "source_format", "domain", "family", "event")
_MAP_FEATURES = ("lane", "road_line", "road_edge", "crosswalk", "speed_bump", "stop_sign", "driveway")
#: Counts of the source before capping, by their path in a manifest entry.
_COUNTS: Mapping[str, tuple[str, ...]] = {
    "agents": ("source", "tracks_valid_now"),
    **{name: ("source", name) for name in ("steps", "tracks", "tracks_valid_now", "map_points", "lights")},
    **{f"map_features.{name}": ("source", "map_features", name) for name in _MAP_FEATURES},
    "segments": ("segments",),
}
_FILTER = re.compile(r"\s*([A-Za-z_][\w.]*)\s*(>=|<=|!=|=|>|<)\s*(.*?)\s*", re.DOTALL)
_COMPARED: Mapping[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_TRUTHS = {"true": True, "false": False}


@dataclass(frozen=True)
class Quantity:
    """Something that a filter can ask for.

    Attributes:
        kind: A number, a truth (``true`` or ``false``) or a word.
        meaning: One line for people.
        words: The words that it can be; empty where any can.
    """

    kind: _Kind
    meaning: str
    words: tuple[str, ...] = ()


#: What the audit finds in a scenario (``evaluation.audit``); filters put ``audit.`` before the name.
FINDINGS: Mapping[str, Quantity] = {
    "log_collides": Quantity("truth", "the logged ego overlaps an agent that it did not overlap at first"),
    "first_collision_step": Quantity("number", "step at which that overlap begins"),
    "log_offroad_fraction": Quantity("number", "share of the judged steps with a corner off the road"),
    "first_offroad_step": Quantity("number", "first such step"),
    "first_onroad_step": Quantity("number", "first step, from the current one on, that is on the road"),
    "log_left_map": Quantity("truth", "the log leaves the mapped area"),
    "log_runs_red": Quantity("truth", "the log runs a red light"),
    "distance_m": Quantity("number", "distance that the log drives after the current step"),
    "route_deviation_mean_m": Quantity("number", "mean distance of the log to the route"),
    "route_deviation_max_m": Quantity("number", "largest distance of the log to the route"),
    "route_reaches_goal": Quantity("truth", "the route ends within 3 m of where the log ends"),
    "lights_seen": Quantity("number", "lights whose state somebody observed at some step"),
    "ignored_overlaps": Quantity(
        "number", "most agents at once that overlapped ego at first and are ignored"
    ),
    "clipped_physical": Quantity(
        "number",
        "share of steps at which following the log asks for more than `physical` and `discrete` allow",
    ),
    "clipped_published": Quantity(
        "number", "share of steps at which following the log asks for more than `published` allows"
    ),
    "default_sizes": Quantity("truth", "some box sizes are those of the class"),
    "velocity": Quantity("word", "where velocities come from", ("measured", "differentiated")),
    "dt_jitter": Quantity("truth", "some step differs from the median step by more than 2 ms"),
    "clean": Quantity("truth", "no collision, never off the road, no red light run"),
}


def tag_words(entry: Mapping[str, Any], name: str) -> frozenset[str]:
    """The words of a scenario's tag: one, several where the source gives several (``scenario_types``), or none."""
    return frozenset(entry["tags"].get(name, "").split("|")) - {""}


def vocabulary() -> dict[str, Quantity]:
    """Everything that filters can ask for, by name, own tags (``tag.NAME``) aside."""
    known = {name: Quantity("word", "") for name in (*_NAMES, *_OPEN_TAGS)}
    known |= {name: Quantity("word", "", words) for name, words in TAGS.items()}
    # Where a tag bears the name of a count (lights), a number asks for the count and a word for the tag.
    known |= {name: Quantity("number", "", TAGS.get(name, ())) for name in _COUNTS}
    known |= {f"overflow.{name}": Quantity("number", "") for name in OVERFLOWS}
    known |= {f"audit.{name}": finding for name, finding in FINDINGS.items()}
    known["flag"] = Quantity("word", "", tuple(str(flag.name) for flag in Flag if flag))
    return known


@dataclass(frozen=True)
class Filter:
    """One condition on a scenario.

    Attributes:
        text: As the user wrote it.
        name: What it asks for.
        operator: ``=``, ``!=``, ``<``, ``<=``, ``>`` or ``>=``.
        values: The alternatives: words, numbers or truths; one number where the operator compares.
    """

    text: str
    name: str
    operator: str
    values: tuple[str | float | bool, ...]

    @classmethod
    def parse(cls, text: str) -> Filter:
        """Reads ``NAME=VALUE|VALUE``, ``NAME!=VALUE`` or a comparison of NAME with a number.

        Raises:
            UsageError: It has no such form, or its name, its operator or a value cannot be meant.
        """
        form = _FILTER.fullmatch(text)
        if form is None or form[3].startswith("="):
            raise _refusal(text, "is no filter", "write NAME=VALUE, NAME!=VALUE or NAME>=NUMBER")
        name, sign, words = form[1], form[2], tuple(word.strip() for word in form[3].split("|"))
        quantity = _known(text, name)
        if not all(words):
            raise _refusal(text, "names no value", "write NAME=VALUE or NAME=VALUE|VALUE")
        if sign in _COMPARED and (quantity.kind != "number" or len(words) > 1):
            raise _refusal(text, f"cannot be compared with {sign}", "use = or !=, or a number of something")
        if name == "flag":
            words = tuple(word.upper() for word in words)
        values = tuple(_value(text, name, quantity, word) for word in words)
        if len({isinstance(value, str) for value in values}) > 1:
            raise _refusal(text, "mixes words and numbers", "write two filters or ask for one of them")
        if sign in _COMPARED and isinstance(values[0], str):
            raise _refusal(text, f"{values[0]!r} is no number", f"give a number after {sign}")
        return cls(text, name, sign, values)

    def matches(self, entry: Mapping[str, Any]) -> bool:
        """Whether a scenario satisfies it; never where the scenario does not know what it asks for."""
        found = self.find(entry)
        if found is None:
            return False
        if self.operator in _COMPARED:
            return _COMPARED[self.operator](found, self.values[0])
        held = found if isinstance(found, frozenset) else {found}
        return held.isdisjoint(self.values) == (self.operator == "!=")

    def find(self, entry: Mapping[str, Any]) -> Any:
        """What a scenario says about it: a number, a word, a truth, a set of words; None where it does not know."""
        group, _, name = self.name.partition(".")
        if group == "flag":
            return frozenset(entry["flags"])
        if group == "audit":
            return entry["audit"].get(name)
        if group == "overflow":
            return entry["overflow"].get(name, 0)
        if group == "tag":
            return tag_words(entry, name) or None
        if group in _NAMES:
            return entry[group]
        if self.name in _COUNTS and not isinstance(self.values[0], str):
            found: Any = entry
            for key in _COUNTS[self.name]:
                found = found.get(key, 0)
            return found
        return tag_words(entry, self.name) or None


@dataclass(frozen=True)
class Selection:
    """Filters that all must hold; without filters every scenario is selected."""

    filters: tuple[Filter, ...] = ()

    @classmethod
    def parse(cls, filters: Sequence[str]) -> Selection:
        """The selection that filters describe, as ``type=turn_left|turn_right`` or ``audit.distance_m>5``.

        Raises:
            UsageError: One of them cannot be meant.
        """
        return cls(tuple(Filter.parse(text) for text in filters))

    def matches(self, entry: Mapping[str, Any]) -> bool:
        """Whether a scenario is selected, by its entry in the manifest (``scenario.store.manifest_entry``)."""
        return all(condition.matches(entry) for condition in self.filters)

    def rows(self, entries: Iterable[Mapping[str, Any]]) -> list[int]:
        """Rows of the scenarios that are selected, in order."""
        return [row for row, entry in enumerate(entries) if self.matches(entry)]

    def unknown(self, entries: Iterable[Mapping[str, Any]]) -> dict[str, int]:
        """How many scenarios do not know what a filter asks for, by the filter's text; only what is not zero."""
        counts = dict.fromkeys((condition.text for condition in self.filters), 0)
        for entry in entries:
            for condition in self.filters:
                counts[condition.text] += condition.find(entry) is None
        return {text: count for text, count in counts.items() if count}


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


def select_scenarios(
    data: Listing, filters: Sequence[str] = (), names: Sequence[str | Path] = (), limit: int | None = None
) -> list[int]:
    """Rows of the scenarios that are meant, in order of the set.

    Args:
        data: The set.
        filters: Conditions that all must hold (``scenario.select.selection``).
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


def _known(text: str, name: str) -> Quantity:
    """What a name stands for."""
    if name.startswith("tag.") and len(name) > len("tag."):
        return Quantity("word", "a tag of the user's own")
    known = vocabulary()
    if name in known:
        return known[name]
    # Without its group a finding is guessed too: log_collides for audit.log_collides.
    by_end = {full.rpartition(".")[2]: full for full in known} | {full: full for full in known}
    near = difflib.get_close_matches(name, by_end, n=1, cutoff=0.7)
    cure = f"did you mean {by_end[near[0]]!r}?" if near else f"a tag of your own is asked for as tag.{name}"
    raise _refusal(text, f"asks for {name!r}, which no scenario has", cure)


def _value(text: str, name: str, quantity: Quantity, word: str) -> str | float | bool:
    """A word of a filter as the kind of value that its quantity has."""
    if quantity.kind == "truth":
        if word.lower() not in _TRUTHS:
            raise _refusal(text, f"{word!r} is neither true nor false", f"write {name}=true or {name}=false")
        return _TRUTHS[word.lower()]
    if quantity.kind == "number":
        number = _number(word)
        if number is None and word not in quantity.words:
            raise _refusal(text, f"{word!r} is no number", f"write {name}>=10, say")
        return word if number is None else number
    if quantity.words and word not in quantity.words:
        near = difflib.get_close_matches(word, quantity.words, n=1)
        cure = f"did you mean {near[0]!r}?" if near else f"use one of {', '.join(quantity.words)}"
        raise _refusal(text, f"{name} is never {word!r}", cure)
    return word


def _number(word: str) -> float | None:
    try:
        number = float(word)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _refusal(text: str, problem: str, cure: str) -> UsageError:
    return UsageError(f"filter {text!r}: {problem}", cure=cure)
