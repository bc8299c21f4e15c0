"""Common parts of the formats of motion data in TFRecord files: detection, base of the readers, object types, notes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivax.datasets import parsing
from drivax.datasets.reader import BadRecord, attempt
from drivax.datasets.womd.messages import ExampleFeatures, parse
from drivax.datasets.womd.tfrecord import count_records, looks_framed, read_records
from drivax.errors import DataError, DrivaxError, UsageError
from drivax.scenario.recording import Recording, is_even
from drivax.scenario.schema import LEAST_STEPS, AgentKind

DATASET = "womd"
FULL_NAME = "Waymo Open Motion Dataset"
SCENARIO_FORMAT, EXAMPLE_FORMAT, SCENARIOMAX_FORMAT = "womd-scenario", "womd-example", "scenariomax"
#: Shards are called ``...tfrecord-00000-of-01000``, samples ``....tfrecord``.
PATTERNS = ("*.tfrecord", "*.tfrecord-*", "*.tfrecords")
_CONTENTS = {
    SCENARIO_FORMAT: "WOMD Scenario protos",
    EXAMPLE_FORMAT: "WOMD tf.Examples",
    SCENARIOMAX_FORMAT: "ScenarioMax tf.Examples",
}
#: Signs of ScenarioMax's writer that an example must show; a single one may be damage or another exporter.
_SIGNS = 2


def format_of(payload: bytes) -> str | None:
    """Return the name of a payload's format by its content; None for anything but motion data."""
    example = parse("Example", payload)
    if example is not None and any(entry.key == "state/current/x" for entry in example.features.feature):
        return SCENARIOMAX_FORMAT if scenariomax_signs(ExampleFeatures(example)) >= _SIGNS else EXAMPLE_FORMAT
    scenario = parse("Scenario", payload)
    if scenario is not None and scenario.scenario_id and scenario.tracks:
        return SCENARIO_FORMAT
    return None


def scenariomax_signs(features: ExampleFeatures) -> int:
    """Count how many of ScenarioMax's three signs an example shows; WOMD's examples show none.

    The signs: the prediction difficulty is missing; the ids of tracks that are valid at the current step equal their
    rows, and the ego is row 0; all times of the current step are negative.
    """
    ids_are_rows = has_no_times = False
    with suppress(DataError):
        ids, valid = features.numbers("state/id"), features.numbers("state/current/valid") == 1
        rows = np.flatnonzero(valid) if valid.size == ids.size else np.zeros(0, np.int64)
        ego = np.flatnonzero(features.numbers("state/is_sdc") == 1)
        ids_are_rows = rows.size > 0 and bool((ids[rows] == rows).all()) and ego.tolist() == [0]
        has_no_times = bool((features.numbers("state/current/timestamp_micros") < 0).all())
    return sum((not features.has("state/difficulty_level"), ids_are_rows, has_no_times))


def _first(path: Path) -> bytes:
    """Return the payload of the first readable record; without any, raise the error of the first record."""
    damage = None
    for _, record in read_records(path):
        if isinstance(record, bytes):
            return record
        damage = damage or record
    raise damage or DataError("the file is empty", file=path, cure="download it again")


@dataclass(frozen=True)
class TfRecordReader:
    """Base of the readers of TFRecord files with one recording per record."""

    name: str
    patterns: tuple[str, ...] = PATTERNS
    companions: tuple[str, ...] = ()

    def decode(self, payload: bytes) -> Recording:
        """Return the recording in a payload."""
        raise NotImplementedError

    def recognise(self, path: Path) -> bool:
        """Return whether the first readable record is of this format; never raises."""
        try:
            return looks_framed(path) and format_of(_first(path)) == self.name
        except UsageError:
            # A package is missing: claim the file as Scenario protos; reading it then reports the package.
            return self.name == SCENARIO_FORMAT
        except DataError:
            return False

    def first(self, path: Path) -> Recording:
        """Return the recording of the first readable record."""
        recording = attempt(self._decode, _first(path), file=path)
        if isinstance(recording, BadRecord):
            raise recording.error()
        return recording

    def count(self, path: Path) -> int:
        """Return the number of records times the windows of the first readable one; 0 if it cannot be decoded."""
        try:
            return count_records(path) * parsing.windows_of(len(self.decode(_first(path)).timestamps_s))
        except DrivaxError:
            return 0

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """Yield the recordings, and a bad record in place of each that cannot be decoded."""
        for number, payload in read_records(path):
            if isinstance(payload, DataError):
                yield BadRecord.of(payload, path, number)
            else:
                yield attempt(self._decode, payload, file=path, record=number)

    def _decode(self, payload: bytes) -> Recording:
        """Return the recording in a payload; for a payload of another known format the error names that format."""
        try:
            return self.decode(payload)
        except DataError as error:
            content = format_of(payload)
            if content in (None, self.name):
                raise
            problem = f"contains {_CONTENTS[content]}, not {_CONTENTS[self.name]}"
            raise DataError(problem, cure=f"use --format {content}") from error


def agent_kind(code: int) -> AgentKind:
    """Return the class of a WOMD object type from 1 to 4 (other); 0 (unset) and codes of later versions are OTHER."""
    return AgentKind(code) if 1 <= code <= 4 else AgentKind.OTHER


def notes_of(recording: Recording) -> tuple[str, ...]:
    """Return notes for users about a file, from its first recording: length, windows, lights, spacing of frames."""
    steps, now = len(recording.timestamps_s), recording.current_step
    notes = [f"{steps} steps, current step {now}"]
    if parsing.windows_of(steps) > 1:
        notes.append(f"each recording becomes {parsing.windows_of(steps)} windows of 91 steps")
    elif steps < LEAST_STEPS:
        notes.append(f"fewer than {LEAST_STEPS} steps: stored, but refused for training and evaluation")
    if not recording.lights:
        notes.append("no traffic lights in the first record")
    if not is_even(recording.timestamps_s):
        notes.append(parsing.UNEVEN)
    return tuple(notes)
