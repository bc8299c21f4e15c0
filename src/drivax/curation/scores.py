"""The table of criticality scores of a scenario set: one file that knows which data and method it is of."""

from __future__ import annotations

import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from drivax.errors import DataError, UsageError
from drivax.scenario.partial import sync_folder
from drivax.scenario.store import ScenarioSet

SCORES_VERSION = 1
_AGAIN = "run `drivax curate` again"


@dataclass(frozen=True)
class ScoreTable:
    """Scores of every scenario and step of a set, in the set's order.

    Attributes:
        method: How they were made.
        config: Its configuration.
        set_hash: ``ScenarioSet.hash`` of the data.
        scenario_ids: Of each row.
        steps: Score of every step, in [0, 1].
    """

    method: str
    config: Mapping[str, Any]
    set_hash: str
    scenario_ids: tuple[str, ...]
    steps: Float[np.ndarray[Any, Any], "N T"]

    @property
    def scenarios(self) -> Float[np.ndarray[Any, Any], " N"]:
        """Score of every scenario: the largest of its steps."""
        return self.steps.max(axis=1)


def write_scores(table: ScoreTable, out: Path, overwrite: bool = False) -> None:
    """Writes a table as ``.npz``: ``header`` (JSON), ``scenario_id``, ``step_score``, ``scenario_score``.

    Raises:
        UsageError: ``out`` exists and ``overwrite`` is not given, or is a folder.
        DataError: A score is not in [0, 1].
    """
    refuse_existing(out, overwrite)
    wrong = np.flatnonzero(~((table.steps >= 0) & (table.steps <= 1)).all(axis=1))
    if wrong.size:
        raise DataError(
            "has a score outside [0, 1]",
            record=table.scenario_ids[int(wrong[0])],
            cure="report this as a defect of drivax",
        )
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
                step_score=table.steps.astype(np.float32),
                scenario_score=table.scenarios.astype(np.float32),
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
            ids = tuple(str(name) for name in stored["scenario_id"])
            steps = stored["step_score"]
        version, found = header["version"], header["set_hash"]
        table = ScoreTable(header["method"], header["config"], found, ids, steps)
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(
            f"is no table of scores, or damaged ({type(error).__name__})", file=file, cure=_AGAIN
        ) from error
    if version != SCORES_VERSION:
        raise DataError(f"version {version}, this drivax reads {SCORES_VERSION}", file=file, cure=_AGAIN)
    if found != data.hash:
        raise DataError(
            f"is of other data (hash {str(found)[:12]}, {data.path} has {data.hash[:12]})",
            file=file,
            cure=_AGAIN,
        )
    _check(table, file, data)
    return table


def _check(table: ScoreTable, file: Path, data: ScenarioSet) -> None:
    wanted = tuple(entry["scenario_id"] for entry in data.entries)
    if table.scenario_ids != wanted or table.steps.shape != (len(wanted), data.capacity.steps):
        raise DataError("does not score every scenario and step of its set", file=file, cure=_AGAIN)
    wrong = np.flatnonzero(~((table.steps >= 0) & (table.steps <= 1)).all(axis=1))
    if wrong.size:
        raise DataError("has a score outside [0, 1]", file=file, record=wanted[int(wrong[0])], cure=_AGAIN)
