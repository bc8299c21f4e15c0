"""Contents of scenario sets as numbers: opened, tested, selected and summed up for tables and pages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import DataError
from drivax.scenario.schema import DT_S, Scenario
from drivax.scenario.select.selection import FINDINGS, Selection, tag_words
from drivax.scenario.store import ScenarioSet

Array = np.ndarray[Any, Any]
Entry = Mapping[str, Any]

_SOURCE = ("steps", "tracks", "tracks_valid_now", "map_features", "map_points", "lights")
#: Scenarios with records that are read; the manifest describes the rest.
SAMPLE = 1000


def described(entry: Entry) -> dict[str, Any]:
    """Return one scenario as ``inspect --json`` prints it: a stable contract."""
    return {
        **{name: entry[name] for name in ("scenario_id", "dataset", "segment")},
        **{name: entry["source"][name] for name in _SOURCE},
        **{name: entry[name] for name in ("segments", "overflow", "flags", "audit")},
    }


@dataclass(frozen=True)
class Inspection:
    """An opened scenario set.

    Attributes:
        name: Its name in tables.
        scenarios: The set.
        rows: Rows of the selected scenarios, at least one.
        unknown: Number of scenarios that lack what a filter asks for, by filter.
        checked: Whether every checksum was tested.
    """

    name: str
    scenarios: ScenarioSet
    rows: tuple[int, ...]
    unknown: Mapping[str, int]
    checked: bool

    @classmethod
    def open(cls, path: Path, selection: Selection, check: bool = True) -> Inspection:
        """Open a set.

        Args:
            path: Its folder.
            selection: Which scenarios to look at.
            check: Read the whole set and test every checksum.

        Raises:
            DataError: The set is damaged, or no scenario is selected.
        """
        scenarios = ScenarioSet.open(path, verify=check)
        if check:
            scenarios.check()
        rows = tuple(selection.rows(scenarios.entries))
        unknown = selection.unknown(scenarios.entries)
        if not rows:
            text = " and ".join(condition.text for condition in selection.filters)
            lacking = ", ".join(f"{count:,} lack what {name!r} asks for" for name, count in unknown.items())
            raise DataError(
                f"none of {len(scenarios):,} scenarios has {text}" + (f" ({lacking})" if lacking else ""),
                file=path,
                cure="drivax inspect without --filter shows what there is",
            )
        return cls(path.resolve().name, scenarios, rows, unknown, check)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def entries(self) -> list[Entry]:
        """The manifest entries of the selected scenarios."""
        return [self.scenarios.entries[row] for row in self.rows]

    @property
    def source(self) -> Mapping[str, Any]:
        """The origin of the set, and what was read and left out; empty for sets that were written by hand."""
        return self.scenarios.manifest["source"]

    def sample(self, most: int | None = None) -> Iterator[Scenario]:
        """Return at most ``most`` (``SAMPLE`` by default) of the selected scenarios, evenly spread."""
        most = SAMPLE if most is None else most
        places = np.unique(np.linspace(0, len(self.rows) - 1, min(most, len(self.rows))).round())
        return (self.scenarios[self.rows[int(place)]] for place in places)

    @property
    def hours(self) -> float:
        """Driving time of all scenarios; windows of one recording may overlap and count in full."""
        return sum(max(entry["source"]["steps"] - 1, 0) for entry in self.entries) * DT_S / 3600

    @property
    def recordings(self) -> int:
        """Number of recordings: segments of data sets."""
        return len({(entry["dataset"], entry["segment"]) for entry in self.entries})

    @property
    def megabytes(self) -> float:
        """Size of the whole set on disk, MB."""
        files = (path for path in self.scenarios.path.rglob("*") if path.is_file())
        return sum(path.stat().st_size for path in files) / 1e6

    def rate_hz(self) -> tuple[float, float]:
        """Return the smallest and largest rate of the sampled scenarios, Hz."""
        rates = [1.0 / float(scenario.record["dt_s"]) for scenario in self.sample()]
        return min(rates), max(rates)

    def values(self, read: Callable[[Entry], Any]) -> Float[Array, " known"]:
        """Return a number of every scenario that has it."""
        numbers = (read(entry) for entry in self.entries)
        return np.array([value for value in numbers if value is not None], np.float64)

    def words(self, read: Callable[[Entry], Sequence[str]]) -> dict[str, int]:
        """Return the number of scenarios with each word, the most frequent first."""
        counts = Counter(word for entry in self.entries for word in read(entry))
        return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))

    def tags(self) -> dict[str, dict[str, int]]:
        """Return the number of scenarios with each value of each tag except the data set."""
        names = self.words(lambda entry: [name for name in entry["tags"] if name != "dataset"])
        return {name: self.words(lambda e, name=name: sorted(tag_words(e, name))) for name in names}

    def totals(self, read: Callable[[Entry], Mapping[str, int]]) -> dict[str, tuple[int, int]]:
        """Return the sum of each counter, and the number of scenarios where it is not zero."""
        counts, scenarios = Counter[str](), Counter[str]()
        for entry in self.entries:
            nonzero = {name: number for name, number in read(entry).items() if number}
            counts.update(nonzero)
            scenarios.update(nonzero.keys())
        return {name: (counts[name], scenarios[name]) for name in sorted(counts)}

    def findings(self) -> list[str]:
        """Return the names of the audit's findings, in the order of ``scenario.select.selection.FINDINGS``."""
        names = {name for e in self.entries for name, value in e["audit"].items() if value is not None}
        return [*(name for name in FINDINGS if name in names), *sorted(names - set(FINDINGS))]

    def finding(self, name: str) -> list[Any]:
        """Return a finding of the audit for every scenario that has it."""
        values = (entry["audit"].get(name) for entry in self.entries)
        return [value for value in values if value is not None]


def _counted(name: str) -> Callable[[Entry], Any]:
    return lambda entry: entry["source"][name]


def _mapped(name: str) -> Callable[[Entry], Any]:
    return lambda entry: entry["source"]["map_features"].get(name, 0)


def _audited(name: str) -> Callable[[Entry], Any]:
    return lambda entry: entry["audit"].get(name)


@dataclass(frozen=True)
class Quantity:
    """A number of a scenario in tables and histograms."""

    label: str
    unit: str
    read: Callable[[Entry], Any]


#: Numbers of every scenario: of its source, before cropping and capping, and of its audit.
QUANTITIES = (
    Quantity("agents now", "", _counted("tracks_valid_now")),
    Quantity("tracks", "", _counted("tracks")),
    Quantity("steps", "", _counted("steps")),
    Quantity("lanes", "", _mapped("lane")),
    Quantity("road lines", "", _mapped("road_line")),
    Quantity("road edges", "", _mapped("road_edge")),
    Quantity("crosswalks", "", _mapped("crosswalk")),
    Quantity("stop signs", "", _mapped("stop_sign")),
    Quantity("map points", "", _counted("map_points")),
    Quantity("stored segments", "", lambda entry: entry["segments"]),
    Quantity("lights", "", _counted("lights")),
    Quantity("ego drives", "m", _audited("distance_m")),
    Quantity("log to route, mean", "m", _audited("route_deviation_mean_m")),
    Quantity("log to route, most", "m", _audited("route_deviation_max_m")),
)


@dataclass(frozen=True)
class Speeds:
    """Speeds in sampled scenarios, m/s.

    Attributes:
        ego: Ego at every step of its log.
        vehicles: Other moving vehicles at the current step.
        scenarios: Number of sampled scenarios.
    """

    ego: Float[Array, " step"]
    vehicles: Float[Array, " vehicle"]
    scenarios: int


def speeds(inspection: Inspection) -> Speeds:
    """Return speeds from the records of a sample."""
    ego, vehicles = [np.zeros(0)], [np.zeros(0)]
    count = 0
    for count, scenario in enumerate(inspection.sample(), 1):  # noqa: B007
        speed = np.linalg.norm(scenario.agent_velocity, axis=-1)
        valid, now = scenario.agent_valid, int(scenario.current_step)
        ego.append(speed[valid[:, 0], 0])
        others = valid[now, 1:] & (scenario.agent_kind[1:] == 1)
        vehicles.append(speed[now, 1:][others])
    return Speeds(np.concatenate(ego), np.concatenate(vehicles), count)
