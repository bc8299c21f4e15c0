"""Reader of WOMD tf.Examples in TFRecord files (motion dataset v1.0 to v1.3.1).

They hold less than the protos: at most 128 tracks, no lane graph, no speed limits, no lanes of stop signs, the map
as one list of points that the writer cut off at 20,000 or 30,000, and at most 16 lights per step.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivax.datasets.reader import BadRecord, Description
from drivax.datasets.womd import records as womd
from drivax.datasets.womd import tf_example
from drivax.datasets.womd.tfrecord import count_records
from drivax.scenario.recording import Recording
from drivax.scenario.schema import Flag


@dataclass(frozen=True)
class WomdExample:
    """Reads tf.Examples: tracks, map points grouped into features, lights re-keyed by lane."""

    name: str = womd.EXAMPLE_FORMAT
    patterns: tuple[str, ...] = womd.PATTERNS
    companions: tuple[str, ...] = ("export.json",)

    def recognise(self, path: Path) -> bool:
        """Whether the first readable record is a tf.Example of the motion dataset."""
        return womd.recognise(path, self.name)

    def describe(self, path: Path) -> Description:
        """What the first record shows: version by sampling and features, truncated map, paths."""
        recording = womd.first_recording(path, self.name, decode)
        notes = [
            *womd.notes_of(recording),
            "no lane graph and no speed limits: lanes are chained by geometry",
        ]
        if Flag.TRUNCATED_MAP in recording.flags:
            notes.append(
                "the list of map points is full, the map is cut off; the Scenario protos hold all of it"
            )
        if "paths" in recording.lost:
            notes.append("path_samples are not used: routes are made anew")
        newer = bool(recording.features) and tf_example.is_coarse(recording.features)
        return Description(
            dataset=womd.FULL_NAME,
            flavour="tf.Examples in TFRecord",
            version=None if not recording.features else "1.2 or later" if newer else "1.0 or 1.1",
            recordings=count_records(path),
            notes=tuple(notes),
        )

    def count(self, path: Path) -> int:
        """Records times windows of the first; 0 where it cannot be read."""
        return womd.count(path, decode)

    def read(self, path: Path) -> Iterator[Recording | BadRecord]:
        """The recordings of one file, and in their place the records that cannot be read."""
        return womd.read(path, self.name, decode)


def decode(payload: bytes) -> Recording:
    """The recording in a serialised tf.Example.

    Padding rows are dropped; the ego row, rows to predict and of interest are numbered among the rest. Invalid
    entries (-1 in the file) are zeros, headings are wrapped. Lights are keyed by lane id because the 16 slots are
    used by different lanes over time. ``path_samples`` are counted as lost: which of them is the route was marked
    with the log's future.
    """
    table = tf_example.features_of(payload)
    used = np.flatnonzero(table.numbers("state/id") != -1)
    track_id = tf_example.track_ids(table, used)
    tracks = tf_example.tracks(table, used, track_id)
    features, truncated = tf_example.map_features(table)
    scenario_id = table.scenario_id(payload)
    return Recording(
        scenario_id=scenario_id,
        dataset=womd.DATASET,
        segment=scenario_id,
        timestamps_s=tf_example.timestamps(table, used, tracks.valid),
        current_step=table.spans["past"],
        ego=tf_example.ego_row(table, used),
        tracks=tracks,
        features=features,
        lights=tf_example.lights(table),
        to_predict=table.marked("state/tracks_to_predict", used),
        of_interest=table.marked("state/objects_of_interest", used),
        tags={"source_format": womd.EXAMPLE_FORMAT},
        lost=tf_example.lost(table, features),
        flags=Flag.TRUNCATED_MAP if truncated else Flag.NONE,
        split_gap_m=tf_example.split_gap_m(features),
    )
