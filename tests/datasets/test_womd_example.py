"""The tf.Example reader against hand-encoded records, damage, and one real file."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from drivax.datasets.reader import BadRecord, Reader
from drivax.datasets.womd.example_reader import WomdExample
from drivax.errors import DataError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import MapFeature, Recording
from drivax.scenario.schema import AgentKind, Flag, RoadKind

decode = WomdExample().decode


@pytest.fixture(scope="module")
def recording(wire) -> Recording:
    return decode(wire.example())


def test_19_rows_are_numbered_without_padding(recording):
    """Check-list 19: the ego is not row 0; rows to predict and of interest are numbered without padding."""
    assert recording.scenario_id == recording.segment == "fedcba9876543210"
    assert recording.tracks.track_id.tolist() == [17, 33, 2406, 900]  # padding is dropped
    assert recording.ego == 2
    assert recording.to_predict == (0,) and recording.of_interest == (2, 3)
    kinds = [AgentKind.CYCLIST, AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.PEDESTRIAN]
    assert recording.tracks.kind.tolist() == kinds
    assert recording.current_step == 10
    np.testing.assert_allclose(recording.timestamps_s, np.arange(91) * 0.1)


def test_states_join_past_current_and_future(recording):
    tracks, t = recording.tracks, np.arange(91)
    np.testing.assert_array_equal(tracks.xy[2, :, 0], t - 10.0)
    np.testing.assert_array_equal(tracks.valid[0], (t % 3 != 1) & (t < 60))
    assert tracks.valid[2].all() and not tracks.valid[1].any()
    np.testing.assert_allclose(tracks.size[3, 4], [0.8, 0.8, 1.8], rtol=1e-6)
    np.testing.assert_allclose(tracks.velocity[0, 0], [4.0, 0.25])
    np.testing.assert_allclose(tracks.heading[2], 7 - 2 * math.pi, atol=1e-6)


def test_04_minus_one_never_leaks(recording):
    """Check-list 4."""
    tracks = recording.tracks
    for values in (tracks.xy, tracks.z, tracks.heading, tracks.velocity, tracks.size):
        assert not values[~tracks.valid].any()


def test_points_become_features(recording):
    kinds = {feature.feature_id: feature.kind for feature in recording.features}
    assert kinds == {
        70: RoadKind.LANE_SURFACE, 71: RoadKind.EDGE_BOUNDARY, 72: RoadKind.CROSSWALK, 73: RoadKind.STOP_SIGN
    }  # fmt: skip
    features = {feature.feature_id: feature.points for feature in recording.features}
    np.testing.assert_array_equal(features[70][:, 0], np.arange(-20, 60))  # interleaved in the file
    np.testing.assert_array_equal(features[71][:, 1], np.full(80, -4.0))
    np.testing.assert_array_equal(
        features[72][:, :2], [[40, -2], [44, -2], [44, 2], [40, 2]]
    )  # not closed twice
    assert features[73].shape == (1, 3)


def test_full_list_of_points_is_flagged(recording, wire):
    """A list without padding has been cut off by its writer, of 20,000 points (v1.0, v1.1) or 30,000 (later)."""
    assert recording.flags == Flag.NONE
    assert decode(wire.example(full=True)).flags == Flag.TRUNCATED_MAP
    assert Flag.TRUNCATED_MAP in assemble(decode(wire.example(full=True))).has


def test_24_lanes_are_chained_by_geometry(wire):
    """Check-list 24: the format has no lane graph; lanes that meet are chained by assembly, and flagged."""
    lonely = assemble(decode(wire.example())).has
    assert not lonely & (Flag.LANE_GRAPH | Flag.CHAINED_GRAPH)
    points = [(70, i - 30.0) for i in range(60)] + [(71, 29.0 + i) for i in range(60)]
    count = len(points)
    chained = assemble(decode(wire.example(**{
        "roadgraph_samples/xyz": wire.floats(v for _, x in points for v in (x, 0.0, 30.0)),
        "roadgraph_samples/id": wire.integers(i for i, _ in points),
        "roadgraph_samples/type": wire.integers([2] * count),
        "roadgraph_samples/valid": wire.integers([1] * count),
    })))  # fmt: skip
    assert Flag.LANE_GRAPH | Flag.CHAINED_GRAPH in chained.has
    lanes = chained.lane_id.tolist()
    assert chained.lane_successor[lanes.index(70)].tolist() == [lanes.index(71), -1, -1, -1]


@pytest.mark.parametrize("lane", [2**24 + 1, 2**53 + 1])
def test_22_lane_ids_never_pass_through_floats(wire, lane):
    """Check-list 22: neighbouring ids beyond 2**24 (float32) and 2**53 (float64) stay apart."""
    ids = [i if i not in (70, 71) else lane + i - 70 for i, _, _ in wire.example_points()] + [-1] * 7
    states = {f"traffic_light_state/{span}/id": wire.integers([lane, lane + 1] * (stop - start))
              for span, (start, stop) in wire.SPANS.items()}  # fmt: skip
    recording = decode(wire.example(**{"roadgraph_samples/id": wire.integers(ids), **states}))
    assert {lane, lane + 1, 72, 73} == {feature.feature_id for feature in recording.features}
    assert {lane, lane + 1} == {light.lane_id for light in recording.lights}


def test_paths_are_counted_not_used(recording):
    assert recording.lost == {"paths": 2} and recording.route_lanes == ()


def test_features_of_unknown_names_are_counted(wire):
    table = {"state/current/yaw": wire.floats([0.0]), "state/is_context": wire.floats([0.0])}
    assert decode(wire.example(**table)).lost == {"paths": 2, "unknown_fields": 1}


def test_windows_of_one_recording_share_its_segment(wire):
    """Exported windows come back with their ids alone, which name the recording and the first step."""
    names = ("drive@0", "drive@40#7", "drive", "drive#7", "me@home")
    segments = [decode(wire.example(name)).segment for name in names]
    assert segments == ["drive"] * 3 + ["drive#7", "me@home"]


def test_limits_of_points_are_read_if_a_writer_adds_them(wire):
    count = len(wire.example_points())
    table = {"roadgraph_samples/speed_limit": wire.floats([25.0] * count + [-1.0] * 7)}
    limits = {f.feature_id: f.limit_mps for f in decode(wire.example(**table)).features}
    assert limits == {70: pytest.approx(11.176), 71: None, 72: None, 73: None}


@pytest.mark.parametrize(("spacing", "gap"), [(0.5, 1.0), (1.0, 2.0)])
def test_split_gap_is_twice_the_sampling(wire, spacing, gap):
    assert decode(wire.example(spacing=spacing)).split_gap_m == gap


def test_10_lights_are_rekeyed_by_lane(recording):
    """Check-list 10: a slot is used by different lanes over time."""
    lights = {light.lane_id: light for light in recording.lights}
    assert set(lights) == {70, 75}
    assert lights[70].states.tolist() == [4] * 91  # in slot 0 before step 30, in slot 1 after
    assert lights[75].states.tolist() == [-1] * 30 + [6] * 61
    np.testing.assert_array_equal(lights[75].stop_point, [25.0, 0.5, 30.0])


@pytest.mark.parametrize("how", ["absent", "invalid"])
def test_20_test_split_has_no_future(wire, how):
    """Check-list 20."""
    cells = wire.ROWS * 80
    future = [name for name in example_names(wire) if name.startswith("state/future/")]
    changes = dict.fromkeys(future) if how == "absent" else {"state/future/valid": wire.integers([0] * cells)}
    recording = decode(wire.example(**changes))
    assert Flag.NO_FUTURE in assemble(recording).has
    assert recording.tracks.valid.shape == (4, 11) and recording.timestamps_s.shape == (11,)
    assert {len(light.states) for light in recording.lights} == {11}


def example_names(wire):
    names = ("x", "y", "z", "length", "width", "height", "bbox_yaw", "velocity_x", "velocity_y")
    return [f"state/{span}/{name}" for span in wire.SPANS for name in (*names, "valid", "timestamp_micros")]


def test_unknown_times_are_ten_hertz(wire):
    changes = {
        f"state/{span}/timestamp_micros": wire.integers([-1] * wire.ROWS * (stop - start))
        for span, (start, stop) in wire.SPANS.items()
    }
    np.testing.assert_allclose(decode(wire.example(**changes)).timestamps_s, np.arange(91) * 0.1)


def test_missing_id_is_replaced_by_a_stable_one(wire):
    one, same = decode(wire.example(None)), decode(wire.example(None))
    other = decode(wire.example(None, full=True))
    assert one.scenario_id == same.scenario_id != other.scenario_id
    assert len(one.scenario_id) == 16 and set(one.scenario_id) <= set("0123456789abcdef")


def test_map_and_lights_may_be_missing(wire):
    gone = [f"traffic_light_state/{span}/id" for span in wire.SPANS] + ["roadgraph_samples/id"]
    recording = decode(wire.example(**dict.fromkeys(gone)))
    assert recording.features == () and recording.lights == () and recording.flags == Flag.NONE


BROKEN = {
    "numeric feature state/past/x is missing": lambda w: {"state/past/x": None},
    "numeric feature state/type is missing": lambda w: {"state/type": w.blob(1, w.blob(1, b"text"))},
    "feature state/future/y has 3 values, not 480": lambda w: {"state/future/y": w.floats([1, 2, 3])},
    "state/current has 0 steps": lambda w: {"state/current/valid": None},
    "marks 0 rows": lambda w: {"state/is_sdc": w.integers([0] * 6)},
    "marks 2 rows": lambda w: {"state/is_sdc": w.integers([1, 1, 0, 0, -1, -1])},
    "feature roadgraph_samples/xyz has 6 values": lambda w: {"roadgraph_samples/xyz": w.floats([0] * 6)},
    "not finite": lambda w: {"state/current/x": w.floats([math.nan] * 6)},
    "feature roadgraph_samples/id contains floats": lambda w: {
        "roadgraph_samples/id": w.floats([i for i, _, _ in w.example_points()] + [-1.0] * 7)
    },
    "names a track twice": lambda w: {"state/id": w.floats([17, 17, 2406, 900, -1, -1])},
    "negatively": lambda w: {"state/id": w.floats([17, -5, 2406, 900, -1, -1])},
    "not exact integers": lambda w: {"state/id": w.floats([17, 2**24 + 2, 2406, 900, -1, -1])},
    "exact": lambda w: {"state/id": w.floats([17, 0.5, 2406, 900, -1, -1])},
    "state/id contains": lambda w: {"state/id": w.floats([17, math.inf, 2406, 900, -1, -1])},
}


@pytest.mark.parametrize("case", BROKEN)
def test_contradictions_are_refused_in_one_line(case, wire, write_records):
    path = write_records("b.tfrecord", wire.example("ok"), wire.example("bad", **BROKEN[case](wire)))
    first, bad = WomdExample().read(path)
    assert first.scenario_id == "ok"
    assert isinstance(bad, BadRecord) and bad.record == 1 and bad.cure
    assert case in str(bad.error()) and "\n" not in str(bad.error())


def test_mutated_payloads_never_crash(wire):
    good = wire.example()
    rng = random.Random(6)
    outcomes = set()
    for _ in range(250):
        data = bytearray(good)
        for _ in range(rng.choice((1, 3, 30))):
            data[rng.randrange(len(data))] = rng.randrange(256)
        try:
            outcomes.add(type(decode(bytes(data))))
        except DataError as error:
            outcomes.add(type(error))
    assert outcomes == {Recording, DataError}


def test_other_format_names_the_cure(wire, write_records):
    (bad,) = WomdExample().read(write_records("a.tfrecord", wire.scenario()))
    assert bad.error().cure == "use --format womd-scenario" and "Scenario protos" in bad.problem


def test_describe_and_count(wire, write_records):
    reader = WomdExample()
    assert isinstance(reader, Reader) and reader.companions == ("export.json",)
    path = write_records("a", *(wire.example(str(i)) for i in range(3)))
    description = reader.describe(path)
    assert (description.recordings, reader.count(path), description.version) == (
        3,
        3,
        "1.2 or later",
    )  # points 1 m apart
    assert [note for note in description.notes if "path_samples" in note] and "cut off" not in str(
        description.notes
    )
    description = reader.describe(write_records("b", wire.example(full=True, spacing=0.5)))
    assert description.version == "1.0 or 1.1" and "cut off" in str(description.notes)
    with pytest.raises(DataError, match="use --format womd-scenario"):
        reader.describe(write_records("c", wire.scenario()))
    assert reader.count(write_records("d", wire.scenario())) == 0


def test_a_map_without_lines_shows_no_version(wire, write_records, monkeypatch):
    path = write_records("a", wire.example())
    crosswalk = MapFeature(1, RoadKind.CROSSWALK, np.zeros((4, 3)))
    recording = replace(WomdExample().first(path), features=(crosswalk,))
    monkeypatch.setattr(WomdExample, "first", lambda *_: recording)
    assert WomdExample().describe(path).version is None


# --- The real file (shared/data/README.md counts it by an independent reader).


@pytest.fixture(scope="module")
def real(real_data) -> Recording:
    (recording,) = WomdExample().read(real_data / "womd" / "motion_data_one_example.tfrecord")
    assert isinstance(recording, Recording)
    return recording


def test_real_example_has_the_counted_content(real):
    assert (real.scenario_id, real.ego) == ("a3bb37c25ce56418", 8)
    assert real.tracks.valid.shape == (128, 91)
    assert real.tracks.valid[:, real.current_step].sum() == 73
    assert len(real.features) == 254 and sum(len(f.points) for f in real.features) == 20_000
    assert len(real.to_predict) == 8
    assert len(real.lights) == 21
    assert real.flags == Flag.TRUNCATED_MAP and real.lost == {"one_point_features": 1}
    assert real.split_gap_m == 1.0


def test_real_lights_do_not_jump(real):
    """Re-keyed by lane a light stays put, and each step holds the 7 to 16 that the slots held."""
    seen = np.stack([light.states >= 0 for light in real.lights])
    assert seen.sum(axis=0).min() == 7 and seen.sum(axis=0).max() == 16
    features = {feature.feature_id: feature for feature in real.features}
    near = [light for light in real.lights if light.lane_id in features]
    assert len(near) > 5
    for light in near:
        gap = np.linalg.norm(features[light.lane_id].points[:, :2] - light.stop_point[:2], axis=1)
        assert gap.min() < 0.1


def test_real_example_is_in_metres_seconds_and_radians(real):
    tracks = real.tracks
    assert np.abs(tracks.heading).max() <= math.pi
    run = tracks.valid[:, :-2] & tracks.valid[:, 1:-1] & tracks.valid[:, 2:]
    slope = (tracks.xy[:, 2:] - tracks.xy[:, :-2]) / 0.2
    error = np.hypot(*np.moveaxis(slope - tracks.velocity[:, 1:-1], -1, 0))[run]
    assert np.median(error) < 0.2
    assert tracks.valid[8].all()
    # Every feature is one unbroken run of points but for the jumps where the map was clipped.
    gaps = np.concatenate(
        [np.hypot(*np.diff(f.points[:, :2], axis=0).T) for f in real.features if len(f.points) > 1]
    )
    assert np.median(gaps) == pytest.approx(0.5, abs=0.02) and (gaps > 1.0).sum() < 20
