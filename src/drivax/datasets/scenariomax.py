"""Reader of ScenarioMax's tf.Examples in TFRecord files, which V-Max reads.

They have WOMD's layout (``womd.example_reader``) with differences: ego is row 0, ids are renumbered from 0, padding
looks like tracks, times, speeds and courses are missing, map points have limits in mph, lights keep their slot and are
UNKNOWN where nothing was known, ten paths of ego are included, and the original data set is not named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drivax.datasets import parsing
from drivax.datasets.reader import Description
from drivax.datasets.womd import example_reader as tf_example
from drivax.datasets.womd import records as womd
from drivax.datasets.womd.tfrecord import count_records
from drivax.scenario.recording import Recording, differentiate
from drivax.scenario.schema import Flag, LightState


@dataclass(frozen=True)
class ScenarioMax(womd.TfRecordReader):
    """Reads ScenarioMax's tf.Examples: tracks, map with limits, lights by lane."""

    name: str = womd.SCENARIOMAX_FORMAT

    def decode(self, payload: bytes) -> Recording:
        """Return the recording in a payload."""
        return decode(payload)

    def describe(self, path: Path) -> Description:
        """Describe the file by its first record."""
        recording = self.first(path)
        notes = [*womd.notes_of(recording), "the file does not say which data set its scenarios come from"]
        limits = sum(feature.limit_mps is not None for feature in recording.features)
        notes.append(f"{limits} lanes have a speed limit; no lane graph: lanes are chained by geometry")
        if Flag.TRUNCATED_MAP in recording.flags:
            notes.append("the list of map points is full, the map is cut off")
        if "paths" in recording.lost:
            note = (
                "path_samples are not used (they were ranked by the log's future): routes are computed again"
            )
            notes.append(note)
        return Description("ScenarioMax", "tf.Examples in TFRecord", None, count_records(path), tuple(notes))


def decode(payload: bytes) -> Recording:
    """Return the recording in a serialised tf.Example of ScenarioMax.

    Rows that are never valid are padding. Speed limits become m/s by lane, -1 mph is unknown; missing times are
    10 Hz; missing velocities (-1 throughout) are differentiated from positions. Lights that are UNKNOWN throughout are
    dropped: the writer fills with UNKNOWN what it does not know, for some sources also yellow.
    """
    table = tf_example.features_of(payload)
    all_rows = np.arange(table.numbers("state/id").size)
    rows = np.flatnonzero((table.over_time("valid", all_rows) == 1).any(axis=1))
    recording = tf_example.recording(table, payload, rows, womd.SCENARIOMAX_FORMAT, womd.SCENARIOMAX_FORMAT)
    tracks, flags = recording.tracks, recording.flags
    if tracks.valid.any() and (tracks.velocity[tracks.valid] == -1.0).all():
        velocity = differentiate(tracks.xy, tracks.valid, recording.timestamps_s)
        tracks, flags = replace(tracks, velocity=velocity), flags | Flag.DIFFERENTIATED_VELOCITY
    lights = tuple(light for light in recording.lights if (light.states > LightState.UNKNOWN).any())
    unknown = parsing.nonzero(lights_without_state=len(recording.lights) - len(lights))
    return replace(recording, tracks=tracks, lights=lights, lost={**recording.lost, **unknown}, flags=flags)
