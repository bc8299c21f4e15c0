"""The sensor-log reader against the hand-made sample (made with SciPy's rotations), damage, and one real log."""

from __future__ import annotations

import json
import math

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pytest
from scipy.spatial.transform import Rotation

from datasets.samples import av2_motion, av2_sensor
from datasets.samples.av2_sensor import FRAMES, LOG, TURN
from drivax.datasets.argoverse.sensor import ArgoverseSensor, decode, rotate
from drivax.datasets.reader import BadRecord, Reader
from drivax.geometry.vectors import wrap
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Recording, windows
from drivax.scenario.schema import AgentKind, Flag

READER = ArgoverseSensor()
POSES = "city_SE3_egovehicle.feather"


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    return av2_sensor.write(tmp_path_factory.mktemp("av2"))


@pytest.fixture(scope="module")
def recording(sample) -> Recording:
    return decode(sample)


@pytest.fixture
def rewritten(tmp_path):
    """Writes the sample with other annotations or poses; returns its path."""

    def _rewritten(boxes=None, poses=None):
        path = av2_sensor.write(tmp_path)
        for file, change, content in (
            (path, boxes, av2_sensor.annotations()),
            (path.with_name(POSES), poses, av2_sensor.poses()),
        ):
            if change is not None:
                pa.feather.write_feather(pa.table(change(content)), file)
        return path

    return _rewritten


def test_identity_and_time(recording):
    assert (recording.scenario_id, recording.segment, recording.dataset) == (LOG, LOG, "av2")
    assert dict(recording.tags) == {
        "source_format": "av2-sensor", "place": "pittsburgh", "location": "PIT"
    }  # fmt: skip
    assert recording.flags == Flag.DIFFERENTIATED_VELOCITY and recording.lost == {}
    assert (recording.ego, recording.current_step) == (0, 10)
    assert recording.tracks.track_id.tolist() == [0, 1, 2, 3, 5]  # the ego's own boxes are number 4
    kinds = [AgentKind.VEHICLE] * 3 + [AgentKind.STATIC, AgentKind.PEDESTRIAN]
    assert recording.tracks.kind.tolist() == kinds


def test_check_list_23_time_stamps_are_those_of_the_frames(recording):
    """Timestamps are jittered: the real ones are stored."""
    np.testing.assert_allclose(recording.timestamps_s, av2_sensor.stamps() * 1e-9, atol=1e-7)
    assert 1e-5 < np.ptp(np.diff(recording.timestamps_s)) < 2e-3


def test_boxes_are_moved_from_the_car_to_the_city(recording):
    tracks = recording.tracks
    seconds = (av2_sensor.stamps() - av2_sensor.START_NS) * 1e-9
    row = {int(size[0] * 10): i for i, size in enumerate(tracks.size.max(axis=1))}
    for _, _, size, x, y, speed, seen in av2_sensor.BOXES:
        own = row[int(size[0] * 10)]
        steps = np.array(list(seen))
        wanted = av2_motion.place(x + speed * seconds[steps], y, TURN)
        np.testing.assert_array_equal(np.flatnonzero(tracks.valid[own]), steps)
        np.testing.assert_allclose(tracks.xy[own, steps], wanted[:, :2], atol=1e-6)
        np.testing.assert_allclose(tracks.z[own, steps], wanted[:, 2] + size[2] / 2, atol=1e-6)
        facing = wrap(np.array(TURN if speed >= 0 else TURN + math.pi))
        np.testing.assert_allclose(wrap(tracks.heading[own, steps] - facing), 0.0, atol=1e-3)
        velocity = speed * np.array([math.cos(TURN), math.sin(TURN)])
        np.testing.assert_allclose(
            tracks.velocity[own, steps], np.broadcast_to(velocity, (len(steps), 2)), atol=1e-4
        )


def test_check_list_4_invalid_states_are_zero(recording):
    tracks = recording.tracks
    for values in (tracks.xy, tracks.z, tracks.heading, tracks.velocity, tracks.size):
        assert not values[~tracks.valid].any()


@pytest.mark.parametrize("own_boxes", [True, False])
def test_the_ego_is_moved_from_its_rear_axle_to_its_middle(rewritten, own_boxes):
    """With boxes of its own (centred on the axle, as real ones are) and without."""
    tracks = decode(rewritten(lambda _: av2_sensor.annotations(own_boxes))).tracks
    rotation, axle = av2_sensor.axle_pose(av2_sensor.stamps())
    middle = axle + rotation.apply([1.34, 0.0, 1.473 / 2 - 0.33])
    np.testing.assert_allclose(tracks.xy[0], middle[:, :2], atol=1e-6)
    np.testing.assert_allclose(tracks.z[0], middle[:, 2], atol=1e-6)
    np.testing.assert_allclose(tracks.heading[0], TURN, atol=1e-3)
    np.testing.assert_allclose(tracks.size[0], np.broadcast_to([4.877, 2.0, 1.473], (FRAMES, 3)))
    assert tracks.valid[0].all()


def test_rotations_equal_those_of_scipy():
    rng = np.random.default_rng(2)
    quaternion = rng.normal(size=(50, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    vector = rng.normal(size=(50, 3))
    wanted = Rotation.from_quat(quaternion, scalar_first=True).apply(vector)
    np.testing.assert_allclose(rotate(quaternion, vector), wanted, atol=1e-12)
    wanted = Rotation.from_quat(quaternion, scalar_first=True).apply(vector[0])
    np.testing.assert_allclose(rotate(quaternion, vector[0]), wanted, atol=1e-12)


def test_it_becomes_one_scenario(recording, sample):
    found = list(windows(recording))
    assert len(found) == READER.count(sample) == 1
    scenario = assemble(found[0])
    assert {Flag.LANE_GRAPH, Flag.ROUTE, Flag.CLOSED_EDGES, Flag.DIFFERENTIATED_VELOCITY} <= set(scenario.has)
    assert Flag.DEFAULT_SIZES not in scenario.has and Flag.JITTERED_TIME not in scenario.has
    assert not scenario.overflow


def test_frames_without_a_pose_are_left_out_and_counted(rewritten):
    gone = set(av2_sensor.stamps()[[3, 90]].tolist())

    def fewer(poses):
        keep = [i for i, stamp in enumerate(poses["timestamp_ns"]) if int(stamp) not in gone]
        return {name: values[keep] for name, values in poses.items()}

    recording = decode(rewritten(poses=fewer))
    assert recording.lost == {"frames_without_pose": 2} and len(recording.timestamps_s) == FRAMES - 2


def test_repeated_rows_are_counted(rewritten):
    path = rewritten(lambda boxes: {name: [*values, values[0]] for name, values in boxes.items()})
    assert decode(path).lost == {"repeated_rows": 1}


def test_columns_of_unknown_names_are_counted(rewritten):
    path = rewritten(
        lambda boxes: boxes | {"vx_m": boxes["qw"]},
        lambda poses: poses | {"vx_m": poses["qw"], "vy_m": poses["qw"]},
    )
    assert decode(path).lost == {"unknown_fields": 2}


def test_poses_may_be_unordered_and_repeated(rewritten, recording):
    def shuffled(poses):
        order = np.random.default_rng(1).permutation(len(poses["timestamp_ns"]))
        order = np.concatenate((order, order[:9]))
        return {name: values[order] for name, values in poses.items()}

    np.testing.assert_allclose(decode(rewritten(poses=shuffled)).tracks.xy, recording.tracks.xy, atol=1e-9)


@pytest.mark.parametrize(
    ("category", "kind"),
    [
        ("ARTICULATED_BUS", AgentKind.VEHICLE),
        ("WHEELCHAIR", AgentKind.PEDESTRIAN),
        ("STROLLER", AgentKind.PEDESTRIAN),
        ("WHEELED_RIDER", AgentKind.CYCLIST),
        ("MOTORCYCLIST", AgentKind.CYCLIST),
        ("STOP_SIGN", AgentKind.STATIC),
        ("BOLLARD", AgentKind.STATIC),
        ("DOG", AgentKind.OTHER),
        ("SPACESHIP", AgentKind.OTHER),
    ],
)
def test_categories_become_agent_kinds(rewritten, category, kind):
    def renamed(boxes):
        return boxes | {"category": [category if c == "PEDESTRIAN" else c for c in boxes["category"]]}

    tracks = decode(rewritten(renamed)).tracks
    assert tracks.kind[np.argmin(np.abs(tracks.size.max(axis=1)[:, 0] - 0.6))] == kind


def change(name, value):
    def _change(table):
        values = list(table[name])
        values[8] = value  # the car at the third frame
        return table | {name: values}

    return _change


BROKEN = {
    "has no column qw": (lambda t: {k: v for k, v in t.items() if k != "qw"}, None),
    "column tx_m contains": (change("tx_m", None), None),
    "not finite": (change("ty_m", math.nan), None),
    "beyond 100": (change("length_m", 1e300), None),
    "is not a quaternion": (lambda t: t | {n: [0.0] * len(t[n]) for n in ("qw", "qx", "qy", "qz")}, None),
    "beyond 2": (change("qz", 1e200), None),
    "beyond 1e+06": (None, lambda t: t | {"tx_m": t["tx_m"] * 1e9}),
    "no frame has a pose": (None, lambda t: t | {"timestamp_ns": t["timestamp_ns"] + 1}),
}


@pytest.mark.parametrize("problem", BROKEN)
def test_damage_is_one_bad_record_of_one_line(rewritten, problem):
    path = rewritten(*BROKEN[problem])
    (bad,) = READER.read(path)
    assert isinstance(bad, BadRecord) and bad.cure and bad.file in (path, path.with_name(POSES))
    assert problem in bad.problem and "\n" not in str(bad.error())


def test_missing_files_are_named(tmp_path):
    path = av2_sensor.write(tmp_path)
    assert READER.describe(path).missing == ()
    (map_path,) = (path.parent / "map").iterdir()
    map_path.unlink()
    (bad,) = READER.read(path)
    assert "has no map/log_map_archive_*.json next to it" in bad.problem and bad.file == path
    path.with_name(POSES).unlink()
    (bad,) = READER.read(path)
    assert bad.file.name == POSES and bad.problem == "is missing"
    assert READER.describe(path).missing == (POSES, "map/log_map_archive_*.json")


def test_maps_of_unknown_cities_give_no_place(tmp_path):
    path = av2_sensor.write(tmp_path)
    (map_path,) = (path.parent / "map").iterdir()
    map_path.rename(map_path.with_name("log_map_archive_x.json"))
    assert dict(decode(path).tags) == {"source_format": "av2-sensor"}
    assert "unknown city" in READER.describe(path).flavour


def test_truncated_and_empty_files_are_refused(sample, tmp_path):
    path = av2_sensor.write(tmp_path)
    data = sample.read_bytes()
    for content in (
        b"",
        b"ARROW1",
        data[:-20],
        data[: len(data) // 2],
        data[:9000] + b"\xff" * 64 + data[9064:],
    ):
        path.write_bytes(content)
        for item in READER.read(path):
            if not isinstance(item, Recording):
                line = str(item.error())
                assert line.startswith(f"{item.file}: ") and item.cure and "\n" not in line
    path.write_bytes(b"")
    assert READER.count(path) == 0 and not READER.recognise(path)


def test_recognise_and_describe(sample, tmp_path):
    assert isinstance(READER, Reader) and READER.recognise(sample)
    other = tmp_path / "poses.feather"
    other.write_bytes(sample.read_bytes())
    assert not READER.recognise(other) and not READER.recognise(tmp_path)
    found = READER.describe(sample)
    assert found.dataset == "Argoverse 2 Sensor" and found.recordings == 1
    assert f"{FRAMES} frames in pittsburgh" in found.flavour and "5 tracks" in found.notes


# --- The real log (shared/data/README.md counts it by an independent reader).


@pytest.fixture(scope="module")
def real(real_data) -> Recording:
    (path,) = (real_data / "av2_sensor").rglob("annotations*.feather")
    (recording,) = READER.read(path)
    assert isinstance(recording, Recording)
    assert READER.recognise(path) and READER.count(path) == 2
    return recording


def test_real_log_has_the_counted_tracks_of_each_kind(real):
    tracks = real.tracks
    assert tracks.valid.shape == (120, 157) and tracks.valid.sum() == 13_820
    assert tracks.valid[0].all() and real.tags["place"] == "miami" and real.lost == {}
    # 84 cars, 3 trucks, 1 large vehicle and the ego; 12 people; 15 cycles and scooters; 4 bollards and cones.
    assert [int((tracks.kind == kind).sum()) for kind in AgentKind] == [0, 89, 12, 15, 0, 4]
    assert sum(f.kind <= 3 for f in real.features) == 150


def test_real_ego_poses_are_those_of_the_rear_axle(real, real_data):
    """Its own boxes have no offset either; the point that does not slip sideways in the turn is at the pose."""
    (path,) = (real_data / "av2_sensor").rglob("annotations*.feather")
    boxes = pa.feather.read_table(path).to_pydict()
    own = [i for i, category in enumerate(boxes["category"]) if category == "EGO_VEHICLE"]
    assert {boxes[name][i] for i in own for name in ("tx_m", "ty_m", "tz_m")} == {0.0}
    tracks = real.tracks
    heading = np.unwrap(tracks.heading[0])
    axle = tracks.xy[0] - 1.34 * np.stack((np.cos(heading), np.sin(heading)), axis=1)
    rate, velocity = (heading[2:] - heading[:-2]) / 0.2, (axle[2:] - axle[:-2]) / 0.2
    sideways = -np.sin(heading[1:-1]) * velocity[:, 0] + np.cos(heading[1:-1]) * velocity[:, 1]
    assert abs(np.polyfit(rate, sideways, 1)[0]) < 0.3  # the middle of the car would give 1.3 to 1.4 m


def test_real_boxes_stand_on_the_map(real):
    """The bottoms of cars and of the ego are at the height of the nearest map point."""
    tracks = real.tracks
    ground = np.concatenate([f.points for f in real.features])
    for rows in (np.array([0]), np.flatnonzero(tracks.kind == AgentKind.VEHICLE)):
        track, step = np.nonzero(tracks.valid[rows][:, ::20])
        track, step = rows[track], step * 20
        apart = np.hypot(*np.moveaxis(tracks.xy[track, step][:, None] - ground[None, :, :2], -1, 0))
        bottom = tracks.z[track, step] - tracks.size[track, step, 2] / 2
        above = (bottom - ground[apart.argmin(axis=1), 2])[apart.min(axis=1) < 5]
        assert len(above) and abs(np.median(above)) < 0.1


def test_real_motion_is_smooth_and_headings_fit_it(real):
    """Parked cars stay (median below 0.1 m/s), moving ones go where they point."""
    tracks = real.tracks
    speed = np.hypot(*np.moveaxis(tracks.velocity, -1, 0))
    cars = tracks.kind == AgentKind.VEHICLE
    moved = np.array(
        [np.hypot(*np.ptp(xy[ok], axis=0)) for xy, ok in zip(tracks.xy, tracks.valid, strict=True)]
    )
    still = speed[cars & (moved < 1)][tracks.valid[cars & (moved < 1)]]
    assert np.median(still) < 0.1 and np.percentile(still, 99) < 0.5
    fast = tracks.valid & (speed > 3) & cars[:, None]
    course = np.arctan2(tracks.velocity[..., 1], tracks.velocity[..., 0])
    assert np.median(np.cos(course - tracks.heading)[fast]) > 0.99


def test_real_class_default_sizes_of_the_forecasting_reader_fit_the_measured_ones(real):
    """Forecasting files hold no sizes; those of cars are within 15 % of these medians, of pedestrians within 25 %."""
    from drivax.datasets.argoverse.motion import _TYPES

    size = real.tracks.size.max(axis=1)
    cars = (real.tracks.kind == AgentKind.VEHICLE) & (size[:, 0] < 5.5)
    people = real.tracks.kind == AgentKind.PEDESTRIAN
    np.testing.assert_allclose(np.median(size[cars], axis=0), _TYPES["vehicle"][1], rtol=0.15)
    np.testing.assert_allclose(np.median(size[people], axis=0), _TYPES["pedestrian"][1], rtol=0.25)


def test_real_log_becomes_two_windows_of_one_segment(real):
    found = list(windows(real))
    assert [window.scenario_id for window in found] == [f"{real.segment}@0", f"{real.segment}@40"]
    for window in found:
        scenario = assemble(window)
        assert {Flag.LANE_GRAPH, Flag.ROUTE, Flag.CLOSED_EDGES, Flag.ELEVATION} <= set(scenario.has)
        assert json.dumps(scenario.overflow) in ("{}", '{"agents": 2}')
