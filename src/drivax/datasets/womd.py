"""What the two forms of the Waymo Open Motion Dataset share: telling them apart, reading records, object types."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from drivax.datasets.messages import example_class, parse, scenario_class
from drivax.datasets.reader import BadRecord
from drivax.datasets.tfrecord import read_records
from drivax.errors import DataError, DrivaxError
from drivax.scenario.recording import Recording
from drivax.scenario.schema import AgentKind

DATASET = "womd"
SCENARIO_FORMAT, EXAMPLE_FORMAT = "womd-scenario", "womd-example"
#: Shards are called ``...tfrecord-00000-of-01000``, samples ``....tfrecord``.
PATTERNS = ("*.tfrecord", "*.tfrecord-*", "*.tfrecords")
_CONTENTS = {SCENARIO_FORMAT: "WOMD Scenario protos", EXAMPLE_FORMAT: "WOMD tf.Examples"}


def flavour(payload: bytes) -> str | None:
    """The format of a record's payload by its content, None where it is neither form of WOMD motion data."""
    example = parse(example_class(), payload)
    if example is not None and any(entry.key == "state/current/x" for entry in example.features.feature):
        return EXAMPLE_FORMAT
    scenario = parse(scenario_class(), payload)
    if scenario is not None and scenario.scenario_id and scenario.tracks:
        return SCENARIO_FORMAT
    return None


def recognise(path: Path, name: str) -> bool:
    """Whether the first readable record of a TFRecord file is of the format ``name``."""
    try:
        for _, record in read_records(path):
            if isinstance(record, bytes):
                return flavour(record) == name
    except DataError:
        return False
    return False


def read(path: Path, name: str, decode: Callable[[bytes], Recording]) -> Iterator[Recording | BadRecord]:
    """The recordings of a TFRecord file whose payloads ``decode`` reads, and bad records in their places."""
    for number, record in read_records(path):
        if isinstance(record, DataError):
            yield BadRecord.of(record, path, number)
            continue
        try:
            yield decode(record)
        except DataError as error:
            yield BadRecord.of(explain(error, record, name), path, number)


def explain(error: DataError, payload: bytes, name: str) -> DrivaxError:
    """The error, or a better one where the payload is of the other form of WOMD."""
    other = flavour(payload)
    if other is None or other == name:
        return error
    return DataError(f"holds {_CONTENTS[other]}, not {_CONTENTS[name]}", cure=f"use --format {other}")


def agent_kind(code: int) -> AgentKind:
    """The class of a WOMD object type; 0 (unset) and codes of later versions count as other."""
    return AgentKind(code) if 1 <= code <= 4 else AgentKind.OTHER
