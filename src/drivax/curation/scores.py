"""The table of criticality scores of a scenario set: one file that knows which data and method it is of."""

from __future__ import annotations

import json
import os
import tempfile
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
from drivax.errors import DataError, UsageError
from drivax.files import sync_folder
from drivax.scenario.store import ScenarioSet

SCORES_VERSION = 3
#: Scores of a set that was chosen by them, in its folder.
OWN_SCORES = "scores.npz"
_AGAIN = "run `drivax curate` again"
_COMPONENT = "component_"


@dataclass(frozen=True)
class ScoreTable:
    """Scores of every scenario and step of a set, in the set's order.

    Attributes:
        method: How they were made.
        config: Its configuration; ``combination`` is what :meth:`combined` was given.
        set_hash: ``ScenarioSet.hash`` of the data.
        scenario_ids: Of each row.
        valid: Whether ego is there; other steps score 0.
        steps: Score of every step, in [0, 1].
        scenarios: Score of every scenario, in [0, 1].
        components: What the scores are made of, by name, each of every step and in [0, 1].
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
    def drawn(self) -> Bool[np.ndarray[Any, Any], "N T"]:
        """Which steps can be drawn: those at which the log knows what ego did, since it is there one step later too."""
        return self.valid & np.pad(self.valid[:, 1:], ((0, 0), (0, 1)))

    @cached_property
    def order(self) -> Int[np.ndarray[Any, Any], " N"]:
        """Rows, the most critical scenario first; of equal ones that with the larger mean step, then the first.

        Scores are compared as a file holds them (float32), so that a table that was read has the same order.
        """
        steps, scenarios = (part.astype(np.float32) for part in (self.steps, self.scenarios))
        return np.lexsort((-aggregate(steps.astype(np.float64), self.valid, "mean"), -scenarios))

    @property
    def combination(self) -> Combination:
        """How the components became scores."""
        return Combination(**self.config["combination"])

    def combined(self, combination: Combination) -> ScoreTable:
        """The same components, weighted and aggregated otherwise; nothing is scored again.

        Raises:
            UsageError: The table lacks a component.
        """
        steps, scenarios = combination.combine(self.components, self.valid)
        config = {**self.config, "combination": asdict(combination)}
        return replace(self, config=config, steps=steps, scenarios=scenarios)


def write_scores(table: ScoreTable, out: Path, overwrite: bool = False) -> None:
    """Writes a table as ``.npz``.

    It holds ``header`` (JSON), ``scenario_id``, ``valid``, ``step_score``, ``scenario_score``, and of each component
    ``component_NAME``.

    Raises:
        UsageError: ``out`` exists and ``overwrite`` is not given, or is a folder.
        DataError: A score is not in [0, 1].
    """
    refuse_existing(out, overwrite)
    _check_range(table, None, "report this as a defect of drivax")
    header = {
        "version": SCORES_VERSION,
        "method": table.method,
        "config": dict(table.config),
        "set_hash": table.set_hash,
        "drivax_version": metadata.version("drivax"),
    }
    out.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{out.name}.", dir=out.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(
                file,
                allow_pickle=False,
                header=np.array(json.dumps(header)),
                scenario_id=np.array(table.scenario_ids),
                valid=table.valid,
                step_score=table.steps.astype(np.float32),
                scenario_score=table.scenarios.astype(np.float32),
                **{_COMPONENT + name: part.astype(np.float32) for name, part in table.components.items()},
            )
            file.flush()
            os.fsync(file.fileno())
        Path(name).chmod(0o644)
        Path(name).replace(out)
        sync_folder(out.parent)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def refuse_existing(out: Path, overwrite: bool) -> None:
    """Refuses a table that may not be written, before any work is done.

    Raises:
        UsageError: ``out`` is a folder, or exists and ``overwrite`` is not given.
    """
    if out.is_dir():
        raise UsageError("is a folder", file=out, cure="name a file, as scores.npz")
    if out.exists() and not overwrite:
        raise UsageError("exists already", file=out, cure="choose another name or pass --overwrite")


def read_scores(file: Path, data: ScenarioSet) -> ScoreTable:
    """The scores of a set.

    Raises:
        DataError: The table is missing, damaged, of another version, or of other data than ``data``.
    """
    if not file.is_file():
        raise DataError(
            "there are no scores",
            file=file,
            cure="make them with `drivax curate METHOD --data SET --out FILE`",
        )
    try:
        # np.load leaves a file that it opened itself open where it is damaged.
        with file.open("rb") as raw, np.load(raw, allow_pickle=False) as stored:
            header = json.loads(str(stored["header"][()]))
            version, found = header["version"], header["set_hash"]
            ids = tuple(str(name) for name in stored["scenario_id"])
            _check_source(version, found, file, data)
            arrays = {name: stored[name] for name in stored.files if name not in ("header", "scenario_id")}
            _check_shapes(ids, arrays, file, data)
            table = ScoreTable(
                method=header["method"],
                config=header["config"],
                set_hash=found,
                scenario_ids=ids,
                valid=arrays["valid"],
                steps=arrays["step_score"],
                scenarios=arrays["scenario_score"],
                components={
                    name.removeprefix(_COMPONENT): part
                    for name, part in arrays.items()
                    if name.startswith(_COMPONENT)
                },
            )
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(
            f"is no table of scores, or damaged ({type(error).__name__})", file=file, cure=_AGAIN
        ) from error
    _check_range(table, file, _AGAIN)
    return table


def _check_source(version: object, found: object, file: Path, data: ScenarioSet) -> None:
    if version != SCORES_VERSION:
        raise DataError(f"version {version}, this drivax reads {SCORES_VERSION}", file=file, cure=_AGAIN)
    if found != data.hash:
        own = data.path / OWN_SCORES
        raise DataError(
            f"is of other data (hash {str(found)[:12]}, {data.path} has {data.hash[:12]})",
            file=file,
            cure=f"use {own}" if own.is_file() and own != file else _AGAIN,
        )


def _check_shapes(ids: tuple[str, ...], arrays: Mapping[str, Any], file: Path, data: ScenarioSet) -> None:
    wanted = tuple(entry["scenario_id"] for entry in data.entries)
    shape = (len(wanted), data.capacity.steps)
    fits = all(
        part.shape == (shape[:1] if name == "scenario_score" else shape) for name, part in arrays.items()
    )
    if ids != wanted or not fits:
        raise DataError("does not score every scenario and step of its set", file=file, cure=_AGAIN)


def _check_range(table: ScoreTable, file: Path | None, cure: str) -> None:
    for scores in (table.steps, table.scenarios[:, None], *table.components.values()):
        wrong = np.flatnonzero(~((scores >= 0) & (scores <= 1)).all(axis=1))
        if wrong.size:
            record = table.scenario_ids[int(wrong[0])]
            raise DataError("has a score outside [0, 1]", file=file, record=record, cure=cure)
