"""The proto reader against hand-encoded records, damage, and one real file."""

from __future__ import annotations

import builtins
import math
import random

import numpy as np
import pytest

from drivax.datasets import messages
from drivax.datasets.reader import BadRecord
from drivax.datasets.womd_scenario import WomdScenario, decode
from drivax.errors import DataError, UsageError
from drivax.scenario.recording import MapFeature, Recording
from drivax.scenario.schema import AgentKind, Flag, RoadKind


@pytest.fixture(scope="module")
def recording(wire) -> Recording:
    return decode(wire.scenario())


def by_id(recording: Recording) -> dict[int, MapFeature]:
    return {feature.feature_id: feature for feature in recording.features}


def test_identity_and_time(recording):
    assert (recording.scenario_id, recording.segment, recording.dataset) == ("0123456789abcdef",) * 2 + (
        "womd",
    )
    assert recording.current_step == 10
    np.testing.assert_allclose(recording.timestamps_s, np.arange(91) * 0.1)
    assert recording.flags == Flag.LIGHTS | Flag.LANE_GRAPH | Flag.SPEED_LIMITS | Flag.ELEVATION
    assert recording.split_gap_m == 1.0


def test_rows_are_rows_and_ids_are_ids(recording):
    assert recording.ego == 2
    assert recording.tracks.track_id.tolist() == [900, 17, 2406]
    assert recording.tracks.kind.tolist() == [AgentKind.PEDESTRIAN, AgentKind.CYCLIST, AgentKind.VEHICLE]
    assert recording.to_predict == (1,)  # the file gives the row
    assert recording.of_interest == (1, 2)  # the file gives ids 17 and 2406


def test_states(recording, wire):
    tracks = recording.tracks
    t = np.arange(91)
    np.testing.assert_array_equal(tracks.xy[2], np.stack([wire.X0 + t - 10, np.full(91, wire.Y0)], axis=1))
    np.testing.assert_allclose(tracks.velocity[1, 0], [4.0, 0.25])
    np.testing.assert_allclose(tracks.size[2, :3, 0], [5.0, 5.01, 5.02], rtol=1e-6)
    np.testing.assert_allclose(tracks.size[0, 5], [0.8, 0.8, 1.8], rtol=1e-6)
    assert tracks.z[0, 3] == 31.0
    np.testing.assert_array_equal(tracks.valid[1], (t % 3 != 1) & (t < 60))


def test_headings_are_wrapped(recording):
    heading = recording.tracks.heading
    assert heading.min() >= -math.pi and heading.max() < math.pi
    assert heading[0, 0] == pytest.approx(7.0 - 2 * math.pi, abs=1e-6)
    assert heading[1, 0] == pytest.approx(-9.5 + 4 * math.pi, abs=1e-6)
    np.testing.assert_allclose(heading[2], 0.0, atol=1e-6)


def test_invalid_states_are_zero(recording):
    tracks = recording.tracks
    gone = ~tracks.valid
    assert gone.any()
    for values in (tracks.xy, tracks.z, tracks.heading, tracks.velocity, tracks.size):
        assert not values[gone].any()


def test_lanes(recording, wire):
    lanes = by_id(recording)
    first, second, third = lanes[1], lanes[2], lanes[4]
    assert first.limit_mps == pytest.approx(25 * 1609.344 / 3600)
    assert second.limit_mps is None  # 0 mph in the file means unknown
    assert (first.kind, third.kind) == (RoadKind.LANE_SURFACE, RoadKind.LANE_FREEWAY)
    assert first.successors == (2, 99)  # 99 dangles and is kept
    assert second.predecessors == (1,)  # written unpacked
    assert first.left_neighbours == (4,) and third.right_neighbours == (1,)
    np.testing.assert_array_equal(first.points, wire.line(0.0, stop=40.0))


def test_other_features(recording, wire):
    features = by_id(recording)
    kinds = {number: feature.kind for number, feature in features.items()}
    assert kinds == {
        1: RoadKind.LANE_SURFACE,
        2: RoadKind.LANE_SURFACE,
        4: RoadKind.LANE_FREEWAY,
        5: RoadKind.LINE_BROKEN_SINGLE_WHITE,
        6: RoadKind.LINE_PASSING_DOUBLE_YELLOW,
        7: RoadKind.EDGE_BOUNDARY,
        8: RoadKind.EDGE_MEDIAN,
        9: RoadKind.STOP_SIGN,
        10: RoadKind.CROSSWALK,
        11: RoadKind.SPEED_BUMP,
        12: RoadKind.DRIVEWAY,
    }
    np.testing.assert_array_equal(features[9].points, [[wire.X0 + 40, wire.Y0 - 3, 31.0]])
    assert features[9].lanes == (1, 4)
    np.testing.assert_array_equal(features[10].points, wire.square(45.0, 0.0))
    assert features[8].points[0, 0] > features[8].points[-1, 0]  # orientation is kept


def test_lights_are_keyed_by_lane(recording, wire):
    lights = {light.lane_id: light for light in recording.lights}
    assert set(lights) == {2, 4}
    assert lights[2].states.tolist() == [4] * 50 + [6] * 41
    assert lights[4].states.tolist() == [-1] * 20 + [1] * 71
    np.testing.assert_array_equal(lights[4].stop_point, [wire.X0 - 60, wire.Y0 + 3.7, 30.0])


def test_two_states_for_one_lane_keep_the_known_one(wire):
    step = b"".join(blob for state in (0, 6, 4) for blob in [wire.blob(1, wire.light(2, state, 0.0, 0.0))])
    odd = wire.blob(1, wire.light(4, 77, 0.0, 0.0))
    lights = decode(wire.scenario(lights=wire.blob(7, step + odd))).lights
    assert [light.states[0] for light in lights] == [6, 0]  # a code of a later version is unknown


def test_test_split_has_no_future(wire):
    recording = decode(wire.scenario(steps=11))
    assert Flag.NO_FUTURE in recording.flags
    assert recording.tracks.xy.shape == (3, 11, 2) and len(recording.timestamps_s) == 11


def test_twenty_second_file(wire):
    recording = decode(wire.scenario(steps=199, now=wire.whole(10, 0)))
    assert (recording.current_step, len(recording.timestamps_s)) == (0, 199)
    assert Flag.NO_FUTURE not in recording.flags


def test_no_lights_no_map(wire):
    recording = decode(wire.scenario(lights=b"", map=b""))
    assert recording.flags == Flag.NONE and recording.features == () and recording.lights == ()


def test_fields_in_reverse_order_read_the_same(wire, recording):
    """protobuf's Python writers emit fields from last to first."""
    again = messages.scenario_class().FromString(wire.scenario()).SerializeToString()
    assert again != wire.scenario()
    other = decode(again)
    np.testing.assert_array_equal(other.tracks.xy, recording.tracks.xy)
    assert [f.successors for f in other.features] == [f.successors for f in recording.features]


BROKEN = {
    "no id": {"id": b""},
    "no tracks": {"tracks": b""},
    "no steps": {"times": b""},
    "current": lambda w: {"now": w.whole(10, 91)},
    "sdc_track_index names track 3": lambda w: {"sdc": w.whole(6, 3)},
    "sdc_track_index names track -1": lambda w: {"sdc": w.whole(6, -1)},
    "tracks_to_predict names track 7": lambda w: {"predict": w.blob(11, w.whole(1, 7))},
    "light steps": lambda w: {"lights": b"".join(w.blob(7, s) for s in w.light_steps(92))},
    "track 5 has 3 states": lambda w: {
        "tracks": b"".join(
            w.blob(2, t) for t in [*w.tracks(), w.track(5, 1, [w.state(0, 0, 0, 1, 1, 1, 0, 0, 0)] * 3)]
        )
    },
    "not finite": lambda w: {
        "tracks": b"".join(
            w.blob(2, t)
            for t in [*w.tracks(), w.track(5, 1, [w.state(math.inf, 0, 0, 1, 1, 1, 0, 0, 0)] * 91)]
        )
    },
}


@pytest.mark.parametrize("case", BROKEN)
def test_contradictions_are_refused_in_one_line(case, wire, write_records):
    changes = BROKEN[case](wire) if callable(BROKEN[case]) else BROKEN[case]
    path = write_records(
        "a.tfrecord", wire.scenario("ok"), wire.scenario("bad", **changes), wire.scenario("ok2")
    )
    first, bad, last = WomdScenario().read(path)
    assert (first.scenario_id, last.scenario_id) == ("ok", "ok2")
    assert isinstance(bad, BadRecord) and (bad.file, bad.record) == (path, 1) and bad.cure
    line = str(bad.error())
    assert line.startswith(f"{path}: record 1: ") and "\n" not in line
    if not case.startswith("no "):
        assert case in line


def test_mutated_payloads_never_crash(wire):
    good = wire.scenario(steps=12)
    rng = random.Random(5)
    outcomes = set()
    for _ in range(250):
        data = bytearray(good)
        for _ in range(rng.choice((1, 1, 3))):
            data[rng.randrange(len(data))] = rng.randrange(256)
        if rng.random() < 0.2:
            del data[rng.randrange(len(data)) :]
        try:
            outcomes.add(type(decode(bytes(data))))
        except DataError as error:
            outcomes.add(type(error))
    assert outcomes == {Recording, DataError}


def test_other_flavour_names_the_cure(wire, write_records):
    path = write_records("a.tfrecord", wire.example())
    (bad,) = WomdScenario().read(path)
    assert bad.error().cure == "use --format womd-example" and "tf.Examples" in bad.problem


def test_missing_protobuf_names_the_extra(wire, monkeypatch):
    found = builtins.__import__

    def without_protobuf(name, *args, **kwargs):
        if name.startswith("google.protobuf"):
            raise ImportError(name)
        return found(name, *args, **kwargs)

    messages._classes.cache_clear()
    monkeypatch.setattr(builtins, "__import__", without_protobuf)
    with pytest.raises(UsageError, match=r"pip install 'drivax\[womd\]'"):
        decode(wire.scenario())


# --- The real file (shared/data/README.md counts it by an independent reader).


@pytest.fixture(scope="module")
def real(real_data) -> Recording:
    (recording,) = WomdScenario().read(real_data / "womd" / "motion_data_one_scenario.tfrecord")
    assert isinstance(recording, Recording)
    return recording


def test_real_counts(real):
    kinds = [feature.kind.name.split("_")[0] for feature in real.features]
    assert {kind: kinds.count(kind) for kind in set(kinds)} == {
        "EDGE": 28, "LINE": 59, "LANE": 199, "CROSSWALK": 4, "SPEED": 3, "STOP": 8
    }  # fmt: skip
    assert sum(len(feature.points) for feature in real.features) == 19_636
    assert real.tracks.valid.shape == (83, 91)
    assert real.tracks.valid[:, real.current_step].sum() == 50
    assert real.tracks.valid.all(axis=1).sum() == 24
    assert [int((real.tracks.kind == kind).sum()) for kind in (1, 2, 3)] == [70, 10, 3]
    states = np.stack([light.states for light in real.lights])
    assert states.shape == (12, 91)
    assert [int((states == code).sum()) for code in (0, 4, 1, -1)] == [540, 324, 228, 0]


def test_real_ego_and_predictions(real):
    assert (real.scenario_id, real.ego, real.tracks.track_id[real.ego]) == ("637f20cafde22ff8", 82, 2406)
    assert real.tracks.valid[82].all() and real.to_predict == (72, 43, 42)
    assert np.ptp(real.tracks.xy[82], axis=0).max() < 0.5  # parked
    np.testing.assert_allclose(real.tracks.size[82, 0], [5.286, 2.332, 2.33], atol=1e-3)


def test_real_units(real):
    limits = {round(f.limit_mps / 0.44704, 6) for f in real.features if f.limit_mps is not None}
    assert limits == {10.0, 15.0, 40.0, 45.0}
    tracks = real.tracks
    assert np.abs(tracks.heading).max() <= math.pi
    # Velocity is the derivative of position in m/s: compare central differences where three steps are valid.
    run = tracks.valid[:, :-2] & tracks.valid[:, 1:-1] & tracks.valid[:, 2:]
    slope = (tracks.xy[:, 2:] - tracks.xy[:, :-2]) / 0.2
    error = np.hypot(*np.moveaxis(slope - tracks.velocity[:, 1:-1], -1, 0))[run]
    assert np.median(error) < 0.2
    # A moving car points where it goes.
    fast = tracks.valid & (np.hypot(*np.moveaxis(tracks.velocity, -1, 0)) > 3) & (tracks.kind == 1)[:, None]
    course = np.arctan2(tracks.velocity[..., 1], tracks.velocity[..., 0])
    assert np.median(np.cos(course - tracks.heading)[fast]) > 0.99


def test_real_lights_stand_at_the_start_of_their_lanes(real):
    features = by_id(real)
    for light in real.lights:
        np.testing.assert_allclose(light.stop_point, features[light.lane_id].points[0], atol=0.01)


def test_real_links_resolve(real):
    features = by_id(real)
    links = [(f, link) for f in real.features for link in f.successors]
    assert len(links) == 193
    for lane, link in links:
        np.testing.assert_allclose(lane.points[-1], features[link].points[0], atol=0.01)
