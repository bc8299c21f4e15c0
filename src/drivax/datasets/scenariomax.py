"""Reader of ScenarioMax's tf.Examples in TFRecord files, the ones that V-Max reads.

They have WOMD's layout (``womd.example_reader``) with differences: the ego is row 0 and ids are renumbered from 0,
padding looks like tracks, there are no times, speeds or courses, limits come with the map's points in mph, lights keep
their slot and are UNKNOWN where nothing was known, and ten paths of the ego are included. Where the data came from
(WOMD, nuPlan, nuScenes, ...) is not in the file.
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
from drivax.scenario.recording import Light, Recording, Tracks
from drivax.scenario.schema import Flag, LightState


@dataclass(frozen=True)
class ScenarioMax(womd.TfRecordReader):
    """Reads ScenarioMax's tf.Examples: tracks, map with limits, lights by lane."""

    name: str = womd.SCENARIOMAX_FORMAT

    def decode(self, payload: bytes) -> Recording:
        """Return the recording in a payload."""
        return decode(payload)

    def describe(self, path: Path) -> Description:
        """What the first record shows."""
        recording = self.first(path)
        notes = [*womd.notes_of(recording), "the file does not say which data set its scenarios come from"]
        limited = sum(feature.limit_mps is not None for feature in recording.features)
        notes.append(f"{limited} lanes have a speed limit; no lane graph: lanes are chained by geometry")
        if Flag.TRUNCATED_MAP in recording.flags:
            notes.append("the list of map points is full, the map is cut off")
        if "paths" in recording.lost:
            notes.append(
                "path_samples are not used (they were ranked by the log's future): routes are computed again"
            )
        return Description(
            dataset="ScenarioMax",
            flavour="tf.Examples in TFRecord",
            recordings=count_records(path),
            notes=tuple(notes),
        )


def decode(payload: bytes) -> Recording:
    """Return the recording in a serialised tf.Example of ScenarioMax.

    Rows that are never valid are padding. Speed limits become m/s by lane, -1 mph is unknown; missing times are
    10 Hz; velocities that are missing (-1 throughout) are differentiated from positions.
    """
    table = tf_example.features_of(payload)
    rows = np.arange(table.numbers("state/id").size)
    used = np.flatnonzero((table.over_time("valid", rows) == 1).any(axis=1))
    recording = tf_example.recording(table, payload, used, womd.SCENARIOMAX_FORMAT, womd.SCENARIOMAX_FORMAT)
    tracks, differentiated = _with_velocities(recording.tracks, recording.timestamps_s)
    lights, unknown = _known(recording.lights)
    return replace(
        recording,
        tracks=tracks,
        lights=lights,
        lost={**recording.lost, **parsing.nonzero(lights_without_state=unknown)},
        flags=recording.flags | (Flag.DIFFERENTIATED_VELOCITY if differentiated else Flag.NONE),
    )


def _with_velocities(tracks: Tracks, times: tf_example.Array) -> tuple[Tracks, bool]:
    """The tracks, and whether their velocities had to be made from positions because the file has none."""
    if not tracks.valid.any() or (tracks.velocity[tracks.valid] != -1.0).any():
        return tracks, False
    return replace(tracks, velocity=parsing.differentiate(tracks.xy, tracks.valid, times)), True


def _known(lights: tuple[Light, ...]) -> tuple[tuple[Light, ...], int]:
    """Lights with some known state, and the number of the others.

    The writer fills what it does not know with UNKNOWN, yellow of some sources included. A light that is UNKNOWN
    throughout says nothing; one that is known at times keeps its UNKNOWN.
    """
    kept = tuple(light for light in lights if (light.states > LightState.UNKNOWN).any())
    return kept, len(lights) - len(kept)
