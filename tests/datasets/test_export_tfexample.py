"""tf.Examples: names, types and shapes by a decoder of the wire format; rules of the data set; round trips."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from datasets.samples import womd_scenario
from datasets.test_export_recording import assert_same_map
from drivax.datasets.export.recording import restore
from drivax.datasets.export.tfexample import PATHS, tf_example
from drivax.datasets.womd import example_reader as womd_example
from drivax.datasets.womd import scenario_reader as protos
from drivax.datasets.womd.messages import ORIGIN
from drivax.datasets.womd.tfrecord import EXAMPLE_FORMAT, example, format_of
from drivax.errors import DataError
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import CAPACITIES, AgentKind, Flag, RoadKind
from scenario.recordings import (
    FAR,
    arc,
    driving,
    edge,
    lane,
    light,
    line,
    make_recording,
    make_tracks,
    moved,
    straight_road,
)

# --- A decoder of the wire format: no protobuf, no code of drivax.


def fields(data: bytes):
    """(field number, content) of every length-delimited field of a message."""
    place = 0
    while place < len(data):
        tag, place = number(data, place)
        assert tag & 7 == 2, "every field of a tf.Example has a length"
        size, place = number(data, place)
        yield tag >> 3, data[place : place + size]
        place += size
    assert place == len(data)


def number(data: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[place]
        place, value, shift = place + 1, value | (byte & 127) << shift, shift + 7
        if byte < 128:
            return value, place


def integers(data: bytes) -> list[int]:
    values, place = [], 0
    while place < len(data):
        value, place = number(data, place)
        values.append(value - 2**64 if value >= 2**63 else value)
    return values


def decode(payload: bytes) -> dict[str, tuple[str, list]]:
    """Name -> (kind of list, its values)."""
    features = {}
    ((one, inside),) = fields(payload)
    assert one == 1
    for _, entry in fields(inside):
        (key, name), (value, feature) = fields(entry)
        ((kind, content),) = fields(feature)
        ((item, packed),) = fields(content)
        assert (key, value, item) == (1, 2, 1)
        read = {
            1: lambda data: [data],
            2: lambda data: [v for (v,) in struct.iter_unpack("<f", data)],
            3: integers,
        }
        features[name.decode()] = ({1: "bytes", 2: "float", 3: "int64"}[kind], read[kind](packed))
    return features


def table(scenario, paths: str = "vmax", lost: dict | None = None) -> dict[str, np.ndarray]:
    """The features of a scenario as decoded from its bytes, by name, arrays in their documented shapes."""
    features, missing = tf_example(scenario, PATHS[paths])
    if lost is not None:
        lost |= missing
    shapes = layout(*((10, 300) if paths == "vmax" else (10, 500)))
    found = decode(example(features))
    found.pop(ORIGIN, None)
    assert {name: kind for name, (kind, _) in found.items()} == {
        name: kind for name, (kind, _) in shapes.items()
    }
    return {
        name: np.array(values).reshape(shapes[name][1])
        for name, (kind, values) in found.items()
        if kind != "bytes"
    }


SPANS = {"past": 10, "current": 1, "future": 80}
STATE_FLOATS = (
    "x", "y", "z", "bbox_yaw", "length", "width", "height", "speed", "vel_yaw", "velocity_x", "velocity_y",
)  # fmt: skip


def layout(paths: int, points: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """The data set's 72 features, ScenarioMax's six: kind and shape."""
    wanted: dict[str, tuple[str, tuple[int, ...]]] = {
        "scenario/id": ("bytes", (1,)),
        "state/id": ("float", (128,)),
        "state/type": ("float", (128,)),
        "state/is_sdc": ("int64", (128,)),
        "state/tracks_to_predict": ("int64", (128,)),
        "state/objects_of_interest": ("int64", (128,)),
        "state/difficulty_level": ("int64", (128,)),
        "roadgraph_samples/xyz": ("float", (30000, 3)),
        "roadgraph_samples/dir": ("float", (30000, 3)),
        "roadgraph_samples/id": ("int64", (30000, 1)),
        "roadgraph_samples/type": ("int64", (30000, 1)),
        "roadgraph_samples/valid": ("int64", (30000, 1)),
        "roadgraph_samples/speed_limit": ("float", (30000,)),
        "path_samples/xyz": ("float", (paths, points, 3)),
        "path_samples/id": ("int64", (paths, points)),
        "path_samples/valid": ("int64", (paths, points)),
        "path_samples/arc_length": ("float", (paths, points)),
        "path_samples/on_route": ("int64", (paths, 1)),
    }
    for span, steps in SPANS.items():
        for name in STATE_FLOATS:
            wanted[f"state/{span}/{name}"] = ("float", (128, steps))
        for name in ("timestamp_micros", "valid"):
            wanted[f"state/{span}/{name}"] = ("int64", (128, steps))
        for name in ("state", "id", "valid"):
            wanted[f"traffic_light_state/{span}/{name}"] = ("int64", (steps, 16))
        for name in "xyz":
            wanted[f"traffic_light_state/{span}/{name}"] = ("float", (steps, 16))
        wanted[f"traffic_light_state/{span}/timestamp_micros"] = ("int64", (steps,))
    return wanted


def over_time(found: dict[str, np.ndarray], name: str, kind: str = "state") -> np.ndarray:
    axis = 1 if kind == "state" else 0
    return np.concatenate([found[f"{kind}/{span}/{name}"] for span in SPANS], axis=axis)


@pytest.fixture(scope="module")
def source():
    return protos.WomdScenario().decode(womd_scenario.scenario())


@pytest.fixture(scope="module")
def found(source):
    return table(assemble(source))


def test_all_features_of_the_data_set_and_of_scenariomax():
    assert len(layout(10, 300)) == 72 + 6  # data.md counts 72 in a real record


def test_layout_equals_that_of_a_real_record(real_data):
    """Names, kinds and lengths; the real one is of version 1.0, with 20,000 points of map."""
    data = (real_data / "womd" / "motion_data_one_example.tfrecord").read_bytes()
    (size,) = struct.unpack_from("<Q", data)
    real = {name: (kind, len(values)) for name, (kind, values) in decode(data[12 : 12 + size]).items()}
    ours = {name: (kind, int(np.prod(shape))) for name, (kind, shape) in layout(10, 300).items()}
    points = {name for name in real if name.startswith("roadgraph_samples/")}
    assert len(real) == 72 and real.keys() < ours.keys()
    assert {name: real[name] for name in real.keys() - points} == {
        name: ours[name] for name in real.keys() - points
    }
    assert {name: (kind, count // 2 * 3) for name, (kind, count) in real.items() if name in points} == {
        name: ours[name] for name in points
    }


def test_states_equal_the_tracks_of_the_source(found, source):
    ids = found["state/id"]
    assert ids[:3].tolist() == [2406, 900, 17] and (ids[3:] == -1).all()
    assert found["state/type"][:4].tolist() == [1, 2, 3, -1]
    for row, track in ((0, 2), (1, 0), (2, 1)):
        valid = source.tracks.valid[track]
        assert over_time(found, "valid")[row].tolist() == valid.astype(int).tolist()
        columns = {
            "x": source.tracks.xy[track, :, 0],
            "y": source.tracks.xy[track, :, 1],
            "z": source.tracks.z[track],
            "bbox_yaw": source.tracks.heading[track],
            "velocity_x": source.tracks.velocity[track, :, 0],
            "velocity_y": source.tracks.velocity[track, :, 1],
            "speed": np.linalg.norm(source.tracks.velocity[track], axis=-1),
            "length": np.median(source.tracks.size[track, valid, 0]),
        }
        for name, wanted in columns.items():
            wanted = np.broadcast_to(wanted, valid.shape)
            np.testing.assert_allclose(over_time(found, name)[row, valid], wanted[valid], atol=1e-3, rtol=0)
    course = over_time(found, "vel_yaw")[2][source.tracks.valid[1]]
    np.testing.assert_allclose(course, np.arctan2(0.25, 4.0), atol=1e-6)


def test_invalid_states_are_minus_one(found):
    invalid = over_time(found, "valid") == 0
    for name in (*STATE_FLOATS, "timestamp_micros"):
        assert (over_time(found, name)[invalid] == -1).all(), name
    for name in ("id", "type", "is_sdc", "tracks_to_predict", "objects_of_interest", "difficulty_level"):
        assert (found[f"state/{name}"][3:] == -1).all(), name
        assert (found[f"state/{name}"][:3] >= 0).all(), name


def test_marks_of_ego_prediction_and_interest_follow_the_agents(found):
    assert found["state/is_sdc"][:3].tolist() == [1, 0, 0]
    assert found["state/tracks_to_predict"][:3].tolist() == [0, 0, 1]
    assert found["state/objects_of_interest"][:3].tolist() == [1, 0, 1]


def test_times_are_microseconds(found):
    assert over_time(found, "timestamp_micros")[0].tolist() == [100_000 * t for t in range(91)]
    assert over_time(found, "timestamp_micros", "traffic_light_state").tolist() == [
        100_000 * t for t in range(91)
    ]


def test_lights_are_time_major(found):
    ids, states, valid = (over_time(found, name, "traffic_light_state") for name in ("id", "state", "valid"))
    assert valid.shape == (91, 16)
    for step in range(91):
        seen = {int(i): int(s) for i, s, v in zip(ids[step], states[step], valid[step], strict=True) if v}
        assert seen == {2: 4 if step < 50 else 6, **({4: 1} if step >= 20 else {})}
    unseen = valid == 0
    assert (ids[unseen] == -1).all() and (states[unseen] == -1).all()
    x = over_time(found, "x", "traffic_light_state")
    assert (x[unseen] == -1).all()
    np.testing.assert_allclose(x[(ids == 2)], womd_scenario.X0 + 40, atol=1e-3)


def test_roadgraph_samples_are_ordered_as_by_the_official_writer(found):
    kinds, valid = found["roadgraph_samples/type"][:, 0], found["roadgraph_samples/valid"][:, 0] == 1
    ids, xyz = found["roadgraph_samples/id"][:, 0], found["roadgraph_samples/xyz"]
    count = int(valid.sum())
    assert valid[:count].all() and (kinds[count:] == -1).all() and (ids[count:] == -1).all()
    assert (xyz[count:] == -1).all()
    # Kinds in the order of the official writer: lanes, lines, stop signs, crosswalks, bumps, edges, driveways.
    order = [kind for i, kind in enumerate(kinds[:count]) if i == 0 or kinds[i - 1] != kind]
    assert order == [1, 2, 6, 13, 17, 18, 19, 15, 16, 20]
    assert {number: kinds[ids == number][0] for number in (1, 4, 5, 7, 10)} == {
        1: 2,
        4: 1,
        5: 6,
        7: 15,
        10: 18,
    }
    line = xyz[ids == 1]
    np.testing.assert_allclose(line[0], (womd_scenario.X0 - 60, womd_scenario.Y0, 30), atol=1e-3)
    gaps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert gaps.min() > 0.9 and gaps.max() < 1.0
    ring = xyz[ids == 10]
    np.testing.assert_array_equal(ring[0], ring[-1])  # closed, as the official writer does


def test_directions_are_unit_vectors_to_the_next_point(found):
    ids, xyz, to = (found[f"roadgraph_samples/{name}"] for name in ("id", "xyz", "dir"))
    for number in (1, 7, 8, 10):
        rows = np.flatnonzero(ids[:, 0] == number)
        step = np.diff(xyz[rows], axis=0)
        np.testing.assert_allclose(
            to[rows[:-1]], step / np.linalg.norm(step, axis=1, keepdims=True), atol=2e-3
        )
        assert (to[rows[-1]] == 0).all()


def test_speed_limits_are_in_miles_per_hour(found):
    ids, limit = found["roadgraph_samples/id"][:, 0], found["roadgraph_samples/speed_limit"]
    np.testing.assert_allclose(limit[ids == 1], 25.0, rtol=1e-5)
    np.testing.assert_allclose(limit[ids == 4], 45.0, rtol=1e-5)
    assert (limit[(ids != 1) & (ids != 4)] == -1).all()


def test_path_samples_start_at_ego_with_points_1_m_apart(found, source):
    xyz, valid = found["path_samples/xyz"], found["path_samples/valid"] == 1
    counts = valid.sum(axis=1)
    used = np.flatnonzero(counts)
    assert used.tolist() == list(range(len(used))) and len(used) >= 1
    first = xyz[0, : counts[0]]
    np.testing.assert_allclose(first[0, :2], source.tracks.xy[2, 0], atol=0.6)  # where the ego was first seen
    for row in used:
        gaps = np.linalg.norm(np.diff(xyz[row, : counts[row]], axis=0), axis=1)
        np.testing.assert_allclose(gaps, 1.0, atol=0.02)
        arc_length = found["path_samples/arc_length"][row, : counts[row]]
        np.testing.assert_allclose(arc_length, np.append(0, np.cumsum(gaps)), atol=0.1)
    assert (xyz[~valid] == -1).all() and (found["path_samples/id"][~valid] == -1).all()
    assert found["path_samples/on_route"][0] == 1
    assert set(found["path_samples/id"][0, :60].tolist()) <= {1, 2}


def test_published_paths_are_half_a_metre_apart(source):
    published = table(assemble(source), "published")
    count = int(published["path_samples/valid"][0].sum())
    gaps = np.linalg.norm(np.diff(published["path_samples/xyz"][0, :count], axis=0), axis=1)
    np.testing.assert_allclose(gaps, 0.5, atol=0.02)
    assert count > 200


def test_only_paths_that_the_log_follows_are_on_the_route():
    fork = lane(
        5, np.concatenate((arc((60, 30), 30, -np.pi / 2, 0.0), line((90, 30), (90, 200)))), predecessors=(1,)
    )
    features = (
        lane(1, line((-60, 0), (60, 0)), successors=(4, 5)),
        lane(4, line((60, 0), (300, 0))),
        fork,
        edge(7, line((-60, -4), (300, -4))),
    )
    tracks = make_tracks([driving(14.0)])
    found = table(assemble(make_recording(features, tracks)))
    through = [set(ids.tolist()) - {-1, 1} for ids in found["path_samples/id"]]
    on_route = found["path_samples/on_route"][:, 0].tolist()
    assert dict(zip(map(tuple, through[:2]), on_route[:2], strict=True)) == {(4,): 1, (5,): 0}
    assert not any(through[2:]) and not any(on_route[2:])


def test_row_order_ego_then_to_predict_by_id_then_distance_then_the_rest():
    """V-Max takes row 0 for ego; all others are in the data set's order."""
    there = [(50, 0), (5, 3), (80, 0), (9, 3), (7, 3)]
    paths = np.array([driving(5.0), *(np.tile(np.array(place, float), (91, 1)) for place in there)])
    paths[1:, :, 0] += (np.arange(91) - 10) * 0.1  # they move, so that they are not parked
    valid = np.ones((6, 91), bool)
    valid[4, 5:] = False  # 5 steps, not now
    valid[5, :50] = False  # 41 steps, not now
    tracks = replace(make_tracks(paths, valid=valid), track_id=np.array([7, 30, 40, 20, 50, 60]))
    found = table(assemble(make_recording(tracks=tracks, to_predict=(1, 3))))
    assert found["state/id"][:7].tolist() == [7, 20, 30, 40, 60, 50, -1]
    assert found["state/tracks_to_predict"][:6].tolist() == [0, 1, 1, 0, 0, 0]


def test_more_agents_than_rows_are_counted_and_the_far_ones_left_out():
    far = [np.tile((20.0 + i, 2.0), (91, 1)) for i in range(140)]
    tracks = make_tracks([driving(), *far], heading=np.zeros((141, 91)))
    lost: dict = {}
    found = table(assemble(make_recording(tracks=tracks), CAPACITIES["large"]), lost=lost)
    assert lost == {"agents": 13}
    assert sorted(found["state/id"].tolist()) == list(range(100, 228))


def test_more_than_sixteen_lights():
    """Of 20, at most 16 are observed at a step but the last: there the farthest are left out and counted."""
    states = np.full((20, 91), 4)
    for number in range(20):
        states[number, :90][(np.arange(90) + number) % 2 == 0] = -1
    lights = tuple(light(1, 5.0 * (number + 1), 0.0, states[number]) for number in range(20))
    lights = tuple(replace(one, lane_id=1000 + number) for number, one in enumerate(lights))
    lost: dict = {}
    found = table(assemble(make_recording(lights=lights)), lost=lost)
    valid = over_time(found, "valid", "traffic_light_state")
    assert valid[:90].sum(axis=1).tolist() == [10] * 90 and valid[90].sum() == 16
    assert lost == {"light_states": 4}
    x = over_time(found, "x", "traffic_light_state")
    assert sorted(x[90].tolist()) == [5.0 * number for number in range(1, 17)]


def test_coordinates_beyond_float32_become_local():
    """UTM: absolute float32 values would be rounded to half a metre."""
    found = table(assemble(moved(make_recording(), FAR)))
    x = over_time(found, "x")[0]
    np.testing.assert_allclose(x, driving()[:, 0], atol=1e-3)
    path = found["path_samples/xyz"][0, : int(found["path_samples/valid"][0].sum())]
    assert np.abs(path).max() < 500
    _, back = round_trip(moved(make_recording(), FAR))  # drivax' reader goes back to the source's frame
    np.testing.assert_allclose(back.tracks.xy[0], driving() + FAR[:2], atol=1e-3)
    for text in (b"1 2", b"1 2 nan", b"x y z"):
        features = tf_example(assemble(make_recording()))[0] | {ORIGIN: text}
        with pytest.raises(DataError, match=f"{ORIGIN} is not a position"):
            womd_example.WomdExample().decode(example(features))
    near = table(assemble(moved(make_recording(), np.array([8000.0, -9000.0, 12.0]))))
    np.testing.assert_allclose(over_time(near, "x")[0], driving()[:, 0] + 8000.0, atol=1e-3)


def test_ids_beyond_the_range_are_renumbered():
    tracks = replace(make_tracks([driving(), driving(6.0, y=3.5)]), track_id=np.array([2**24 + 1, 5]))
    features = tuple(
        replace(f, feature_id=f.feature_id + 2**33, left_neighbours=(), right_neighbours=())
        for f in straight_road()
    )
    recording = make_recording(features, tracks, lights=(light(2**33 + 1, 30.0, 0.0, np.full(91, 4)),))
    found = table(assemble(recording))
    assert found["state/id"][:3].tolist() == [0, 1, -1]
    ids = found["roadgraph_samples/id"]
    assert ids.max() < 2**31 and np.unique(ids).tolist() == [-1, 0, 1, 2, 3]
    lane_number = found["traffic_light_state/current/id"][0, 0]
    assert found["roadgraph_samples/type"][ids[:, 0] == lane_number].max() == RoadKind.LANE_SURFACE
    assert lane_number in found["path_samples/id"][0]


def test_cones_are_others(source):
    tracks = make_tracks(
        [driving(), np.tile((20.0, 2.0), (91, 1))], kind=[AgentKind.VEHICLE, AgentKind.STATIC]
    )
    assert table(assemble(make_recording(tracks=tracks)))["state/type"][:3].tolist() == [1, 4, -1]


def test_short_recordings_have_no_future():
    tracks = make_tracks([driving(steps=11)])
    stored = assemble(make_recording(tracks=tracks))
    found = table(stored)
    assert over_time(found, "valid")[0].tolist() == [1] * 11 + [0] * 80
    again = assemble(womd_example.WomdExample().decode(example(tf_example(stored)[0])))
    assert Flag.NO_FUTURE in again.has


def test_dense_map_is_sampled_more_sparsely_and_not_cut_off():
    rows = [line((-90, y), (190, y), step=4.0) for y in np.linspace(-95, 95, 110)]
    features = [MapFeature(i + 10, RoadKind.LINE_UNKNOWN, row) for i, row in enumerate(rows)]
    stored = assemble(
        make_recording((*straight_road(), *features)), replace(CAPACITIES["large"], segments=8192)
    )
    found = table(stored)
    valid = found["roadgraph_samples/valid"][:, 0] == 1
    assert 20_000 < valid.sum() <= 30_000
    assert set(found["roadgraph_samples/id"][valid, 0].tolist()) >= {1, 2, 3}
    kept = restore(stored).features
    assert set(found["roadgraph_samples/id"][valid, 0].tolist()) == {feature.feature_id for feature in kept}


# --- The way round: proto -> stored -> tf.Example -> drivax's own reader.


def round_trip(recording, tolerance_m: float = 1e-3):
    stored = assemble(recording)
    payload = example(tf_example(stored)[0])
    assert format_of(payload) == EXAMPLE_FORMAT  # not taken for ScenarioMax's
    back = womd_example.WomdExample().decode(payload)
    kept = restore(stored)
    rows = [kept.tracks.track_id.tolist().index(number) for number in back.tracks.track_id]
    assert sorted(rows) == list(range(len(kept.tracks.kind)))
    assert (back.scenario_id, back.current_step) == (recording.scenario_id, 10)
    np.testing.assert_array_equal(back.tracks.valid, kept.tracks.valid[rows])
    np.testing.assert_array_equal(back.tracks.kind, kept.tracks.kind[rows])
    for name in ("xy", "z", "heading", "velocity", "size"):
        np.testing.assert_allclose(
            getattr(back.tracks, name), getattr(kept.tracks, name)[rows], atol=tolerance_m, rtol=0
        )
    lights = {one.lane_id: one for one in back.lights}
    assert lights.keys() == {one.lane_id for one in kept.lights}
    for one in kept.lights:
        np.testing.assert_array_equal(lights[one.lane_id].states, one.states)
        np.testing.assert_allclose(lights[one.lane_id].stop_point, one.stop_point, atol=tolerance_m)
    assert_same_map(back, kept, 0.01)
    kinds = {feature.feature_id: feature.kind for feature in kept.features}
    assert {feature.feature_id: feature.kind for feature in back.features} == kinds
    limits = {feature.feature_id: feature.limit_mps for feature in kept.features if feature.limit_mps}
    assert {
        f.feature_id: pytest.approx(f.limit_mps, rel=1e-5) for f in back.features if f.limit_mps
    } == limits
    assert Flag.TRUNCATED_MAP not in back.flags
    return stored, back


def test_map_and_valid_steps_survive_a_round_trip(source):
    stored, back = round_trip(source)
    assert_same_map(back, source, 0.1)
    again = assemble(back)
    np.testing.assert_array_equal(again.agent_valid, stored.agent_valid)
    assert again.overflow == stored.overflow


def test_round_trip_of_a_real_scenario(real_data):
    """And against the proto itself: moving agents to a millimetre, parked ones within the 0.3 m of their one pose."""
    (source,) = protos.WomdScenario().read(real_data / "womd" / "motion_data_one_scenario.tfrecord")
    stored, back = round_trip(source)
    assert_same_map(back, source, 0.1)
    assert len(back.tracks.kind) == 83 and len(back.lights) == 12
    rows = [source.tracks.track_id.tolist().index(number) for number in back.tracks.track_id]
    np.testing.assert_array_equal(back.tracks.valid, source.tracks.valid[rows])
    off = np.abs(back.tracks.xy - source.tracks.xy[rows]).max(axis=(1, 2))
    moving = np.isin(back.tracks.track_id, stored.agent_id)
    assert off[moving].max() < 1e-3 and off.max() < 0.301
    lights = {one.lane_id: one.states.tolist() for one in source.lights}
    assert {one.lane_id: one.states.tolist() for one in back.lights} == lights
    counts = {
        kind: sum(f.kind == kind for f in back.features)
        for kind in (RoadKind.CROSSWALK, RoadKind.STOP_SIGN, RoadKind.SPEED_BUMP)
    }
    assert counts == {RoadKind.CROSSWALK: 4, RoadKind.STOP_SIGN: 8, RoadKind.SPEED_BUMP: 3}


def test_round_trip_of_real_gpudrive_and_example_files(real_data):
    from drivax.datasets.gpudrive import GpuDrive

    for path in sorted((real_data / "gpudrive").glob("*.json")):
        (source,) = GpuDrive().read(path)
        round_trip(source)
    (source,) = womd_example.WomdExample().read(real_data / "womd" / "motion_data_one_example.tfrecord")
    round_trip(source)
