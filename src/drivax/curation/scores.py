"""Score tables: combine components into scores of steps and scenarios, and store them with set and method.

The most critical scenarios of a table are written as a scenario set with scores.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax.datasets.export.writer import Exported, refuse_part, write_part
from drivax.errors import DataError, UsageError, did_you_mean
from drivax.files import atomic_write, check_output
from drivax.reading import explain_damage, parse_json, read_arrays
from drivax.scenario.store import ScenarioSet, ScenarioWriter
from drivax.seal import edited_files, note_edited, refuse_edited
from drivax.stats.clusters import recordings_of

#: Candidates per selected scenario, among which those that differ are selected.
_CANDIDATES = 4
#: Values of M logs: one log of each of N scenarios, or one log of each of their egos.
Steps = Float[np.ndarray[Any, Any], "M T"]
Valid = Bool[np.ndarray[Any, Any], "M T"]
Scenarios = Float[np.ndarray[Any, Any], " N"]


@dataclass(frozen=True)
class Combination:
    """Weights and aggregators that combine components into scores.

    Attributes:
        weights: Non-negative weight of each component; only their ratios matter.
        scenario: Aggregator of steps: ``max``, ``mean``, ``std``, ``p0`` to ``p100`` (percentile) or ``topN`` (mean of
            the N largest). A string aggregates the combined score. A mapping gives each component its aggregator, and
            the results are weighted. A scenario with several egos has the largest of their scores.
    """

    weights: Mapping[str, float]
    scenario: str | Mapping[str, str] = "max"

    def __post_init__(self) -> None:
        for name, weight in self.weights.items():
            if not 0.0 <= weight < float("inf"):
                raise UsageError(f"the weight of {name!r} is {weight}", cure="use 0 or more, but not inf")
        if not any(self.weights.values()):
            raise UsageError("all weights are 0", cure="give a component a weight above 0")
        aggregators = {"": self.scenario} if isinstance(self.scenario, str) else self.scenario
        for name in aggregators.values():
            _parse_aggregator(name)
        if not isinstance(self.scenario, str) and (missing := set(self.weights) - set(self.scenario)):
            problem = f"missing aggregator for {min(missing)!r}"
            raise UsageError(problem, cure="name an aggregator for each component")

    def check_components(self, available: Collection[str]) -> None:
        """Check that all components with a weight or an aggregator are available."""
        for name in (*self.weights, *(() if isinstance(self.scenario, str) else self.scenario)):
            if name not in available:
                cure = did_you_mean(name, sorted(available))
                raise UsageError(f"unknown component {name!r}", cure=cure)

    def combine(
        self, components: Mapping[str, Steps], valid: Valid, egos: int = 1
    ) -> tuple[Steps, Scenarios]:
        """Return the scores of steps and of scenarios, in [0, 1].

        Invalid steps score 0 and are ignored in scenario scores. Each scenario has ``egos`` consecutive logs.

        Raises:
            UsageError: A component with a weight or an aggregator is missing.
        """
        self.check_components(components)
        shares = {name: weight / sum(self.weights.values()) for name, weight in self.weights.items()}
        steps = sum(share * components[name] for name, share in shares.items())
        # Rounding may make a mean of ones exceed 1.
        steps = np.where(valid, np.minimum(steps, 1.0), 0.0)
        if isinstance(self.scenario, str):
            logs = aggregate(steps, valid, self.scenario)
        else:
            logs = np.zeros(len(steps))
            for name, share in shares.items():
                logs += share * aggregate(components[name], valid, self.scenario[name])
        return steps, np.minimum(logs, 1.0).reshape(-1, egos).max(axis=1)


def _parse_aggregator(name: str) -> tuple[str, int]:
    """Return kind (``mean``, ``std``, ``p`` or ``top``) and number of an aggregator; ``max`` is ``p100``."""
    match = re.fullmatch(r"(p|top)(\d+)", "p100" if name == "max" else name)
    kind, number = (match[1], int(match[2])) if match else (name, 0)
    is_valid = (number <= 100 if kind == "p" else number >= 1) if match else kind in ("mean", "std")
    if not is_valid:
        cure = "use max, mean, std, p0 to p100, or top1, top2, ..."
        raise UsageError(f"unknown aggregator {name!r}", cure=cure)
    return kind, number


def aggregate(steps: Steps, valid: Valid, name: str) -> Float[np.ndarray[Any, Any], " M"]:
    """Aggregate the valid steps of every log; 0 if there are none.

    Percentiles interpolate linearly (NumPy's default); ``std`` is the population standard deviation.
    """
    kind, number = _parse_aggregator(name)
    count = valid.sum(axis=1)
    divisor = np.maximum(count, 1)
    mean = np.where(valid, steps, 0.0).sum(axis=1) / divisor
    if kind == "mean":
        return mean
    if kind == "std":
        return np.sqrt(np.where(valid, (steps - mean[:, None]) ** 2, 0.0).sum(axis=1) / divisor)
    sorted_scores = np.sort(np.where(valid, steps, np.inf), axis=1)
    sorted_scores = np.where(np.isinf(sorted_scores), 0.0, sorted_scores)
    if kind == "top":
        rank = np.arange(steps.shape[1])
        is_largest = (rank < count[:, None]) & (rank >= count[:, None] - number)
        return np.where(is_largest, sorted_scores, 0.0).sum(axis=1) / np.maximum(is_largest.sum(axis=1), 1)
    position = (divisor - 1) * (number / 100.0)
    low = np.floor(position).astype(int)
    high, log = np.minimum(low + 1, divisor - 1), np.arange(len(steps))
    fraction = position - low
    return sorted_scores[log, low] * (1.0 - fraction) + sorted_scores[log, high] * fraction


SCORES_VERSION = 3
#: File name of a subset's scores in its folder.
OWN_SCORES = "scores.npz"
_RERUN = "run `drivax curate` again"
_COMPONENT = "component_"
#: Size limits of a table: bytes of ids and header, and float32 columns of all steps.
_MOST_BYTES, _MOST_COLUMNS = 64 << 20, 64
#: Maximum length of the header in characters; most have less than a thousand.
_MOST_HEADER = 1 << 20


@dataclass(frozen=True)
class ScoreTable:
    """Scores of every scenario and step of a set, in the order of the set.

    Attributes:
        method, config: Name and configuration of the method; ``combination`` holds the arguments of :meth:`recombine`.
        set_hash, scenario_ids: ``ScenarioSet.hash`` of the data, and the ids of its N scenarios.
        valid: Whether ego is observed at the steps of M logs; other steps score 0.
        steps, scenarios: Scores, in [0, 1].
        components: Components of the step scores by name, in [0, 1].
        egos: Logs per scenario: 1, that of the recorded ego, or one for each ego of the set, the recorded one first.
            Scenarios with fewer egos have logs without valid steps.
    """

    method: str
    config: Mapping[str, Any]
    set_hash: str
    scenario_ids: tuple[str, ...]
    valid: Valid
    steps: Steps
    scenarios: Scenarios
    components: Mapping[str, Steps] = field(default_factory=dict)
    egos: int = 1

    @property
    def drawable(self) -> Valid:
        """Mask of steps such that ego is observed at the step and at the next one.

        Training draws fewer steps: those of :func:`drivax.learning.loop.usable_steps`.
        """
        return self.valid & np.pad(self.valid[:, 1:], ((0, 0), (0, 1)))

    @cached_property
    def order(self) -> Int[np.ndarray[Any, Any], " N"]:
        """Indices by descending scenario score; ties by descending mean step score, then by index.

        Scores are compared in float32, the precision of files, so that stored tables have the same order.
        """
        shape, scenarios = (len(self.scenarios), -1), self.scenarios.astype(np.float32)
        steps = self.steps.astype(np.float32).astype(np.float64).reshape(shape)
        return np.lexsort((-aggregate(steps, self.valid.reshape(shape), "mean"), -scenarios))

    @property
    def combination(self) -> Combination:
        """Combination of the components.

        Raises:
            UsageError: The table has no components.
        """
        if "combination" not in self.config:
            problem = f"scores of {self.method!r} have no components to combine"
            raise UsageError(problem, cure="leave out weights and aggregators")
        return Combination(**self.config["combination"])

    def recombine(self, combination: Combination) -> ScoreTable:
        """Return the table with another combination of the same components."""
        steps, scenarios = combination.combine(self.components, self.valid, self.egos)
        config = {**self.config, "combination": asdict(combination)}
        return replace(self, config=config, steps=steps, scenarios=scenarios)


def write_scores(table: ScoreTable, out: Path, overwrite: bool = False) -> None:
    """Write a table as ``.npz``.

    The arrays are ``header`` (JSON), ``scenario_id``, ``valid``, ``step_score``, ``scenario_score``, and
    ``component_NAME`` for each component.

    Raises:
        UsageError: ``out`` is a folder, or exists and ``overwrite`` is not set.
        DataError: A score is not in [0, 1].
    """
    check_output(out, overwrite)
    _check_range(table, None, "report this as a defect of drivax")
    header: dict[str, Any] = {
        "version": SCORES_VERSION, "method": table.method, "config": dict(table.config), "set_hash": table.set_hash,
        "egos": table.egos, "drivax_version": metadata.version("drivax"), "edited": edited_files(),
    }  # fmt: skip
    arrays = {
        "scenario_id": np.array(table.scenario_ids),
        "valid": table.valid,
        "step_score": table.steps.astype(np.float32),
        "scenario_score": table.scenarios.astype(np.float32),
        **{_COMPONENT + name: values.astype(np.float32) for name, values in table.components.items()},
    }
    header["sha256"] = _digest(header, arrays)
    with atomic_write(out) as file:
        np.savez_compressed(file, allow_pickle=False, header=np.array(json.dumps(header)), **arrays)


def read_scores(file: Path, data: ScenarioSet) -> ScoreTable:
    """Read the scores of a set.

    Raises:
        DataError: The table is missing, damaged or edited, has another version, or belongs to another set.
    """
    if not file.is_file():
        cure = "write it with `drivax curate METHOD --data SET --out FILE`"
        raise DataError("score table not found", file=file, cure=cure)
    most_logs = len(data) * data.capacity.egos
    arrays = read_arrays(file, _RERUN, _MOST_BYTES + most_logs * _MOST_COLUMNS * data.capacity.steps * 4)
    with explain_damage(file, _RERUN, "not a score table, or damaged"):
        if (size := arrays["header"].nbytes) > 4 * _MOST_HEADER:  # 4 bytes per character
            raise ValueError(f"a header of {size // 4:,} characters")
        header = parse_json(str(arrays.pop("header")[()]).encode())
        _check_source(header["version"], header["set_hash"], file, data)
        digest = _digest(header, arrays)
        ids = tuple(str(name) for name in arrays.pop("scenario_id"))
        egos = header.get("egos", 1)  # tables of earlier versions score recorded egos
        _check_shapes(ids, arrays, egos, file, data)
        if header.get("sha256", digest) != digest:
            refuse_edited(file, "changed since drivax wrote it")
        edited = header.get("edited", [])
        if not isinstance(edited, list):
            raise ValueError("edited is not a list")
        note_edited(*map(str, edited))
        valid, steps, scenarios = (arrays[name] for name in ("valid", "step_score", "scenario_score"))
        component_names = [name for name in arrays if name.startswith(_COMPONENT)]
        components = {name.removeprefix(_COMPONENT): arrays[name] for name in component_names}
        method, config, set_hash = (header[name] for name in ("method", "config", "set_hash"))
        table = ScoreTable(method, config, set_hash, ids, valid, steps, scenarios, components, egos)
    _check_range(table, file, _RERUN)
    return table


def _digest(header: Mapping[str, Any], arrays: Mapping[str, Any]) -> str:
    """Return the SHA-256 (hex) of header and arrays, except for the entry ``sha256``, which old tables lack."""
    content = {name: value for name, value in header.items() if name != "sha256"}
    digest = hashlib.sha256(json.dumps(content).encode())
    for name in sorted(arrays):
        digest.update(f"{name} {arrays[name].dtype} {arrays[name].shape}".encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _check_source(version: object, set_hash: object, file: Path, data: ScenarioSet) -> None:
    if version != SCORES_VERSION:
        raise DataError(f"version {version}, this drivax reads {SCORES_VERSION}", file=file, cure=_RERUN)
    if set_hash != data.hash:
        subset_scores, short_hash = data.path / OWN_SCORES, str(set_hash)[:12]
        problem = f"scores belong to another set (hash {short_hash}, {data.path} has {data.hash[:12]})"
        has_own = subset_scores.is_file() and not subset_scores.samefile(file)
        cure = f"use {subset_scores}" if has_own else _RERUN
        raise DataError(problem, file=file, cure=cure)


def _check_shapes(
    ids: tuple[str, ...], arrays: Mapping[str, Any], egos: Any, file: Path, data: ScenarioSet
) -> None:
    if type(egos) is not int or egos not in (1, data.capacity.egos):
        raise ValueError(f"{egos} egos per scenario")
    expected_ids = tuple(entry["scenario_id"] for entry in data.entries)
    scenarios, logs = (len(expected_ids),), (len(expected_ids) * egos, data.capacity.steps)
    shapes = {name: scenarios if name == "scenario_score" else logs for name in arrays}
    if ids != expected_ids or any(values.shape != shapes[name] for name, values in arrays.items()):
        raise DataError("does not score every scenario and step of its set", file=file, cure=_RERUN)


def _check_range(table: ScoreTable, file: Path | None, cure: str) -> None:
    for scores in (table.steps, table.scenarios[:, None], *table.components.values()):
        invalid = np.flatnonzero(~((scores >= 0) & (scores <= 1)).all(axis=1))
        if invalid.size:
            record = table.scenario_ids[int(invalid[0]) * len(table.scenario_ids) // len(scores)]
            raise DataError("has a score outside [0, 1]", file=file, record=record, cure=cure)


def check_top(
    data: ScenarioSet, out: Path, count: int, overwrite: bool = False, all_windows: bool = False
) -> None:
    """Check, before any work, that a subset can be written.

    Raises:
        UsageError: ``count`` is below 1, the set has fewer recordings (with ``all_windows``: scenarios), or ``out``
            exists or is the set.
    """
    total, recordings = len(data), len(set(recordings_of(data.entries)))
    if not all_windows and recordings < total and not 1 <= count <= recordings:
        cure = f"ask for 1 to {recordings}"
        if 1 <= count <= total:
            cure += f", or pass --all-windows to choose among all {total} scenarios"
        problem = f"cannot select {count} scenarios from {recordings} recordings, one of each"
        raise UsageError(problem, cure=cure)
    if not 1 <= count <= total:
        raise UsageError(f"cannot select {count} of {total} scenarios", cure=f"ask for 1 to {total}")
    refuse_part(data, out)
    ScenarioWriter(out, data.capacity, overwrite=overwrite)  # checks ``out``, writes nothing


def top_rows(table: ScoreTable, count: int, recordings: Sequence[str] | None = None) -> list[int]:
    """Return the indices of the ``count`` most critical scenarios, or all if fewer, by ``ScoreTable.order``.

    Given the recording of every scenario, only the most critical scenario of each recording is considered.
    """
    indices = table.order
    if recordings is not None:
        first = np.unique(np.asarray(recordings)[indices], return_index=True)[1]
        indices = indices[np.sort(first)]
    return indices[:count].tolist()


def diverse_rows(rows: Sequence[int], embedding: Float[np.ndarray, "N D"], count: int) -> list[int]:
    """Return up to ``count`` scenarios that differ: a greedy k-center of the most critical ones.

    Among the first ``4 count`` of ``rows``, which are in descending order of their scores, the first is selected, then
    always the one that is farthest from those selected (Gonzalez 1985, 2-approximation of the k-center). Scenarios
    with the same embedding as a selected one are duplicates, and left out. The result is in the order of ``rows``.
    """
    candidates = np.asarray(rows[: _CANDIDATES * count])
    values = embedding[candidates].astype(np.float64)
    selected, distance = [0], np.linalg.norm(values - values[0], axis=1)
    while len(selected) < min(count, len(candidates)):
        farthest = int(distance.argmax())
        if distance[farthest] < 1e-6:
            break
        selected.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(values - values[farthest], axis=1))
    return candidates[np.sort(selected)].tolist()


def subset_of_table(table: ScoreTable, indices: Sequence[int], subset: ScenarioSet) -> ScoreTable:
    """Return the scores of a subset that ``write_part`` wrote.

    ``indices`` are the scenarios in the whole set, in the order of the subset. ``part_of`` in the configuration of the
    result identifies the whole set.
    """
    order = list(indices)
    part_of = subset.manifest["source"]["part_of"]
    part_of = {name: value for name, value in part_of.items() if name not in ("method", "config")}
    ids = tuple(table.scenario_ids[index] for index in order)
    logs = (np.array(order)[:, None] * table.egos + np.arange(table.egos)).reshape(-1)
    scores = {"valid": table.valid[logs], "steps": table.steps[logs], "scenarios": table.scenarios[order]}
    components = {name: component[logs] for name, component in table.components.items()}
    config = {**table.config, "part_of": part_of}
    return replace(
        table, config=config, set_hash=subset.hash, scenario_ids=ids, components=components, **scores
    )


def write_top(
    table: ScoreTable, data: ScenarioSet, count: int, out: Path, overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None, all_windows: bool = False,
    embedding: Float[np.ndarray, "N D"] | None = None,
) -> Exported:  # fmt: skip
    """Write the ``count`` most critical scenarios as a scenario set, in descending order, with their scores.

    Without ``all_windows``, only the most critical scenario of each recording is considered. Given an ``embedding`` of
    every scenario, those among the most critical that differ are written (:func:`diverse_rows`), without duplicates.
    ``progress`` is called with (scenarios done, scenarios).

    Raises:
        UsageError: See :func:`check_top`.
    """
    check_top(data, out, count, overwrite, all_windows)
    considered = len(data) if embedding is not None else count
    indices = top_rows(table, considered, None if all_windows else recordings_of(data.entries))
    selection = {
        "most_critical": count, "all_windows": all_windows, "method": table.method, "config": dict(table.config)
    }  # fmt: skip
    if embedding is not None:
        indices, selection["diverse"] = diverse_rows(indices, embedding, count), True

    def write_own_scores(folder: Path) -> None:
        write_scores(subset_of_table(table, indices, ScenarioSet.open(folder)), folder / OWN_SCORES)

    return write_part(data, indices, out, overwrite, progress, selection, write_own_scores)
