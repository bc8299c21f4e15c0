"""Results of an evaluation: one row per episode, a summary with intervals, and the run folder that holds both."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivax.errors import DataError
from drivax.metrics.catalogue import EVENTS, METRICS, Column, Metric, names_of
from drivax.stats.clusters import recordings
from drivax.stats.intervals import Interval, bootstrap_mean, rate

#: Columns of ``episodes.csv`` before the metrics.
KEYS = ("planner", "dataset", "scenario_id", "segment", "seed", "traffic")
#: The columns that evaluation adds to the metrics.
ADDED = {
    "crashed": Column(
        "-", "low", "the planner raised an error, or its action was not finite: a failed episode", kind="rate"
    ),
    "action_jerk": Column(
        "-",
        "low",
        "standard deviation of the change of the action from step to step; 0.82 for random actions",
    ),
}
_COLUMNS: dict[str, Column] = {**METRICS, **ADDED}
#: Columns of zeros and ones: their interval is Wilson's.
RATES = names_of(_COLUMNS, "rate")
#: Columns that lie between 0 and 1.
SHARES = names_of(_COLUMNS, "rate", "score")
#: Columns without a mean.
NOT_SUMMARISED = tuple(name for name, column in _COLUMNS.items() if not column.summarised)
#: Columns that are 0 in an episode in which the planner crashed.
FAILED = tuple(name for name, column in _COLUMNS.items() if column.fails_on_crash)


@dataclass(frozen=True)
class Crash:
    """An episode whose planner crashed.

    Attributes:
        row: Which one.
        step: Step of the log at which it first did.
        error: What it raised, or that its action was not finite; one line.
    """

    row: int
    step: int
    error: str


@dataclass(frozen=True)
class Results:
    """Episodes of one planner on one set of scenarios.

    Attributes:
        planner, traffic, seed: What drove, in which traffic, with which seed.
        scenarios: ``dataset``, ``scenario_id`` and ``segment`` of each episode.
        metrics: Values by metric name, NaN where undefined.
        events: First step of each kind of failure, -1 for none.
        motion: x, y, heading, speed per step from ``start`` on.
        actions: What was carried out from ``start`` on, NaN from a crash on.
        others: Where everyone was from ``start`` on (``evaluation.traffic_trajectories``); None where the log was
            replayed.
        start: Step of the log at which the episodes began.
        offroad_steps: Steps off the road.
        own: Those of the metrics that are the user's own: unit, direction and text.
        crashes: Episodes that failed because the planner crashed.
    """

    planner: str
    traffic: str
    seed: int
    scenarios: Sequence[Mapping[str, str]]
    metrics: Mapping[str, np.ndarray[Any, Any]]
    events: Mapping[str, np.ndarray[Any, Any]]
    motion: np.ndarray[Any, Any]
    actions: np.ndarray[Any, Any]
    others: np.ndarray[Any, Any] | None
    start: int
    offroad_steps: np.ndarray[Any, Any]
    own: Mapping[str, Metric] = field(default_factory=dict)
    crashes: Sequence[Crash] = ()

    def __len__(self) -> int:
        return len(self.scenarios)

    def summary(self) -> dict[str, Any]:
        """Mean and 95 % interval of every metric, as ``summary.json`` holds them.

        Rates have Wilson's interval over the effective number of recordings, other means a bootstrap over them. A
        metric that is defined nowhere has null mean and n 0.
        """
        rows = ([row[key] for row in self.scenarios] for key in ("dataset", "segment", "scenario_id"))
        clusters = np.array(recordings(*rows))
        table = {
            name: interval_of(name, values, clusters).as_dict()
            for name, values in self.metrics.items()
            if name not in NOT_SUMMARISED
        }
        return {"planner": self.planner, "traffic": self.traffic, "metrics": table}

    def rows(self) -> list[dict[str, str]]:
        """Rows of ``episodes.csv``: undefined metrics are empty cells, booleans 0 or 1."""
        rows = []
        for number, scenario in enumerate(self.scenarios):
            row = {
                "planner": self.planner,
                **{key: scenario[key] for key in ("dataset", "scenario_id", "segment")},
                "seed": str(self.seed),
                "traffic": self.traffic,
            }
            row |= {name: _cell(values[number]) for name, values in self.metrics.items()}
            rows.append(row)
        return rows

    def notes(self) -> dict[str, Any]:
        """What ``run.json`` says of the user's own metrics, so that a report can head their columns."""
        about = {n: {"unit": m.unit, "better": m.better, "text": m.definition} for n, m in self.own.items()}
        return {"own_metrics": about} if about else {}

    def crash_rows(self) -> list[dict[str, Any]]:
        """What ``crashes.json`` holds: the scenario of each crash, the step and the error."""
        return [
            {
                **{key: self.scenarios[crash.row][key] for key in ("dataset", "scenario_id")},
                "step": crash.step,
                "error": crash.error,
            }
            for crash in self.crashes
        ]

    def write(self, folder: Path) -> None:
        """Writes ``episodes.csv``, ``summary.json`` and ``trajectories.npz`` into an existing folder.

        And ``crashes.json``, where the planner crashed.
        """
        if self.crashes:
            (folder / "crashes.json").write_text(
                json.dumps(self.crash_rows(), indent=1) + "\n", encoding="utf-8"
            )
        with (folder / "episodes.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [*KEYS, *self.metrics], lineterminator="\n")
            writer.writeheader()
            writer.writerows(self.rows())
        (folder / "summary.json").write_text(json.dumps(self.summary(), indent=1) + "\n", encoding="utf-8")
        arrays = {f"{name}_step": self.events[name].astype(np.int16) for name in EVENTS}
        arrays |= {} if self.others is None else {"others": self.others}
        np.savez_compressed(
            folder / "trajectories.npz",
            allow_pickle=False,
            scenario_id=np.array([row["scenario_id"] for row in self.scenarios]),
            ego=self.motion.astype(np.float32),
            action=self.actions.astype(np.float16),
            start=np.full(len(self), self.start, np.int32),
            **arrays,
        )


def with_crashes(metrics: Mapping[str, Any], crashed: Any) -> dict[str, np.ndarray[Any, Any]]:
    """Metrics in which episodes whose planner crashed have failed, and the column that says which these are.

    They have the value 0 in those of :data:`FAILED` that their scenario defines, so that a planner gains nothing by
    crashing; all else is what was measured until then.

    Args:
        metrics: Values by name, NaN where undefined; those of the user's own last.
        crashed: Which episodes did.
    """
    found = {
        name: np.where(crashed & ~np.isnan(values), 0.0, values) if name in FAILED else values
        for name, values in metrics.items()
    }
    ours = [name for name in found if name in METRICS]
    own = [name for name in found if name not in METRICS]
    column = {"crashed": np.asarray(crashed, np.float64)}
    return {n: found[n] for n in ours} | column | {n: found[n] for n in own}


def _cell(value: Any) -> str:
    if not np.isfinite(value):
        return ""
    return str(int(value)) if float(value).is_integer() else f"{value:.6g}"


def interval_of(name: str, values: Any, clusters: Any, confidence: float = 0.95, seed: int = 0) -> Interval:
    """Mean and interval over the episodes that define the metric; the interval of a rate is Wilson's."""
    if name in RATES:
        return rate(values, clusters, confidence)
    return bootstrap_mean(values, clusters, confidence, seed=seed)


def read_summary(folder: Path) -> dict[str, Any]:
    """The summary of an evaluation's run folder."""
    file = folder / "summary.json"
    if not file.is_file():
        raise DataError(
            "is missing: not a finished evaluation", file=file, cure="run `drivax evaluate` again"
        )
    return json.loads(file.read_text())
