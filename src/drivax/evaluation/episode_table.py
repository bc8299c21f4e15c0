"""Episodes of an evaluation: metrics, trajectories and crashes, in memory or in a run folder."""

from __future__ import annotations

import contextlib
import json
import math
from array import array
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Float32, Int16, Int64

from drivax.errors import DataError
from drivax.escaping import csv_text
from drivax.metrics.catalogue import EVENTS, METRICS, Column, Direction, names_of
from drivax.reading import DAMAGE, MOST_TEXT, explain_damage, read_arrays, read_csv, read_json
from drivax.scenario.schema import Scenario
from drivax.scenario.store import ScenarioSet
from drivax.seal import check_seal, edited_files, mark_edited, refuse_edited, require_entries, seal
from drivax.stats.clusters import recordings
from drivax.stats.intervals import Interval, bootstrap_mean, rate
from drivax.tracking.run_folder import CONFIG_FILE, RunFolder, require_file

#: Key columns of ``episodes.csv``, before the metrics.
KEYS = ("planner", "dataset", "scenario_id", "segment", "seed", "traffic")
_CRASHED = "the planner raised an error, or its action was not finite: a failed episode"
_ACTION_JERK = "standard deviation of the change of the action from step to step; 0.82 for random actions"
#: Columns that an evaluation adds to the metrics.
ADDED = {
    "crashed": Column("-", "low", _CRASHED, kind="rate"), "action_jerk": Column("-", "low", _ACTION_JERK)
}  # fmt: skip
#: All columns after the keys, except user-defined metrics.
COLUMNS: dict[str, Column] = {**METRICS, **ADDED}
#: Columns of zeros and ones, which have Wilson intervals.
RATES = names_of(COLUMNS, "rate")
#: Columns whose intervals are kept within 0 and 1.
SHARES = names_of(COLUMNS, "rate", "score")
#: Codes and counts, whose means are not reported.
NOT_SUMMARISED = tuple(name for name, column in COLUMNS.items() if not column.summarised)
#: Columns that are 0 if the planner crashed.
FAILED = tuple(name for name, column in COLUMNS.items() if column.fails_on_crash)
_RERUN = "run drivax evaluate again"
_FILES = ("episodes.csv", "summary.json", "crashes.json", "trajectories.npz")
#: Size limits of ``episodes.csv``, bytes: per row (a typical row has 300), and in total.
_MOST_ROW_BYTES, _MOST_TABLE_BYTES = 1 << 10, 512 << 20
#: Memory limit of a table, in cells of 8 bytes (1 GB in total): the largest table, of 1.7 million episodes, takes up to
#: 126 million. A key takes two cells (in a list, then in a tuple), a distinct text ``_TEXT_CELLS``.
_MOST_CELLS, _TEXT_CELLS = 128 << 20, 16
#: Size limits of ``trajectories.npz``, bytes: fixed part, and per episode (more than any capacity needs).
_MOST_BYTES, _MOST_EPISODE_BYTES = 16 << 20, 1 << 20

Array = np.ndarray[Any, Any]
#: ``(dataset, scenario_id)``.
ScenarioKey = tuple[str, str]
#: Tags of scenarios by name.
Tags = Mapping[ScenarioKey, Mapping[str, str]]


@dataclass(frozen=True)
class Crash:
    """First crash of a planner in one episode: the step of the log, and the error."""

    dataset: str
    scenario_id: str
    step: int
    error: str


@dataclass(frozen=True)
class Trajectories:
    """Trajectories of ego and traffic in each scenario's local frame, one episode per row.

    Attributes:
        ego: x, y [m], heading [rad], speed [m/s] from step ``start`` on; the last value is repeated after a crash and
            after the end of a short log.
        action: Executed actions from step ``start`` on, NaN after a crash and after the end of a short log; without
            columns if unknown.
        start: Step of the log at which the planner takes over.
        events: Step of the first event by name (:data:`EVENTS`), -1 for none.
        others: Packed poses of the other agents (``evaluation.rollout.pack_poses``); None in log traffic.
    """

    ego: Float32[Array, "episode step 4"]
    action: Float[Array, "episode action D"]
    start: Int64[Array, " episode"]
    events: Mapping[str, Int64[Array, " episode"]]
    others: Int16[Array, "episode step A 3"] | None = None

    def begin(self, row: int, scenario: Scenario) -> int:
        """Return the step at which an episode begins.

        Raises:
            DataError: It is beyond the end of the scenario.
        """
        start, steps = int(self.start[row]), int(scenario.steps)
        if start >= steps:
            problem = f"the episode begins at step {start} of {steps}"
            raise DataError(problem, record=scenario.id, cure=_RERUN)
        return start


@dataclass(frozen=True, eq=False)
class EpisodeTable:
    """Episodes of one planner on one scenario set.

    Attributes:
        folder, info: Run folder (None for episodes in memory), and content of ``run.json``.
        name: Planner name in tables.
        keys: Columns :data:`KEYS` as text.
        metrics: Values by metric name, NaN if undefined.
        crashes: Crashes of the planner.
        in_memory: Trajectories of an evaluation that was not read from a folder.
    """

    folder: Path | None
    name: str
    info: Mapping[str, Any]
    keys: Mapping[str, tuple[str, ...]]
    metrics: Mapping[str, Float[Array, " episode"]]
    crashes: tuple[Crash, ...] = ()
    in_memory: Trajectories | None = None

    def __len__(self) -> int:
        return len(self.keys["scenario_id"])

    @classmethod
    def read(cls, path: str | Path) -> EpisodeTable:
        """Read the episodes of a run folder of ``drivax evaluate``; trajectories are read on first access.

        Raises:
            DataError: The folder or a file is missing, damaged or edited, the run is not an evaluation, or its rows
                are not those that ``run.json`` describes.
        """
        run = RunFolder.open(path)
        if run.kind != "evaluation":
            problem, file = f"run is of kind {run.kind!r}, not evaluation", run.path / "run.json"
            raise DataError(problem, file=file, cure="give a folder written by drivax evaluate")
        if run.is_sealed:
            require_entries(run.path, *_FILES)
        keys, metrics = _read_columns(run.path / "episodes.csv", _count_scenarios(run.info))
        if mismatch := _mismatch(keys, run.info):
            refuse_edited(run.path / "episodes.csv", *mismatch)
        crashes = _read_crashes(run.path / "crashes.json")
        for file in (CONFIG_FILE, "summary.json"):
            check_seal(run.path / file)
        name = mark_edited(str(run.info.get("planner", run.path.name)), edited_files(run.path))
        return cls(run.path, name, run.info | {"planner": name}, keys, metrics, crashes)

    @classmethod
    def read_seeds(cls, path: str | Path) -> tuple[EpisodeTable, ...]:
        """Read the evaluation in a folder, or those in its sub-folders (one per training seed), ordered by name."""
        path = Path(path)
        folders = sorted(file.parent for file in path.glob("*/episodes.csv"))
        if (path / "run.json").is_file() or not folders:
            return (cls.read(path),)
        return tuple(cls.read(folder) for folder in folders)

    @property
    def planner(self) -> str:
        """Name of the planner in ``run.json``."""
        return str(self.info.get("planner", self.name))

    @property
    def traffic(self) -> str:
        """Traffic model: ``log``, ``idm``, ..."""
        return str(self.info.get("traffic", "log"))

    @property
    def own_metrics(self) -> Mapping[str, Column]:
        """Unit, direction and definition of user-defined metrics."""
        columns = {}
        with explain_damage((self.folder or Path()) / "run.json", _RERUN):
            for name, metric in (self.info.get("own_metrics") or {}).items():
                unit, better, definition = (str(metric[key]) for key in ("unit", "better", "text"))
                columns[name] = Column(unit, cast(Direction, better), definition)
        return columns

    @property
    def data(self) -> Mapping[str, Any]:
        """Path, hash and name of the scenario set, if known."""
        data = self.info.get("data") or {}
        return data[0] if isinstance(data, list) else data

    @cached_property
    def settings(self) -> Mapping[str, Any]:
        """Content of ``config.yaml``; empty if there is none."""
        return {} if self.folder is None else RunFolder(self.folder, dict(self.info)).settings

    @property
    def scenarios(self) -> list[ScenarioKey]:
        """Scenario of every episode."""
        return list(zip(self.keys["dataset"], self.keys["scenario_id"], strict=True))

    @property
    def clusters(self) -> list[str]:
        """Cluster of every episode: its segment, or its scenario if the segment is unknown."""
        return recordings(*(self.keys[name] for name in ("dataset", "segment", "scenario_id")))

    @property
    def crash_by_scenario(self) -> dict[ScenarioKey, Crash]:
        """Crash by scenario; of repeated episodes the last one."""
        return {(crash.dataset, crash.scenario_id): crash for crash in self.crashes}

    @cached_property
    def trajectories(self) -> Trajectories:
        """Trajectories of the episodes, in their order.

        Raises:
            DataError: ``trajectories.npz`` is missing, damaged or edited, or lacks an episode.
        """
        if self.in_memory is not None:
            return self.in_memory
        if self.folder is None:
            raise DataError("episodes have no trajectories", cure="evaluate again, or read a run folder")
        path = self.folder / "trajectories.npz"
        return _read_trajectories(path, self.keys["scenario_id"], self.traffic == "log")

    def metric(self, name: str) -> Column | None:
        """Return the description of a metric, or None if it is unknown."""
        return COLUMNS.get(name) or self.own_metrics.get(name)

    def by_scenario(self, metric: str) -> dict[ScenarioKey, float]:
        """Return the mean of a metric by scenario, over the episodes that define it; NaN if there are none."""
        column = self.metrics.get(metric, np.full(len(self), np.nan))
        defined_values: dict[ScenarioKey, list[float]] = {key: [] for key in self.scenarios}
        for key, value in zip(self.scenarios, column.tolist(), strict=True):
            if not math.isnan(value):
                defined_values[key].append(value)
        return {key: float(np.mean(values)) if values else math.nan for key, values in defined_values.items()}

    def summary(self) -> dict[str, Any]:
        """Return the content of ``summary.json``: mean and 95 % interval (:func:`interval_of`) by metric.

        Codes and counts (:data:`NOT_SUMMARISED`) are left out. A metric without defined values has mean null and n 0.
        """
        clusters = np.array(self.clusters)
        columns = {name: values for name, values in self.metrics.items() if name not in NOT_SUMMARISED}
        table = {name: interval_of(name, values, clusters).as_dict() for name, values in columns.items()}
        return {"planner": self.planner, "traffic": self.traffic, "metrics": table}

    def rows(self) -> list[dict[str, str]]:
        """Return the rows of ``episodes.csv``: undefined metrics are empty cells, booleans 0 or 1."""
        columns = {name: self.keys[name] for name in KEYS}
        columns |= {name: tuple(map(_cell, values)) for name, values in self.metrics.items()}
        return [dict(zip(columns, cells, strict=True)) for cells in zip(*columns.values(), strict=True)]

    def write(self, folder: Path) -> None:
        """Write and seal ``episodes.csv``, ``summary.json``, ``trajectories.npz`` and, if any, ``crashes.json``."""
        records: dict[str, Any] = {"summary.json": self.summary()}
        if self.crashes:
            records["crashes.json"] = [asdict(crash) for crash in self.crashes]
        for name, record in records.items():
            (folder / name).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        lines = [[*KEYS, *self.metrics], *(list(row.values()) for row in self.rows())]
        (folder / "episodes.csv").write_text(csv_text(lines), encoding="utf-8", newline="")
        trajectories = self.trajectories
        arrays = {f"{name}_step": trajectories.events[name].astype(np.int16) for name in EVENTS}
        arrays |= {} if trajectories.others is None else {"others": trajectories.others}
        np.savez_compressed(
            folder / "trajectories.npz",
            allow_pickle=False,
            scenario_id=np.array(self.keys["scenario_id"]),
            ego=trajectories.ego.astype(np.float32),
            action=trajectories.action.astype(np.float16),
            start=trajectories.start.astype(np.int32),
            **arrays,
        )
        seal(folder, *_FILES)

    def open_set(self, data: Path | None = None) -> ScenarioSet:
        """Open the scenario set of this evaluation; ``data`` is its path if it has moved.

        Raises:
            DataError: The set is missing, or its hash differs.
        """
        run_path = self.data.get("path")
        if data is None and run_path is None:
            file = None if self.folder is None else self.folder / "run.json"
            raise DataError("no scenario set recorded", file=file, cure="pass it with --data SET")
        path = data if data is not None else Path(str(run_path))
        if data is None and not path.exists():
            cure = "pass its new path with --data SET"
            raise DataError("scenario set of this run not found", file=path, cure=cure)
        scenarios, expected_hash = ScenarioSet.open(path), str(self.data.get("hash") or "")
        if expected_hash and scenarios.hash != expected_hash:
            hashes = f"hash {scenarios.hash[:12]}, not {expected_hash[:12]}"
            problem = f"not the set that {self.name!r} was evaluated on ({hashes})"
            raise DataError(problem, file=path, cure="pass the set that was evaluated with --data SET")
        return scenarios


def fail_crashed(metrics: Mapping[str, Array], has_crashed: Any) -> dict[str, Array]:
    """Set the metrics :data:`FAILED` of crashed episodes to 0 if defined, and add the column ``crashed``.

    A crash thus never improves a score. Other metrics cover the steps before the crash. User-defined metrics come
    last.
    """
    values = {
        name: np.where(has_crashed & ~np.isnan(column), 0.0, column) if name in FAILED else column
        for name, column in metrics.items()
    }
    built_in = {name: column for name, column in values.items() if name in METRICS}
    return built_in | {"crashed": np.asarray(has_crashed, np.float64)} | values


def interval_of(name: str, values: Any, clusters: Any, confidence: float = 0.95, seed: int = 0) -> Interval:
    """Return the mean over defined values of a metric, with Wilson's interval for rates, else a bootstrap interval."""
    if name in RATES:
        return rate(values, clusters, confidence)
    return bootstrap_mean(values, clusters, confidence, seed=seed)


def _cell(value: Any) -> str:
    if not np.isfinite(value):
        return ""
    return str(int(value)) if float(value).is_integer() else f"{value:.6g}"


def _count_scenarios(info: Mapping[str, Any]) -> int:
    """Return the number of scenarios of the evaluated sets according to ``run.json``, 0 if unknown."""
    with contextlib.suppress(*DAMAGE):
        return sum(int(data["scenarios"]) for data in info["data"])
    return 0


def _read_columns(path: Path, scenarios: int) -> tuple[dict[str, tuple[str, ...]], dict[str, Array]]:
    """Read ``episodes.csv``: :data:`KEYS` as text, metrics as float64 with NaN for undefined values."""
    max_bytes = min(max(MOST_TEXT, scenarios * _MOST_ROW_BYTES), _MOST_TABLE_BYTES)
    rows = read_csv(require_file(path, _RERUN), _RERUN, max_bytes)
    header = next(rows, [])
    missing = [key for key in KEYS if key not in header]
    if missing or len(set(header)) < len(header):
        problem = f"lacks the column {missing[0]!r}" if missing else "names a column twice"
        raise DataError(problem, file=path, record="header", cure=_RERUN)
    keys: dict[str, list[str]] = {name: [] for name in KEYS}
    metrics = {name: array("d") for name in header if name not in KEYS}
    distinct_texts: dict[str, str] = {}
    for number, row in enumerate(rows, start=1):
        if len(row) != len(header):
            raise DataError(f"has {len(row)} cells, not {len(header)}", file=path, record=number, cure=_RERUN)
        if number * (len(header) + len(KEYS)) + _TEXT_CELLS * len(distinct_texts) > _MOST_CELLS:
            raise DataError("the table has too many cells", file=path, record=number, cure=_RERUN)
        for name, cell in zip(header, row, strict=True):
            if name in keys:
                keys[name].append(distinct_texts.setdefault(cell, cell))
            else:
                metrics[name].append(_parse_metric(path, number, name, cell))
    if not keys[KEYS[0]]:
        raise DataError("contains no episodes", file=path, cure=_RERUN)
    columns = {name: np.frombuffer(values, np.float64) for name, values in metrics.items()}
    return {name: tuple(cells) for name, cells in keys.items()}, columns


def _mismatch(keys: Mapping[str, Sequence[str]], info: Mapping[str, Any]) -> tuple[str, int] | None:
    """Return problem and number of a row of ``episodes.csv`` that contradicts ``run.json``; None if all agree.

    Entries that ``run.json`` lacks, as in runs of other programs, are not compared.
    """
    for name in ("planner", "traffic", "seed"):
        expected = info.get(name)
        for row, cell in enumerate(keys[name], start=1):
            if expected is not None and cell != str(expected):
                return f"{name} is {cell!r}, not {str(expected)!r} as in run.json", row
    rows, episodes, set_size = len(keys["scenario_id"]), info.get("episodes"), _count_scenarios(info)
    scenarios: set[ScenarioKey] = set()
    for row, scenario in enumerate(zip(keys["dataset"], keys["scenario_id"], strict=True), start=1):
        if episodes is not None and scenario in scenarios:  # Episodes of other programs may repeat scenarios.
            return f"scenario {scenario[1]!r} occurs twice", row
        scenarios.add(scenario)
        if 0 < set_size < len(scenarios):
            return f"scenario {scenario[1]!r} is one more than the {set_size} of the set in run.json", row
    return None if episodes in (None, rows) else (f"has {rows} rows, not {episodes} as in run.json", rows)


def _parse_metric(path: Path, row: int, name: str, cell: str) -> float:
    """Parse the cell of a metric: NaN (undefined) if empty, else a finite number."""
    if not cell.strip():
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        problem = f"{name} is {cell!r}, not a number or empty"
        raise DataError(problem, file=path, record=row, cure=_RERUN) from None
    if not math.isfinite(value):
        problem = f"{name} is {'infinite' if math.isinf(value) else 'NaN'}"
        raise DataError(problem, file=path, record=row, cure=_RERUN)
    return value


def _read_crashes(path: Path) -> tuple[Crash, ...]:
    """Read ``crashes.json``, which exists only after crashes."""
    check_seal(path)
    if not path.is_file():
        return ()
    rows = read_json(path, _RERUN)
    with explain_damage(path, _RERUN, "cannot be read"):
        crashes = ((row["dataset"], row["scenario_id"], int(row["step"]), str(row["error"])) for row in rows)
        return tuple(Crash(*crash) for crash in crashes)


def _read_trajectories(path: Path, scenario_ids: Sequence[str], log_traffic: bool) -> Trajectories:
    """Read ``trajectories.npz`` in the order of ``scenario_ids``; repeated ids are matched by their order."""
    check_seal(path)
    archive = read_arrays(path, _RERUN, _MOST_BYTES + len(scenario_ids) * _MOST_EPISODE_BYTES)
    with explain_damage(path, _RERUN, "cannot be read"):
        ids = [_text(value) for value in archive["scenario_id"]]
        ego = archive["ego"].astype(np.float32)
        action = (archive["action"] if "action" in archive else ego[:, 1:, :0]).astype(np.float32)
        start = archive["start"].astype(np.int64)
        events = {name: archive[f"{name}_step"].astype(np.int64) for name in EVENTS}
        if start.size and not 0 <= start.min() <= start.max() < 1 << 15:
            raise ValueError(f"an episode begins at step {start.min() if start.min() < 0 else start.max()}")
        others = None if log_traffic else archive["others"]
    if not _has_consistent_shapes(len(ids), ego, action, (start, *events.values()), others):
        raise DataError("its arrays disagree in shape", file=path, cure=_RERUN)
    row_of = {key: row for row, key in enumerate(_with_occurrence(ids))}
    try:
        rows = [row_of[key] for key in _with_occurrence(scenario_ids)]
    except KeyError as error:
        raise DataError("lacks an episode", file=path, record=error.args[0][0], cure=_RERUN) from None
    if rows == list(range(len(ids))):
        return Trajectories(ego, action, start, events, others)
    events = {name: steps[rows] for name, steps in events.items()}
    others = None if others is None else others[rows]
    return Trajectories(ego[rows], action[rows], start[rows], events, others)


def _has_consistent_shapes(
    episodes: int, ego: np.ndarray, action: np.ndarray, steps: Sequence[np.ndarray], others: np.ndarray | None
) -> bool:
    if ego.ndim != 3 or ego.shape[::2] != (episodes, 4) or action.shape[:-1] != (episodes, ego.shape[1] - 1):
        return False
    if any(values.shape != (episodes,) for values in steps):
        return False
    return others is None or (
        others.ndim == 4 and others.shape[:2] == ego.shape[:2] and others.shape[3] == 3 and others.dtype == np.int16
    )  # fmt: skip


def _with_occurrence(ids: Sequence[str]) -> list[tuple[str, int]]:
    """Return each id with the number of its earlier occurrences."""
    counters: dict[str, Iterator[int]] = defaultdict(count)
    return [(name, next(counters[name])) for name in ids]


def _text(value: Any) -> str:
    return value.rstrip(b"\0").decode() if isinstance(value, bytes) else str(value)
