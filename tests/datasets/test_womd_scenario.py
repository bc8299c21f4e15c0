"""The proto reader against hand-encoded records, damage, and one real file."""

from __future__ import annotations

import math
import random
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from drivax.datasets import parsing
from drivax.datasets.reader import BadRecord, Reader
from drivax.datasets.womd import messages
from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.datasets.womd.tfrecord import notes_of
from drivax.errors import DataError, UsageError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import MapFeature, Recording, windows
from drivax.scenario.schema import CAPACITIES, AgentKind, Flag, RoadKind

decode = WomdScenario().decode


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
    assert recording.flags == Flag.NONE  # nothing that the reader alone knows; assembly measures the rest
    assert recording.split_gap_m == 1.0
    assert recording.tags == {"source_format": "womd-scenario"}


def test_assembled_scenario_has_lights_graph_limits_and_route(recording):
    measured = Flag.LIGHTS | Flag.LANE_GRAPH | Flag.SPEED_LIMITS | Flag.ROUTE
    assert assemble(recording).has & ~Flag.DEFAULT_LIMITS == measured


def test_fields_of_unknown_numbers_are_counted(wire, recording):
    """Different ones, at any depth; those that are known and not needed are not."""
    boundary = wire.blob(13, wire.whole(1, 0) + wire.whole(2, 8))
    extent = wire.blob(11, wire.whole(1, 4) + wire.whole(2, 0) + wire.whole(4, 3))
    lane = wire.lane(wire.line(0.0, stop=40.0)) + extent + boundary
    state = wire.state(wire.X0, wire.Y0, 30.5, 5.0, 2.0, 1.7, 0.0, 10.0, 0.0)

    def lost(*more, lane=lane, state=state):
        track = wire.blob(2, wire.track(7, 1, [state] * wire.STEPS) + b"".join(more))
        return decode(
            wire.scenario(
                tracks=track, sdc=wire.whole(6, 0), predict=b"", map=wire.blob(8, wire.feature(1, 3, lane))
            )
        ).lost

    assert "unknown_fields" not in recording.lost and "unknown_fields" not in lost()
    assert lost(wire.double(9, 1.0), wire.double(9, 2.0))["unknown_fields"] == 1
    assert lost(lane=lane + wire.double(20, 3.5))["unknown_fields"] == 1
    assert lost(state=state + wire.single(12, 0.1) + wire.single(13, 0.1))["unknown_fields"] == 2


def test_rows_are_rows_and_ids_are_ids(recording):
    assert recording.ego == 2
    assert recording.tracks.track_id.tolist() == [900, 17, 2406]
    assert recording.tracks.kind.tolist() == [AgentKind.PEDESTRIAN, AgentKind.CYCLIST, AgentKind.VEHICLE]
    assert recording.to_predict == (1,)  # the file gives the row
    assert recording.of_interest == (1, 2)  # the file gives ids 17 and 2406


def test_tracks_equal_the_states_of_the_proto(recording, wire):
    tracks = recording.tracks
    t = np.arange(91)
    np.testing.assert_array_equal(tracks.xy[2], np.stack([wire.X0 + t - 10, np.full(91, wire.Y0)], axis=1))
    np.testing.assert_allclose(tracks.velocity[1, 0], [4.0, 0.25])
    np.testing.assert_allclose(tracks.size[2, :3, 0], [5.0, 5.01, 5.02], rtol=1e-6)
    np.testing.assert_allclose(tracks.size[0, 5], [0.8, 0.8, 1.8], rtol=1e-6)
    assert tracks.z[0, 3] == 31.0
    np.testing.assert_array_equal(tracks.valid[1], (t % 3 != 1) & (t < 60))


def test_01_headings_are_wrapped(recording):
    """Check-list 1: the files hold up to 10 rad."""
    heading = recording.tracks.heading
    assert heading.min() >= -math.pi and heading.max() < math.pi
    assert heading[0, 0] == pytest.approx(7.0 - 2 * math.pi, abs=1e-6)
    assert heading[1, 0] == pytest.approx(-9.5 + 4 * math.pi, abs=1e-6)
    np.testing.assert_allclose(heading[2], 0.0, atol=1e-6)


def test_04_invalid_states_are_zero(recording):
    """Check-list 4: the file keeps a z in them."""
    tracks = recording.tracks
    gone = ~tracks.valid
    assert gone.any()
    for values in (tracks.xy, tracks.z, tracks.heading, tracks.velocity, tracks.size):
        assert not values[gone].any()


def test_12_lanes_and_limits_in_mph(recording, wire):
    """Check-list 12: 0.44704 m/s per mph, 0 is unknown."""
    lanes = by_id(recording)
    first, second, third = lanes[1], lanes[2], lanes[4]
    assert first.limit_mps == pytest.approx(25 * 1609.344 / 3600)
    assert second.limit_mps is None
    assert (first.kind, third.kind) == (RoadKind.LANE_SURFACE, RoadKind.LANE_FREEWAY)
    assert first.successors == (2, 99)  # 99 dangles and is kept
    assert second.predecessors == (1,)  # written unpacked
    assert first.left_neighbours == (4,) and third.right_neighbours == (1,)
    np.testing.assert_array_equal(first.points, wire.line(0.0, stop=40.0))


def test_map_elements_other_than_lanes_become_features(recording, wire):
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


def test_10_lights_are_keyed_by_lane(recording, wire):
    """Check-list 10: -1 where unobserved; the place in the list of a step means nothing."""
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


def test_lights_without_a_stop_point_stand_where_their_lane_begins(wire):
    """A missing point and a point of zeros are the same; without the lane there is no place."""
    bare = b"".join(wire.blob(1, wire.whole(1, lane) + wire.whole(2, 4)) for lane in (2, 999))
    zeros = wire.blob(1, wire.whole(1, 4) + wire.whole(2, 6) + wire.blob(3, wire.point(0.0, 0.0, 0.0)))
    recording = decode(wire.scenario(lights=wire.blob(7, bare + zeros)))
    starts = {f.feature_id: f.points[0] for f in recording.features}
    assert [light.lane_id for light in recording.lights] == [2, 4]
    assert recording.lost["lights_without_place"] == 1
    for light in recording.lights:
        np.testing.assert_array_equal(light.stop_point, starts[light.lane_id])


def test_20_test_split_has_no_future(wire):
    """Check-list 20: the test split has 11 steps; stored, the rest masked, with the flag."""
    recording = decode(wire.scenario(steps=11))
    assert recording.tracks.xy.shape == (3, 11, 2) and len(recording.timestamps_s) == 11
    scenario = assemble(recording)
    assert Flag.NO_FUTURE in scenario.has and int(scenario.record["steps"]) == 11
    assert scenario.agent_valid[:11, 0].all() and not scenario.agent_valid[11:].any()


def test_twenty_second_file_becomes_windows(wire, write_records):
    path = write_records("a_20s.tfrecord", wire.scenario("long", steps=199, now=wire.whole(10, 0)))
    (recording,) = WomdScenario().read(path)
    assert (recording.current_step, len(recording.timestamps_s)) == (0, 199)
    parts = [assemble(part) for part in windows(recording)]
    assert [part.id for part in parts] == ["long@0", "long@40", "long@80"]
    assert {bytes(part.segment.item()).rstrip(b"\0") for part in parts} == {b"long"}
    for start, part in zip((0, 40, 80), parts, strict=True):
        assert int(part.current_step) == 10 and Flag.NO_FUTURE not in part.has
        # Ego drives 1 m per step, so the origin says which step is the current one.
        assert part.origin[0] == pytest.approx(wire.X0 + start)
    assert WomdScenario().count(path) == len(parts)


def test_lights_and_map_may_be_missing(wire):
    recording = decode(wire.scenario(lights=b"", map=b""))
    assert recording.features == () and recording.lights == () and recording.lost == {}
    assert not assemble(recording).has & (Flag.LIGHTS | Flag.LANE_GRAPH)


def test_what_is_left_out_is_counted(recording, wire):
    assert recording.lost == {"unknown_features": 1, "empty_features": 1}
    line = wire.feature(20, 4, wire.whole(1, 1) + wire.polyline(2, [(wire.X0, wire.Y0, 30.0)]))
    again = wire.feature(1, 3, wire.lane(wire.line(9.0)))
    bare = wire.feature(21, 7, wire.blob(1, wire.varint(1)))  # a stop sign without a position
    parts = b"".join(wire.blob(8, f) for f in (*wire.features(), line, again, bare))
    other = decode(wire.scenario(map=parts))
    assert other.lost == {
        "unknown_features": 1, "empty_features": 2, "duplicate_features": 1, "one_point_features": 1
    }  # fmt: skip
    np.testing.assert_array_equal(by_id(other)[1].points, by_id(recording)[1].points)  # the first one stays


def test_06_features_of_one_point_are_dropped(wire):
    """Check-list 6: the source counts keep them, nothing is drawn."""
    only = wire.feature(20, 4, wire.whole(1, 1) + wire.polyline(2, [(wire.X0, wire.Y0, 30.0)]))
    parts = b"".join(wire.blob(8, f) for f in wire.features())
    plain, more = (assemble(decode(wire.scenario(map=m))) for m in (parts, parts + wire.blob(8, only)))
    assert more.source.map_features["road_line"] == plain.source.map_features["road_line"] + 1
    np.testing.assert_array_equal(more.segment_a, plain.segment_a)


def test_interpolating_lanes_are_kept_and_marked(recording, wire):
    turn = wire.whole(2, 2) + wire.whole(3, 1) + wire.polyline(8, wire.line(0.0, stop=0.0))
    lanes = by_id(decode(wire.scenario(map=wire.blob(8, wire.feature(3, 3, turn)))))
    assert lanes[3].interpolating and not by_id(recording)[1].interpolating


def test_unknown_objects_of_interest_are_left_out(wire):
    assert decode(wire.scenario(interest=wire.whole(4, 555) + wire.whole(4, 900))).of_interest == (0,)


def test_11_dangling_links_lead_nowhere(recording):
    """Check-list 11: lane 1 names lane 99, which is not in the file."""
    scenario = assemble(recording)
    lanes = scenario.lane_id.tolist()
    row = lanes.index(1)
    assert [lanes[i] for i in scenario.lane_successor[row] if i >= 0] == [2]


def test_05_edges_are_cut_where_the_map_was_clipped(wire):
    """Check-list 5: one edge leaves the clipped map and comes back 30 m further on; no wall crosses the gap."""
    points = wire.line(-4.0, stop=0.0) + wire.line(-4.0, start=30.0)
    edge = wire.feature(7, 5, wire.whole(1, 1) + wire.polyline(2, points))
    others = [f for f in wire.features() if f != wire.features()[5]]
    scenario = assemble(decode(wire.scenario(map=b"".join(wire.blob(8, f) for f in (*others, edge)))))
    stop = int(scenario.segment_blocks[1])
    a, b = scenario.segment_a[:stop, :2], scenario.segment_b[:stop, :2]
    assert np.linalg.norm(b - a, axis=1).max() <= 4.0
    middle = (a + b) / 2
    right = middle[np.abs(middle[:, 1] + 4.0) < 0.1]
    assert len(right) and not ((right[:, 0] > 0.0) & (right[:, 0] < 30.0)).any()


def test_19_ego_comes_first_and_marks_move_with_the_rows(recording):
    """Check-list 19: ego is the file's last row; a row to predict and ids of interest keep their tracks."""
    scenario = assemble(recording)
    flags = dict(zip(scenario.agent_id.tolist(), scenario.agent_flags.tolist(), strict=True))
    flags |= {int(i): 0 for i in scenario.parked_id}  # the walker stands still
    assert int(scenario.agent_id[0]) == 2406
    assert (flags[2406], flags[17], flags[900]) == (1 | 4, 2 | 4, 0)


def test_02_origin_is_subtracted_in_float64(wire):
    """Check-list 2: at 5 km float32 is exact to 0.5 mm only; local positions are exact to 1e-5 m."""
    scenario = assemble(decode(wire.scenario()))
    np.testing.assert_array_equal(scenario.origin, [wire.X0, wire.Y0, 30.5])
    np.testing.assert_allclose(scenario.agent_xy[:, 0, 0], np.arange(91) - 10.0, atol=1e-5)
    step = b"".join(
        wire.blob(3, wire.state(9000 + 1e-4 * t, 0, 0, 5, 2, 1.5, 0, 0.001, 0)) for t in range(91)
    )
    slow = assemble(
        decode(
            wire.scenario(
                tracks=wire.blob(2, wire.whole(1, 1) + wire.whole(2, 1) + step),
                sdc=wire.whole(6, 0),
                interest=b"",
                predict=b"",
                map=b"",
                lights=b"",
            )
        )
    )
    np.testing.assert_allclose(slow.agent_xy[:, 0, 0], 1e-4 * (np.arange(91) - 10.0), atol=1e-7)


def test_03_sizes_are_medians(recording):
    """Check-list 3: ego's length is 5.00, 5.01, 5.02, 5.00, ...: 31, 30 and 30 times."""
    assert assemble(recording).agent_size[0].tolist() == pytest.approx([5.01, 2.0, 1.7])


def test_21_what_does_not_fit_is_counted(recording):
    """Check-list 21: overflow counters and the flag; the ego keeps its place and the source counts stay."""
    whole, small = assemble(recording), replace(CAPACITIES["default"], agents=1, parked=0, lanes=1)
    cut = assemble(recording, small)
    assert whole.overflow == {} and Flag.OVERFLOW not in whole.has
    assert cut.overflow == {
        "agents": int(whole.agent_valid.any(axis=0).sum()) - 1,
        "parked": int(whole.parked_valid.any(axis=0).sum()),
        "lanes": len(whole.lane_id[whole.lane_id >= 0]) - 1,
    } | {name: count for name, count in cut.overflow.items() if name not in ("agents", "parked", "lanes")}
    assert Flag.OVERFLOW in cut.has and cut.agent_id[0] == whole.agent_id[0]
    assert cut.source.tracks == whole.source.tracks == len(recording.tracks.kind)


def test_23_jitter_is_flagged(wire):
    """Check-list 23: steps differ from their median by more than 2 ms."""
    times = 0.1 * np.arange(91)
    calm, jittery = times + 0.0008 * (np.arange(91) % 2), times + 0.004 * (np.arange(91) % 2)
    for values, flagged in ((calm, False), (jittery, True)):
        scenario = assemble(decode(wire.scenario(times=b"".join(wire.double(1, t) for t in values))))
        assert (Flag.JITTERED_TIME in scenario.has) == flagged


def test_sensor_fields_are_skipped(wire, tmp_path):
    """Lidar and camera tokens (fields 12 and 13) cost their bytes, nothing more, and change nothing."""
    sensors = wire.blob(12, bytes(range(256)) * 160_000) + wire.blob(13, b"\xff" * 1000)
    payload = wire.scenario(laser=sensors)
    np.testing.assert_array_equal(decode(payload).tracks.xy, decode(wire.scenario()).tracks.xy)
    path = tmp_path / "payload"
    path.write_bytes(payload)
    program = (
        "import resource, sys; from pathlib import Path\n"
        "from drivax.datasets.womd.scenario_reader import WomdScenario\n"
        "payload = Path(sys.argv[1]).read_bytes()\n"
        "def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024\n"
        "before = peak(); WomdScenario().decode(payload); print((peak() - before) / len(payload))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True
    )
    assert float(done.stdout) < 2.5


BROKEN = {
    "no id": {"id": b""},
    "scenario_id is not text": lambda w: {"id": w.blob(5, b"\xff\xfe")},
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
    "two tracks have the id 17": lambda w: {
        "tracks": b"".join(w.blob(2, t) for t in [*w.tracks(), w.tracks()[1]])
    },
    "a message ObjectState is damaged": lambda w: {
        "tracks": b"".join(w.blob(2, t) for t in [*w.tracks(), w.track(5, 1, [b"\x11abc"] * 91)])
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


def test_other_format_names_the_cure(wire, write_records):
    path = write_records("a.tfrecord", wire.example())
    (bad,) = WomdScenario().read(path)
    assert bad.error().cure == "use --format womd-example" and "tf.Examples" in bad.problem


def test_missing_protobuf_names_the_extra(wire, hide_packages):
    messages.message_class.cache_clear()
    messages._pool.cache_clear()
    hide_packages("google.protobuf")
    with pytest.raises(UsageError, match=r"pip install 'drivax\[womd\]'"):
        decode(wire.scenario())


def test_describe_and_count(wire, write_records):
    reader = WomdScenario()
    assert isinstance(reader, Reader) and reader.companions == ()
    path = write_records("a.tfrecord", *(wire.scenario(str(i)) for i in range(3)))
    description = reader.describe(path)
    assert (description.recordings, reader.count(path), description.version) == (
        3,
        3,
        "1.2 or later",
    )  # it has a driveway
    assert description.notes == ("91 steps, current step 10",)
    early = [f for f in wire.features() if f[2:3] != b"\x52"]  # field 10 of a map feature is a driveway
    unlinked = wire.scenario(map=wire.blob(8, wire.feature(1, 3, wire.lane(wire.line(0.0)))), lights=b"")
    older = wire.scenario(map=b"".join(wire.blob(8, f) for f in early))
    assert reader.describe(write_records("b", older)).version == "1.1 or later"
    description = reader.describe(write_records("c", unlinked))
    assert (
        description.version is None
        and len(description.notes) == 3
        and "no lane graph" in description.notes[2]
    )
    assert "fewer than 31 steps" in reader.describe(write_records("d", wire.scenario(steps=11))).notes[1]
    assert "3 windows" in reader.describe(write_records("e", wire.scenario(steps=199))).notes[1]
    (recording,) = reader.read(write_records("f", wire.scenario()))
    gap = recording.timestamps_s + 0.5 * (np.arange(91) > 40)
    assert notes_of(replace(recording, timestamps_s=gap))[-1] == parsing.UNEVEN


def test_describe_names_the_damage(wire, write_records, tmp_path):
    with pytest.raises(DataError, match="use --format womd-example"):
        WomdScenario().describe(write_records("a", wire.example()))
    empty = tmp_path / "empty"
    empty.touch()
    with pytest.raises(DataError, match="empty"):
        WomdScenario().describe(empty)
    assert WomdScenario().count(empty) == WomdScenario().count(tmp_path / "none") == 0
    first = bytearray(wire.frame(wire.scenario("a")))
    first[500] ^= 1
    half = tmp_path / "half"
    half.write_bytes(bytes(first) + wire.frame(wire.scenario("b", steps=131)))
    assert WomdScenario().describe(half).recordings == 2  # the second one is looked at
    assert WomdScenario().count(half) == 4


def test_tfrecords_are_recognised_without_packages(wire, write_records, hide_packages):
    path, other = write_records("a.tfrecord", wire.example()), write_records("b").with_name("c")
    other.write_bytes(b"SQLite format 3\0")
    hide_packages("google.protobuf", "google_crc32c")
    assert WomdScenario().recognise(path) and not WomdScenario().recognise(other)
    with pytest.raises(UsageError, match=r"pip install 'drivax\[womd\]'"):
        next(WomdScenario().read(path))


# --- The real file (shared/data/README.md counts it by an independent reader).


@pytest.fixture(scope="module")
def real(real_data) -> Recording:
    (recording,) = WomdScenario().read(real_data / "womd" / "motion_data_one_scenario.tfrecord")
    assert isinstance(recording, Recording)
    return recording


def test_real_scenario_has_the_counted_content(real):
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


def test_real_scenario_is_in_metres_seconds_and_radians(real):
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
