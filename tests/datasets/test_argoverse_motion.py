"""The forecasting reader against the hand-made sample, damage, and one real scenario."""

from __future__ import annotations

import json
import math

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from datasets.samples import av2_motion
from datasets.samples.av2_motion import height, place
from drivax.datasets.argoverse.motion import ArgoverseMotion, decode
from drivax.datasets.argoverse.tables import read_table
from drivax.datasets.reader import BadRecord, Reader
from drivax.errors import DataError, UsageError
from drivax.geometry.polylines import project
from drivax.geometry.vectors import wrap
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import Recording, windows
from drivax.scenario.schema import EDGE_KINDS, AgentKind, Flag

READER = ArgoverseMotion()


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    return av2_motion.write(tmp_path_factory.mktemp("av2"))


@pytest.fixture(scope="module")
def recording(sample) -> Recording:
    return decode(sample)


@pytest.fixture
def rewritten(tmp_path):
    """Writes the sample with other columns; returns its path."""

    def _rewritten(change=None, **columns):
        path = av2_motion.write(tmp_path)
        table = av2_motion.columns()
        if change is not None:
            table = change(table)
        pq.write_table(pa.table(table | columns), path)
        return path

    return _rewritten


def row(recording, track_id):
    return recording.tracks.track_id.tolist().index(track_id)


def test_identity_and_time(recording):
    assert recording.scenario_id == av2_motion.SCENARIO and recording.dataset == "av2"
    assert (
        recording.segment == "7bef7e1f-0000-4ba5-b39e-00000000aa5b"
    )  # the slice that scenarios are cut from
    assert dict(recording.tags) == {
        "source_format": "av2-motion", "place": "austin", "location": "austin"
    }  # fmt: skip
    assert recording.current_step == 10 and recording.lost == {}
    np.testing.assert_allclose(np.diff(recording.timestamps_s), 0.1, atol=1e-6)
    assert recording.timestamps_s[0] == pytest.approx(315986559.459579)
    assert recording.tracks.valid.shape == (5, 110)


def test_check_list_19_rows_ids_and_marks(recording):
    """Focal track to predict, scored tracks of interest, the ego's text id as a number; indices, not ids."""
    assert recording.tracks.track_id.tolist() == [138902, 138951, 139084, 139085, 0]
    assert recording.ego == 4
    assert recording.to_predict == (1,) and recording.of_interest == (2,)
    assert recording.tracks.kind.tolist() == [
        AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.VEHICLE, AgentKind.OTHER, AgentKind.VEHICLE
    ]  # fmt: skip


def test_tracks_equal_the_positions_of_the_file(recording):
    tracks, t = recording.tracks, np.arange(110)
    np.testing.assert_allclose(tracks.xy[0], place(30 + 0.8 * t, 1.75)[:, :2])
    np.testing.assert_allclose(tracks.velocity[2], np.broadcast_to([-8.0, 0.0], (110, 2)))
    np.testing.assert_array_equal(tracks.valid[1], (t >= 3) & (t < 73))
    np.testing.assert_array_equal(tracks.valid[3], (t >= 20) & (t < 29))


def test_check_list_1_headings_are_wrapped(recording):
    """The sample's pedestrian faces 7 rad, the bus pi."""
    heading = recording.tracks.heading
    assert heading.min() >= -math.pi and heading.max() < math.pi
    assert heading[1, 10] == pytest.approx(7.0 - 2 * math.pi)
    assert heading[2, 10] == pytest.approx(-math.pi)


def test_check_list_4_invalid_states_are_zero(recording):
    tracks = recording.tracks
    for values in (tracks.xy, tracks.z, tracks.heading, tracks.velocity, tracks.size):
        assert not values[~tracks.valid].any()


def test_check_list_3_sizes_are_those_of_the_class_and_flagged(recording):
    """Class defaults and flag: a bus is no car of 4 m; the flag survives assembly."""
    size = recording.tracks.size.max(axis=1)
    np.testing.assert_array_equal(size[2], [11.6, 2.9, 3.0])
    np.testing.assert_array_equal(size[1], [0.7, 0.7, 1.8])
    np.testing.assert_array_equal(size[4], [4.877, 2.0, 1.473])
    assert recording.flags == Flag.DEFAULT_SIZES
    (window,) = windows(recording)
    assert Flag.DEFAULT_SIZES in assemble(window).has


def test_the_ego_is_moved_from_its_rear_axle_to_its_middle(recording):
    """And stands on the sloping road like all agents: box centres half a height above it."""
    tracks, t = recording.tracks, np.arange(110)
    np.testing.assert_allclose(tracks.xy[4], place(4 + 1.34 + 0.8 * t, 1.75)[:, :2])
    on_map = tracks.xy[4, :, 0] - av2_motion.ORIGIN[0]
    np.testing.assert_allclose(tracks.z[4], height(on_map) + 1.473 / 2, atol=0.03)
    np.testing.assert_allclose(tracks.z[1, 10], height(32.0) + 0.9, atol=0.03)


def test_it_becomes_one_scenario(recording):
    """110 steps give one window; step 10 is the current one."""
    (window,) = windows(recording)
    scenario = assemble(window)
    assert window.scenario_id == f"{av2_motion.SCENARIO}@0" and int(scenario.steps) == 91
    assert {Flag.LANE_GRAPH, Flag.ROUTE, Flag.CLOSED_EDGES, Flag.ELEVATION} <= set(scenario.has)
    assert Flag.CHAINED_GRAPH not in scenario.has and Flag.LIGHTS not in scenario.has
    assert Flag.NO_FUTURE not in scenario.has and Flag.SPEED_LIMITS not in scenario.has
    assert not scenario.overflow


def test_check_list_20_the_test_split_is_shorter(rewritten):
    """50 observed steps of 110: judged to the last of them."""

    def observed(table):
        keep = [i for i, step in enumerate(table["timestep"]) if step < 50]
        return {name: [values[i] for i in keep] for name, values in table.items()}

    recording = decode(rewritten(observed))
    assert recording.tracks.valid.shape == (5, 50) and recording.current_step == 10
    assert recording.timestamps_s[-1] - recording.timestamps_s[0] == pytest.approx(4.9, abs=1e-5)
    (window,) = windows(recording)
    scenario = assemble(window)
    assert scenario.steps == 50 and Flag.NO_FUTURE not in scenario.has


def test_ids_that_are_no_numbers_become_row_numbers(rewritten):
    table = av2_motion.columns()
    for odd in (
        "abc",
        "0",
        "99999999999",
        "138902",
    ):  # "0" is the ego's number, 138902 another track's plus a zero
        ids = [{"139085": odd, "138902": "0138902"}.get(name, name) for name in table["track_id"]]
        recording = decode(rewritten(track_id=ids))
        assert recording.tracks.track_id.tolist() == [0, 1, 2, 3, 4] and recording.ego == 4


def test_repeated_rows_are_counted(rewritten):
    recording = decode(rewritten(lambda table: {n: [*v, v[-1]] for n, v in table.items()}))
    assert recording.lost == {"repeated_rows": 1} and recording.tracks.valid[4].all()


def test_columns_of_unknown_names_are_counted(rewritten):
    recording = decode(rewritten(lambda table: table | {"length_m": table["heading"]}))
    assert recording.lost == {"unknown_fields": 1}


def test_unknown_types_are_others(rewritten):
    kinds = ["rickshaw" if kind == "bus" else kind for kind in av2_motion.columns()["object_type"]]
    assert decode(rewritten(object_type=kinds)).tracks.kind[2] == AgentKind.OTHER


def change(name, value, at=5):
    def _change(table):
        values = list(table[name])
        values[at] = value
        return table | {name: values}

    return _change


def without(name):
    return lambda table: {key: values for key, values in table.items() if key != name}


def test_older_files_name_no_slice(rewritten):
    """The public serializer leaves the columns map_id and slice_id out where they are unknown."""
    path = rewritten(lambda table: without("slice_id")(without("map_id")(table)))
    (recording,) = READER.read(path)
    assert recording.segment == recording.scenario_id == av2_motion.SCENARIO
    assert READER.describe(path).recordings == 1


BROKEN = {
    "has no column heading": without("heading"),
    "has no track AV": lambda t: t | {"track_id": ["AW" if i == "AV" else i for i in t["track_id"]]},
    "not finite": change("position_x", math.nan),
    "beyond 1e+06": change("position_y", 1e300),
    "beyond 200": change("velocity_x", 1e5),
    "timesteps run from -1": change("timestep", -1),
    "timesteps run from 0 to 1000000": change("timestep", 1_000_000),
    "column heading contains string": lambda t: t | {"heading": ["x"] * len(t["heading"])},
    "with 1 null values": change("heading", None),
    "contains no rows": lambda t: {n: pa.array([], pa.array(v).type) for n, v in t.items()},
}


@pytest.mark.parametrize("problem", BROKEN)
def test_damage_is_one_bad_record_of_one_line(rewritten, problem):
    path = rewritten(BROKEN[problem])
    (bad,) = READER.read(path)
    assert isinstance(bad, BadRecord) and bad.file == path and bad.cure
    assert problem in bad.problem and "\n" not in str(bad.error())


def test_a_repeated_column_is_reported_as_such(tmp_path):
    path = tmp_path / "x.parquet"
    pq.write_table(pa.Table.from_arrays([pa.array([1]), pa.array([2])], names=["a", "a"]), path)
    with pytest.raises(DataError, match="has several columns a"):
        read_table(path, {"a": "number"})


def test_a_missing_map_is_named(sample, tmp_path):
    path = tmp_path / sample.name
    path.write_bytes(sample.read_bytes())
    (bad,) = READER.read(path)
    assert bad.file.name == f"log_map_archive_{av2_motion.SCENARIO}.json" and bad.problem == "file not found"
    assert READER.describe(path).missing == (bad.file.name,)
    assert READER.describe(sample).missing == ()


def test_truncated_and_empty_files_are_refused(sample, tmp_path):
    data = sample.read_bytes()
    for number, content in enumerate(
        (b"", b"PAR1", data[:-20], data[: len(data) // 2], data[:4] + data[100:])
    ):
        path = tmp_path / f"scenario_{number}.parquet"
        path.write_bytes(content)
        (bad,) = READER.read(path)
        assert isinstance(bad, BadRecord)
        line = str(bad.error())
        assert line.startswith(f"{path}: ") and bad.cure and "\n" not in line


def test_only_scenario_parquet_files_are_recognised(sample, tmp_path):
    assert isinstance(READER, Reader)
    assert READER.recognise(sample) and READER.count(sample) == 1
    other = tmp_path / "table.parquet"
    other.write_bytes(sample.read_bytes())
    empty = tmp_path / "scenario_x.parquet"
    empty.write_bytes(b"")
    for path in (other, empty, tmp_path, tmp_path / "scenario_none.parquet"):
        assert not READER.recognise(path)
    assert READER.count(empty) == 0


def test_description_names_city_steps_and_tracks(sample):
    found = READER.describe(sample)
    assert (found.dataset, found.recordings) == ("Argoverse 2 Motion Forecasting", 1)
    assert "110 steps in austin" in found.flavour and "5 tracks" in found.notes


def test_missing_pyarrow_names_the_extra(sample, hide_packages):
    hide_packages("pyarrow")
    with pytest.raises(UsageError, match=r"pip install 'drivax\[av2\]'"):
        list(READER.read(sample))


# --- The real file (shared/data/README.md counts it by an independent reader).


@pytest.fixture(scope="module")
def real(real_data) -> Recording:
    (path,) = (real_data / "av2").rglob("scenario_*.parquet")
    (recording,) = READER.read(path)
    assert isinstance(recording, Recording)
    return recording


def test_real_scenario_has_the_counted_tracks_of_each_kind(real, real_data):
    tracks = real.tracks
    assert tracks.valid.shape == (58, 110) and tracks.valid.sum() == 2434 and real.lost == {}
    kinds = [int((tracks.kind == kind).sum()) for kind in AgentKind]
    assert kinds == [0, 32, 12, 0, 4, 10]  # 4 riderless bicycles, 8 static and 2 background things
    assert tracks.track_id[real.ego] == 0 and tracks.valid[real.ego].all()
    assert real.tags["place"] == "austin" and len(real.to_predict) == 1


def test_real_ego_poses_are_those_of_the_rear_axle(real, real_data):
    """The point of a car that does not slip sideways is on its rear axle: v_lateral = yaw rate x distance ahead."""
    (path,) = (real_data / "av2").rglob("scenario_*.parquet")
    table = pq.read_table(path).to_pydict()
    own = [i for i, name in enumerate(table["track_id"]) if name == "AV"]
    x, y, heading = (np.array([table[n][i] for i in own]) for n in ("position_x", "position_y", "heading"))
    rate = wrap(heading[2:] - heading[:-2]) / 0.2
    velocity = np.stack((x[2:] - x[:-2], y[2:] - y[:-2])) / 0.2
    sideways = -np.sin(heading[1:-1]) * velocity[0] + np.cos(heading[1:-1]) * velocity[1]
    slope = np.polyfit(rate, sideways, 1)[0]
    assert -0.5 < slope < 0.5  # the middle of the car would give 1.3 to 1.4 m
    apart = real.tracks.xy[real.ego] - np.stack((x, y), axis=1)
    np.testing.assert_allclose(np.hypot(*apart.T), 1.34, atol=1e-6)


def test_real_headings_fit_motion_and_heights_fit_the_map(real):
    tracks = real.tracks
    speed = np.hypot(*np.moveaxis(tracks.velocity, -1, 0))
    fast = tracks.valid & (speed > 3) & (tracks.kind == AgentKind.VEHICLE)[:, None]
    course = np.arctan2(tracks.velocity[..., 1], tracks.velocity[..., 0])
    assert np.median(np.cos(course - tracks.heading)[fast]) > 0.99
    bottom = (tracks.z - tracks.size[..., 2] / 2)[tracks.valid]
    assert bottom.min() > 21.8 and bottom.max() < 25.3  # the heights of the drivable areas


def test_real_ego_drives_on_the_drivable_side(real):
    """At every step all corners of the box are left of the nearest road edge or within 0.3 m of it."""
    tracks, ego = real.tracks, real.ego
    edges = [f.points for f in real.features if f.kind in EDGE_KINDS]
    for step in range(110):
        x, y, heading = *tracks.xy[ego, step], tracks.heading[ego, step]
        for front in (-1, 1):
            for left in (-1, 1):
                ahead, aside = front * 4.877 / 2, left * 1.0
                corner = np.array(
                    [
                        x + ahead * math.cos(heading) - aside * math.sin(heading),
                        y + ahead * math.sin(heading) + aside * math.cos(heading),
                    ]
                )
                assert _depth(edges, corner) > -0.3


def _depth(edges, point) -> float:
    """Distance from the edges, positive inside (crossings of a ray with all rings, even-odd)."""
    crossings, nearest = 0, math.inf
    for ring in edges:
        _, distance = project(ring, point[None])
        nearest = min(nearest, float(distance[0]))
        a, b = ring[:-1, :2], ring[1:, :2]
        over = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
        a, b = a[over], b[over]
        crossings += int(
            (a[:, 0] + (point[1] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]) > point[0]).sum()
        )
    return nearest if crossings % 2 else -nearest


def test_real_log_keeps_to_a_candidate_route(real):
    """Some route stays within 1.5 m of the log at 95 % of its steps."""
    (window,) = windows(real)
    scenario = assemble(window)
    log = scenario.agent_xy[:, 0].astype(np.float64)
    share = []
    for row in range(len(scenario.route_points)):
        count = int(scenario.route_points[row])
        if row != 1 and count >= 2:  # row 1 is the log itself
            _, distance = project(scenario.route_xy[row, :count].astype(np.float64), log[10:])
            share.append((distance <= 1.5).mean())
    assert max(share) >= 0.95


def test_real_json_of_the_map_has_flat_centre_lines(real_data):
    """The reason for taking heights from the boundaries."""
    (path,) = (real_data / "av2").rglob("log_map_archive_*.json")
    segments = json.loads(path.read_bytes())["lane_segments"].values()
    assert {point["z"] for segment in segments for point in segment["centerline"]} == {0.0}
    assert min(point["z"] for segment in segments for point in segment["left_lane_boundary"]) > 20
