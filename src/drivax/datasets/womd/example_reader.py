"""Reader of WOMD tf.Examples in TFRecord files (motion dataset v1.0 to v1.3.1).

They hold less than the protos: at most 128 tracks, no lane graph, no speed limits, no lanes of stop signs, the map
as one list of points that the writer cut off at 20,000 or 30,000, and at most 16 lights per step.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivax.datasets.reader import Description
from drivax.datasets.womd import records as womd
from drivax.datasets.womd import tf_example
from drivax.datasets.womd.tfrecord import count_records
from drivax.scenario.recording import Recording
from drivax.scenario.schema import Flag


@dataclass(frozen=True)
class WomdExample(womd.TfRecordReader):
    """Reads tf.Examples: tracks, map points grouped into features, lights re-keyed by lane."""

    name: str = womd.EXAMPLE_FORMAT
    companions: tuple[str, ...] = ("export.json",)

    def decode(self, payload: bytes) -> Recording:
        """Return the recording in a payload."""
        return decode(payload)

    def describe(self, path: Path) -> Description:
        """What the first record shows: version by sampling and features, truncated map, paths."""
        recording = self.first(path)
        notes = [
            *womd.notes_of(recording),
            "no lane graph and no speed limits: lanes are chained by geometry",
        ]
        if Flag.TRUNCATED_MAP in recording.flags:
            notes.append(
                "the list of map points is full, the map is cut off; the Scenario protos hold all of it"
            )
        if "paths" in recording.lost:
            notes.append("path_samples are not used: routes are computed again")
        newer = bool(recording.features) and tf_example.is_coarse(recording.features)
        return Description(
            dataset=womd.FULL_NAME,
            flavour="tf.Examples in TFRecord",
            version=None if not recording.features else "1.2 or later" if newer else "1.0 or 1.1",
            recordings=count_records(path),
            notes=tuple(notes),
        )


def decode(payload: bytes) -> Recording:
    """Return the recording in a serialised tf.Example; rows without an id are padding."""
    table = tf_example.features_of(payload)
    used = np.flatnonzero(table.numbers("state/id") != -1)
    return tf_example.recording(table, payload, used, womd.DATASET, womd.EXAMPLE_FORMAT)
