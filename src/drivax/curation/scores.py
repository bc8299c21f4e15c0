"""Score tables: criticality scores of a scenario set, in a file that names their data and method."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from drivax.curation.combining import Combination, aggregate
from drivax.errors import DataError
from drivax.files import atomic_write, check_output
from drivax.scenario.store import ScenarioSet

SCORES_VERSION = 3
#: File name of the scores of an exported subset, in its folder.
OWN_SCORES = "scores.npz"
_AGAIN = "run `drivax curate` again"
_COMPONENT = "component_"


@dataclass(frozen=True)
class ScoreTable:
    """Scores of every scenario and step of a set, in the set's order.

    Attributes:
        method: Name of the method.
        config: Its configuration; ``combination`` holds the arguments of :meth:`combined`.
        set_hash: ``ScenarioSet.hash`` of the data.
        scenario_ids: Id of each scenario.
        valid: Whether ego is observed; other steps score 0.
        steps: Score of every step, in [0, 1].
        scenarios: Score of every scenario, in [0, 1].
        components: Components of the scores by name, of every step, in [0, 1].
    """

    method: str
    config: Mapping[str, Any]
    set_hash: str
    scenario_ids: tuple[str, ...]
    valid: Bool[np.ndarray[Any, Any], "N T"]
    steps: Float[np.ndarray[Any, Any], "N T"]
    scenarios: Float[np.ndarray[Any, Any], " N"]
    components: Mapping[str, Float[np.ndarray[Any, Any], "N T"]] = field(default_factory=dict)

    @property
    def drawable(self) -> Bool[np.ndarray[Any, Any], "N T"]:
        """Steps that can be drawn: ego is observed at the next step too, so its action is known."""
        return self.valid & np.pad(self.valid[:, 1:], ((0, 0), (0, 1)))

    @cached_property
    def order(self) -> Int[np.ndarray[Any, Any], " N"]:
        """Indices by descending scenario score; ties by descending mean step score, then by index.

        Scores are compared in float32, as files store them, so that a table that was read has the same order.
        """
        steps, scenarios = (scores.astype(np.float32) for scores in (self.steps, self.scenarios))
        return np.lexsort((-aggregate(steps.astype(np.float64), self.valid, "mean"), -scenarios))

    @property
    def combination(self) -> Combination:
        """How the components became scores."""
        return Combination(**self.config["combination"])

    def combined(self, combination: Combination) -> ScoreTable:
        """Return the scores of another combination of the same components."""
        steps, scenarios = combination.combine(self.components, self.valid)
        config = {**self.config, "combination": asdict(combination)}
        return replace(self, config=config, steps=steps, scenarios=scenarios)


def write_scores(table: ScoreTable, out: Path, overwrite: bool = False) -> None:
    """Write a table as ``.npz``.

    It holds ``header`` (JSON), ``scenario_id``, ``valid``, ``step_score``, ``scenario_score``, and ``component_NAME``
    of each component.

    Raises:
        UsageError: ``out`` exists and ``overwrite`` is not given, or is a folder.
        DataError: A score is not in [0, 1].
    """
    check_output(out, overwrite)
    _check_range(table, None, "report this as a defect of drivax")
    header = {
        "version": SCORES_VERSION,
        "method": table.method,
        "config": dict(table.config),
        "set_hash": table.set_hash,
        "drivax_version": metadata.version("drivax"),
    }
    with atomic_write(out) as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            header=np.array(json.dumps(header)),
            scenario_id=np.array(table.scenario_ids),
            valid=table.valid,
            step_score=table.steps.astype(np.float32),
            scenario_score=table.scenarios.astype(np.float32),
            **{_COMPONENT + name: values.astype(np.float32) for name, values in table.components.items()},
        )


def read_scores(file: Path, data: ScenarioSet) -> ScoreTable:
    """Read the scores of a set.

    Raises:
        DataError: The table is missing, damaged, of another version, or of other data than ``data``.
    """
    if not file.is_file():
        raise DataError(
            "score table not found",
            file=file,
            cure="write it with `drivax curate METHOD --data SET --out FILE`",
        )
    try:
        # np.load does not close a damaged file that it opened itself.
        with file.open("rb") as raw, np.load(raw, allow_pickle=False) as stored:
            header = json.loads(str(stored["header"][()]))
            ids = tuple(str(name) for name in stored["scenario_id"])
            _check_source(header["version"], header["set_hash"], file, data)
            arrays = {name: stored[name] for name in stored.files if name not in ("header", "scenario_id")}
            _check_shapes(ids, arrays, file, data)
            table = ScoreTable(
                method=header["method"],
                config=header["config"],
                set_hash=header["set_hash"],
                scenario_ids=ids,
                valid=arrays["valid"],
                steps=arrays["step_score"],
                scenarios=arrays["scenario_score"],
                components={
                    name.removeprefix(_COMPONENT): values
                    for name, values in arrays.items()
                    if name.startswith(_COMPONENT)
                },
            )
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(
            f"not a score table, or damaged ({type(error).__name__})", file=file, cure=_AGAIN
        ) from error
    _check_range(table, file, _AGAIN)
    return table


def _check_source(version: object, set_hash: object, file: Path, data: ScenarioSet) -> None:
    if version != SCORES_VERSION:
        raise DataError(f"version {version}, this drivax reads {SCORES_VERSION}", file=file, cure=_AGAIN)
    if set_hash != data.hash:
        own = data.path / OWN_SCORES
        raise DataError(
            f"scores are of other data (hash {str(set_hash)[:12]}, {data.path} has {data.hash[:12]})",
            file=file,
            cure=f"use {own}" if own.is_file() and own != file else _AGAIN,
        )


def _check_shapes(ids: tuple[str, ...], arrays: Mapping[str, Any], file: Path, data: ScenarioSet) -> None:
    expected = tuple(entry["scenario_id"] for entry in data.entries)
    shape = (len(expected), data.capacity.steps)
    fits = all(
        values.shape == (shape[:1] if name == "scenario_score" else shape) for name, values in arrays.items()
    )
    if ids != expected or not fits:
        raise DataError("does not score every scenario and step of its set", file=file, cure=_AGAIN)


def _check_range(table: ScoreTable, file: Path | None, cure: str) -> None:
    for scores in (table.steps, table.scenarios[:, None], *table.components.values()):
        wrong = np.flatnonzero(~((scores >= 0) & (scores <= 1)).all(axis=1))
        if wrong.size:
            record = table.scenario_ids[int(wrong[0])]
            raise DataError("has a score outside [0, 1]", file=file, record=record, cure=cure)
