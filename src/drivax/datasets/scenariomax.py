"""Reader of ScenarioMax's tf.Examples in TFRecord files, the ones that V-Max reads.

They have WOMD's layout (``womd_example``) with differences: the ego is row 0 and ids are renumbered from 0, padding
looks like tracks, there are no times, speeds or courses, limits come with the map's points in mph, lights keep their
slot and are UNKNOWN where nothing was known, and ten paths of the ego are included. Where the data came from (WOMD,
nuPlan, nuScenes, ...) is not in the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drivax.datasets import parsing as readings
from drivax.datasets.reader import BadRecord, Description
from drivax.datasets.womd import records as womd
from drivax.datasets.womd import tf_example
from drivax.datasets.womd.tfrecord import count_records
from drivax.scenario.recording import Light, Recording, Tracks
from drivax.scenario.schema import Flag, LightState


@dataclass(frozen=True)
class ScenarioMax:
    """Reads ScenarioMax's tf.Examples: tracks, map with limits, lights by lane."""

    name: str = womd.SCENARIOMAX_FORMAT
    patterns: tuple[str, ...] = womd.PATTERNS
    companions: tuple[str, ...] = ()

    def recognise(self, path: Path) -> bool:
        """Whether the first readable record was written by ScenarioMax (``womd.scenariomax_signs``)."""
        return womd.recognise(path, self.name)

    def describe(self, path: Path) -> Description:
        """What the first record shows."""
        recording = womd.first_recording(path, self.name, decode)
        notes = [*womd.notes_of(recording), "the file does not say which data set its scenarios come from"]
        limited = sum(feature.limit_mps is not None for feature in recording.features)
        notes.append(f"{limited} lanes have a speed limit; no lane graph: lanes are chained by geometry")
        if Flag.TRUNCATED_MAP in recording.flags:
            notes.append("the list of map points is full, the map is cut off")
        if "paths" in recording.lost:
            notes.append(
                "path_samples are not used (they were ranked by the log's future): routes are made anew"
            )
        return Description(
            dataset="ScenarioMax",
            flavour="tf.Examples in TFRecord",
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
    """The recording in a serialised tf.Example of ScenarioMax.

    Rows that are never valid are padding. Speed limits become m/s by lane, -1 mph is unknown; missing times are
    10 Hz; velocities that are missing (-1 throughout) are differentiated from positions.
    """
    table = tf_example.features_of(payload)
    rows = np.arange(table.numbers("state/id").size)
    used = np.flatnonzero((table.over_time("valid", rows) == 1).any(axis=1))
    tracks = tf_example.tracks(table, used, tf_example.track_ids(table, used))
    times = tf_example.timestamps(table, used, tracks.valid)
    tracks, differentiated = _with_velocities(tracks, times)
    features, truncated = tf_example.map_features(table)
    lights, dark = _known(tf_example.lights(table))
    scenario_id = table.scenario_id(payload)
    flags = Flag.TRUNCATED_MAP if truncated else Flag.NONE
    return Recording(
        scenario_id=scenario_id,
        dataset=womd.SCENARIOMAX_FORMAT,
        segment=scenario_id,
        timestamps_s=times,
        current_step=table.spans["past"],
        ego=tf_example.ego_row(table, used),
        tracks=tracks,
        features=features,
        lights=lights,
        to_predict=table.marked("state/tracks_to_predict", used),
        of_interest=table.marked("state/objects_of_interest", used),
        tags={"source_format": womd.SCENARIOMAX_FORMAT},
        lost=tf_example.lost(table, features) | readings.counted(lights_without_state=dark),
        flags=flags | (Flag.DIFFERENTIATED_VELOCITY if differentiated else Flag.NONE),
        split_gap_m=tf_example.split_gap_m(features),
    )


def _with_velocities(tracks: Tracks, times: tf_example.Array) -> tuple[Tracks, bool]:
    """The tracks, and whether their velocities had to be made from positions because the file has none."""
    if not tracks.valid.any() or (tracks.velocity[tracks.valid] != -1.0).any():
        return tracks, False
    return replace(tracks, velocity=readings.differentiate(tracks.xy, tracks.valid, times)), True


def _known(lights: tuple[Light, ...]) -> tuple[tuple[Light, ...], int]:
    """Lights with some known state, and the number of the others.

    The writer fills what it does not know with UNKNOWN, yellow of some sources included. A light that is UNKNOWN
    throughout says nothing; one that is known at times keeps its UNKNOWN.
    """
    kept = tuple(light for light in lights if (light.states > LightState.UNKNOWN).any())
    return kept, len(lights) - len(kept)
