"""The reader of ScenarioMax's tf.Examples against records made from its published description."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from drivax.datasets.reader import BadRecord, Reader
from drivax.datasets.womd.example_reader import ScenarioMax, WomdExample
from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.datasets.womd.tfrecord import format_of
from drivax.errors import DataError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Recording
from drivax.scenario.schema import AgentKind, Flag, RoadKind

decode = ScenarioMax().decode


@pytest.fixture(scope="module")
def recording(wire) -> Recording:
    return decode(wire.scenariomax())


def by_span(wire, name: str, make) -> dict[str, bytes]:
    """A state feature replaced in every span by ``make(number of cells)``."""
    return {f"state/{span}/{name}": make(5 * (stop - start)) for span, (start, stop) in wire.SPANS.items()}


# --- Which of the two kinds of tf.Example a record is.


def test_format_is_detected_by_content(wire, write_records):
    ours, womd = write_records("a", wire.scenariomax()), write_records("b", wire.example())
    proto = write_records("c", wire.scenario())
    for reader, path in ((ScenarioMax(), ours), (WomdExample(), womd), (WomdScenario(), proto)):
        assert [p for p in (ours, womd, proto) if reader.recognise(p)] == [path]


def signs(wire) -> dict[str, dict[str, bytes]]:
    """Changes to a ScenarioMax record that take away one of its signs each."""
    return {
        "difficulty": {"state/difficulty_level": wire.integers([0] * 5)},
        "times": {"state/current/timestamp_micros": wire.integers([1_000_000] * 5)},
        "numbering": {"state/id": wire.floats([17, 4, 9, -1, -1])},
        "ego": {"state/is_sdc": wire.integers([0, 0, 1, 0, 0])},
        "damage": {"state/current/timestamp_micros": None},
    }


@pytest.mark.parametrize("sign", ["difficulty", "times", "numbering", "ego", "damage"])
def test_one_sign_may_be_missing(wire, sign):
    assert format_of(wire.scenariomax(**signs(wire)[sign])) == "scenariomax"


@pytest.mark.parametrize("pair", [("difficulty", "times"), ("times", "numbering"), ("difficulty", "ego")])
def test_two_missing_signs_make_it_womds(wire, pair):
    changes = {name: value for sign in pair for name, value in signs(wire)[sign].items()}
    assert format_of(wire.scenariomax(**changes)) == "womd-example"


def test_one_sign_does_not_make_womds_a_scenariomax(wire):
    renumbered = {
        "state/id": wire.floats([0, 1, 2, 3, -1, -1]),
        "state/is_sdc": wire.integers([1, 0, 0, 0, -1, -1]),
        "state/current/valid": wire.integers([1, 0, 1, 1, 0, 0]),
    }
    untimed = {"state/current/timestamp_micros": wire.integers([-1] * 6)}
    for changes in (renumbered, untimed, {"state/difficulty_level": None}):
        assert format_of(wire.example(**changes)) == "womd-example"


def test_other_formats_name_the_cure(wire, write_records):
    with pytest.raises(DataError, match="use --format womd-example"):
        ScenarioMax().describe(write_records("a", wire.example(**{"state/type": None})))
    (bad,) = ScenarioMax().read(write_records("b", wire.scenario()))
    assert isinstance(bad, BadRecord) and bad.cure == "use --format womd-scenario"


# --- What is in it.


def test_19_padding_is_dropped_by_validity(recording, wire):
    """Check-list 19; padding is not marked the way WOMD marks it (to predict is 0 there, ids may be anything)."""
    assert recording.tracks.track_id.tolist() == [0, 1, 2] and recording.ego == 0
    assert recording.to_predict == (0, 2) and recording.of_interest == ()
    kinds = [AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.VEHICLE]
    assert recording.tracks.kind.tolist() == kinds
    for padding in (0, 3, -1):
        other = decode(wire.scenariomax(**{"state/id": wire.floats([0, 1, 2, padding, padding])}))
        assert other.tracks.track_id.tolist() == [0, 1, 2]


def test_recording_has_id_data_set_and_source(recording):
    assert (recording.scenario_id, recording.segment, recording.dataset) == (
        "sm_0001",
        "sm_0001",
        "scenariomax",
    )
    assert recording.current_step == 10 and recording.tags == {"source_format": "scenariomax"}


def test_23_missing_times_are_ten_hertz(recording):
    """Check-list 23."""
    np.testing.assert_allclose(recording.timestamps_s, 0.1 * np.arange(91))


def test_tracks_equal_the_states_of_the_example(recording):
    tracks, t = recording.tracks, np.arange(91)
    np.testing.assert_array_equal(tracks.xy[0, :, 0], t - 10.0)
    np.testing.assert_array_equal(tracks.valid, [t >= 0, t >= 20, t >= 0])
    assert not tracks.xy[~tracks.valid].any()
    assert tracks.heading[1, 30] == pytest.approx(7.5 - 2 * math.pi, abs=1e-6)
    np.testing.assert_array_equal(tracks.velocity[2, 5], [-5.0, 0.5])
    assert recording.flags == Flag.NONE


def test_17_missing_velocities_are_differentiated(wire):
    """Check-list 17: -1 throughout is no velocity."""
    gone = by_span(wire, "velocity_x", lambda n: wire.floats([-1.0] * n))
    gone |= by_span(wire, "velocity_y", lambda n: wire.floats([-1.0] * n))
    other = decode(wire.scenariomax(**gone))
    assert other.flags == Flag.DIFFERENTIATED_VELOCITY
    np.testing.assert_allclose(other.tracks.velocity[0], np.tile([10.0, 0.0], (91, 1)), atol=1e-3)
    np.testing.assert_allclose(other.tracks.velocity[1, 20:], np.tile([0.0, 1.0], (71, 1)), atol=1e-3)
    assert not other.tracks.velocity[1, :20].any()
    half = by_span(wire, "velocity_y", lambda n: wire.floats([-1.0] * n))
    assert decode(wire.scenariomax(**half)).flags == Flag.NONE  # a car that drives at (10, -1) m/s


def test_12_limits_come_with_points_in_mph(recording, wire):
    """Check-list 12: -1 is unknown; only lanes have limits."""
    limits = {f.feature_id: f.limit_mps for f in recording.features}
    assert limits.pop(7) == pytest.approx(11.176) and limits.pop(4) == pytest.approx(24.5872)
    assert set(limits.values()) == {None}
    scenario = assemble(recording)
    assert Flag.SPEED_LIMITS in scenario.has
    row = scenario.lane_id.tolist().index(3)
    assert scenario.lane_limit[row] == -1
    without = decode(wire.scenariomax(**{"roadgraph_samples/speed_limit": None}))
    assert {f.limit_mps for f in without.features} == {None}


def test_map_elements_become_features(recording):
    kinds = {f.feature_id: f.kind for f in recording.features}
    assert kinds == {
        7: RoadKind.LANE_SURFACE, 3: RoadKind.LANE_SURFACE, 4: RoadKind.LANE_FREEWAY, 9: RoadKind.EDGE_BOUNDARY,
        8: RoadKind.EDGE_BOUNDARY, 2: RoadKind.CROSSWALK, 1: RoadKind.STOP_SIGN,
    }  # fmt: skip
    assert recording.split_gap_m == 2.0  # points are 1.01 m apart
    scenario = assemble(recording)
    edges = slice(0, int(scenario.segment_blocks[1]))
    length = np.linalg.norm((scenario.segment_b - scenario.segment_a)[edges, :2], axis=1).sum()
    assert length == pytest.approx(2 * 119 * 1.01, abs=0.01)
    assert recording.lost == {"paths": 1, "lights_without_state": 1}


def test_10_lights_that_are_always_unknown_are_left_out(recording):
    """Check-list 10: lane 3 keeps its slot and its UNKNOWN, lane 4 was never known, padding is no lane."""
    (light,) = recording.lights
    assert light.lane_id == 3 and light.states.tolist() == [0] * 40 + [6] * 51
    np.testing.assert_allclose(light.stop_point, [39.79, 0.0, 0.0], atol=1e-5)


def test_24_lanes_are_chained_by_geometry(recording):
    """Check-list 24: lane 7 ends where lane 3 begins."""
    scenario = assemble(recording)
    assert Flag.LANE_GRAPH | Flag.CHAINED_GRAPH | Flag.LIGHTS | Flag.ROUTE in scenario.has
    lanes = scenario.lane_id.tolist()
    assert scenario.lane_successor[lanes.index(7)].tolist() == [lanes.index(3), -1, -1, -1]


def test_full_list_of_points_is_flagged(wire, recording):
    count = 540
    full = {"roadgraph_samples/valid": wire.integers([1] * count),
            "roadgraph_samples/type": wire.integers([2] * count),
            "roadgraph_samples/id": wire.integers(range(count))}  # fmt: skip
    assert Flag.TRUNCATED_MAP in decode(wire.scenariomax(**full)).flags


def test_describe_and_count(wire, write_records):
    reader = ScenarioMax()
    assert isinstance(reader, Reader) and reader.companions == ()
    path = write_records("a.tfrecord", wire.scenariomax(), wire.scenariomax("two"))
    description = reader.describe(path)
    assert (description.recordings, reader.count(path), description.dataset) == (2, 2, "ScenarioMax")
    notes = " ".join(description.notes)
    assert "which data set" in notes and "2 lanes have a speed limit" in notes and "path_samples" in notes
    assert [r.scenario_id for r in reader.read(path)] == ["sm_0001", "two"]


def test_womd_reader_would_take_padding_for_tracks(wire):
    """Why the format is detected: WOMD's reader refuses or misreads what ScenarioMax writes."""
    with pytest.raises(DataError, match="names a track twice"):
        WomdExample().decode(wire.scenariomax(**{"state/id": wire.floats([0, 1, 2, 0, 0])}))
    assert len(WomdExample().decode(wire.scenariomax()).lights) == 2


def test_mutated_payloads_never_crash(wire):
    good = wire.scenariomax()
    rng = random.Random(8)
    outcomes = set()
    for _ in range(200):
        data = bytearray(good)
        for _ in range(rng.choice((1, 3, 30))):
            data[rng.randrange(len(data))] = rng.randrange(256)
        try:
            outcomes.add(type(decode(bytes(data))))
        except DataError as error:
            outcomes.add(type(error))
    assert outcomes == {Recording, DataError}
